"""Diagnosis of the physical effects that a model lacks."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import control as ct
import numpy as np

from ..arguments import as_number, as_share
from ..data.measurement import Measurement
from ..data.records import amplitude, as_data, at_rest, stretches_by_level
from ..effects.effect import Effect, as_effects
from ..exceptions import IdentifiabilityWarning, own_arithmetic, unheard
from ..inference.assembly import (
    about_noise,
    check_settings,
    check_validation,
    spread_lines,
)
from ..inference.covariance import wald
from ..inference.fitted import FittedModel, coefficient_covariance
from ..inference.levels import Levels, levels
from ..inference.problem import descend
from ..inference.refinement import Refinement
from ..inference.search import starting_states
from ..inference.sensitivities import candidate_columns
from ..models.controller import Controller
from ..models.conversion import as_physical, under_control
from ..progress import Progress
from ..refinement.refine import base_fit
from ..results import chance, with_error
from ..systems.linear import Array
from .case import Case, no_motion, not_excited, not_tried, with_recorded_inputs
from .check import looks
from .dead_sensors import without_dead_sensors
from .held_out import by_smaller_motion
from .hypothesis import Trial
from .noise import error_shares, is_drowned, left_to_noise, matter
from .nuisances import Hold, about_hold, with_fitting_priors, with_offsets
from .open_law import FreeForces, open_force
from .result import Diagnosis
from .search import MOST, Search, is_gain
from .verdict import (
    Answer,
    Listed,
    TableRow,
    answer,
    close_enough,
    detectable,
    log_sum,
    ranking,
    table,
    undetermined,
)
from .words import determined, numbers_that_moved, percent

_OTHER_AMPLITUDE = 1.3  # amplitude over that of another record


def amplitude_test(fitted: FittedModel, added: int, levels: Levels) -> tuple[float, str]:
    """Test whether motions of different amplitude have the same coefficients.

    An effect that only approximates the true one has other coefficients at another amplitude. Several records
    are compared with each other, a single one in its stretches of different excitation.

    Parameters
    ----------
    fitted : FittedModel
        Model with the effects.
    added : int
        Number of tested effects, the last ones of the model.
    levels : Levels
        Levels of the decision.

    Returns
    -------
    p_value : float
        p-value of the Wald test; 1 if all amplitudes are similar.
    sentence : str
        Result of the comparison in words; empty without one.
    """
    # one record is cut into stretches of different excitation
    structure, records = fitted.structure, fitted.problem.records
    if len(records) == 1 and not at_rest(records):
        stretches = (piece for _, piece in stretches_by_level(records[0]))
        # compare the smallest with the largest amplitude
        records = [piece for piece in stretches if piece.n_samples >= piece.shortest] or records
    sizes = [amplitude(record) for record in records]
    low, high = int(np.argmin(sizes)), int(np.argmax(sizes))
    if sizes[high] <= _OTHER_AMPLITUDE * max(sizes[low], 1e-300):
        return 1.0, ""
    first = len(structure.effects) - added
    # Wald test, with a tolerance for what counts as the same value
    own = np.flatnonzero([q.effect >= first for q in structure.parameters])
    (one, C1), (two, C2) = (_alone(fitted, records[i]) for i in (low, high))
    spread = np.diag((levels.same_value * fitted.theta[own]) ** 2)
    p_value = wald((one - two)[own], (C1 + C2)[np.ix_(own, own)] + spread)
    p, name = own[0], structure.effects[first].label
    values = " and ".join(with_error(e[p], np.sqrt(C[p, p])) for e, C in ((one, C1), (two, C2)))
    sentence = (
        f"Fitted alone at the smallest and the largest amplitude, {name} is {values} "
        f"({'they disagree' if p_value < levels.disagree else 'they agree'}, {chance(p_value, 'p')})."
    )
    return p_value, sentence


def _alone(fitted: FittedModel, record: Any) -> tuple[Array, Array]:
    """Return coefficients and covariance, estimated from one record alone."""
    theta, _ = fitted.problem.unpack(fitted.point)
    problem = fitted.problem.like(records=[record])
    # fit, noise model of this record, fit with it
    run = descend(problem, problem.pack(theta, starting_states(problem, theta)), evaluations=15)
    whitener = problem.whitener([residual for residual, _ in run.blocks(problem)])  # the noise of this record
    run = descend(problem, run.point, whitener=whitener, evaluations=15, tolerance=1e-8)
    C = coefficient_covariance(problem, run.blocks(problem), whitener)
    return problem.unpack(run.point)[0].copy(), C


def remarks(fitted: FittedModel, effects: Sequence[Effect]) -> list[str]:
    """Return warnings about a fit with effects.

    They name friction without reversal of the motion, and coefficients at a bound.
    """
    # friction needs a motion that reverses
    ports, said = {port.name for port in fitted.structure.model.ports}, []
    for effect in effects:
        if not (effect.spec.turns and effect.place in ports and fitted.problem.in_time):
            continue
        v = np.concatenate([fitted.port(effect.place, 0.0, i)[1] for i in range(len(fitted.problem.records))])
        if v.min() >= 0 or v.max() <= 0:
            said.append(
                f"The motion at {effect.place} never changes direction: friction there cannot be told from a "
                "constant force."
            )
    bound = fitted.refinement.message.partition(" At its bound: ")[2]
    return [*said, *([f"At its bound, and so no estimate: {bound}"] if bound else [])]


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
    matters: float | None = None,
    effort: float = 1.0,
    controller: Controller | ct.StateSpace | None = None,
    executor: Any = None,
    progress: bool | None = None,
) -> Diagnosis:
    """Find the physical effect that a model lacks.

    The function compares hypotheses: nothing is missing, the parameters are wrong, or one or several effects
    are missing. It fits each of the likely hypotheses together with nuisance parameters of the record. The
    score of a hypothesis is its log evidence plus its log prior probability. The verdict follows from the
    table of scores. An effect is named only if the residual passes every residual test.

    Parameters
    ----------
    model : StateSpace, PhysicalModel or Refinement
        Initial model, continuous time.
    data : Measurement or list of Measurement
        Record, or several records of the same system. Or a `FrequencyResponse`, or a list of them. A
        frequency response shows linear effects, delays, gains and hidden modes. Nonlinear effects need
        responses of known amplitude, best at several amplitudes.
    candidates : sequence of Effect, optional
        Candidate effects. By default these are `effect_library(model)`, the zero entries of B, C and D of
        stores, the faults of a whole record, and `output_average` over a sample at outputs that are rates.
        Inputs of the records that the model lacks are added to it, with zero columns of B and D: their
        entries are candidates, too.
    validation : Measurement or FrequencyResponse, optional
        Validation data for `fit_before` and `fit_after` of the ranking.
    free, tolerance, offset, noise, horizon
        As in `refine`: free parameters of the linear model, declared sensor noise, and length of the
        simulations (free runs). ``free="linear"`` changes nothing here: the search re-estimates all
        parameters. Parameters that are a few percent wrong need no tolerance: the verdict
        "parameters" covers them. Parameters that are free from the start make weak effects harder to find.
        Example: cubic springs that cost 1 % of the output, at 3 % noise. With tolerance 0, 5 of 5 were named
        or tied; with tolerance 0.05, 3 of 5.
    significance : float
        Significance level of all residual tests together: the false-alarm rate if nothing is missing.
    matters : float, optional
        Share of the spread of an output, default .01 (``rcorefine.matters``). An error of the model below it,
        or below the rounding step of the sensor, does not matter even if a test finds it.
    effort : float
        Number of refits of the search, in units of 120. If they are spent and the verdict is "unexplained",
        the notes say what was not tried.
    controller : Controller, StateSpace or TransferFunction, optional
        As in `refine`: the controller that was active during the measurement.
    executor : concurrent.futures.Executor or dask.distributed.Client, optional
        Executor that refits candidates in parallel. On the threads of a `ThreadPoolExecutor` the answer is
        the same, and its simulations run beside each other.
    progress : bool, optional
        Whether to show steps and remaining time on standard error. By default in a terminal and in a
        notebook.

    Returns
    -------
    Diagnosis
        Verdict, ranking, effects that the data cannot distinguish, and all residual tests.

    Raises
    ------
    DataError
        If the record is too short to test.
    ModelError
        If a candidate does not fit the model.

    Notes
    -----
    Evidence: Laplace's method approximates the marginal likelihood. Each hypothesis has its likeliest
    noise: autoregressive, heavy-tailed, proportional to the signal, or rounding.

    Priors: the relative standard deviation of the parameters is 5, 20 or 100 %, with probability 0.6, 0.3
    and 0.1. Each coefficient of an effect may change the output as much as the effect as a whole.

    Search: candidate effects are compared to first order, in sets of up to four. The best sets are refitted.

    Decision: "adequate" needs a residual that passes the tests, and no set that is ``1 / significance`` times
    as probable. The verdict "effect" needs a probability of at least 0.95, or of 0.5 if no other set is
    within odds of 100:1. A hidden state (a mode, a store) is named only if no black box without that state
    reaches the same error. If one force law contains another, the simpler one is named within odds of 10:1,
    or if the limit that distinguishes them is within two standard deviations of its value there.

    With several outputs, an output without information in any record is left out, with everything that
    depends on it. Such an output is constant, stops, or shows noise only. The notes name it and give the
    reason; `Diagnosis.records` holds the remaining channels.

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
    with own_arithmetic(), unheard(IdentifiabilityWarning), Progress(progress, executor) as steps:
        return investigate(
            model, data, candidates=candidates, validation=validation, free=free, tolerance=tolerance,
            offset=offset, noise=noise, horizon=horizon, significance=significance, matters=matters,
            effort=effort, controller=controller, steps=steps,
        ).found  # fmt: skip


