"""Both stages of retrospective cost optimization over a block of samples: arrays in, arrays out.

One source for both ways of running: numba compiles it where it is installed
(`rcorefine.jit`), otherwise it runs as plain Python.
"""

from __future__ import annotations

import numpy as np

from ...jit import compiled, put
from ...systems.linear import Array
from .arrays import LEARNED, RECENT, Design, Plant, Record, Stage
from .products import add_scaled, affine, product
from .window import learn

__all__ = ["advance"]

# Simulated output over the largest measured one: beyond it the correction has diverged.
DIVERGED = 1e6


@compiled
def remember(stage: Stage, order: int, x: Array, w: Array) -> Array:
    """Shift x(k) and w(k) into the regressor, and return the correction u(k) = theta psi."""
    psi = stage.psi
    n, n_w, l_u = x.size, w.size, stage.past_u.shape[1]
    recent = stage.counters[RECENT]
    first_w = (order + 1) * n
    first_u = first_w + (order + 1) * n_w
    if order > 0:
        put(psi, n, psi[: first_w - n].copy())
        put(psi, first_w + n_w, psi[first_w : first_u - n_w].copy())
        put(psi, first_u + l_u, psi[first_u : psi.size - l_u].copy())
        put(psi, first_u, stage.past_u[recent])
    put(psi, 0, x)
    put(psi, first_w, w)
    u = product(stage.theta[: l_u * psi.size].reshape(l_u, psi.size), psi)
    recent = (recent + 1) % stage.past_u.shape[0]
    stage.counters[RECENT] = recent
    put(stage.past_psi[recent], 0, psi)
    put(stage.past_u[recent], 0, u)
    return u


@compiled
def reach(design: Design, past_u: Array, recent: int) -> Array:
    """Sum of H_i u(k-i) over the Markov parameters: what the recent corrections do to y(k)."""
    total = np.zeros(design.H.shape[1])
    for i in range(design.H.shape[0]):
        total += product(design.H[i], past_u[(recent - design.delay - i) % past_u.shape[0]])
    return total


@compiled
def filtered(design: Design, past_psi: Array, recent: int, width: int) -> Array:
    """Rows sum of H_i (x) psi(k-i), one per output, padded to `width`."""
    mu, n_y, l_u = design.H.shape
    q = past_psi.shape[1]
    rows = np.zeros((n_y, width))
    for i in range(mu):
        psi = past_psi[(recent - design.delay - i) % past_psi.shape[0]]
        for r in range(n_y):
            for c in range(l_u):
                add_scaled(rows[r], c * q, design.H[i, r, c], psi)
    return rows


@compiled
def bounded(simulated: Array, u: Array, x: Array, limit: float) -> bool:
    """Whether output, correction and states are numbers of a sane size (NaN is not)."""
    largest = max(np.abs(simulated).max(), np.abs(u).max())
    return bool(largest <= limit and np.abs(x).sum() <= DIVERGED * limit)


@compiled
def _follow(level: Array, rate: float, signal: Array) -> None:
    """Mean square of each entry, of limited memory."""
    for i in range(level.shape[0]):
        level[i] += rate * (signal[i] * signal[i] - level[i])


@compiled
def advance(
    plant: Plant,
    design1: Design,
    design2: Design,
    stage1: Stage,
    stage2: Stage,
    peak: Array,
    levels: Array,
    recent_theta: Array,
    w: Array,
    y: Array,
    estimated: bool,
    record: Record,
) -> tuple[int, int]:
    """Run both stages over a block of samples; the stages change in place.

    Parameters
    ----------
    peak : ndarray of shape (1,)
        Largest scaled output measured so far, at least 1.
    levels : ndarray of shape (3, n_y)
        Mean squares of y, z1 and z2, with a memory of one window of stage 1.
    recent_theta : ndarray of shape (average, m)
        Latest coefficients of stage 2, as a ring.
    estimated : bool
        Whether stage 2 sees the states of stage 1; otherwise its own, and
        stage 1 does not learn: it is the initial model.

    Returns
    -------
    sample, stage : int
        Number of samples done and 0, or where and in which stage it diverged.
    """
    keep = record.z1.shape[0] > 0
    rate = y.shape[1] / stage1.rows.shape[0]
    for k in range(w.shape[0]):
        peak[0] = max(peak[0], np.abs(y[k]).max())
        limit = DIVERGED * peak[0]
        x = stage1.x.copy()
        u = remember(stage1, design1.order, x, w[k])
        simulated = affine(plant.C, x, plant.D, w[k], plant.Du, u)
        if not bounded(simulated, u, x, limit):
            return k, 1
        z1 = simulated - y[k]
        recent = stage1.counters[RECENT]
        offsets = z1 - reach(design1, stage1.past_u, recent)
        # y^ predicted from the states of stage 1 is y_Delta with u2 in the place of u1
        # over the span of the Markov parameters: free of theta2 but for that span.
        z2 = z1 - reach(design2, stage1.past_u, recent)
        if estimated:
            learn(stage1, design1, filtered(design1, stage1.past_psi, recent, stage1.theta.size), offsets)
            if not np.isfinite(stage1.theta.sum()):
                return k, 1
        put(stage1.x, 0, affine(plant.A, x, plant.B, w[k], plant.Bu, u))

        x2 = x if estimated else stage2.x.copy()
        u = remember(stage2, design2.order, x2, w[k])
        recent = stage2.counters[RECENT]
        if estimated:
            offsets = z2
            z2 = offsets + reach(design2, stage2.past_u, recent)
        else:
            z2 = affine(plant.C, x2, plant.D, w[k], plant.Du, u) - y[k]
            offsets = z2 - reach(design2, stage2.past_u, recent)
            put(stage2.x, 0, affine(plant.A, x2, plant.B, w[k], plant.Bu, u))
        if not bounded(z2 + y[k], u, x2, limit):
            return k, 2
        learn(stage2, design2, filtered(design2, stage2.past_psi, recent, stage2.theta.size), offsets)
        if not np.isfinite(stage2.theta.sum()):
            return k, 2
        put(recent_theta[(stage2.counters[LEARNED] - 1) % recent_theta.shape[0]], 0, stage2.theta)
        _follow(levels[0], rate, y[k])
        _follow(levels[1], rate, z1)
        _follow(levels[2], rate, z2)
        if keep:
            put(record.z1[k], 0, z1)
            put(record.z2[k], 0, z2)
            put(record.theta1[k], 0, stage1.theta)
            put(record.theta2[k], 0, stage2.theta)
            put(record.x[k], 0, x)
    return w.shape[0], 0
