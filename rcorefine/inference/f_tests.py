"""Projections, and F-tests that allow unequal variances."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy import stats
from scipy.linalg import solve_triangular

from ..results import Row
from ..systems.linear import Array

_INSIDE = 1e-6  # share of a column, or sine of an angle, below which it lies in the span of the fit
_FEWEST = 10  # least degrees of freedom that remain


@dataclass(frozen=True, slots=True)
class FTest(Row):
    """Result of an F-test of additional columns (regressors).

    The test asks whether the columns explain more of the residual than chance would.

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


def f_test(name: str, residual: Array, columns: Array, basis: Basis | Array) -> FTest:
    """Test of columns on a whitened residual.

    Parameters
    ----------
    name : str
        What is tested.
    residual : ndarray, shape (N,)
        Whitened residual, the basis already projected off.
    columns : ndarray, shape (N, k)
        Whitened columns.
    basis : Basis or ndarray of shape (N, b)
        Orthonormal basis of what was fitted already; projected off the columns.

    Returns
    -------
    FTest
        p_value 1 where the columns lie in what was fitted.
    """
    columns = in_own_units(columns)
    return projected_test(name, residual, project(columns, basis), lengths(columns), basis)


def projected_test(name: str, residual: Array, left: Array, size: Array, basis: Basis | Array) -> FTest:
    """Run `f_test` on columns that are already orthogonal to the basis.

    `left` holds the projected columns, `size` their norms before the projection.
    """
    # columns inside the span of the basis cannot explain more
    keep = lengths(left) > _INSIDE * np.maximum(size, 1e-300)
    q = rank_basis(left if keep.all() else left[:, keep])
    k, basis = q.shape[1], as_basis(basis)
    if k == 0 or residual.size - basis.rank - k < _FEWEST:
        return _empty_test(name)
    # gain: squared length of the residual along the new directions
    along = q.T @ residual
    gain = float(along @ along)
    return _test_gain(name, residual, k, basis, gain, unequal_variances(gain, q, residual, basis))


def _empty_test(name: str) -> FTest:
    return FTest(name, 0.0, 0, 1.0, 0.0, 1.0)


def _test_gain(name: str, residual: Array, k: int, basis: Basis, gain: float, unequal: float) -> FTest:
    """Return the test of k directions from the gain that they achieve.

    `unequal` is the p-value for unequal variances.
    """
    free = residual.size - basis.rank - k
    rest = max(float(residual @ residual) - gain, 1e-300)
    # F = (gain / k) / (rest / degrees of freedom)
    statistic = gain / k / (rest / free)
    p_equal = float(stats.f.sf(statistic, k, free))
    return FTest(name, float(statistic), k, max(p_equal, unequal), gain, p_equal)


def apart_test(
    name: str, residual: Array, parts: Sequence[tuple[NDArray[np.intp], Array]], basis: Basis | Array
) -> FTest:
    """Run `f_test` on columns that each belong to one output.

    The columns of an output are zero in the rows of the others.

    Parameters
    ----------
    name : str
        What is tested.
    residual : ndarray, shape (N,)
        Whitened residual, the basis already projected off.
    parts : sequence of (ndarray of int, ndarray)
        Rows of an output, and its columns there; no row twice.
    basis : Basis or ndarray of shape (N, b)
        Of what was fitted already.

    Returns
    -------
    FTest

    Notes
    -----
    What the columns add to the basis is the span of both less that of the basis, and the span of both is
    that of the columns and of what they leave of the basis. Columns of one output stay among themselves
    in that: the cost grows with the number of outputs, where that of all columns on all rows grows with
    its cube.
    """
    basis = as_basis(basis)
    if len(parts) == 1 or basis.own:
        return f_test(name, residual, _join_columns(parts, residual.size), basis)
    # orthonormal columns of each output
    columns = [(rows, rank_basis(in_own_units(part))) for rows, part in parts]
    columns = [(rows, part) for rows, part in columns if part.shape[1]]
    if not columns:
        return _empty_test(name)
    common = basis.common
    inside = np.hstack([common[rows].T @ part for rows, part in columns])  # (b, K)
    # Gram matrix of the columns without their part in the basis
    values, vectors = np.linalg.eigh(np.eye(inside.shape[1]) - inside.T @ inside)
    new = values > _INSIDE**2
    k = int(new.sum())
    if k == 0 or residual.size - basis.rank - k < _FEWEST:
        return _empty_test(name)
    # residual along the new directions, and the part of it that they explain
    along = vectors[:, new].T @ np.concatenate([part.T @ residual[rows] for rows, part in columns])
    gain = float(np.sum(along**2 / values[new]))
    taken = vectors[:, new] @ (along / values[new])
    explained = -common @ (inside @ taken)
    # what the columns leave of the basis; the explained part, row by row
    beyond, at = common.copy(), 0
    for rows, part in columns:
        mine = slice(at, at + part.shape[1])
        explained[rows] += part @ taken[mine]
        beyond[rows] -= part @ inside[:, mine].T
        at = mine.stop
    unequal = _apart_variances(gain, columns, _complement(beyond, inside), basis, residual, explained)
    return _test_gain(name, residual, k, basis, gain, unequal)


