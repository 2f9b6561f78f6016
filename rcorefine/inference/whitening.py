"""Autoregressive noise models, and the filters that whiten by them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import ArrayLike, NDArray
from scipy import stats
from scipy.linalg.lapack import dpotrf, dtrtrs

from ..exceptions import DataError
from ..jit import compiled
from ..systems.linear import Array

#: Share of an output's standard deviation below which a residual in time is that of the arithmetic.
RESOLUTION = 1e-6
_HUBER = 1.345  # Huber's constant: 95 % efficiency for normal noise
_HEAVY = 5.0  # excess kurtosis in standard deviations, above which samples are unequally noisy


def innovations(a: Array, signal: Array) -> Array:
    """Return the innovations of a signal under a whitening filter.

    The shape is (N,) or (N, k). The signal is taken as zero before its first sample.
    """
    if a.size == 1:
        return signal
    if signal.ndim == 1:
        return np.convolve(signal, a)[: signal.size]
    left = np.zeros_like(signal)
    for j in np.flatnonzero(signal.any(axis=0)):  # columns of other windows' initial states are zero
        left[:, j] = np.convolve(signal[:, j], a)[: len(signal)]  # three times as fast as lfilter
    return left


@dataclass(frozen=True, slots=True, eq=False)
class Whitener:
    """Autoregressive filters, one per output, for residuals and regressors.

    Attributes
    ----------
    filters : tuple of ndarray
        Whitening polynomials, leading coefficient 1.
    scales : ndarray, shape (n_y,)
        Standard deviation of each innovation.
    steps : tuple of int, or None
        Where outputs have gaps: samples from one reading of each sensor to the next, on which its filter
        works. Samples that were not measured are NaN in each block.
    """

    filters: tuple[Array, ...]
    scales: Array
    steps: tuple[int, ...] | None = None

    @classmethod
    def fit(
        cls,
        residuals: Sequence[Array],
        *,
        order: int | None = None,
        most: int | None = None,
        floor: ArrayLike = 0.0,
    ) -> Whitener:
        """Filters from residuals, each of shape (n_y, N).

        Parameters
        ----------
        residuals : sequence of ndarray
            One for each record.
        order, most : int, optional
            As of `autoregression`.
        floor : float or array_like of shape (n_y,)
            Standard deviation below which an innovation is rounding.
        """
        # one model for each output, over all records
        rows, steps = readings(residuals)
        models = [autoregression(row, order=order, most=most) for row in rows]
        left = np.hypot(np.sqrt([variance for _, variance in models]), floor)
        # zero innovations (no sample counts, or the observer follows the record) are no noise level
        return cls(tuple(a for a, _ in models), left + (left == 0), steps)

    @property
    def orders(self) -> tuple[int, ...]:
        """Order of each filter, 0 for white."""
        return tuple(a.size - 1 for a in self.filters)

    def of_output(self, i: int, signal: Array) -> Array:
        """Whiten a signal (N,) or (N, k) of one output.

        The result begins at the first sample with a whole past, and has no row where nothing was measured.
        """
        a = self.filters[i]
        if self.steps is not None:
            return np.asarray(over_gaps(a, signal, self.steps[i]) / self.scales[i])
        with np.errstate(over="ignore"):  # columns of coefficients with a large unit may overflow
            return np.asarray(innovations(a, signal)[a.size - 1 :] / self.scales[i])

    def apply(self, blocks: Sequence[Array]) -> Array:
        """Whiten blocks of shape (n_y, N) or (n_y, N, k) and stack their rows.

        The first samples of each block, where the filter has no past, are left out.

        Raises
        ------
        DataError
            If that leaves none.
        """
        rows = [self.of_output(i, block[i]) for block in blocks for i in range(len(self.filters))]
        white = np.concatenate(rows, axis=0)
        if not len(white):
            raise DataError(
                f"free runs of {max(block.shape[1] for block in blocks)} samples are too short to test: the "
                "noise is correlated for longer; give a longer horizon, or a longer record"
            )
        return white

    def log_likelihood(self, residuals: Sequence[Array]) -> float:
        """Return the log-likelihood of residuals (n_y, N), up to a constant."""
        joined = np.concatenate(residuals, axis=1)
        measured = np.mean(~np.isnan(joined), axis=1)  # share of the samples
        return -len(joined[0]) * float(np.sum(measured * np.log(self.scales)))

    def outputs(self, blocks: Sequence[Array]) -> NDArray[np.intp]:
        """Output that each row of `apply` belongs to."""
        counts = [np.count_nonzero(~np.isnan(row)) for block in blocks for row in block]
        orders = self.orders * len(blocks)
        rows = np.arange(len(counts)) % len(self.orders)
        return np.repeat(rows, np.maximum(np.subtract(counts, orders), 0))


def readings(residuals: Sequence[Array]) -> tuple[list[Array], tuple[int, ...] | None]:
    """Return the readings of each output, one record after the other.

    What lies between the readings of a slow sensor is left out; a reading that is missing is NaN. The second
    value is how many samples each sensor takes for one, None where no record (n_y, N) has gaps.
    """
    joined = np.concatenate(residuals, axis=1)
    if not np.isnan(joined).any():
        return list(joined), None
    rows, steps = [], []
    for every in zip(*residuals, strict=True):
        at = [np.flatnonzero(~np.isnan(row)) for row in every]
        apart = np.concatenate([np.diff(places) for places in at])
        steps.append(int(np.gcd.reduce(apart)) or 1)
        pieces = [row[p[0] : p[-1] + 1 : steps[-1]] for row, p in zip(every, at, strict=True) if p.size]
        rows.append(np.concatenate([joined[0, :0], *pieces]))
    return rows, tuple(steps)


def white_part(a: Array, signal: Array) -> Array:
    """Return the innovations of a signal with a past, over gaps too."""
    return over_gaps(a, signal) if np.isnan(signal).any() else innovations(a, signal)[a.size - 1 :]


_UNKNOWN = 1e8  # variance of the values before the first sample, over that of the innovations


def over_gaps(a: Array, signal: Array, step: int = 1) -> Array:
    """Return the innovations of the samples that are not NaN.

    Each is that of the Kalman filter whose states are the last values (Jones, Technometrics 22 (1980) 389),
    over its standard deviation in units of the filter's.

    Parameters
    ----------
    a : ndarray, shape (order + 1,)
        Whitening filter.
    signal : ndarray, shape (N,) or (N, k)
        Signal or columns; NaN in all columns where nothing was measured.
    step : int
        Samples from one reading to the next.

    Returns
    -------
    ndarray, shape (n,) or (n, k)
        Without the first ones, which the filter needs for a past.

    Examples
    --------
    >>> signal = np.array([1.0, 2.0, np.nan, 4.0])
    >>> print(over_gaps(np.array([1.0, -0.5]), signal).round(4))  # the last: 4 - 0.25 * 2 over sqrt(1.25)
    [1.5    3.1305]
    """
    columns = signal.reshape(len(signal), -1)
    known = ~np.isnan(columns[:, 0])
    if a.size == 1:
        return signal[known]
    found = np.empty((np.count_nonzero(known), columns.shape[1]))
    at = 0
    for first in np.unique(np.flatnonzero(known) % step):
        part = known[first::step]
        _bridge(a, columns[first::step], part, _UNKNOWN * np.eye(a.size - 1), found[at:])
        at += int(np.count_nonzero(part))
    return np.asarray(found[a.size - 1 :].reshape(-1, *signal.shape[1:]))


@compiled
def _bridge(a, signal, known, P, found):  # type: ignore[no-untyped-def]
    """Filter columns (N, k) over unknown samples, into the rows of `found`."""
    b, at = a[1:], 0
    x = np.zeros((b.size, signal.shape[1]))  # the last values, the newest first
    for k in range(len(signal)):
        # prediction y = -b'x, its covariance with the last values g = -Pb, its variance s = b'Pb + 1
        g, y = -(P @ b), -(b @ x)
        s = 1.0 - b @ g
        if known[k]:
            e = signal[k] - y
            found[at], at = e / np.sqrt(s), at + 1
            x += np.outer(g, e / s)
            P -= np.outer(g, g / s)
            y, g, s = signal[k], 0.0 * g, 0.0
        # on by one sample
        x[1:], P[1:, 1:] = x[:-1].copy(), P[:-1, :-1].copy()
        x[0], P[0, 0], P[0, 1:], P[1:, 0] = y, s, g[:-1], g[:-1]


def huber_weights(residual: Array, outputs: NDArray[np.intp]) -> Array | None:
    """Return the square roots of Huber's weights, or None.

    The result is None where the samples look equally noisy.

    Parameters
    ----------
    residual : ndarray, shape (N,)
        Whitened residual.
    outputs : ndarray of int, shape (N,)
        Output that each sample belongs to; each has a scale of its own.

    Returns
    -------
    ndarray or None

    Notes
    -----
    A few large samples hide what the many others show. Weighted, both count by what they can
    say. The weights follow the size of the residual, not its sign, so they favor no column.
    """
    weights, heavy = np.ones(residual.size), False
    for i in np.unique(outputs):
        mine = outputs == i
        r = residual[mine]
        known = r[r != 0.0]  # samples without weight are exactly zero
        # robust scale: median of the absolute values
        scale = float(np.median(np.abs(known))) / stats.norm.ppf(0.75) if known.size else 0.0
        if scale <= 0.0:
            continue
        # excess kurtosis, against its standard deviation sqrt(24 / N)
        square = (known / scale) ** 2
        excess = float(np.mean(square**2) / np.mean(square) ** 2) - 3.0
        heavy = heavy or excess > _HEAVY * np.sqrt(24.0 / known.size)
        # square root of Huber's weight min(1, c / |r|)
        weights[mine] = np.sqrt(np.minimum(1.0, _HUBER * scale / np.maximum(np.abs(r), 1e-9 * scale)))
    return weights if heavy else None


MAX_ORDER = 20
_RIDGE = 1e-13  # ridge over the power of the signal, above the rounding of the sums


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
    unsure: Array | None = None,
) -> tuple[Array, float]:
    """Fit an autoregressive model to a signal.

    Akaike's criterion chooses the order, or another one by its `price`.

    Parameters
    ----------
    signal : ndarray, shape (N,)
        Signal; its mean is taken out, but for one with `unsure`. Samples that are NaN were not measured.
    order : int, optional
        Given rather than chosen, where likelihoods of several signals are compared.
    known : ndarray of bool, shape (N,), optional
        Samples that count; by default all.
    price : float, optional
        Of a coefficient in twice the log-likelihood: 2 for Akaike, the log of the samples for Schwarz.
    most : int, optional
        Highest order to choose from, where the length of the signal allows more.
    unsure : ndarray, shape (N, k), optional
        Root of the covariance matrix of the signal, where it is known only up to an error of a fit: the
        expected products count.

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
    if known is None and np.isnan(signal).any():
        return _over_gaps(signal, order, price, most, unsure)
    whole = np.ones(signal.size, dtype=bool) if known is None else known
    r = signal - (signal[whole].mean() if whole.any() and unsure is None else 0.0)
    longest = highest_order(int(whole.sum()))
    most = order if order is not None else longest if most is None else min(most, longest)
    products, n = _sums(r, unsure, whole, most)
    power = float(products[0, 0])
    if most == 0 or not 0.0 < power < np.inf:
        return np.eye(1, 1 + (order or 0))[0], power / max(n, 1)
    # Cholesky factorization: least squares of all orders at once
    ridge = _RIDGE * np.trace(products) / (most + 1) * np.eye(most)
    lower, failed = dpotrf(products[1:, 1:] + ridge, lower=True, clean=True)
    if failed:
        raise np.linalg.LinAlgError("the lagged samples of the signal are linearly dependent")
    along, _ = dtrtrs(lower, products[1:, 0], lower=True)
    # residual power of each order
    rest = np.maximum(power - np.concatenate([[0.0], np.cumsum(along**2)]), 1e-14 * power)
    # information criterion: log-likelihood and price of the coefficients
    best = int(np.argmin(n * np.log(rest) + price * np.arange(rest.size))) if order is None else order
    # coefficients of the chosen order
    past = dtrtrs(lower[:best, :best], along[:best], lower=True, trans=True)[0] if best else along[:0]
    return np.concatenate([[1.0], -past]), float(rest[best]) / n


