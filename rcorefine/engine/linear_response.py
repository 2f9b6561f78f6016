"""Responses of a linear model to several signals, each alone.

They are computed sample by sample.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ..jit import compiled, put_rows
from ..systems.linear import Array

__all__ = ["linear_responses"]


def linear_responses(
    Phi: Array,
    drives: tuple[Array, Array],
    C: Array,
    D: Array,
    signals: Array,
    *,
    gain: Array | None = None,
    restarts: NDArray[np.uint8] | None = None,
) -> Array:
    """Outputs that each of several signals adds, from rest.

    Parameters
    ----------
    Phi : ndarray, shape (n, n)
        Transition over one sample.
    drives : two ndarrays, each of shape (n, k)
        Of a signal that falls from one to zero over the sample, and of one that rises.
    C, D : ndarray, shapes (n_y, n) and (n_y, k)
        Outputs.
    signals : ndarray, shape (N, k)
        One per column.
    gain : ndarray, shape (n, n_y), optional
        Of an observer; a free run without it.
    restarts : ndarray of uint8, shape (N,), optional
        Where the run begins anew from rest.

    Returns
    -------
    ndarray, shape (N, n_y, k)
    """
    N, n_y = len(signals), len(C)
    K = np.zeros((len(Phi), n_y)) if gain is None else gain
    begins = np.zeros(N, dtype=np.uint8) if restarts is None else restarts
    out = np.zeros((N, n_y, signals.shape[1]))
    Phi, falling, rising, C, D, K, signals = (
        np.ascontiguousarray(one, dtype=float) for one in (Phi, *drives, C, D, K, signals)
    )
    _march(Phi, falling, rising, C, D, K, signals, begins, out)
    return out


@compiled
def _march(Phi, falling, rising, C, D, K, F, restarts, out):  # type: ignore[no-untyped-def]
    N = out.shape[0]
    x = np.zeros((Phi.shape[0], out.shape[2]))
    for step in range(N):
        if restarts[step]:
            x = np.zeros_like(x)
        y = C @ x + D * F[step]
        put_rows(out[step], y)
        x = x - K @ y
        if step + 1 < N:
            x = Phi @ x + falling * F[step] + rising * F[step + 1]
