"""What one output of a sample teaches a filter: about its state and about its coefficients.

The filter is a Kalman filter for state and coefficients jointly, kept in two parts
(Friedland, IEEE Trans. Automatic Control 14 (1969) 359): the state as if the coefficients
were known, and the sensitivity of the filtered state to them. What a sample teaches about
the coefficients moves the state as if the model had always had them, to first order; that is the
retrospective filter about the current refined model. Names as in `packed`.
"""

from __future__ import annotations

import numpy as np

from ...jit import compiled

__all__ = [
    "coefficient_gain",
    "collect",
    "forget",
    "move_coefficients",
    "move_state",
    "moved",
    "reduce_covariance",
    "state_gain",
    "step_covariance",
]


@compiled
def state_gain(i, R, Pb, F, H, gain):
    """Gain of the state for known coefficients, before and after the transition; variance of output i."""
    n = Pb.shape[0]
    s = R
    for a in range(n):
        total = 0.0
        for b in range(n):
            total += Pb[a, b] * H[i, b]
        gain[0, a] = total
        s += H[i, a] * total
    for a in range(n):
        gain[0, a] /= s
    for a in range(n):
        total = 0.0
        for b in range(n):
            total += F[a, b] * gain[0, b]
        gain[1, a] = total
    return s


@compiled
def coefficient_gain(i, Pt, h, g):
    """Covariance of the coefficients with output i, and what they add to its variance."""
    p = g.shape[0]
    spread = 0.0
    for a in range(p):
        total = 0.0
        for b in range(p):
            total += Pt[a, b] * h[i, b]
        g[a] = total
        spread += h[i, a] * total
    return spread


@compiled
def collect(i, e, st, delta, h, g):
    """What output i says about coefficients that are kept."""
    for a in range(g.shape[0]):
        e -= h[i, a] * delta[a]
    for a in range(g.shape[0]):
        delta[a] += g[a] * e / st


@compiled
def move_coefficients(i, e, st, theta, limits, x, S, h, g, yhat):
    """Move the coefficients inside their bounds, and all that they move; return what is left of `e`."""
    left = e
    for a in range(theta.shape[0]):
        aim = theta[a] + g[a] * e / st
        if aim < limits[0, a]:
            aim = limits[0, a]
        elif aim > limits[1, a]:
            aim = limits[1, a]
        move = aim - theta[a]
        theta[a] = aim
        left -= h[i, a] * move
        for b in range(x.shape[0]):
            x[b] += S[a, b] * move
        for j in range(i + 1, yhat.shape[0]):
            yhat[j] += h[j, a] * move
    return left


@compiled
def move_state(i, e, s, x, S, Pb, H, h, gain, yhat):
    """Move the state, and what the later outputs and the sensitivities have of it."""
    n, p = x.shape[0], S.shape[0]
    for b in range(n):
        x[b] += gain[1, b] * e
    for j in range(i + 1, yhat.shape[0]):
        c = 0.0
        for b in range(n):
            c += H[j, b] * gain[0, b]
        yhat[j] += c * e
        for a in range(p):
            h[j, a] -= c * h[i, a]
    for a in range(p):
        for b in range(n):
            S[a, b] -= gain[1, b] * h[i, a]
    for a in range(n):
        for b in range(n):
            Pb[a, b] -= s * gain[0, a] * gain[0, b]


@compiled
def forget(i, s, spread, forgetting, S, h, g, gain, loose):
    """Forget along what this sample saw only (Kulhavy); return the share that is learned of it.

    The coefficients may have changed just now: the state no longer answers for them since the start.
    """
    n, p = gain.shape[1], g.shape[0]
    st = s + spread
    ratio = spread / s
    kept = forgetting - (1.0 - forgetting) / ratio
    down = kept / (s * (1.0 + kept * ratio))
    extra = 1.0 / st - down
    share = extra / (1.0 + extra * spread * st / s)
    for b in range(n):
        total = 0.0
        for a in range(p):
            total += g[a] * S[a, b]
        gain[0, b] = total
    for a in range(p):
        for b in range(n):
            S[a, b] -= share * h[i, a] * st / s * gain[0, b]
    for a in range(n):
        for b in range(n):
            loose[a, b] += share * gain[0, a] * gain[0, b]
    return down


@compiled
def reduce_covariance(Pt, g, down):
    """Covariance of the coefficients after an output."""
    p = g.shape[0]
    for a in range(p):
        before = Pt[a, a]
        for b in range(p):
            Pt[a, b] -= down * g[a] * g[b]
        # rounding must not make it negative where one sample teaches almost everything
        if Pt[a, a] < 1e-13 * before:
            Pt[a, a] = 1e-13 * before


@compiled
def step_covariance(Pb, F, Q, loose, T):
    """Covariance of the state one sample on: F Pb F', and what unknown forces and forgetting add."""
    n = F.shape[0]
    for a in range(n):
        for b in range(n):
            total = 0.0
            for c in range(n):
                total += F[a, c] * Pb[c, b]
            T[a, b] = total
    for a in range(n):
        for b in range(a + 1):
            total = Q[a, b] + loose[a, b]
            for c in range(n):
                total += T[a, c] * F[b, c]
            Pb[a, b] = total
            Pb[b, a] = total


@compiled
def moved(theta, centre, Pt, share, least):
    """Whether a coefficient has moved so far that the model is to be discretized anew."""
    for a in range(theta.shape[0]):
        shift = abs(theta[a] - centre[a])
        if shift > least[a] and shift > share * np.sqrt(max(Pt[a, a], 0.0)):
            return True
    return False
