"""Correlation of measured signals, and correlograms.

The module also checks the arrays that the residual tests take.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import control as ct
import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy import stats

from ..exceptions import DataError
from ..systems.linear import Array

__all__ = [
    "Correlogram",
    "correlation",
    "correlogram",
    "lag_count",
    "residual_and_inputs",
    "signal_names",
    "signal_rows",
    "standardized",
]


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
    x, y = (signal_rows(v, "signal")[0] for v in (first, second))
    if x.size != y.size:
        raise ct.ControlDimension(f"signals have {x.size} and {y.size} samples; give both over the same time")
    count = lag_count(lags, x.size)
    steps = np.arange(-count, count + 1)
    same = x is y or np.array_equal(x, y)
    # beyond a quarter of the record an autocorrelation is noise only
    reach = np.arange(-(x.size // 4), x.size // 4 + 1)
    spread = 1.0 if same else float(correlation(x, x, reach) @ correlation(y, y, reach))
    bound = float(stats.norm.isf((1 - probability) / 2)) * np.sqrt(max(spread, 1.0 / x.size) / x.size)
    return Correlogram(steps.astype(float), correlation(x, y, steps), np.full(steps.size, bound))


def correlation(x: Array, y: Array, lags: Sequence[int] | NDArray[np.int_]) -> Array:
    """Correlation of y(k + lag) with x(k), means taken out, divided by N."""
    a, b = x - x.mean(), y - y.mean()
    scale = float(np.sqrt((a @ a) * (b @ b)))
    n = a.size
    if scale == 0.0:
        return np.zeros(len(lags))
    return np.array([a[: n - k] @ b[k:] if k >= 0 else a[-k:] @ b[: n + k] for k in lags]) / scale


def signal_rows(values: ArrayLike, what: str) -> Array:
    """Signals as rows of finite numbers."""
    array = np.atleast_2d(np.asarray(values, dtype=float))
    if array.ndim != 2 or array.shape[1] < array.shape[0]:
        raise ct.ControlDimension(f"{what} has shape {array.shape}; give (signals, samples), time last")
    if not np.isfinite(array).all():
        i, k = np.argwhere(~np.isfinite(array))[0]
        raise DataError(f"{what} {i} is not finite at sample {k}; repair or cut it")
    return array


def lag_count(lags: int, n_samples: int) -> int:
    """Number of lags, where the signals are long enough for them."""
    if isinstance(lags, (bool, np.bool_)) or not isinstance(lags, (int, np.integer)) or lags < 1:
        raise ct.ControlArgument(f"lags must be a whole number from 1 on, not {lags!r}")
    if n_samples < 2 * lags + 8:
        raise DataError(f"{n_samples} samples are too few for {lags} lags; give at least {2 * lags + 8}")
    return int(lags)


def residual_and_inputs(residual: ArrayLike, inputs: ArrayLike) -> tuple[Array, Array]:
    """Both over the same samples."""
    e, u = signal_rows(residual, "residual"), signal_rows(inputs, "inputs")
    if e.shape[1] != u.shape[1]:
        raise ct.ControlDimension(
            f"the residual has {e.shape[1]} samples and the inputs {u.shape[1]}; give both over the same time"
        )
    return e, u


def signal_names(given: Sequence[str] | None, count: int, letter: str) -> list[str]:
    """Names given, or a letter with the number."""
    if given is None:
        return [letter] if count == 1 else [f"{letter}[{i}]" for i in range(count)]
    names = [given] if isinstance(given, str) else list(given)
    if len(names) != count:
        raise ct.ControlDimension(f"{len(names)} labels given for {count} signal(s)")
    return names


def standardized(values: Array) -> Array:
    """Mean taken out, unit spread."""
    spread = float(values.std())
    return np.asarray((values - values.mean()) / (spread if spread > 0 else 1.0))
