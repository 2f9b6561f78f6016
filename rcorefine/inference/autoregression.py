"""Autoregressive model of a signal.

All parts of the package use this one, so that they agree on what is white.
"""

from __future__ import annotations

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray
from scipy.linalg import cholesky, solve_triangular

from ..systems.linear import Array

MAX_ORDER = 20
_RIDGE = 1e-13  # of the signal's power: rounding of the sums of products stays below it


def highest_order(n_samples: int) -> int:
    """Return the largest model order for a record of this length.

    Each coefficient needs 20 samples.
    """
    return min(MAX_ORDER, n_samples // 20)


def autoregression(
    signal: Array,
    *,
    order: int | None = None,
    known: NDArray[np.bool_] | None = None,
    price: float = 2.0,
    most: int | None = None,
) -> tuple[Array, float]:
    """Fit an autoregressive model to a signal.

    Akaike's criterion chooses the order, or another one by its `price`.

    Parameters
    ----------
    signal : ndarray, shape (N,)
        Signal; its mean is taken out.
    order : int, optional
        Given rather than chosen, where likelihoods of several signals are compared.
    known : ndarray of bool, shape (N,), optional
        Samples that count; by default all.
    price : float, optional
        Of a coefficient in twice the log-likelihood: 2 for Akaike, the log of the samples for Schwarz.

    most : int, optional
        Highest order to choose from, where the length of the signal allows more.

    Returns
    -------
    a : ndarray, shape (order + 1,)
        Whitening filter: ``a[0] = 1``, innovation = ``sum a[i] signal(k - i)``.
    variance : float
        Variance of the innovation.

    Notes
    -----
    Least squares on the samples with a whole past, and not the sample covariances of Yule and
    Walker: their bias leaves drift and sharp resonances in the innovation. All orders are fitted
    to the same samples, from one factorization. The model may be unstable: see `stable_model`.

    Examples
    --------
    >>> from scipy.signal import lfilter
    >>> e = np.random.default_rng(0).standard_normal(20000)
    >>> a, variance = autoregression(lfilter([1], [1, -0.8], e), order=1)
    >>> print(a.round(1), round(variance, 1))
    [ 1.  -0.8] 1.0
    """
    whole = np.ones(signal.size, dtype=bool) if known is None else known
    r = signal - (signal[whole].mean() if whole.any() else 0.0)
    longest = highest_order(int(whole.sum()))
    most = order if order is not None else longest if most is None else min(most, longest)
    n = r.size - most
    if whole.all():
        products = _products(r, most)
    else:
        judged = sliding_window_view(whole, most + 1).all(axis=1)
        rows, n = sliding_window_view(r, most + 1)[judged, ::-1], int(judged.sum())
        products = rows.T @ rows
    power = float(products[0, 0])
    if most == 0 or not 0.0 < power < np.inf:
        return np.eye(1, 1 + (order or 0))[0], power / max(n, 1)
    ridge = _RIDGE * np.trace(products) / (most + 1) * np.eye(most)
    lower = cholesky(products[1:, 1:] + ridge, lower=True)
    along = solve_triangular(lower, products[1:, 0], lower=True)
    rest = np.maximum(power - np.concatenate([[0.0], np.cumsum(along**2)]), 1e-14 * power)
    best = int(np.argmin(n * np.log(rest) + price * np.arange(rest.size))) if order is None else order
    past = solve_triangular(lower[:best, :best], along[:best], lower=True, trans="T")
    return np.concatenate([[1.0], -past]), float(rest[best]) / n


def _products(r: Array, most: int) -> Array:
    """Return the sums of r(k - i) r(k - j) over all k with a whole past.

    The shape is (most + 1, most + 1).
    """
    n, lags = r.size, np.arange(most + 1)
    products = np.empty((most + 1, most + 1))
    products[0] = [r[most:] @ r[most - lag : n - lag] for lag in lags]
    for i in range(most):  # one sample further back, one enters the sum and one leaves it
        entered, left = r[most - 1 - i] * r[most - 1 - lags[:-1]], r[n - 1 - i] * r[n - 1 - lags[:-1]]
        products[i + 1, 1:] = products[i, :-1] + entered - left
        products[i + 1, 0] = products[0, i + 1]
    return products


def stable_model(a: Array, variance: float) -> tuple[Array, float]:
    """Reflect the unstable poles of a model into the unit circle.

    The spectrum does not change. Least squares may place a pole outside the unit circle.
    """
    if a.size == 1:
        return a, variance
    roots = np.roots(a)
    outside = np.abs(roots) > 1.0
    if not outside.any():
        return a, variance
    size = np.abs(roots[outside])
    roots[outside] = 1.0 / roots[outside].conj()
    return np.real(np.poly(roots)), variance / float(np.prod(size**2))
