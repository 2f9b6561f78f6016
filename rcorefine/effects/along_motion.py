"""Force of each law per unit of its coefficient, along a known motion."""

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
        Displacement and velocity at an operating point: force and tangent there are subtracted, but no
        tangent by a velocity that is zero.

    Returns
    -------
    list of ndarray, or None
        None for a law that is not a force along a motion.
    """
    if rest is not None and effect.spec.signal != "constant":
        sizes = np.abs([rest[0] or np.abs(d).max(initial=0.0), rest[1]]) * (not effect.spec.linear)
        steps = 1e-5 * sizes * (not effect.spec.inner_states)
        near = np.array(rest)[:, None] + steps[:, None] * [[0, 1, -1, 0, 0], [0, 0, 0, 1, -1]]
        per, moved = 0.5 * steps / np.maximum(steps, 1e-150) ** 2, np.hstack([near, [d, v]])
        whole = unit_forces(effect, moved[0], moved[1], shapes)  # none feels inputs at a point
        above = moved[:, 5:] - near[:, :1]
        return whole and [f[5:] - f[0] - (f[[1, 3]] - f[[2, 4]]) * per @ above for f in whole]
    law, simple = effect.spec, {"displacement": d, "velocity": v, "constant": np.ones(v.size)}
    if law.signal in simple:
        return [np.asarray(simple[law.signal], dtype=float)]
    if not isinstance(law, PortLaw) or law.needs_starts or (law.feels_inputs and w is None):
        return None
    # a copy: a read-only view would have the kernel compiled once more
    inputs = np.zeros((d.size, 0)) if w is None else np.array(w.T, order="C")
    d, v, columns = np.ascontiguousarray(d, dtype=float), np.ascontiguousarray(v, dtype=float), list[Array]()
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
        columns += [found[c] for c, name in enumerate(law.coefficient_names) if name not in law.shaping]
    return columns
