"""Steady-state Rauch-Tung-Striebel smoother.

A steady Kalman filter runs forward over the record, then the smoother runs backward.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from ..jit import compiled, put
from ..systems.linear import Array
from .observer import SteadyFilter, steady_filter


@dataclass(eq=False)
class Smoothed:
    """States of a record, by the samples up to each one and by all of them.

    Attributes
    ----------
    steady : SteadyFilter
        What led the states.
    predicted, filtered : ndarray, shape (N, n)
        States by the samples before this one, and with it.
    innovations : ndarray, shape (N, n_y)
        Outputs less their prediction.
    """

    F: Array
    steady: SteadyFilter
    predicted: Array
    filtered: Array
    innovations: Array
    reset: NDArray[np.uint8]

    @cached_property
    def _back(self) -> Array:
        # least squares: a state without process noise has no predicted covariance to divide by
        after = self.F @ self.steady.filtered.T
        return np.ascontiguousarray(np.linalg.lstsq(self.steady.predicted.T, after, rcond=1e-12)[0].T)

    @cached_property
    def states(self) -> Array:
        """States by all samples, shape (N, n)."""
        states = self.filtered.copy()
        _backwards(self._back, self.predicted, self.reset, states)
        return states

    @cached_property
    def covariance(self) -> Array:
        """Return the covariance of the smoothed states, shape (n, n).

        It is that at the sample farthest from the end of the record.
        """
        steady, back = self.steady, self._back
        # covariance of the last but one state, given the last one exactly
        found = steady.filtered - back @ steady.predicted @ back.T
        for _ in range(int(np.ceil(np.log2(len(self.filtered))))):  # P = Q + back P back', from the end on
            found = found + back @ found @ back.T
            back = back @ back
        return np.asarray(found + back @ steady.filtered @ back.T)

    @cached_property
    def power(self) -> float:
        """Return the mean square of the normalized innovations.

        It is 1 if the noise levels are right.
        """
        # e' S^-1 e of each sample
        e = self.innovations
        weighed = np.einsum("ki,ij,kj->k", e, np.linalg.inv(self.steady.innovation), e)
        return float(np.mean(weighed) / e.shape[1])

    @property
    def log_determinant(self) -> float:
        """Of the covariance of the innovations."""
        return float(np.linalg.slogdet(self.steady.innovation)[1])

    @property
    def log_likelihood(self) -> float:
        """Of the outputs, up to a constant."""
        N, ny = self.innovations.shape
        return float(-0.5 * N * (self.log_determinant + ny * self.power))


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
    """Return the states of a linear model, smoothed over a whole record.

    The model is ``x = F x + drive + process noise`` with outputs ``y = H x + sensor noise``.

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
    # steady-state Kalman filter, then one pass forward
    steady = steady_filter(F, H, Q, R)
    predicted, filtered, innovations = (np.full((N, m), np.nan) for m in (n, n, H.shape[0]))
    anew = np.zeros(N, np.uint8) if reset is None else reset
    if np.isfinite(steady.gain).all():
        steer = np.zeros((N, n)) if drive is None else drive
        F, H, K, y, steer = (np.ascontiguousarray(array) for array in (F, H, steady.gain, outputs, steer))
        _forwards(F, H, K, y, steer, anew, (predicted, filtered, innovations))
    return Smoothed(F, steady, predicted, filtered, innovations, anew)


@compiled
def _forwards(F, H, K, y, drive, reset, into):  # type: ignore[no-untyped-def]
    predicted, filtered, innovations = into
    x = np.zeros(F.shape[0])
    for k in range(y.shape[0]):
        # the state begins anew
        if reset[k]:
            x = np.zeros(F.shape[0])
        put(predicted[k], 0, x)
        # Kalman filter: update with the innovation, then predict
        put(innovations[k], 0, y[k] - H @ x)
        for i in range(y.shape[1]):  # what was not measured corrects nothing
            if np.isnan(y[k, i]):
                innovations[k, i] = 0.0
        x = x + K @ innovations[k]
        put(filtered[k], 0, x)
        x = F @ x + drive[k]


@compiled
def _backwards(back, predicted, reset, states):  # type: ignore[no-untyped-def]
    """In place over the filtered states."""
    # Rauch-Tung-Striebel: x_s(k) = x(k|k) + G (x_s(k+1) - x(k+1|k))
    for k in range(states.shape[0] - 2, -1, -1):
        if not reset[k + 1]:
            put(states[k], 0, states[k] + back @ (states[k + 1] - predicted[k + 1]))
