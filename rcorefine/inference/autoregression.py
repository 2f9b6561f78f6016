"""Autoregressive filters that take the color out of a signal."""

from __future__ import annotations

import numpy as np
from scipy.linalg import solve_toeplitz
from scipy.signal import lfilter
from scipy.signal.windows import tukey

from ..systems.linear import Array

__all__ = ["ar_order", "autoregressive_filter", "whitened"]


def ar_order(n_samples: int) -> int:
    """Order that whitens ordinary noise in a record of this length, 8 to 60.

    Examples
    --------
    >>> ar_order(500), ar_order(4000)
    (13, 25)
    """
    return int(np.clip(round(1.6 * n_samples ** (1 / 3)), 8, max(8, min(60, n_samples // 12))))


def autoregressive_filter(signal: Array, order: int) -> Array:
    """Whitening filter of a signal by the Yule-Walker equations.

    A light taper keeps a strong resonance or a slow drift from leaking into
    the rest of the spectrum.

    Parameters
    ----------
    signal : ndarray of shape (N,)
        Signal; its mean is taken out.
    order : int
        Number of coefficients.

    Returns
    -------
    ndarray of shape (order + 1,)
        ``a`` with ``a[0] = 1``; ``sum_i a[i] signal[k - i]`` is white.

    Examples
    --------
    >>> from scipy.signal import lfilter
    >>> e = np.random.default_rng(0).standard_normal(20000)
    >>> print(autoregressive_filter(lfilter([1], [1, -0.8], e), 1).round(1))
    [ 1.  -0.8]
    """
    x = (signal - signal.mean()) * tukey(signal.size, 0.1)
    size = 1 << int(2 * x.size - 1).bit_length()
    covariance = np.fft.irfft(np.abs(np.fft.rfft(x, size)) ** 2, size)[: order + 1] / x.size
    if not np.isfinite(covariance).all() or covariance[0] <= 1e-300:
        return np.concatenate([[1.0], np.zeros(order)])
    covariance[0] *= 1.0 + 1e-9  # keeps a nearly noise-free residual solvable
    coefficients = solve_toeplitz(covariance[:order], covariance[1:])
    return np.concatenate([[1.0], -coefficients])


def whitened(signal: Array, order: int | None = None) -> Array:
    """Innovations of a signal under its own autoregressive model, mean taken out.

    Parameters
    ----------
    signal : ndarray of shape (N,)
        Signal.
    order : int, optional
        Order of the model; default `ar_order` of its length.

    Returns
    -------
    ndarray of shape (N - order,)
        The samples for which the filter has its whole past.
    """
    p = ar_order(signal.size) if order is None else order
    a = autoregressive_filter(signal, p)
    return np.asarray(lfilter(a, [1.0], signal - signal.mean())[p:])
