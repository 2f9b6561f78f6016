"""The loop of the monitor: the scores of its candidates.

Plain array functions that numba compiles where it is installed. Every loop keeps its
memory in arrays that it is handed, so that a stream may be cut anywhere.
"""

from __future__ import annotations

import math

import numpy as np

from ...jit import NUMBA, compiled, put, put_rows

__all__ = ["ALONE", "CLIP", "EVEN", "FEW", "scores"]

LEARNED = 200.0  # samples that the noise level of the learning phase is worth
BORROWED = 10.0  # independent values that the scatter in the next shorter window is worth
ALONE = 2  # mark of such a sample
GATE = 8.0  # standard deviations from which an innovation stands out
FEW = 3.0  # samples that may do so before it is taken for a change
EVEN = 0.2  # least variance of the noise, of what it is on average around: no sample decides alone
CLIP = 3.0  # standard deviations at which one innovation stops counting for more
FALLEN = 0.8  # of the learned variance: below it the machine is still, which says nothing of when it runs


if NUMBA:  # scalar loops are the fast form in compiled code, and the slow one in Python

    @compiled
    def _add(out, c, x):  # type: ignore[no-untyped-def]
        for j in range(out.shape[0]):
            out[j] += c * x[j]

    @compiled
    def _windows(N_, V_, doubt, keep, level, factor, gain, info):  # type: ignore[no-untyped-def]
        top = 0.0
        for m in range(keep.shape[0]):
            g = keep[m]
            g2 = g * g
            best = 0.0
            for j in range(N_.shape[1]):
                a = g * N_[m, j] + gain[j]
                v = g2 * V_[m, j] + info[j]
                N_[m, j] = a
                V_[m, j] = v
                w = (v + doubt[m, j]) * factor[m, j]
                if a * a > best * w and w > 1e-200:
                    best = a * a / w
            top = max(top, best / level[m])
        return top

    @compiled
    def _multiply(cross, seen, size, unsure):  # type: ignore[no-untyped-def]
        for j in range(seen.size):
            _add(cross[j], seen[j] / size, unsure)

    @compiled
    def _share_doubt(cross, shared, fading, doubt):  # type: ignore[no-untyped-def]
        for m in range(fading.size):
            for j in range(cross.shape[0]):
                total = 0.0
                for a in range(cross.shape[1]):
                    c = fading[m] * shared[m, j, a] + cross[j, a]
                    shared[m, j, a] = c
                    total += c * c
                doubt[m, j] = total
        cross[:, :] = 0.0

else:

    def _add(out, c, x):  # type: ignore[no-untyped-def]
        out += c * x

    def _windows(N_, V_, doubt, keep, level, factor, gain, info):  # type: ignore[no-untyped-def]
        N_ *= keep[:, None]
        N_ += gain
        V_ *= (keep * keep)[:, None]
        V_ += info
        wide = (V_ + doubt) * factor
        return float((N_ * N_ / np.where(wide > 1e-200, wide, np.inf) / level[:, None]).max())

    def _multiply(cross, seen, size, unsure):  # type: ignore[no-untyped-def]
        cross += np.outer(seen / size, unsure)

    def _share_doubt(cross, shared, fading, doubt):  # type: ignore[no-untyped-def]
        shared *= fading[:, None, None]
        shared += cross
        doubt[:] = (shared * shared).sum(axis=2)
        cross[:] = 0.0


@compiled
def _calibrate(N_, V_, doubt, keep, counted, spread, factor):  # type: ignore[no-untyped-def]
    """Estimate how much wider the statistics scatter than in theory.

    The estimate uses samples at which nothing is wrong.

    Long windows have few independent values yet; they borrow from the next shorter one.
    """
    M, k = factor.shape
    spread[M - 1, k] += 1.0
    weight = 1.0 / spread[M - 1, k]
    for j in range(k):
        wider = 1.0
        for m in range(M):
            if V_[m, j] > 1e-200:
                square = min(N_[m, j] * N_[m, j] / (V_[m, j] + doubt[m, j]), CLIP * CLIP)
                spread[m, j] += weight * (square - spread[m, j])
            independent = 0.5 * counted * (1.0 - keep[m])
            wider = (independent * spread[m, j] + BORROWED * wider) / (independent + BORROWED)
            factor[m, j] = max(1.0, wider)


