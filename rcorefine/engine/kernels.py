"""Loops over samples: a linear part with port laws, laws over a period.

Pure array functions, no objects and no checks. numba compiles them where it is
installed; without it the same source runs as plain Python (`products.py` has two bodies).
"""

from __future__ import annotations

import numpy as np

from ..effects.compiled import COUNT, evaluate
from ..jit import by_address, compiled, put, put_rows
from .products import add, add_forcing, add_rows, apply, clear, multiply, solve_in_place, take

_OUTSIDE = 2e-5  # of `far`: within it what is left of an equation is rounding, as at rest
_NO_FORCES = 1e-6  # of their squares: what is left of an equation that has no solution


@compiled
def _force_jacobian(J, parts, Q, slopes, m):
    """Compute the Jacobian of the force equations at the end of a substep.

    Each force must equal that of its force law, or of its row of the field. `J` is filled in place.
    """
    for j in range(J.shape[0]):
        for i in range(m):
            J[i, j] = -(parts[i, 1] * Q[i, j] + parts[i, 2] * Q[m + i, j])
        for i in range(J.shape[0] - m):
            total = 0.0
            for k in range(Q.shape[0] - 2 * m):
                total += slopes[i, k] * Q[2 * m + k, j]
            J[m + i, j] = -total
        J[j, j] += 1.0


@compiled
def _field_sensitivity(sf, slopes, staken, columns):
    """Compute the sensitivity (p, nf) of the rows of the nonlinear field.

    It follows from the sensitivity (p, ns) of its signals, and from its parameters. `sf` is filled in place.
    """
    ns = staken.shape[1]
    for q in range(sf.shape[0]):
        for i in range(sf.shape[1]):
            total = 0.0
            for k in range(ns):
                total += slopes[i, k] * staken[q, k]
            sf[q, i] = total
    if sf.shape[0] > 0:
        for c in range(columns.size):
            if columns[c] >= 0:
                for i in range(sf.shape[1]):
                    sf[columns[c], i] += slopes[i, ns + c]


