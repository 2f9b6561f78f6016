"""Lowest modes of M q'' + K q = 0 for large finite-element matrices."""

from __future__ import annotations

from typing import Any

import control as ct
import numpy as np
from scipy.linalg import eigh
from scipy.sparse import csc_matrix, issparse
from scipy.sparse.linalg import ArpackError, LinearOperator, eigsh, splu

from ...exceptions import ModelError
from ...systems.linear import Array
from ._checks import as_matrix

_SHIFT = 1e-8  # below zero, in the middle of the squared frequencies that each displacement has alone
_DENSE = 200  # displacements, up to which all modes are as fast
_SAME = 1e-6  # relative difference of squared frequencies that says nothing


def as_sparse(value: Any, name: str, size: int, *, symmetric: bool) -> csc_matrix:
    """Square matrix of finite numbers, whose zeros take no room."""
    if not issparse(value):
        return csc_matrix(as_matrix(value, name, size, symmetric=symmetric))
    if value.dtype.kind not in "fiu":
        raise ct.ControlArgument(f"{name} must hold real numbers, not {value.dtype}")
    matrix = csc_matrix(value, dtype=float)
    if matrix.shape != (size, size):
        raise ct.ControlDimension(f"{name} has shape {matrix.shape}, expected {(size, size)}")
    if not np.isfinite(matrix.data).all():
        raise ModelError(f"{name} has a value that is not finite")
    if symmetric and abs(matrix - matrix.T).max() > 1e-8 * abs(matrix).max():
        raise ModelError(
            f"{name} is not symmetric; a Matrix Market file that holds a half must say `symmetric`"
        )
    return matrix


def lowest_modes(M: csc_matrix, K: csc_matrix, count: int) -> tuple[Array, Array]:
    """Return squared frequencies and mode shapes, the lowest first.

    Their shapes are (count,) and (n, count), and Phi' M Phi = I.

    Raises
    ------
    ModelError
        If M is not positive definite, K has a negative direction, or modes cannot be told from others.
    """
    n = M.shape[0]
    if M.diagonal().min() <= 0 or _negative(M):
        raise ModelError("M must be positive definite: every displacement needs a mass")
    middle = float(np.median(np.abs(K.diagonal()) / M.diagonal())) or 1.0
    shift = -_SHIFT * middle
    if n <= _DENSE or 2 * count >= n:
        squares, shapes = eigh(K.toarray(), M.toarray(), subset_by_index=[0, count - 1])
    else:
        squares, shapes = _by_lanczos(M, K, count, shift)
    if squares[0] < shift:
        raise ModelError(
            f"K has a negative direction (omega^2 = {squares[0]:g}); the structure would not stand"
        )
    squares = np.where(np.abs(squares) <= _SAME * abs(shift), 0.0, squares)
    shapes = shapes * np.sign(shapes[np.argmax(np.abs(shapes), axis=0), np.arange(count)])
    return squares, shapes


def _by_lanczos(M: csc_matrix, K: csc_matrix, count: int, shift: float) -> tuple[Array, Array]:
    """Return the lowest modes by shift-and-invert Lanczos iteration.

    The shift lies below zero, because rigid-body modes make K itself singular.
    """
    solved = _factors(K - shift * M)
    if (solved.U.diagonal() < 0).any():
        raise ModelError("K has a negative direction; the structure would not stand")
    try:
        squares, shapes = eigsh(
            K,
            k=count,
            M=M,
            sigma=shift,
            OPinv=LinearOperator(K.shape, solved.solve, dtype=float),
            v0=np.random.default_rng(0).standard_normal(K.shape[0]),
        )
    except ArpackError as error:
        raise ModelError(f"the lowest {count} modes did not converge: {error}") from error
    order = np.argsort(squares)
    squares, shapes = squares[order], shapes[:, order]
    # none is left out where as many lie below the last as were found there (Sylvester)
    last = squares[-1] - _SAME * (squares[-1] - shift)
    if _negative(K - last * M) != int((squares < last).sum()):
        raise ModelError(f"a mode below {np.sqrt(squares[-1]):g} rad/s was missed; ask for other n_modes")
    return squares, shapes


def _factors(X: csc_matrix) -> Any:
    """Factor a symmetric matrix without row exchanges.

    There are then as many negative pivots as negative eigenvalues.
    """
    return splu(
        csc_matrix(X), permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options={"SymmetricMode": True}
    )


def _negative(X: csc_matrix) -> int:
    try:
        return int((_factors(X).U.diagonal() < 0).sum())
    except RuntimeError:  # exactly singular
        return -1
