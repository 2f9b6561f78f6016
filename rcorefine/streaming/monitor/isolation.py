"""Identification of the effect behind a change.

Each candidate is fitted to the samples since the change, in the observer's form.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.stats import chi2

from ...data.measurement import Measurement
from ...diagnosis.hypothesis import unphysical
from ...effects.effect import Effect, hold_coefficients
from ...engine.engine import Engine
from ...engine.structure import Structure
from ...gauss_newton import Rows, gauss_newton
from ...inference.covariance import covariance, standard_deviations
from ...inference.levels import levels
from ...inference.problem import natural_sizes
from ...inference.starts import Motion, law_widths, shape_starts
from ...inference.whitening import innovations
from ...systems.linear import Array
from ..samples import Flags, Integers

_EVALUATIONS = 20
_LITTLE = 0.01  # twice the log-likelihood that a last step may still add
_MOST_STARTS = 2
_REACH = 8.0
_LEFT = 1e-3  # chance that the noise alone leaves more
_HUGE = 1e100  # errors and slopes beyond which the model has blown up


@dataclass(frozen=True, eq=False)
class Segment:
    """Samples since the change, and how the healthy model is led through them.

    Attributes
    ----------
    structure : Structure
        Healthy model.
    theta : ndarray, shape (p,)
        Its coefficients.
    substeps : int
        Substeps per sample.
    data : Measurement
        Samples, gaps filled.
    use : ndarray of uint8, shape (N, n_y)
        Which outputs were measured.
    x0 : ndarray, shape (n,)
        State before the first sample.
    gain : ndarray, shape (n, n_y)
        Observer gain.
    filters, mix : ndarray
        Whitening, the present noise level included.
    scale : ndarray, shape (N, n_y)
        By how much the noise is larger at each sample.
    free_state : bool
        Whether the initial state is not to be trusted, and is fitted too.
    """

    structure: Structure
    theta: Array
    substeps: int
    data: Measurement
    use: Flags
    x0: Array
    gain: Array
    filters: Array
    mix: Array
    scale: Array
    free_state: bool

    @cached_property
    def motion(self) -> Motion:
        """Motion at the ports, for the shapes of laws."""
        return Motion(self.structure, self.theta, self.data)

    @cached_property
    def held(self) -> Structure:
        """Healthy model with all coefficients held.

        A fit of a candidate needs no derivatives by them.
        """
        healthy = self.structure
        effects = [
            hold_coefficients(
                effect, {n: float(healthy.value(self.theta, i, n)) for n in effect.coefficients}
            )
            for i, effect in enumerate(healthy.effects)
        ]
        return Structure(healthy.model, effects, constants=healthy.constants)

    @cached_property
    def judged(self) -> NDArray[np.bool_]:
        """Samples that are whitened, shape (N,).

        They and the past of the filters were measured.
        """
        # a sample counts if it and the q samples before were measured
        whole = self.use.all(axis=1)
        q = self.filters.shape[1]
        if whole.size <= q:
            return np.zeros(whole.size, dtype=bool)
        known = np.lib.stride_tricks.sliding_window_view(whole, q + 1).all(axis=1)
        return np.concatenate([np.zeros(q, dtype=bool), known])

    def whiten(self, errors: Array) -> Array:
        """Return innovations as independent rows of unit variance.

        `errors` has shape (n_y, N) or (n_y, N, p).
        """
        ny, N = errors.shape[:2]
        there = self.judged
        flags = self.use.T > 0
        # autoregressive filter of each output, over its standard deviation
        shape = flags.reshape(ny, N, *([1] * (errors.ndim - 2)))
        filled = np.where(shape, errors, 0.0)
        white = np.array([innovations(np.r_[1.0, self.filters[i]], filled[i]) for i in range(ny)])
        white /= self.scale.T.reshape(shape.shape)
        # then decorrelate the outputs
        mixed = np.tensordot(self.mix, white, axes=(1, 0))[:, there]
        return mixed.reshape(-1, *errors.shape[2:])


@dataclass(frozen=True, slots=True, eq=False)
class CandidateFit:
    """One candidate fitted.

    Attributes
    ----------
    effect : Effect
        Candidate.
    coefficients : ndarray, shape (p,)
        Estimates.
    covariance : ndarray, shape (p, p)
        Of these.
    cost : float
        Sum of squares of the whitened innovations.
    points : int
        Their number.
    state : ndarray, shape (n,)
        State before the first sample.
    doubt : ndarray, shape (n, n)
        Covariance of that, zero where it was given.
    """

    effect: Effect | None
    coefficients: Array
    covariance: Array
    cost: float
    points: int
    state: Array
    doubt: Array

    @property
    def std(self) -> Array:
        """Standard deviations, shape (p,)."""
        return standard_deviations(self.covariance)

    @property
    def reaches_noise(self) -> bool:
        """Return whether no more is left than independent noise."""
        # chi-square test of the remaining sum of squares
        return self.cost < float(chi2.isf(_LEFT, max(self.points, 1)))

    def possible(self, healthy: Structure) -> bool:
        """Return whether a friction that the model lacks resists the motion."""
        # friction of the wrong sign would drive the motion
        effect = self.effect
        if effect is None or any((e.kind, e.place) == (effect.kind, effect.place) for e in healthy.effects):
            return True
        values = dict(zip(effect.free, map(float, self.coefficients), strict=True))
        return not unphysical(effect, values, healthy.model)

    @property
    def determined(self) -> bool:
        """Return whether the samples determine a size of the effect."""
        if self.effect is None:
            return True
        # is any size at least `moved` standard deviations from zero?
        free, shaping = self.effect.free, self.effect.spec.shaping
        sizes = [i for i, name in enumerate(free) if name not in shaping] or list(range(len(free)))
        return bool((np.abs(self.coefficients) > levels().moved * self.std)[sizes].any())


def fit_candidate(
    segment: Segment,
    effect: Effect | None,
    starts: Sequence[Array] = (),
    *,
    alone: bool = False,
    worst: float = math.inf,
) -> CandidateFit:
    """Fit one candidate (None: the healthy model) by damped Gauss-Newton.

    Parameters
    ----------
    segment : Segment
        Samples.
    effect : Effect or None
        Candidate.
    starts : sequence of ndarray
        Coefficients to start from, beside those at which the effect is absent.
    alone : bool
        Start from `starts` alone, where there are any.
    worst : float
        Cost above which a fit is given up once it will not come below.

    Returns
    -------
    CandidateFit
    """
    # healthy model plus the candidate, with the widths of its law on this motion
    old = structure = segment.held
    if effect is not None:
        bare = Structure(old.model, [*old.effects, effect], constants=old.constants)
        widths = law_widths(bare, segment.motion) | old.constants
        structure = Structure(old.model, bare.effects, constants=widths)
    steps = max(segment.substeps, 1 if structure.is_linear else 2)
    engine = Engine(structure, segment.data, substeps=steps)
    own, theta = structure.parameters, structure.start()
    # state and gain of the healthy model; the candidate's own states start at zero
    extra = structure.n_states - old.n_states
    led = replace(segment, x0=np.pad(segment.x0, (0, extra)), gain=np.pad(segment.gain, ((0, extra), (0, 0))))
    lower, upper = _bounds(own, segment.data.dt)
    # starts: those given, then those that the motion suggests
    points = [np.asarray(s, dtype=float) for s in starts if len(s) == len(own) and np.isfinite(s).all()]
    if effect is not None and not (alone and points):
        points += shape_starts(structure, theta, segment.motion, len(old.effects))[:_MOST_STARTS]
    # gap, limit or fading speed: within a factor of 8 of the start; far off its motion a law is another one
    shaping = np.array([q.name in structure.effects[q.effect].spec.shaping for q in own], dtype=bool)
    loose = np.arange(structure.n_parameters)
    found: list[CandidateFit] = []
    # damped Gauss-Newton from each start; the best one counts
    for start in points or [np.zeros(0)]:
        low = np.where(shaping, np.maximum(lower, start / _REACH), lower)
        high = np.where(shaping, np.minimum(upper, start * _REACH), upper)
        begin = np.clip(start, low, high)
        found.append(descend(led, engine, begin, loose, low, high, effect=effect, worst=worst))
    return min(found, key=lambda fit: fit.cost)


def _bounds(parameters: Sequence[Any], dt: float) -> tuple[Array, Array]:
    """Bounds of coefficients, a little inside those of physics."""
    lower = np.array([q.lower for q in parameters])
    upper = np.array([q.upper for q in parameters])
    lower += 0.02 * np.abs(np.where(np.isfinite(lower), lower, 0.0))  # a spring that is gone has no slope
    upper -= 1e-3 * np.abs(np.where(np.isfinite(upper), upper, 0.0))
    lags = np.array([q.name == "time_constant" for q in parameters], dtype=bool)
    return np.where(lags, np.maximum(lower, 1e-3 * dt), lower), upper


def descend(
    segment: Segment,
    engine: Engine,
    theta: Array,
    loose: Integers,
    lower: Array,
    upper: Array,
    *,
    effect: Effect | None = None,
    worst: float = math.inf,
    prior: tuple[Array, Array] | None = None,
) -> CandidateFit:
    """Fit the coefficients `loose` of `theta` from one starting value.

    The initial state is fitted as well if it is free. `prior` holds the mean of the coefficients and a root
    of their covariance.
    """
    start, x0, y = theta[loose], segment.x0, segment.data.outputs
    p, n = start.size, x0.size
    free = n if segment.free_state else 0
    K = segment.gain if segment.gain.any() else None
    slopes = p > 0 or free > 0
    sizes = np.concatenate([natural_sizes(engine.structure, [engine.data])[loose], np.ones(free)])
    nothing = Rows(np.full(1, np.inf), np.zeros((1, p + free)))

    # residual and Jacobian, whitened: coefficients first, then the initial state
    def rows(point: Array) -> Rows:
        there = theta.copy()
        there[loose] = point[:p]
        begin = x0 + point[p:] if free else x0
        run = engine.run(
            there, begin, sensitivity=slopes, initial_state=slopes and free > 0, gain=K,
            use=segment.use > 0, check=False,
        )  # fmt: skip
        if run.blew_up >= 0 or not np.isfinite(run.outputs).all():
            return nothing
        r = segment.whiten(run.outputs - y)
        columns = np.r_[loose, theta.size : theta.size + free]
        J = segment.whiten(run.sensitivity[:, :, columns]) if slopes else np.zeros((r.size, 0))
        # prior as additional rows
        if prior is not None:
            centre, root = prior
            precision = np.linalg.inv(root)
            r = np.concatenate([r, precision @ (point[:p] - centre)])
            J = np.vstack([J, np.pad(precision, ((0, 0), (0, free)))])
        sound = np.abs(r).max(initial=0.0) < _HUGE and np.abs(J).max(initial=0.0) < _HUGE
        # no more points than unknowns tell nothing
        return Rows(r, J) if sound and r.size > point.size else nothing

    steps = 0

    # converged, or too far behind the best candidate so far
    def settled(cost: float, gain: float) -> bool:
        nonlocal steps
        steps += 1
        return 2.0 * gain < _LITTLE or (steps > 3 and 2.0 * (cost - gain) > worst)

    beyond = np.full(free, np.inf)
    run = gauss_newton(
        rows,
        np.concatenate([start, np.zeros(free)]),
        lower=np.concatenate([lower, -beyond]),
        upper=np.concatenate([upper, beyond]),
        sizes=sizes,
        evaluations=_EVALUATIONS if start.size + free else 1,
        settled=settled,
    )
    # covariance (J'J)^-1 of coefficients and initial state
    point, cost, (r, J, _) = run.point, 2.0 * run.cost, run.rows
    whole = covariance(J.T @ J) if math.isfinite(cost) else np.diag(np.full(p + free, np.inf))
    if prior is not None and math.isfinite(cost):
        # in units of the prior every singular value is 1 or more: none is lost beside strong data
        felt, state = J[:, :p] @ prior[1], J[:, p:]
        _, sizes, ways = np.linalg.svd(felt - state @ np.linalg.lstsq(state, felt, rcond=None)[0], False)
        wide = prior[1] @ (ways.T / sizes)
        whole[:p, :p] = wide @ wide.T
    doubt = whole[p:, p:] if free else np.zeros((n, n))
    points = r.size if math.isfinite(cost) else 0
    return CandidateFit(effect, point[:p], whole[:p, :p], cost, points, x0 + point[p:] if free else x0, doubt)
