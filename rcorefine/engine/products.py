"""Small products in place, and the solution of small systems.

numba compiles them where it is installed; without it the same calls run as plain
Python. The products and copies have two bodies, because scalar loops are
the fast form in compiled code and the slow one in Python.
"""

from __future__ import annotations

import numpy as np

from ..jit import NUMBA, compiled, inlined

# compiled: scalar loops
if NUMBA:

    @inlined
    def apply(out, M, z, row, at):
        """Out = M z, of the rows of M from `row` on and the columns from `at` on."""
        for i in range(out.shape[0]):
            total = 0.0
            for j in range(M.shape[1] - at):
                total += M[row + i, at + j] * z[j]
            out[i] = total

    @inlined
    def add(out, M, z, row, at):
        """Out += M z, of the rows of M from `row` on and the columns from `at` on."""
        for i in range(out.shape[0]):
            total = 0.0
            for j in range(M.shape[1] - at):
                total += M[row + i, at + j] * z[j]
            out[i] += total

    # eight lanes are written out, so that they stay in registers
    @inlined
    def add_product(L, to, rows, M, at, stride, frm, count):
        """Rows of L from `to` on += M times its rows from `frm` on.

        The first row of M stands in a row of numbers from `at` on, the next one `stride` further on.
        """
        for i in range(rows):
            # sums of the eight lanes
            a, b, c, d = L[to + i, 0], L[to + i, 1], L[to + i, 2], L[to + i, 3]
            e, f, g, h = L[to + i, 4], L[to + i, 5], L[to + i, 6], L[to + i, 7]
            for j in range(count):
                by = M[at + i * stride + j]
                a += by * L[frm + j, 0]
                b += by * L[frm + j, 1]
                c += by * L[frm + j, 2]
                d += by * L[frm + j, 3]
                e += by * L[frm + j, 4]
                f += by * L[frm + j, 5]
                g += by * L[frm + j, 6]
                h += by * L[frm + j, 7]
            L[to + i, 0], L[to + i, 1], L[to + i, 2], L[to + i, 3] = a, b, c, d
            L[to + i, 4], L[to + i, 5], L[to + i, 6], L[to + i, 7] = e, f, g, h

    @inlined
    def add_each(L, to, rows, dM, at, count, tape, where):
        """Rows of L from `to` on += dM z, each lane with its own dM.

        Its rows (count, 8) begin at `at`; z stands on a tape from `where` on.
        """
        # z is common to the lanes, dM is not
        for i in range(rows):
            a, b, c, d = L[to + i, 0], L[to + i, 1], L[to + i, 2], L[to + i, 3]
            e, f, g, h = L[to + i, 4], L[to + i, 5], L[to + i, 6], L[to + i, 7]
            for j in range(count):
                by = tape[where + j]
                a += by * dM[at + i, j, 0]
                b += by * dM[at + i, j, 1]
                c += by * dM[at + i, j, 2]
                d += by * dM[at + i, j, 3]
                e += by * dM[at + i, j, 4]
                f += by * dM[at + i, j, 5]
                g += by * dM[at + i, j, 6]
                h += by * dM[at + i, j, 7]
            L[to + i, 0], L[to + i, 1], L[to + i, 2], L[to + i, 3] = a, b, c, d
            L[to + i, 4], L[to + i, 5], L[to + i, 6], L[to + i, 7] = e, f, g, h

    @inlined
    def combine(L, to, which, by):
        """Row `to` = the sum of four rows, each times a number."""
        (i, j, k, m), (p, q, r, s) = which, by
        # each lane: p L[i] + q L[j] + r L[k] + s L[m]
        a = p * L[i, 0] + q * L[j, 0] + r * L[k, 0] + s * L[m, 0]
        b = p * L[i, 1] + q * L[j, 1] + r * L[k, 1] + s * L[m, 1]
        c = p * L[i, 2] + q * L[j, 2] + r * L[k, 2] + s * L[m, 2]
        d = p * L[i, 3] + q * L[j, 3] + r * L[k, 3] + s * L[m, 3]
        e = p * L[i, 4] + q * L[j, 4] + r * L[k, 4] + s * L[m, 4]
        f = p * L[i, 5] + q * L[j, 5] + r * L[k, 5] + s * L[m, 5]
        g = p * L[i, 6] + q * L[j, 6] + r * L[k, 6] + s * L[m, 6]
        h = p * L[i, 7] + q * L[j, 7] + r * L[k, 7] + s * L[m, 7]
        L[to, 0], L[to, 1], L[to, 2], L[to, 3] = a, b, c, d
        L[to, 4], L[to, 5], L[to, 6], L[to, 7] = e, f, g, h

    @inlined
    def copy(L, to, frm, rows):
        """Rows from `to` on = those from `frm` on."""
        for i in range(rows):
            for lane in range(8):
                L[to + i, lane] = L[frm + i, lane]

    @inlined
    def clear(out, first, rows):
        """Rows from `first` on = 0."""
        for i in range(first, first + rows):
            for j in range(out.shape[1]):
                out[i, j] = 0.0

