"""Exact discretization with inputs held or interpolated between samples."""

from __future__ import annotations

from typing import Any

import control as ct
import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy import linalg

from ..arguments import as_choice, as_number
from ..exceptions import ModelError
from .linear import Array, balance, check_finite

HOLDS = ("zoh", "foh")
# Higham, SIAM J. Matrix Anal. Appl. 26 (2005) 1179, table 2.3: degree 9 is exact to
# double precision up to a 1-norm of 2.1.
_THETA = 2.1
_UNBALANCED = 64.0  # five squarings
_PADE = (
    17643225600.0, 8821612800.0, 2075673600.0, 302702400.0, 30270240.0, 2162160.0, 110880.0, 3960.0,
    90.0, 1.0,
)  # fmt: skip


def discretize(A: ArrayLike, B: ArrayLike, dt: float, hold: str = "zoh") -> tuple[Array, Array, Array]:
    """Discretize a continuous model exactly.

    The state obeys ``x(k+1) = Phi x(k) + G0 w(k) + G1 w(k+1)``. One block
    exponential gives all three matrices, so `A` may be singular, which
    equation (20) of the paper excludes.

    Parameters
    ----------
    A : array_like
        State matrix, shape (n, n), in 1/s.
    B : array_like
        Input matrix, shape (n, n_w).
    dt : float
        Sampling time in seconds.
    hold : {'zoh', 'foh'}, optional
        How the input moves between samples: held (zero order, `G1` is
        zero) or joined by straight lines (first order).

    Returns
    -------
    Phi : ndarray
        Transition matrix, shape (n, n).
    G0, G1 : ndarray
        Weights of the input sample at the start and at the end of the
        interval, shape (n, n_w).

    Raises
    ------
    control.ControlDimension
        If `A` is not square or `B` has another number of rows.
    control.ControlArgument
        If `hold` is unknown.
    ModelError
        If the sampling time is not positive, an entry is not finite, or
        the model grows beyond floating point within one sample.

    Examples
    --------
    >>> import numpy as np
    >>> Phi, G0, G1 = discretize([[0.0, 1.0], [0.0, 0.0]], [[0.0], [1.0]], 0.5)
    >>> print(G0.ravel(), G1.ravel())
    [0.125 0.5  ] [0. 0.]
    """
    as_choice(hold, "hold", HOLDS)
    a, b = _check_matrices(A, B)
    step = check_sampling_time(dt)
    n, n_w = b.shape
    if n == 0:
        return np.zeros((0, 0)), np.zeros((0, n_w)), np.zeros((0, n_w))
    # Units that differ much (current and charge) cost digits; scaling by powers of two is exact.
    a, scale = balanced(a)
    b = b / scale[:, None]
    columns = power_of_two(np.max(np.abs(b), axis=0, initial=0.0))
    blocks = 2 if hold == "foh" else 1
    # exponential of [A B 0; 0 0 I; 0 0 0] dt: transition, held input, ramp of the input (Van Loan)
    block = np.zeros((n + blocks * n_w, n + blocks * n_w))
    block[:n, :n] = a * step
    block[:n, n : n + n_w] = b / columns
    if hold == "foh":
        block[n : n + n_w, n + n_w :] = np.eye(n_w)
    with np.errstate(over="ignore", invalid="ignore"):
        exponential = linalg.expm(block)[:n] * scale[:, None]
        phi = exponential[:, :n] / scale
        held = exponential[:, n : n + n_w] * (columns * step)
        ramp = exponential[:, n + n_w :] * (columns * step) if hold == "foh" else np.zeros((n, n_w))
    if not (np.isfinite(phi).all() and np.isfinite(held).all() and np.isfinite(ramp).all()):
        raise ModelError(
            f"the model grows beyond floating point within one sample of {step:g} s; "
            "check the signs and units of A, or sample faster"
        )
    # w(k) acts by the hold less the ramp, w(k+1) by the ramp
    return phi, held - ramp, ramp