@compiled
def scores(  # type: ignore[no-untyped-def]
    E,  # (N, ny)         innovations; anything where missing
    P,  # (N, ny)         outputs as predicted
    use,  # (N, ny) uint8 1: measured, 0: missing; on return `ALONE`: left out, for it stands out alone
    calm,  # (N,) uint8   whether the sample counts (the observer has settled)
    F,  # (N, k)
    Phi,  # (n, n)
    drive,  # (2, n, k)   of a force that falls from one to zero over the sample, and that rises
    C,  # (ny, n)
    D,  # (ny, k)
    K,  # (n, ny)
    filters,  # (ny, q)   whitening polynomials without the leading one
    noise,  # (ny, 3)     variance of the innovations: constant, times prediction squared, times its mean
    least,  # (ny,)       the smallest one
    pace,  # float        weight of a sample in that mean
    mix,  # (ny, ny)      lower triangular: makes the innovations independent, of unit variance
    keep,  # (M,)         share that each window keeps per sample
    level,  # (M,)        square of the threshold of each window
    adapt,  # bool        whether noise level and scatter are followed
    slowest,  # float     least weight of a sample in the noise level
    fading,  # float      weight of a sample in the slow means that are taken off
    stop,  # bool         return at the first sample above a threshold
    numbers,  # (p,)      columns of what is known of the model but for a doubt
    root,  # (p, p)       root of the covariance of that
    block,  # int         samples per block sum
    Xc,  # (n, k)         states of the columns, complete but for the force of the next sample
    past_e,  # (q, ny)
    past_s,  # (q, ny, k)
    known,  # (ny,)       innovations in a row that are known
    N_,  # (M, k)
    V_,  # (M, k)
    power,  # (ny,)       mean square of the predictions
    cross,  # (k, p)      products of the columns with the doubtful ones, since the last block
    shared,  # (M, k, p)  the same, of each window
    doubt,  # (M, k)      variance of the scores from that
    mean_e,  # (ny,)      slow means of the innovations and of what the columns add to the outputs
    mean_s,  # (ny, k)
    spread,  # (M, k + 1) mean square of the statistics; the last entry counts
    factor,  # (M, k)     by how much the statistics scatter more than by theory
    spread_r,  # (ny,)    standard deviation of the innovations, whitened but not yet made independent
    thinning,  # weight of a sample in `crowd`
    crowd,  # (ny,)       samples that stood out of late, fading
    size,  # (ny,)        variance of the whitened innovations, followed slowly
    sums,  # (2, blocks, k) scores and informations of the blocks, a ring
    counters,  # (2,) int64: samples taken, samples counted
    scale,  # (N, ny)     standard deviation of the noise at each sample, on return
    ratio,  # (N,)        largest squared statistic over its threshold, on return
):
    """Whiten the forces behind the observer and update the windows.

    Return the number of samples done.

    The first columns are those of the candidates; others are parameters of the model. Ends early at a
    sample that is left out, for the observer must not follow it either.
    """
    total, k = F.shape
    n = Phi.shape[0]
    ny = E.shape[1]
    q = filters.shape[1]
    blocks = sums.shape[1]
    y = np.zeros((ny, k))
    white = np.zeros((ny, k))
    level_s = np.zeros((ny, k))
    s = np.zeros((ny, k))
    e = np.zeros(ny)
    r = np.zeros(ny)
    fresh = np.zeros((n, k))
    ready = np.zeros(ny, dtype=np.uint8)
    watched = N_.shape[1]
    p = numbers.size
    unsure = np.zeros(p)
    fading_of = keep**block
    gain = np.zeros(watched)
    info = np.zeros(watched)
    for step in range(total):
        if counters[0] > 0:
            for a in range(n):
                Xc[a] += drive[1, a] * F[step]
        # what each candidate would add to the outputs
        for i in range(ny):
            y[i] = D[i] * F[step]
            for a in range(n):
                if C[i, a] != 0.0:
                    _add(y[i], C[i, a], Xc[a])
        alone = False
        # whiten: filter of each output with its own past
        for i in range(ny):
            # noise may be larger where the signal is
            square = P[step, i] * P[step, i]
            power[i] += pace * (square - power[i])
            here = noise[i, 0] + noise[i, 1] * square + noise[i, 2] * power[i]
            around = noise[i, 0] + (noise[i, 1] + noise[i, 2]) * power[i]
            scale[step, i] = math.sqrt(max(here, EVEN * around, least[i]))
            slow = fading * around / (scale[step, i] * scale[step, i])
            there = use[step, i] != 0
            e[i] = E[step, i] - mean_e[i] if there else 0.0
            level_s[i] = y[i] - mean_s[i]
            if calm[step]:
                mean_s[i] += slow * level_s[i]
            white[i] = level_s[i]
            w = e[i]
            for a in range(q):
                f = filters[i, a]
                if f != 0.0:
                    w += f * past_e[a, i]
                    _add(white[i], f, past_s[a, i])
            crowd[i] -= thinning * crowd[i]
            gate = GATE * scale[step, i] * spread_r[i] * math.sqrt(size[i])
            if there and known[i] >= q and calm[step] and abs(w) > gate:
                crowd[i] = min(crowd[i] + 1.0, 2.0 * FEW)
                if crowd[i] <= FEW:  # as the past of the filter would have it
                    e[i] -= w
                    w = 0.0
                    use[step, i] = ALONE
                    alone = True
            if (
                there and use[step, i] != ALONE and calm[step]
            ):  # slow drift of a sensor is none of the candidates
                mean_e[i] += slow * e[i]
            r[i] = w / scale[step, i]
            white[i] /= scale[step, i]
            ready[i] = 1 if there and use[step, i] != ALONE and known[i] >= q and calm[step] else 0
            known[i] = known[i] + 1 if there else 0
        for i in range(ny - 1, -1, -1):  # in place: each row needs those before it
            whole = ready[i]
            w = mix[i, i] * r[i]
            s[i] = mix[i, i] * white[i]
            for a in range(i):
                c = mix[i, a]
                if c != 0.0:
                    w += c * r[a]
                    _add(s[i], c, white[a])
                    if ready[a] == 0:
                        whole = 0
            r[i] = w
            ready[i] = whole
        # the score of this sample
        gain[:] = 0.0
        info[:] = 0.0
        counted = False
        for i in range(ny):
            if ready[i] == 0:
                continue
            counted = True
            w = r[i] / math.sqrt(size[i])
            w = min(max(w, -CLIP), CLIP)
            seen = s[i, :watched]
            _add(gain, w / math.sqrt(size[i]), seen)
            info += seen * seen / size[i]
            if p:
                unsure[:] = 0.0
                for a in range(p):
                    _add(unsure, s[i, numbers[a]], root[a])
                _multiply(cross, seen, size[i], unsure)
        top = 0.0
        if counted:
            top = _windows(N_, V_, doubt, keep, level, factor, gain, info)
            counters[1] += 1
        if counters[0] % block == 0:
            at = (counters[0] // block) % blocks
            sums[:, at] = 0.0
        at = (counters[0] // block) % blocks
        sums[0, at] += gain
        sums[1, at] += info
        if p and (counters[0] + 1) % block == 0:
            _share_doubt(cross, shared, fading_of, doubt)
        if counted and adapt:
            weight = max(slowest, 1.0 / (LEARNED + counters[1]))
            runs = False
            for i in range(ny):
                if ready[i]:
                    w = min(r[i] * r[i], CLIP * CLIP * size[i])
                    size[i] = max(size[i] + weight * (1.005 * w - size[i]), FALLEN)
                    runs = runs or size[i] > FALLEN
            if runs and counters[0] % block == 0:
                _calibrate(N_, V_, doubt, keep, counters[1], spread, factor)
        ratio[step] = top
        # the past of the filters
        for a in range(q - 1, 0, -1):
            past_e[a] = past_e[a - 1]
            past_s[a] = past_s[a - 1]
        if q > 0:
            put(past_e[0], 0, e)
            put_rows(past_s[0], level_s)
        # correct and step on
        for i in range(ny):
            if use[step, i] == 1:
                for a in range(n):
                    if K[a, i] != 0.0:
                        _add(Xc[a], -K[a, i], y[i])
        for a in range(n):
            fresh[a] = drive[0, a] * F[step]
            for b in range(n):
                if Phi[a, b] != 0.0:
                    _add(fresh[a], Phi[a, b], Xc[b])
        put_rows(Xc, fresh)
        counters[0] += 1
        if alone or (stop and top > 1.0):
            return step + 1
    return total
