"""Force laws over a period."""

from __future__ import annotations

import numpy as np

from ..effects.compiled import COUNT, evaluate
from ..jit import compiled


@compiled
def law_over_period(code, d, v, w, values, width):
    """Return a force and its slopes over one period, shape (3, n).

    The rows are the force and its derivatives by displacement and velocity.
    """
    found = np.empty((3, d.size))
    out = np.zeros((1, COUNT + w.shape[1]))
    for i in range(d.size):
        evaluate(code, d[i], v[i], d[i], 0.0, values, 0, width, w[i], out)
        found[0, i], found[1, i], found[2, i] = out[0, 0], out[0, 1], out[0, 2]
    return found


@compiled
def memory_over_period(code, d, v, w, values, inner, slope):
    """Run a force law with an inner state over one period.

    It starts from the inner state and its derivative by the n displacements. The forces, their derivatives
    (n, n), the inner state at the end, its derivative, and the remaining share of the inner state at the
    start are returned.
    """
    n = d.size
    f = np.empty(n)
    by = np.empty((n, n))
    slope = slope.copy()
    left = 1.0
    row = np.zeros((1, COUNT + w.shape[1]))
    for i in range(n):
        before = i - 1 if i > 0 else n - 1
        evaluate(code, d[i], v[i], d[before], inner, values, 0, 1.0, w[i], row)
        out = row[0]
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
