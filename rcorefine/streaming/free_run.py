"""Simulation cost of a frozen model on data that it has not seen."""

from __future__ import annotations

import numpy as np

from ..engine.products import solve_in_place
from ..jit import compiled, put, put_rows

__all__ = ["free_run_cost", "state_power"]


@compiled
def free_run_cost(A, B, C, D, W, Y, use, weights, window):
    """Return the weighted mean square simulation error.

    The initial state is fitted.

    Parameters
    ----------
    A, B, C, D : ndarray
        Discrete model.
    W, Y : ndarray, shape (N, nw), (N, ny)
        Samples.
    use : ndarray of uint8, shape (N, ny)
        Which outputs to compare.
    weights : ndarray, shape (ny,)
        One over the size of each output.
    window : int
        Samples after which the run starts anew with a state of its own, 0 for never.
    """
    n, ny, nw, N = A.shape[0], C.shape[0], B.shape[1], W.shape[0]
    x, xn = np.zeros(n), np.zeros(n)
    X, Xn = np.eye(n), np.eye(n)
    H = np.zeros((n, n))
    g = np.zeros(n)
    h = np.zeros(n)
    found = np.zeros((1, n))
    total = 0.0
    square = 0.0
    count = 0.0
    held = 0
    for k in range(N):
        for i in range(ny):
            if use[k, i]:
                e = Y[k, i]
                for j in range(n):
                    e -= C[i, j] * x[j]
                for j in range(nw):
                    e -= D[i, j] * W[k, j]
                e *= weights[i]
                for j in range(n):
                    h[j] = 0.0
                    for a in range(n):
                        h[j] += C[i, a] * X[a, j]
                    h[j] *= weights[i]
                for a in range(n):
                    g[a] += h[a] * e
                    for b in range(n):
                        H[a, b] += h[a] * h[b]
                square += e * e
                count += 1.0
        for a in range(n):
            xn[a] = 0.0
            for j in range(n):
                xn[a] += A[a, j] * x[j]
            for j in range(nw):
                xn[a] += B[a, j] * W[k, j]
            for b in range(n):
                Xn[a, b] = 0.0
                for j in range(n):
                    Xn[a, b] += A[a, j] * X[j, b]
        put(x, 0, xn)
        put_rows(X, Xn)
        held += 1
        if held == window or k == N - 1:
            # least squares for the state at the start of the window, each column of unit size
            for a in range(n):
                xn[a] = 1.0 / np.sqrt(H[a, a]) if H[a, a] > 0.0 else 0.0
            for a in range(n):
                for b in range(n):
                    H[a, b] *= xn[a] * xn[b]
                H[a, a] += 1e-10 if xn[a] > 0.0 else 1.0
                g[a] *= xn[a]
            gained = 0.0
            if n > 0:
                if not np.isfinite(H).all():
                    return np.inf
                put(found[0], 0, g)
                solve_in_place(H, found)
                for a in range(n):
                    gained += g[a] * found[0, a]
            total += max(square - gained, 0.0)
            square, held = 0.0, 0
            x[:] = 0.0
            for a in range(n):
                for b in range(n):
                    X[a, b] = 1.0 if a == b else 0.0
            H[:, :] = 0.0
            g[:] = 0.0
    return total / max(count, 1.0)


@compiled
def state_power(A, B, W):
    """Return the mean square of each state of a discrete model.

    The model starts from rest, with inputs of shape (N, nw).
    """
    n, nw = B.shape
    x, xn, total = np.zeros(n), np.zeros(n), np.zeros(n)
    for k in range(W.shape[0]):
        for i in range(n):
            xn[i] = 0.0
            for j in range(n):
                xn[i] += A[i, j] * x[j]
            for j in range(nw):
                xn[i] += B[i, j] * W[k, j]
        for i in range(n):
            x[i] = xn[i]
            total[i] += x[i] * x[i]
    return total / max(W.shape[0], 1)
