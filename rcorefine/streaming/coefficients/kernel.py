"""One sample of the physical static stage, and the loop over a block: predict, compare, correct.

The stage is a Kalman filter for state and coefficients jointly, kept in two parts
(Friedland, IEEE Trans. Automatic Control 14 (1969) 359): the state as if the coefficients
were known, and the sensitivity of the filtered state to them. What a sample teaches about
the coefficients moves the state as if the model had always had them, to first order; that is the
retrospective filter about the current refined model.
"""

from __future__ import annotations

import numpy as np

from ...effects.compiled import COUNT, evaluate
from ...engine.kernels import march
from ...jit import compiled

__all__ = ["DIVERGED", "DONE", "MOVED", "SURPRISED", "advance", "advance_general"]

DONE, MOVED, DIVERGED, SURPRISED = 0, 1, 2, 3

_SHORT = 1.0 / 32.0  # weight of a sample in the quick level of the innovations
_LONG = 1.0 / 1000.0  # least weight of a sample in the slow one
_MOST = 36.0  # of its variance that the square of an innovation counts for as a surprise
_EXCITED = 25.0  # of the noise: what the prior doubt moves at an output that counts as excited
_QUIET = 0.02  # of the most that it ever moved: less is no excitation
_SETTLED = 1e-6  # share of the noise below which the initial state no longer matters


@compiled
def _noise(level, floor, i):
    """Variance an output is weighted by: declared, or what the innovations show, whichever is larger."""
    quick = 0.5 * level[0, i]
    slow = level[1, i]
    return max(floor[i], max(slow, quick))


@compiled
def _learn(
    i,  # output
    e,  # its innovation
    R,
    theta, delta, S, Pt, x, Pb, K, FK, F, H, h, g, yhat,
    lower, upper, forgetting, frozen, uncertain, loose,
):  # fmt: skip
    """Correct with one output; return its variance for known coefficients over the noise, and in all."""
    n = x.shape[0]
    p = theta.shape[0]
    ny = yhat.shape[0]
    s = R
    if uncertain:
        for a in range(n):
            total = 0.0
            for b in range(n):
                total += Pb[a, b] * H[i, b]
            K[a] = total
            s += H[i, a] * total
        for a in range(n):
            K[a] /= s
        for a in range(n):
            total = 0.0
            for b in range(n):
                total += F[a, b] * K[b]
            FK[a] = total
    spread = 0.0
    for a in range(p):
        total = 0.0
        for b in range(p):
            total += Pt[a, b] * h[i, b]
        g[a] = total
        spread += h[i, a] * total
    st = s + spread
    if frozen:
        inner = e
        gap = e
        for a in range(p):
            gap -= h[i, a] * delta[a]
        for a in range(p):
            delta[a] += g[a] * gap / st
    else:
        inner = e
        for a in range(p):
            move = g[a] * e / st
            aim = theta[a] + move
            if aim < lower[a]:
                aim = lower[a]
            elif aim > upper[a]:
                aim = upper[a]
            move = aim - theta[a]
            theta[a] = aim
            inner -= h[i, a] * move
            for b in range(n):
                x[b] += S[a, b] * move
            for j in range(i + 1, ny):
                yhat[j] += h[j, a] * move
    if uncertain:
        for b in range(n):
            x[b] += FK[b] * inner
        for j in range(i + 1, ny):
            c = 0.0
            for b in range(n):
                c += H[j, b] * K[b]
            yhat[j] += c * inner
            for a in range(p):
                h[j, a] -= c * h[i, a]
        for a in range(p):
            for b in range(n):
                S[a, b] -= FK[b] * h[i, a]
        for a in range(n):
            for b in range(n):
                Pb[a, b] -= s * K[a] * K[b]
    down = 1.0 / st
    if forgetting < 1.0 and not frozen and spread > 0.0:
        # forgetting along what this sample saw only (Kulhavy): without excitation none
        ratio = spread / s
        kept = forgetting - (1.0 - forgetting) / ratio
        down = kept / (s * (1.0 + kept * ratio))
        # that may have changed just now: the state no longer answers for it since the start
        extra = 1.0 / st - down
        share = extra / (1.0 + extra * spread * st / s)
        for b in range(n):
            total = 0.0
            for a in range(p):
                total += g[a] * S[a, b]
            K[b] = total
        for a in range(p):
            for b in range(n):
                S[a, b] -= share * h[i, a] * st / s * K[b]
        for a in range(n):
            for b in range(n):
                loose[a, b] += share * K[a] * K[b]
    for a in range(p):
        before = Pt[a, a]
        for b in range(p):
            Pt[a, b] -= down * g[a] * g[b]
        # rounding must not make it negative where one sample teaches almost everything
        if Pt[a, a] < 1e-13 * before:
            Pt[a, a] = 1e-13 * before
    return s / R, st


