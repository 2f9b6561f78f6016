"""The force that a model lacks at a port, from the record, without any law."""

from __future__ import annotations

import numpy as np
from scipy.linalg import solve_discrete_are

from ..data.measurement import Measurement
from ..models.ports import Port
from ..systems.discretization import discretize
from ..systems.linear import Array, LinearModel
from .refinement import Refinement

__all__ = ["estimated_force"]

_LEVELS = np.logspace(-3, 1, 9)  # of the force that drives the estimate, tried by likelihood
_MEMORY = (3.0, 12.0, 50.0)  # samples for which it lasts, tried too
_TRIED_ON = 1000  # samples


def estimated_force(model: Refinement, noise: Array, port: Port, record: Measurement) -> tuple[Array, Array]:
    """Force at a port and the motion, from the record and the model as it is, without any law.

    The force is one more state of a Kalman smoother, driven by noise; how strongly, and how
    long it remembers, is chosen by likelihood. Its mean is no part of the estimate.

    Parameters
    ----------
    model : Refinement
        Model as it is, the linear part of which moves.
    noise : ndarray, shape (n_y,)
        Standard deviation of what the sensors add.
    port : Port
        Where the force acts.
    record : Measurement
        Record, channels in the order of the model.

    Returns
    -------
    force : ndarray, shape (N,)
        Resisting force.
    states : ndarray, shape (n, N)
        States of the linear model.
    """
    linear = LinearModel.from_statespace(model.system)
    n = linear.n_states
    act = np.zeros(n)
    act[: port.act.size] = port.act
    rate = np.zeros((linear.n_outputs, n))
    given = model.physical_model.output_rate
    rate[:, : given.shape[1]] = given
    B = np.vstack([linear.B, np.zeros((1, linear.n_inputs))])
    C = np.column_stack([linear.C, rate @ act])
    hold = "zoh" if record.hold == "zoh" else "foh"
    w = record.inputs
    R = np.diag(np.maximum(noise, 1e-6 * record.outputs.std(axis=1)) ** 2)
    y = record.outputs - linear.D @ w
    y = y - y.mean(axis=1, keepdims=True)
    runs = []
    for memory in _MEMORY:
        A = np.zeros((n + 1, n + 1))
        A[:n, :n], A[:n, n], A[n, n] = linear.A, act, -1.0 / (memory * record.dt)
        F, G0, G1 = discretize(A, B, record.dt, hold)
        drive = G0 @ w[:, :-1] + G1 @ w[:, 1:]
        # a force that moves the output by its own size within a sample: the scale of the walk
        reach = np.linalg.norm(C @ F[:, -1]) + np.linalg.norm(C[:, -1]) + 1e-300
        unit = float(np.linalg.norm(y.std(axis=1))) / reach
        short = min(_TRIED_ON, y.shape[1])
        for share in _LEVELS:
            try:
                run = _smoother(F, C, drive[:, : short - 1], y[:, :short], R, share * unit)
            except (np.linalg.LinAlgError, ValueError):
                continue  # no stationary filter at this level; the next one may have
            runs.append((run[0], F, drive, share * unit))
    if not runs:
        return np.zeros(record.n_samples), np.zeros((n, record.n_samples))
    _, F, drive, walk = max(runs, key=lambda run: run[0])
    smooth = _smoother(F, C, drive, y, R, walk)[1]
    return smooth[n], smooth[:n]


def _smoother(F: Array, C: Array, drive: Array, y: Array, R: Array, walk: float) -> tuple[float, Array]:
    """Stationary Kalman filter forth, Rauch-Tung-Striebel back: log-likelihood and states."""
    n, N = F.shape[0], y.shape[1]
    Q = np.zeros((n, n))
    Q[-1, -1] = walk**2
    size = np.ones(n)
    size[-1] = walk
    Fs, Cs, Qs = F * size / size[:, None], C * size, Q / np.outer(size, size)
    Qs = Qs + 1e-12 * np.eye(n) * np.mean(np.diag(R))
    P = solve_discrete_are(Fs.T, Cs.T, Qs, R)
    S = Cs @ P @ Cs.T + R
    K = P @ Cs.T @ np.linalg.inv(S)
    after = P - K @ Cs @ P
    J = np.linalg.solve(P.T, (after @ Fs.T).T).T
    steer = drive / size[:, None]
    before_all, after_all = np.zeros((n, N)), np.zeros((n, N))
    x = np.zeros(n)
    errors = np.zeros_like(y)
    for k in range(N):
        before_all[:, k] = x
        errors[:, k] = y[:, k] - Cs @ x
        z = x + K @ errors[:, k]
        after_all[:, k] = z
        if k + 1 < N:
            x = Fs @ z + steer[:, k]
    smooth = np.zeros((n, N))
    smooth[:, -1] = after_all[:, -1]
    for k in range(N - 2, -1, -1):
        smooth[:, k] = after_all[:, k] + J @ (smooth[:, k + 1] - before_all[:, k + 1])
    likelihood = -0.5 * (N * np.linalg.slogdet(S)[1] + float(np.sum(errors * np.linalg.solve(S, errors))))
    return likelihood, smooth * size[:, None]