@compiled
def march(
    # Forces are those of m laws, and with a field (a right-hand side that is not linear) nf of its
    # rows behind them, all = m + nf; the field takes ns states and inputs.
    # A substep is divided by 4 where a force jumps in it, and again up to the last grade.
    Ms,  # (grades, n, n + 2 nw + 2 all)  [Phi, Gamma0, Gamma1, Psi0, Psi1] of a substep, and of its pieces
    dMs,  # (grades, q, n, n + 2 nw + 2 all) their derivatives, for the parameters listed in `linear`
    linear,  # (q,)               rows of the sensitivity that dM and dO drive
    O,  # (ny, n + nw + all)      [C, D, G]
    dO,  # (q, ny, n + nw + all)
    P,  # (2 m + ns, n + nw)      d = P[:m] [x; w], v = P[m:2m] [x; w]; what the field takes
    dP,  # (q or 0, 2 m + ns, n + nw)
    codes,  # (m,)                law of each port, as `evaluate` takes it
    values,  # (m, 6)             its coefficients; 1 where it feels the inputs; 1 where it jumps
    columns,  # (m, 4)            their rows in the sensitivity, -1 where fixed
    widths,  # (m,)
    W,  # (rows, nw)              inputs over the substeps
    course,  # int                0: W[i] held; 1: straight from W[i] to W[i + 1]; 2: W[2 i] to W[2 i + 1]
    Wout,  # (N, nw)              input at the samples
    dW,  # (r, rows, nw)          derivative of W for the parameters in `driven`
    dWout,  # (r, N, nw)
    driven,  # (r,)
    Y,  # (N, ny)                 measurement, used where `use` is set
    use,  # (N, ny) uint8         correct the state with this output at this sample
    K,  # (n, ny)                 observer gain
    J,  # (n, n) or (0, 0)        x = J x at every sample, before anything else
    outcodes,  # (ny,)            law of each output, 0 for none
    outvalues,  # (ny, 4)
    outcolumns,  # (ny, 4)
    x,  # (n,)                    initial state; holds the final one on return
    z,  # (m,) or (m + ny,)       inner states of the laws, those of outputs behind
    S,  # (p, n)                  sensitivity of the state; p = 0 for none
    substeps,
    Yout,  # (N, ny)
    SY,  # (N, ny, p)
    X,  # (N, n) or (0, n)
    F,  # (N, all) or (0, all)
    limit,  # stop when a state exceeds this
    far,  # (ny,)                 or an output this
    field,  # int                 code of the field, as `evaluate` takes it
    fvalues,  # (1, nq)           its parameters
    fcolumns,  # (nq,)            their rows in the sensitivity, -1 where fixed
):
    """March over the record; return the first sample that blew up, or -1.

    Where a field leaves no forces at the end of a substep the motion has run away within it.
    """
    n = x.shape[0]
    nw = Wout.shape[1]
    m = codes.shape[0]
    ny = Yout.shape[1]
    p = S.shape[0]
    samples = Wout.shape[0]
    nz = Ms.shape[2]
    nf = (nz - n - 2 * nw) // 2 - m
    ns = P.shape[0] - 2 * m
    senses_input = False
    for i in range(P.shape[0]):
        for j in range(nw):
            if P[i, n + j] != 0.0:
                senses_input = True
    for i in range(m):
        if values[i, 4] != 0.0:
            senses_input = True
    remembers = z.shape[0] > m

    ends = n + 2 * nw + m + nf
    grades = Ms.shape[0]
    ticks = 1 << 2 * (grades - 1)  # of a substep: its smallest pieces
    Phis = np.zeros((grades, n, n))
    Gamma0s, Gamma1s = np.zeros((grades, n, nw)), np.zeros((grades, n, nw))
    Psi0s, Psi1s = np.zeros((grades, n, m + nf)), np.zeros((grades, n, m + nf))
    for grade in range(grades):
        take(Phis[grade], Ms[grade], 0)
        take(Gamma0s[grade], Ms[grade], n)
        take(Gamma1s[grade], Ms[grade], n + nw)
        take(Psi0s[grade], Ms[grade], n + 2 * nw)
        take(Psi1s[grade], Ms[grade], ends)
    Px, Pw = np.zeros((P.shape[0], n)), np.zeros((P.shape[0], nw))
    take(Px, P, 0)
    take(Pw, P, n)
    Qs = np.zeros((grades, P.shape[0], m + nf))
    for grade in range(grades):
        multiply(Qs[grade], Px, Psi1s[grade])
    Cx, Dw, Gf = np.zeros((ny, n)), np.zeros((ny, nw)), np.zeros((ny, m + nf))
    take(Cx, O, 0)
    take(Dw, O, n)
    take(Gf, O, n + nw)

    step = np.zeros(nz)
    out = np.zeros(n + nw + m + nf)
    xw = np.zeros(n + nw)
    x_before = np.zeros(n)
    w_now, w_end = xw[n : n + nw - 1], step[n + nw : n + 2 * nw - 1]  # the inputs without the constant one
    y = np.zeros(ny)
    sy = np.zeros((p, ny))
    sense = np.zeros(P.shape[0])
    free = np.zeros(P.shape[0])
    f = np.zeros(m + nf)
    trial = np.zeros(m + nf)
    residual = np.zeros(m + nf)
    newton = np.zeros((1, m + nf))
    d_last = np.zeros(m)
    v_last = np.zeros(m)
    f_start = np.zeros(m + nf)
    Jn = np.zeros((m + nf, m + nf))
    own = np.zeros(ns)
    table = np.zeros((1, nf * (2 + ns + fvalues.shape[1])))
    slopes = table.reshape((nf, 2 + ns + fvalues.shape[1]))[:, 2:]  # of the field, by what it takes
    slopes_wanted = 1.0  # 2 where a parameter of the field is free
    for c in range(fcolumns.size):
        if fcolumns[c] >= 0:
            slopes_wanted = 2.0
    parts = np.zeros((m + ny, COUNT + nw - 1))  # what the laws write, those of outputs behind
    shown = parts[m:]
    past = np.zeros((3 + 3 * p, ny))  # of outputs; in one piece, for a stream comes here with every sample
    zy, y_raw, y_last = past[0], past[1], past[2]
    sy_raw, sy_last, szy = past[3 : 3 + p], past[3 + p : 3 + 2 * p], past[3 + 2 * p :]
    if remembers:
        for i in range(ny):
            zy[i] = z[m + i]
    sf = np.zeros((p, m + nf))
    sz = np.zeros((p, m))
    sd_last = np.zeros((p, m))
    ssense = np.zeros((p, P.shape[0]))
    Snew = np.zeros((p, n))
    dw_a = np.zeros((p, nw))
    dw_b = np.zeros((p, nw))

    stale = True
    first = True
    outside = False
    for k in range(samples):
        if J.shape[0] > 0:
            put(x_before, 0, x)
            apply(x, J, x_before)
            clear(Snew)
            add_rows(Snew, S, J)
            put_rows(S, Snew)
        # forces at the sample: new where the state was corrected or the port senses the input
        for attempt in range(2):
            if m + nf > 0 and (stale or senses_input):
                put(xw, 0, x)
                put(xw, n, Wout[k])
                apply(sense, P, xw)
                if p > 0:
                    clear(ssense)
                    add_rows(ssense, S, Px)
                    clear(dw_a)
                    if senses_input and driven.shape[0] > 0:
                        for r in range(driven.shape[0]):
                            for j in range(nw):
                                dw_a[driven[r], j] += dWout[r, k, j]
                        add_rows(ssense, dw_a, Pw)
                    add_forcing(ssense, linear, dP, xw)
                for i in range(m):
                    if first:
                        d_last[i] = sense[i]
                        for q in range(p):
                            sd_last[q, i] = ssense[q, i]
                    evaluate(
                        codes[i], sense[i], sense[m + i], d_last[i], z[i], values, i, widths[i],
                        w_now, parts,
                    )  # fmt: skip
                    part = parts[i]
                    f[i] = part[0]
                    for q in range(p):
                        sd = ssense[q, i]
                        sv = ssense[q, m + i]
                        sf[q, i] = part[1] * sd + part[2] * sv + part[3] * sd_last[q, i] + part[4] * sz[q, i]
                        sz[q, i] = part[6] * sd + part[17] * sv + part[7] * sd_last[q, i] + part[8] * sz[q, i]
                        sd_last[q, i] = sd
                        if values[i, 4] != 0.0:
                            for j in range(nw - 1):
                                sf[q, i] += part[COUNT + j] * dw_a[q, j]
                    if p > 0:
                        for c in range(4):
                            if columns[i, c] >= 0:
                                sf[columns[i, c], i] += part[9 + c]
                                sz[columns[i, c], i] += part[13 + c]
                    z[i] = part[5]
                    d_last[i] = sense[i]
                    v_last[i] = sense[m + i]
                if nf > 0:
                    wanted = slopes_wanted if p > 0 or first else 0.0
                    evaluate(field, 0.0, 0.0, 0.0, 0.0, fvalues, 0, wanted, sense[2 * m :], table)
                    for i in range(nf):
                        f[m + i] = table[0, i * (2 + ns + fvalues.shape[1])]
                    _field_sensitivity(sf[:, m:], slopes, ssense[:, 2 * m :], fcolumns)
                first = False
                stale = False
            if attempt == 1:
                break

            # output, its sensitivity, and the sensor's own static law
            put(out, 0, x)
            put(out, n, Wout[k])
            put(out, n + nw, f)
            apply(y, O, out)
            if p > 0:
                clear(sy)
                add_rows(sy, S, Cx)
                if m + nf > 0:
                    add_rows(sy, sf, Gf)
                add_forcing(sy, linear, dO, out)
                for r in range(driven.shape[0]):
                    for i in range(ny):
                        total = 0.0
                        for j in range(nw):
                            total += Dw[i, j] * dWout[r, k, j]
                        sy[driven[r], i] += total
            corrected = False
            for i in range(ny):
                slope = 1.0
                if outcodes[i] != 0:
                    y_raw[i] = y[i]
                    if k == 0 and attempt == 0:
                        y_last[i] = y[i]
                    evaluate(outcodes[i], y[i], 0.0, y_last[i], zy[i], outvalues, i, 1.0, w_now, shown)
                    y[i], slope = shown[i, 0], shown[i, 1]
                    for q in range(p):
                        sy_raw[q, i] = sy[q, i]
                        if k == 0 and attempt == 0:
                            sy_last[q, i] = sy[q, i]
                        sy[q, i] *= slope
                        sy[q, i] += shown[i, 3] * sy_last[q, i] + shown[i, 4] * szy[q, i]
                    if p > 0:
                        for c in range(4):
                            if outcolumns[i, c] >= 0:
                                sy[outcolumns[i, c], i] += shown[i, 9 + c]
                Yout[k, i] = y[i]
                if not abs(y[i]) <= far[i]:
                    return k
                outside = (outside and i > 0) or abs(y[i]) > _OUTSIDE * far[i]
                for q in range(p):
                    SY[k, i, q] = sy[q, i]
                if use[k, i] and slope != 0.0:
                    corrected = True
                    error = slope * (Y[k, i] - y[i])
                    for j in range(n):
                        x[j] += K[j, i] * error
                        for q in range(p):
                            S[q, j] -= K[j, i] * slope * sy[q, i]
            if X.shape[0] > 0:
                put(X[k], 0, x)
            if F.shape[0] > 0:
                put(F[k], 0, f)
            if not corrected:
                break
            stale = True
        if remembers:
            # what the outputs keep of this sample
            for i in range(ny):
                for q in range(p):
                    szy[q, i] *= shown[i, 8]
                    szy[q, i] += shown[i, 6] * sy_raw[q, i] + shown[i, 7] * sy_last[q, i]
                    sy_last[q, i] = sy_raw[q, i]
                if p > 0:
                    for c in range(4):
                        if outcolumns[i, c] >= 0:
                            szy[outcolumns[i, c], i] += shown[i, 13 + c]
                zy[i], y_last[i] = shown[i, 5], y_raw[i]
                z[m + i] = zy[i]

        if k == samples - 1:
            break
        for s in range(substeps):
            row = (k * substeps + s) * max(course, 1)
            after = row + min(course, 1)
            grade, length, tick = 0, ticks, 0
            while tick < ticks:
                M, Psi1, Q = Ms[grade], Psi1s[grade], Qs[grade]
                early, late = tick / ticks, (tick + length) / ticks
                put(step, 0, x)
                for j in range(nw):
                    rise = W[after, j] - W[row, j]
                    step[n + j] = W[row, j] + early * rise
                    step[n + nw + j] = W[row, j] + late * rise
                put(step, n + 2 * nw, f)
                for j in range(ends, nz):
                    step[j] = 0.0
                apply(x, M, step)
                if m + nf > 0:
                    put(xw, 0, x)
                    put(xw, n, step[n + nw : n + 2 * nw])
                    apply(free, P, xw)
                    # forces at the end of the step: damped Newton, start from the last ones
                    put(f_start, 0, f)
                    put(trial, 0, f)
                    best = np.inf
                    scale = 1.0
                    for iteration in range(60):
                        size = 0.0
                        level = 0.0
                        for i in range(m):
                            d = free[i]
                            v = free[m + i]
                            for j in range(m + nf):
                                d += Q[i, j] * trial[j]
                                v += Q[m + i, j] * trial[j]
                            evaluate(
                                codes[i], d, v, d_last[i], z[i], values, i, widths[i],
                                w_end, parts,
                            )  # fmt: skip
                            residual[i] = trial[i] - parts[i, 0]
                            size += residual[i] * residual[i]
                            level = max(level, abs(parts[i, 0]))
                        if nf > 0:
                            for j in range(ns):
                                own[j] = free[2 * m + j]
                                for i in range(m + nf):
                                    own[j] += Q[2 * m + j, i] * trial[i]
                            # derivatives from before serve a Newton step, unless it takes long
                            wanted = 1.0 if iteration % 4 == 3 else 0.0
                            evaluate(field, 0.0, 0.0, 0.0, 0.0, fvalues, 0, wanted, own, table)
                            for i in range(nf):
                                at = i * (2 + ns + fvalues.shape[1])
                                residual[m + i] = trial[m + i] - table[0, at]
                                size += residual[m + i] * residual[m + i]
                                level = max(level, table[0, at + 1])
                        if size >= best and scale > 1e-6 and iteration > 0:
                            scale *= 0.5
                            for i in range(m + nf):
                                trial[i] = f[i] - scale * newton[0, i]
                            continue
                        best = size
                        if size <= 1e-20 * (level * level + 1e-300) or not np.isfinite(size):
                            break
                        _force_jacobian(Jn, parts, Q, slopes, m)
                        put(newton[0], 0, residual)
                        solve_in_place(Jn, newton)
                        scale = 1.0
                        for i in range(m + nf):
                            f[i] = trial[i]
                            trial[i] = f[i] - newton[0, i]
                    if nf > 0 and outside and not best <= _NO_FORCES * (level * level + 1e-300):
                        return k + 1
                    put(f, 0, trial)
                    put(step, ends, f)
                    if length > 1:
                        # a friction force jumps inside: once more, the first quarter
                        jumps = False
                        for i in range(m):
                            if values[i, 5] != 0.0:
                                v = free[m + i]
                                for j in range(m + nf):
                                    v += Q[m + i, j] * f[j]
                                stuck = 3.0 * widths[i]
                                moves, moved = abs(v) > stuck, abs(v_last[i]) > stuck
                                if (moves or moved) and (moves != moved or v * v_last[i] < 0.0):
                                    jumps = True
                        if jumps:
                            put(x, 0, step[:n])
                            put(f, 0, f_start)
                            grade += 1
                            length //= 4
                            continue
                    add(x, Psi1, f)
                if p > 0:
                    clear(Snew)
                    add_rows(Snew, S, Phis[grade])
                    if m + nf > 0:
                        add_rows(Snew, sf, Psi0s[grade])
                    add_forcing(Snew, linear, dMs[grade], step)
                    if driven.shape[0] > 0:
                        clear(dw_a)
                        clear(dw_b)
                        for r in range(driven.shape[0]):
                            for j in range(nw):
                                rise = dW[r, after, j] - dW[r, row, j]
                                dw_a[driven[r], j] += dW[r, row, j] + early * rise
                                dw_b[driven[r], j] += dW[r, row, j] + late * rise
                        add_rows(Snew, dw_a, Gamma0s[grade])
                        add_rows(Snew, dw_b, Gamma1s[grade])
                    if m + nf > 0:
                        clear(ssense)
                        add_rows(ssense, Snew, Px)
                        if senses_input and driven.shape[0] > 0:
                            add_rows(ssense, dw_b, Pw)
                        if dP.shape[0] > 0:
                            put(xw, 0, x)
                            add_forcing(ssense, linear, dP, xw)
                        for i in range(m):
                            for q in range(p):
                                sf[q, i] = (
                                    parts[i, 1] * ssense[q, i]
                                    + parts[i, 2] * ssense[q, m + i]
                                    + parts[i, 3] * sd_last[q, i]
                                    + parts[i, 4] * sz[q, i]
                                )
                                if values[i, 4] != 0.0 and driven.shape[0] > 0:
                                    for j in range(nw - 1):
                                        sf[q, i] += parts[i, COUNT + j] * dw_b[q, j]
                            for c in range(4):
                                if columns[i, c] >= 0:
                                    sf[columns[i, c], i] += parts[i, 9 + c]
                        if nf > 0:
                            evaluate(field, 0.0, 0.0, 0.0, 0.0, fvalues, 0, slopes_wanted, own, table)
                            _field_sensitivity(sf[:, m:], slopes, ssense[:, 2 * m :], fcolumns)
                        _force_jacobian(Jn, parts, Q, slopes, m)
                        solve_in_place(Jn, sf)
                        add_rows(Snew, sf, Psi1)
                        for i in range(m):
                            for q in range(p):
                                sd = ssense[q, i]
                                sv = ssense[q, m + i]
                                for j in range(m + nf):
                                    sd += Q[i, j] * sf[q, j]
                                    sv += Q[m + i, j] * sf[q, j]
                                sz[q, i] = (
                                    parts[i, 6] * sd
                                    + parts[i, 17] * sv
                                    + parts[i, 7] * sd_last[q, i]
                                    + parts[i, 8] * sz[q, i]
                                )
                                sd_last[q, i] = sd
                            for c in range(4):
                                if columns[i, c] >= 0:
                                    sz[columns[i, c], i] += parts[i, 13 + c]
                    put_rows(S, Snew)
                for i in range(m):
                    z[i] = parts[i, 5]
                    d_last[i] = free[i]
                    v_last[i] = free[m + i]
                    for j in range(m + nf):
                        d_last[i] += Q[i, j] * f[j]
                        v_last[i] += Q[m + i, j] * f[j]
                tick += length
                while length < ticks and tick % (4 * length) == 0:
                    length *= 4
                    grade -= 1
        for j in range(n):
            if not abs(x[j]) < limit:
                return k + 1
    return -1