@compiled
def _correct(
    y, use, theta, delta, S, Pt, x, Pb, Q, K, FK, T, F, H, h, g, yhat, level, floor, count, limits,
    least, forgetting, frozen, counters, cost, power, surprise, loose, predicted,
):  # fmt: skip
    """Correct with all outputs of a sample that are there."""
    n = x.shape[0]
    ny = yhat.shape[0]
    uncertain = counters[1] > 0
    settled = True
    seen = False
    loose[:, :] = 0.0
    predicted[:] = yhat
    for i in range(ny):
        if not use[i]:
            continue
        e = y[i] - yhat[i]
        calm = max(floor[i], level[1, i])
        if frozen:
            R = floor[i]
        else:
            count[i] += 1.0
            level[0, i] += _SHORT * (e * e - level[0, i])
            level[1, i] += max(_LONG, 1.0 - forgetting, 1.0 / count[i]) * (e * e - level[1, i])
            R = _noise(level, floor, i)
        forgets = forgetting
        if forgetting < 1.0:
            doubt = 0.0
            for a in range(theta.shape[0]):
                doubt += (h[i, a] * 1e6 * least[a]) ** 2
            power[0, i] += _SHORT * (doubt - power[0, i])
            power[1, i] = max(power[1, i], power[0, i])
            if doubt < _EXCITED * R or power[0, i] < _QUIET * power[1, i]:
                forgets = 1.0
        excess, variance = _learn(
            i, e, R, theta, delta, S, Pt, x, Pb, K, FK, F, H, h, g, yhat, limits[0], limits[1],
            forgets, frozen, uncertain, loose,
        )  # fmt: skip
        # a lone outlier does not count for much; a run of errors where the filter was sure does
        ratio = e * e / (variance - R + calm)
        surprise[0] += _SHORT * (min(ratio, _MOST) - surprise[0])
        cost[0, i] += e * e / excess
        cost[1, i] += 1.0
        seen = True
        if excess - 1.0 > _SETTLED:
            settled = False
    if uncertain:
        for a in range(n):
            for b in range(n):
                total = 0.0
                for c in range(n):
                    total += F[a, c] * Pb[c, b]
                T[a, b] = total
        for a in range(n):
            for b in range(a + 1):
                total = Q[a, b]
                if forgetting < 1.0:
                    total += loose[a, b]
                for c in range(n):
                    total += T[a, c] * F[b, c]
                Pb[a, b] = total
                Pb[b, a] = total
        # several samples in a row without a trace of it: the initial state is forgotten
        if counters[2] > 0 or not settled:
            counters[1] = 10 * n + 10
        elif seen:
            counters[1] -= 1


@compiled
def _moved(theta, centre, Pt, share, least):
    for a in range(theta.shape[0]):
        shift = abs(theta[a] - centre[a])
        if shift > least[a] and shift > share * np.sqrt(max(Pt[a, a], 0.0)):
            return True
    return False


