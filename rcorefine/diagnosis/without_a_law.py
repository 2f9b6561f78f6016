"""Answers that name no law: nothing is missing, an unmeasured force, the hold, the numbers of the model."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from ..inference.f_tests import FTest
from ..inference.refinement import Refinement
from ..inference.sensitivities import candidate_columns
from ..refinement.refine import refit
from .candidate_fits import CandidateFits
from .case import Case
from .colored_noise import gain_over_color, left_to_noise
from .floating import Floated, as_good, explaining_numbers, floating, is_number, outdone
from .judging import Judged, beside_force, outweighs
from .ranking import detectable
from .residual_tests import TestedResidual, run_tests
from .result import Diagnosis
from .unmeasured_force import Explained, explaining_force

__all__ = [
    "Answer",
    "about_hold",
    "adequate",
    "earned_beside",
    "gains",
    "likelihood",
    "numbers_instead",
    "parameters",
    "under_another_hold",
    "without_a_law",
]


class Answer(NamedTuple):
    """A diagnosis, and what was fitted for it.

    Attributes
    ----------
    found : Diagnosis
        The diagnosis.
    race : CandidateFits or None
        The refitted rivals, where there were any.
    floated : Refinement or None
        The model while all its numbers float, where no law explains the records and they may.
    """

    found: Diagnosis
    race: CandidateFits | None = None
    floated: Refinement | None = None


def without_a_law(
    case: Case, free_run: TestedResidual, floated: Refinement | None, doubtful: bool
) -> tuple[Explained | None, Floated | None]:
    """An unmeasured force, or the numbers of the model: what of them explains the residual better, if any.

    Where the residual passes for noise of a color that is doubtful, either has to gain over that.
    """
    least = free_run.log_likelihood + case.levels.color if doubtful else -np.inf
    force, numbers = explaining_force(case, free_run), explaining_numbers(case, floated)
    force = None if force is None or force.battery.log_likelihood < least else force
    numbers = None if numbers is None or numbers.battery.log_likelihood < least else numbers
    if force is not None and numbers is not None:
        if numbers.battery.log_likelihood > force.battery.log_likelihood:
            return None, numbers
        return force, None
    return force, numbers


def earned_beside(case: Case, force: Explained, judged: Judged) -> Judged | None:
    """The winner, if it earns its place beside an unmeasured force that alone explains the residual."""
    if outweighs(judged, force.battery, 0.0):
        return judged
    beside = beside_force(case, judged)
    return beside if beside is not None and outweighs(beside, force.battery, case.levels.force) else None


def numbers_instead(
    case: Case, numbers: Floated | None, floated: Refinement | None, judged: Judged
) -> Floated | None:
    """The numbers of the model, where they explain the records no worse than the best law.

    A law with room for it mimics a spring and a damper, and numbers, be they far off, are the plainer
    words. A single effect that explains as much as all the numbers keeps its name, and so does a fault of
    the record, which is plainer still.
    """
    if numbers is not None:
        as_much = judged.passed and as_good(case, judged.race, numbers)
        return None if as_much or outdone(judged.race, numbers.battery, case.levels.force) else numbers
    best = judged.race.rivals[0].effect
    if judged.passed and (is_number(best) or best.spec.of_record):
        return None
    far = explaining_numbers(case, floated, far=True)
    return None if far is None or outdone(judged.race, far.battery, case.levels.force) else far


def under_another_hold(case: Case, rival: Floated | None) -> Diagnosis | None:
    """The verdict where the inputs run otherwise between the samples than declared, and no law is needed.

    A missing law can look like a wrong hold, so that only counts if every test passes with it; numbers
    that move under the declared one (`rival`) are not the plainer words for it, unless they explain more.
    """
    hold, sentence = case.hold if case.thorough else ("", "")
    if not sentence:
        return None
    base = refit(case.base.with_hold(hold), case.records, **case.options)
    given = (case.library, case.settings, case.significance, case.progress, case.thorough)
    other = Case.prepare(base, case.records, *given)
    scored = candidate_columns(other.fitted, other.library, other.motions[0], (0.0,))
    free_run = TestedResidual(other.fitted)
    tests = run_tests(free_run, scored, other.motions)
    least = -np.inf if rival is None else likelihood(rival.battery) - 0.5 * case.levels.rival
    as_it_is = likelihood(free_run) >= least and other.passes(tests, other.fitted)
    if as_it_is and gain_over_color(free_run, scored) < case.levels.color:
        found = adequate(other, Explained(free_run, scored, tests))
        return replace(found, notes=(sentence, *found.notes))
    numbers = explaining_numbers(other, floating(other))
    if numbers is None or likelihood(numbers.battery) < least:
        return None
    return replace(by_numbers(other, numbers, tests), notes=(sentence,))


def gains(case: Case, judged: Judged, other: CandidateFits | None) -> bool:
    """Whether candidates of a model that was fitted otherwise explain clearly more than the best one here."""
    if other is None:
        return False
    mine, theirs = (likelihood(TestedResidual(j.model(), j.ratio)) for j in (judged.race, other))
    return theirs >= mine + case.levels.force


def likelihood(battery: TestedResidual) -> float:
    """Log-likelihood in the units of the record: two fits need not share those of their noise."""
    n = sum(r.shape[1] for r in battery.fitted.residuals(battery.ratio))
    return float(battery.log_likelihood + n * np.sum(np.log(battery.fitted.problem.weights)))


def about_hold(case: Case) -> list[str]:
    """What the hold has to say; only where the case is looked into thoroughly."""
    return [case.hold[1]] if case.thorough and case.hold[1] else []


def by_numbers(case: Case, numbers: Floated, tests: Sequence[FTest]) -> Diagnosis:
    """Moved numbers explain the records, but for what passes for noise with a memory."""
    left = left_to_noise(numbers.battery, case.levels)
    return parameters(case, numbers.refinement, numbers.tests, tests, left)


def parameters(
    case: Case, refinement: Refinement, passed: Sequence[FTest], tests: Sequence[FTest], left: str = ""
) -> Diagnosis:
    """Moved numbers explain the records: these show no need for a law."""
    return Diagnosis(
        "parameters", (), (), tuple(tests), tuple(passed), (), force_ratio=0.0, left_to_noise=left,
        floated=refinement, notes=tuple(about_hold(case)), **case.about,
    )  # fmt: skip


def adequate(case: Case, explained: Explained) -> Diagnosis:
    """Nothing is missing; say what the record would have shown."""
    count = len(explained.tests)
    known, battery = {c.effect for c in explained.scored}, explained.battery
    far = [e for e in case.library if e not in known and len(e.coefficients) == 1]
    scored = [*explained.scored, *candidate_columns(battery.fitted, far, case.motions[0], (battery.ratio,))]
    shown = detectable(battery, scored, count, case.significance, case.levels)
    own = {"force_ratio": battery.ratio, "left_to_noise": left_to_noise(battery, case.levels), **case.about}
    return Diagnosis("adequate", (), (), tuple(explained.tests), (), shown, **own)
