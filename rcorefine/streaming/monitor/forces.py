"""Forces of the candidates along the motion, in one compiled loop.

Its memory is kept in arrays.
"""

from __future__ import annotations

import numpy as np

from ...effects.compiled import COUNT, evaluate
from ...jit import compiled

__all__ = ["CODES", "forces"]

#: Signals of the candidates that are no law to evaluate; d and v are what the rows sense.
CODES = {
    "displacement": 101,
    "velocity": 102,
    "acceleration": 102,  # where the rows for v sense it
    "value": 102,  # of a signal that the rows for v sense
    "constant": 103,  # 1
    "deadzone": 104,  # what a dead zone of half width p1 takes away
    "saturation": 105,  # what a limit p1 cuts off
    "rectification": 106,  # |v| - v
    "change": 108,  # what a law makes of d beyond d itself
    "rate": 107,  # minus the rate of v
}


@compiled
def forces(  # type: ignore[no-untyped-def]
    X,  # (N, n + nw)       states before the correction, and inputs
    rows,  # (2, k, n + nw) what each column senses: d, v
    codes,  # (k,)          below 100 for the force of a law
    laws,  # (k,)           the law, as `evaluate` takes it
    n,  # int               number of states
    values,  # (k, 4)       coefficients at which the law is differentiated
    widths,  # (k,)
    pick,  # (k,)           which coefficient
    rate,  # float          samples per second
    inner,  # (3, k)        state of the law, d and v of the sample before; NaN before the first
    F,  # (N, k)            on return
):
    """Force of each column per unit of its coefficient, along the motion."""
    N, k = F.shape
    width = X.shape[1]
    out = np.zeros((1, COUNT + width - n))
    for j in range(k):
        code = codes[j]
        z, d_last, v_last = inner[0, j], inner[1, j], inner[2, j]
        for s in range(N):
            d = 0.0
            v = 0.0
            for i in range(width):
                d += rows[0, j, i] * X[s, i]
                v += rows[1, j, i] * X[s, i]
            if code == 101:
                f = d
            elif code == 102:
                f = v
            elif code == 103:
                f = 1.0
            elif code == 104:
                f = -min(max(v, -values[j, 1]), values[j, 1])
            elif code == 105:
                f = min(max(v, -values[j, 1]), values[j, 1]) - v
            elif code == 106:
                f = abs(v) - v
            elif code == 107:
                f = (v_last - v) * rate if v_last == v_last else 0.0
            else:
                if d_last != d_last:
                    d_last = d
                evaluate(laws[j], d, v, d_last, z, values[j : j + 1], 0, widths[j], X[s, n:], out)
                f = out[0, 0] - d if code == 108 else out[0, 9 + pick[j]]
                z = out[0, 5]
            d_last = d
            v_last = v
            F[s, j] = f
        inner[0, j], inner[1, j], inner[2, j] = z, d_last, v_last