@compiled
def advance(sizes, fixed, memory, counters, W, known, Y, use, frozen, TH, E, X):
    """Advance over a block with effects that are absorbed into the matrices.

    Parameters
    ----------
    sizes : ndarray of int64, shape (6,)
        n, p, nw + 1, ny, q (parameters in the matrices) and lag (unused here).
    fixed, memory : ndarray
        Packed as in `memory`.
    counters : ndarray of int64, shape (3,)
        Samples taken; samples for which the initial state still matters; unknown disturbances.
    W : ndarray, shape (N, nw + 1)
        Inputs, the last one constant.
    known : ndarray of uint8, shape (N,)
        Whether the inputs of the sample were measured.
    Y, use : ndarray, shape (N, ny)
        Outputs, and which of them to learn from.
    frozen : bool
        Keep the coefficients, and collect in `delta` what the block says about them.
    TH, E, X : ndarray, shape (N, p), (N, ny), (N, n), or no rows
        Coefficients, innovations and states of every sample.

    Returns
    -------
    tuple of int
        Samples done, and DONE, MOVED (discretize anew), SURPRISED (innovations far beyond what the
        filter was sure of) or DIVERGED.
    """
    n, p, nu, ny, q = sizes[0], sizes[1], sizes[2], sizes[3], sizes[4]
    nz = n + 2 * nu
    no = n + nu
    at = 0
    centre = fixed[at : at + p]
    at += p
    limits = fixed[at : at + 2 * p].reshape(2, p)
    at += 2 * p
    least = fixed[at : at + p]
    at += p
    floor = fixed[at : at + ny]
    at += ny
    share, forgetting, limit, watch = fixed[at], fixed[at + 1], fixed[at + 2], fixed[at + 3]
    at += 4
    Q = fixed[at : at + n * n].reshape(n, n)
    at += n * n
    Qw = fixed[at : at + n * n].reshape(n, n)
    at += n * n
    M = fixed[at : at + n * nz].reshape(n, nz)
    at += n * nz
    O = fixed[at : at + ny * no].reshape(ny, no)
    at += ny * no
    dM = fixed[at : at + q * n * nz].reshape(q, n, nz)
    at += q * n * nz
    dO = fixed[at : at + q * ny * no].reshape(q, ny, no)
    at += q * ny * no
    column = fixed[at : at + q]

    at = 0
    theta = memory[at : at + p]
    at += p
    delta = memory[at : at + p]
    at += p
    x = memory[at : at + n]
    at += n
    S = memory[at : at + p * n].reshape(p, n)
    at += p * n
    Pb = memory[at : at + n * n].reshape(n, n)
    at += n * n
    Pt = memory[at : at + p * p].reshape(p, p)
    at += p * p
    level = memory[at : at + 2 * ny].reshape(2, ny)
    at += 2 * ny
    count = memory[at : at + ny]
    at += ny
    cost = memory[at : at + 2 * ny].reshape(2, ny)
    at += 2 * ny
    power = memory[at : at + 2 * ny].reshape(2, ny)
    at += 2 * ny
    surprise = memory[at : at + 1]
    at += 1
    w = memory[at : at + nu]

    columns = np.zeros(q, dtype=np.int64)
    moved = np.zeros((q, 2), dtype=np.int64)  # first row that a coefficient moves, and the last one + 1
    varied = False  # whether the outputs' own matrices depend on a coefficient
    for r in range(q):
        columns[r] = int(column[r])
        for i in range(n):
            for j in range(nz):
                if dM[r, i, j] != 0.0:
                    if moved[r, 1] == 0:
                        moved[r, 0] = i
                    moved[r, 1] = i + 1
        for i in range(ny):
            for j in range(no):
                if dO[r, i, j] != 0.0:
                    varied = True
    Phi = np.zeros((n, n))
    Oc = O.copy()
    step = np.zeros(nz)
    out = np.zeros(no)
    drive = np.zeros((q, n))
    Sn = np.zeros(n)
    loose = np.zeros((n, n))
    H = np.zeros((ny, n))
    h = np.zeros((ny, p))
    g = np.zeros(p)
    K = np.zeros(n)
    FK = np.zeros(n)
    T = np.zeros((n, n))
    yhat = np.zeros(ny)
    e = np.zeros(ny)
    N = W.shape[0]
    for k in range(N):
        if counters[0] > 0:
            # the model at the present coefficients: first order about those it was discretized for
            step[:n] = x
            step[n : n + nu] = w
            step[n + nu :] = W[k]
            for i in range(n):
                total = 0.0
                for j in range(nz):
                    total += M[i, j] * step[j]
                x[i] = total
                for j in range(n):
                    Phi[i, j] = M[i, j]
            for i in range(ny):
                for j in range(no):
                    Oc[i, j] = O[i, j]
            for r in range(q):
                shift = theta[columns[r]] - centre[columns[r]]
                for i in range(moved[r, 0], moved[r, 1]):
                    total = 0.0
                    for j in range(nz):
                        total += dM[r, i, j] * step[j]
                    drive[r, i] = total
                    x[i] += shift * total
                    for j in range(n):
                        Phi[i, j] += shift * dM[r, i, j]
                if varied:
                    for i in range(ny):
                        for j in range(no):
                            Oc[i, j] += shift * dO[r, i, j]
            for a in range(p):
                for i in range(n):
                    total = 0.0
                    for j in range(n):
                        total += Phi[i, j] * S[a, j]
                    Sn[i] = total
                for i in range(n):
                    S[a, i] = Sn[i]
            for r in range(q):
                for i in range(moved[r, 0], moved[r, 1]):
                    S[columns[r], i] += drive[r, i]
            out[:n] = x
            out[n:] = W[k]
            for i in range(ny):
                total = 0.0
                for j in range(no):
                    total += Oc[i, j] * out[j]
                yhat[i] = total
                for a in range(p):
                    total = 0.0
                    for j in range(n):
                        total += Oc[i, j] * S[a, j]
                    h[i, a] = total
                if varied:
                    for r in range(q):
                        total = 0.0
                        for j in range(no):
                            total += dO[r, i, j] * out[j]
                        h[i, columns[r]] += total
            if not known[k] or counters[2] > 0:
                counters[1] = 10 * n + 10
                if not known[k]:
                    for i in range(n):
                        for j in range(n):
                            Pb[i, j] += Qw[i, j]
            if counters[1] > 0:
                for i in range(ny):
                    for b in range(n):
                        total = 0.0
                        for j in range(n):
                            total += Oc[i, j] * Phi[j, b]
                        H[i, b] = total
            _correct(
                Y[k], use[k], theta, delta, S, Pt, x, Pb, Q, K, FK, T, Phi, H, h, g, yhat, level, floor,
                count, limits, least, forgetting, frozen, counters, cost, power, surprise, loose, e,
            )  # fmt: skip
            for i in range(n):
                if not abs(x[i]) < limit:
                    return k, DIVERGED
        else:
            e[:] = np.nan
        w[:] = W[k]
        counters[0] += 1
        if TH.shape[0] > 0:
            TH[k] = theta
            E[k] = e
            X[k] = x
        if not frozen and surprise[0] > watch:
            return k + 1, SURPRISED
        if not frozen and _moved(theta, centre, Pt, share, least):
            return k + 1, MOVED
    return N, DONE