def check_sampling_time(dt: object) -> float:
    """Return `dt` as a float, or say why it is not a sampling time.

    Parameters
    ----------
    dt : object
        Candidate for a sampling time in seconds.

    Returns
    -------
    float
        The sampling time in seconds.

    Raises
    ------
    ModelError
        If `dt` is not one positive, finite number.

    Examples
    --------
    >>> check_sampling_time(0.01)
    0.01
    """
    return as_number(dt, "the sampling time", above=0.0, what="a time in seconds", error=ModelError)


def _check_matrices(A: ArrayLike, B: ArrayLike) -> tuple[Array, Array]:
    """Give A and B as finite float arrays of fitting size."""
    a, b = np.array(A, dtype=float), np.array(B, dtype=float)
    if a.ndim != 2 or a.shape[0] != a.shape[1]:
        raise ct.ControlDimension(f"A must be square, not of shape {a.shape}")
    if b.ndim != 2 or b.shape[0] != a.shape[0]:
        raise ct.ControlDimension(f"B must have shape ({a.shape[0]}, n_w) as A demands, not {b.shape}")
    check_finite("A", a)
    check_finite("B", b)
    return a, b


def balanced(a: Array) -> tuple[Array, Array]:
    """Scale the states so that rows and columns of A have similar norms.

    The result satisfies ``A = S A_bal S^-1``.
    """
    scale = balance(a)
    return a * scale / scale[:, None], scale


def power_of_two(size: Array) -> Array:
    """Return the largest power of two up to each size, and 1 for zero.

    Scaling by powers of two causes no rounding errors.
    """
    safe = np.where(size > 0, size, 1.0)
    return np.asarray(np.exp2(np.floor(np.log2(safe))), dtype=float)


def exponential(matrices: NDArray[Any]) -> NDArray[Any]:
    """Exponential of each matrix of a stack, real or complex.

    `scipy.linalg.expm` is right but starts BLAS threads for every small matrix of a stack, which costs up
    to a hundred times its arithmetic on a busy machine, and an estimate takes thousands of exponentials.

    Parameters
    ----------
    matrices : ndarray, shape (k, n, n)
        Square matrices of like size; they share one scaling.

    Returns
    -------
    ndarray, shape (k, n, n)
        Exponentials; not finite where they overflow.

    Examples
    --------
    >>> import numpy as np
    >>> bool(np.allclose(exponential(np.zeros((1, 2, 2))), np.eye(2)))
    True
    """
    norm = float(np.abs(matrices).sum(axis=-2).max(initial=0.0))
    if not np.isfinite(norm):
        return np.full_like(matrices, np.nan)
    scale = None
    if norm > _UNBALANCED:  # many squarings lose digits in badly scaled matrices such as companion forms
        size = np.abs(matrices).max(axis=0)
        scale = balance(size)
        matrices = matrices * scale / scale[:, None]
        norm = float(np.abs(matrices).sum(axis=-2).max(initial=0.0))
    # scaling and squaring: exp(M) = exp(M / 2^s)^(2^s)
    squarings = max(0, int(np.ceil(np.log2(max(norm, 1e-300) / _THETA))))
    a = matrices / 2.0**squarings
    one = np.eye(a.shape[-1])
    # Pade approximant of degree 9, split in even and odd powers
    a2 = a @ a
    a4 = a2 @ a2
    a6 = a4 @ a2
    a8 = a4 @ a4
    b = _PADE
    odd = a @ (b[9] * a8 + b[7] * a6 + b[5] * a4 + b[3] * a2 + b[1] * one)
    even = b[8] * a8 + b[6] * a6 + b[4] * a4 + b[2] * a2 + b[0] * one
    result = np.linalg.solve(even - odd, even + odd)
    with np.errstate(over="ignore", invalid="ignore"):
        for _ in range(squarings):
            result = result @ result
    return np.asarray(result if scale is None else result * scale[:, None] / scale)
