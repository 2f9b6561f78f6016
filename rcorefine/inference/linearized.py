"""Closest linear model of a nonlinear model along its motion."""

from __future__ import annotations

import numpy as np

from ..engine.engine import Trajectory
from ..engine.structure import Structure
from ..systems.linear import Array

__all__ = ["linearized"]


def linearized(structure: Structure, theta: Array, run: Trajectory, inputs: Array) -> tuple[Array, Array]:
    """Return A and C with nonlinear forces replaced by linear fits.

    Each fit is the best one along the motion.

    Parameters
    ----------
    structure : Structure
        Model with effects.
    theta : ndarray, shape (p,)
        Coefficients.
    run : Trajectory
        Motion, with its histories.
    inputs : ndarray, shape (n_w, N)
        Inputs over the same time.

    Returns
    -------
    A : ndarray, shape (n, n)
    C : ndarray, shape (n_y, n)
    """
    matrices, n, ports = structure.matrices(theta), structure.n_states, structure.n_ports
    A, C = matrices.A.astype(float), matrices.C.astype(float)
    forces, x = np.nan_to_num(run.forces), np.nan_to_num(run.states)
    drive = np.vstack([x, inputs, np.ones((1, x.shape[1]))])
    for i in range(ports):
        rows = matrices.P[[i, ports + i]].astype(float)
        motion = (rows @ drive[: rows.shape[1]]).T
        motion = motion - motion.mean(axis=0)
        size = np.sqrt(np.mean(motion**2, axis=0))
        scale = np.where(size > 0, size, 1.0)
        slopes = np.linalg.lstsq(motion / scale, forces[i] - forces[i].mean(), rcond=1e-8)[0]
        along = np.where(size > 0, slopes / scale, 0.0) @ rows[:, :n]
        A = A + np.outer(matrices.E[:, i].astype(float), along)
        C = C + np.outer(matrices.G[:, i].astype(float), along)
    if structure.field is not None:
        taken = matrices.P[2 * ports :].astype(float)
        moved = (taken @ drive).T
        moved = moved - moved.mean(axis=0)
        scale = np.sqrt(np.mean(moved**2, axis=0))
        scale = np.where(scale > 0, scale, 1.0)
        rows = forces[ports:] - forces[ports:].mean(axis=1, keepdims=True)
        by = np.linalg.lstsq(moved / scale, rows.T, rcond=1e-8)[0].T / scale @ taken[:, :n]
        A = A + matrices.E[:, ports:].astype(float) @ by
        C = C + matrices.G[:, ports:].astype(float) @ by
    return A, C
