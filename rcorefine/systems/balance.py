"""State scaling that gives matrix rows and columns similar norms."""

from __future__ import annotations

import numpy as np
from scipy.linalg.lapack import dgebal

from .linear import Array

__all__ = ["balance"]


def balance(size: Array) -> Array:
    """Powers of two d with which d_j size_ij / d_i is balanced.

    Parameters
    ----------
    size : ndarray of shape (n, n)
        Sizes of the entries of a matrix, or of several of the same structure.

    Returns
    -------
    ndarray of shape (n,)

    Notes
    -----
    LAPACK's gebal without permutations; `scipy.linalg.matrix_balance` writes the factors as integers,
    too, which units 1e15 apart exceed.
    """
    *_, scale, _ = dgebal(np.asarray(size, dtype=np.float64), scale=1, permute=0)
    return np.asarray(scale, dtype=np.float64)