@compiled
def _static(value, statics, channel, levels, kept, slopes, out, keep):
    """The laws of one input in turn.

    `slopes` (r, 4) takes the derivatives by their coefficients, the slope by the value is returned;
    `kept` (r, 6) holds inner state, its derivatives and the value of the sample before, and takes those
    of this one where `keep` is set.
    """
    passed = 1.0
    for r in range(statics.shape[0]):
        if statics[r, 1] != channel or statics[r, 0] == 0:
            continue
        evaluate(statics[r, 0], value, 0.0, kept[r, 5], kept[r, 0], levels, r, 1.0, slopes[r], out)
        for before in range(r):
            if statics[before, 1] == channel:
                for c in range(4):
                    slopes[before, c] *= out[r, 1]
        for c in range(4):
            slopes[r, c] = out[r, 9 + c] + out[r, 4] * kept[r, 1 + c]
            if keep:
                kept[r, 1 + c] = out[r, 13 + c] + out[r, 8] * kept[r, 1 + c]
        if keep:
            kept[r, 0], kept[r, 5] = out[r, 5], value
        value = out[r, 0]
        passed *= out[r, 1]
    return value, passed


@compiled
def _input_at(ring, channel, when, foh):
    """Raw input at `when` samples before the latest (0 or negative), and its slope per sample."""
    last = ring.shape[0] - 1
    cell = int(np.floor(when + 1e-9))
    if cell < -last:
        return ring[0, channel], 0.0
    if cell >= 0:
        return ring[last, channel], 0.0
    start = ring[last + cell, channel]
    if not foh:
        return start, 0.0
    rise = ring[last + cell + 1, channel] - start
    return start + (when - cell) * rise, rise


