"""Whitened residuals, and tests of columns against them that need no equal variances."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import stats

from ..exceptions import DataError
from ..systems.linear import Array
from .autoregression import autoregression

__all__ = [
    "FTest",
    "Whitener",
    "f_test",
    "huber_weights",
    "in_own_units",
    "innovations",
    "project",
    "projected_test",
    "rank_basis",
    "unequal_variances",
    "whitened",
]

_RANK = 3e-7  # singular value, relative, below which a direction is none
_HUBER = 1.345  # times the standard deviation; of normal noise 95 % of the efficiency is kept
_HEAVY = 5.0  # excess kurtosis, in its standard deviations, from which samples count as unequally noisy


def innovations(a: Array, signal: Array) -> Array:
    """What a filter leaves of a signal, shape (N,) or (N, k), that was zero before its first sample."""
    if a.size == 1:
        return signal
    if signal.ndim == 1:
        return np.convolve(signal, a)[: signal.size]
    left = np.zeros_like(signal)
    for j in np.flatnonzero(signal.any(axis=0)):  # an initial state is felt in its own window only
        left[:, j] = np.convolve(signal[:, j], a)[: len(signal)]  # a third of lfilter's time in windows
    return left


def whitened(signal: Array) -> Array:
    """Innovations of a signal (N,) under its own model, mean taken out, from where the past is whole."""
    a, _ = autoregression(signal)
    return innovations(a, signal - signal.mean())[a.size - 1 :]


@dataclass(frozen=True, slots=True, eq=False)
class Whitener:
    """One autoregressive filter per output, common to residuals and regressors.

    Attributes
    ----------
    filters : tuple of ndarray
        Whitening polynomials, leading coefficient 1.
    scales : ndarray, shape (n_y,)
        Standard deviation of each innovation.
    """

    filters: tuple[Array, ...]
    scales: Array

    @classmethod
    def fit(cls, residuals: Sequence[Array], *, order: int | None = None, floor: float = 0.0) -> Whitener:
        """Filters from residuals, each of shape (n_y, N).

        Parameters
        ----------
        residuals : sequence of ndarray
            One for each record.
        order : int, optional
            As of `autoregression`.
        floor : float
            Standard deviation below which an innovation is rounding.
        """
        models = [autoregression(row, order=order) for row in np.concatenate(residuals, axis=1)]
        scales = np.sqrt([variance + floor**2 for _, variance in models])
        return cls(tuple(a for a, _ in models), np.where(scales > 0, scales, 1.0))

    @property
    def orders(self) -> tuple[int, ...]:
        """Order of each filter, 0 for white."""
        return tuple(a.size - 1 for a in self.filters)

    def apply(self, blocks: Sequence[Array]) -> Array:
        """Whiten blocks of shape (n_y, N) or (n_y, N, k) and stack their rows.

        The first samples of each block, where the filter has no past, are left out.

        Raises
        ------
        DataError
            If that leaves none.
        """
        rows = []
        for block in blocks:
            for i, a in enumerate(self.filters):
                with np.errstate(over="ignore"):  # the column of an enormous unit is as enormous
                    rows.append(innovations(a, block[i])[a.size - 1 :] / self.scales[i])
        white = np.concatenate(rows, axis=0)
        if not len(white):
            raise DataError(
                f"free runs of {max(block.shape[1] for block in blocks)} samples are too short to test: the "
                "noise is correlated for longer; give a longer horizon, or a longer record"
            )
        return white

    def log_likelihood(self, n_samples: int) -> float:
        """Of so many samples of the residual that it was fitted to, up to a constant."""
        return -n_samples * float(np.sum(np.log(self.scales)))

    def outputs(self, blocks: Sequence[Array]) -> NDArray[np.intp]:
        """Output that each row of `apply` belongs to."""
        orders = self.orders
        return np.concatenate([np.full(b.shape[1] - p, i) for b in blocks for i, p in enumerate(orders)])


@dataclass(frozen=True, slots=True)
class FTest:
    """Whether a set of columns explains more of the residual than chance.

    Attributes
    ----------
    name : str
        What was tested.
    statistic : float
        F statistic, all samples taken as equally noisy.
    dof : int
        Columns that count.
    p_value : float
        Probability of such a gain if nothing is missing, whether the samples are equally
        noisy or not: the larger one of the F-test and of Box's. Where the samples are not, twice
        the smaller one of that and of the same with Huber's weights.
    gain : float
        Sum of squares that the columns take away.
    p_equal : float
        Of the F-test alone: right if all samples are equally noisy. Far below `p_value`, few
        samples carry it, and whether they are fault or noise another record must tell.
    """

    name: str
    statistic: float
    dof: int
    p_value: float
    gain: float
    p_equal: float


def huber_weights(residual: Array, outputs: NDArray[np.intp]) -> Array | None:
    """Square roots of Huber's weights, or None where the samples look equally noisy.

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
        known = r[r != 0.0]  # a sample that is not judged is exactly zero
        scale = float(np.median(np.abs(known))) / stats.norm.ppf(0.75) if known.size else 0.0
        if scale <= 0.0:
            continue
        square = (known / scale) ** 2
        excess = float(np.mean(square**2) / np.mean(square) ** 2) - 3.0
        heavy = heavy or excess > _HEAVY * np.sqrt(24.0 / known.size)
        weights[mine] = np.sqrt(np.minimum(1.0, _HUBER * scale / np.maximum(np.abs(r), 1e-9 * scale)))
    return weights if heavy else None


