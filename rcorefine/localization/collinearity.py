"""Which candidates the record can tell apart: correlation of their sensitivities."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ..inference.covariance import pseudo_inverse
from ..inference.levels import levels
from ..systems.linear import Array
from .estimate import Joint

__all__ = ["collinear_groups", "similarity"]

_MEMBER = 0.3  # share of such a direction above which a candidate belongs to it


def _projected(joint: Joint, where: NDArray[np.int64]) -> Array:
    """Information of the candidates, offsets, damping ratio and initial states projected off."""
    normal = joint.information().normal
    rest = np.setdiff1d(np.arange(normal.shape[0]), where)
    inner = normal[np.ix_(where, where)]
    if rest.size:
        inverse, _, _ = pseudo_inverse(normal[np.ix_(rest, rest)])
        cross = normal[np.ix_(rest, where)]
        inner = inner - cross.T @ inverse @ cross
    size = np.sqrt(np.maximum(np.diag(inner), 0.0))
    size[size <= 1e-9 * np.sqrt(np.diag(normal)[where])] = np.inf
    unit = inner / np.outer(size, size)
    np.fill_diagonal(unit, np.where(np.isfinite(size), 1.0, 0.0))
    return np.asarray(unit)


def similarity(joint: Joint, where: NDArray[np.int64]) -> Array:
    """How alike the candidates' sensitivities are, 0 to 1, shape (m, m)."""
    return np.asarray(np.abs(_projected(joint, where)))


def collinear_groups(
    joint: Joint, where: NDArray[np.int64], blurred: NDArray[np.bool_]
) -> tuple[tuple[int, ...], ...]:
    """Candidates that the record sees only together.

    Parameters
    ----------
    joint : Joint
        Estimate.
    where : ndarray of int
        Columns of the candidates.
    blurred : ndarray of bool
        Candidates that the joint estimate leaves too unsure to matter on their own.

    Returns
    -------
    tuple of tuple of int
        Groups of two or more.
    """
    unit = _projected(joint, where)
    seen = np.flatnonzero(np.diag(unit) > 0)
    values, vectors = np.linalg.eigh(unit[np.ix_(seen, seen)])
    owner = list(range(where.size))
    for value, vector in zip(values, vectors.T, strict=True):
        if value >= levels().collinear:
            break
        members = [int(seen[k]) for k in np.flatnonzero(np.abs(vector) > _MEMBER * np.abs(vector).max())]
        members = [i for i in members if blurred[i]]
        if len(members) < 2:
            continue
        target = min(owner[i] for i in members)
        merged = {owner[i] for i in members}
        owner = [target if group in merged else group for group in owner]
    groups = [tuple(i for i in range(where.size) if owner[i] == k) for k in sorted(set(owner))]
    return tuple(group for group in groups if len(group) > 1)