@compiled
def _drive(
    ring, statics, levels, kept, delays, free, dt, substeps, foh, W, Wout, dW, dWout, slopes, total, out
):
    """Inputs over the last interval behind their laws and delays; derivatives by what is `free` (row, c)."""
    nu = ring.shape[1]
    dW[:, :, :] = 0.0
    dWout[:, :, :] = 0.0
    for channel in range(nu):
        delay = delays[channel] / dt
        for edge in range(2):
            raw, rise = _input_at(ring, channel, edge - 1.0 - delay, foh)
            slopes[:, :] = 0.0
            Wout[edge, channel], passed = _static(raw, statics, channel, levels, kept, slopes, out, False)
            for i in range(free.shape[0]):
                r, c = free[i, 0], free[i, 1]
                if statics[r, 1] == channel:
                    dWout[i, edge, channel] = -rise * passed / dt if statics[r, 0] == 0 else slopes[r, c]
        if foh:
            for s in range(substeps + 1):
                raw, rise = _input_at(ring, channel, s / substeps - 1.0 - delay, foh)
                slopes[:, :] = 0.0
                W[s, channel], passed = _static(raw, statics, channel, levels, kept, slopes, out, False)
                for i in range(free.shape[0]):
                    r, c = free[i, 0], free[i, 1]
                    if statics[r, 1] == channel:
                        dW[i, s, channel] = -rise * passed / dt if statics[r, 0] == 0 else slopes[r, c]
        else:
            for s in range(substeps):
                # mean over the substep, so that no impulse is lost where an edge falls inside it
                early = s / substeps - 1.0 - delay
                late = early + 1.0 / substeps
                turn = min(max(np.floor(early + 1e-9) + 1.0, early), late)
                share = (turn - early) / (late - early)
                W[s, channel] = 0.0
                total[:, :] = 0.0
                ends = np.zeros(2)
                for part in range(2):
                    weight = share if part == 0 else 1.0 - share
                    raw, rise = _input_at(ring, channel, early if part == 0 else late, foh)
                    slopes[:, :] = 0.0
                    value, passed = _static(raw, statics, channel, levels, kept, slopes, out, False)
                    ends[part] = value
                    W[s, channel] += weight * value
                    for r in range(statics.shape[0]):
                        for c in range(4):
                            total[r, c] += weight * slopes[r, c]
                for i in range(free.shape[0]):
                    r, c = free[i, 0], free[i, 1]
                    if statics[r, 1] == channel:
                        if statics[r, 0] == 0:
                            dW[i, s, channel] = -(ends[1] - ends[0]) / (late - early) / dt
                        else:
                            dW[i, s, channel] = total[r, c]
        _static(_input_at(ring, channel, -delay, foh)[0], statics, channel, levels, kept, slopes, out, True)


