"""Detection of outputs at the end of their range.

Equal readings on one step of the converter do not count.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ..systems.linear import Array

__all__ = ["clipped", "coarse_noise", "cut_off", "resolution", "runs"]

_RUN = 4  # samples in a row that make a standstill
_STEPS = 3.0  # of the converter by which a smooth signal may leave a peak that it shows as flat
_CLIPPED = 0.005  # share of the samples that sit at the very same extreme
_SAME = 1e-9  # of the range, below which two readings are one


def resolution(y: Array) -> float:
    """Return the smallest difference between two readings (N,).

    It is the step of the converter; without a converter it is close to zero.
    """
    levels = np.unique(y)
    apart = np.diff(levels)
    apart = apart[apart > _SAME * float(np.ptp(y))]
    return float(apart.min()) if apart.size else 0.0


def coarse_noise(y: Array) -> float:
    """Estimate the standard deviation of white noise on a smooth signal.

    The signal has shape (N,). Outliers do not count.
    """
    return float(1.4826 * np.median(np.abs(np.diff(y, 2))) / np.sqrt(6.0))


def runs(at: NDArray[np.bool_]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """First sample and end (exclusive) of each run of True."""
    edges = np.flatnonzero(np.diff(np.concatenate([[0], at.astype(np.int8), [0]])))
    return edges[::2], edges[1::2]


def cut_off(y: Array, limit: float) -> bool:
    """Return whether a record (N,) runs into a limit at speed and stays.

    A peak shows as four equal readings of a converter only where it is so flat that the
    readings beside them are within three steps, and a response that settles comes slowly; a
    signal that is cut off comes and goes at whatever speed it has.

    Parameters
    ----------
    y : ndarray, shape (N,)
        Readings.
    limit : float
        Largest or smallest of them.

    Returns
    -------
    bool

    Examples
    --------
    >>> t = 0.05 * np.arange(2000)
    >>> steps = np.round(np.sin(t) * 20) / 20
    >>> cut_off(steps, 1.0), cut_off(np.minimum(steps, 0.8), 0.8)
    (False, False)
    >>> fine = np.round(np.sin(t) * 2000) / 2000
    >>> cut_off(fine, fine.max()), cut_off(np.minimum(fine, 0.8), 0.8)
    (False, True)
    """
    first, end = runs(y == limit)
    whole = (end - first >= _RUN) & (first > 0) & (end < y.size)
    before, after = np.abs(y[first[whole] - 1] - limit), np.abs(y[end[whole]] - limit)
    slower = min(np.median(before), np.median(after)) if whole.any() else 0.0
    return bool(slower > _STEPS * resolution(y))


def clipped(y: Array) -> tuple[float, int] | None:
    """Return the extreme at which an output (N,) stays, and for how long.

    The time is the longest one, in samples. None if the output is not clipped.
    """
    if np.unique(y).size < 20:
        return None
    for level in (float(y.max()), float(y.min())):
        at = y == level
        if at.mean() >= _CLIPPED and cut_off(y, level):
            first, end = runs(at)
            return level, int((end - first).max())
    return None