def _complement(beyond: Array, inside: Array) -> Array:
    """Return an orthonormal basis of a basis outside a span of columns.

    `beyond` is what the columns leave of the basis; `inside` holds its inner products with the columns.
    """
    values, vectors = np.linalg.eigh(np.eye(len(inside)) - inside @ inside.T)
    kept = values > _INSIDE**2
    return np.asarray(beyond @ (vectors[:, kept] / np.sqrt(values[kept])))


def _apart_variances(
    gain: float,
    columns: Sequence[tuple[NDArray[np.intp], Array]],
    beyond: Array,
    basis: Basis,
    residual: Array,
    explained: Array,
) -> float:
    """Return the p-value of `apart_test` for unequal variances.

    It is `unequal_variances` for the span of the columns and `beyond`, without the span of the basis.
    """
    # leverage of each row: share of the new directions
    weight = np.einsum("ij,ij->i", beyond, beyond) - basis.leverage
    for rows, part in columns:
        weight[rows] += np.einsum("ij,ij->i", part, part)
    weight = np.maximum(weight, 0.0)
    # jackknife: residual over one less its leverage
    free = np.maximum(1.0 - weight - basis.leverage, 1e-9)
    square = ((residual - explained) / free) ** 2
    # trace of the square of D P D, P = S S' + T T' - Q Q' the projection, D what is left of each row
    both = np.hstack([beyond, basis.common])
    sign = np.repeat([1.0, -1.0], [beyond.shape[1], basis.common.shape[1]])
    inner = both.T @ (square[:, None] * both)
    size = float(sign @ inner**2 @ sign)
    for rows, part in columns:
        weighted = square[rows, None] * part
        size += float(np.sum((part.T @ weighted) ** 2))
        size += 2.0 * float(np.sum((both[rows].T @ weighted) ** 2, axis=1) @ sign)
    return _by_box(gain, float(square @ weight), size, weight)


def _by_box(gain: float, total: float, size: float, weight: Array) -> float:
    """Return the p-value of a gain by Box's approximation.

    `total` is the trace of the covariance matrix, `size` the trace of its square.
    """
    if total <= 0.0:
        return 1.0 if gain <= 0.0 else 0.0
    # degrees of freedom of Box: tr(M)^2 / tr(M^2)
    dof = total**2 / size
    return float(stats.f.sf(gain / total, dof, weight.sum() ** 2 / np.sum(weight**2)))


def _join_columns(parts: Sequence[tuple[NDArray[np.intp], Array]], count: int) -> Array:
    """Columns that have rows of their own as columns (N, K) of all rows."""
    whole, at = np.zeros((count, sum(part.shape[1] for _, part in parts))), 0
    for rows, part in parts:
        whole[rows, at : at + part.shape[1]] = part
        at += part.shape[1]
    return whole


