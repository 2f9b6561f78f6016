"""Orthonormal bases of the fitted regressors.

Some directions belong to one record only, the others are common to all records.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.linalg import solve_triangular

from ..systems.linear import Array

_RANK = 3e-7  # singular value, relative, below which a direction is none
_SURE = 1e-6  # eigenvalue of the Gram matrix, relative, above which its directions are orthogonal at once


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
    """

    common: Array
    own: tuple[tuple[slice, Array], ...] = ()

    @classmethod
    def of(cls, common: Sequence[Array], own: Sequence[Array]) -> Basis:
        """Return the basis of columns that are given by record.

        `common` holds the columns (rows, c) common to all records, `own` the columns (rows, k) of one record.
        """
        if len(common) == 1:
            return cls(rank_basis(np.hstack([common[0], own[0]])))
        ends = np.cumsum([len(rows) for rows in common])
        places = [slice(int(end) - len(rows), int(end)) for end, rows in zip(ends, common, strict=True)]
        alone = tuple((at, rank_basis(columns)) for at, columns in zip(places, own, strict=True))
        whole = np.concatenate(common)
        return cls(rank_basis(project(whole, cls(whole[:, :0], alone)), lengths(whole)), alone)

    @property
    def rank(self) -> int:
        """Number of directions."""
        return int(self.common.shape[1] + sum(q.shape[1] for _, q in self.own))

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
            return Basis(rank_basis(common))
        return Basis.of(
            [common[at] for at, _ in self.own],
            [weights[at, None] * directions for at, directions in self.own],
        )


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
    kept = np.flatnonzero((own > 1e-12 * max(float(own.max()), 1e-300)) & (own > _RANK * sizes))
    if not kept.size:
        return columns[:, :0]
    sizes = sizes[kept]
    values, vectors = np.linalg.eigh(gram[np.ix_(kept, kept)] / np.outer(sizes, sizes))
    top = max(float(values[-1]), 1.0)  # less where hardly anything is left of what counted as one
    seen = values > _RANK**2 * top
    if not seen.any():
        return columns[:, :0]
    turn = np.zeros((columns.shape[1], int(seen.sum())))
    turn[kept] = vectors[:, seen] / np.sqrt(values[seen]) / sizes[:, None]
    basis = columns @ turn
    if values[seen][0] < _SURE * top:
        # once more: the small directions come out of the Gram matrix only nearly orthogonal
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
