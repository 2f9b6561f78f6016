"""Force of each law per unit of its coefficient, along a motion that is known."""

from __future__ import annotations

import numpy as np

from ..systems.linear import Array
from .compiled import MAX_COEFFICIENTS, forces_along, raise_pending
from .effect import Effect
from .formula import PortLaw

__all__ = ["unit_forces"]

_SHARP = 1e-300  # width of a jump that is none


def unit_forces(
    effect: Effect,
    d: Array,
    v: Array,
    shapes: list[dict[str, float]],
    w: Array | None = None,
    rest: tuple[float, float] | None = None,
) -> list[Array] | None:
    """Columns of force (N,), one per coefficient that scales it and per shape.

    Parameters
    ----------
    effect : Effect
        Law at a port.
    d, v : ndarray, shape (N,)
        Displacement and velocity there.
    shapes : list of dict
        Values of the coefficients that shape the law, to be tried.
    w : ndarray, shape (n_w, N), optional
        Inputs, for laws that feel them.
    rest : two floats, optional
        Displacement and velocity at which the force is counted as nothing.

    Returns
    -------
    list of ndarray, or None
        None for a law that is not a force along a motion.
    """
    if rest is not None and effect.spec.signal != "constant":
        d, v = np.append(rest[0], d), np.append(rest[1], v)
        w = None if w is None else np.hstack([0.0 * w[:, :1], w])
        whole = unit_forces(effect, d, v, shapes, w)
        return None if whole is None else [column[1:] - column[0] for column in whole]
    law = effect.spec
    simple = {"displacement": d, "velocity": v, "constant": np.ones(v.size)}.get(law.signal)
    if simple is not None:
        return [np.asarray(simple, dtype=float)]
    if not isinstance(law, PortLaw) or law.needs_starts or (law.feels_inputs and w is None):
        return None
    # a copy: a read-only view would have the kernel compiled once more
    inputs = np.zeros((d.size, 0)) if w is None else np.array(w.T, order="C")
    d, v = np.ascontiguousarray(d, dtype=float), np.ascontiguousarray(v, dtype=float)
    columns: list[Array] = []
    for shape in shapes if law.shaping else [{}]:
        values = {**law.constants, **effect.fixed, **shape}
        if not law.shaping <= values.keys():
            return None
        row = np.zeros((1, MAX_COEFFICIENTS))
        row[0, : len(law.row)] = [values.get(name) or 0.0 for name in law.row]
        found = np.zeros((len(law.coefficients), d.size))
        with np.errstate(all="ignore"):
            forces_along(law.code, d, v, inputs, row, _SHARP, found)
        raise_pending()
        names = enumerate(law.coefficient_names)
        columns += [found[c] for c, name in names if name not in law.shaping]
    return columns