class Investigation(NamedTuple):
    """A diagnosis with what it rests on.

    Attributes
    ----------
    found : Diagnosis
        Diagnosis.
    case : Case
        Initial model, records without dead sensors, and settings.
    model : StateSpace, PhysicalModel or Refinement
        Initial model, with the channels of the case.
    validation : Measurement or None
        Validation data with these channels.
    """

    found: Diagnosis
    case: Case
    model: Any
    validation: Measurement | None


def investigate(
    model: Any,
    data: Measurement | Sequence[Measurement],
    *,
    candidates: Sequence[Effect] | None,
    validation: Measurement | None,
    significance: float,
    matters: float | None,
    effort: float,
    controller: Controller | ct.StateSpace | None,
    steps: Progress,
    most: int = MOST + 1,
    **options: Any,
) -> Investigation:
    """Diagnose a model and return the case, too.

    Parameters
    ----------
    model, data, candidates, validation, significance, matters, effort, controller
        As in `diagnose`.
    steps : Progress
        Progress display.
    most : int
        Maximum number of effects.
    **options
        free, tolerance, offset, noise and horizon as in `diagnose`.

    Returns
    -------
    Investigation
    """
    # arguments, then model and records in one order of channels
    significance = as_share(significance, "significance")
    effort = as_number(effort, "effort", least=0.0)
    matters = levels().matters if matters is None else as_number(matters, "matters", least=0.0)
    noise, horizon = options["noise"], options["horizon"]
    given = as_data(data, horizon=horizon, noise=noise, controller=controller)
    model = seen = under_control(model, controller, data)
    added: tuple[str, ...] = ()
    if candidates is not None:
        candidates = as_effects(candidates, "candidates")
    else:
        model, added = with_recorded_inputs(model, [*given, *([] if validation is None else [validation])])
    # settings and validation record must suit the model
    if validation is not None:
        check_validation(model, validation)
    check_settings(as_physical(model), **options)
    free_all = isinstance(options["free"], str)
    if free_all:  # the search re-estimates all parameters, with priors
        options["free"] = ()
    # outputs that show nothing are left out
    live, silent = given, tuple[str, ...]()
    watched = without_dead_sensors(model, given)
    if watched is not None:
        model, live, silent = watched.model, [watched.record(one) for one in given], watched.said
        options["noise"] = watched.noise(noise)
        options["free"], candidates = watched.effects(options["free"]), watched.effects(candidates)
        validation = None if validation is None else watched.record(validation)
    records = spread_lines(live)
    # fit of the model as it is, without any effect
    with steps.step("model as it is"):
        base = base_fit(model, records, **options)
    # checks of the record, for the warnings
    with steps.step("what is odd"):
        odd = looks(seen, given, horizon) if records[0].in_time else ()
    asked = options | {"candidates": None if candidates is None else tuple(candidates), "matters": matters}
    case = Case(base, records, candidates, asked, significance, steps, effort)
    if not most:
        return Investigation(Diagnosis("unexplained", **case.about), case, model, validation)
    found = by_smaller_motion(_ask_twice(case, validation, most), case, model)
    if free_all and found.floated is not None:  # they are no verdict then, but what was asked for
        found = replace(found, verdict="adequate", base=found.floated, floated=None)
    said = about_noise(base.physical_model, records, live)
    # warnings and notes go with the diagnosis
    found = replace(found, checks=odd, records=tuple(live), notes=(*added, *silent, *found.notes, *said))
    return Investigation(found, case, model, validation)


