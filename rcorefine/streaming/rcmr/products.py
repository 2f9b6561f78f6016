"""The innermost passes, each with two bodies.

Scalar loops are the fast form where numba compiles them; in plain Python they
would take milliseconds per sample, so there arrays do it.
"""

from __future__ import annotations

import numpy as np
from scipy.linalg.blas import dger

from ...jit import NUMBA, compiled
from ...systems.linear import Array

__all__ = ["add_scaled", "affine", "half_gradient", "product", "slide"]


@compiled
def _product_loops(matrix: Array, vector: Array) -> Array:
    """Multiply a matrix by a vector without a call into BLAS.

    The call costs more than a small product.
    """
    count, m = matrix.shape
    out = np.empty(count)
    for i in range(count):
        total = 0.0
        for j in range(m):
            total += matrix[i, j] * vector[j]
        out[i] = total
    return out


def _affine_arrays(A: Array, x: Array, B: Array, w: Array, E: Array, u: Array) -> Array:
    """A x + B w + E u."""
    return A @ x + B @ w + E @ u


@compiled
def _affine_loops(A: Array, x: Array, B: Array, w: Array, E: Array, u: Array) -> Array:
    """Like `_affine_arrays`, with one array made instead of five."""
    out = np.empty(A.shape[0])
    for i in range(out.size):
        total = 0.0
        for j in range(x.size):
            total += A[i, j] * x[j]
        for j in range(w.size):
            total += B[i, j] * w[j]
        for j in range(u.size):
            total += E[i, j] * u[j]
        out[i] = total
    return out


def _gradient_arrays(rows: Array, offsets: Array, theta: Array) -> Array:
    """Return half the gradient of the retrospective cost at theta.

    It is Phi'(f + Phi theta).
    """
    return (rows @ theta + offsets) @ rows


@compiled
def _gradient_loops(rows: Array, offsets: Array, theta: Array) -> Array:
    """Return the result of `_gradient_arrays` in one pass over the window.

    The pass takes four rows at a time.
    """
    count, m = rows.shape
    gradient = np.zeros(m)
    whole = count - count % 4
    for i in range(0, whole, 4):
        row1, row2, row3, row4 = rows[i], rows[i + 1], rows[i + 2], rows[i + 3]
        f1, f2, f3, f4 = 0.0, 0.0, 0.0, 0.0
        for j in range(m):
            entry = theta[j]
            f1 += row1[j] * entry
            f2 += row2[j] * entry
            f3 += row3[j] * entry
            f4 += row4[j] * entry
        f1 += offsets[i]
        f2 += offsets[i + 1]
        f3 += offsets[i + 2]
        f4 += offsets[i + 3]
        for j in range(m):
            gradient[j] += f1 * row1[j] + f2 * row2[j] + f3 * row3[j] + f4 * row4[j]
    for i in range(whole, count):
        row1 = rows[i]
        f1 = offsets[i]
        for j in range(m):
            f1 += row1[j] * theta[j]
        for j in range(m):
            gradient[j] += f1 * row1[j]
    return gradient


def _slide_arrays(gain: Array, pending: Array, new: Array, old: Array, gradient: Array, step: Array) -> float:
    """Update the gain when one row enters the window and another leaves.

    `new` enters and `old` leaves, which is a rank-2 change.

    The change is left in `pending`, to be applied on the next pass over the
    gain: gain - pending[0] pending[0]' + pending[1] pending[1]'. `step`
    becomes the new gain times `gradient`. Returns the pivot of the downdate;
    near zero means that the leaving row held nearly all that was known of
    some direction.
    """
    # gain is symmetric, so its transpose is the Fortran array that dger updates in place
    dger(-1.0, pending[0], pending[0], a=gain.T, overwrite_a=1)
    dger(1.0, pending[1], pending[1], a=gain.T, overwrite_a=1)
    a, b = gain @ new, gain @ old
    step[:] = gain @ gradient
    # Sherman and Morrison's formula twice
    grow = 1.0 / (1.0 + a @ new)
    step -= (grow * (a @ gradient)) * a
    b -= (grow * (a @ old)) * a
    pivot = 1.0 - b @ old
    shrink = 1.0 / pivot if pivot > 0.0 else 0.0
    step += (shrink * (b @ gradient)) * b
    pending[0] = np.sqrt(grow) * a
    pending[1] = np.sqrt(shrink) * b
    return float(pivot)


@compiled
def _slide_loops(gain: Array, pending: Array, new: Array, old: Array, gradient: Array, step: Array) -> float:
    """Do the work of `_slide_arrays` in one fused pass over the gain.

    The pass takes two rows at a time.
    """
    m = new.size
    a = np.empty(m)
    b = np.empty(m)
    less, more = pending[0], pending[1]
    for i in range(0, m, 2):  # m is a multiple of PADDING
        row1, row2 = gain[i], gain[i + 1]
        less1, more1, less2, more2 = less[i], more[i], less[i + 1], more[i + 1]
        new1, old1, gradient1, new2, old2, gradient2 = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
        for j in range(m):
            entry1 = row1[j] - less1 * less[j] + more1 * more[j]
            entry2 = row2[j] - less2 * less[j] + more2 * more[j]
            row1[j] = entry1
            row2[j] = entry2
            new1 += entry1 * new[j]
            old1 += entry1 * old[j]
            gradient1 += entry1 * gradient[j]
            new2 += entry2 * new[j]
            old2 += entry2 * old[j]
            gradient2 += entry2 * gradient[j]
        a[i], a[i + 1] = new1, new2
        b[i], b[i + 1] = old1, old2
        step[i], step[i + 1] = gradient1, gradient2
    # Sherman and Morrison's formula twice
    with_new, with_old, with_gradient = 0.0, 0.0, 0.0
    for j in range(m):
        with_new += a[j] * new[j]
        with_old += a[j] * old[j]
        with_gradient += a[j] * gradient[j]
    grow = 1.0 / (1.0 + with_new)
    root, shared, along = np.sqrt(grow), grow * with_old, grow * with_gradient
    with_old, with_gradient = 0.0, 0.0
    for j in range(m):
        less[j] = root * a[j]
        b[j] -= shared * a[j]
        with_old += b[j] * old[j]
        with_gradient += b[j] * gradient[j]
    pivot = 1.0 - with_old
    shrink = 1.0 / pivot if pivot > 0.0 else 0.0
    root, back = np.sqrt(shrink), shrink * with_gradient
    for j in range(m):
        more[j] = root * b[j]
        step[j] += back * b[j] - along * a[j]
    return pivot


def _add_scaled_arrays(out: Array, at: int, factor: float, values: Array) -> None:
    """Add a multiple of a row to a part of another."""
    out[at : at + values.size] += factor * values


@compiled
def _add_scaled_loops(out: Array, at: int, factor: float, values: Array) -> None:
    """Like `_add_scaled_arrays`."""
    for i in range(values.size):
        out[at + i] += factor * values[i]


add_scaled = _add_scaled_loops if NUMBA else _add_scaled_arrays
affine = _affine_loops if NUMBA else _affine_arrays
product = _product_loops if NUMBA else np.matmul
half_gradient = _gradient_loops if NUMBA else _gradient_arrays
slide = _slide_loops if NUMBA else _slide_arrays
