"""One sample of a model whose coefficients all stand in its matrices."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ...jit import compiled, put_rows
from ...systems.linear import Array
from .packed import matrix, row

__all__ = ["linear_at", "shift_outputs", "step_outputs", "step_sensitivity", "step_state", "through_state"]


class LinearPart(NamedTuple):
    """A discretized model: x+ = M [x; w; w+], y = O [x; w], and their derivatives.

    columns : coefficient of each derivative; rows : first row that it moves, and the last one + 1;
    varied : 1 where O depends on a coefficient; Oc : O at the present coefficients; others : room.
    """

    M: Array
    O: Array
    dM: Array
    dO: Array
    columns: NDArray[np.int64]
    rows: NDArray[np.int64]
    varied: bool
    Oc: Array
    step: Array
    drive: Array
    Sn: Array


@compiled
def linear_at(sizes, fixed, at):
    """Views of the model among the packed numbers."""
    n, nu, ny, q = sizes[0], sizes[2], sizes[3], sizes[4]
    nz, no = n + 2 * nu, n + nu
    M, at = matrix(fixed, at, n, nz)
    O, at = matrix(fixed, at, ny, no)
    slopes, at = row(fixed, at, q * n * nz)
    shown, at = row(fixed, at, q * ny * no)
    last, at = row(fixed, at, q)
    dM, dO = slopes.reshape(q, n, nz), shown.reshape(q, ny, no)
    columns = np.zeros(q, dtype=np.int64)
    rows = np.zeros((q, 2), dtype=np.int64)
    varied = False
    for r in range(q):
        columns[r] = int(last[r])
        for i in range(n):
            for j in range(nz):
                if dM[r, i, j] != 0.0:
                    if rows[r, 1] == 0:
                        rows[r, 0] = i
                    rows[r, 1] = i + 1
        for i in range(ny):
            for j in range(no):
                if dO[r, i, j] != 0.0:
                    varied = True
    room = np.zeros(nz), np.zeros((q, n)), np.zeros(n)
    return LinearPart(M, O, dM, dO, columns, rows, varied, O.copy(), room[0], room[1], room[2])


@compiled
def step_state(x, F, M, dM, columns, rows, theta, centre, step, drive):
    """State and its transition at the present coefficients: first order about those of `M`."""
    n, nz = M.shape
    for i in range(n):
        total = 0.0
        for j in range(nz):
            total += M[i, j] * step[j]
        x[i] = total
        for j in range(n):
            F[i, j] = M[i, j]
    for r in range(columns.shape[0]):
        shift = theta[columns[r]] - centre[columns[r]]
        for i in range(rows[r, 0], rows[r, 1]):
            total = 0.0
            for j in range(nz):
                total += dM[r, i, j] * step[j]
            drive[r, i] = total
            x[i] += shift * total
            for j in range(n):
                F[i, j] += shift * dM[r, i, j]


@compiled
def step_sensitivity(S, F, columns, rows, drive, Sn):
    """Sensitivity of the state to the coefficients."""
    p, n = S.shape
    for a in range(p):
        for i in range(n):
            total = 0.0
            for j in range(n):
                total += F[i, j] * S[a, j]
            Sn[i] = total
        for i in range(n):
            S[a, i] = Sn[i]
    for r in range(columns.shape[0]):
        for i in range(rows[r, 0], rows[r, 1]):
            S[columns[r], i] += drive[r, i]


@compiled
def shift_outputs(Oc, O, dO, columns, theta, centre):
    """Matrix of the outputs at the present coefficients."""
    put_rows(Oc, O)
    for r in range(columns.shape[0]):
        shift = theta[columns[r]] - centre[columns[r]]
        for i in range(O.shape[0]):
            for j in range(O.shape[1]):
                Oc[i, j] += shift * dO[r, i, j]


@compiled
def step_outputs(x, w, S, Oc, dO, columns, varied, yhat, h):
    """Outputs, and their sensitivity to the coefficients."""
    n, p = x.shape[0], S.shape[0]
    for i in range(yhat.shape[0]):
        total = 0.0
        for j in range(n):
            total += Oc[i, j] * x[j]
        for j in range(w.shape[0]):
            total += Oc[i, n + j] * w[j]
        yhat[i] = total
        for a in range(p):
            total = 0.0
            for j in range(n):
                total += Oc[i, j] * S[a, j]
            h[i, a] = total
        if varied:
            for r in range(columns.shape[0]):
                total = 0.0
                for j in range(n):
                    total += dO[r, i, j] * x[j]
                for j in range(w.shape[0]):
                    total += dO[r, i, n + j] * w[j]
                h[i, columns[r]] += total


@compiled
def through_state(H, Oc, F):
    """Outputs by the state before."""
    n = F.shape[0]
    for i in range(H.shape[0]):
        for b in range(n):
            total = 0.0
            for j in range(n):
                total += Oc[i, j] * F[j, b]
            H[i, b] = total
