"""One model, one battery of tests, one race of candidates: what that answers, or leaves open."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

from ..data.measurement import Measurement
from ..inference.f_tests import FTest
from ..inference.refinement import Refinement
from ..inference.sensitivities import Candidate, candidate_columns
from .candidate_fits import fit_candidates, shortlist
from .case import Case, no_motion, not_excited
from .colored_noise import is_drowned, takes_error_for_color
from .floating import floating, outdone, rivals_of_numbers
from .judging import Judged, judge, pair_hint, second_chance, with_special_cases, with_the_rest
from .naming import named
from .places import in_race
from .residual_tests import TestedResidual, run_tests
from .result import Diagnosis
from .unmeasured_force import Explained
from .verdict import overall
from .without_a_law import (
    Answer,
    adequate,
    by_numbers,
    earned_beside,
    numbers_instead,
    under_another_hold,
    without_a_law,
)

__all__ = ["Ask", "Unanswered", "ask"]


@dataclass(frozen=True, slots=True)
class Unanswered:
    """A case in which the best of the likely candidates fails its tests.

    Attributes
    ----------
    case : Case
        What was asked.
    judged : Judged
        The best candidate.
    floated : Refinement or None
        The model while all its numbers float, where they may.
    scored, scores : sequence
        All candidates, and the score test of each.
    chosen : sequence of int
        Those that were fitted.
    batteries : sequence of TestedResidual
        Residuals of the model, free and led by its observers.
    tests : sequence of FTest
        Tests of the model as it is.
    validation : Measurement or None
        Record on which the rows of the ranking are judged.
    """

    case: Case
    judged: Judged
    floated: Refinement | None
    scored: Sequence[Candidate]
    scores: Sequence[FTest]
    chosen: Sequence[int]
    batteries: Sequence[TestedResidual]
    tests: Sequence[FTest]
    validation: Measurement | None

    def with_the_rest(self) -> Unanswered:
        """With the candidates in the race that the scores had left out."""
        return replace(self, judged=with_the_rest(self.case, self.judged, self.scored, self.chosen))

    def insisted(self) -> Unanswered:
        """After all that may be wrong with the fits was tried."""
        return replace(self, judged=second_chance(self.case, self.judged, self.scored))

    def told(self) -> Answer:
        """The diagnosis as far as it came."""
        given = (self.judged, self.scored, self.scores, self.batteries, self.validation, self.tests)
        return Answer(named(self.case, *given), self.judged.race)

    def pairs(self) -> list[str]:
        """Whether two laws would do: a hint, where it is the last that can be said."""
        with self.case.progress.step("pairs"):
            return pair_hint(self.case, self.judged, self.scored)


Ask = Callable[[Refinement, bool], "Answer | Unanswered"]  # the same of a model fitted otherwise


def ask(case: Case, validation: Measurement | None) -> Answer | Unanswered:
    """What the tests of the model and the race of the likely candidates answer, if they do.

    Parameters
    ----------
    case : Case
        What is asked.
    validation : Measurement or None
        Record on which the rows of the ranking are judged.

    Returns
    -------
    Answer or Unanswered
    """
    still = case.in_time and (no_motion(case.ordered) or not_excited(case.base, case.ordered))
    if still:  # nothing moves in the records
        own = {"force_ratio": 0.0, "notes": (still,), **case.about}
        return Answer(Diagnosis("ambiguous", (), tuple(case.library), (), (), (), **own))
    with case.progress.step("tests"):
        near = in_race(case.fitted, case.library, (0.0, *case.observers))
        scored = candidate_columns(case.fitted, near, case.motions[0], (0.0, *case.observers))
        free_run = TestedResidual(case.fitted)
        tests = run_tests(free_run, scored, case.motions, len(case.library) - len(near))
    passed = case.passes(tests, case.fitted)
    doubtful = passed and takes_error_for_color(free_run, scored, case.levels)
    if passed and not doubtful:
        return _fine(case, Explained(free_run, scored, tests))
    floated = floating(case)
    force, numbers = without_a_law(case, free_run, floated, doubtful)
    mended = under_another_hold(case, numbers) if force is None else None
    if mended is not None:
        return Answer(mended)
    if numbers is not None and not rivals_of_numbers(case, numbers, scored):
        return Answer(by_numbers(case, numbers, tests))
    batteries = [free_run, *(TestedResidual(case.fitted, r) for r in case.observers)]
    chosen, scores = shortlist(scored, batteries)
    race = fit_candidates(case.fitted, [scored[i] for i in chosen], progress=case.progress)
    race = race and with_special_cases(race, scored, case.progress)
    if race is None:
        return Answer(Diagnosis("unexplained", (), (), tuple(tests), (), (), force_ratio=0.0, **case.about))
    with case.progress.step("tests"):
        judged = judge(case, race)
    if doubtful and not outdone(judged.race, free_run, case.levels.color):
        if force is not None or numbers is not None or not is_drowned(free_run, case.levels):
            # a color may be noise or a missing law: another record tells, for who has one to choose by
            unsure = not case.thorough and force is None and numbers is None
            return Answer(adequate(case, Explained(free_run, scored, tests)), race if unsure else None)
        lost = Judged(judged.race, [], False)  # it passes as the model does: that says nothing
        return Answer(named(case, lost, scored, scores, batteries, validation, tests), race)
    if force is not None:
        earned = earned_beside(case, force, judged)
        if earned is None:
            return Answer(adequate(case, force))
        judged = earned
    plainer = numbers_instead(case, numbers, floated, judged)
    if plainer is not None:
        return Answer(by_numbers(case, plainer, tests))
    open_ = Unanswered(case, judged, floated, scored, scores, chosen, batteries, tests, validation)
    return open_.told() if judged.passed else open_


def _fine(case: Case, explained: Explained) -> Answer:
    """Nothing is missing, or few samples carry it, fault or noise: another record may ask the candidates."""
    fine = adequate(case, explained)
    if case.thorough or overall(explained.tests, equal=True) >= case.significance:
        return Answer(fine)
    short = [explained.scored[i] for i in shortlist(explained.scored, [explained.battery])[0]]
    return Answer(fine, fit_candidates(case.fitted, short, progress=case.progress))
