"""Loops of the monitor: forces of its candidates, and their scores.

Plain array functions that numba compiles where it is installed. Every loop keeps its
memory in arrays that it is handed, so that a stream may be cut anywhere.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from ...effects.compiled import COUNT, evaluate
from ...jit import compiled
from ...systems.linear import Array
from ..samples import Flags, Integers

#: Signals of the candidates that are no law to evaluate; d and v are what the rows sense.
CODES = {
    "displacement": 101,
    "velocity": 102,
    "acceleration": 102,  # where the rows for v sense it
    "value": 102,  # of a signal that the rows for v sense
    "constant": 103,  # 1
    "deadzone": 104,  # what a dead zone of half width p1 takes away
    "saturation": 105,  # what a limit p1 cuts off
    "change": 108,  # what a law makes of d beyond d itself
    "rate": 107,  # minus the rate of v
}


class Columns(NamedTuple):
    """Laws of the columns of a bank.

    rows : (2, k, n + nw), what each column senses: d, v; codes : (k,), below 100 for the force of a law;
    laws : (k,), the law, as `evaluate` takes it; values : (k, 4), coefficients at which the law is
    differentiated; widths : (k,); pick : (k,), which coefficient.
    """

    rows: Array
    codes: Integers
    laws: Integers
    values: Array
    widths: Array
    pick: Integers


@compiled
def forces(X: Array, columns: Columns, n: int, rate: float, inner: Array, F: Array) -> None:
    """Force of each column per unit of its coefficient, along the motion.

    Parameters
    ----------
    X : ndarray, shape (N, n + nw)
        States before the correction, and inputs.
    columns : Columns
        Laws.
    n : int
        Number of states.
    rate : float
        Samples per second.
    inner : ndarray, shape (3, k)
        State of the law, d and v of the sample before; NaN before the first.
    F : ndarray, shape (N, k)
        Forces, on return.
    """
    rows, codes, laws, values, widths, pick = columns
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


LEARNED = 200.0  # samples that the noise level of the learning phase is worth
BORROWED = 10.0  # independent values that the scatter in the next shorter window is worth
ALONE = 2  # mark of such a sample
GATE = 8.0  # standard deviations from which an innovation stands out
FEW = 3.0  # samples that may do so before it is taken for a change
EVEN = 0.2  # least variance of the noise, of what it is on average around: no sample decides alone
CLIP = 3.0  # standard deviations at which one innovation stops counting for more
FALLEN = 0.8  # of the learned variance: below it the machine is still, which says nothing of when it runs
SLOWEST = 1.0 / 50_000  # least weight of a sample in the noise level


class Fixed(NamedTuple):
    """Settings of the scores, fixed by the learning phase.

    Phi, drive, C, through : (n, n), (2, n, k), (ny, n), (ny, k), how forces pass: `drive` of one that falls
    from one to zero over the sample, and of one that rises; gain : (n, ny), of the observer;
    filters : (ny, q), whitening polynomials without the leading one; noise : (ny, 3), variance of the
    innovations: constant, times prediction squared, times its mean; least : (ny,), the smallest one;
    pace : weight of a sample in that mean; mix : (ny, ny), lower triangular, makes the innovations
    independent, of unit variance; wide : (ny,), their standard deviation before; keep : (M,), share that
    each window keeps per sample; level : (M,), square of its threshold; fading : weight of a sample in the
    slow means that are taken off; numbers, root : (p,), (p, p), columns of what is known of the model but
    for a doubt, and root of the covariance of that; block : samples per block sum; thinning : weight of a
    sample in `crowd`.
    """

    Phi: Array
    drive: Array
    C: Array
    through: Array
    gain: Array
    filters: Array
    noise: Array
    least: Array
    pace: float
    mix: Array
    wide: Array
    keep: Array
    level: Array
    fading: float
    numbers: Integers
    root: Array
    block: int
    thinning: float


class State(NamedTuple):
    """Memory of the scores.

    Xc : (n, k), states of the columns, complete but for the force of the next sample; past_e, past_s :
    (q, ny), (q, ny, k); known : (ny,), innovations in a row that are known; N, V : (M, k), scores of the
    windows, and their variance; power : (ny,), mean square of the predictions; cross : (k, p), products of
    the columns with the doubtful ones, since the last block; shared : (M, k, p), the same, of each window;
    doubt : (M, k), variance of the scores from that; mean_e, mean_s : (ny,), (ny, k), slow means of the
    innovations and of what the columns add to the outputs; spread : (M, k + 1), mean square of the
    statistics, the last entry counts; factor : (M, k), by how much they scatter more than by theory;
    crowd : (ny,), samples that stood out of late, fading; size : (ny,), variance of the whitened
    innovations, followed slowly; sums : (2, blocks, k), scores and informations of the blocks, a ring;
    counters : (2,), samples taken, samples counted.
    """

    Xc: Array
    past_e: Array
    past_s: Array
    known: Array
    N: Array
    V: Array
    power: Array
    cross: Array
    shared: Array
    doubt: Array
    mean_e: Array
    mean_s: Array
    spread: Array
    factor: Array
    crowd: Array
    size: Array
    sums: Array
    counters: Integers


@compiled
def _windows(state: State, keep: Array, level: Array, gain: Array, info: Array) -> float:
    """Let each window forget and learn.

    Return the largest squared statistic over its threshold.
    """
    top = 0.0
    for m in range(keep.size):
        state.N[m] = keep[m] * state.N[m] + gain
        state.V[m] = keep[m] * keep[m] * state.V[m] + info
        wide = (state.V[m] + state.doubt[m]) * state.factor[m]
        square = state.N[m] * state.N[m] / np.where(wide <= 1e-200, np.inf, wide)
        if square.size and top == top and not square.max() <= top * level[m]:  # NaN stays
            top = square.max() / level[m]
    return top


@compiled
def _share_doubt(state: State, fading: Array) -> None:
    """Bring the products of the last block into each window."""
    for m in range(fading.size):
        state.shared[m] = fading[m] * state.shared[m] + state.cross
        state.doubt[m] = (state.shared[m] * state.shared[m]).sum(axis=1)
    state.cross[:, :] = 0.0


@compiled
def _calibrate(state: State, keep: Array) -> None:
    """Estimate how much wider the statistics scatter than in theory.

    The estimate uses samples at which nothing is wrong.

    Long windows have few independent values yet; they borrow from the next shorter one.
    """
    M, k = state.factor.shape
    state.spread[M - 1, k] += 1.0
    weight = 1.0 / state.spread[M - 1, k]
    for j in range(k):
        wider = 1.0
        for m in range(M):
            if state.V[m, j] > 1e-200:
                variance = state.V[m, j] + state.doubt[m, j]
                square = min(state.N[m, j] * state.N[m, j] / variance, CLIP * CLIP)
                state.spread[m, j] += weight * (square - state.spread[m, j])
            independent = 0.5 * state.counters[1] * (1.0 - keep[m])
            wider = (independent * state.spread[m, j] + BORROWED * wider) / (independent + BORROWED)
            state.factor[m, j] = max(1.0, wider)


@compiled
def scores(
    samples: tuple[Array, Array, Flags, Flags, Array],
    fixed: Fixed,
    state: State,
    stop: bool,
    scale: Array,
    ratio: Array,
) -> int:
    """Whiten the forces behind the observer and update the windows.

    The first columns are those of the candidates; others are parameters of the model. Ends early at a
    sample that is left out, for the observer must not follow it either.

    Parameters
    ----------
    samples : tuple of ndarray
        Innovations (N, ny), anything where missing; outputs as predicted (N, ny); flags (N, ny), 1:
        measured, 0: missing, on return `ALONE`: left out, for it stands out alone; whether the sample
        counts, for the observer has settled (N,); forces (N, k).
    fixed, state : Fixed, State
        Settings, and memory that is changed in place.
    stop : bool
        Whether nothing is wrong: follow noise level and scatter, return at the first sample above a
        threshold.
    scale : ndarray, shape (N, ny)
        Standard deviation of the noise at each sample, on return.
    ratio : ndarray, shape (N,)
        Largest squared statistic over its threshold, on return.

    Returns
    -------
    int
        Number of samples done.
    """
    E, P, use, calm, F = samples
    filters, noise, mix, numbers, block = fixed.filters, fixed.noise, fixed.mix, fixed.numbers, fixed.block
    known, size, counters, crowd = state.known, state.size, state.counters, state.crowd
    ny, q = filters.shape
    watched, p, blocks = state.N.shape[1], numbers.size, state.sums.shape[1]
    e, r = np.zeros(ny), np.zeros(ny)
    ready = np.zeros(ny, dtype=np.bool_)
    fading_of = fixed.keep**block
    gain, info = np.zeros(watched), np.zeros(watched)
    for step in range(len(F)):
        if counters[0] > 0:
            state.Xc[:, :] += fixed.drive[1] * F[step]
        # what each candidate would add to the outputs
        y = fixed.through * F[step] + fixed.C @ state.Xc
        level_s = y - state.mean_s
        white = level_s.copy()
        alone = False
        # whiten: filter of each output with its own past
        for i in range(ny):
            # noise may be larger where the signal is
            square = P[step, i] * P[step, i]
            state.power[i] += fixed.pace * (square - state.power[i])
            here = noise[i, 0] + noise[i, 1] * square + noise[i, 2] * state.power[i]
            around = noise[i, 0] + (noise[i, 1] + noise[i, 2]) * state.power[i]
            scale[step, i] = math.sqrt(max(here, EVEN * around, fixed.least[i]))
            slow = fixed.fading * around / (scale[step, i] * scale[step, i])
            there = use[step, i] != 0
            e[i] = E[step, i] - state.mean_e[i] if there else 0.0
            if calm[step]:
                state.mean_s[i] += slow * level_s[i]
            w = e[i]
            for a in range(q):
                w += filters[i, a] * state.past_e[a, i]
                if filters[i, a] != 0.0:
                    white[i] += filters[i, a] * state.past_s[a, i]
            crowd[i] -= fixed.thinning * crowd[i]
            gate = GATE * scale[step, i] * fixed.wide[i] * math.sqrt(size[i])
            if there and known[i] >= q and calm[step] and abs(w) > gate:
                crowd[i] = min(crowd[i] + 1.0, 2.0 * FEW)
                if crowd[i] <= FEW:  # as the past of the filter would have it
                    e[i] -= w
                    w = 0.0
                    use[step, i] = ALONE
                    alone = True
            measured = there and use[step, i] != ALONE
            if measured and calm[step]:  # slow drift of a sensor is none of the candidates
                state.mean_e[i] += slow * e[i]
            r[i] = w / scale[step, i]
            white[i] /= scale[step, i]
            ready[i] = measured and known[i] >= q and calm[step] != 0
            known[i] = known[i] + 1 if there else 0
        s, r = mix @ white, mix @ r
        for i in range(ny - 1, -1, -1):  # each row needs those before it
            for a in range(i):
                ready[i] = ready[i] and (ready[a] or mix[i, a] == 0.0)
        # the score of this sample
        gain[:] = 0.0
        info[:] = 0.0
        for i in range(ny):
            if ready[i]:
                w = min(max(r[i] / math.sqrt(size[i]), -CLIP), CLIP)
                seen = s[i, :watched]
                gain += w / math.sqrt(size[i]) * seen
                info += seen * seen / size[i]
                if p:
                    state.cross[:, :] += np.outer(seen / size[i], s[i][numbers] @ fixed.root)
        counted, top = ready.any(), 0.0
        if counted:
            top = _windows(state, fixed.keep, fixed.level, gain, info)
            counters[1] += 1
        at = (counters[0] // block) % blocks
        if counters[0] % block == 0:
            state.sums[:, at] = 0.0
        state.sums[0, at] += gain
        state.sums[1, at] += info
        if p and (counters[0] + 1) % block == 0:
            _share_doubt(state, fading_of)
        if counted and stop:
            weight = max(SLOWEST, 1.0 / (LEARNED + counters[1]))
            runs = False
            for i in range(ny):
                if ready[i]:
                    w = min(r[i] * r[i], CLIP * CLIP * size[i])
                    size[i] = max(size[i] + weight * (1.005 * w - size[i]), FALLEN)
                    runs = runs or size[i] > FALLEN
            if runs and counters[0] % block == 0:
                _calibrate(state, fixed.keep)
        ratio[step] = top
        # the past of the filters
        for a in range(q - 1, 0, -1):
            state.past_e[a] = state.past_e[a - 1]
            state.past_s[a] = state.past_s[a - 1]
        if q > 0:
            state.past_e[0] = e
            state.past_s[0] = level_s
        # correct and step on
        for i in range(ny):
            if use[step, i] != 1:
                y[i] = 0.0
        state.Xc[:, :] -= fixed.gain @ y
        state.Xc[:, :] = fixed.Phi @ state.Xc + fixed.drive[0] * F[step]
        counters[0] += 1
        if alone or (stop and top > 1.0):
            return step + 1
    return len(F)
