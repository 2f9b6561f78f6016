"""Equations (23)-(42) of the paper, transcribed literally: the oracle of the tests and of the benchmark.

Every sample builds the extended vectors, the block Toeplitz matrix and the
normal equations anew. Only the misprints are mended: "w" in (28), (31) and
(34) is u_Delta; p_c = p + mu + d - 1 (the paper's mu + p is the case d = 1);
(33) runs to p_c and carries the Toeplitz matrix in front; (41) has a minus.
w enters through B (DESIGN 2.1), so theta starts at zero.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


class Plant(NamedTuple):
    """x+ = A x + B w + Bu u, y = C x + D w + Du u, in discrete time."""

    A: Array
    B: Array
    Bu: Array
    C: Array
    D: Array
    Du: Array


class Trace(NamedTuple):
    """What one stage did, time last; theta of shape (N + 1, l_u, l_psi)."""

    z: Array
    theta: Array
    x: Array
    u: Array


def markov(plant: Plant, count: int) -> list[Array]:
    """H_0 .. H_count by repeated multiplication."""
    values, power = [plant.Du], plant.Bu
    for _ in range(count):
        values.append(plant.C @ power)
        power = plant.A @ power
    return values


def toeplitz(H: list[Array], d: int, mu: int, p: int) -> Array:
    """Surrogate control matrix B-bar after (32)."""
    l_z, l_u = H[0].shape
    columns = p + mu + d - 1
    rows = []
    for j in range(p):
        row = np.zeros((l_z, columns * l_u))
        for i in range(d, d + mu):
            if j + i < columns:
                row[:, (j + i) * l_u : (j + i + 1) * l_u] = H[i]
        rows.append(row)
    return np.vstack(rows)


def literal(
    plant: Plant,
    w: Array,
    y: Array,
    d: int,
    n_c: int,
    p: int,
    mu: int,
    alpha: float,
    states: Array | None = None,
) -> Trace:
    """One stage over a record (signal, time).

    With `states` (the x_Delta of stage 1, one column more than samples are
    needed) the regressor holds them and y^ is predicted from them over the
    span of the Markov parameters, which is stage 2.
    """
    n, n_w, l_u, l_z = plant.A.shape[0], plant.B.shape[1], plant.Bu.shape[1], plant.C.shape[0]
    N = w.shape[1]
    l_psi = n_c * l_u + (n_c + 1) * (n + n_w)
    H = markov(plant, d + mu)
    bar, p_c, horizon = toeplitz(H, d, mu, p), p + mu + d - 1, mu + d - 1
    theta = np.zeros((N + 1, l_u, l_psi))
    x, u, z = np.zeros((n, N + 1)), np.zeros((l_u, N)), np.zeros((l_z, N))
    psi = np.zeros((N, l_psi))
    regressor_state = x if states is None else states

    def past(signal: Array, k: int) -> Array:
        return signal[:, k] if k >= 0 else np.zeros(signal.shape[0])

    for k in range(N):
        psi[k] = np.concatenate(
            [past(regressor_state, k - i) for i in range(n_c + 1)]
            + [past(w, k - i) for i in range(n_c + 1)]
            + [past(u, k - i) for i in range(1, n_c + 1)]
        )
        u[:, k] = theta[k] @ psi[k]  # (27)
        if states is None:
            x_hat = x[:, k]
            x[:, k + 1] = plant.A @ x_hat + plant.B @ w[:, k] + plant.Bu @ u[:, k]  # (23)
        else:
            x_hat = past(states, k - horizon)
            for i in range(horizon, 0, -1):
                x_hat = plant.A @ x_hat + plant.B @ past(w, k - i) + plant.Bu @ past(u, k - i)
            x[:, k] = x_hat
        z[:, k] = plant.C @ x_hat + plant.D @ w[:, k] + plant.Du @ u[:, k] - y[:, k]  # (24)
        Z = np.zeros(p * l_z)  # (28)
        count = min(p, k + 1)
        Z[: count * l_z] = z[:, k - count + 1 : k + 1][:, ::-1].T.ravel()
        U = np.zeros(p_c * l_u)
        Psi = np.zeros((p_c, l_psi))
        count = min(p_c, k + 1)
        U[: count * l_u] = u[:, k - count + 1 : k + 1][:, ::-1].T.ravel()
        Psi[:count] = psi[k - count + 1 : k + 1][::-1]
        # sum_i psi(k-i+1)' (x) L_i, whose block row i is psi' (x) I
        D = bar @ np.einsum("ij,ab->iajb", Psi, np.eye(l_u)).reshape(p_c * l_u, l_psi * l_u)  # (33)
        f = Z - bar @ U  # (34)
        vec = theta[k].ravel(order="F")
        normal = D.T @ D + alpha * np.eye(vec.size)  # (38)
        b = 2 * D.T @ f - 2 * alpha * vec  # (39)
        theta[k + 1] = (-0.5 * np.linalg.solve(normal, b)).reshape((l_u, l_psi), order="F")  # (41), (42)
    return Trace(z, theta, x, u)
