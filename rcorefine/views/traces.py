"""Readable plots of signals over time.

A dense signal is drawn as a band, and of a long record only a stretch is drawn.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from ..systems.linear import Array

__all__ = ["busiest_stretch", "trace"]

_TURNS = 200  # crossings of its middle above which a line fills the picture
_CELLS = 120  # of a band
_SHOWN = 50  # crossings in a stretch


def trace(axis: Any, times: Array, values: Array, **look: Any) -> list[Any]:
    """Draw a signal as a line, or as a band if it is too dense.

    The band lies between the extremes of the signal.

    Parameters
    ----------
    axis : Axes
        Where.
    times, values : ndarray of shape (n,)
        The signal; NaN breaks the line.
    **look
        Of the line, as `Axes.plot` takes it.

    Returns
    -------
    list of Line2D
        The line with its arrays, not visible where the band stands for it.
    """
    drawn: list[Any] = axis.plot(times, values, **look)
    if _crossings(values) <= _TURNS:
        return drawn
    starts = np.unique(np.linspace(0, len(values) - 1, _CELLS + 1).astype(int))
    low, high = np.fmin.reduceat(values, starts), np.fmax.reduceat(values, starts)
    line = drawn[0]
    axis.fill_between(
        times[starts], low, high, step="post", alpha=0.8, lw=0.6,
        color=line.get_color(), zorder=line.get_zorder(), label=line.get_label(),
    )  # fmt: skip
    line.set(visible=False, label="_")
    return drawn


def busiest_stretch(times: Array, outputs: Array, residuals: ArrayLike) -> tuple[float, float] | None:
    """Return the stretch of a record where it differs most from the models.

    The stretch is as long as a picture has room for.

    Parameters
    ----------
    times : ndarray of shape (n,)
        Times in s.
    outputs : ndarray of shape (n_y, n)
        What is drawn as lines.
    residuals : array_like of shape (n_models, n_y, n)
        What the models leave.

    Returns
    -------
    tuple of float or None
        Its first and last time in s; None where there is room for all.

    Examples
    --------
    >>> t = np.arange(1000) * 0.01
    >>> busiest_stretch(t, np.sin(t)[None], [[0 * t]]) is None
    True
    """
    turns = max(_crossings(y) for y in outputs)
    if turns <= _TURNS:
        return None
    length = max(int(len(times) * _SHOWN / turns), 2)
    with np.errstate(over="ignore", invalid="ignore"):
        energy = np.sum(np.nan_to_num(np.asarray(residuals)) ** 2, axis=(0, 1))
        total = np.concatenate([[0.0], np.cumsum(energy)])
        first = int(np.argmax(np.nan_to_num(total[length:] - total[:-length])))
    return float(times[first]), float(times[first + length - 1])


def _crossings(values: Array) -> int:
    """Count how often a signal crosses its median."""
    known = values[np.isfinite(values)]
    return int(np.count_nonzero(np.diff(known > np.median(known)))) if known.size else 0