# plain Python: products of NumPy
else:

    def apply(out, M, z, row, at):
        """Out = M z, of the rows of M from `row` on and the columns from `at` on."""
        out[:] = M[row : row + out.size, at:] @ z[: M.shape[1] - at]

    def add(out, M, z, row, at):
        """Out += M z, of the rows of M from `row` on and the columns from `at` on."""
        out += M[row : row + out.size, at:] @ z[: M.shape[1] - at]

    def add_product(L, to, rows, M, at, stride, frm, count):
        """Rows of L from `to` on += M times its rows from `frm` on."""
        if rows and count:
            # the matrix is a view of the row of numbers: offset and strides in bytes
            L[to : to + rows] += (
                np.ndarray((rows, count), float, M, 8 * at, (8 * stride, 8)) @ L[frm : frm + count]
            )

    def add_each(L, to, rows, dM, at, count, tape, where):
        """Rows of L from `to` on += dM z, each lane with its own dM."""
        L[to : to + rows] += np.tensordot(dM[at : at + rows], tape[where : where + count], axes=(1, 0))

    def combine(L, to, which, by):
        """Row `to` = the sum of four rows, each times a number."""
        (i, j, k, m), (p, q, r, s) = which, by
        L[to] = p * L[i] + q * L[j] + r * L[k] + s * L[m]

    def copy(L, to, frm, rows):
        """Rows from `to` on = those from `frm` on."""
        L[to : to + rows] = L[frm : frm + rows]

    def clear(out, first, rows):
        """Rows from `first` on = 0."""
        out[first : first + rows] = 0.0


@compiled
def solve_in_place(J, R):
    """Solve linear equations by Gaussian elimination with pivoting.

    The rows of R (k, m) are the right-hand sides.
    """
    m = J.shape[0]
    for c in range(m):
        # partial pivoting: largest entry of the column
        pivot = c
        for r in range(c + 1, m):
            if abs(J[r, c]) > abs(J[pivot, c]):
                pivot = r
        if pivot != c:
            for j in range(m):
                J[c, j], J[pivot, j] = J[pivot, j], J[c, j]
            for q in range(R.shape[0]):
                R[q, c], R[q, pivot] = R[q, pivot], R[q, c]
        # singular: a tiny pivot gives a huge, finite step
        if J[c, c] == 0.0:
            J[c, c] = 1e-300
        # forward elimination
        for r in range(c + 1, m):
            factor = J[r, c] / J[c, c]
            if factor != 0.0:
                for j in range(c, m):
                    J[r, j] -= factor * J[c, j]
                for q in range(R.shape[0]):
                    R[q, r] -= factor * R[q, c]
    # back substitution
    for c in range(m - 1, -1, -1):
        for q in range(R.shape[0]):
            total = R[q, c]
            for j in range(c + 1, m):
                total -= J[c, j] * R[q, j]
            R[q, c] = total / J[c, c]
