"""Matrix exponential of a stack of small matrices.

`scipy.linalg.expm` is right but starts BLAS threads for every small matrix of a
stack, which costs up to a hundred times its arithmetic on a busy machine, and an
estimate takes thousands of exponentials.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from .balance import balance

__all__ = ["exponential"]

# Higham, SIAM J. Matrix Anal. Appl. 26 (2005) 1179, table 2.3: degree 9 is exact to
# double precision up to a 1-norm of 2.1.
_THETA = 2.1
_UNBALANCED = 64.0  # five squarings
_PADE = (
    17643225600.0, 8821612800.0, 2075673600.0, 302702400.0, 30270240.0, 2162160.0, 110880.0, 3960.0,
    90.0, 1.0,
)  # fmt: skip


def exponential(matrices: NDArray[Any]) -> NDArray[Any]:
    """Exponential of each matrix of a stack, real or complex.

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
    if norm > _UNBALANCED:  # many squarings lose digits where units differ, as in a companion matrix
        size = np.abs(matrices).max(axis=0)
        scale = balance(size)
        matrices = matrices * scale / scale[:, None]
        norm = float(np.abs(matrices).sum(axis=-2).max(initial=0.0))
    squarings = max(0, int(np.ceil(np.log2(max(norm, 1e-300) / _THETA))))
    a = matrices / 2.0**squarings
    one = np.eye(a.shape[-1])
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
