"""Hypotheses, their fits (trials), and their evidence by Laplace's method."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property, partial

import numpy as np

from ..data.records import at_rest
from ..effects.effect import Effect, unit_forces
from ..engine.point import resting, tangents
from ..inference.covariance import covariance, standard_deviations
from ..inference.f_tests import Basis, project
from ..inference.fitted import FittedModel, coefficient_covariance, evaluated
from ..inference.outcome import fit_of
from ..inference.parameters import estimated, parameter_table
from ..inference.problem import Descent, Problem
from ..models.operating_point import sensed
from ..models.physical_model import PhysicalModel
from ..systems.linear import Array
from .noise import Noise, noise_of, rounding_step
from .nuisances import Nuisance, Parameters, UnmeasuredForce
from .residual_tests import TestedResidual

#: Prior probability of each relative standard deviation (spread) of the parameters.
SPREADS = {0.05: 0.6, 0.2: 0.3, 1.0: 0.1}
_NEAR = 5.0  # standard deviations, by which derivatives hardly change
_FINE = 8  # times the substeps of the fit
_EXACT = 0.1  # of its noise, below which a residual is that of the arithmetic
_EQUAL = 0.01  # difference of the outputs of equal hypotheses, as a share of their change
_SHIFTED = 0.1  # the same of two delays: an output is interpolated between samples, an input held


@dataclass(frozen=True)
class Hypothesis:
    """A set of missing effects with its nuisances.

    Attributes
    ----------
    effects : tuple of Effect
        Missing effects; empty if nothing is missing.
    nuisances : frozenset of Nuisance
        Nuisances, estimated together with the effects. The noise is chosen by likelihood instead.
    """

    effects: tuple[Effect, ...] = ()
    nuisances: frozenset[Nuisance] = frozenset()

    @property
    def key(self) -> tuple[frozenset[Effect], frozenset[Nuisance]]:
        """Return effects and nuisances as sets, without the order of effects."""
        return frozenset(self.effects), self.nuisances

    @property
    def floated(self) -> bool:
        """Return whether the parameters of the model are re-estimated."""
        return self.spread > 0

    @property
    def spread(self) -> float:
        """Return the prior spread of the parameters in the fit, 0 if held."""
        return max((one.spread for one in self.nuisances if isinstance(one, Parameters)), default=0.0)

    @property
    def ratio(self) -> float:
        """Return the ratio of unmeasured to measured force, 0 without one."""
        return max((one.ratio for one in self.nuisances if isinstance(one, UnmeasuredForce)), default=0.0)

    def log_prior(self, library: int) -> float:
        """Return the log prior probability.

        Each effect is one of `library` equally probable candidates.
        """
        each = float(np.log(max(library, 2)))
        return sum(one.log_prior for one in self.nuisances) - each * len(self.effects)


@dataclass(frozen=True, eq=False)
class Start:
    """Starting values of a fit.

    Attributes
    ----------
    values : list of dict
        Coefficients of each effect by name.
    theta : ndarray
        Coefficients of the base.
    states : ndarray, shape (n_records, n)
        Initial states.
    widths : dict
        By place: the width over which the jump of a force law is smoothed there.
    """

    values: list[dict[str, float]]
    theta: Array
    states: Array
    widths: dict[str, float] = field(default_factory=dict)

    def shared(self, effects: Sequence[Effect], absent: Start, share: float) -> Start:
        """Return the start with reduced effects.

        The sizes of the effects are multiplied by the share. So are the differences of `theta` and of the
        initial states from those of `absent`. Shaping coefficients and secant effects keep their values.
        """
        if share == 1.0:
            return self
        # reduce sizes, not shapes; theta and states move toward the model without the effects
        values = [
            {n: v if n in e.spec.shaping or e.spec.secant else share * v for n, v in own.items()}
            for e, own in zip(effects, self.values, strict=True)
        ]
        n = min(absent.states.shape[1], self.states.shape[1])
        states = absent.states[:, :n] + share * (self.states[:, :n] - absent.states[:, :n])
        theta = absent.theta + share * (self.theta - absent.theta)
        return replace(self, values=values, theta=theta, states=states)


def likeliest_noise(problem: Problem, colored: bool) -> Callable[[Sequence[Array]], Noise]:
    """Return the function that gives the likeliest noise of residuals.

    Outputs and rounding steps are those of the records, in units of the weights. Noise is white and normal in
    frequency responses, and if it is not `colored`.
    """
    # outputs in the weighted units of the residuals, with their rounding steps
    outputs = [problem.weights[:, None] * r.outputs for r in problem.records]
    colored = colored and problem.color != 0
    steps = [rounding_step(row) if colored else 0.0 for row in np.concatenate(outputs, axis=1)]
    return partial(noise_of, outputs=outputs, steps=steps, most=problem.color if colored else 0)


@dataclass(eq=False)
class Trial:
    """A fitted hypothesis.

    Attributes
    ----------
    hypothesis : Hypothesis
        Effects and nuisances.
    base : FittedModel
        The model with its nuisances, without the effects.
    problem, point
        Estimation problem, and the point of the fit.
    run : Descent
        Descent that ended at this point; its evaluation has plain weights.
    noise : Noise
        Likeliest noise of the residual.
    log_evidence : dict
        Log evidence by spread of the parameters; one entry if they are held.
    sd : ndarray, shape (p,)
        Standard deviations of the coefficients.
    size : float
        Norm of the reduction of the whitened residual by the effects.
    lack : float
        Log evidence that one more step would gain: small only at a minimum.
    """

    hypothesis: Hypothesis
    base: FittedModel
    problem: Problem
    run: Descent
    noise: Noise = field(init=False)
    log_evidence: dict[float, float] = field(init=False)
    sd: Array = field(init=False)
    size: float = field(init=False)
    lack: float = field(init=False)

    @property
    def effects(self) -> tuple[Effect, ...]:
        """Return the effects beyond those of the base."""
        return self.hypothesis.effects

    @property
    def n_coefficients(self) -> int:
        """Return the number of coefficients that the effects add."""
        return sum(len(effect.free) for effect in self.effects)

    @property
    def first(self) -> int:
        """Return the position of the first of these effects in the structure."""
        return len(self.problem.structure.effects) - len(self.effects)

    @property
    def point(self) -> Array:
        """Return the point of the fit."""
        return self.run.point

    @cached_property
    def blocks(self) -> list[tuple[Array, Array]]:
        """Return residual and Jacobian of each record in units of the weights.

        With an unmeasured force they are those of the Kalman predictor.
        """
        return self.run.blocks(self.problem)

    @property
    def total(self) -> float:
        """Return the log evidence, averaged over the spreads of the parameters."""
        if len(self.log_evidence) == 1:
            return next(iter(self.log_evidence.values()))
        return float(np.logaddexp.reduce([v + np.log(SPREADS[s]) for s, v in self.log_evidence.items()]))

    def near(self, other: Trial) -> bool:
        """Return whether another fit of the same hypothesis is near.

        Then sensitivities at one are sensitivities at the other.
        """
        own, its = (trial.problem.unpack(trial.point)[0] for trial in (self, other))
        return bool(np.all(np.abs(own - its) <= _NEAR * self.sd))

    @cached_property
    def surest(self) -> list[float]:
        """Return the significance of each effect, in standard deviations.

        It is that of its most significant coefficient; shaping coefficients count only if there is no other.
        """
        structure, found = self.problem.structure, []
        theta = self.problem.unpack(self.point)[0]
        for i in range(self.first, len(structure.effects)):
            # sizes of the effect, or its shapes if it has no size
            at = [k for k, q in enumerate(structure.parameters) if q.effect == i]
            shaping = structure.effects[i].spec.shaping
            sizes = [k for k in at if structure.parameters[k].name not in shaping] or at
            found.append(max((abs(theta[k]) / self.sd[k] if self.sd[k] > 0 else np.inf) for k in sizes))
        return found

    def determined(self, least: float) -> bool:
        """Return whether the data determine every effect, with possible signs.

        Each effect needs a size more than `least` standard deviations from zero. The same holds for each
        essential coefficient and for each shaping coefficient with a finite lower bound. No effect of
        friction or of a loss may have a sign that physics excludes.
        """
        # each size and each shape with a bound must differ clearly from zero
        structure, theta = self.problem.structure, self.problem.unpack(self.point)[0]
        for k, q in enumerate(structure.parameters):
            effect = structure.effects[q.effect]
            shape = q.name in effect.spec.shaping and np.isfinite(effect.bounds(q.name)[0])
            asked = q.effect >= self.first and (shape or q.name in effect.spec.essential)
            if asked and not abs(theta[k]) > least * self.sd[k]:
                return False
        return self.possible and all(sure > least for sure in self.surest)

    @cached_property
    def possible(self) -> bool:
        """Return whether no effect has a sign that physics excludes."""
        own = zip(self.effects, self.start.values, strict=True)
        return not any(unphysical(effect, values, self.problem.structure.model) for effect, values in own)

    @property
    def is_linear(self) -> bool:
        """Return whether the model with its effects is linear."""
        return self.problem.structure.is_linear

    @cached_property
    def tested(self) -> TestedResidual:
        """Return the whitened residual for the tests."""
        return TestedResidual(self.model, self.hypothesis.ratio)

    @cached_property
    def start(self) -> Start:
        """Return the point of the trial as a start."""
        theta, states = self.problem.unpack(self.point)
        structure, first = self.problem.structure, self.first
        values: list[dict[str, float]] = [{} for _ in self.effects]
        for k, q in enumerate(structure.parameters):
            if q.effect >= first:
                values[q.effect - first][q.name] = float(theta[k])
        widths = {structure.effects[k].place: w for k, w in structure.constants.items() if k >= first}
        return Start(values, theta[: self.base.problem.n_theta], states, widths)

    @cached_property
    def model(self) -> FittedModel:
        """Return the trial as a fitted model, with parameters and covariance."""
        old, problem, noise, ratio = self.base.refinement, self.problem, self.noise, self.hypothesis.ratio
        # uneven noise: weight samples by their standard deviation
        blocks, judged = self.blocks, problem
        if noise.uneven:
            judged = weighted(problem, noise)
            blocks = [(w * r, w[:, :, None] * j) for w, (r, j) in zip(noise.weights, blocks, strict=True)]
        # covariance of the estimate, scaled by the whitened residual
        white = noise.whitener.apply([r for r, _ in blocks])
        scale = float(white @ white) / max(white.size - problem.size, 1)
        C = scale * coefficient_covariance(problem, blocks, noise.whitener)
        theta, states = problem.unpack(self.point)
        roles = (*old.roles, *("effect",) * len(self.effects))
        table = parameter_table(problem.structure, roles, self.base.tolerance)
        # free-run error for the printed fit, also with process noise
        free = self.blocks if ratio == 0 else evaluated(problem, self.point)
        errors = [r / problem.weights[:, None] for r, _ in free]
        fit, rmse = fit_of(problem.records, errors)
        bound = self.run.at_bound(problem)
        refinement = replace(
            old,
            effects=problem.structure.effects,
            roles=roles,
            constants=dict(problem.structure.constants),
            theta=theta.copy(),
            parameters=estimated(table, theta, standard_deviations(C)),
            covariance=C,
            fit=fit,
            rmse=rmse,
            initial_states=states.copy(),
            substeps=problem.engines[0].substeps,
            residual_orders=noise.whitener.orders,
            success=True,
            message="Converged." + (f" At its bound: {', '.join(bound)}." if bound else ""),
            warnings=(),
        )
        found = FittedModel(refinement, judged, self.point, self.base.tolerance, self.base.force_at)
        found._blocks[ratio] = blocks
        return found

    def force(self, i: int) -> tuple[Array, Array, Array, Array] | None:
        """Return the motion at the place of an effect, the inputs, and its force.

        All records are joined. None if the effect is no force at a port, or if the force is zero or not
        finite. The tangent of a force law at rest is subtracted.
        """
        problem, structure = self.problem, self.problem.structure
        k = self.first + i
        effect, at_port = structure.effects[k], k in structure.port_effects
        ports = [port.name for port in structure.model.ports]
        if not problem.in_time or effect.place not in ports or not (at_port or effect.spec.is_element):
            return None
        # simulate, then force of the law without its tangent at rest
        theta, starts = problem.unpack(self.point)
        (d0, v0), rows = resting(structure, effect.place) or (0.0, 0.0), []
        for engine, start in zip(problem.engines, starts, strict=True):
            run = engine.run(theta, start, sensitivity=False, histories=True, check=False)
            d, v = sensed(structure.model, effect.place, run.states, engine.data.inputs)
            if at_port:
                at = list(structure.port_effects).index(k)
                rest = tangents(structure, theta)[at]
                force = run.forces[at] - (rest[0] + rest[1] * (d - d0) + rest[2] * (v - v0))
            else:
                unit = unit_forces(effect, d, v, [], rest=resting(structure, effect.place))
                if unit is None:
                    return None
                (own,) = (q for q, one in enumerate(structure.parameters) if one.effect == k)
                force = theta[own] * unit[0]
            rows.append((d, v, engine.data.inputs, force))
        d, v, w, force = (np.concatenate(parts, axis=-1) for parts in zip(*rows, strict=True))
        return (d, v, w, force) if np.isfinite([d, v, force]).all() and force.any() else None

    @cached_property
    def elsewhere(self) -> tuple[Array, Array] | None:
        """Outputs for white inputs, with and without the effects.

        None where no input drives the model. It is at rest for a quarter of the first record; then its inputs
        have the mean and twice the size of those of that record.
        """
        first = self.problem.records[0]
        if not self.problem.in_time or at_rest([first]):
            return None
        # rest first, then white noise of twice the rms
        size = np.sqrt(np.mean(np.square(first.inputs), axis=1, keepdims=True))
        inputs = np.random.default_rng(0).standard_normal(first.inputs.shape) * 2.0 * size
        inputs += first.inputs.mean(axis=1, keepdims=True)
        inputs[:, : first.n_samples // 4] = 0.0
        record, found = replace(first, inputs=inputs), []
        for problem, point in ((self.problem, self.point), (self.base.problem, self.base.point)):
            # what a delayed edge does between samples depends on the substeps
            (engine,) = problem.like(records=[record], substeps=_FINE * problem.substeps).engines
            theta, rest = problem.unpack(point)[0], np.zeros(problem.n_states)
            found.append(engine.run(theta, rest, sensitivity=False, check=False).outputs)
        with_it, without = found
        return with_it, without

    def equals(self, other: Trial) -> bool:
        """Return whether another trial is the same change of the model.

        Both have the same outputs for white inputs, to a hundredth of that change, or a tenth if only delays
        differ. Where they differ, their effects are linear: two laws may be equal at one shape, or one
        amplitude, only.
        """
        # equal number of coefficients, and linear where they differ
        differing = {e.spec for e in {*self.effects} ^ {*other.effects}}
        if self.n_coefficients != other.n_coefficients:
            return False
        if not all(law.linear or law.delays for law in differing):
            return False
        if self.elsewhere is None or other.elsewhere is None:
            return False
        # difference of the outputs over the change from the model without effects
        (one, without), (two, _) = self.elsewhere, other.elsewhere
        least = _SHIFTED if all(law.delays for law in differing) else _EQUAL
        return bool(np.linalg.norm(one - two) < least * np.linalg.norm(one - without))

    def force_at(self, place: str) -> float:
        """Return the standard deviation of the force of the effects at a port."""
        forces = [self.force(i) for i, effect in enumerate(self.effects) if effect.place == place]
        known = [one[-1] for one in forces if one is not None]
        return float(np.std(sum(known[1:], start=known[0]))) if known else 0.0


def unphysical(effect: Effect, values: Mapping[str, float], model: PhysicalModel) -> bool:
    """Return whether friction or a loss has a sign that drives the motion.

    Parameters
    ----------
    effect : Effect
        Effect.
    values : mapping
        Its coefficients by name. If there are two sizes, their sum counts: the rest is a constant force.
    model : PhysicalModel
        Model, for the port. A flow out of one store that depends on the level of another may have either
        sign.
    """
    law = effect.spec
    # size of the force, shapes left out; negative friction drives the motion
    size = sum(value for name, value in values.items() if name not in law.shaping)
    if size >= 0 or not (law.turns or law.resists):
        return False
    port = model.port(effect.place)
    return bool(port.velocity @ port.act < 0)


def weighted(problem: Problem, noise: Noise) -> Problem:
    """Return the problem with samples weighted by their noise."""
    found, plain = problem.like(), problem.judged

    def judged(theta: Array) -> list[Array]:
        return [j * w for j, w in zip(plain(theta), noise.weights, strict=True)]

    found.judged = judged  # type: ignore[method-assign]
    return found


def evidence(
    trial: Trial, before: Sequence[Array], noise_of: Callable[[Sequence[Array]], Noise], held: int
) -> Trial:
    """Set noise, log evidence and standard deviations of a trial.

    Parameters
    ----------
    trial : Trial
        Changed in place, and returned.
    before : sequence of ndarray, shape (n_y, N)
        Residual without the effects. The effects reduce it; the size of this reduction scales their priors.
    noise_of : callable
        Function that gives the likeliest noise of residuals (`likeliest_noise`).
    held : int
        Number of coefficients of the model as given; further ones of the base are its parameters.

    Notes
    -----
    Laplace's method at the fit gives the log of the marginal likelihood (MacKay, Neural Computation 4 (1992)
    415). Offsets and initial states of the base have flat priors. Each coefficient of an effect may change
    the output as much as the effect as a whole. A force law therefore gains nothing from more coefficients
    alone. The values of shaping coefficients are not penalized.
    """
    problem, point, blocks = trial.problem, trial.point, trial.blocks
    theta, _ = problem.unpack(point)
    p, p0 = problem.n_theta, trial.base.problem.n_theta
    noise = noise_of([r for r, _ in blocks])
    trial.noise = noise
    # whiten and weight the residual and that of the base
    weights = [w * np.sign(j) for w, j in zip(noise.weights, problem.judged(theta), strict=True)]
    apply = noise.whitener.apply
    left = apply([w * r for w, (r, _) in zip(weights, blocks, strict=True)])
    base = apply([w * r for w, r in zip(weights, before, strict=True)])
    scale = np.sqrt(float(left @ left) / len(left))  # rounding noise has another scale
    scale = scale if scale > _EXACT else 1.0
    left, base = left / scale, base / scale
    white = [apply([w[:, :, None] * j]) / scale for w, (_, j) in zip(weights, blocks, strict=True)]
    # size of what the effects explain: the unit of their prior
    size = trial.size = float(np.sqrt(max(float(base @ base) - float(left @ left), float((p - p0) or 1))))
    # Laplace's method: Jacobian in units of the prior standard deviations
    common = np.concatenate([j[:, :p] for j in white])
    prior_sd = _prior_sds(problem, theta, common, size, p0)
    # directions without a prior and initial states are projected out
    flat = ~np.isfinite(prior_sd)
    own = trial.base.problem.n_states
    basis = Basis.of([j[:, :p][:, flat] for j in white], [j[:, p : p + own] for j in white])
    extra = _states_of_effects(white, p + own, size)
    C, E, r = project(common, basis), project(extra, basis) if extra.size else extra, project(left, basis)
    mean = np.where(np.isfinite(problem.prior_mean), problem.prior_mean, 0.0)
    informed = np.flatnonzero(~flat & (prior_sd > 0))
    structure = problem.structure
    shaping = [q.name in structure.effects[q.effect].spec.shaping for q in structure.parameters]
    counted = ~np.array(shaping, bool)[informed]

    def value(sd: Array) -> tuple[float, float]:
        """Return the log evidence at the point, and the gain of one linear step."""
        X = np.hstack([C[:, informed] * sd[informed], E])
        u = (theta - mean)[informed] / sd[informed]
        # log det of the posterior precision over that of the prior; one more step for the lack
        A = X.T @ X + np.eye(X.shape[1])
        step = -np.linalg.solve(A, X.T @ r + np.concatenate([u, np.zeros(E.shape[1])]))
        moved = r + X @ step
        here = -0.5 * float(u[counted] @ u[counted])
        v = (u + step[: len(informed)])[counted]
        there = -0.5 * (float(moved @ moved) - float(r @ r) + float(v @ v))
        return noise.log_likelihood + here - 0.5 * float(np.linalg.slogdet(A)[1]), there - here

    at_point, lack = value(prior_sd)
    trial.lack = lack
    trial.log_evidence = {0.0: at_point}
    numbers, fitted_under = slice(held, p0), trial.hypothesis.spread
    if fitted_under:
        trial.log_evidence = {}
        # the same fit under each prior spread of the parameters
        for spread in SPREADS:
            sd = prior_sd.copy()
            sd[numbers] *= spread / fitted_under
            here, gain = value(sd)
            trial.log_evidence[spread] = here + gain - lack  # the fit itself may be short of its minimum
    # standard deviations under the prior of the fit
    precision = np.zeros(p)
    precision[numbers] = prior_sd[numbers] ** -2.0
    H = np.hstack([C, E]).T @ np.hstack([C, E])
    H[:p, :p] += np.diag(precision + flat)  # flat directions were projected out
    trial.sd = standard_deviations(covariance(H))[:p]
    return trial


def _prior_sds(problem: Problem, theta: Array, columns: Array, size: float, first: int) -> Array:
    """Return the prior standard deviation of each coefficient.

    Coefficients from `first` on belong to the effects. Each may change the whitened output by `size` to first
    order. The prior is widened to the fitted value if that is larger. A prior of the effect's own stays.
    """
    found, norms = problem.prior_sd.copy(), np.linalg.norm(columns, axis=0)
    # width of the prior: the coefficient that moves the output by `size`
    for i in first + np.flatnonzero(~np.isfinite(found[first:])):
        found[i] = 0.0
        if norms[i] > 0:
            found[i] = max(size / norms[i], abs(theta[i]))
    return found


def _states_of_effects(white: Sequence[Array], first: int, size: float) -> Array:
    """Return the columns (N, k) of initial states of effects, of norm `size`."""
    lengths = [len(j) for j in white]
    columns, start = [], 0
    # initial states that the effects add, each of norm `size`
    for j, n in zip(white, lengths, strict=True):
        for own in j[:, first:].T:
            norm = np.linalg.norm(own)
            if norm > 1e-9:
                column = np.zeros(sum(lengths))
                column[start : start + n] = own * (size / norm)
                columns.append(column)
        start += n
    return np.column_stack(columns) if columns else np.zeros((sum(lengths), 0))