_WHOLE = 1.3  # rms error of the whole free run over that of the windows, within which no window is needed


def _ask_twice(case: Case, validation: Measurement | None, most: int) -> Diagnosis:
    """Return the diagnosis of a case, or of the same records seen otherwise.

    If nothing is named, there is an offset at each channel: nonlinear effects depend on the zero of a signal,
    linear models do not.

    If nothing is missing in windows of an integrating model, whole free runs count, where they are as good:
    the free initial state of each window takes up what accumulates, a wrong gain among it.
    """
    found, settings, records = ask(case, validation, most), case.settings, list(case.records)
    again, base = settings, case.base
    # nothing named: try again with an offset at each channel
    if found.verdict == "unexplained":
        base = with_offsets(base, records, case.options)
    # adequate in windows: try again with free runs over the whole record
    elif found.verdict == "adequate" and settings["horizon"] is None and case.cut:
        longest = {"horizon": max(record.n_samples * record.dt for record in records)}
        again = settings | longest
        base = base_fit(base.physical_model, records, free=settings["free"], **case.options | longest)
    if base is case.base:
        return found
    other = Case(base, records, settings["candidates"], again, case.significance, case.progress, case.effort)
    second = ask(other, validation, most)
    best = second.best.refinement if second.best is not None else second.floated or second.base
    worse = again is not settings and np.any(best.rmse > _WHOLE * found.base.rmse)
    # the second answer unless it is none, or its free run is much worse
    return found if second.verdict == "unexplained" or worse else second


