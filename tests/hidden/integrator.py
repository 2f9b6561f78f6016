"""Motion of a plant with a law at one place, by Dormand-Prince steps that never cross a sample.

Written for the tests alone: it shares nothing with the package, and `tests/test_hidden_generator.py`
holds it against `scipy.integrate.solve_ivp`.
"""

from __future__ import annotations

import math

import numpy as np

try:
    from numba import njit
except ImportError:

    def njit(**_options):
        """Run as plain Python, slowly."""
        return lambda function: function


LAWS = {
    name: code
    for code, name in enumerate(
        [
            "none", "stiffness", "damping", "cubic_stiffness", "quadratic_stiffness", "bilinear_stiffness",
            "coulomb_friction", "quadratic_damping", "cubic_damping", "clearance", "ramp", "jenkins",
            "bouc-wen", "dahl", "hidden mass", "v^1.5", "soft dead zone", "lugre", "sine", "quintic",
            "impact damper", "backlash", "valve", "soft saturation", "inverse square", "radiation", "sqrt v",
        ]
    )
}  # fmt: skip
MEMORY = {"jenkins": 1, "bouc-wen": 1, "dahl": 1, "hidden mass": 2, "lugre": 1, "backlash": 1}


@njit(cache=True)
def force_of(code, p, t, d, v, z, inner):
    """Resisting force of a law, and the rates of its inner states; p[0] scales it."""
    if code == 1:
        return p[0] * d
    if code == 2:
        return p[0] * v
    if code == 3:
        return p[0] * d**3
    if code == 4:
        return p[0] * d * d
    if code == 5:
        return p[0] * max(d, 0.0)
    if code == 6:
        return p[0] * math.tanh(v / p[1])
    if code == 7:
        return p[0] * v * abs(v)
    if code == 8:
        return p[0] * v**3
    if code == 9:
        return p[0] * math.copysign(max(abs(d) - p[1], 0.0), d)
    if code == 10:
        return p[0] * d * t / p[1]
    if code == 11:  # an elastic slider
        inner[0] = 0.0 if abs(z[0]) >= p[1] and z[0] * v > 0 else v
        return p[0] * z[0] / p[1]
    if code == 12:
        inner[0] = v - (0.6 * abs(v) * z[0] + 0.4 * v * abs(z[0])) / p[1]
        return p[0] * z[0] / p[1]
    if code == 13:
        inner[0] = v - abs(v) * z[0] / p[1]
        return p[0] * z[0] / p[1]
    if code == 14:  # p = stiffness, damping, mass
        force = p[0] * (d - z[0]) + p[1] * (v - z[1])
        inner[0] = z[1]
        inner[1] = force / p[2]
        return force
    if code in (15, 26):  # a power of the speed, p[1]
        return p[0] * v * (v * v + 1e-12) ** (0.5 * (p[1] - 1.0))
    if code == 16:  # rounded over a third of the gap
        w = 0.3 * p[1]
        right, left = (d - p[1]) / w, (-d - p[1]) / w
        up = right if right > 30.0 else math.log1p(math.exp(right))
        down = left if left > 30.0 else math.log1p(math.exp(left))
        return p[0] * w * (up - down)
    if code == 17:  # bristles that slip at 1 to 1.5 times the level
        inner[0] = v - abs(v) * z[0] / (p[1] * (1.0 + 0.5 * math.exp(-((v / (20.0 * p[1])) ** 2))))
        return p[0] * z[0] / p[1]
    if code == 18:
        return p[0] * math.sin(d / p[1])
    if code == 19:
        return p[0] * d**5
    if code == 20:
        return p[0] * v * max(d, 0.0)
    if code == 21:  # a spring behind a play
        inner[0] = v if (d - z[0] >= p[1] and v > 0.0) or (d - z[0] <= -p[1] and v < 0.0) else 0.0
        return p[0] * z[0]
    if code == 22:  # a damper that blows off
        return p[0] * (v if abs(v) < p[1] else math.copysign(p[1] + 0.2 * (abs(v) - p[1]), v))
    if code == 23:
        return p[0] * math.tanh(d / p[1])
    if code == 24:
        return p[0] * ((1.0 + d / p[1]) ** -2 - 1.0)
    if code == 25:
        return p[0] * ((1.0 + v / p[1]) ** 4 - 1.0)
    return 0.0


