"""Amplitude, period and damping ratio of each half cycle of a decay."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from ..exceptions import DataError
from ..systems.linear import Array

__all__ = ["Decay", "decay_of"]

_NOISE = (
    6.0  # standard deviations of the noise by which the signal must pass its level to count as crossing it
)
_WITHIN = 1 / 6  # of a half cycle on either side of an extreme to which a parabola is fitted
_SMOOTHED = 5  # amplitudes to which a logarithmic decrement is fitted


class Decay(NamedTuple):
    """Course of a free decay.

    Attributes
    ----------
    timepts : ndarray, shape (K,)
        Times of the amplitudes [s], between two neighboring extremes.
    amplitude : ndarray, shape (K,)
        Half the distance between two neighboring extremes, in the unit of the signal.
    period : ndarray, shape (K,)
        Twice the time between them [s].
    damping_ratio : ndarray, shape (K,)
        From the logarithmic decrement of neighboring amplitudes.
    """

    timepts: Array
    amplitude: Array
    period: Array
    damping_ratio: Array


def decay_of(signal: Array, dt: float, start: float = 0.0) -> Decay:
    """Return amplitude, period and damping ratio of an oscillation.

    The signal oscillates about a level, which is estimated.

    Parameters
    ----------
    signal : ndarray, shape (N,)
        Signal with one dominant mode.
    dt : float
        Sampling time [s].
    start : float
        Time of the first sample [s].

    Returns
    -------
    Decay

    Raises
    ------
    DataError
        If the signal has fewer than four extremes.

    Notes
    -----
    An extreme is the vertex of a parabola fitted about the largest sample of a half cycle. With the decrement
    d of one half cycle the damping ratio is ``d / sqrt(pi^2 + d^2)`` (Meirovitch, Fundamentals of Vibrations,
    sec. 2.3); d is the slope of a line through the logarithms of five neighboring amplitudes.

    Examples
    --------
    >>> t = np.arange(4000) * 0.01
    >>> found = decay_of(np.exp(-0.05 * t) * np.cos(5 * t), 0.01)
    >>> print(found.damping_ratio.round(4)[:3], found.period.round(3)[0])
    [0.01 0.01 0.01] 1.257
    """
    noise = float(np.median(np.abs(np.diff(signal, 2)))) / (0.6745 * np.sqrt(6.0))
    level = float(np.median(signal))
    for _ in range(3):  # the level is the middle of the extremes
        sign = np.sign(signal - level) * (np.abs(signal - level) > _NOISE * noise)
        known = np.flatnonzero(sign)
        turns = np.flatnonzero(np.diff(sign[known])) + 1
        halves = [(int(part[0]), int(part[-1])) for part in np.split(known, turns) if part.size > 2]
        if len(halves) < 4:
            raise DataError(
                f"the signal swings through {len(halves)} half cycle(s) above its noise; a decay needs at "
                "least four: give a longer record, or one from the release on"
            )
        found = [_extreme(signal - level, *half) for half in halves]
        at, value = np.array([one for one in found if one is not None]).T
        level += float(np.mean(0.25 * (value[:-2] + 2 * value[1:-1] + value[2:])))
    amplitude, period = 0.5 * np.abs(np.diff(value)), 2.0 * dt * np.diff(at)
    decrement = _slopes(-np.log(amplitude))
    ratio = decrement / np.sqrt(np.pi**2 + decrement**2)
    return Decay(start + dt * 0.5 * (at[1:] + at[:-1]), amplitude, period, ratio)


def _extreme(signal: Array, first: int, last: int) -> tuple[float, float] | None:
    """Return position (in samples) and value of the extreme of a half cycle.

    None if the record cuts the extreme off.
    """
    part = signal[first : last + 1]
    peak = first + int(np.argmax(np.abs(part)))
    reach = max(2, int(_WITHIN * (last - first)))
    low, high = max(peak - reach, 0), min(peak + reach + 1, signal.size)
    x = np.arange(low, high) - peak
    a, b, c = np.polyfit(x, signal[low:high], 2)
    if a == 0 or not x[0] < -0.5 * b / a < x[-1]:
        return None if peak - reach < 0 or peak + reach >= signal.size else (float(peak), float(signal[peak]))
    return peak - 0.5 * b / a, c - 0.25 * b**2 / a


def _slopes(values: Array) -> Array:
    """Return the slope at each value.

    It is that of a line through up to `_SMOOTHED` neighbors.
    """
    half, n = _SMOOTHED // 2, values.size
    found = np.empty(n)
    for k in range(n):
        reach = min(half, max(k, 1), max(n - 1 - k, 1))
        part = slice(max(k - reach, 0), min(k + reach + 1, n))
        found[k] = np.polyfit(np.arange(n)[part], values[part], 1)[0]
    return found
