"""Figures of merit of a simulated against a measured signal."""

from __future__ import annotations

import control as ct
import numpy as np
from numpy.typing import ArrayLike

from ..systems.linear import Array

__all__ = ["fit_percent", "root_mean_square"]


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
    spread = np.linalg.norm(y - y.mean(axis=-1, keepdims=True), axis=-1)
    error = np.linalg.norm(y - yh, axis=-1)
    spread = np.broadcast_to(spread, error.shape)
    constant = np.broadcast_to((y == y[..., :1]).all(axis=-1), error.shape)
    ratio = np.divide(error, spread, out=np.full(error.shape, np.nan), where=~constant)
    return np.asarray(100.0 * (1.0 - ratio))


def root_mean_square(residual: ArrayLike) -> Array:
    """Root mean square over time (the last axis), in the unit of the signal.

    Examples
    --------
    >>> float(root_mean_square([3.0, -3.0]))
    3.0
    """
    return np.asarray(np.sqrt(np.mean(np.square(np.asarray(residual, dtype=float)), axis=-1)))