_LISTED = 20  # rows of a ranking
_SETTLED = 10.0  # log evidence below the answer, within which coefficients get the substeps that they need
_MATTERS = 0.2  # share of `Levels.off`: a smaller change may only compensate a wrong force law


def ask(case: Case, validation: Measurement | None, most: int) -> Diagnosis:
    """Diagnose a case.

    Parameters
    ----------
    case : Case
        Fitted model, records and candidate effects.
    validation : Measurement or None
        Validation data for the fits of the ranking.
    most : int
        Maximum number of effects of a set.

    Returns
    -------
    Diagnosis
    """
    # records without motion allow no answer
    still = case.in_time and (no_motion(case.ordered) or not_excited(case.base, case.records))
    if still:  # nothing moves in the records
        about = case.about | {"ambiguous": tuple(case.library), "notes": (still,)}
        return Diagnosis("ambiguous", **about)
    # search over sets of effects, re-estimated parameters and nuisances
    search = Search(case, most).run()
    agreements: dict[Trial, tuple[float, str]] = {}

    def passed(trial: Trial) -> bool:
        """Return whether a trial may be named.

        The residual must pass its tests. Without effects, colored noise must not explain most of the record.
        With effects, the free run must not become worse, re-estimated parameters must differ from nominal,
        and records of different amplitude must agree on the coefficients.
        """
        if not search.passed(trial):
            return False
        if not trial.effects:
            return not is_drowned(trial.tested, case.levels)
        off = not trial.hypothesis.floated or parameters_off(trial, case.levels)
        missed = [100.0 - np.mean(one.model.refinement.fit) for one in (trial, search.trials[0])]
        farther = not trial.hypothesis.ratio and missed[0] > (1.0 + case.levels.spoiled) * missed[1]
        if farther or not off:  # a missing effect does not increase the error of the free run
            return False
        if (len(case.records) > 1 or (case.in_time and not case.cut)) and trial not in agreements:
            agreements[trial] = amplitude_test(trial.model, len(trial.effects), case.levels)
        return agreements.get(trial, (1.0, ""))[0] >= case.levels.disagree

    # hypotheses with equal effects form one row; the answer from their probabilities
    rows = table(search)
    found = answer(search, rows, passed)
    if found.verdict == "unexplained":
        found = close_enough(search, rows, found)
    said = [sentence for _, sentence in [agreements.get(found.trial, (1.0, ""))] if sentence]
    # coefficients of the answer and its alternatives, with enough substeps
    if found.verdict in ("effect", "ambiguous"):
        near = [row for row in rows if row.effects and row.value > found.row.value - _SETTLED]
        answered, *settled = search.settled([found.trial, *(row.trials[0] for row in near)])
        found = found._replace(trial=answered)
        for row, trial in zip(near, settled, strict=True):
            row.trials[0] = trial
    return _told(search, rows, found, said, validation)


