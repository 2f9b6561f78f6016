"""Conversion of a structure to a `control.NonlinearIOSystem`.

python-control can simulate it.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import control as ct
import numpy as np

from ..effects.compiled import COUNT, evaluate
from ..effects.formula import InputLaw, OutputLaw, PortLaw
from ..systems.linear import Array
from .point import field_numbers
from .structure import Structure


def nonlinear_system(structure: Structure, theta: Array, name: str | None = None) -> ct.NonlinearIOSystem:
    """Continuous-time nonlinear system of a structure.

    Parameters
    ----------
    structure : Structure
        Model and effects.
    theta : ndarray, shape (p,)
        Coefficients.
    name : str, optional
        Name of the system.

    Returns
    -------
    NonlinearIOSystem
        States of the linear part, then one per law with memory.

    Raises
    ------
    ModelError
        If an input or output delay is among the effects: a delay has no finite state.

    Notes
    -----
    `control.input_output_response` interpolates inputs linearly: it agrees with
    rcorefine for records with ``hold="foh"``.
    """
    structure = structure.with_equations()
    # matrices and force laws at these coefficients
    matrices = structure.matrices(theta.astype(float))
    codes, values, _, widths = structure.laws(theta)
    laws = [structure.effects[index].spec for index in structure.port_effects]
    # a law with memory has a state with a differential equation of its own
    memory = [i for i, law in enumerate(laws) if law.inner_states]
    rates = {i: law.rate for i, law in enumerate(laws) if isinstance(law, PortLaw) and law.rate is not None}
    n, m, nw = structure.n_states, structure.n_ports, structure.n_inputs

    def force(i: int, d: float, v: float, z: float, w: Array) -> float:
        out = np.zeros((1, COUNT + nw))
        evaluate(codes[i], d, v, d, z, values[i : i + 1], 0, widths[i], w, out)
        return float(out[0, 0])

    field, (_, numbers, _) = structure.field, field_numbers(structure, theta)
    drive, point = _drive(structure, theta), structure.model.operating_point
    # states are absolute, those of the matrices deviations from the operating point
    above = np.zeros(n + len(memory))
    if point is not None:
        above[: point.states.size] = point.states

    def forces(x: Array, w: Array) -> tuple[Array, Array]:
        # what the places feel: [d; v; arguments of the field] = P [x; w; 1]
        sense = matrices.P @ np.concatenate([x[:n], w])
        inner = dict(zip(memory, x[n:], strict=True))
        found = [force(i, sense[i], sense[m + i], inner.get(i, 0.0), w[:nw]) for i in range(m)]
        if field is not None:
            found += field.table(numbers[0], sense[2 * m :])[:, 0].tolist()
        return np.array(found), sense

    def update(t: float, x: Any, u: Any, params: Any) -> Array:
        x, w = np.asarray(x, dtype=float) - above, drive(u)
        f, sense = forces(x, w)
        # dx/dt = A x + B w + E f
        rate = matrices.A @ x[:n] + matrices.B @ w + matrices.E @ f
        # inner states of the laws: dz/dt = rate(d, v, z)
        inner = []
        for j, i in enumerate(memory):
            speed = sense[m + i]
            inner.append(rates[i](sense[i], speed, x[n + j], *values[i, : len(laws[i].coefficients)]))
        return np.concatenate([rate, inner])

    def output(t: float, x: Any, u: Any, params: Any) -> Array:
        x, w = np.asarray(x, dtype=float) - above, drive(u)
        f, _ = forces(x, w)
        # y = C x + D w + G f, then the laws of the sensors
        y = matrices.C @ x[:n] + matrices.D @ w + matrices.G @ f
        for index, channel in structure.output_statics:
            effect = structure.effects[index]
            assert isinstance(effect.spec, OutputLaw)
            y[channel] = effect.spec.through(y[[channel]], *structure.law_values(theta, index))[0][0]
        return np.asarray(y)

    linear = structure.linear_model
    labels = structure.state_labels() + [f"memory{j + 1}" for j in range(len(memory))]
    return ct.nlsys(
        update,
        output,
        inputs=list(linear.input_labels),
        outputs=list(linear.output_labels),
        states=labels,
        name=name or linear.name,
    )


def _drive(structure: Structure, theta: Array) -> Callable[[Any], Array]:
    """Return a function from the inputs to the drives of the model.

    It applies the effects at the inputs, subtracts the operating point, and appends a constant one.
    """
    point, nw = structure.model.operating_point, structure.n_inputs
    level = np.zeros(nw) if point is None else point.inputs

    def acting(u: Any) -> Array:
        w = np.append(np.atleast_1d(np.asarray(u, dtype=float)), 1.0)
        # static effects at the inputs
        for index, channel in structure.input_statics:
            effect = structure.effects[index]
            assert isinstance(effect.spec, InputLaw)
            w[channel] = effect.spec.through(w[[channel]], *structure.law_values(theta, index))[0][0]
        return w

    # what acts at the operating point, to be subtracted
    rest = np.append(acting(level)[:nw] if structure.balanced else level, 0.0)
    return lambda u: np.asarray(acting(u) - rest)
