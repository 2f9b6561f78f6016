"""Conversion of a `control.NonlinearIOSystem` to a physical model.

The model is linear about an operating point. A `Field` holds the nonlinear rest.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from numbers import Real
from typing import Any
from weakref import WeakKeyDictionary

import control as ct
import numpy as np

from ..effects.right_hand_side import Field, ModelParameter, RightHandSide
from ..effects.straight_line import Remainder, exact_slopes
from ..exceptions import ModelError
from ..systems.linear import Array, LinearModel
from .detection import recognized
from .link_ports import Declared
from .operating_point import as_operating_point
from .parameters import NominalParameter
from .physical_model import PhysicalModel

__all__ = ["as_known", "from_nonlinear", "is_nonlinear"]

_TIMES = (0.0, 1.7)  # at which a model that does not depend on time says the same
_KNOWN: WeakKeyDictionary[Any, tuple[dict[str, Any], PhysicalModel]] = WeakKeyDictionary()


def is_nonlinear(model: Any) -> bool:
    """Return whether a model is a nonlinear system of python-control.

    A StateSpace does not count, although its class is derived from that of nonlinear systems.
    """
    return isinstance(model, ct.NonlinearIOSystem) and not isinstance(model, ct.StateSpace)


def as_known(system: ct.NonlinearIOSystem) -> PhysicalModel:
    """Return the physical model of a system without declarations.

    It is made only once, because its functions are compiled.
    """
    held = _KNOWN.get(system)
    if held is None or held[0] != system.params:
        _KNOWN[system] = held = (dict(system.params), from_nonlinear(system))
    return held[1]


def from_nonlinear(
    system: ct.NonlinearIOSystem,
    declared: Declared | None = None,
    operating_point: Mapping[str, Any] | None = None,
) -> PhysicalModel:
    """Physical model of a nonlinear system.

    Parameters
    ----------
    system : NonlinearIOSystem
        In continuous time, its functions independent of time.
    declared : Declared, optional
        Links, units and masses.
    operating_point : mapping, optional
        As in `physical`; where the model is linearized for observers and starts, default the origin.

    Returns
    -------
    PhysicalModel
        Its linear part, with ports found there, and the field; numbers among `params` are its parameters.

    Raises
    ------
    ModelError
        If the system is in discrete time, has no states, depends on time, or gives no numbers at the point.
    """
    if system.dt not in (0, None):
        raise ModelError(
            f"{system.name!r} is in discrete time; give a nonlinear model in continuous time, dx/dt = f"
        )
    if not system.nstates or system.ninputs is None or system.noutputs is None:
        raise ModelError(
            f"{system.name!r} does not say how many states, inputs and outputs it has; "
            "name them: control.nlsys(..., states=[...], inputs=[...], outputs=[...])"
        )
    n, nw, ny = system.nstates, system.ninputs, system.noutputs
    names = tuple(k for k, v in system.params.items() if isinstance(v, Real) and not isinstance(v, bool))
    others = {k: v for k, v in system.params.items() if k not in names}
    functions = RightHandSide(system.updfcn, system.outfcn, names, others, n, ny, f"{system.name!r}")
    nominal = np.array([float(system.params[name]) for name in names])
    labels = (system.state_labels, system.input_labels, system.output_labels)
    bare = LinearModel.from_statespace(
        ct.ss(np.zeros((n, n)), np.zeros((n, nw)), np.zeros((ny, n)), np.zeros((ny, nw)),
              states=labels[0], inputs=labels[1], outputs=labels[2], name=system.name)
    )  # fmt: skip
    given = {"inputs": np.zeros(nw), "states": np.zeros(n)} if operating_point is None else operating_point
    point = as_operating_point(given, bare)
    level = np.concatenate([point.states, point.inputs])
    here = _checked(functions, level, nominal, operating_point is None)
    L, exact = _slopes(functions, level, nominal), exact_slopes(functions, level, nominal)
    if not np.isfinite(L).all():
        raise ModelError(_NOWHERE.format(label=functions.label, what="have no slope"))
    if exact is not None and np.allclose(exact, L, rtol=1e-6, atol=1e-9 * np.abs(L).max(initial=0.0)):
        L = exact  # but not at a corner, nor where symbols took another way through the functions
    linear = bare.with_arrays(A=L[:n, :n], B=L[:n, n:], C=L[n:, :n], D=L[n:, n:])
    model = PhysicalModel(**recognized(linear.to_statespace(), None, declared))
    if operating_point is None or "outputs" not in operating_point:
        point = replace(point, outputs=here[n:])
    straight = np.vstack([L[:n], np.hstack([model.output_state, model.output_input])])
    field = Field(Remainder(functions, nominal, level, straight, model.output_rate, point.outputs))
    numbers = tuple(
        NominalParameter(name, value, "", ModelParameter.name, name)
        for name, value in zip(names, nominal.tolist(), strict=True)
    )
    return replace(model, parameters=numbers, operating_point=replace(point, field=field))


def _checked(functions: RightHandSide, level: Array, nominal: Array, origin: bool) -> Array:
    """Return rates and outputs at a point, after checks.

    They must not depend on time, and there must be as many as declared.
    """
    n = functions.n_states
    first, later = (functions(level[:n], level[n:], nominal, t) for t in _TIMES)
    if first.size != n + functions.n_outputs:
        raise ModelError(
            f"the functions of {functions.label} give {first.size} numbers for {n} states and "
            f"{functions.n_outputs} outputs"
        )
    if not np.isfinite(first).all():
        raise ModelError(_NOWHERE.format(label=functions.label, what="are no numbers"))
    if not np.array_equal(first, later):
        raise ModelError(f"{functions.label} depends on time; make what changes with time an input")
    return first


_NOWHERE = (
    "the functions of {label} {what} at the point about which they are linearized (the origin, unless "
    "declared): give physical(system, operating_point={{'inputs': ..., 'states': ...}}) where it works"
)


def _slopes(functions: RightHandSide, level: Array, nominal: Array) -> Array:
    """Return the derivatives by states and inputs.

    They are Richardson's central differences, rounded to ten digits.
    """
    n = functions.n_states

    def central(j: int, h: float) -> Array:
        step = np.zeros(level.size)
        step[j] = h
        with np.errstate(all="ignore"):
            up, low = (functions((level + s)[:n], (level + s)[n:], nominal) for s in (step, -step))
        return (up - low) / (2.0 * h)

    columns = []
    for j in range(level.size):
        h = 1e-3 * max(abs(level[j]), 1.0)
        wide, narrow = central(j, h), central(j, 0.5 * h)
        columns.append((4.0 * narrow - wide) / 3.0)
    found = np.column_stack(columns)
    size = np.abs(found).max(axis=1, initial=0.0, keepdims=True)
    found[np.abs(found) < 1e-9 * size] = 0.0
    digits = np.where(found == 0.0, 0.0, 9 - np.floor(np.log10(np.abs(np.where(found == 0, 1.0, found)))))
    return np.round(found * 10.0**digits) / 10.0**digits