@compiled
def advance_general(
    sizes, fixed, memory, counters, W, known, Y, use, frozen, TH, E, X,
    Ms, dMs, pieces, linear, O, dO, P, dP, codes, values, columns, widths, statics, levels,
    outcodes, outvalues, outcolumns, substeps, foh, dt,
):  # fmt: skip
    """Advance over a block with any effects; arguments as of `advance` and of the engine's loop.

    statics : ndarray of int64, shape (r, 6)
        Input laws: as `evaluate` takes it, 0 for a delay; channel; four columns in theta or -1.
    levels : ndarray, shape (r, 4)
        Their coefficients, those that are held.
    """
    n, p, nu, ny, lag = sizes[0], sizes[1], sizes[2], sizes[3], sizes[5]
    m = codes.shape[0]
    q = linear.shape[0]
    at = 0
    centre = fixed[at : at + p]
    at += p
    limits = fixed[at : at + 2 * p].reshape(2, p)
    at += 2 * p
    least = fixed[at : at + p]
    at += p
    floor = fixed[at : at + ny]
    at += ny
    share, forgetting, limit, watch = fixed[at], fixed[at + 1], fixed[at + 2], fixed[at + 3]
    at += 4
    Q = fixed[at : at + n * n].reshape(n, n)
    at += n * n
    Qw = fixed[at : at + n * n].reshape(n, n)

    at = 0
    theta = memory[at : at + p]
    at += p
    delta = memory[at : at + p]
    at += p
    x = memory[at : at + n]
    at += n
    S = memory[at : at + p * n].reshape(p, n)
    at += p * n
    Pb = memory[at : at + n * n].reshape(n, n)
    at += n * n
    Pt = memory[at : at + p * p].reshape(p, p)
    at += p * p
    level = memory[at : at + 2 * ny].reshape(2, ny)
    at += 2 * ny
    count = memory[at : at + ny]
    at += ny
    cost = memory[at : at + 2 * ny].reshape(2, ny)
    at += 2 * ny
    power = memory[at : at + 2 * ny].reshape(2, ny)
    at += 2 * ny
    surprise = memory[at : at + 1]
    at += 1
    w = memory[at : at + nu]
    at += nu
    z = memory[at : at + sizes[6]]
    at += sizes[6]
    ring = memory[at : at + lag * nu].reshape(lag, nu)
    at += lag * nu
    kept = memory[at : at + 6 * sizes[7]].reshape(sizes[7], 6)

    r = statics.shape[0]
    rows = substeps + 1 if foh else substeps
    Wn = np.zeros((rows, nu))
    Wout = np.zeros((2, nu))
    if sizes[7] == 0:
        kept = np.zeros((r, 6))
    out = np.zeros((r, COUNT))
    slopes = np.zeros((r, 4))
    sums = np.zeros((r, 4))
    delays = np.zeros(nu)
    free = np.zeros((4 * r, 2), dtype=np.int64)
    driven = np.zeros(4 * r, dtype=np.int64)
    count_free = 0
    for i in range(r):
        for c in range(4):
            if statics[i, 2 + c] >= 0:
                driven[count_free] = statics[i, 2 + c]
                free[count_free, 0], free[count_free, 1] = i, c
                count_free += 1
    free, driven = free[:count_free], driven[:count_free]
    dW = np.zeros((count_free, rows, nu))
    dWout = np.zeros((count_free, 2, nu))
    Msc = Ms.copy()
    Oc = O.copy()
    Y2 = np.zeros((2, ny))
    none = np.zeros((2, ny), dtype=np.uint8)
    K0 = np.zeros((n, ny))
    S2 = np.zeros((p + n, n))
    Yout = np.zeros((2, ny))
    SY = np.zeros((2, ny, p + n))
    X0 = np.zeros((0, n))
    F0 = np.zeros((0, m))
    F = np.zeros((n, n))
    H = np.zeros((ny, n))
    h = np.zeros((ny, p))
    g = np.zeros(p)
    K = np.zeros(n)
    FK = np.zeros(n)
    loose = np.zeros((n, n))
    T = np.zeros((n, n))
    yhat = np.zeros(ny)
    e = np.zeros(ny)
    N = W.shape[0]
    for k in range(N):
        if counters[0] == 0:
            for i in range(lag):
                ring[i] = W[k]
            for channel in range(nu):
                _static(W[k, channel], statics, channel, levels, kept, slopes, out, True)
            e[:] = np.nan
        else:
            for i in range(lag - 1):
                ring[i] = ring[i + 1]
            ring[lag - 1] = W[k]
            Msc[:, :, :] = Ms
            Oc[:, :] = O
            for j in range(q):
                shift = theta[linear[j]] - centre[linear[j]]
                if shift != 0.0:
                    Msc += dMs[:, j] * shift
                    Oc += dO[j] * shift
            for i in range(m):
                for c in range(4):
                    if columns[i, c] >= 0:
                        values[i, c] = theta[columns[i, c]]
            for i in range(ny):
                for c in range(4):
                    if outcolumns[i, c] >= 0:
                        outvalues[i, c] = theta[outcolumns[i, c]]
            delays[:] = 0.0
            for i in range(r):
                for c in range(4):
                    if statics[i, 2 + c] >= 0:
                        levels[i, c] = theta[statics[i, 2 + c]]
                if statics[i, 0] == 0:
                    delays[statics[i, 1]] += levels[i, 0]
            _drive(
                ring, statics, levels, kept, delays, free, dt, substeps, foh, Wn, Wout, dW, dWout, slopes,
                sums, out,
            )  # fmt: skip
            S2[:p] = S
            S2[p:] = 0.0
            for i in range(n):
                S2[p + i, i] = 1.0
            blew = march(
                Msc, dMs, pieces, linear, Oc, dO, P, dP, codes, values, columns, widths, Wn, foh, Wout,
                dW, dWout, driven, Y2, none, K0, outcodes, outvalues, outcolumns, x, z, S2, substeps,
                Yout, SY, X0, F0, limit,
            )  # fmt: skip
            if blew >= 0:
                return k, DIVERGED
            S[:, :] = S2[:p]
            for i in range(n):
                for j in range(n):
                    F[i, j] = S2[p + j, i]
            for i in range(ny):
                yhat[i] = Yout[1, i]
                for a in range(p):
                    h[i, a] = SY[1, i, a]
                for j in range(n):
                    H[i, j] = SY[1, i, p + j]
            if not known[k] or counters[2] > 0:
                counters[1] = 10 * n + 10
                if not known[k]:
                    Pb += Qw
            _correct(
                Y[k], use[k], theta, delta, S, Pt, x, Pb, Q, K, FK, T, F, H, h, g, yhat, level, floor,
                count, limits, least, forgetting, frozen, counters, cost, power, surprise, loose, e,
            )  # fmt: skip
            for i in range(n):
                if not abs(x[i]) < limit:
                    return k, DIVERGED
        w[:] = W[k]
        counters[0] += 1
        if TH.shape[0] > 0:
            TH[k] = theta
            E[k] = e
            X[k] = x
        if not frozen and surprise[0] > watch:
            return k + 1, SURPRISED
        if not frozen and _moved(theta, centre, Pt, share, least):
            return k + 1, MOVED
    return N, DONE
