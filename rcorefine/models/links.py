"""Links between masses: rank-one factors of a stiffness or damping matrix."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ..systems.linear import Array
from .bodies import ROUNDING, Groups, between_bodies, connected, couplings, unit

__all__ = ["factors"]


def factors(K: Array, C: Array, alike: NDArray[np.bool_]) -> tuple[list[Array], Groups]:
    """Return the directions g of the links in a stiffness or damping matrix.

    The matrix is K = sum of k g g' + (springs to the ground).

    Parameters
    ----------
    K : ndarray, shape (n, n)
        Symmetric, stiffness or damping.
    C : ndarray, shape (n, n)
        The other one of the same structure; it decides where K alone leaves two factors open.
    alike : ndarray of bool, shape (n, n)
        Whether two displacements have, as far as is known, the same unit and sense.

    Returns
    -------
    directions : list of ndarray, shape (n,)
        One per link.
    open_ : list of list of int
        Displacements whose coupling to each other or to the ground has more than one factorization.

    Notes
    -----
    A sum of terms on two displacements each exists if and only if the comparison matrix M (diagonal
    of K, minus the sizes of the rest) is positive semidefinite [1]_. Differences x_i - x_j are one such
    sum where the rows of M have no negative sum. Where M is singular, the sum is unique: M x = 0 gives
    d = q_i / x_i - q_j / x_j. Otherwise displacements move together as bodies (the
    two of a node, heave and pitch), between which the coupling has rank one.

    References
    ----------
    .. [1] E. G. Boman, D. Chen, O. Parekh, S. Toledo, "On factor width and symmetric H-matrices",
       Linear Algebra and its Applications 405 (2005), 239-248.
    """
    n = len(K)
    found: list[Array] = []
    open_: Groups = []
    for group in connected(couplings(K)):
        if len(group) < 2:
            continue
        part = np.ix_(group, group)
        own = _differences(K[part], alike[part])
        if own is None:
            own = _ratios(K[part])
        lost: Groups = []
        if own is None:
            own, lost = between_bodies(K[part], C[part], alike[part])
        for g in own:
            full = np.zeros(n)
            full[group] = g
            found.append(full)
        open_ += [[group[i] for i in body] for body in lost]
    return found, open_


def _pairs(K: Array, sizes: Array) -> list[Array]:
    """A link for each coupled pair, d = q_i / size_i -+ q_j / size_j."""
    found = []
    for i, j in np.argwhere(np.triu(couplings(K))):
        g = np.zeros(len(K))
        g[i], g[j] = 1.0 / sizes[i], np.sign(K[i, j]) / sizes[j]
        found.append(unit(g))
    return found


def _comparison(K: Array) -> Array:
    return np.asarray(2.0 * np.diag(np.diag(K)) - np.abs(K))


def _differences(K: Array, alike: NDArray[np.bool_]) -> list[Array] | None:
    """Return x_i - x_j for each coupling, or None.

    None means that springs to the ground do not explain the rest of K.
    """
    coupled = couplings(K)
    if not alike[coupled].all():
        return None
    size = np.abs(np.diag(K))
    left = _comparison(K).sum(axis=1)
    unstable = bool(np.linalg.eigvalsh(K)[0] < -ROUNDING * size.max())  # gravity takes from the diagonal
    if (K[coupled] < 0).all() and (unstable or (left >= -ROUNDING * size).all()):
        return _pairs(K, np.ones(len(K)))
    # a displacement may be counted the other way; two alone may as well be heave and pitch
    balanced = len(K) > 2 and bool((left >= -ROUNDING * size).all()) and _balanced(K)
    return _pairs(K, np.ones(len(K))) if balanced else None


def _balanced(K: Array) -> bool:
    """Return whether sign changes can make all couplings negative.

    A sign change reverses the sense of a displacement.
    """
    sign, front = {0: 1.0}, [0]
    while front:
        i = front.pop()
        for j in np.flatnonzero(couplings(K)[i]):
            wanted = -sign[i] * float(np.sign(K[i, j]))
            if j not in sign:
                sign[int(j)] = wanted
                front.append(int(j))
            elif sign[int(j)] != wanted:
                return False
    return True


def _ratios(K: Array) -> list[Array] | None:
    """Return the links whose ratios leave no springs to the ground, or None."""
    size = np.diag(K)
    if (size <= 0).any():
        return None
    scale = 1.0 / np.sqrt(size)
    values, vectors = np.linalg.eigh(_comparison(K) * np.outer(scale, scale))
    if abs(values[0]) > ROUNDING or (len(K) > 2 and values[1] < 10 * ROUNDING):
        return None
    return _pairs(K, np.abs(vectors[:, 0]) * scale)
