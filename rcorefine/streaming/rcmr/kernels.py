"""Kernels of both stages of retrospective cost optimization.

They process a block of samples: arrays in, arrays out.

One source for both ways of running: numba compiles it where it is installed
(`rcorefine.jit`), otherwise it runs as plain Python.
"""

from __future__ import annotations

import numpy as np

from ...jit import compiled, put, put_rows
from ...systems.linear import Array
from .arrays import AGE, LEARNED, RECENT, SLOT, STALE, Design, Plant, Record, Stage
from .products import add_scaled, affine, half_gradient, product, slide

__all__ = ["advance", "direct_step", "learn"]

# Simulated output over the largest measured one: beyond it the correction has diverged.
DIVERGED = 1e6


@compiled
def remember(stage: Stage, order: int, x: Array, w: Array) -> Array:
    """Shift x(k), w(k) into the regressor and return the correction u(k).

    The correction is theta psi.
    """
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
    """Return the effect of the recent corrections on y(k).

    It is the sum of H_i u(k-i) over the Markov parameters.
    """
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
    """Return whether output, correction and states are below the limit.

    NaN is not.
    """
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


# Samples between two rebuilds of the gain matrix, in windows.
REFRESH_WINDOWS = 10
# A row that leaves with this much of the gain's information forces a rebuild.
DOWNDATE_LIMIT = 1e-4
# Beyond this ratio of window energy to alpha the recursion has no digits left: solve directly.
DIRECT_LIMIT = 1e11


@compiled
def refresh(stage: Stage, alpha: float) -> None:
    """Rebuild the gain matrix from the rows of the window.

    One row after the other enters an empty window.
    """
    count, m = stage.rows.shape
    energy = 0.0
    for i in range(count):
        energy += stage.rows[i] @ stage.rows[i]
    stage.energy[0] = energy
    stage.counters[AGE] = 0
    stage.counters[STALE] = 1 if energy > DIRECT_LIMIT * alpha else 0
    if stage.counters[STALE] == 1:
        return
    stage.gain[:, :] = 0.0
    for i in range(m):
        stage.gain[i, i] = 1.0 / alpha
    stage.pending[:] = 0.0
    nothing, unused = np.zeros(m), np.zeros(m)
    for i in range(count):
        slide(stage.gain, stage.pending, stage.rows[i], nothing, nothing, unused)


@compiled
def _reflect(column: Array, v: Array) -> None:
    """Householder's reflection of a column in the plane across v."""
    column -= (2.0 * (column @ v) / (v @ v)) * v


@compiled
def direct_step(rows: Array, residual: Array, alpha: float) -> Array:
    """Solve the regularized least-squares step by Householder reflections.

    The step s minimizes |residual + rows s|^2 + alpha |s|^2.
    """
    count, m = rows.shape
    right = np.zeros(count + m)  # -residual; 0
    columns = np.zeros((m, count + m))  # of [rows; sqrt(alpha) I]
    for i in range(count):
        right[i] = -residual[i]
        put(columns[:, i], 0, rows[i])
    step = np.zeros(m)
    for j in range(m):
        columns[j, count + j] = np.sqrt(alpha)
    for j in range(m):
        v = columns[j].copy()
        v[:j] = 0.0
        size = np.sqrt(v @ v)
        v[j] += size if v[j] > 0.0 else -size
        for i in range(j, m):
            _reflect(columns[i], v)
        _reflect(right, v)
    for j in range(m - 1, -1, -1):
        step[j] = right[j] / columns[j, j]
        right -= step[j] * columns[j]
    return step


@compiled
def learn(stage: Stage, design: Design, new: Array, offsets: Array) -> None:
    """Slide the window by one sample and minimize the retrospective cost.

    The step is theta -= gain Phi'(f + Phi theta): the part of theta that the
    window does not see is never touched, and an error of the gain does not
    move the minimizer.
    """
    n_y, m = new.shape
    window = stage.rows.shape[0] // n_y
    counters = stage.counters
    slot = counters[SLOT] * n_y
    old = stage.rows[slot : slot + n_y].copy()
    put_rows(stage.rows[slot : slot + n_y], new)
    put(stage.offsets, slot, offsets)
    counters[SLOT] = (counters[SLOT] + 1) % window
    counters[AGE] += 1
    counters[LEARNED] += 1
    theta = stage.theta
    gradient = half_gradient(stage.rows, stage.offsets, theta)
    step = np.empty(m)
    pivot = 1.0
    for r in range(n_y):
        stage.energy[0] += new[r] @ new[r] - old[r] @ old[r]
        if counters[STALE] == 0:
            pivot = min(pivot, slide(stage.gain, stage.pending, new[r], old[r], gradient, step))
    due = counters[AGE] >= REFRESH_WINDOWS * window or pivot < DOWNDATE_LIMIT
    if due or counters[STALE] == 1 or stage.energy[0] > DIRECT_LIMIT * design.alpha:
        refresh(stage, design.alpha)
        if counters[STALE] == 1:
            step = direct_step(stage.rows, product(stage.rows, theta) + stage.offsets, design.alpha)
        else:
            nothing = np.zeros(m)
            slide(stage.gain, stage.pending, nothing, nothing, gradient, step)
            step = -step
        theta += step
    else:
        theta -= step
