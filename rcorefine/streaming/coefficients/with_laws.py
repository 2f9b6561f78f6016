"""Nonlinear model at the present coefficients over one interval.

The engine integrates this model.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ...jit import compiled, put, put_rows
from ...systems.linear import Array

__all__ = ["Laws", "enter", "fill", "march_of", "push", "read", "shift_matrices"]


class Laws(NamedTuple):
    """A model with laws, discretized: as the engine's `march` takes it.

    march : address of that; Ms, dMs, O, dO, P, dP, pieces, codes, values, columns, widths, outcodes,
    outvalues, outcolumns, substeps : as there; linear : coefficients that the matrices depend on;
    statics, levels : laws of the inputs and their coefficients, as `input_laws` takes them; foh : whether
    inputs are linear between samples; dt : sampling time.
    """

    march: int
    Ms: Array
    dMs: Array
    pieces: int
    linear: NDArray[np.int64]
    O: Array
    dO: Array
    P: Array
    dP: Array
    codes: NDArray[np.int64]
    values: Array
    columns: NDArray[np.int64]
    widths: Array
    statics: NDArray[np.int64]
    levels: Array
    outcodes: NDArray[np.int64]
    outvalues: Array
    outcolumns: NDArray[np.int64]
    substeps: int
    foh: bool
    dt: float


class March(NamedTuple):
    """Room for the march over one interval.

    Ms, O : matrices at the present coefficients; Y : outputs; S, SY : sensitivities of state and outputs
    to the coefficients, and to the state before; S_settled, SY_settled : where that no longer matters;
    measured, unused, gain : nothing that corrects; X, F : nothing that is recorded.
    """

    Ms: Array
    O: Array
    Y: Array
    S: Array
    SY: Array
    S_settled: Array
    SY_settled: Array
    measured: Array
    unused: NDArray[np.uint8]
    gain: Array
    X: Array
    F: Array


@compiled
def march_of(sizes, laws):
    """Room for the march."""
    n, p, ny = sizes[0], sizes[1], sizes[3]
    return March(
        laws.Ms.copy(), laws.O.copy(), np.zeros((2, ny)), np.zeros((p + n, n)), np.zeros((2, ny, p + n)),
        np.zeros((p, n)), np.zeros((2, ny, p)), np.zeros((2, ny)), np.zeros((2, ny), dtype=np.uint8),
        np.zeros((n, ny)), np.zeros((0, n)), np.zeros((0, laws.codes.shape[0])),
    )  # fmt: skip


@compiled
def push(ring, w):
    """The latest inputs behind those before."""
    last = ring.shape[0] - 1
    for i in range(last):
        put(ring[i], 0, ring[i + 1])
    put(ring[last], 0, w)


@compiled
def fill(values, columns, first, theta):
    """Fill in the estimated coefficients of force laws from `theta`.

    Their columns begin at `first`.
    """
    for i in range(values.shape[0]):
        for c in range(4):
            if columns[i, first + c] >= 0:
                values[i, c] = theta[columns[i, first + c]]


@compiled
def shift_matrices(Ms, O, given_Ms, dMs, given_O, dO, linear, theta, centre):
    """Update the matrices to the present coefficients, to first order.

    The expansion is about the coefficients that the matrices were discretized for.
    """
    if linear.shape[0] == 0:
        return
    put_rows(Ms[0], given_Ms[0])
    put_rows(Ms[1], given_Ms[1])
    put_rows(O, given_O)
    for r in range(linear.shape[0]):
        shift = theta[linear[r]] - centre[linear[r]]
        if shift == 0.0:
            continue
        for i in range(Ms.shape[1]):
            for j in range(Ms.shape[2]):
                Ms[0, i, j] += dMs[0, r, i, j] * shift
                Ms[1, i, j] += dMs[1, r, i, j] * shift
        for i in range(O.shape[0]):
            for j in range(O.shape[1]):
                O[i, j] += dO[r, i, j] * shift


@compiled
def enter(through, S):
    """Set the sensitivities at the start of the interval.

    Those to the coefficients come first, then those of the state to itself.
    """
    p, n = S.shape
    put_rows(through, S)
    for i in range(through.shape[0] - p):
        for j in range(n):
            through[p + i, j] = 1.0 if i == j else 0.0


@compiled
def read(through, shown, Y, S, yhat, h, F, H):
    """Sensitivities and outputs at the end of the interval."""
    p, n = S.shape
    put_rows(S, through[:p])
    for i in range(yhat.shape[0]):
        yhat[i] = Y[1, i]
        for a in range(p):
            h[i, a] = shown[1, i, a]
    for j in range(through.shape[0] - p):
        for i in range(n):
            F[i, j] = through[p + j, i]
        for i in range(yhat.shape[0]):
            H[i, j] = shown[1, i, p + j]
