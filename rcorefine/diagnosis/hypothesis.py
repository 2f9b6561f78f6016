"""A hypothesis, and its one score: log marginal likelihood of the records (Laplace) and log prior."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import NamedTuple

import numpy as np

from ..effects.along_motion import unit_forces
from ..effects.effect import Effect
from ..engine.point import resting, tangents
from ..inference.basis import Basis, project
from ..inference.covariance import covariance, standard_deviations
from ..inference.descent import Descent
from ..inference.fitted import FittedModel, coefficient_covariance, evaluated
from ..inference.outcome import _rows, fit_of
from ..inference.problem import Problem
from ..models.operating_point import sensed
from ..models.physical_model import PhysicalModel
from ..systems.linear import Array
from .noise import Noise, noise_of, rounding_step
from .nuisances import Nuisance, Parameters, UnmeasuredForce

__all__ = ["SPREADS", "Hypothesis", "Recorded", "Start", "Trial", "evidence", "unphysical", "weighted"]

#: Relative spread of the parameters of a model: prior probability that it is this large.
SPREADS = {0.05: 0.6, 0.2: 0.3, 1.0: 0.1}


@dataclass(frozen=True)
class Hypothesis:
    """What acts, and what is open beside it.

    Attributes
    ----------
    effects : tuple of Effect
        What is missing; empty for nothing.
    nuisances : frozenset of Nuisance
        What is open. The noise is chosen by the evidence.
    """

    effects: tuple[Effect, ...] = ()
    nuisances: frozenset[Nuisance] = frozenset()

    @property
    def key(self) -> tuple[frozenset[Effect], frozenset[Nuisance]]:
        """What makes it another one: the order of the effects does not."""
        return frozenset(self.effects), self.nuisances

    @property
    def floated(self) -> bool:
        """Whether the parameters of the model are open."""
        return self.spread > 0

    @property
    def spread(self) -> float:
        """Spread under which the parameters are fitted, 0 where they are held."""
        return max((one.spread for one in self.nuisances if isinstance(one, Parameters)), default=0.0)

    @property
    def ratio(self) -> float:
        """Size of an unmeasured force over the measured one, 0 for none."""
        return max((one.ratio for one in self.nuisances if isinstance(one, UnmeasuredForce)), default=0.0)

    def log_prior(self, library: int) -> float:
        """Log prior probability: each effect is one of so many."""
        each = float(np.log(max(library, 2)))
        return sum(one.log_prior for one in self.nuisances) - each * len(self.effects)


@dataclass(frozen=True, eq=False)
class Start:
    """Where a fit begins.

    Attributes
    ----------
    values : list of dict
        Coefficients of each effect by name.
    theta : ndarray
        Coefficients of the base.
    states : ndarray, shape (n_records, n)
        Initial states.
    widths : dict
        By place: the width over which laws that jump turn over there.
    """

    values: list[dict[str, float]]
    theta: Array
    states: Array
    widths: dict[str, float] = field(default_factory=dict)

    def on(self, states: Array) -> Start:
        """The same on other records: with its initial states where there are as many, else with these."""
        return self if states.shape[0] == self.states.shape[0] else replace(self, states=states)

    def shared(self, effects: Sequence[Effect], absent: Start, share: float) -> Start:
        """Sizes, and what the base moved for them, times a share."""
        if share == 1.0:
            return self
        values = [
            {n: v if n in e.spec.shaping or e.spec.secant else share * v for n, v in own.items()}
            for e, own in zip(effects, self.values, strict=True)
        ]
        n = min(absent.states.shape[1], self.states.shape[1])
        states = absent.states[:, :n] + share * (self.states[:, :n] - absent.states[:, :n])
        theta = absent.theta + share * (self.theta - absent.theta)
        return replace(self, values=values, theta=theta, states=states)


class Recorded(NamedTuple):
    """What was measured, in units of the weights.

    Attributes
    ----------
    outputs : list of ndarray, shape (n_y, N)
        Of each record.
    steps : list of float
        Rounding step of each output, 0 for none.
    colored : bool
        Whether noise may be other than white and normal.
    """

    outputs: list[Array]
    steps: list[float]
    colored: bool

    @classmethod
    def of(cls, problem: Problem, colored: bool = True) -> Recorded:
        """Outputs of the records of a problem."""
        outputs, colored = (
            [problem.weights[:, None] * r.outputs for r in problem.records],
            colored and problem.in_time,
        )
        rows = np.concatenate(outputs, axis=1)
        return cls(outputs, [rounding_step(row) if colored else 0.0 for row in rows], colored)

    def noise(self, residuals: Sequence[Array]) -> Noise:
        """Likeliest noise of residuals."""
        return noise_of(residuals, self.outputs, self.steps, self.colored)


@dataclass(eq=False)
class Trial:
    """A hypothesis that was fitted.

    Attributes
    ----------
    hypothesis : Hypothesis
        What acts and what is open.
    base : FittedModel
        The model with its nuisances, without the effects.
    problem, point
        Estimation problem, and where the fit stands.
    run : Descent
        How it came there; its evaluation is that of plain weights.
    noise : Noise
        Likeliest noise of what is left.
    log_evidence : dict
        By spread of the parameters; one entry where they are held.
    sd : ndarray, shape (p,)
        Standard deviations of the coefficients.
    size : float
        Norm of what the effects take from the whitened residual.
    """

    hypothesis: Hypothesis
    base: FittedModel
    problem: Problem
    run: Descent
    noise: Noise = field(init=False)
    log_evidence: dict[float, float] = field(init=False)
    sd: Array = field(init=False)
    size: float = field(init=False)

    @property
    def effects(self) -> tuple[Effect, ...]:
        """Effects beyond those of the base."""
        return self.hypothesis.effects

    @property
    def point(self) -> Array:
        """Where the fit stands."""
        return self.run.point

    @cached_property
    def blocks(self) -> list[tuple[Array, Array]]:
        """Residual and Jacobian of each record in units of the weights, led where a force is allowed for."""
        return self.run.blocks(self.problem)

    @property
    def total(self) -> float:
        """Log evidence over all spreads of the parameters."""
        if len(self.log_evidence) == 1:
            return next(iter(self.log_evidence.values()))
        return float(np.logaddexp.reduce([v + np.log(SPREADS[s]) for s, v in self.log_evidence.items()]))

    @cached_property
    def surest(self) -> list[float]:
        """Size of the surest coefficient of each effect, in its standard deviations."""
        structure, found = self.problem.structure, []
        first = len(structure.effects) - len(self.effects)
        theta = self.problem.unpack(self.point)[0]
        for i in range(first, len(structure.effects)):
            at = [k for k, q in enumerate(structure.parameters) if q.effect == i]
            shaping = structure.effects[i].spec.shaping
            sizes = [k for k in at if structure.parameters[k].name not in shaping] or at
            found.append(max((abs(theta[k]) / self.sd[k] if self.sd[k] > 0 else np.inf) for k in sizes))
        return found

    def determined(self, least: float) -> bool:
        """Whether every effect is known and possible.

        Its surest size, and every shape that is positive or essential, is so many standard deviations from
        zero; no coefficient has a sign that physics rules out.
        """
        structure, theta = self.problem.structure, self.problem.unpack(self.point)[0]
        first = len(structure.effects) - len(self.effects)
        for k, q in enumerate(structure.parameters):
            if q.effect < first:
                continue
            effect = structure.effects[q.effect]
            law = effect.spec
            shape = q.name in law.shaping and np.isfinite(effect.bounds(q.name)[0])
            if (shape or q.name in law.essential) and not abs(theta[k]) > least * self.sd[k]:
                return False
        return self.possible and all(sure > least for sure in self.surest)

    @cached_property
    def possible(self) -> bool:
        """Whether no coefficient has a sign that physics rules out."""
        own = zip(self.effects, self.start.values, strict=True)
        return not any(unphysical(effect, values, self.problem.structure.model) for effect, values in own)

    @cached_property
    def start(self) -> Start:
        """Where the trial stands, as a start."""
        theta, states = self.problem.unpack(self.point)
        structure = self.problem.structure
        first = len(structure.effects) - len(self.effects)
        values: list[dict[str, float]] = [{} for _ in self.effects]
        for k, q in enumerate(structure.parameters):
            if q.effect >= first:
                values[q.effect - first][q.name] = float(theta[k])
        widths = {structure.effects[k].place: w for k, w in structure.constants.items() if k >= first}
        return Start(values, theta[: self.base.problem.n_theta], states, widths)

    @cached_property
    def model(self) -> FittedModel:
        """The trial as a fitted model that can be tested, added to, and reported."""
        old, problem, noise, ratio = self.base.refinement, self.problem, self.noise, self.hypothesis.ratio
        blocks, judged = self.blocks, problem
        if noise.uneven:
            judged = weighted(problem, noise)
            blocks = [(w * r, w[:, :, None] * j) for w, (r, j) in zip(noise.weights, blocks, strict=True)]
        white = noise.whitener.apply([r for r, _ in blocks])
        scale = float(white @ white) / max(white.size - problem.size, 1)
        C = scale * coefficient_covariance(problem, blocks, noise.whitener)
        theta, states = problem.unpack(self.point)
        roles = (*old.roles, *("effect",) * len(self.effects))
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
            parameters=_rows(problem.structure, roles, theta, standard_deviations(C)),
            covariance=C,
            fit=fit,
            rmse=rmse,
            initial_states=states.copy(),
            substeps=problem.engines[0].substeps if problem.in_time else old.substeps,
            residual_orders=noise.whitener.orders,
            success=True,
            message="Converged." + (f" At its bound: {', '.join(bound)}." if bound else ""),
            warnings=(),
        )
        found = FittedModel(refinement, judged, self.point, self.base.tolerance, self.base.force_at)
        found._blocks[ratio] = blocks
        return found

    def force(self, i: int) -> tuple[Array, Array, Array, Array] | None:
        """Return the motion at the place of an effect, the inputs, and its force, records joined.

        None where it is no force.
        """
        problem, structure = self.problem, self.problem.structure
        k = len(structure.effects) - len(self.effects) + i
        effect, at_port = structure.effects[k], k in structure.port_effects
        if not problem.in_time or not (at_port or effect.spec.is_element):
            return None
        if effect.place not in [port.name for port in structure.model.ports]:
            return None
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

    def force_at(self, place: str) -> float:
        """Standard deviation of the force of the effects at a port."""
        forces = [self.force(i) for i, effect in enumerate(self.effects) if effect.place == place]
        known = [one[-1] for one in forces if one is not None]
        return float(np.std(sum(known[1:], start=known[0]))) if known else 0.0


def unphysical(effect: Effect, values: Mapping[str, float], model: PhysicalModel) -> bool:
    """Return whether coefficients of friction or of a loss have a sign that drives the motion.

    Parameters
    ----------
    effect : Effect
        Effect.
    values : mapping
        Its coefficients by name. Of two sizes the sum counts: the rest is a constant force.
    model : PhysicalModel
        Model, for the port. What one store loses by the level of another may have either sign.
    """
    law = effect.spec
    size = sum(value for name, value in values.items() if name not in law.shaping)
    if size >= 0 or not (law.turns or law.resists):
        return False
    port = model.port(effect.place)
    return bool(port.velocity @ port.act < 0)


def weighted(problem: Problem, noise: Noise) -> Problem:
    """Return the problem with its samples weighted by their noise."""
    found, plain = problem.like(), problem.judged

    def judged(theta: Array) -> list[Array]:
        return [j * w for j, w in zip(plain(theta), noise.weights, strict=True)]

    found.judged = judged  # type: ignore[method-assign]
    return found


def evidence(trial: Trial, before: Sequence[Array], record: Recorded, held: int) -> Trial:
    """Give a trial its noise, its log evidence, and its standard deviations.

    Parameters
    ----------
    trial : Trial
        Is changed, and returned.
    before : sequence of ndarray, shape (n_y, N)
        Residual without the effects: an effect may change the output as much as that.
    record : Recorded
        What was measured.
    held : int
        Coefficients of the model as it was given; those of the base beyond are its parameters.

    Notes
    -----
    Log of the marginal likelihood by Laplace's method at the fit (MacKay, Neural Computation 4 (1992) 415).
    Offsets and initial states have flat priors. A coefficient may change the output as much as the effect as
    a whole, so a law is not preferred for its freedom. Shapes of a law have no prior of their own.
    """
    problem, point, blocks = trial.problem, trial.point, trial.blocks
    theta, _ = problem.unpack(point)
    p, p0 = problem.n_theta, trial.base.problem.n_theta
    noise = record.noise([r for r, _ in blocks])
    trial.noise = noise
    weights = [w * np.sign(j) for w, j in zip(noise.weights, problem.judged(theta), strict=True)]
    apply = noise.whitener.apply
    left = apply([w * r for w, (r, _) in zip(weights, blocks, strict=True)])
    base = apply([w * r for w, r in zip(weights, before, strict=True)])
    scale = np.sqrt(float(left @ left) / len(left)) or 1.0  # rounding has another size
    left, base = left / scale, base / scale
    white = [apply([w[:, :, None] * j]) / scale for w, (_, j) in zip(weights, blocks, strict=True)]
    size = trial.size = float(np.sqrt(max(float(base @ base) - float(left @ left), float((p - p0) or 1))))
    common = np.concatenate([j[:, :p] for j in white])
    prior_sd = _prior_sds(problem, theta, common, size, p0)
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
        """Log evidence at the point, and what the minimum under this prior would gain to first order."""
        X = np.hstack([C[:, informed] * sd[informed], E])
        u = (theta - mean)[informed] / sd[informed]
        A = X.T @ X + np.eye(X.shape[1])
        step = -np.linalg.solve(A, X.T @ r + np.concatenate([u, np.zeros(E.shape[1])]))
        moved = r + X @ step
        here = -0.5 * float(u[counted] @ u[counted])
        v = (u + step[: len(informed)])[counted]
        there = -0.5 * (float(moved @ moved) - float(r @ r) + float(v @ v))
        return noise.log_likelihood + here - 0.5 * float(np.linalg.slogdet(A)[1]), there - here

    at_point, lack = value(prior_sd)
    trial.log_evidence = {0.0: at_point}
    numbers, fitted_under = slice(held, p0), trial.hypothesis.spread
    if fitted_under:
        trial.log_evidence = {}
        for spread in SPREADS:
            sd = prior_sd.copy()
            sd[numbers] *= spread / fitted_under
            here, gain = value(sd)
            trial.log_evidence[spread] = here + gain - lack  # what the fit lacks itself is no gain
    precision = np.zeros(p)
    precision[numbers] = prior_sd[numbers] ** -2.0
    H = np.hstack([C, E]).T @ np.hstack([C, E])
    H[:p, :p] += np.diag(precision + flat)  # what is flat was projected out
    trial.sd = standard_deviations(covariance(H))[:p]
    return trial


def _prior_sds(problem: Problem, theta: Array, columns: Array, size: float, first: int) -> Array:
    """Prior standard deviation of each coefficient; from the first on they belong to the effects.

    Such a one may change the whitened output as much as the effects did to first order, or as it did.
    """
    found, norms = problem.prior_sd.copy(), np.linalg.norm(columns, axis=0)
    for i in range(first, found.size):
        found[i] = 0.0
        if norms[i] > 0:
            found[i] = max(size / norms[i], abs(theta[i]))
    return found


def _states_of_effects(white: Sequence[Array], first: int, size: float) -> Array:
    """Columns (N, k) of the initial states of effects, each as large as an effect may be."""
    lengths = [len(j) for j in white]
    columns, start = [], 0
    for j, n in zip(white, lengths, strict=True):
        for own in j[:, first:].T:
            norm = np.linalg.norm(own)
            if norm > 1e-9:
                column = np.zeros(sum(lengths))
                column[start : start + n] = own * (size / norm)
                columns.append(column)
        start += n
    return np.column_stack(columns) if columns else np.zeros((sum(lengths), 0))