def unequal_variances(gain: float, q: Array, residual: Array, basis: Basis | Array) -> float:
    """Return the p-value of a gain if the noise level differs by sample.

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
    basis : Basis or ndarray of shape (N, b)
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
    # leverage of each sample in q, and what the fit leaves of it
    weight = np.einsum("ij,ij->i", q, q)
    free = np.maximum(1.0 - weight - as_basis(basis).leverage, 1e-9)
    # HC3 covariance of q' residual
    scaled = q * (project(residual, q) / free)[:, None]
    covariance = scaled.T @ scaled
    return _by_box(gain, float(np.trace(covariance)), float(np.sum(covariance**2)), weight)


_RANK = 3e-7  # relative singular value below which a direction does not count
_SURE = 1e-6  # relative eigenvalue of the Gram matrix above which its directions are orthogonal


@dataclass(frozen=True, eq=False)
class Basis:
    """Orthonormal directions in the rows of all records.

    Attributes
    ----------
    common : ndarray, shape (N, c)
        Those that all records feel.
    own : tuple of (slice, ndarray)
        Rows of a record, and the directions that it feels alone: time and room grow with the number of
        records, not with its square.
    more : int
        Degrees of freedom that were used besides, such as those of a noise filter.
    """

    common: Array
    own: tuple[tuple[slice, Array], ...] = ()
    more: int = 0

    @classmethod
    def of(cls, common: Sequence[Array], own: Sequence[Array]) -> Basis:
        """Return the basis of columns that are given by record.

        `common` holds the columns (rows, c) common to all records, `own` the columns (rows, k) of one record.
        """
        if len(common) == 1:
            return cls(rank_basis(np.hstack([common[0], own[0]])))
        # rows of each record; its own directions first, then the common ones outside of these
        ends = np.cumsum([len(rows) for rows in common])
        places = [slice(int(end) - len(rows), int(end)) for end, rows in zip(ends, common, strict=True)]
        separate = tuple((at, rank_basis(columns)) for at, columns in zip(places, own, strict=True))
        whole = np.concatenate(common)
        return cls(rank_basis(project(whole, cls(whole[:, :0], separate)), lengths(whole)), separate)

    @property
    def rank(self) -> int:
        """Number of degrees of freedom that were used."""
        return int(self.common.shape[1] + sum(q.shape[1] for _, q in self.own)) + self.more

    @cached_property
    def leverage(self) -> Array:
        """Square of what each row has of the directions, shape (N,)."""
        found = np.einsum("ij,ij->i", self.common, self.common)
        for at, q in self.own:
            found[at] += np.einsum("ij,ij->i", q, q)
        return np.asarray(found)

    def weighted(self, weights: Array, more: Array) -> Basis:
        """Return the basis of the weighted directions and more columns.

        The additional columns have shape (N, m). Each row is multiplied by its weight, shape (N,).
        """
        common = weights[:, None] * np.hstack([self.common, more])
        if not self.own:
            return Basis(rank_basis(common), more=self.more)
        found = Basis.of(
            [common[at] for at, _ in self.own],
            [weights[at, None] * directions for at, directions in self.own],
        )
        return replace(found, more=self.more)


def as_basis(basis: Basis | Array) -> Basis:
    """Orthonormal columns as a basis."""
    return basis if isinstance(basis, Basis) else Basis(basis)


def rank_basis(columns: Array, sizes: Array | None = None) -> Array:
    """Orthonormal basis of the span of columns, near-dependent ones left out.

    Parameters
    ----------
    columns : ndarray, shape (N, k)
        Columns.
    sizes : ndarray, shape (k,), optional
        What counts as one in each; by default its own norm.
    """
    if columns.shape[1] == 0:
        return columns
    with np.errstate(over="ignore"):
        gram = columns.T @ columns
    if not np.isfinite(gram).all():
        return rank_basis(in_own_units(columns))
    own = np.sqrt(np.diag(gram))
    sizes = own if sizes is None else sizes
    # columns that are zero or depend on the basis count as none
    kept = np.flatnonzero((own > 1e-12 * max(float(own.max()), 1e-300)) & (own > _RANK * sizes))
    if not kept.size:
        return columns[:, :0]
    sizes = sizes[kept]
    # eigenvectors of the Gram matrix of columns of unit size
    values, vectors = np.linalg.eigh(gram[np.ix_(kept, kept)] / np.outer(sizes, sizes))
    top = max(float(values[-1]), 1.0)  # smaller where the columns are nearly in the basis
    seen = values > _RANK**2 * top
    if not seen.any():
        return columns[:, :0]
    turn = np.zeros((columns.shape[1], int(seen.sum())))
    # orthonormal basis from the directions with nonzero eigenvalues
    turn[kept] = vectors[:, seen] / np.sqrt(values[seen]) / sizes[:, None]
    basis = columns @ turn
    if values[seen][0] < _SURE * top:
        # orthogonalize again: small directions of the Gram matrix are only nearly orthogonal
        lower = np.linalg.cholesky(basis.T @ basis)
        basis = basis @ solve_triangular(lower, np.eye(len(lower)), lower=True).T
    return np.asarray(basis)


def project(values: Array, basis: Basis | Array) -> Array:
    """Remove the span of an orthonormal basis from values."""
    basis = as_basis(basis)
    left = np.array(values)
    for at, q in basis.own:
        left[at] -= q @ (q.T @ left[at])
    left -= basis.common @ (basis.common.T @ left)
    return left


def lengths(columns: Array) -> Array:
    """Norm of each column."""
    with np.errstate(over="ignore"):
        return np.asarray(np.sqrt(np.einsum("ij,ij->j", columns, columns)))


def in_own_units(columns: Array) -> Array:
    """Scale columns to a largest entry of 1.

    A column whose response diverges is set to zero, because it cannot test anything.

    The squares of a response that nearly diverges would overflow.
    """
    largest = np.maximum(columns.max(axis=0, initial=0.0), -columns.min(axis=0, initial=0.0))
    finite = np.isfinite(largest)
    if not finite.all():
        columns = np.where(finite, columns, 0.0)
    return np.asarray(columns / np.where(finite & (largest > 0.0), largest, 1.0))