def parameters_off(trial: Trial, levels: Levels) -> bool:
    """Return whether a re-estimated parameter differs clearly from nominal.

    The change must be significant and larger than 1 % of the initial value (default levels). The gain of a
    channel among the effects also counts. Smaller changes may only compensate a wrong force law, for example
    a cubic spring in place of a sine; that effect is not named. A parameter that is zero has no size to
    compare with, and does not count.
    """
    rows, least = [r for r in determined(trial.model.refinement) if r.initial], _MATTERS * levels.off
    moved = (abs(r.coefficient) > max(levels.moved * r.std, least * abs(r.initial)) for r in rows)
    return any(map(is_gain, trial.effects)) or any(moved)


def _told(
    search: Search, rows: Sequence[TableRow], found: Answer, said: list[str], validation: Measurement | None
) -> Diagnosis:
    """Return the answer as a diagnosis."""
    case, trial, word = search.case, found.trial, found.verdict
    # process noise, tests and error shares of the answer
    own, ratio = search.tests(trial), trial.hypothesis.ratio
    shares = () if ratio else error_shares(trial.tested, own, case.significance)
    left = "" if word == "unexplained" and own else left_to_noise(trial.tested, case.levels)
    about = case.about | {"force_ratio": ratio, "error_shares": shares, "left_to_noise": left}
    if word != "unexplained" and np.isnan(found.probability):  # it fails the tests, by too little to matter
        about["adequate_to"] = max(one.model for one in shares)
    outcome = _Outcome(search, rows, found, about, [*about_hold(trial, search), *said], validation)
    if word == "adequate":
        return outcome.adequate()
    about |= {"tests": search.tests(search.trials[0]), "winner_tests": own}
    holds = frozenset(one for one in trial.hypothesis.nuisances if isinstance(one, Hold))
    if holds:
        about["base"] = search.base(holds).refinement
    if word == "parameters":
        return outcome.parameters()
    return outcome.unexplained() if word == "unexplained" else outcome.effects()


