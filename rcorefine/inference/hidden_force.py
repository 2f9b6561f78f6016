"""Estimate of the missing force at a place, without a force law."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from ..data.measurement import Measurement
from ..engine.smoother import Smoothed, smooth
from ..models.ports import Port, felt
from ..systems.discretization import discretize
from ..systems.linear import Array, LinearModel
from .refinement import Refinement

_LEVELS = np.logspace(-3, 1, 9)  # of the force that drives the estimate, tried by likelihood
_MEMORY = (3.0, 12.0, 50.0)  # samples for which it lasts, tried too
_TRIED_ON = 1000  # samples


def estimated_force(
    model: Refinement, noise: Array, port: Port, record: Measurement
) -> tuple[Array, Array, float]:
    """Estimate the missing force at a place, and the motion.

    The estimate uses the record and the model as it is; it assumes no force law.

    The force is one more state of a Kalman smoother, driven by noise. The likelihood chooses the noise
    level and the correlation time. The mean of the force is not estimated.

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
    std : float
        Standard deviation of the force, far from both ends of the record.
    """
    linear = LinearModel.from_statespace(model.system)
    n = linear.n_states
    act = np.zeros(n)
    act[: port.act.size] = port.act
    B = np.vstack([linear.B, np.zeros((1, linear.n_inputs))])
    C = np.column_stack([linear.C, felt(port, model.physical_model.output_rate)])
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
        drive = (G0 @ w + G1 @ np.hstack([w[:, 1:], w[:, -1:]])).T
        # a force that moves the output by its own size within a sample: the scale of the walk
        reach = np.linalg.norm(C @ F[:, -1]) + np.linalg.norm(C[:, -1]) + 1e-300
        unit = float(np.linalg.norm(y.std(axis=1))) / reach
        runs += [_Walk(F, C, R, y.T, drive, share * unit) for share in _LEVELS]
    likelihoods = [run.smoothed(_TRIED_ON).log_likelihood for run in runs]
    if not np.isfinite(likelihoods).any():
        return np.zeros(record.n_samples), np.zeros((n, record.n_samples)), np.inf
    best = runs[int(np.nanargmax(likelihoods))]
    smoothed = best.smoothed()
    states = (smoothed.states * best.size).T
    std = best.size[n] * np.sqrt(max(smoothed.covariance[n, n], 0.0))
    return states[n], states[:n], float(std)


class _Walk(NamedTuple):
    """A model whose last state is a force, driven by noise of a certain level."""

    F: Array
    C: Array
    R: Array
    outputs: Array  # (N, n_y)
    drive: Array  # (N, n + 1)
    level: float

    @property
    def size(self) -> Array:
        """Of each state."""
        return np.append(np.ones(self.F.shape[0] - 1), self.level)

    def smoothed(self, most: int | None = None) -> Smoothed:
        """States in their sizes, over the first samples or all."""
        size = self.size
        Q = 1e-12 * np.mean(np.diag(self.R)) * np.eye(size.size)  # no direction without any noise
        Q[-1, -1] += 1.0
        F, C, drive = self.F * size / size[:, None], self.C * size, self.drive[:most] / size
        return smooth(F, C, Q, self.R, self.outputs[:most], drive=drive)
