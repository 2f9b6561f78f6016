"""Small products in place, and the solution of small systems.

numba compiles them where it is installed; without it the same calls run as plain
Python. The products and copies have two bodies, because scalar loops are
the fast form in compiled code and the slow one in Python.
"""

from __future__ import annotations

from ..jit import NUMBA, compiled, inlined

if NUMBA:

    @inlined
    def apply(out, M, z):
        """Out = M z."""
        for i in range(M.shape[0]):
            total = 0.0
            for j in range(M.shape[1]):
                total += M[i, j] * z[j]
            out[i] = total

    @inlined
    def add(out, M, z):
        """Out += M z."""
        for i in range(M.shape[0]):
            total = 0.0
            for j in range(M.shape[1]):
                total += M[i, j] * z[j]
            out[i] += total

    @compiled
    def add_rows(out, S, M):
        """Out += S M', row by row."""
        for p in range(S.shape[0]):
            for i in range(M.shape[0]):
                total = 0.0
                for j in range(M.shape[1]):
                    total += M[i, j] * S[p, j]
                out[p, i] += total

    @compiled
    def add_forcing(out, index, dM, z):
        """Rows `index` of out += dM z."""
        for q in range(dM.shape[0]):
            p = index[q]
            for i in range(dM.shape[1]):
                total = 0.0
                for j in range(dM.shape[2]):
                    total += dM[q, i, j] * z[j]
                out[p, i] += total

    @compiled
    def clear(out):
        """Out = 0."""
        for i in range(out.shape[0]):
            for j in range(out.shape[1]):
                out[i, j] = 0.0

    @compiled
    def take(out, M, at):
        """Out = columns of M from `at` on."""
        for i in range(out.shape[0]):
            for j in range(out.shape[1]):
                out[i, j] = M[i, at + j]

    @compiled
    def multiply(out, L, R):
        """Out = L R."""
        for i in range(out.shape[0]):
            for j in range(out.shape[1]):
                total = 0.0
                for k in range(R.shape[0]):
                    total += L[i, k] * R[k, j]
                out[i, j] = total

else:

    def apply(out, M, z):
        """Out = M z."""
        out[:] = M @ z

    def add(out, M, z):
        """Out += M z."""
        out += M @ z

    def add_rows(out, S, M):
        """Out += S M', row by row."""
        out += S @ M.T

    def add_forcing(out, index, dM, z):
        """Rows `index` of out += dM z."""
        if dM.shape[0]:  # none where no parameter reaches this matrix
            out[index] += dM @ z

    def clear(out):
        """Out = 0."""
        out[:] = 0.0

    def take(out, M, at):
        """Out = columns of M from `at` on."""
        out[:] = M[:, at : at + out.shape[1]]

    def multiply(out, L, R):
        """Out = L R."""
        out[:] = L @ R


@compiled
def solve_in_place(J, R):
    """Solve linear equations by Gaussian elimination with pivoting.

    The rows of R (k, m) are the right-hand sides.
    """
    m = J.shape[0]
    for c in range(m):
        pivot = c
        for r in range(c + 1, m):
            if abs(J[r, c]) > abs(J[pivot, c]):
                pivot = r
        if pivot != c:
            for j in range(m):
                J[c, j], J[pivot, j] = J[pivot, j], J[c, j]
            for q in range(R.shape[0]):
                R[q, c], R[q, pivot] = R[q, pivot], R[q, c]
        if J[c, c] == 0.0:
            J[c, c] = 1e-300
        for r in range(c + 1, m):
            factor = J[r, c] / J[c, c]
            if factor != 0.0:
                for j in range(c, m):
                    J[r, j] -= factor * J[c, j]
                for q in range(R.shape[0]):
                    R[q, r] -= factor * R[q, c]
    for c in range(m - 1, -1, -1):
        for q in range(R.shape[0]):
            total = R[q, c]
            for j in range(c + 1, m):
                total -= J[c, j] * R[q, j]
            R[q, c] = total / J[c, c]
