"""The retrospective cost over a sliding window, minimized again with every sample.

Compiled where numba is installed (`rcorefine.jit`), otherwise plain Python.
"""

from __future__ import annotations

import numpy as np

from ...jit import compiled, put, put_rows
from ...systems.linear import Array
from .arrays import AGE, LEARNED, SLOT, STALE, Design, Stage
from .products import half_gradient, product, slide

__all__ = ["direct_step", "learn"]

# Samples between two rebuilds of the gain matrix, in windows.
REFRESH_WINDOWS = 10
# A row that leaves with this much of the gain's information forces a rebuild.
DOWNDATE_LIMIT = 1e-4
# Beyond this ratio of window energy to alpha the recursion has no digits left: solve directly.
DIRECT_LIMIT = 1e11


@compiled
def refresh(stage: Stage, alpha: float) -> None:
    """Rebuild the gain matrix from the rows: one after the other enters an empty window."""
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
    """Minimize |residual + rows s|^2 + alpha |s|^2 by Householder's reflections."""
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
