"""The laws of the nonlinear effects: force and exact derivatives.

A law gives the resisting force at the end of a step from the displacement and
the velocity there. Laws with memory (Dahl hysteresis) also see the displacement
at the start of the step and their inner state, which they update exactly along
the displacement (the law is rate independent). ``sgn(v)`` is ``tanh(v / width)``
with a small fixed width: a free one was found to make estimates worse.
"""

from __future__ import annotations

import math
from typing import Final

from ..jit import compiled

__all__ = ["MAX_COEFFICIENTS", "evaluate_law"]

MAX_COEFFICIENTS: Final = 4


@compiled
def evaluate_law(code, d, v, d_start, z_start, p0, p1, p2, p3, width):
    """Force, inner state and their partial derivatives at the end of a step.

    Returns ``(f, f_d, f_v, f_ds, f_zs, z, z_d, z_ds, z_zs, f_p0..f_p3, z_p0..z_p3)``.
    """
    f = f_d = f_v = f_ds = f_zs = 0.0
    z = z_start
    z_d = z_ds = 0.0
    z_zs = 1.0
    g0 = g1 = g2 = g3 = 0.0
    y0 = y1 = y2 = y3 = 0.0
    if code == 1:
        g0 = d * d * d
        f = p0 * g0
        f_d = 3.0 * p0 * d * d
    elif code == 2:
        g0 = d * d
        f = p0 * g0
        f_d = 2.0 * p0 * d
    elif code == 3:
        if d > 0.0:
            g0 = d
            f_d = p0
        f = p0 * g0
    elif code == 4:
        excess = abs(d) - p1
        if excess > 0.0:
            side = 1.0 if d > 0.0 else -1.0
            g0 = side * excess
            f_d = p0
            g1 = -p0 * side
        f = p0 * g0
    elif code == 5:
        g0 = math.tanh(v / width)
        f = p0 * g0
        f_v = p0 * (1.0 - g0 * g0) / width
    elif code == 6:
        s = math.tanh(v / width)
        slope = (1.0 - s * s) / width
        if v > 0.0:
            g0 = s
            f = p0 * s
            f_v = p0 * slope
        else:
            g1 = s
            f = p1 * s
            f_v = p1 * slope
    elif code == 7:
        if v > 0.0:
            g0 = v
            f = p0 * v
            f_v = p0
        else:
            g1 = v
            f = p1 * v
            f_v = p1
    elif code == 8:
        s = math.tanh(v / width)
        slope = (1.0 - s * s) / width
        bell = math.exp(-((v / p2) ** 2))
        level = p0 + (p1 - p0) * bell
        f = level * s
        f_v = level * slope - (p1 - p0) * bell * 2.0 * v / (p2 * p2) * s
        g0 = (1.0 - bell) * s
        g1 = bell * s
        g2 = (p1 - p0) * bell * 2.0 * v * v / (p2 * p2 * p2) * s
    elif code == 9:
        g0 = v * abs(v)
        f = p0 * g0
        f_v = 2.0 * p0 * abs(v)
    elif code == 10:
        g0 = v * v * v
        f = p0 * g0
        f_v = 3.0 * p0 * v * v
    elif code == 11:
        step = d - d_start
        side = 1.0 if step >= 0.0 else -1.0
        decay = math.exp(-abs(step) / p1)
        z = side + (z_start - side) * decay
        z_d = -(z_start - side) * decay * side / p1
        z_ds = -z_d
        z_zs = decay
        y1 = (z_start - side) * decay * abs(step) / (p1 * p1)
        f = p0 * z
        f_d = p0 * z_d
        f_ds = p0 * z_ds
        f_zs = p0 * z_zs
        g0 = z
        g1 = p0 * y1
    elif code == 12:
        if v > 0.0:
            root = (v * v + width * width) ** 0.25
            g0 = v / root
            f_v = p0 * (1.0 / root - 0.5 * v * v / (root * root * root * root * root))
        f = p0 * g0
    elif code == 13:
        excess = v - p1
        if excess > 0.0:
            g0 = excess
            f_v = p0
            g1 = -p0
        f = p0 * g0
    return f, f_d, f_v, f_ds, f_zs, z, z_d, z_ds, z_zs, g0, g1, g2, g3, y0, y1, y2, y3
