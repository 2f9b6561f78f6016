"""A candidate at its best point so far: how likely it is there, and what it is as a model."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from ..effects.effect import Effect
from ..inference.covariance import standard_deviations
from ..inference.descent import Descent, descend
from ..inference.fitted import FittedModel, coefficient_covariance, evaluated
from ..inference.outcome import _rows, fit_of
from ..inference.problem import Problem
from ..inference.refinement import Refinement
from ..inference.sensitivities import Candidate
from ..inference.whitening import Whitener
from ..models.physical_model import PhysicalModel
from ..systems.linear import Array
from .starts import gain_for

__all__ = [
    "LACK",
    "CandidateFit",
    "continued",
    "fitted_model",
    "log_likelihood",
    "price",
    "prior_cost",
    "unphysical",
    "whitener_of",
]

LACK = 0.1  # log-likelihood that the next full step would gain, at most, at a minimum


@dataclass(eq=False)
class CandidateFit:
    """A candidate in the race, at its best point so far."""

    candidate: Candidate
    descent: Descent
    log_likelihood: float = -np.inf
    free_run: Descent | None = None  # its minimum of the plain error, before any whitening
    raced: Candidate | None = None  # as which it had that, where no unmeasured force was allowed for
    known: Descent | None = None  # where an earlier race left it, under the filter of that one
    settled: bool = False  # at a minimum, or lacking too little to come near the best
    lack: float = np.inf  # log-likelihood that its next full step would gain

    @property
    def effect(self) -> Effect:
        """Its effect."""
        return self.candidate.effect

    @property
    def converged(self) -> bool:
        """Whether its gradient is small against its standard deviation."""
        return self.lack <= LACK

    @property
    def unphysical(self) -> bool:
        """Whether the sign of its coefficients contradicts physics."""
        theta, fitted = self.candidate.problem.unpack(self.descent.point)[0], self.candidate.fitted
        own = theta[fitted.structure.n_parameters :]
        return unphysical(self.effect, dict(zip(self.effect.free, own, strict=True)), fitted.structure.model)

    @property
    def n_coefficients(self) -> int:
        """Coefficients that it adds."""
        return self.candidate.problem.n_theta - self.candidate.fitted.problem.n_theta


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


def continued(
    fitted: FittedModel,
    rival: CandidateFit,
    ratio: float,
    whitener: Whitener | None,
    evaluations: int,
    tolerance: float = 1e-4,
) -> Descent:
    """Its descent, some laps further."""
    problem, gain = rival.candidate.problem, gain_for(fitted, rival.candidate, ratio)
    return descend(
        problem,
        rival.descent.point,
        gain=gain,
        whitener=whitener,
        evaluations=evaluations,
        tolerance=tolerance,
        known=rival.descent.known(problem, gain),
    )


def _blocks(rival: CandidateFit) -> list[tuple[Array, Array]]:
    return rival.descent.blocks(rival.candidate.problem)


def whitener_of(rival: CandidateFit) -> Whitener:
    """Filter of its own residual."""
    return rival.candidate.problem.whitener([r for r, _ in _blocks(rival)])


def prior_cost(problem: Problem, point: Array) -> float:
    """Squared distance of the coefficients from what was declared, in standard deviations."""
    theta = problem.unpack(point)[0]
    mean, sd = problem.prior_mean, problem.prior_sd
    held = np.isfinite(sd)
    return float(np.sum(((theta[held] - mean[held]) / sd[held]) ** 2))


def log_likelihood(rival: CandidateFit, whitener: Whitener) -> float:
    """Each coefficient beyond the first costs half the log of the number of samples."""
    white = whitener.apply([r for r, _ in _blocks(rival)])
    prior = prior_cost(rival.candidate.problem, rival.descent.point)
    return -0.5 * (float(white @ white) + prior) - price(rival, white.size)


def price(rival: CandidateFit, samples: int) -> float:
    """What its coefficients beyond the first cost in log-likelihood."""
    return 0.5 * max(rival.n_coefficients - 1, 0) * float(np.log(samples))


def fitted_model(fitted: FittedModel, rival: CandidateFit, whitener: Whitener, ratio: float) -> FittedModel:
    """The rival as a refinement; its covariance is that of generalized least squares."""
    problem, point = rival.candidate.problem, rival.descent.point
    gain = gain_for(fitted, rival.candidate, ratio)
    blocks = _blocks(rival)
    white = whitener.apply([r for r, _ in blocks])
    scale = float(white @ white) / max(white.size - problem.size, 1)
    C = scale * coefficient_covariance(problem, blocks, whitener)
    spread = standard_deviations(C)
    old = fitted.refinement
    theta, starts = problem.unpack(point)
    free = [r for r, _ in (blocks if ratio == 0 else evaluated(problem, point))]
    fit, rmse = fit_of(problem.records, [r / problem.weights[:, None] for r in free])
    roles = [*old.roles, "effect"]
    bound = rival.descent.at_bound(problem)
    far = "Not polished: far behind the best candidate." if rival.settled else "Not converged."
    state = "Converged." if rival.converged else far
    refinement: Refinement = replace(
        old,
        effects=problem.structure.effects,
        roles=tuple(roles),
        constants=dict(problem.structure.constants),
        theta=theta.copy(),
        parameters=_rows(problem.structure, roles, theta, spread),
        covariance=C,
        fit=fit,
        rmse=rmse,
        initial_states=starts.copy(),
        substeps=problem.engines[0].substeps,
        residual_orders=whitener.orders,
        success=rival.converged,
        message=state + (f" At its bound: {', '.join(bound)}." if bound else ""),
        warnings=(),
    )
    extended = FittedModel(refinement, problem, point, fitted.tolerance, fitted.force_at)
    extended._blocks[ratio] = blocks
    if gain is not None:
        extended._gains[ratio] = gain
    return extended
