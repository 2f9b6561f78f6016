"""Simulation loop of a model without nonlinear force laws.

It is separate because it compiles in a fifth of the time of `march`.
"""

from __future__ import annotations

import numpy as np

from ..jit import compiled, put, put_rows
from .products import add_forcing, add_rows, apply, clear, take


@compiled
def _enter(dw, at, dW, row, driven):
    """Add the derivatives of the inputs to columns of dw.

    They are those at one row of dW (r, rows, nw); the columns begin at `at`.
    """
    for r in range(driven.shape[0]):
        for j in range(dW.shape[2]):
            dw[driven[r], at + j] += dW[r, row, j]


@compiled
def _correct(x, S, K, i, error, sy):
    """Correct the state, and its sensitivities, by the error of output i."""
    for j in range(x.shape[0]):
        x[j] += K[j, i] * error
        for q in range(S.shape[0]):
            S[q, j] -= K[j, i] * sy[q, i]


@compiled
def linear_march(  # arguments as in `kernels.march`; M and dM are those of a substep
    M, dM, linear, O, dO, W, course, Wout, dW, dWout, driven,
    Y, use, K, x, S, substeps, Yout, SY, X, limit, far,
):  # fmt: skip
    """March over the record; return the first sample that blew up, or -1."""
    n, nw, p, ny = x.shape[0], Wout.shape[1], S.shape[0], Yout.shape[1]
    Phi, Gamma, C, D = np.zeros((n, n)), np.zeros((n, 2 * nw)), np.zeros((ny, n)), np.zeros((ny, nw))
    take(Phi, M, 0)
    take(Gamma, M, n)
    take(C, O, 0)
    take(D, O, n)
    step, out, y = np.zeros(n + 2 * nw), np.zeros(n + nw), np.zeros(ny)
    sy, S_next, dw, dw_out = np.zeros((p, ny)), np.zeros((p, n)), np.zeros((p, 2 * nw)), np.zeros((p, nw))
    for k in range(Yout.shape[0]):
        put(out, 0, x)
        put(out, n, Wout[k])
        apply(y, O, out)
        if p > 0:
            clear(sy)
            add_rows(sy, S, C)
            add_forcing(sy, linear, dO, out)
            if driven.shape[0] > 0:
                clear(dw_out)
                _enter(dw_out, 0, dWout, k, driven)
                add_rows(sy, dw_out, D)
        for i in range(ny):
            Yout[k, i] = y[i]
            if not abs(y[i]) <= far[i]:
                return k
            for q in range(p):
                SY[k, i, q] = sy[q, i]
            if use[k, i]:
                _correct(x, S, K, i, Y[k, i] - y[i], sy)
        if X.shape[0] > 0:
            put(X[k], 0, x)
        if k == Yout.shape[0] - 1:
            break
        for s in range(substeps):
            row = (k * substeps + s) * max(course, 1)
            after = row + min(course, 1)
            put(step, 0, x)
            put(step, n, W[row])
            put(step, n + nw, W[after])
            apply(x, M, step)
            if p > 0:
                clear(S_next)
                add_rows(S_next, S, Phi)
                add_forcing(S_next, linear, dM, step)
                if driven.shape[0] > 0:
                    clear(dw)
                    _enter(dw, 0, dW, row, driven)
                    _enter(dw, nw, dW, after, driven)
                    add_rows(S_next, dw, Gamma)
                put_rows(S, S_next)
        for j in range(n):
            if not abs(x[j]) < limit:
                return k + 1
    return -1
