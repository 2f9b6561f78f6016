"""The winner of the candidate fits before the tests, and what may be wrong where it fails them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from ..exceptions import ModelError
from ..inference.f_tests import FTest
from ..inference.levels import Levels
from ..inference.sensitivities import Candidate, candidate_columns
from ..inference.starts import estimated_motion
from ..progress import Progress
from ..systems.linear import Array
from .beside import Beside
from .candidate_fits import CandidateFits, fit_candidates
from .case import Case, not_held
from .families import contains
from .free_stiffness import FreeStiffness
from .places import in_race
from .residual_tests import TestedResidual, passed_without_library, run_tests
from .starts import force_along
from .unmeasured_force import likely_forces

__all__ = [
    "Judged",
    "beside_force",
    "beyond",
    "judge",
    "outweighed",
    "outweighs",
    "pair_hint",
    "second_chance",
    "with_special_cases",
    "with_the_rest",
]

_PAIRS = 3  # seconds that are tried for a hint


@dataclass(eq=False)
class Judged:
    """Candidate fits, and the tests of the winner's residual.

    Attributes
    ----------
    race : CandidateFits
        The fits.
    tests : list of FTest
        Tests of the winner's residual; none where they could not be done.
    passed : bool
        Whether that residual is noise.
    beside : float
        Log of the odds of a force of no law at the winner's place, over the winner's; -inf where that is no
        force at a port.
    elsewhere : float
        The same of a force of no law whose place nobody knows: what an unmeasured force stands for.
    """

    race: CandidateFits
    tests: list[FTest]
    passed: bool
    beside: float = -np.inf
    elsewhere: float = -np.inf

    @property
    def against(self) -> float:
        """Log of the odds of none of the candidates, over the winner's."""
        return float(np.logaddexp(self.beside, self.elsewhere))


def judge(case: Case, race: CandidateFits) -> Judged:
    """The winner's residual through the tests that the model itself went through.

    A candidate with a sign that physics rules out wins over none that has a possible one.
    Where it fails, and the next likely law contains it and passes, that one takes its place: the
    simplest member of a family is named only if it does.
    """
    possible = [rival for rival in race.rivals if not rival.unphysical]
    race = replace(race, rivals=possible or race.rivals, _models={})
    judged = _tested(case, race)
    if judged.passed or len(race.rivals) < 2 or not contains(race.rivals[1].effect, race.rivals[0].effect):
        return judged
    wider = _tested(case, replace(race, rivals=race.rivals[1:], _models={}))
    return wider if wider.passed else judged


def _tested(case: Case, race: CandidateFits) -> Judged:
    """The winner's residual, tested."""
    fitted = race.model()
    rest = not_held(case.library, fitted.structure.effects)
    if fitted.problem.dwells:
        # the free stiffness stands for the other laws: a balance of two of them is slow
        rest = [e for e in rest if e.spec.linear or e.spec.delays]
    try:
        moved = [estimated_motion(fitted.structure, fitted.theta, motion.data) for motion in case.motions]
        near = in_race(fitted, rest, (race.ratio,))
        scored = candidate_columns(fitted, near, moved[0], (race.ratio,))
        battery = TestedResidual(fitted, race.ratio)
        tests = run_tests(battery, scored, moved, len(rest) - len(near))
        free = (Beside if case.in_time else FreeStiffness)(battery, race.rivals[0].effect.place)
        tests += free.tests()
    except ModelError:  # it runs away within one sample, or no observer leads it: untested is not passed
        return Judged(race, [], False)
    if isinstance(free, FreeStiffness):
        odds = free.odds(race.fitted)
    else:
        along = force_along(race.rivals[0].candidate, race.rivals[0].descent.point)
        odds = -np.inf if along is None else free.odds(along[-1])
    return Judged(race, tests, case.passes(tests, fitted), odds)


def outweighs(judged: Judged, forced: TestedResidual, price: float) -> bool:
    """Whether a winner that passes is likelier than an unmeasured force alone."""
    if not judged.passed:
        return False
    own = TestedResidual(judged.race.model(), judged.race.ratio).log_likelihood
    return own >= forced.log_likelihood + price


def beside_force(case: Case, first: Judged) -> Judged | None:
    """The candidates with an unmeasured force beside them, where the winner then passes."""
    race, levels = first.race, case.levels
    if not case.in_time or not first.tests:  # to a response, a force that nobody measured is noise
        return None
    winner = race.model()
    if case.excess(winner) > levels.noise_excess:
        return None
    for led in likely_forces(winner, TestedResidual(winner), levels.force_beside, levels)[:2]:
        if _hopeless(case, led):
            continue  # no refit mends that, and all candidates take long
        again = fit_candidates(race.fitted.forced(led.fitted.force_at), [], led.ratio, entered=race.rivals)
        if again is not None:
            judged = judge(case, again)
            if judged.passed:
                return replace(judged, elsewhere=_left_to_force(judged.race, race))
    return None


def _hopeless(case: Case, battery: TestedResidual) -> bool:
    """Whether a residual fails the tests that need no candidates by far."""
    structure, theta = battery.fitted.structure, battery.fitted.theta
    moved = [estimated_motion(structure, theta, m.data) for m in case.motions]
    return passed_without_library(battery, moved, case.levels.hopeless) is None


def _left_to_force(race: CandidateFits, free: CandidateFits) -> float:
    """Log of the odds that a law which is no candidate makes what the unmeasured force stands for.

    Nobody has measured that force, and it explains whatever a law does: the name is as likely as its share
    of the error of the free run, beyond what is new in each sample.
    """
    same = [i for i, rival in enumerate(free.rivals) if rival.effect == race.rivals[0].effect]
    fits, scales = (free.model(same[0]) if same else race.model(), free.fitted), race.whitener.scales
    after, before = (beyond(fitted.residuals(), scales) for fitted in fits)
    share = np.clip(after / before if before else 1.0, 1e-12, 1.0 - 1e-12)
    return float(np.log(share) - np.log1p(-share))