def rank_basis(columns: Array) -> Array:
    """Orthonormal basis of the span of columns, near-dependent ones left out."""
    if columns.shape[1] == 0:
        return columns
    size = np.linalg.norm(columns, axis=0)
    columns = columns[:, size > 1e-12 * max(float(size.max()), 1e-300)]
    if columns.shape[1] == 0:
        return columns
    columns = columns / np.linalg.norm(columns, axis=0)
    values, vectors = np.linalg.eigh(columns.T @ columns)
    keep = values > _RANK**2 * values[-1]
    basis = columns @ (vectors[:, keep] / np.sqrt(values[keep]))
    # once more: the small directions come out of the Gram matrix only nearly orthogonal
    lower = np.linalg.cholesky(basis.T @ basis)
    return np.asarray(np.linalg.solve(lower, basis.T).T)


def project(values: Array, basis: Array) -> Array:
    """What is left of values after the span of an orthonormal basis is taken out."""
    return np.asarray(values - basis @ (basis.T @ values))


def in_own_units(columns: Array) -> Array:
    """Columns with 1 as their largest entry; zero where the response diverges, which tests nothing.

    What nearly diverges has squares beyond every number.
    """
    largest = np.abs(columns).max(axis=0, initial=0.0)
    finite = np.isfinite(largest)
    return np.where(finite, columns, 0.0) / np.where(finite & (largest > 0.0), largest, 1.0)


def f_test(name: str, residual: Array, columns: Array, basis: Array) -> FTest:
    """Test of columns on a whitened residual.

    Parameters
    ----------
    name : str
        What is tested.
    residual : ndarray, shape (N,)
        Whitened residual, the basis already projected off.
    columns : ndarray, shape (N, k)
        Whitened columns.
    basis : ndarray, shape (N, b)
        Orthonormal basis of what was fitted already; projected off the columns.

    Returns
    -------
    FTest
        p_value 1 where the columns lie in what was fitted.
    """
    columns = in_own_units(columns)
    return projected_test(name, residual, project(columns, basis), np.linalg.norm(columns, axis=0), basis)


def projected_test(name: str, residual: Array, left: Array, size: Array, basis: Array) -> FTest:
    """As `f_test`, of columns off which the basis was projected already; `size` is their norm before."""
    norms = np.linalg.norm(left, axis=0)
    keep = norms > 1e-6 * np.maximum(size, 1e-300)
    c = left[:, keep] / norms[keep]  # columns come in units of their own
    q = c if c.shape[1] == 1 else rank_basis(c)
    k = q.shape[1]
    free = residual.size - basis.shape[1] - k
    if k == 0 or free < 10:
        return FTest(name, 0.0, 0, 1.0, 0.0, 1.0)
    along = q.T @ residual
    gain = float(along @ along)
    rest = max(float(residual @ residual) - gain, 1e-300)
    statistic = gain / k / (rest / free)
    p_equal = float(stats.f.sf(statistic, k, free))
    p_value = max(p_equal, unequal_variances(gain, q, residual, basis))
    return FTest(name, float(statistic), k, p_value, gain, p_equal)


def unequal_variances(gain: float, q: Array, residual: Array, basis: Array) -> float:
    """Probability of a gain by chance where each sample may have a noise level of its own.

    Noise in proportion to the reading, bursts, spikes or dropouts are no fault of the
    model, but columns that are large where the noise is large take much of it away.

    Parameters
    ----------
    gain : float
        Sum of squares of the residual along q.
    q : ndarray, shape (N, k)
        Orthonormal columns, orthogonal to the basis.
    residual : ndarray, shape (N,)
        Residual, the basis projected off.
    basis : ndarray, shape (N, b)
        Orthonormal basis of what was fitted.

    Returns
    -------
    float

    Notes
    -----
    Box's approximation: the gain is distributed as ``tr(M) / nu`` times chi-squared of
    ``nu = tr(M)^2 / tr(M^2)`` degrees of freedom, M the covariance of ``q' residual``. M is
    estimated by the jackknife (HC3 of MacKinnon and White), and counts as a sum of squares
    weighted as q weighs the samples. What q explains is taken out of the residual for that,
    or a large fault would pass as noise on the few samples on which it acts.

    References
    ----------
    Box, G. E. P., Ann. Math. Statist. 25 (1954) 290; MacKinnon and White, J. Econometrics
    29 (1985) 305.
    """
    weight = np.einsum("ij,ij->i", q, q)
    free = np.maximum(1.0 - weight - np.einsum("ij,ij->i", basis, basis), 1e-9)
    scaled = q * (project(residual, q) / free)[:, None]
    covariance = scaled.T @ scaled
    total = float(np.trace(covariance))
    if total <= 0.0:
        return 1.0 if gain <= 0.0 else 0.0
    dof = total**2 / float(np.sum(covariance**2))
    return float(stats.f.sf(gain / total, dof, weight.sum() ** 2 / np.sum(weight**2)))
