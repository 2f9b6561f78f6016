"""Which physical effect is missing, with a verdict that can be trusted."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any, TypeGuard

import control as ct

from ..arguments import as_share
from ..arithmetic import own_arithmetic
from ..data.measurement import Measurement
from ..data.response_record import in_frequency
from ..effects.effect import Effect
from ..effects.several import as_effects
from ..exceptions import IdentifiabilityWarning, unheard
from ..inference.assembly import check_settings
from ..inference.refinement import Refinement
from ..inference.windows import about_noise, as_data, check_validation, spread_lines
from ..models.conversion import as_physical, under_control
from ..progress import Progress
from ..refinement.base_fit import base_fit
from .asking import Ask, Unanswered, ask
from .beside_numbers import beside_numbers, gains_by_numbers, told_beside
from .case import Case
from .checks.check import looks
from .dead_sensors import without_dead_sensors
from .result import Diagnosis
from .without_a_law import Answer, gains
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
        found = investigate(
            base,
            records,
            asked=candidates,
            validation=validation,
            settings=options | {"candidates": None if candidates is None else tuple(candidates)},
            significance=significance,
            progress=steps,
        ).found
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
    numbers: bool = True,
) -> Answer:
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
    numbers : bool
        Whether laws are sought beside numbers of the model that are off, too.

    Returns
    -------
    Answer
        Beside "adequate", unless `thorough`, with the refitted rivals of a fault that few samples alone
        would show, or that a color of the noise may hide.
    """
    case = Case.prepare(base, records, asked, settings, significance, progress, thorough)
    answer = ask(case, validation)
    if isinstance(answer, Unanswered):

        def again(base: Refinement, thorough: bool) -> Answer | Unanswered:
            given = (case.settings, case.significance, case.progress, thorough)
            return ask(Case.prepare(base, case.records, case.library, *given), validation)

        answer = _none_passing(answer, again, numbers)
    return answer


def _none_passing(first: Unanswered, again: Ask, numbers: bool) -> Answer:
    """The diagnosis where no likely law passes: any law, beside what the model knows less, trying harder."""
    first = first.with_the_rest()
    if first.judged.passed:
        return first.told()
    zeros = with_zeros_sought(first, again)
    if isinstance(zeros, Unanswered):
        beside = beside_numbers(zeros, again) if numbers else None
        if _names(beside):
            return beside
        if gains(first.case, first.judged, zeros.judged.race):
            return _finished(zeros.with_the_rest(), beside)
    elif zeros is not None:
        return zeros
    beside = beside_numbers(first, again) if numbers else None
    return beside if _names(beside) else _finished(first, beside)


def _names(beside: Answer | Unanswered | None) -> TypeGuard[Answer]:
    """Whether something explains the record while the numbers float."""
    return isinstance(beside, Answer) and beside.found.verdict != "unexplained"


def _finished(open_: Unanswered, beside: Answer | Unanswered | None) -> Answer:
    """The diagnosis after what may be wrong with the fits; `beside` is the same while the numbers float."""
    last = open_ if open_.judged.passed else open_.insisted()
    answer = last.told()
    if last.judged.passed:
        return answer
    if not last.case.thorough:
        return answer._replace(floated=last.floated)
    if beside is not None and gains_by_numbers(answer.found, beside):
        answer = told_beside(answer.found, beside)
        if isinstance(beside, Answer):
            return answer
        last = beside
    return answer._replace(found=replace(answer.found, notes=(*answer.found.notes, *last.pairs())))