def _over_gaps(
    signal: Array, order: int | None, price: float, most: int | None, unsure: Array | None
) -> tuple[Array, float]:
    """Fit an autoregressive model to a signal with gaps, as `autoregression`."""
    whole = ~np.isnan(signal)
    if order is None:
        # largest order for which enough samples have a whole past, then that of the criterion
        orders = range(highest_order(int(whole.sum())), 0, -1)
        longest = next((p for p in orders if highest_order(int(_complete(whole, p).sum())) >= p), 0)
        most = longest if most is None else min(most, longest)
        order = autoregression(signal, known=whole, price=price, most=most, unsure=unsure)[0].size - 1
    a, _ = autoregression(signal, order=order, known=whole, unsure=unsure)
    # the innovations over the gaps count for the variance, too
    r = signal - (signal[whole].mean() if unsure is None and whole.any() else 0.0)
    white = over_gaps(a, np.column_stack([r] if unsure is None else [r, unsure]))
    return a, float(np.sum(white**2)) / max(len(white), 1)


def _sums(r: Array, unsure: Array | None, whole: NDArray[np.bool_], most: int) -> tuple[Array, int]:
    """Return the sums of products of lagged samples, and how many there are.

    The shape is (most + 1, most + 1).
    """
    every = [r] if unsure is None else [r, *unsure.T]
    if whole.all():
        return np.sum([_products(column, most) for column in every], axis=0), r.size - most
    complete = _complete(whole, most)
    rows = [sliding_window_view(column, most + 1)[complete, ::-1] for column in every]
    return np.sum([row.T @ row for row in rows], axis=0), int(complete.sum())


def _complete(whole: NDArray[np.bool_], order: int) -> NDArray[np.bool_]:
    """Return which samples are known with all of their past."""
    return np.asarray(sliding_window_view(whole, order + 1).all(axis=1))


def _products(r: Array, most: int) -> Array:
    """Return the sums of r(k - i) r(k - j) over all k with a whole past.

    The shape is (most + 1, most + 1).
    """
    n = r.size
    products = np.empty((most + 1, most + 1))
    products[0] = products[:, 0] = np.correlate(r, r[most:])[::-1]
    # shift by one sample: one product enters the sum, one leaves it
    first, last = r[:most][::-1], r[n - most :][::-1]
    entered, left = np.outer(first, first), np.outer(last, last)
    for i in range(most):
        products[i + 1, 1:] = products[i, :-1] + entered[i] - left[i]
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
