"""States that a whole record shows: a steady Kalman filter forth, Rauch, Tung and Striebel's pass back."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..jit import compiled
from ..systems.linear import Array
from .observer import steady_filter

__all__ = ["Smoothed", "smooth"]


class Smoothed(NamedTuple):
    """States of a record, by the samples up to each one and by all of them."""

    filtered: Array  #: (N, n), by the samples up to this one
    states: Array  #: (N, n), by all samples
    innovations: Array  #: (N, n_y), outputs less their prediction
    spread: Array  #: (n_y, n_y), covariance of the innovations
    power: float  #: mean square of the innovations in that metric; 1 if the noise levels are right

    @property
    def log_likelihood(self) -> float:
        """Of the outputs, up to a constant."""
        N, ny = self.innovations.shape
        return float(-0.5 * N * (np.linalg.slogdet(self.spread)[1] + ny * self.power))


def smooth(
    F: Array,
    H: Array,
    Q: Array,
    R: Array,
    outputs: Array,
    *,
    drive: Array | None = None,
    reset: NDArray[np.uint8] | None = None,
) -> Smoothed:
    """States of ``x = F x + drive + process noise`` from outputs ``y = H x + sensor noise``.

    Parameters
    ----------
    F, H, Q, R : ndarray
        As of `steady_filter`.
    outputs : ndarray, shape (N, n_y)
        Outputs.
    drive : ndarray, shape (N, n), optional
        What the known inputs add to the state from each sample to the next.
    reset : ndarray of uint8, shape (N,), optional
        1 where the state begins anew, at zero; the first sample always does.

    Returns
    -------
    Smoothed
        NaN where there is no filter.
    """
    N, n = outputs.shape[0], F.shape[0]
    steady = steady_filter(F, H, Q, R)
    nothing = np.full((N, n), np.nan)
    if not np.isfinite(steady.gain).all():
        return Smoothed(nothing, nothing, np.full(outputs.shape, np.nan), steady.innovation, np.nan)
    predicted, filtered, innovations = np.zeros((N, n)), np.zeros((N, n)), np.zeros(outputs.shape)
    steer = np.zeros((N, n)) if drive is None else np.ascontiguousarray(drive)
    anew = np.zeros(N, np.uint8) if reset is None else reset
    F, H, y = (np.ascontiguousarray(array) for array in (F, H, outputs))
    _forwards(F, H, np.ascontiguousarray(steady.gain), y, steer, anew, predicted, filtered, innovations)
    # least squares: a state without process noise has no predicted covariance to divide by
    back = np.linalg.lstsq(steady.predicted.T, F @ steady.filtered.T, rcond=1e-12)[0].T
    states = filtered.copy()
    _backwards(np.ascontiguousarray(back), predicted, anew, states)
    weighed = np.einsum("ki,ij,kj->k", innovations, np.linalg.inv(steady.innovation), innovations)
    return Smoothed(
        filtered, states, innovations, steady.innovation, float(np.mean(weighed)) / outputs.shape[1]
    )


@compiled
def _forwards(F, H, K, y, drive, reset, predicted, filtered, innovations):  # type: ignore[no-untyped-def]
    x = np.zeros(F.shape[0])
    for k in range(y.shape[0]):
        if reset[k]:
            x = np.zeros(F.shape[0])
        predicted[k] = x
        innovations[k] = y[k] - H @ x
        x = x + K @ innovations[k]
        filtered[k] = x
        x = F @ x + drive[k]


@compiled
def _backwards(back, predicted, reset, states):  # type: ignore[no-untyped-def]
    """In place over the filtered states."""
    for k in range(states.shape[0] - 2, -1, -1):
        if not reset[k + 1]:
            states[k] = states[k] + back @ (states[k + 1] - predicted[k + 1])
