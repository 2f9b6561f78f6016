"""Figures of measured and simulated signals: fit, correlation, decay."""

from __future__ import annotations

from typing import NamedTuple

import control as ct
import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy import signal, stats

from ..exceptions import DataError
from ..systems.linear import Array

_NOISE = 6.0  # standard deviations of the noise by which a signal must pass its level to count as crossing it
_WITHIN = 1 / 6  # of a half cycle on either side of an extreme to which a parabola is fitted
_ROUNDING = 1e-12  # of an output, below which what a model leaves is rounding
_SMOOTHED = 5  # amplitudes to which a logarithmic decrement is fitted


def fit_percent(measured: ArrayLike, simulated: ArrayLike) -> Array:
    """Fit in percent, as in MATLAB's `compare`: 100 (1 - NRMSE).

    Parameters
    ----------
    measured : array_like of shape (..., N)
        Measured signal(s), time last.
    simulated : array_like of shape (..., N)
        Simulated signal(s); broadcast against `measured`.

    Returns
    -------
    ndarray
        100 (1 - norm(y - yh) / norm(y - mean(y))) over time: 100 for a
        perfect model, 0 for one no better than the mean, negative below.
        NaN where the measured signal is constant, for then it has no scale.

    Raises
    ------
    control.ControlDimension
        If the numbers of samples differ.

    Examples
    --------
    >>> print(round(float(fit_percent([0.0, 2.0], [0.0, 1.0])), 2))
    29.29
    """
    y, yh = np.asarray(measured) + 0.0, np.asarray(simulated) + 0.0
    if y.ndim == 0 or y.shape[-1:] != yh.shape[-1:]:
        raise ct.ControlDimension(f"measured has shape {y.shape} and simulated {yh.shape}; time comes last")
    # norm of the output about its mean, over the samples that were measured
    seen = ~np.isnan(y)
    level = np.mean(y, axis=-1, keepdims=True, where=seen)
    spread = np.linalg.norm(np.where(seen, y - level, 0.0), axis=-1)
    error = np.linalg.norm(np.where(seen, y - yh, 0.0), axis=-1)
    # a constant output has no fit
    first = np.take_along_axis(y, seen.argmax(axis=-1)[..., None], axis=-1)
    moves = (seen & (y != first)).any(axis=-1)
    ratio = np.divide(error, spread, out=np.full(error.shape, np.nan), where=moves)
    return np.asarray(100.0 * (1.0 - ratio))


def is_rounding(residual: Array, outputs: Array) -> NDArray[np.bool_]:
    """Return, by output, whether a residual is no more than rounding.

    Parameters
    ----------
    residual, outputs : ndarray of shape (n_y, N)
        What a model leaves of the outputs.

    Returns
    -------
    ndarray of shape (n_y,)
    """
    return root_mean_square(residual) <= _ROUNDING * root_mean_square(outputs)


def root_mean_square(residual: ArrayLike) -> Array:
    """Root mean square over time (the last axis), in the unit of the signal.

    NaN stands for samples that were not measured.

    Examples
    --------
    >>> float(root_mean_square([3.0, -3.0]))
    3.0
    """
    square = np.square(np.asarray(residual, dtype=float))
    return np.asarray(np.sqrt(np.mean(square, axis=-1, where=~np.isnan(square))))


class Correlogram(NamedTuple):
    """Correlation by lag and the bound that chance stays within.

    Attributes
    ----------
    lags : ndarray of shape (n_lags,)
        Lags in samples; positive: the second signal follows the first.
    correlation : ndarray of shape (n_lags,)
        Correlation coefficients.
    bound : ndarray of shape (n_lags,)
        Half-width of the region in which independent signals stay with the
        given probability, at each lag.
    """

    lags: Array
    correlation: Array
    bound: Array


def correlogram(
    first: ArrayLike, second: ArrayLike, lags: int = 25, *, probability: float = 0.99
) -> Correlogram:
    """Cross-correlation of two signals, with the bound of MATLAB's `resid`.

    Parameters
    ----------
    first, second : array_like of shape (N,)
        Say input and residual; the same twice for the autocorrelation.
    lags : int
        Largest lag, to both sides.
    probability : float
        Probability that independent signals stay within the bound, per lag.

    Returns
    -------
    Correlogram
        The variance is P/N with P the sum over all lags of the product of
        the two autocorrelations, so that coloured signals have wider bounds
        (Ljung, System Identification, 1999, sec. 16.6).

    Examples
    --------
    >>> u = np.random.default_rng(0).standard_normal(500)
    >>> found = correlogram(u, np.roll(u, 3), 5)
    >>> int(found.lags[np.argmax(found.correlation)])
    3
    """
    x, y = (np.ravel(np.asarray(v, dtype=float)) for v in (first, second))
    # lags on both sides
    steps = np.arange(-lags, lags + 1)
    same = x is y or np.array_equal(x, y)
    # beyond a quarter of the record an autocorrelation is noise only
    reach = np.arange(-(x.size // 4), x.size // 4 + 1)
    # Bartlett: variance of a cross-correlation, from both autocorrelations
    spread = 1.0 if same else float(_correlation(x, x, reach) @ _correlation(y, y, reach))
    bound = float(stats.norm.isf((1 - probability) / 2)) * np.sqrt(max(spread, 1.0 / x.size) / x.size)
    return Correlogram(steps.astype(float), _correlation(x, y, steps), np.full(steps.size, bound))


def _correlation(x: Array, y: Array, lags: NDArray[np.int_]) -> Array:
    """Correlation of y(k + lag) with x(k), means taken out, divided by N."""
    a, b = x - x.mean(), y - y.mean()
    scale = float(np.sqrt((a @ a) * (b @ b)))
    return np.asarray(signal.correlate(b, a)[a.size - 1 + lags] / (scale or 1.0))


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
    # noise from second differences, robust: median absolute value
    noise = float(np.median(np.abs(np.diff(signal, 2)))) / (0.6745 * np.sqrt(6.0))
    level = float(np.median(signal))
    for _ in range(3):  # the level is the middle of the extremes
        # half cycles between crossings of the level, small values left out
        sign = np.sign(signal - level) * (np.abs(signal - level) > _NOISE * noise)
        known = np.flatnonzero(sign)
        turns = np.flatnonzero(np.diff(sign[known])) + 1
        halves = [(int(part[0]), int(part[-1])) for part in np.split(known, turns) if part.size > 2]
        if len(halves) < 4:
            raise DataError(
                f"the signal swings through {len(halves)} half cycle(s) above its noise; a decay needs at "
                "least four: give a longer record, or one from the release on"
            )
        # extreme of each half cycle by a parabola
        found = [_extreme(signal - level, *half) for half in halves]
        at, value = np.array([extreme for extreme in found if extreme is not None]).T
        level += float(np.mean(0.25 * (value[:-2] + 2 * value[1:-1] + value[2:])))
    amplitude, period = 0.5 * np.abs(np.diff(value)), 2.0 * dt * np.diff(at)
    # logarithmic decrement per half cycle
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
    # least-squares parabola about the peak
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
