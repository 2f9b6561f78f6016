"""Which physical effect is missing, with a verdict that can be trusted."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from typing import Any

import control as ct

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
from ..inference.sensitivities import candidate_columns
from ..inference.windows import about_noise, as_data, check_validation, spread_lines
from ..models.conversion import as_physical, under_control
from ..progress import Progress
from ..refinement.base_fit import base_fit
from .beside_numbers import beside_numbers, open_beside_numbers
from .candidate_fits import CandidateFits, fit_candidates, shortlist
from .case import Case
from .checks.check import looks
from .colored_noise import is_drowned, takes_error_for_color
from .dead_sensors import without_dead_sensors
from .excitation import no_motion, not_excited
from .floating import floating, outdone, rivals_of_numbers
from .judging import Judged, judge, second_chance, with_special_cases
from .naming import named
from .places import in_race
from .residual_tests import TestedResidual, run_tests
from .result import Diagnosis
from .unmeasured_force import Explained
from .verdict import overall
from .without_a_law import (
    Answer,
    adequate,
    earned_beside,
    numbers_instead,
    parameters,
    under_another_hold,
    without_a_law,
)
from .zeros import with_zeros_sought

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
    their likelihood under the whitening filter of the best one. Where neither the numbers nor a law
    explain the record, every law is tried once more while the numbers float: then `base` is the model
    with its numbers fitted, and the notes list those that moved.

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
        return _fine(case, Explained(free_run, scored, tests))
    floated = floating(case)
    force, numbers = without_a_law(case, free_run, floated, doubtful)
    mended = under_another_hold(case, numbers) if force is None else None
    if mended is not None:
        return mended, None
    if numbers is not None and not rivals_of_numbers(case, numbers, scored):
        return parameters(case, numbers.refinement, numbers.tests, tests), None
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
        return named(case, lost, scored, scores, batteries, validation, tests), race
    if force is not None:
        earned = earned_beside(case, force, judged)
        if earned is None:
            return adequate(case, force), None
        judged = earned
    plainer = numbers_instead(case, numbers, floated, judged)
    if plainer is not None:
        return parameters(case, plainer.refinement, plainer.tests, tests), None
    tell = partial(
        named, case, scored=scored, scores=scores, batteries=batteries, validation=validation, tests=tests
    )
    if judged.passed:
        return tell(judged), judged.race
    insist = partial(second_chance, case, judged, scored, chosen)
    return _none_passing(case, judged, floated, tests, partial(_again, case, validation), insist, tell)


def _fine(case: Case, explained: Explained) -> Answer:
    """Nothing is missing, or few samples carry it, fault or noise: another record may ask the candidates."""
    fine = adequate(case, explained)
    if case.thorough or overall(explained.tests, equal=True) >= case.significance:
        return fine, None
    short = [explained.scored[i] for i in shortlist(explained.scored, [explained.battery])[0]]
    return fine, fit_candidates(case.fitted, short, progress=case.progress)


def _none_passing(
    case: Case,
    judged: Judged,
    floated: Refinement | None,
    tests: Sequence[FTest],
    again: Callable[[Refinement, bool], Answer],
    insist: Callable[[], Judged],
    tell: Callable[[Judged], Diagnosis],
) -> Answer:
    """The diagnosis where no law passes: of a model that knows less, or by trying harder."""
    elsewhere = with_zeros_sought(case, judged, again)
    elsewhere = elsewhere or beside_numbers(case, judged, floated, tests, again)
    if elsewhere is not None:
        return elsewhere
    judged = insist()
    found = tell(judged)
    return open_beside_numbers(case, found, floated, again) or (found, judged.race)


def _unseen(case: Case, base: Refinement) -> Diagnosis | None:
    """The verdict on records in which nothing moves."""
    still = case.in_time and (no_motion(case.ordered) or not_excited(base, case.ordered))
    if not still:
        return None
    alike = tuple(case.library)
    return Diagnosis("ambiguous", (), alike, (), (), (), force_ratio=0.0, notes=(still,), **case.about)


def _again(case: Case, validation: Measurement | None, base: Refinement, thorough: bool) -> Answer:
    """The same asked of the model fitted otherwise."""
    return investigate(
        base,
        case.records,
        asked=case.library,
        validation=validation,
        settings=case.settings,
        significance=case.significance,
        progress=case.progress,
        thorough=thorough,
    )
