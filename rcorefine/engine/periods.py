"""Laws over one period of a steady motion, sample by sample: kernels of the harmonic balance."""

from __future__ import annotations

import numpy as np

from ..effects.kernel import evaluate_law
from ..jit import compiled

__all__ = ["dahl_over_period", "law_over_period"]


@compiled
def law_over_period(code, d, v, p, width):
    """Force and its slopes by displacement and velocity; rows of an array of shape (3, n)."""
    found = np.empty((3, d.size))
    for i in range(d.size):
        out = evaluate_law(code, d[i], v[i], 0.0, 0.0, p[0], p[1], p[2], p[3], width)
        found[0, i], found[1, i], found[2, i] = out[0], out[1], out[2]
    return found


@compiled
def dahl_over_period(code, d, p, inner, slope):
    """One turn of a law with memory from an inner state and its derivative by the n displacements.

    Returns the forces, their derivatives (n, n), the inner state at the end, its derivative, and
    how much of the inner state at the start is left.
    """
    n = d.size
    f = np.empty(n)
    by = np.empty((n, n))
    slope = slope.copy()
    left = 1.0
    for i in range(n):
        before = i - 1 if i > 0 else n - 1
        out = evaluate_law(code, d[i], 0.0, d[before], inner, p[0], p[1], p[2], p[3], 1.0)
        f[i] = out[0]
        by[i] = out[4] * slope
        by[i, i] += out[1]
        by[i, before] += out[3]
        slope *= out[8]
        slope[i] += out[6]
        slope[before] += out[7]
        inner = out[5]
        left *= out[8]
    return f, by, inner, slope, left
