"""What the monitor learns from the first, healthy samples: gain of the observer, and its noise."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.stats import norm

from ...data.measurement import Measurement
from ...engine.engine import Engine
from ...engine.observer import observer_gain
from ...engine.simulation import estimate_initial_state
from ...engine.structure import Structure
from ...exceptions import DataError
from ...inference.autoregression import autoregression
from ...inference.whitening import innovations
from ...systems.linear import Array

__all__ = ["Healthy", "learn"]

#: Unknown force over the measured input, relative to sensor noise of 3 %: observer gains that are tried.
RATIOS = (0.0, *(float(r) for r in np.geomspace(2**-11, 2, 13)))
_FREE = 0.9999  # spectral radius up to which the model may run free
_WORTH = 3.0  # log-likelihood that another gain has to earn
_MOST_MISSING = 0.2
_STANDS_OUT = 8.0  # standard deviations at which a sample is left out of what is learned
_MOST_ALONE = 0.05  # share of samples up to which they are outliers, not the noise itself
_PASSES = 3


@dataclass(frozen=True, slots=True, eq=False)
class Healthy:
    """Observer and noise of the healthy structure.

    Attributes
    ----------
    ratio : float
        Unknown force over the measured input that the gain answers to.
    gain : ndarray, shape (n, n_y)
        Observer gain.
    x0 : ndarray, shape (n,)
        Initial state.
    filters : ndarray, shape (n_y, q)
        Whitening polynomials without the leading one.
    mix : ndarray, shape (n_y, n_y)
        Lower triangular; makes the whitened innovations independent, of unit variance.
    settle : int
        Samples after which the observer has forgotten a wrong state.
    orders : tuple of int
        Order of the whitening filter of each output.
    mean : ndarray, shape (n_y,)
        Mean of the innovations: offset of the sensors.
    """

    ratio: float
    gain: Array
    x0: Array
    filters: Array
    mix: Array
    settle: int
    orders: tuple[int, ...]
    mean: Array


def learn(
    structure: Structure,
    theta: Array,
    substeps: int,
    data: Measurement,
    use: NDArray[np.uint8],
    disturbance: float | None,
) -> Healthy:
    """Choose the observer and its whitening filter by likelihood.

    Parameters
    ----------
    structure, theta, substeps
        Healthy model.
    data : Measurement
        Healthy samples.
    use : ndarray of uint8, shape (N, n_y)
        Which outputs were measured.
    disturbance : float or None
        Declared ratio; None to choose it.

    Returns
    -------
    Healthy

    Raises
    ------
    DataError
        If an output is hardly there, or does not move.
    """
    for i, label in enumerate(structure.linear_model.output_labels):
        there = use[:, i] > 0
        if there.mean() < 1 - _MOST_MISSING:
            raise DataError(
                f"output {label!r} is missing in {100 * (1 - there.mean()):.0f} % of the learning phase "
                f"({use.shape[0]} samples); learn from a whole stretch, or leave it out of the model"
            )
        if np.ptp(data.outputs[i][there]) == 0:
            raise DataError(f"output {label!r} is constant over the learning phase; check the sensor")
    engine = Engine(structure, data, substeps=substeps)
    sound = use
    for _ in range(_PASSES):
        healthy, white = _chosen(engine, theta, data, disturbance, sound)
        before, sound = sound, np.where(_alone(white, sound), 0, sound).astype(np.uint8)
        if np.array_equal(before, sound):
            break
    return healthy


def _alone(white: Array, use: NDArray[np.uint8]) -> NDArray[np.bool_]:
    """Samples that stand out of the whitened innovations, shape (N, n_y); none where they are many."""
    size = np.abs(white.T)
    usual = np.array([np.median(row[there > 0]) for row, there in zip(size.T, use.T, strict=True)])
    out = (size > _STANDS_OUT / norm.ppf(0.75) * usual) & (use > 0) & (usual > 0)
    return np.asarray(out & (out.mean(axis=0) < _MOST_ALONE))


def _chosen(
    engine: Engine, theta: Array, data: Measurement, disturbance: float | None, use: NDArray[np.uint8]
) -> tuple[Healthy, Array]:
    """The likeliest observer, and its whitened innovations."""
    structure = engine.structure
    best: tuple[float, Healthy, Array] | None = None
    for ratio in RATIOS if disturbance is None else (disturbance,):
        for everywhere in (False, True):
            gain, radius = _gain(structure, theta, data, ratio, everywhere)
            if ratio == 0 and radius > _FREE:
                if disturbance is None:
                    continue  # what was once wrong about the state would stay wrong
                gain, radius = _gain(structure, theta, data, RATIOS[1], everywhere)
            found = _evaluated(engine, theta, gain, ratio, radius, use)
            if found is not None and (best is None or found[0] < best[0] - _WORTH):
                best = found
            if ratio == 0:
                break
    if best is None:
        raise DataError(
            "no observer of the healthy model follows the learning phase; check model, units and channels "
            "with compare(), or refine the model first"
        )
    return best[1:]


def _gain(
    structure: Structure, theta: Array, data: Measurement, ratio: float, everywhere: bool
) -> tuple[Array, float]:
    """Gain, and the spectral radius of the observer."""
    matrices = structure.matrices(theta)
    n = structure.n_states
    Phi = structure.discretize(theta, data.dt, derivatives=False).M[:, :n]
    if ratio == 0:
        K = np.zeros((n, structure.n_outputs))
    else:
        # the unknown force comes in where the measured one does, or at the ports too
        K = observer_gain(structure, theta, data, ratio, at="everywhere" if everywhere else "inputs")
    closed = Phi @ (np.eye(n) - K @ matrices.C.astype(float))
    return K, float(np.abs(np.linalg.eigvals(closed)).max(initial=0.0))


def _evaluated(
    engine: Engine, theta: Array, gain: Array, ratio: float, radius: float, use: NDArray[np.uint8]
) -> tuple[float, Healthy, Array] | None:
    """Minus log-likelihood, the observer and what its filter leaves; None where it cannot follow."""
    y, flags = engine.data.outputs, use.T > 0
    spread = np.maximum(y.std(axis=1), 1e-300)
    K = gain if gain.any() else None
    x0 = estimate_initial_state(engine, theta, 1.0 / spread, gain=K, use=use > 0)
    run = engine.run(theta, x0, sensitivity=False, gain=K, use=use > 0, check=False)
    if run.blew_up >= 0 or not np.isfinite(run.outputs).all():
        return None
    e = y - run.outputs
    mean = np.array([row[there].mean() for row, there in zip(e, flags, strict=True)])
    e = np.where(flags, e - mean[:, None], 0.0)
    rows, orders, white = [], [], []
    cost = 0.0
    for i in range(e.shape[0]):
        a, variance = autoregression(e[i], known=flags[i])
        floor = max(1e-24 * spread[i] ** 2, 1e-300)  # a record without noise
        n = int(flags[i].sum())
        cost += 0.5 * n * math.log(max(variance, floor)) + 0.5 * math.log(n) * (a.size - 1)
        rows.append(a[1:])
        orders.append(a.size - 1)
        white.append(innovations(a, e[i]))
    q = max(orders)
    filters = np.zeros((len(rows), q))
    for i, row in enumerate(rows):
        filters[i, : row.size] = row
    w = np.array(white)[:, q:]
    covariance = np.atleast_2d(np.cov(w, bias=True))
    diagonal = np.maximum(np.diag(covariance), 1e-24 * spread**2)
    covariance = covariance + np.diag(diagonal - np.diag(covariance) + 1e-12 * diagonal)
    lower = np.linalg.cholesky(covariance)
    correlation = covariance / np.sqrt(np.outer(diagonal, diagonal))
    cost += 0.5 * w.shape[1] * math.log(max(np.linalg.det(correlation), 1e-300))
    settle = math.ceil(math.log(0.01) / math.log(radius)) if 0 < radius < 1 else 1
    mix = np.linalg.inv(lower)
    healthy = Healthy(ratio, gain, x0, filters, np.tril(mix), settle, tuple(orders), mean)
    return cost, healthy, np.array(white)
