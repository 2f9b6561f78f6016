"""The motion behind a record: the model led by its residual, forwards and backwards."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import LinAlgError, solve_discrete_are

from ...jit import compiled
from ...systems.discretization import discretize
from ...systems.linear import Array
from .record import Scene

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


def estimated_motion(scene: Scene, chosen: Sequence[int] | None = None) -> MotionEstimate:
    """States of the motion that the record shows, unknown forces at places allowed for.

    What the model with its known input leaves unexplained is put down to
    forces at the places (first stage of the paper, with a Kalman gain), whose
    common level is the most likely one. A backward pass takes out the lag.

    Parameters
    ----------
    scene : Scene
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
    through = np.array([p.through for p in used]).T / scene.scale
    C = places.C / scene.scale
    Phi, G, _ = discretize(places.A, acts, scene.dt, "zoh")
    # forces of equal effect: unit output each, over the record
    unit = scene.forced([(i, np.where(np.arange(scene.n_samples) % 7 < 3, 1.0, -1.0)) for i in which])
    size = np.array([float(np.std(u)) for u in unit])
    size = np.where(size > 0, size, np.inf)
    F = np.block([[Phi, G / size], [np.zeros((m, n)), _MEMORY * np.eye(m)]])
    H = np.hstack([C, through / size])
    residual = scene.evidence.with_offset
    r = np.ascontiguousarray(residual.T)
    best: tuple[float, Array, Array] | None = None
    R = _NOISE**2 * np.eye(ny)
    for level in _LEVELS:
        Q = np.zeros((n + m, n + m))
        Q[n:, n:] = (1 - _MEMORY**2) * level**2 * np.eye(m)
        scaled = _covariance(F, H, Q, R)
        if scaled is None:
            continue
        S = H @ scaled @ H.T + R
        K = np.linalg.solve(S, H @ scaled).T
        predicted, filtered, innovations = (
            np.zeros((scene.n_samples, n + m)), np.zeros((scene.n_samples, n + m)), np.zeros_like(r),
        )  # fmt: skip
        forwards(F, H, np.ascontiguousarray(K), r, scene.reset, predicted, filtered, innovations)
        weighed = float(np.mean(np.einsum("ki,ij,kj->k", innovations, np.linalg.inv(S), innovations))) / ny
        if not np.isfinite(weighed) or weighed <= 0:
            continue
        value = -ny * np.log(weighed) - float(np.linalg.slogdet(S)[1])
        if best is None or value > best[0]:
            after = scaled - K @ H @ scaled
            back = np.linalg.lstsq(scaled.T, F @ after.T, rcond=1e-12)[0].T
            best = value, _smoothed(filtered, predicted, back, scene.reset), filtered
    if best is None:
        return MotionEstimate(scene.states, np.zeros((m, scene.n_samples)), -np.inf)
    change = best[1] if np.isfinite(best[1]).all() else best[2]
    return MotionEstimate(scene.states + change[:, :n].T, (change[:, n:] / size).T, best[0])


def _covariance(F: Array, H: Array, Q: Array, R: Array) -> Array | None:
    """Steady covariance of the prediction; None where there is none."""
    Q = Q + 1e-12 * np.trace(Q) / Q.shape[0] * np.eye(Q.shape[0])
    try:
        P = solve_discrete_are(F.T, H.T, Q, R)
    except (LinAlgError, ValueError):
        P = Q.copy()
        for _ in range(400):
            K = np.linalg.solve(H @ P @ H.T + R, H @ P).T
            P = F @ (P - K @ H @ P) @ F.T + Q
            P = 0.5 * (P + P.T)
    return P if np.isfinite(P).all() else None


def _smoothed(filtered: Array, predicted: Array, back: Array, reset: NDArray[np.uint8]) -> Array:
    out = filtered.copy()
    backwards(np.ascontiguousarray(back), predicted, reset, out)
    return out


@compiled
def forwards(F, H, K, r, reset, predicted, filtered, innovations):  # type: ignore[no-untyped-def]
    """Filter with a steady gain, begun anew where the free run does."""
    x = np.zeros(F.shape[0])
    for k in range(r.shape[0]):
        if reset[k]:
            x = np.zeros(F.shape[0])
        predicted[k] = x
        innovations[k] = r[k] - H @ x
        x = x + K @ innovations[k]
        filtered[k] = x
        x = F @ x


@compiled
def backwards(back, predicted, reset, out):  # type: ignore[no-untyped-def]
    """Rauch, Tung and Striebel's pass, in place over the filtered states."""
    for k in range(out.shape[0] - 2, -1, -1):
        if not reset[k + 1]:
            out[k] = out[k] + back @ (out[k + 1] - predicted[k + 1])
