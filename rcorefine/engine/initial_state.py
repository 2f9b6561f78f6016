"""Initial state that fits a record, with a prior for brief modes.

The prior lets brief modes start about as large as they are later.
"""

from __future__ import annotations

from functools import partial

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import schur

from ..data.signals import difference, over_time, spreads
from ..gauss_newton import Rows, gauss_newton
from ..systems.discretization import exponential
from ..systems.linear import Array
from .engine import Engine
from .observer import observer_gain
from .structure import Structure

_RATIOS = (0.1, 0.01)  # observer gains on the way to the free run, high to low
_NEAR = 1e-3  # relative decrease of the cost below which such a step ends, since it is only an initial guess
_BRIEF = 0.63  # decay of a mode per sample that leaves a hundredth after ten samples
_TELLS = 0.5  # error of the free run over the spread of the output up to which the model's modes count
_WIDE = 1000.0  # prior standard deviation of a brief mode over its largest motion


def brief_modes(engine: Engine) -> Array:
    """Return a prior of the initial state for modes that decay quickly.

    It lets modes that decay within a few samples start about as large as they are later. The record hardly
    sees where they started, and the initial state would follow the noise of those samples to any size; what
    is nonlinear blows up there.

    Parameters
    ----------
    engine : Engine
        Structure on its record; its model counts as it is without effects.

    Returns
    -------
    ndarray, shape (k, n)
        Rows whose products with the initial state have standard deviation 1; none where no mode is brief, or
        where the model explains too little for its modes to count.
    """
    structure, theta, data = Structure(engine.structure.model), np.zeros(0), engine.data
    n, added = structure.n_states, engine.structure.n_states - structure.n_states
    none = np.zeros((0, n + added))
    if not n or structure.model.controller is not None:  # in a loop the modes are those of the closed loop
        return none
    Phi = exponential(structure.matrices(theta).A[None] * data.dt)[0]
    if not np.isfinite(Phi).all() or np.abs(np.linalg.eigvals(Phi)).min() >= _BRIEF:
        return none
    # states of the free run and of the observer: how large they become
    bare = Engine(structure, data, substeps=engine.substeps)
    gain = observer_gain(structure, theta, data, 1.0)
    with np.errstate(all="ignore"):
        free, corrected = (
            bare.run(theta, sensitivity=False, gain=g, histories=True, check=False)
            for g in (np.zeros_like(gain), gain)
        )
        left = over_time(np.std, data.outputs - free.outputs)
    # the plant has other modes than such a model
    if not np.all(left < _TELLS * over_time(np.std, data.outputs)):
        return none
    sound = [run.states for run in (free, corrected) if np.isfinite(run.states).all()]
    sizes = np.max([np.abs(states).max(axis=1) for states in sound], axis=0)
    sizes = np.where(sizes > 0, sizes, 1.0)
    # left invariant subspace of the brief modes, by an ordered Schur form
    _, Q, k = schur((Phi * sizes / sizes[:, None]).T / _BRIEF, "real", sort="iuc")
    rows = Q[:, :k].T / sizes
    moved = np.max([np.abs(rows @ states).max(axis=1) for states in sound], axis=0)
    rows = rows[moved > 0] / (_WIDE * moved[moved > 0])[:, None]
    return np.pad(rows, ((0, 0), (0, added)))


def added_states(engine: Engine, theta: Array) -> Array:
    """Return a wide prior of initial states that effects add.

    It has rows like that of `brief_modes`. The states start about as large as they become with the
    coefficients `theta`. A lag that vanishes could otherwise start anywhere, with the same outputs.
    """
    structure, n = engine.structure, engine.structure.linear_model.n_states
    run = engine.run(theta, sensitivity=False, histories=True, check=False)
    size = np.abs(run.states[n:]).max(axis=1, initial=0.0)
    moved = np.isfinite(size) & (size > 0)
    return np.asarray(np.eye(structure.n_states)[n:][moved] / (_WIDE * size[moved])[:, None])


def estimate_initial_state(
    engine: Engine,
    theta: Array,
    weights: Array | None = None,
    *,
    gain: Array | None = None,
    use: NDArray[np.bool_] | None = None,
) -> Array:
    """Initial state that brings the free run closest to the record.

    Parameters
    ----------
    engine : Engine
        Structure on its record.
    theta : ndarray, shape (p,)
        Coefficients, held.
    weights : ndarray, shape (n_y,), optional
        Weight of each output, default one over its standard deviation.
    gain : ndarray, shape (n, n_y), optional
        Observer gain; the free run without it.
    use : ndarray of bool, shape (N, n_y), optional
        Which outputs were measured; by default all.

    Returns
    -------
    ndarray, shape (n,)
        Gauss-Newton estimate (exact in one step for a linear model); directions
        that the record cannot see stay at zero, and `brief_modes` where they move.
    """
    if weights is None:
        weights = 1.0 / spreads(engine.data.outputs)
    judged = engine.judged(theta) & ~np.isnan(engine.data.outputs)
    weights = weights[:, None] * (judged if use is None else judged & use.T)
    calm = theta.copy()
    if not engine.structure.is_linear:
        calm[engine.structure.port_columns] = 0.0  # first guess without nonlinear forces
    prior = np.zeros((0, engine.structure.n_states))

    # residual and Jacobian of the initial state; rows of the prior below
    def rows(theta: Array, point: Array, gain: Array | None = gain) -> Rows:
        run = engine.run(theta, point, sensitivity=False, initial_state=True, gain=gain, use=use, check=False)
        error = (weights * difference(run.outputs, engine.data.outputs)).ravel()
        slopes = (weights[:, :, None] * run.sensitivity).reshape(error.size, -1)
        sound = run.blew_up < 0 and np.isfinite(slopes).all()
        error, slopes = np.append(error, prior @ point), np.vstack([slopes, prior])
        return Rows(error if sound else np.full(1, np.inf), slopes)

    rest = np.zeros(engine.structure.n_states)
    # Gauss-Newton on the linear part, exact in one step
    descend = partial(gauss_newton, sizes=engine.state_sizes(theta), tolerance=1e-8, damping=0.0)
    linear = partial(descend, partial(rows, calm), rest, evaluations=3)
    found = linear()
    known = brief_modes(engine) if gain is None and np.isfinite(found.cost) else prior
    if np.any(np.abs(known @ found.point) > 1.0):
        # prior in units of the remaining residual, so that an exact record keeps its exact initial state
        left = 2.0 * found.cost / max(1.0, float(np.count_nonzero(weights)))
        prior = known * np.sqrt(left)
        found = linear()
    if engine.structure.is_linear:
        return found.point
    whole = partial(rows, theta)
    # the initial state of the linear part may lie far outside of the motion: compare it with rest
    nearer = min(found.point, rest, key=lambda point: float(np.sum(whole(point).residual ** 2)))
    # nonlinear: approach the free run by observers of falling gain, then refine it
    for ratio in _RATIOS if gain is None else ():  # a free run has local minima, an observer few
        lead = observer_gain(engine.structure, theta, engine.data, ratio)
        if np.isfinite(lead).all():
            nearer = descend(partial(rows, theta, gain=lead), nearer, evaluations=12, tolerance=_NEAR).point
    return descend(whole, nearer, evaluations=40).point