class _Outcome(NamedTuple):
    """An answer, and what it rests on, with one diagnosis for each verdict.

    Attributes
    ----------
    search, rows, found, validation
        Search, its table, the answer, and validation data.
    about : dict
        Fields of the diagnosis so far.
    notes : list of str
        Notes so far.
    """

    search: Search
    rows: Sequence[TableRow]
    found: Answer
    about: dict[str, Any]
    notes: list[str]
    validation: Measurement | None

    def diagnosis(self, **more: Any) -> Diagnosis:
        """Return the diagnosis with some fields more."""
        return Diagnosis(self.found.verdict, **self.about | {"notes": tuple(self.notes)} | more)

    def adequate(self) -> Diagnosis:
        """Return that nothing is missing, with what the record would have shown."""
        case, trial = self.search.case, self.found.trial
        tests, held = self.search.tests(trial), trial.hypothesis
        scored = candidate_columns(trial.model, case.library, case.motions[0], (held.ratio,))
        shown = detectable(trial.tested, scored, len(tests), case.significance, case.levels)
        if held.nuisances and not held.ratio:
            self.about["base"] = trial.model.refinement
        return self.diagnosis(tests=tests, detectable=shown)

    def parameters(self) -> Diagnosis:
        """Return that parameters are wrong, with their fit under priors."""
        self.notes.extend(_against(self.rows, self.found))
        return self.diagnosis(floated=with_fitting_priors(self.search.case, self.found.trial))

    def effects(self) -> Diagnosis:
        """Return the effects that are missing, one set or several that tie."""
        trial = self.found.trial
        if trial.hypothesis.floated:
            self.about["base"] = trial.base.refinement
            self.notes.append(_beside_parameters(trial, self.found.verdict))
        listed = _listed(self.search, self.rows, self.found, self.about["base"])
        return self.with_ranking(listed, [self.found.row, *self.found.ties])

    def unexplained(self) -> Diagnosis:
        """Return that no candidate explains the record, with free forces."""
        search, case, trial, about = self.search, self.search.case, self.found.trial, self.about
        law = None
        if case.settings["candidates"] is None:
            self.notes.append(not_tried(case.base.physical_model, case.library, case.ordered))
        self.notes.append(search.not_afforded)
        # estimate the force at each place as a free curve
        if case.in_time:
            with case.progress.step("free forces"):
                law, base = open_force(search)
            about["base"] = base.refinement
        if trial.hypothesis.floated and about["base"] is trial.base.refinement:
            self.notes.append(_beside_parameters(trial, "unexplained"))
        # the candidate with the best free run, and whether it is close enough
        listed = _listed(search, self.rows, self.found, about["base"])
        first = listed[0]
        if not first.hypothesis.ratio:
            shares = error_shares(first.tested, search.tests(first), case.significance)
            about["error_shares"] = shares
            if shares and not matter(shares, case.levels.matters) and search.determined(first):
                about["adequate_to"] = max(one.model for one in shares)
        return self.with_ranking(listed, (), law)

    def with_ranking(
        self, listed: Sequence[Trial], tied: Sequence[TableRow], law: FreeForces | None = None
    ) -> Diagnosis:
        """Return the diagnosis with the answer and the other candidates."""
        search, rows, found, case = self.search, self.rows, self.found, self.search.case
        sets, names = [set(row.effects) for row in tied], {frozenset(row.effects): row.same for row in rows}
        shown = [
            Listed(trial, share, set(trial.effects) in sets, names.get(frozenset(trial.effects), ()))
            for trial, share in zip(listed, _shares(rows, found, listed), strict=True)
        ]
        ranked = ranking(shown, search.trials[0].total, case, self.validation)
        # effects that the data cannot distinguish, that of the answer first
        named = [e for row in ranked if row.alike for one in (row, *row.same) for e in one.effects]
        others = [e for e in named if e not in found.trial.effects]
        self.notes.extend([*remarks(found.trial.model, found.trial.effects), *_denied(search, found.trial)])
        return self.diagnosis(
            notes=tuple(filter(None, self.notes)),
            ranking=ranked,
            ambiguous=tuple(dict.fromkeys([ranked[0].effect, *others])),
            none_of_these=found.none,
            places=_places(rows, found, law, case.in_time),
            open_law=None if law is None else law.law,
        )


def _beside_parameters(trial: Trial, word: str) -> str:
    """Return the note on parameters re-estimated together with the effects."""
    base = trial.base.refinement
    before, after = (percent(fit) for fit in (base.initial_fit, base.fit))
    said = "Neither effects alone nor parameters alone explain the record, so both are estimated."
    if word == "unexplained":
        return f"{said} The parameters alone increase the fit from {before} to {after}."
    return f"{said} {numbers_that_moved(determined(trial.model.refinement))}"


