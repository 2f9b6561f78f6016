"""The numbers of a model, all floating by a few percent: where that mends it, no law is needed."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from ..effects.bodies import Mass
from ..effects.effect import Effect
from ..exceptions import IdentifiabilityWarning, ModelError, unheard
from ..inference.assembly import nominal_size
from ..inference.basis import Basis, project
from ..inference.f_tests import FTest
from ..inference.fitted import FittedModel, fitted_from
from ..inference.refinement import Refinement
from ..inference.sensitivities import Candidate, candidate_columns
from ..inference.starts import estimated_motion
from ..models.library import effect_library
from ..refinement.base_fit import base_fit
from ..refinement.refine import refine
from ..systems.linear import Array
from .candidate_fit import log_likelihood, prior_cost
from .candidate_fits import STRONG, CandidateFits, fit_candidates
from .case import Case, not_held
from .colored_noise import gain_over_color
from .places import in_race
from .residual_tests import TestedResidual, passed_without_library, run_tests
from .verdict import keeps_name, overall

__all__ = [
    "Floated",
    "as_good",
    "explaining_numbers",
    "floating",
    "is_number",
    "outdone",
    "rivals_of_numbers",
]

_SEEN = 0.5  # share of its prior variance that the data take from a combination which they determine
_SAME = 0.1  # relative change of a prior that is none
_PROMISED = 0.5  # share of the gain of the numbers that the score of a law must promise to be worth a refit
_LAWS = 3  # of them
_LEFT = 2.0  # standard deviations of a prior beyond which a number has left it
_ROUNDS = 3


@dataclass(frozen=True, slots=True, eq=False)
class Floated:
    """A model whose numbers float, and which passes every test with that.

    Attributes
    ----------
    fitted : FittedModel
        At its minimum.
    battery : TestedResidual
        Its residual.
    tests : list of FTest
        What that passed.
    evidence : float
        Log-likelihood under its own filter, averaged over the prior of the numbers: what it gains by
        choosing them is not counted.
    refinement : Refinement
        What is reported of them: where a number went far beyond its prior, that no longer pulls it back.
    """

    fitted: FittedModel
    battery: TestedResidual
    tests: list[FTest]
    evidence: float
    refinement: Refinement


def floating(case: Case) -> Refinement | None:
    """The model with all its numbers fitted, each with a prior of `Levels.off` of its nominal value.

    What it declares floats, and every mass where they are known from the matrices alone; what only
    rescales others stays. None if there is nothing to float.
    """
    numbers = _numbers(case)
    return _fit(case, numbers) if numbers else None


def explaining_numbers(case: Case, refined: Refinement | None, *, far: bool = False) -> Floated | None:
    """The model with all its numbers floating, if it then passes every test.

    Parameters
    ----------
    case : Case
        What is asked.
    refined : Refinement or None
        Of `floating`.
    far : bool
        Let numbers lie beyond their prior. More freedom mimics more laws, so that is for where none
        explains the records better.
    """
    if refined is None:
        return None
    loose = _let_go(case, refined) if far else refined
    found = None if far and loose is refined else _tested(case, loose)
    if found is None:
        return None
    fitted, battery, tests = found
    reported = loose if far else _let_go(case, refined)
    return Floated(fitted, battery, tests, _evidence(battery, case.fitted.problem.n_theta), reported)


def _fit(
    case: Case, numbers: list[Effect], by: Callable[..., Refinement] = base_fit, sds: Array | None = None
) -> Refinement:
    if sds is not None:
        named = zip(numbers, sds, strict=True)
        numbers = [e.replace(prior={e.coefficients[0]: float(sd)}) for e, sd in named]
    with case.progress.step("parameters"), unheard(IdentifiabilityWarning):  # `determined` says it
        return by(case.base, case.records, free=numbers, **case.options)


def _tested(case: Case, refined: Refinement) -> tuple[FittedModel, TestedResidual, list[FTest]] | None:
    """A model whose numbers float on its records, if it passes every test."""
    try:
        problem = case.fitted.problem
        noise = 1.0 / problem.weights  # in the units of the noise that the candidates are compared in
        fitted = fitted_from(refined, problem.records, tolerance=case.options["tolerance"], noise=noise)
        battery = TestedResidual(fitted)
        motions = [estimated_motion(fitted.structure, fitted.theta, m.data) for m in case.motions]
        if case.excess(fitted) > case.levels.noise_excess:
            return None
        others = passed_without_library(battery, motions, case.significance)
        if others is None:
            return None  # the library cannot mend what fails without it
        library = not_held(case.library, fitted.structure.effects)
        near = in_race(fitted, library, (0.0,))
        scored = candidate_columns(fitted, near, motions[0], (0.0,))
        tests = run_tests(battery, scored, motions, len(library) - len(near), others)
        if overall(tests) < case.significance or gain_over_color(battery, scored) >= case.levels.color:
            return None
        return fitted, battery, tests
    except ModelError:  # floated to where no observer leads it, or it runs away within a sample
        return None


def _let_go(case: Case, refined: Refinement) -> Refinement:
    """Re-estimate with priors as wide as the parameters turn out to be off.

    Where the combinations that the data determine are further off than the prior says, those that they do
    not determine may be as far off: all priors grow by one factor, so that the mean square of the former
    is as expected, and that of a parameter which is further off still grows to what it is off by.
    """
    by: Callable[..., Refinement] = base_fit
    numbers = _numbers(case)
    near = np.array([sd for e in numbers for sd in e.prior.values()])
    wide = near
    if float(np.min(refined.fit)) < STRONG:  # resonances moved: another valley
        wide, by = near / case.levels.off, refine
        refined = _fit(case, numbers, by, wide)
    for _ in range(_ROUNDS):
        rows = [(row.kind, row.place) for row in refined.parameters]
        at = [rows.index((e.kind, e.place)) for e in numbers]
        moved = refined.theta[at]
        C = np.nan_to_num(refined.covariance[np.ix_(at, at)] / np.outer(wide, wide), posinf=1.0)
        told, turn = np.linalg.eigh(np.eye(len(at)) - C)  # share of the prior variance that data took away
        seen = told > _SEEN
        off = (turn.T @ (moved / wide))[seen] ** 2 / told[seen]
        wider = np.maximum(near, wide * np.sqrt(np.mean(off) if off.size else 0.0))
        wider = np.where(np.abs(moved) > _LEFT * wider, np.abs(moved), wider)
        if np.allclose(wider, wide, rtol=_SAME):
            break
        wide = wider
        refined = _fit(case, numbers, by, wide)
    return refined


def _evidence(battery: TestedResidual, held: int) -> float:
    """Log-likelihood of the records where each new number has its prior and no value is chosen (Laplace)."""
    fitted = battery.fitted
    problem = fitted.problem
    new = slice(held, problem.n_theta)
    white = [battery.whitener.apply([j]) for _, j in fitted.blocks()]
    old = Basis.of([J[:, :held] for J in white], [J[:, problem.n_theta :] for J in white])
    spread = project(np.concatenate([J[:, new] for J in white]), old) * problem.prior_sd[new]
    occam = np.linalg.slogdet(np.eye(spread.shape[1]) + spread.T @ spread)[1]
    cost = prior_cost(problem, fitted.point)
    return -0.5 * (float(battery.residual @ battery.residual) + cost + float(occam))


def _numbers(case: Case) -> list[Effect]:
    """Return every parameter that can be estimated, with its prior.

    Parameters that only rescale others are among them: held at nominal, they would make the others look
    surer than the record makes them.
    """
    physical, structure = case.base.physical_model, case.fitted.structure
    declared = [Effect(q.kind, q.place) for q in physical.parameters]
    masses = [e for e in effect_library(physical) if e.kind == Mass.name]
    everything = list({(e.kind, e.place): e for e in [*masses, *declared]}.values())
    sized = [(e, nominal_size(structure, e)) for e in not_held(everything, case.base.effects)]
    spread = case.levels.off
    return [e.replace(prior={e.coefficients[0]: spread * x}) for e, x in sized if 0.0 < x < np.inf]


def rivals_of_numbers(case: Case, numbers: Floated, scored: Sequence[Candidate]) -> bool:
    """Whether a single effect explains the residual as well as all the numbers together.

    Every single number is refitted, for its score says little where the resonances move. A law is, where
    its score promises enough: that is right where a law is weak enough to be mistaken for numbers. Where
    the numbers leave much of the record, that is not so, and every candidate gets its fit.
    """
    if float(np.min(numbers.fitted.refinement.fit)) < STRONG:
        return True  # much is left, be it noise or a strong law, whose score promises little: all are fitted
    before = TestedResidual(case.fitted, whitener=numbers.battery.whitener)
    least = _PROMISED * 2 * (numbers.evidence + 0.5 * float(before.left @ before.left))
    laws = [(test.gain, i) for i, test in enumerate(before.each(scored)) if not is_number(scored[i].effect)]
    tried = [c for c in scored if is_number(c.effect)]
    tried += [scored[i] for gain, i in sorted(laws, reverse=True)[:_LAWS] if gain > least]
    race = fit_candidates(case.fitted, tried, progress=case.progress) if tried else None
    return race is not None and as_good(case, race, numbers)


def is_number(effect: Effect) -> bool:
    """Whether an effect is a change of a single number of a linear model."""
    return effect.spec.is_parameter or effect.spec.relative


def as_good(case: Case, race: CandidateFits, numbers: Floated) -> bool:
    """Whether the best candidate explains the records as well as all the numbers of the model together."""
    own = max(log_likelihood(rival, numbers.battery.whitener) for rival in race.rivals)
    return keeps_name(own, numbers.evidence, case.levels)


def outdone(race: CandidateFits, battery: TestedResidual, price: float) -> bool:
    """Whether the best candidate leaves clearly less than another model, each under a filter of its own.

    A residual that passes for noise of some color may still be most of the record: where a law takes
    that away, the other does not explain it, whatever that law itself leaves.
    """
    return TestedResidual(race.model(), race.ratio).log_likelihood >= battery.log_likelihood + price
