"""Which physical effect is missing, with a verdict that can be trusted."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import control as ct
import numpy as np

from ..arguments import as_share
from ..arithmetic import own_arithmetic
from ..data.measurement import Measurement
from ..data.response_record import in_frequency
from ..effects.effect import Effect
from ..effects.several import as_effects
from ..exceptions import IdentifiabilityWarning, unheard
from ..inference.assembly import check_settings
from ..inference.f_tests import FTest
from ..inference.refinement import Refinement
from ..inference.sensitivities import Candidate, candidate_columns
from ..inference.windows import about_noise, as_data, check_validation, spread_lines
from ..models.conversion import as_physical, under_control
from ..progress import Progress
from ..refinement.base_fit import base_fit
from .candidate_fits import CandidateFits, fit_candidates, shortlist
from .case import Case
from .checks.check import looks
from .colored_noise import is_drowned, left_to_noise, takes_error_for_color
from .dead_sensors import without_dead_sensors
from .excitation import no_motion, not_excited
from .families import hosts, said_of_families
from .floating import floating, outdone, rivals_of_numbers
from .judging import Judged, judge, outweighed, pair_hint, second_chance, with_special_cases
from .open_law import open_law, probabilities
from .places import in_race
from .ranking import in_free_run, ranking
from .remarks import amplitude_test, fit_remarks, not_known, remarks
from .residual_tests import TestedResidual, run_tests
from .result import Diagnosis
from .unmeasured_force import Explained
from .verdict import overall, tied, verdict
from .without_a_law import (
    about_hold,
    adequate,
    earned_beside,
    numbers_instead,
    parameters,
    under_another_hold,
    without_a_law,
)
from .zeros import gains_by_zeros, zeros_sought

__all__ = ["diagnose", "investigate"]


def diagnose(
    model: Any,
    data: Measurement | Sequence[Measurement],
    *,
    candidates: Sequence[Effect] | None = None,
    validation: Measurement | None = None,
    free: str | Sequence[Any] = (),
    tolerance: float = 0.0,
    offset: bool = True,
    noise: float | Sequence[float] | None = None,
    horizon: float | None = None,
    significance: float = 0.01,
    controller: ct.StateSpace | None = None,
    executor: Any = None,
    progress: bool = False,
) -> Diagnosis:
    """Find the physical effect that a model lacks.

    The model is fitted as far as it is declared to be free; its whitened residual must
    pass a battery of tests. If it does not, all its numbers float by a few percent: where
    that passes, the record shows no need for a law. Else every candidate is scored on the motion that
    the record itself shows, the best are refitted, and the winner must pass the same
    battery.

    Parameters
    ----------
    model : StateSpace, PhysicalModel or Refinement
        Initial model, continuous time.
    data : Measurement or list of Measurement
        Record, or several of the same system. Or a `FrequencyResponse`, or a list of them at several
        amplitudes: one shows linear effects, delays, gains and hidden modes, nonlinear ones need the
        amplitudes.
    candidates : sequence of Effect, optional
        What could be missing, default `effect_library(model)`.
    validation : Measurement or FrequencyResponse, optional
        Record on which `fit_before` and `fit_after` are judged.
    free, tolerance, offset, noise, horizon
        As in `refine`: what of the linear model floats, the declared sensor noise, and the
        length of the free runs. Numbers that are a few percent off need no tolerance, for the
        verdict "parameters" is for them. Numbers that float from the start take up part of a weak
        law: of cubic springs that cost 1 % of the output at 3 % noise, 5 of 5 were named or
        tied with others at 0, and 3 of 5 at 0.05.
    significance : float
        Level of the gate: the rate of false alarms where nothing is missing.
    controller : StateSpace or TransferFunction, optional
        As in `refine`: the controller under which the record was taken.
    executor : concurrent.futures.Executor or dask.distributed.Client, optional
        Refits candidates in parallel.
    progress : bool
        Whether to show steps and remaining time on standard error.

    Returns
    -------
    Diagnosis
        Verdict, ranking, what cannot be told apart, every test.

    Raises
    ------
    DataError
        If the record is too short to test.
    ModelError
        If a candidate does not fit the model.

    Notes
    -----
    Score tests project every candidate off what was fitted; p-values are corrected for
    the number of candidates and of tests. Before any law is sought, every number that the model
    declares, and every mass of a plain `StateSpace`, floats with a prior of 5 %
    (``control.config.defaults["rcorefine.off"]``). If the residual then passes, the verdict is
    "parameters", unless a single effect explains the record as well: a log-likelihood
    within 4.6 of that of all the numbers, averaged over their prior. Rivals are compared by
    their likelihood under the whitening filter of the best one.

    An output of several that shows nothing in any record (constant, stopped, or noise alone) is left out with
    all that belongs to it; the notes say which and why, and `Diagnosis.records` holds what was kept.

    Examples
    --------
    >>> import numpy as np, rcorefine as rco
    >>> model = rco.mass_spring_damper([1.0], [0.4], [100.0], sensors="displacement")
    >>> rng = np.random.default_rng(0)
    >>> force = 10 * rng.standard_normal(2000)
    >>> blank = rco.Measurement(force, np.zeros(2000), dt=0.02)
    >>> y = rco.simulate(model, blank, "zero").outputs[0]
    >>> noisy = y + 0.03 * y.std() * rng.standard_normal(2000)
    >>> found = rco.diagnose(model, rco.Measurement(force, noisy, dt=0.02))
    >>> found.verdict
    'adequate'
    """
    significance = as_share(significance, "significance")
    given = as_data(data, horizon=horizon, noise=noise, controller=controller)
    model = seen = under_control(model, controller, data)
    candidates = None if candidates is None else as_effects(candidates, "candidates")
    if validation is not None:
        check_validation(model, validation)
    options: dict[str, Any] = {"free": free, "tolerance": tolerance, "offset": offset}
    options |= {"noise": noise, "horizon": horizon}
    check_settings(as_physical(model), **options)
    live, silent = given, tuple[str, ...]()
    watched = without_dead_sensors(model, given)
    if watched is not None:
        model, live, silent = watched.model, [watched.record(one) for one in given], watched.said
        options["noise"] = watched.noise(noise)
        entries = [free] if isinstance(free, Effect) else free
        options["free"] = free if isinstance(free, str) else watched.effects(entries)
        candidates = None if candidates is None else watched.effects(candidates)
        validation = None if validation is None else watched.record(validation)
    records = spread_lines(live)
    with own_arithmetic(), unheard(IdentifiabilityWarning), Progress(progress, executor) as steps:
        with steps.step("model as it is"):
            base = base_fit(model, records, **options)
        with steps.step("what is odd"):
            odd = () if in_frequency(records) else looks(seen, given, horizon)
        found, _ = investigate(
            base,
            records,
            asked=candidates,
            validation=validation,
            settings=options | {"candidates": None if candidates is None else tuple(candidates)},
            significance=significance,
            progress=steps,
        )
        said = about_noise(base.physical_model, records, live)
        return replace(found, checks=odd, records=tuple(live), notes=(*silent, *found.notes, *said))


def investigate(
    base: Refinement,
    records: Sequence[Measurement],
    *,
    asked: Sequence[Effect] | None,
    validation: Measurement | None,
    settings: dict[str, Any],
    significance: float,
    progress: Progress,
    thorough: bool = True,
) -> tuple[Diagnosis, CandidateFits | None]:
    """Diagnose a model that was fitted to the records already.

    Parameters
    ----------
    base : Refinement
        The model at its minimum.
    records : sequence of Measurement
        What it was fitted to.
    asked : sequence of Effect, or None
        Candidates; the library for None.
    validation, settings, significance
        As in `diagnose`; settings holds its options of fitting.
    progress : Progress
        What does the steps and counts them.
    thorough : bool
        Whether to try harder where no candidate passes, and pairs of them.

    Returns
    -------
    found : Diagnosis
    race : CandidateFits or None
        The refitted rivals, where there were any. Beside "adequate", unless `thorough`, those of
        a fault that few samples alone would show.
    """
    case = Case.prepare(base, records, asked, settings, significance, progress, thorough)
    unknown = _unseen(case, base)
    if unknown is not None:
        return unknown, None
    with progress.step("tests"):
        near = in_race(case.fitted, case.library, (0.0, *case.observers))
        scored = candidate_columns(case.fitted, near, case.motions[0], (0.0, *case.observers))
        free_run = TestedResidual(case.fitted)
        tests = run_tests(free_run, scored, case.motions, len(case.library) - len(near))
    passed = case.passes(tests, case.fitted)
    doubtful = passed and takes_error_for_color(free_run, scored, case.levels)
    if passed and not doubtful:
        fine = adequate(case, Explained(free_run, scored, tests))
        if thorough or overall(tests, equal=True) >= significance:
            return fine, None
        # few samples carry it, fault or noise: whoever holds another record asks the candidates there
        short = [scored[i] for i in shortlist(scored, [free_run])[0]]
        return fine, fit_candidates(case.fitted, short, progress=progress)
    floated = floating(case)
    force, numbers = without_a_law(case, free_run, floated, doubtful)
    mended = under_another_hold(case, numbers) if force is None else None
    if mended is not None:
        return mended, None
    if numbers is not None and not rivals_of_numbers(case, numbers, scored):
        return parameters(case, numbers, tests), None
    batteries = [free_run, *(TestedResidual(case.fitted, r) for r in case.observers)]
    chosen, scores = shortlist(scored, batteries)
    race = fit_candidates(case.fitted, [scored[i] for i in chosen], progress=progress)
    race = race and with_special_cases(race, scored, progress)
    if race is None:
        return Diagnosis("unexplained", (), (), tuple(tests), (), (), force_ratio=0.0, **case.about), None
    with progress.step("tests"):
        judged = judge(case, race)
    if doubtful and not outdone(judged.race, free_run, case.levels.color):
        if force is not None or numbers is not None or not is_drowned(free_run, case.levels):
            return adequate(case, Explained(free_run, scored, tests)), None
        lost = Judged(judged.race, [], False)  # it passes as the model does: that says nothing
        return _named(case, lost, scored, scores, batteries, validation, tests), race
    if force is not None:
        earned = earned_beside(case, force, judged)
        if earned is None:
            return adequate(case, force), None
        judged = earned
    plainer = numbers_instead(case, numbers, floated, judged)
    if plainer is not None:
        return parameters(case, plainer, tests), None
    other = None if judged.passed else _with_zeros_sought(case, judged, validation)
    if other is None:
        judged = judged if judged.passed else second_chance(case, judged, scored, chosen)
    return other or (_named(case, judged, scored, scores, batteries, validation, tests), judged.race)


def _unseen(case: Case, base: Refinement) -> Diagnosis | None:
    """The verdict on records in which nothing moves."""
    still = case.in_time and (no_motion(case.ordered) or not_excited(base, case.ordered))
    if not still:
        return None
    alike = tuple(case.library)
    return Diagnosis("ambiguous", (), alike, (), (), (), force_ratio=0.0, notes=(still,), **case.about)


def _with_zeros_sought(
    case: Case, judged: Judged, validation: Measurement | None
) -> tuple[Diagnosis, CandidateFits | None] | None:
    """The diagnosis with offsets wherever laws want them, where that says more."""
    base = zeros_sought(case, judged)
    if base is None:
        return None
    found, race = investigate(
        base,
        case.records,
        asked=case.library,
        validation=validation,
        settings=case.settings,
        significance=case.significance,
        progress=case.progress,
        thorough=case.thorough,
    )
    explains = found.verdict != "unexplained"
    return (found, race) if explains or gains_by_zeros(case, judged, race) else None


def _named(
    case: Case,
    judged: Judged,
    scored: Sequence[Candidate],
    scores: Sequence[FTest],
    batteries: Sequence[TestedResidual],
    validation: Measurement | None,
    tests: Sequence[FTest],
) -> Diagnosis:
    """The ranking, who is tied, and what the tests of the winner make of it."""
    race = judged.race
    likelihoods = [rival.log_likelihood for rival in race.rivals]
    p_of = {c.effect: test.p_value for c, test in zip(scored, scores, strict=True)}
    lacks = [0.0 if rival.settled else rival.lack for rival in race.rivals]
    ties = tied(likelihoods, lacks, case.levels)
    held = hosts(race.rivals, ties, case.levels)
    alike = tuple(race.rivals[i].effect for i in ties if i not in held)
    several = judged.passed and len(case.records) > 1
    agreement, sentence = amplitude_test(race, case.levels) if several else (1.0, "")
    unknown = not_known(race, case.levels) if judged.passed else ""
    passed = judged.passed and not unknown
    word = verdict(passed, agreement, len(alike), case.levels, judged.against)
    with case.progress.step("free forces"):
        law = open_law(race) if word == "unexplained" and case.thorough and case.in_time else None
    odds = (judged.beside, judged.elsewhere) if judged.passed else (-np.inf, -np.inf)
    shares, none, places = probabilities(race, *odds, law)
    if word == "unexplained":  # none is printed for what fails its own tests
        shares, none = np.full(len(shares), np.nan), 1.0
    shown = in_free_run(race) if word == "unexplained" and case.thorough else race
    p_values = [p_of[rival.effect] for rival in shown.rivals]
    if word == "unexplained" and not case.in_time:  # laws that fail do not tell where
        places = {}
    rows = ranking(shown, p_values, shares, case.base, validation, case.settings["horizon"])
    notes = [*about_hold(case), *fit_remarks(race), *remarks(race, scored, batteries)]
    notes += said_of_families(race.rivals, held)
    notes += [said for said in (sentence, unknown, outweighed(judged, case.levels)) if said]
    if case.thorough and word == "unexplained":
        with case.progress.step("pairs"):
            notes += pair_hint(case, judged, scored)
    own = {"force_ratio": race.ratio, "notes": tuple(notes), **case.about}
    own["left_to_noise"] = "" if judged.tests else left_to_noise(batteries[0], case.levels)
    found = Diagnosis(word, rows, alike, tuple(tests), tuple(judged.tests), (), **own)
    return replace(found, none_of_these=none, places=places, open_law=None if law is None else law.law)