@njit(cache=True)
def _rate(A, drive, slope, s, act, sense_d, sense_v, codes, p, t, x, n, out):
    inner = np.zeros(2)
    first = np.zeros(2)
    for i in range(n):
        total = drive[i] + s * slope[i]
        for j in range(n):
            total += A[i, j] * x[j]
        out[i] = total
    for law in range(codes.size):
        d = 0.0
        v = 0.0
        for j in range(n):
            d += sense_d[law, j] * x[j]
            v += sense_v[law, j] * x[j]
        force = force_of(codes[law], p[law], t, d, v, x[n:], first if law == 0 else inner)
        for i in range(n):
            out[i] += act[law, i] * force
    for i in range(n, x.size):
        out[i] = first[i - n]


@njit(cache=True)
def march(A, steer, act, sense_d, sense_v, codes, p, memory, dt, rtol, atol, most, held, start):
    """States (N, n + memory); row 0 is `start`; nan from where it runs away or gets too stiff.

    One row of act, sense_d, sense_v and p per law; only the first may have inner states.
    steer runs linearly between samples, or is held.
    """
    N, n = steer.shape
    size = n + memory
    X = np.full((N, size), np.nan)
    x = start.copy()
    X[0] = x
    k = np.zeros((7, size))
    c = np.array([0.0, 1 / 5, 3 / 10, 4 / 5, 8 / 9, 1.0, 1.0])
    a = np.array(
        [
            [0.0, 0, 0, 0, 0, 0],
            [1 / 5, 0, 0, 0, 0, 0],
            [3 / 40, 9 / 40, 0, 0, 0, 0],
            [44 / 45, -56 / 15, 32 / 9, 0, 0, 0],
            [19372 / 6561, -25360 / 2187, 64448 / 6561, -212 / 729, 0, 0],
            [9017 / 3168, -355 / 33, 46732 / 5247, 49 / 176, -5103 / 18656, 0],
            [35 / 384, 0, 500 / 1113, 125 / 192, -2187 / 6784, 11 / 84],
        ]
    )
    e = np.array([71 / 57600, 0, -71 / 16695, 71 / 1920, -17253 / 339200, 22 / 525, -1 / 40])
    h = dt
    taken = 0
    for step in range(N - 1):
        slope = (steer[step + 1] - steer[step]) / dt
        if held:
            slope[:] = 0.0
            h = min(h, 0.05 * dt)  # the input has jumped
        s = 0.0
        while s < dt * (1 - 1e-12):
            h = min(h, dt - s)
            for stage in range(7):
                trial = x.copy()
                for j in range(stage):
                    for i in range(size):
                        trial[i] += h * a[stage, j] * k[j, i]
                at = s + c[stage] * h
                _rate(
                    A,
                    steer[step],
                    slope,
                    at,
                    act,
                    sense_d,
                    sense_v,
                    codes,
                    p,
                    step * dt + at,
                    trial,
                    n,
                    k[stage],
                )
            worst = 0.0
            for i in range(size):
                error = 0.0
                for stage in range(7):
                    error += h * e[stage] * k[stage, i]
                worst = max(worst, abs(error) / (atol[i] + rtol * max(abs(x[i]), abs(trial[i]))))
            taken += 1
            if not np.isfinite(worst) or taken > most:
                return X
            if worst <= 1.0:
                s += h
                x = trial  # the last stage is the solution
            h *= min(5.0, max(0.2, 0.9 * max(worst, 1e-10) ** -0.2))
        X[step + 1] = x
    return X