def beyond(residuals: Sequence[Array], scales: Array) -> float:
    """Return the power of residuals beyond their innovations, over that of these, summed over outputs."""
    left = np.hstack(residuals) / scales[:, None]
    return float(np.sum(np.maximum(np.mean(left**2, axis=1) - 1.0, 0.0)))


def with_the_rest(case: Case, first: Judged, scored: Sequence[Candidate], chosen: Sequence[int]) -> Judged:
    """The winner of all candidates, with those that their scores had left out.

    Parameters
    ----------
    case : Case
        What is asked.
    first : Judged
        The winner that failed.
    scored : sequence of Candidate
        All candidates.
    chosen : sequence of int
        Those that were fitted.

    Returns
    -------
    Judged
        The first one again where none of them comes nearer.
    """
    race = first.race
    rest = [c for i, c in enumerate(scored) if i not in set(chosen)] + list(race.left)
    again = fit_candidates(race.fitted, rest, entered=race.rivals, progress=case.progress)
    if again is None:
        return first
    if _ahead(again, race):
        return judge(case, again)
    return first if case.thorough else Judged(again, first.tests, False)


def second_chance(case: Case, first: Judged, scored: Sequence[Candidate]) -> Judged:
    """What may be wrong when the winner fails: an unmeasured force, or a stuck fit.

    Parameters
    ----------
    case : Case
        What is asked.
    first : Judged
        The winner that failed.
    scored : sequence of Candidate
        All candidates.

    Returns
    -------
    Judged
        One that passes, or the last that failed.
    """
    beside = beside_force(case, first)
    if beside is not None:
        return beside
    race = first.race
    if not case.thorough or any(r.candidate.problem.dwells for r in race.rivals[:3]):
        return first
    # what the winner's own residual points at counts among those that may be stuck
    pointed = [c for c in scored if any(t.name == f"library (most: {c.effect.label})" for t in first.tests)]
    stuck = list(dict.fromkeys([*(r.candidate for r in race.rivals[:3]), *pointed]))
    again = fit_candidates(race.fitted, stuck, entered=race.rivals, thorough=True, progress=case.progress)
    if again is not None and _ahead(again, race):
        judged = judge(case, again)
        return judged if judged.passed else first
    return first


def outweighed(judged: Judged, levels: Levels) -> str:
    """Why a winner that passes every test is no name; "" where that is not so."""
    best = judged.race.rivals[0].effect
    if not judged.passed or 2 * judged.against <= levels.rival:
        return ""
    if 2 * judged.beside > levels.rival:
        return (
            f"{best.label} passes every test, but a force at {best.place} that departs from it is more than "
            f"{np.exp(levels.rival / 2):.0f} times as likely."
        )
    return (
        f"{best.label} passes every test beside an unmeasured force, which explains the larger part of the "
        "error: what makes that force, and where, this record does not tell."
    )


def pair_hint(case: Case, judged: Judged, scored: Sequence[Candidate]) -> list[str]:
    """Whether the winner and one effect more would pass: flexible, so a hint and no verdict."""
    race = judged.race
    fitted = race.model()
    if fitted.problem.dwells or not judged.tests:  # a pair under harmonic balance takes too long for a hint
        return []
    first = race.rivals[0].effect
    rest = not_held([c.effect for c in scored], [first])
    if not rest:
        return []
    scored = candidate_columns(fitted, rest, case.motions[0], (0.0,))
    tests = TestedResidual(fitted).each(scored)
    order = np.argsort([t.p_value for t in tests], kind="stable")[:_PAIRS]
    likely = [rest[i] for i in order]
    second = candidate_columns(fitted, likely, case.motions[0], (0.0, *case.observers))
    pair = fit_candidates(fitted, second, race.ratio)
    if (
        pair is None
        or pair.rivals[0].unphysical
        or _hopeless(case, TestedResidual(pair.model(), race.ratio))
        or not judge(case, pair).passed
    ):
        return []
    return [
        f"A pair would pass every test: {first.label} with {pair.rivals[0].effect.label}. Pairs are flexible "
        "enough to mimic what they are not; a record at another amplitude would tell."
    ]


def _ahead(again: CandidateFits, before: CandidateFits) -> bool:
    """Whether candidate fits ended elsewhere than before: another winner, or the same one higher."""
    if again.rivals[0].effect != before.rivals[0].effect:
        return True
    # each has a filter of its own, so their levels are what compares
    scales = np.log(before.whitener.scales) - np.log(again.whitener.scales)
    return float(again.fitted.problem.n_points * np.mean(scales)) > 1.0


def with_special_cases(
    race: CandidateFits, candidates: Sequence[Candidate], progress: Progress
) -> CandidateFits:
    """Fits to responses with whatever the first one contains: it may do the same with fewer coefficients.

    Parameters
    ----------
    race : CandidateFits
        Fits.
    candidates : sequence of Candidate
        All that were scored.
    progress : Progress
        What does the steps and counts them.
    """
    if race.fitted.problem.in_time:  # there the places that lead bring all their laws along
        return race
    fitted, first = {rival.effect for rival in race.rivals}, race.rivals[0].effect
    special = [c for c in candidates if c.effect not in fitted and contains(first, c.effect)]
    if not special:
        return race
    again = fit_candidates(race.fitted, special, race.ratio, entered=race.rivals, progress=progress)
    return again or race
