"""Coupled mass matrix from the symmetry of stiffness and damping."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ..systems.balance import balance
from ..systems.linear import Array

__all__ = ["coupled_inverse"]

_LEFT = (1e-7, 2e-3)  # relative size of what is left of an equation: by arithmetic, by entries of four digits
_SINGULAR = 1e-6  # smallest eigenvalue of a mass matrix with ones on its diagonal


def coupled_inverse(K: Array, C: Array, B: Array, without: int) -> tuple[Array, int, int] | None:
    """Return the inverse W of a mass matrix that couples coordinates.

    Examples are a cart with its pendulum, and a beam.

    Parameters
    ----------
    K, C : ndarray of shape (n, n)
        Accelerations by displacements and by velocities, W times minus stiffness and damping.
    B : ndarray of shape (n, n_w)
        Accelerations by inputs.
    without : int
        Numbers that the model consists of where no inertia is shared.

    Returns
    -------
    inverse : ndarray of shape (n, n)
        Symmetric and positive definite; if an input acts at a single coordinate, that column of `inverse`
        is the input's column of `B`, otherwise the first entry is one.
    coordinate, column : int
        Of that input; -1 if there is none.
    None
        If no such matrix makes stiffness and damping symmetric, if more than one does with as few numbers,
        or if it saves none.

    Notes
    -----
    K W and C W are symmetric exactly if W^-1 K and W^-1 C are: linear equations in W. What they leave open
    (an undamped structure: all W p(K')) an input settles that is a force at one of the coordinates.
    Neither proves a mass matrix, for as many free numbers would fit as well: fewer do.
    """
    n = len(K)
    if n < 2:
        return None
    # units of the coordinates in which the couplings are of one size
    d = balance(np.abs(K) + np.sqrt(np.abs(K).max(initial=0.0)) * np.abs(C))
    K, C, B = K * d / d[:, None], C * d / d[:, None], B / d[:, None]
    basis = np.array([_unit(n, i, j) for i in range(n) for j in range(i, n)])
    rows = np.vstack([_asymmetries(X, basis) for X in (K, C)])
    for tolerance in _LEFT:
        open_ = np.tensordot(_null(rows, tolerance).T, basis, axes=1)
        found = _candidates(open_, B, tolerance if len(open_) > 1 else _LEFT[-1])
        if not found and len(open_) == 1 and (W := _definite(open_[0])) is not None:
            found = [(W, -1, -1)]
        if found:
            break
    counts = [_numbers(K, C, B, W) for W, *_ in found]
    fewest = min(counts, default=(without, 1))
    found = [item for item, count in zip(found, counts, strict=True) if count == fewest]
    one = all(np.abs(other[0] - found[0][0]).max() <= 10 * tolerance for other in found)
    if not one or fewest >= (without, 1):
        return None
    W, i, j = found[0]
    size = B[i, j] / (W[i, i] * d[i]) if i >= 0 else 1.0 / (W[0, 0] * d[0] ** 2)
    return abs(size) * W * d * d[:, None], i, j


def _candidates(open_: Array, B: Array, tolerance: float) -> list[tuple[Array, int, int]]:
    """Return possible inverse mass matrices, each with an input.

    They belong to the family `open_`, and the input acts at a single coordinate, which is returned as
    well.
    """
    found = []
    for j, b in enumerate(B.T):
        size = np.linalg.norm(b)
        for i in range(len(b)) if size else ():
            across = np.eye(len(b)) - np.outer(b, b) / size**2
            left = _null(across @ open_[:, :, i].T, tolerance)
            W = _definite(np.tensordot(left[:, 0], open_, axes=1)) if left.shape[1] == 1 else None
            if W is not None:
                found.append((W, i, j))
    return found


def _null(rows: Array, tolerance: float) -> Array:
    """Directions that rows of size one say nothing about."""
    _, s, right = np.linalg.svd(rows)
    rank = int(np.count_nonzero(s > tolerance))
    return np.asarray(right[rank:].T)


def _unit(n: int, i: int, j: int) -> Array:
    W = np.zeros((n, n))
    W[i, j] = W[j, i] = 1.0
    return W


def _asymmetries(X: Array, basis: Array) -> Array:
    """Return the equations that make X W symmetric.

    There is one equation per pair of coordinates. Empty equations are left out.
    """
    products = X @ basis
    upper = np.triu_indices(len(X), 1)
    rows = (products - products.transpose(0, 2, 1))[:, upper[0], upper[1]].T
    size = np.linalg.norm(rows, axis=1)
    told = size > 1e-9 * size.max(initial=0.0)
    return np.asarray(rows[told] / size[told, None])


def _numbers(K: Array, C: Array, B: Array, W: Array) -> tuple[int, int]:
    """Count the numbers in masses, stiffness, damping and inputs.

    The second value is 1 if stiffness or damping couples coordinates.
    """
    M: Array = np.asarray(np.linalg.inv(W), dtype=np.float64)
    size = np.sqrt(np.diag(M))

    def told(X: Array, across: Array | float) -> NDArray[np.bool_]:
        X = np.asarray(np.abs(X) / size[:, None] / across)
        return np.asarray(X > _LEFT[-1] * X.max(initial=1e-300))

    mass, spring, damper, force = told(M, size), told(M @ K, size), told(M @ C, size), told(M @ B, 1.0)
    count = sum(np.count_nonzero(np.triu(X)) for X in (mass, spring, damper)) + np.count_nonzero(force)
    return int(count) - 1, int(np.triu(spring | damper, 1).any())  # one is the unit of the masses


def _definite(W: Array) -> Array | None:
    """A matrix of unit size that is positive definite, else None."""
    W = W * np.sign(np.trace(W)) / np.abs(W).max()
    if (np.diag(W) <= _SINGULAR**2).any():
        return None
    size = np.sqrt(np.diag(W))
    if np.linalg.eigvalsh(W / size / size[:, None])[0] < _SINGULAR:
        return None
    return np.asarray(W)
