"""Observer gains for a structure: how strongly the record corrects the state."""

from __future__ import annotations

import numpy as np
from scipy.linalg import LinAlgError, solve_discrete_are

from ..data.measurement import Measurement
from ..systems.exponential import exponential
from ..systems.linear import Array
from .structure import Structure

__all__ = ["observer_gain"]


def observer_gain(
    structure: Structure,
    theta: Array,
    data: Measurement,
    ratio: float,
    *,
    at: str = "everywhere",
    noise: float = 0.03,
) -> Array:
    """Steady Kalman gain (filter form) for unknown forces at inputs and ports.

    Parameters
    ----------
    structure : Structure
        Model with effects; linearized at rest.
    theta : ndarray, shape (p,)
        Coefficients.
    data : Measurement
        Record, for the levels of inputs and outputs.
    ratio : float
        Unknown force over the measured one, rms. A low ratio gives a low gain, which
        tells rivals apart; a high one follows the record whatever the model says.
    at : str
        "everywhere" for forces at inputs and ports, "inputs" for forces at the inputs alone.
    noise : float
        Sensor noise over the rms of each output.

    Returns
    -------
    ndarray, shape (n, n_y)
        Gain K of ``x = x + K (y - y_model)`` at each sample.
    """
    m = structure.matrices(theta.astype(float))
    nw, n = structure.n_inputs, structure.n_states
    level = np.sqrt(np.mean(data.inputs**2, axis=1))
    level = np.where(level > 0, level, 1.0)
    drives = [m.B[:, i] * level[i] for i in range(nw)]
    top = max((np.linalg.norm(d) for d in drives), default=1.0) or 1.0
    acts = [] if at == "inputs" and drives else [port.act for port in structure.model.ports]
    for act in acts:
        size = np.linalg.norm(act)
        if size > 0:
            padded = np.zeros(n)
            padded[: act.size] = act * (top / size)
            drives.append(padded)
    G = np.column_stack(drives) * ratio
    block = np.zeros((2 * n, 2 * n))
    block[:n, :n], block[:n, n:], block[n:, n:] = -m.A, G @ G.T, m.A.T
    # Van Loan: exact covariance of a force that is constant over a sample, as a density
    scale = data.dt
    with np.errstate(over="ignore", invalid="ignore"):
        F = exponential((block * scale)[None])[0]
        Phi = F[n:, n:].T
        Q = Phi @ F[:n, n:]
    diagonal = np.diag(Q)
    if not np.isfinite(Q).all() or diagonal.min(initial=0.0) < -1e-9 * diagonal.max(initial=0.0):
        # a fast pole: the density form overflows or cancels, the held form does not
        held = exponential((np.block([[m.A, G], [np.zeros((G.shape[1], n + G.shape[1]))]]) * scale)[None])[0]
        Phi, gamma = held[:n, :n], held[:n, n:]
        Q = gamma @ gamma.T
    else:
        Q = Q * data.dt
    spread = data.outputs.std(axis=1)
    spread = np.where(spread > 0, spread, 1.0)
    R = noise**2 * np.eye(spread.size)
    size = np.sqrt(np.maximum(np.diag(Q), 1e-12 * np.trace(Q) / n + 1e-300))
    A = Phi * size / size[:, None]  # unit-size states keep the Riccati equation well scaled
    C = m.C * size / spread[:, None]
    Qs = Q / np.outer(size, size)
    Qs = 0.5 * (Qs + Qs.T) + 1e-12 * np.eye(n)
    try:  # unit sizes already, and scipy balances entries that are rounding beyond all bounds
        S = solve_discrete_are(A.T, C.T, Qs, R, balanced=False)
        if not np.isfinite(S).all():
            raise LinAlgError
    except (LinAlgError, ValueError):
        S = _riccati(A, C, Qs, R)  # a state that the outputs cannot see: the finite horizon has a gain
    K = S @ C.T @ np.linalg.inv(C @ S @ C.T + R)
    return np.asarray(K * size[:, None] / spread)


def _riccati(A: Array, C: Array, Q: Array, R: Array, steps: int = 300) -> Array:
    S = Q.copy()
    for _ in range(steps):
        K = S @ C.T @ np.linalg.inv(C @ S @ C.T + R)
        S = A @ (S - K @ C @ S) @ A.T + Q
        S = 0.5 * (S + S.T)
    return S
