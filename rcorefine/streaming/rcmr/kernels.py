"""Kernels of both stages of retrospective cost optimization.

They process a block of samples: arrays in, arrays out. Signals are rows in time (time first, so that one
sample is contiguous) and scaled to unit size; `delay` is d and `H` holds H_d ... H_(d+mu-1).

One source for both ways of running: numba compiles it where it is installed
(`rcorefine.jit`), otherwise it runs as plain Python. The innermost passes have two bodies: scalar loops
are the fast form where numba compiles them; in plain Python arrays do it.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy.linalg.blas import dger

from ...jit import NUMBA, compiled, put, put_rows
from ...systems.linear import Array
from ..samples import Integers

# Columns of Stage.counters
SLOT, AGE, STALE, RECENT, LEARNED = 0, 1, 2, 3, 4
# theta, rows and gain are padded with zeros to a multiple of this, which the passes run faster over.
PADDING = 4


class Plant(NamedTuple):
    """Scaled discrete model: x+ = A x + B w + B_u u, y = C x + D w + D_u u."""

    A: Array
    B: Array
    Bu: Array
    C: Array
    D: Array
    Du: Array


class Design(NamedTuple):
    """Settings of one stage; `H` has shape (mu, n_y, l_u)."""

    H: Array
    delay: int
    order: int
    alpha: float


class Stage(NamedTuple):
    """Everything that one stage remembers.

    theta : (m,), the rows of the (l_u, l_psi) matrix and padding;
    gain : (m, m), (Phi'Phi + alpha I)^-1
    but for the last sample's change, which is pending, (2, m);
    rows, offsets : the window, (p n_y, m) and (p n_y,); psi : (l_psi,);
    past_psi, past_u : the last samples, as a ring; x : (n,);
    energy : (1,), trace of Phi'Phi; counters : (5,).
    """

    theta: Array
    gain: Array
    pending: Array
    rows: Array
    offsets: Array
    psi: Array
    past_psi: Array
    past_u: Array
    x: Array
    energy: Array
    counters: Integers


class Record(NamedTuple):
    """History of a block, time first.

    Its length is 0 where it was not requested.
    """

    z1: Array
    z2: Array
    theta1: Array
    theta2: Array
    x: Array


@compiled
def _product_loops(matrix: Array, vector: Array) -> Array:
    """Multiply a matrix by a vector without a call into BLAS.

    The call costs more than a small product.
    """
    count, m = matrix.shape
    out = np.empty(count)
    for i in range(count):
        total = 0.0
        for j in range(m):
            total += matrix[i, j] * vector[j]
        out[i] = total
    return out


def _affine_arrays(A: Array, x: Array, B: Array, w: Array, E: Array, u: Array) -> Array:
    """A x + B w + E u."""
    return A @ x + B @ w + E @ u


@compiled
def _affine_loops(A: Array, x: Array, B: Array, w: Array, E: Array, u: Array) -> Array:
    """Like `_affine_arrays`, with one array made instead of five."""
    out = np.empty(A.shape[0])
    for i in range(out.size):
        total = 0.0
        for j in range(x.size):
            total += A[i, j] * x[j]
        for j in range(w.size):
            total += B[i, j] * w[j]
        for j in range(u.size):
            total += E[i, j] * u[j]
        out[i] = total
    return out


def _gradient_arrays(rows: Array, offsets: Array, theta: Array) -> Array:
    """Return half the gradient of the retrospective cost at theta.

    It is Phi'(f + Phi theta).
    """
    # f + Phi theta is the retrospective performance over the window, (p n_y,)
    return (rows @ theta + offsets) @ rows


@compiled
def _gradient_loops(rows: Array, offsets: Array, theta: Array) -> Array:
    """Return the result of `_gradient_arrays` in one pass over the window.

    The pass takes four rows at a time.
    """
    count, m = rows.shape
    gradient = np.zeros(m)
    whole = count - count % 4
    # four rows per pass: theta and gradient are read once for four rows
    for i in range(0, whole, 4):
        row1, row2, row3, row4 = rows[i], rows[i + 1], rows[i + 2], rows[i + 3]
        # f + Phi theta for these rows
        f1, f2, f3, f4 = 0.0, 0.0, 0.0, 0.0
        for j in range(m):
            entry = theta[j]
            f1 += row1[j] * entry
            f2 += row2[j] * entry
            f3 += row3[j] * entry
            f4 += row4[j] * entry
        f1 += offsets[i]
        f2 += offsets[i + 1]
        f3 += offsets[i + 2]
        f4 += offsets[i + 3]
        # Phi' (f + Phi theta)
        for j in range(m):
            gradient[j] += f1 * row1[j] + f2 * row2[j] + f3 * row3[j] + f4 * row4[j]
    for i in range(whole, count):
        row1 = rows[i]
        f1 = offsets[i]
        for j in range(m):
            f1 += row1[j] * theta[j]
        for j in range(m):
            gradient[j] += f1 * row1[j]
    return gradient


def _slide_arrays(gain: Array, pending: Array, new: Array, old: Array, gradient: Array, step: Array) -> float:
    """Update the gain when one row enters the window and another leaves.

    `new` enters and `old` leaves, which is a rank-2 change.

    The change is left in `pending`, to be applied on the next pass over the
    gain: gain - pending[0] pending[0]' + pending[1] pending[1]'. `step`
    becomes the new gain times `gradient`. Returns the pivot of the downdate;
    near zero means that the leaving row held nearly all that was known of
    some direction.
    """
    # apply the change of the sample before
    # gain is symmetric, so its transpose is the Fortran array that dger updates in place
    dger(-1.0, pending[0], pending[0], a=gain.T, overwrite_a=1)
    dger(1.0, pending[1], pending[1], a=gain.T, overwrite_a=1)
    # products with the gain for the rows that enter and leave
    a, b = gain @ new, gain @ old
    step[:] = gain @ gradient
    # Sherman and Morrison's formula twice
    # update: Phi'Phi + new new'
    grow = 1.0 / (1.0 + a @ new)
    step -= (grow * (a @ gradient)) * a
    # downdate: Phi'Phi - old old'
    b -= (grow * (a @ old)) * a
    pivot = 1.0 - b @ old
    shrink = 1.0 / pivot if pivot > 0.0 else 0.0
    step += (shrink * (b @ gradient)) * b
    # leave the change in square-root form: gain - grow a a' + shrink b b'
    pending[0] = np.sqrt(grow) * a
    pending[1] = np.sqrt(shrink) * b
    return float(pivot)


@compiled
def _slide_loops(gain: Array, pending: Array, new: Array, old: Array, gradient: Array, step: Array) -> float:
    """Do the work of `_slide_arrays` in one fused pass over the gain.

    The pass takes two rows at a time.
    """
    m = new.size
    a = np.empty(m)
    b = np.empty(m)
    less, more = pending[0], pending[1]
    for i in range(0, m, 2):  # m is a multiple of PADDING
        row1, row2 = gain[i], gain[i + 1]
        less1, more1, less2, more2 = less[i], more[i], less[i + 1], more[i + 1]
        new1, old1, gradient1, new2, old2, gradient2 = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
        # the pending change and the three products in one pass over the gain
        for j in range(m):
            entry1 = row1[j] - less1 * less[j] + more1 * more[j]
            entry2 = row2[j] - less2 * less[j] + more2 * more[j]
            row1[j] = entry1
            row2[j] = entry2
            new1 += entry1 * new[j]
            old1 += entry1 * old[j]
            gradient1 += entry1 * gradient[j]
            new2 += entry2 * new[j]
            old2 += entry2 * old[j]
            gradient2 += entry2 * gradient[j]
        a[i], a[i + 1] = new1, new2
        b[i], b[i + 1] = old1, old2
        step[i], step[i + 1] = gradient1, gradient2
    # Sherman and Morrison's formula twice
    with_new, with_old, with_gradient = 0.0, 0.0, 0.0
    for j in range(m):
        with_new += a[j] * new[j]
        with_old += a[j] * old[j]
        with_gradient += a[j] * gradient[j]
    # update by the row that enters
    grow = 1.0 / (1.0 + with_new)
    root, shared, along = np.sqrt(grow), grow * with_old, grow * with_gradient
    with_old, with_gradient = 0.0, 0.0
    for j in range(m):
        less[j] = root * a[j]
        b[j] -= shared * a[j]
        with_old += b[j] * old[j]
        with_gradient += b[j] * gradient[j]
    # downdate by the row that leaves; a pivot near zero means loss of accuracy
    pivot = 1.0 - with_old
    shrink = 1.0 / pivot if pivot > 0.0 else 0.0
    root, back = np.sqrt(shrink), shrink * with_gradient
    for j in range(m):
        more[j] = root * b[j]
        step[j] += back * b[j] - along * a[j]
    return pivot


def _add_scaled_arrays(out: Array, at: int, factor: float, values: Array) -> None:
    """Add a multiple of a row to a part of another."""
    out[at : at + values.size] += factor * values


@compiled
def _add_scaled_loops(out: Array, at: int, factor: float, values: Array) -> None:
    """Like `_add_scaled_arrays`."""
    for i in range(values.size):
        out[at + i] += factor * values[i]


add_scaled = _add_scaled_loops if NUMBA else _add_scaled_arrays
affine = _affine_loops if NUMBA else _affine_arrays
product = _product_loops if NUMBA else np.matmul
half_gradient = _gradient_loops if NUMBA else _gradient_arrays
slide = _slide_loops if NUMBA else _slide_arrays


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
    # shift the past of x, w and u by one sample
    if order > 0:
        put(psi, n, psi[: first_w - n].copy())
        put(psi, first_w + n_w, psi[first_w : first_u - n_w].copy())
        put(psi, first_u + l_u, psi[first_u : psi.size - l_u].copy())
        put(psi, first_u, stage.past_u[recent])
    put(psi, 0, x)
    put(psi, first_w, w)
    # u(k) = theta psi(k)
    u = product(stage.theta[: l_u * psi.size].reshape(l_u, psi.size), psi)
    # circular buffers of psi and u for the Markov parameters
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
    # sum of H_i u(k - i), i = d ... d + mu - 1
    total = np.zeros(design.H.shape[1])
    for i in range(design.H.shape[0]):
        total += product(design.H[i], past_u[(recent - design.delay - i) % past_u.shape[0]])
    return total


@compiled
def filtered(design: Design, past_psi: Array, recent: int, width: int) -> Array:
    """Rows sum of H_i (x) psi(k-i), one per output, padded to `width`."""
    mu, n_y, l_u = design.H.shape
    q = past_psi.shape[1]
    # Phi(k): the regressor filtered by the Markov parameters, (n_y, m)
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
        # exponential average
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
        # the threshold of divergence follows the largest output
        peak[0] = max(peak[0], np.abs(y[k]).max())
        limit = DIVERGED * peak[0]
        # stage 1: simulate with the dynamic correction
        x = stage1.x.copy()
        u = remember(stage1, design1.order, x, w[k])
        simulated = affine(plant.C, x, plant.D, w[k], plant.Du, u)
        if not bounded(simulated, u, x, limit):
            return k, 1
        # performance z1 = simulated - measured output
        z1 = simulated - y[k]
        # subtract the effect of the past corrections: theta takes their place in the cost
        recent = stage1.counters[RECENT]
        offsets = z1 - reach(design1, stage1.past_u, recent)
        # y^ predicted from the states of stage 1 is y_Delta with u2 in the place of u1
        # over the span of the Markov parameters: free of theta2 but for that span.
        z2 = z1 - reach(design2, stage1.past_u, recent)
        if estimated:
            learn(stage1, design1, filtered(design1, stage1.past_psi, recent, stage1.theta.size), offsets)
            if not np.isfinite(stage1.theta.sum()):
                return k, 1
        # advance the state of stage 1
        put(stage1.x, 0, affine(plant.A, x, plant.B, w[k], plant.Bu, u))

        # stage 2: static correction, on the states that stage 1 estimates
        x2 = x if estimated else stage2.x.copy()
        u = remember(stage2, design2.order, x2, w[k])
        recent = stage2.counters[RECENT]
        if estimated:
            offsets = z2
            z2 = offsets + reach(design2, stage2.past_u, recent)
        # without estimated states stage 2 simulates its own
        else:
            z2 = affine(plant.C, x2, plant.D, w[k], plant.Du, u) - y[k]
            offsets = z2 - reach(design2, stage2.past_u, recent)
            put(stage2.x, 0, affine(plant.A, x2, plant.B, w[k], plant.Bu, u))
        if not bounded(z2 + y[k], u, x2, limit):
            return k, 2
        learn(stage2, design2, filtered(design2, stage2.past_psi, recent, stage2.theta.size), offsets)
        if not np.isfinite(stage2.theta.sum()):
            return k, 2
        # the latest static coefficients, to be averaged
        put(recent_theta[(stage2.counters[LEARNED] - 1) % recent_theta.shape[0]], 0, stage2.theta)
        # mean squares for the printed performance
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
    # energy of the window: trace of Phi'Phi
    energy = 0.0
    for i in range(count):
        energy += stage.rows[i] @ stage.rows[i]
    stage.energy[0] = energy
    # ill-conditioned: no recursion, solve directly at each sample
    stage.counters[AGE] = 0
    stage.counters[STALE] = 1 if energy > DIRECT_LIMIT * alpha else 0
    if stage.counters[STALE] == 1:
        return
    # start from (alpha I)^-1 and let the rows enter one by one
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
    # least squares with [Phi; sqrt(alpha) I], (p n_y + m, m)
    right = np.zeros(count + m)  # -residual; 0
    columns = np.zeros((m, count + m))  # of [rows; sqrt(alpha) I]
    for i in range(count):
        right[i] = -residual[i]
        put(columns[:, i], 0, rows[i])
    step = np.zeros(m)
    for j in range(m):
        columns[j, count + j] = np.sqrt(alpha)
    # QR by Householder's reflections
    for j in range(m):
        v = columns[j].copy()
        v[:j] = 0.0
        size = np.sqrt(v @ v)
        v[j] += size if v[j] > 0.0 else -size
        for i in range(j, m):
            _reflect(columns[i], v)
        _reflect(right, v)
    # back substitution
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
    # slide the window: the new rows take the place of the oldest
    slot = counters[SLOT] * n_y
    old = stage.rows[slot : slot + n_y].copy()
    put_rows(stage.rows[slot : slot + n_y], new)
    put(stage.offsets, slot, offsets)
    counters[SLOT] = (counters[SLOT] + 1) % window
    counters[AGE] += 1
    counters[LEARNED] += 1
    # Gauss-Newton step on the quadratic cost: exact if the gain is
    theta = stage.theta
    gradient = half_gradient(stage.rows, stage.offsets, theta)
    step = np.empty(m)
    pivot = 1.0
    # one rank-2 update of the gain per output
    for r in range(n_y):
        stage.energy[0] += new[r] @ new[r] - old[r] @ old[r]
        if counters[STALE] == 0:
            pivot = min(pivot, slide(stage.gain, stage.pending, new[r], old[r], gradient, step))
    # rebuild the gain after ten windows, or where the downdate lost its digits
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
