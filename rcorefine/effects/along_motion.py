"""Force of each law per unit of its coefficient, along a motion that is known."""

from __future__ import annotations

import numpy as np

from ..jit import compiled
from ..systems.linear import Array
from .effect import Effect

__all__ = ["unit_forces"]


def unit_forces(effect: Effect, d: Array, v: Array, shapes: list[dict[str, float]]) -> list[Array] | None:
    """Columns of force (N,), one per coefficient that scales it and per shape.

    Parameters
    ----------
    effect : Effect
        Law at a port.
    d, v : ndarray, shape (N,)
        Displacement and velocity there.
    shapes : list of dict
        Values of the coefficients that shape the law, to be tried.

    Returns
    -------
    list of ndarray, or None
        None for a law that is not a force along a motion.
    """
    simple = _SIMPLE.get(effect.kind)
    if simple is not None:
        return [np.asarray(f, dtype=float) for f in simple(d, v)]
    if effect.kind == "custom" and effect.law is not None and not effect.start:
        return [np.array([float(effect.law(a, b)) for a, b in zip(d, v, strict=True)])]
    found: list[Array] = []
    for shape in shapes:
        columns = _shaped(effect.kind, d, v, {**shape, **effect.fixed})
        if columns is None:
            return None
        found += columns
    return found or None


_SIMPLE = {
    "stiffness": lambda d, v: [d],
    "damping": lambda d, v: [v],
    "cubic_stiffness": lambda d, v: [d**3],
    "quadratic_stiffness": lambda d, v: [d * d],
    "bilinear_stiffness": lambda d, v: [np.maximum(d, 0.0)],
    "coulomb_friction": lambda d, v: [np.sign(v)],
    "asymmetric_friction": lambda d, v: [(v > 0) * 1.0, (v < 0) * -1.0],
    "asymmetric_damping": lambda d, v: [np.maximum(v, 0.0), np.minimum(v, 0.0)],
    "quadratic_damping": lambda d, v: [v * np.abs(v)],
    "cubic_damping": lambda d, v: [v**3],
    "sqrt_flow": lambda d, v: [np.sqrt(np.maximum(v, 0.0))],
    "constant_force": lambda d, v: [np.ones(v.size)],
}


def _shaped(kind: str, d: Array, v: Array, shape: dict[str, float]) -> list[Array] | None:
    if kind == "clearance" and "gap" in shape:
        return [np.sign(d) * np.maximum(np.abs(d) - shape["gap"], 0.0)]
    if kind == "threshold_flow" and "threshold" in shape:
        return [np.maximum(v - shape["threshold"], 0.0)]
    if kind == "stribeck_friction" and "velocity" in shape:
        fading = np.exp(-((v / shape["velocity"]) ** 2))
        return [np.sign(v) * (1 - fading), np.sign(v) * fading]
    if kind == "hysteresis" and "displacement" in shape:
        return [_dahl(np.ascontiguousarray(d), float(shape["displacement"]))]
    return None


@compiled
def _dahl(d, width):  # type: ignore[no-untyped-def]
    """Inner state of Dahl's law, exact between samples of a monotonic motion."""
    z = np.zeros(d.size)
    for k in range(1, d.size):
        step = d[k] - d[k - 1]
        sign = 1.0 if step > 0 else -1.0
        z[k] = sign + (z[k - 1] - sign) * np.exp(-abs(step) / width)
    return z
