"""Estimation of the motion behind a record.

A forward and a backward pass correct the model by its residual.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ...engine.smoother import Smoothed, smooth
from ...systems.discretization import discretize
from ...systems.linear import Array
from .record import ModelOnRecord

__all__ = ["MotionEstimate", "estimated_motion"]

_MEMORY = 0.9  # of the unknown forces, from one sample to the next
_NOISE = 0.02  # sensor noise over the spread of an output, the unit of the force levels that are tried
_LEVELS = (0.01, 0.1, 0.5, 2.0, 10.0)


@dataclass(frozen=True, slots=True, eq=False)
class MotionEstimate:
    """Motion that the record shows.

    Attributes
    ----------
    states : ndarray of shape (n, N)
        States.
    forces : ndarray of shape (m, N)
        Unknown forces at the places.
    likelihood : float
        Log-likelihood per sample of the residual, up to a constant.
    """

    states: Array
    forces: Array
    likelihood: float


def estimated_motion(scene: ModelOnRecord, chosen: Sequence[int] | None = None) -> MotionEstimate:
    """Estimate the states of the recorded motion.

    Unknown forces at the places explain what the model with its known input leaves (first stage of the paper,
    with a Kalman gain). Their common level is the most likely one. A backward pass removes the lag.

    Parameters
    ----------
    scene : ModelOnRecord
        Model on its record, with places.
    chosen : sequence of int, optional
        Places where the forces may act; default all.

    Returns
    -------
    MotionEstimate
    """
    places = scene.places
    assert places is not None
    which = list(range(len(places.places)) if chosen is None else chosen)
    used = [places.places[i] for i in which]
    n, m, ny = places.A.shape[0], len(used), scene.n_outputs
    acts = np.array([p.act for p in used]).T
    through = np.array([p.output for p in used]).T / scene.scale
    C = places.C / scene.scale
    Phi, G, _ = discretize(places.A, acts, scene.dt, "zoh")
    # forces of equal effect: unit output each, over the record
    unit = scene.forced([(i, np.where(np.arange(scene.n_samples) % 7 < 3, 1.0, -1.0)) for i in which])
    size = np.array([float(np.std(u)) for u in unit])
    size = np.where(size > 0, size, np.inf)
    F = np.block([[Phi, G / size], [np.zeros((m, n)), _MEMORY * np.eye(m)]])
    H = np.hstack([C, through / size])
    best: tuple[float, Smoothed] | None = None
    R = _NOISE**2 * np.eye(ny)
    for level in _LEVELS:
        force = (1 - _MEMORY**2) * level**2
        Q = 1e-12 * force * m / (n + m) * np.eye(n + m)  # no direction without any noise
        Q[n:, n:] += force * np.eye(m)
        one = smooth(F, H, Q, R, scene.evidence.with_offset.T, reset=scene.reset)
        if not np.isfinite(one.power) or one.power <= 0:
            continue
        # noise and forces in proportion: their common size is the likeliest one
        value = -ny * np.log(one.power) - one.log_determinant
        if best is None or value > best[0]:
            best = value, one
    if best is None:
        return MotionEstimate(scene.states, np.zeros((m, scene.n_samples)), -np.inf)
    found = best[1]
    change = found.states if np.isfinite(found.states).all() else found.filtered
    return MotionEstimate(scene.states + change[:, :n].T, (change[:, n:] / size).T, best[0])