def _denied(search: Search, trial: Trial) -> list[str]:
    """Return the reason why a more probable set is not named, or no note."""
    first = search.ranked()[0]
    if search.determined(first) or search.posterior(first) < search.posterior(trial) + search.price:
        return []
    names, rows = " with ".join(e.label for e in first.effects), []
    if search.spare(first):
        return [
            f"{names} would fit better, but it is not named: a black box without the states that it adds "
            "reaches the same error."
        ]
    for effect in first.effects:
        rows += undetermined(first.model.refinement, effect, search.case.levels)
    values = ", ".join(with_error(row.coefficient, row.std) for row in rows)
    why = "the data do not determine it" if first.possible else "its value must be positive"
    return [f"{names} would fit better, but it is not named: {why} ({values})."]


def _against(rows: Sequence[TableRow], found: Answer) -> list[str]:
    """Return the note on the best set of effects for the verdict "parameters".

    Empty if the verdict has at least the probability `Levels.named`.
    """
    if found.probability >= levels().named:
        return []
    first = next(row for row in rows if row.effects)
    share = float(np.exp(first.value - log_sum(rows)))
    names = " with ".join(effect.label for effect in first.effects)
    return [f"The probability of that is {found.probability:.2f}; {names} has {share:.2f}."]


def _listed(search: Search, rows: Sequence[TableRow], found: Answer, base: Refinement) -> list[Trial]:
    """Return the trials of the ranking, at most `_LISTED`.

    The order is: the answer, the rows of the table, and then single effects that are not determined. For the
    verdict "unexplained" only the most probable trial and those of the base are listed, by their fit in free
    run. The evidence would not do there: a noise filter fitted to model errors makes them cheap.
    """
    known = {frozenset[Effect](), *(frozenset(one.effects) for row in rows for one in row.same)}
    singles = (trial for trial in search.ranked() if len(trial.effects) == 1)
    trials = [found.trial, *(row.trials[0] for row in rows), *singles]
    trials = [trial for trial in trials if frozenset(trial.effects) not in known]
    if found.verdict == "unexplained":
        best = search.best  # a set beside re-estimated parameters may be the best that is known
        here = [trial for trial in trials if trial.base.refinement is base or trial is best]
        trials = [search.fitter.in_free_run(trial) for trial in dict.fromkeys(here or trials)]
        trials.sort(key=lambda trial: -float(np.mean(trial.model.refinement.fit)))
    first: dict[frozenset[Effect], Trial] = {}
    for trial in trials:
        first.setdefault(frozenset(trial.effects), trial)
    return list(first.values())[:_LISTED]


def _shares(rows: Sequence[TableRow], found: Answer, listed: Sequence[Trial]) -> list[float]:
    """Return the probability of each listed set.

    The answer includes its special cases. All are NaN for the verdict "unexplained".
    """
    if found.verdict == "unexplained":
        return [np.nan] * len(listed)
    total = log_sum(rows)
    of_set = {
        frozenset(row.effects): float(np.exp(row.value - total)) * (1.0 - found.none)
        for row in rows
        if row.effects and row not in found.inside
    }
    of_set[frozenset(found.row.effects)] = found.probability
    return [of_set.get(frozenset(trial.effects), 0.0) for trial in listed]


def _places(rows: Sequence[TableRow], found: Answer, free: Any, in_time: bool) -> dict[str, float]:
    """Return the probability of each place, the most probable first.

    Empty for an unexplained frequency response. The rest of the probability belongs to unknown places.
    """
    if found.verdict == "unexplained" and not in_time:  # effects that fail do not locate the force
        return {}
    logs = [(e.place, row.value) for row in rows for e in row.effects]
    if free is not None:
        logs = list(free.log_likelihoods.items())
        left = np.clip(free.left, 1e-12, 1.0 - 1e-12)  # the unexplained share is at an unknown place
        known = np.logaddexp.reduce([value for _, value in logs])
        logs.append(("", float(known + np.log(left) - np.log1p(-left))))
    total = float(np.logaddexp.reduce([value for _, value in logs])) if logs else 0.0
    shares: dict[str, float] = {}
    for place, value in logs:
        shares[place] = shares.get(place, 0.0) + float(np.exp(value - total))
    shares.pop("", None)
    return dict(sorted(shares.items(), key=lambda item: -item[1]))