_TYPES = """int64(
    f8[:, :, ::1], f8[:, :, :, ::1], i8[::1], f8[:, ::1], f8[:, :, ::1], f8[:, ::1], f8[:, :, ::1],
    i8[::1], f8[:, ::1], i8[:, ::1], f8[::1], f8[:, ::1], i8, f8[:, ::1], f8[:, :, ::1], f8[:, :, ::1],
    i8[::1], f8[:, ::1], u1[:, ::1], f8[:, ::1], f8[:, ::1], i8[::1], f8[:, ::1], i8[:, ::1], f8[::1],
    f8[::1], f8[:, ::1], i8, f8[:, ::1], f8[:, :, ::1], f8[:, ::1], f8[:, ::1], f8,
    f8[::1], i8, f8[:, ::1], i8[::1])"""

#: The march in a kernel, and the address that this takes: inside of that it would be compiled once more.
march_at, address_of_march = by_address(march, _TYPES)


@compiled
def law_over_period(code, d, v, w, values, width):
    """Return a force and its slopes over one period, shape (3, n).

    The rows are the force and its derivatives by displacement and velocity.
    """
    found = np.empty((3, d.size))
    out = np.zeros((1, COUNT + w.shape[1]))
    for i in range(d.size):
        evaluate(code, d[i], v[i], d[i], 0.0, values, 0, width, w[i], out)
        found[0, i], found[1, i], found[2, i] = out[0, 0], out[0, 1], out[0, 2]
    return found


@compiled
def memory_over_period(code, d, v, w, values, inner, slope):
    """Run a force law with an inner state over one period.

    It starts from the inner state and its derivative by the n displacements. The forces, their derivatives
    (n, n), the inner state at the end, its derivative, and the remaining share of the inner state at the
    start are returned.
    """
    n = d.size
    f = np.empty(n)
    by = np.empty((n, n))
    slope = slope.copy()
    left = 1.0
    row = np.zeros((1, COUNT + w.shape[1]))
    for i in range(n):
        before = i - 1 if i > 0 else n - 1
        evaluate(code, d[i], v[i], d[before], inner, values, 0, 1.0, w[i], row)
        out = row[0]
        f[i] = out[0]
        by[i] = out[4] * slope
        by[i, i] += out[1]
        by[i, before] += out[3]
        slope *= out[8]
        slope[i] += out[6]
        slope[before] += out[7]
        inner = out[5]
        left *= out[8]
    return f, by, inner, slope, left
