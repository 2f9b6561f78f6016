"""The race: shortlist by score, refit, likelihood under one common whitening."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from types import SimpleNamespace
from typing import Any

import numpy as np

from ..exceptions import IdentifiabilityWarning
from ..physics.effects import Effect
from ..physics.observer import observer_gain
from ..refinement.outcome import package
from ..refinement.refinement import Refinement
from ..systems.linear import Array
from .battery import Battery
from .columns import Candidate
from .state import Fitted
from .whitening import FTest, Whitener

__all__ = ["Rival", "log_likelihoods", "refit", "shortlist"]

_SHORT = 5  # best of each score
_OBSERVERS = (1.0, 0.1)
_IN_THE_RACE = 60.0  # 2 log-likelihood behind the best, after the first laps


@dataclass(eq=False)
class Rival:
    """A candidate that was refitted."""

    effect: Effect
    fitted: Fitted
    result: Any
    n_coefficients: int
    cost: float


def shortlist(candidates: Sequence[Candidate], batteries: Sequence[Battery]) -> tuple[list[int], list[FTest]]:
    """Indices of the candidates worth a refit, and the free-run score of every one.

    The best of each score (free run, observers of two gains), and all laws at the
    places that win one: the linearized score is right for weak effects, the observer's
    for strong ones.
    """
    scores = []
    chosen: list[int] = []
    for battery in batteries:
        tests = [battery.test(c.effect.label, c.columns[battery.ratio]) for c in candidates]
        scores.append(tests)
        order = sorted(range(len(tests)), key=lambda i: (tests[i].p_value, -tests[i].statistic))
        chosen += order[:_SHORT]
    places = {
        candidates[scores[b].index(min(scores[b], key=_rank))].effect.place for b in range(len(batteries))
    }
    chosen += [i for i, c in enumerate(candidates) if c.effect.place in places]
    return list(dict.fromkeys(chosen)), scores[0]


def _rank(test: FTest) -> tuple[float, float]:
    return test.p_value, -test.statistic


def refit(fitted: Fitted, candidates: Sequence[Candidate], physical: Any) -> list[Rival]:
    """Output-error refit of candidates, all with the parameters of the fitted model.

    Each starts from the model as it is and from where an observer-led fit takes it; those
    that fall far behind after the first laps are not polished.
    """
    rivals = []
    for candidate in candidates:
        outcome = _laps(fitted, candidate)
        if outcome is not None:
            rivals.append(outcome)
    if not rivals:
        return []
    n = fitted.problem.n_points
    best = min(cost for _, _, cost in rivals)
    finished = []
    for candidate, point, cost in rivals:
        if n * np.log(cost / best) > _IN_THE_RACE + 0.02 * n:
            tail = candidate.problem.minimize(point, max_nfev=3)
        else:
            tail = candidate.problem.minimize(point, max_nfev=40, tol=1e-10)
        finished.append(_rival(fitted, candidate, tail, physical))
    return finished


def _laps(fitted: Fitted, candidate: Candidate) -> tuple[Candidate, Array, float] | None:
    problem = candidate.problem
    outcomes = []
    for start in candidate.starts[:3]:
        result = problem.minimize(start, max_nfev=8, tol=1e-4)
        outcomes.append((float(result.cost), result.x))
        point = start
        for ratio in _OBSERVERS:
            gain = observer_gain(problem.structure, problem.unpack(point)[0], problem.records[0], ratio)
            if not np.isfinite(gain).all():
                continue
            point = problem.minimize(point, max_nfev=6, tol=1e-4, gain=gain).x
        theta = problem.unpack(point)[0]
        start = problem.pack(theta, problem.unpack(start)[1])
        result = problem.minimize(problem.inside(start), max_nfev=8, tol=1e-4)
        outcomes.append((float(result.cost), result.x))
    outcomes = [pair for pair in outcomes if np.isfinite(pair[0])]
    if not outcomes:
        return None
    cost, point = min(outcomes, key=lambda pair: pair[0])
    return candidate, point, cost


def _rival(fitted: Fitted, candidate: Candidate, result: Any, physical: Any) -> Rival:
    problem = candidate.problem
    roles = [*fitted.refinement.roles, "effect"]
    steps = problem.engines[0].substeps
    shell = SimpleNamespace(
        structure=problem.structure, problem=problem, result=result, roles=roles, steps=steps
    )
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", IdentifiabilityWarning)  # ties are reported as such
        refinement: Refinement = package(shell, physical, "", fitted.tolerance)
    extended = Fitted(refinement, problem, result.x, fitted.tolerance)
    free = problem.structure.n_parameters - fitted.structure.n_parameters
    return Rival(candidate.effect, extended, result, free, float(result.cost))


def log_likelihoods(
    base: Fitted, rivals: Sequence[Rival], ratio: float = 0.0
) -> tuple[float, Array, Whitener]:
    """Log-likelihood of the base and of each rival under the whitening of the best one.

    Each coefficient beyond the first costs half the log of the number of samples.
    """
    first = [Whitener.fit(r.fitted.residuals(ratio)) for r in rivals]
    powers = [float(np.sum(np.log(w.scales))) for w in first]
    whitener = first[int(np.argmin(powers))]

    def of(fitted: Fitted, coefficients: int) -> float:
        white = whitener.apply(fitted.residuals(ratio))
        theta = fitted.theta
        problem = fitted.problem
        held = np.isfinite(problem.prior_sd)
        prior = float(np.sum(((theta[held] - problem.prior_mean[held]) / problem.prior_sd[held]) ** 2))
        penalty = max(coefficients - 1, 0) * np.log(white.size)
        return -0.5 * (float(white @ white) + prior + penalty)

    return of(base, 0), np.array([of(r.fitted, r.n_coefficients) for r in rivals]), whitener
