"""Stepwise improvement of a model by the effects that it lacks."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import control as ct
import numpy as np

from ..arguments import as_number, as_share, as_whole
from ..comparison.compare import compare
from ..data.channels import match_channels, record_for
from ..data.measurement import Measurement
from ..data.records import at_rest
from ..data.response_record import in_frequency
from ..effects.effect import Effect, as_effects
from ..engine.amplitude_response import engine_on
from ..exceptions import (
    DataError,
    DivergenceError,
    ExcitationWarning,
    IdentifiabilityWarning,
    ModelError,
    own_arithmetic,
    unheard,
)
from ..inference.assembly import as_data, check_settings, check_validation
from ..inference.f_tests import FTest
from ..inference.levels import levels
from ..inference.refinement import Refinement
from ..inference.whitening import Whitener
from ..models.controller import Controller, completed
from ..models.conversion import as_physical, under_control
from ..models.operating_point import ordered_record
from ..progress import Progress
from ..refinement.refine import base_fit, refine, refit
from ..systems.linear import Array
from .case import (
    Case,
    Parts,
    candidates_of,
    common_horizon,
    no_motion,
    not_held,
    not_tried,
    seen_in,
    split_in_parts,
    with_recorded_inputs,
)
from .check import looks
from .error_shares import ErrorShare, error_shares_of, found_share, in_percent, matter
from .hypothesis import Trial
from .noise import left_to_noise
from .nuisances import Nuisance, about_hold, with_offsets
from .open_law import open_force
from .result import Diagnosis, Improvement, RankedEffect, Step
from .search import Search
from .verdict import close_models, estimates, special, table, undetermined

_MOST = 4  # effects that a diagnosis adds to a decay
_JUDGED, _SETTLED = 30, 10  # sets compared by the error on the second part; most sets refitted of them


def improve(
    model: Any,
    data: Measurement | Sequence[Measurement],
    *,
    validation: Measurement | None = None,
    max_effects: int = 4,
    candidates: Sequence[Effect] | None = None,
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
) -> Improvement:
    """Find the set of effects that a model lacks, step by step.

    The record is split into three parts in time. The first part has three fifths of the samples, and at least
    200; sets of effects are compared on it as in `diagnose`. The error on the second part, the next fifth,
    decides which set is chosen. The third part is held-out data: the reported validation error comes from it.
    Five records or more are divided as wholes: of five in turn, three belong to the first part, one to the
    second and one to the third.

    Parameters
    ----------
    model : StateSpace, PhysicalModel or Refinement
        Initial model, continuous time.
    data : Measurement or list of Measurement
        Record, or several records of the same system. Or a `FrequencyResponse`, or a list of them. Of each
        five successive frequencies, three belong to the first part, one to the second and one to the third.
        Errors of frequency responses are relative to their noise.
    validation : Measurement or FrequencyResponse, optional
        Validation data; by default a fifth of `data`. With it, `data` is split into two parts only.
    max_effects : int
        Maximum number of effects.
    candidates : sequence of Effect, optional
        Candidate effects, default `effect_library(model)` and the faults of a whole record.
    free, tolerance, offset, noise, horizon
        As in `refine`.
    significance : float
        Significance level of the residual tests, as in `diagnose`.
    matters : float, optional
        Share of the spread of an output, default .01 (``rcorefine.matters``). An error of the model below it,
        or below the rounding step of the sensor, does not matter even if a test finds it.
    effort : float
        Number of refits of each search, in units of 120, as in `diagnose`.
    controller : Controller, StateSpace or TransferFunction, optional
        As in `refine`: the controller that was active during the measurement.
    executor : concurrent.futures.Executor or dask.distributed.Client, optional
        Executor that refits candidates in parallel.
    progress : bool, optional
        Whether to show steps and remaining time on standard error. By default in a terminal and in a
        notebook.

    Returns
    -------
    Improvement
        Steps, improved model, and pictures.

    Raises
    ------
    DataError
        If the record is too short to split, or if it shows no motion.

    Notes
    -----
    Choice: sets of up to `max_effects` effects are compared as in `diagnose`. No effect is added if the model
    passes the residual tests and no set is ``1 / significance`` times as probable. Otherwise the function
    chooses the most probable set that passes, within odds of 100:1 of the best. A set is excluded if it
    increases the free-run error on the second part by 2 % or more. If the residual of the choice is noise,
    the likely sets are compared again on the first two parts together.

    If no set passes, the set with the least error on the first two parts is chosen (mean of the logarithms).
    It must decrease this error by more than 5 % per coefficient.

    Significance: the data must determine every effect. Its size must be more than 3 standard deviations
    (``rcorefine.moved``) from zero. The same holds for essential coefficients, and for shaping coefficients
    with a finite lower bound. Friction and losses must be positive. If parameters of the model are wrong,
    they are re-estimated together with the effects.

    Steps: each step shows how much its effect decreases the error. The first step is the effect without which
    the other effects give the largest error. The last steps are removed while the error on the third part
    exceeds that of the start. They are also removed while the data do not determine an effect. If no set
    passes, the last step is the unknown force at a place, tabulated (`Diagnosis.law`). This step needs a 5 %
    smaller error on the second part.

    For a model that integrates, the free runs of all parts have one length, that of `compare` on the whole
    record.

    Examples
    --------
    >>> import numpy as np, rcorefine as rco
    >>> model = rco.mass_spring_damper([1.0], [0.4], [100.0], sensors="displacement")
    >>> true = rco.mass_spring_damper([1.0], [0.4], [80.0], sensors="displacement")
    >>> rng = np.random.default_rng(0)
    >>> force = 10 * rng.standard_normal(3000)
    >>> y = rco.simulate(true, rco.Measurement(force, np.zeros(3000), dt=0.02), "zero").outputs[0]
    >>> data = rco.Measurement(force, y + 0.03 * y.std() * rng.standard_normal(3000), dt=0.02)
    >>> laws = [rco.Effect(kind, "link1") for kind in ("stiffness", "damping", "cubic_stiffness")]
    >>> found = rco.improve(model, data, candidates=laws)
    >>> [step.effect.kind for step in found.steps[1:]], found.verdict
    (['stiffness'], 'adequate')
    """
    max_effects = as_whole(max_effects, "max_effects")
    significance = as_share(significance, "significance")
    effort = as_number(effort, "effort", least=0.0)
    matters = levels().matters if matters is None else as_number(matters, "matters", least=0.0)
    records = as_data(data, horizon=horizon, noise=noise, controller=controller)
    model, added = under_control(model, controller, data), tuple[str, ...]()
    if candidates is None:
        model, added = with_recorded_inputs(model, [*records, *([] if validation is None else [validation])])
    physical = as_physical(model)
    check_settings(physical, free=free, tolerance=tolerance, offset=offset, noise=noise, horizon=horizon)
    library = candidates_of(physical) if candidates is None else as_effects(candidates, "candidates")
    if validation is not None:
        check_validation(model, validation)
    parts = split_in_parts(records, validation)
    ordered = [ordered_record(physical, record) for record in records]
    horizon, cut = common_horizon(physical, ordered, horizon)
    settings: dict[str, Any] = {"tolerance": tolerance, "offset": offset, "noise": noise, "horizon": horizon}
    in_time = not in_frequency(parts.fit)
    library = seen_in(physical, library, ordered, candidates is not None)
    with own_arithmetic(), unheard(IdentifiabilityWarning), Progress(progress, executor) as bar:
        with bar.step("the model as it is"):
            start = base_fit(model, parts.fit, free=free, **settings)
            # if all parameters are free, they get priors in the search; the widest is 100 %
            nominal = base_fit(model, parts.fit, free=(), **settings) if isinstance(free, str) else start
        if in_time and (still := no_motion(parts.fit)):  # the fits above have checked the channels
            raise DataError(still)
        odd = looks(model, records, horizon) if in_time else ()
        library = not_held(library, nominal.effects)
        improver = _Improver(start, nominal, parts, settings, library, significance, bar, effort, matters)
        verdict, message, notes = improver.improve(max_effects)
        if verdict == "unexplained" and candidates is None:
            notes += filter(None, [not_tried(physical, library, ordered)])
    outputs = physical.linear.output_labels
    units = tuple(parts.fit[0].output_units) if in_time else ("std",) * len(outputs)
    return Improvement(
        tuple(improver.steps), verdict, message, outputs, units, (*added, *parts.remarks, *notes, *cut), odd,
        improver.errors_on(parts.judge, improver.steps[-1].refinement),
    )  # fmt: skip


@dataclass(eq=False)
class _Improver:
    """Stepwise improvement from the initial model to the chosen set.

    Attributes
    ----------
    start, nominal : Refinement
        Initial model, fitted to the first part with its free parameters, and the model to be improved.
    parts : Parts
        Three parts of the records.
    settings : dict
        tolerance, offset, noise and horizon as in `refine`.
    library : list of Effect
        Candidate effects.
    significance : float
        Significance level of the residual tests.
    progress : Progress
        Progress display, which also runs the tasks.
    effort : float
        Refits that each search may take, times the usual number.
    matters : float
        Share of the spread of an output below which an error of the model does not matter.
    steps : list of Step
        Steps so far.
    tests : tuple of FTest
        Residual tests of the chosen set on the first part.
    found : float
        Share of the innovations' power that they find.
    """

    start: Refinement
    nominal: Refinement
    parts: Parts
    settings: dict[str, Any]
    library: list[Effect]
    significance: float
    progress: Progress
    effort: float = 1.0
    matters: float = 0.01
    steps: list[Step] = field(default_factory=list)
    tests: tuple[FTest, ...] = ()
    found: float = 0.0

    def improve(self, most: int) -> tuple[str, str, list[str]]:
        """Choose a set and record its steps; return verdict, message and notes."""
        if not most or not self.library:
            self._tell([(None, "start", self._settled(self.start))], "")
            why = "Stopped at max_effects = 0" if not most else "No candidate is left"
            return "unexplained", f"{why}; the residual is not noise.", []
        first = Search(self._case(self.nominal, self.parts.fit), most, alone=False).run()
        search, chosen = self._choice(first, most)
        passed = search.passed(chosen)
        self.tests = search.tests(chosen)
        self.found = found_share(chosen.tested, self.tests, self.significance)
        self._tell(self._rungs(chosen, search), "adequate" if passed else "unexplained")
        if not passed:
            self._cut()
        notes = [*self._tie(chosen, search), *about_hold(chosen, search)]
        back = self._back()
        doubtful = self._doubtful(search, chosen) and not self._close()
        law, back = self._with_table(search, back, most) if doubtful else (None, back)
        if passed and (not back or search.passed(search.trials[0])):
            return "adequate", self._ending("adequate", back, len(chosen.effects) >= most, law), notes
        if close := self._close():
            # what imitates a law in one motion is not known to do so in another
            sure = not any(step.effect for step in self.steps) or at_rest(self.parts.judge)
            return "adequate" if sure else "unexplained", close, notes
        notes += filter(None, [search.not_afforded])
        return "unexplained", self._ending("unexplained", back, len(chosen.effects) >= most, law), notes

    def errors_on(self, records: Sequence[Any], model: Refinement) -> tuple[ErrorShare, ...]:
        """Return the errors of a model on one of the parts."""
        labels = model.physical_model.linear.output_labels
        if in_frequency(records):
            return ()
        try:
            left = [_left(model, record, self.settings["horizon"]) for record in records]
        except DivergenceError:
            return tuple(ErrorShare(label, np.inf, np.inf, 0.0) for label in labels)
        innovations = Whitener.fit(left, floor=1e-150).scales
        every = [*self.parts.learn, *self.parts.judge]
        outputs = [ordered_record(model.physical_model, record).outputs for record in every]
        return error_shares_of(labels, left, outputs, innovations, self.found)

    @property
    def is_close(self) -> bool:
        """True if the error of the last model does not matter on any part."""
        return self._all_close(self.steps[-1].refinement, self.parts.learn, self.parts.judge)

    def _close(self) -> str:
        """Return the end if the error of the model is too small to matter."""
        if not self.is_close:
            return ""
        last, parts = self.steps[-1].refinement, (self.parts.learn, self.parts.judge)
        most = max(one.model for part in parts for one in self.errors_on(part, last))
        return (
            f"The residual is not noise, but the model is adequate to {in_percent(most)}: its error "
            f"is less than what matters ({in_percent(self.matters)} of the motion)."
        )

    def _with_table(self, search: Search, back: list[str], most: int) -> tuple[Any, list[str]]:
        """Add the remaining force, tabulated, as a last step if it is kept.

        Returns the step, or None, and the names of all removed steps.
        """
        room = search.case.in_time and sum(step.effect is not None for step in self.steps) < most
        law = self._tabulated(search, self.steps[-1].refinement) if room else None
        if law is None:
            return None, back
        self._tell([law], "unexplained")
        gone = self._back()
        return (None, [*back, *gone]) if gone else (law, back)

    def _case(self, start: Refinement, records: Sequence[Measurement]) -> Case:
        """Return the case of some of the records, with offsets at all channels."""
        given = {**self.settings, "free": (), "matters": self.matters}
        base = with_offsets(start, records, given)
        return Case(base, records, self.library, given, self.significance, self.progress, self.effort)

    # ------------------------------------------------------------------ choosing
    def _choice(self, search: Search, most: int) -> tuple[Search, Trial]:
        """Return the chosen set, and the search that holds it.

        If the error of the model as it is does not matter, nothing is added. Of several sets whose error on
        a decay does not matter, it is the one with the least error on the second part.
        """
        chosen = self._chosen(search)
        if not self._doubtful(search, chosen):
            return self._pooled(search, chosen) if self.parts.whole else (search, chosen)
        close = [t for t in close_models(search) if not t.effects or at_rest(self.parts.choose)]
        close.sort(key=lambda trial: self._log_error(trial.model.refinement))
        if close and self._all_close(close[0].model.refinement, self.parts.choose):
            return search, close[0]
        return self._by_error(search, most)

    def _all_close(self, model: Refinement, *parts: Sequence[Any]) -> bool:
        """Return whether the error of a model does not matter on some parts."""
        left = [one for part in parts for one in self.errors_on(part, model)]
        return bool(left) and not matter(left, self.matters)

    def _pooled(self, search: Search, chosen: Trial) -> tuple[Search, Trial]:
        """Choose among the likely sets again, on the first two parts together.

        This is possible if the residual is noise: then no separate second part is needed. The old choice
        stays if none of the three most probable sets passes.
        """
        learn, excluded = self.parts.learn, 0.5 * search.case.levels.rival
        base = refit(self.nominal, learn, elsewhere=False, **self.settings)
        more = Search(self._case(base, learn), search.most, alone=False)
        for nuisances in dict.fromkeys((frozenset[Nuisance](), chosen.hypothesis.nuisances)):
            more.empty(nuisances)
        least = search.posterior(chosen) - 2.0 * excluded
        likely = [row.trials[0] for row in table(search) if row.effects and row.value > least]
        for trial in dict.fromkeys([chosen, *likely]):
            if trial.effects:
                there = more.base(trial.hypothesis.nuisances)
                start = trial.start.on(there.problem.unpack(there.point)[1])
                more.try_(trial.effects, trial.hypothesis.nuisances, [start])
        more.polish()
        ranked = [t for t in more.ranked() if more.determined(t)]
        best = next((t for t in ranked[:3] if more.passed(t)), None)
        keeps = -float(np.log(self.significance))
        return (search, chosen) if best is None else (more, self._plainer(best, more, keeps))

    @staticmethod
    def _doubtful(search: Search, chosen: Trial) -> bool:
        """Return whether a set fails its tests, or passes them doubtfully.

        Doubtful means that colored noise accounts for much of the error.
        """
        if not search.passed(chosen):
            return True
        return left_to_noise(chosen.tested, search.case.levels) != ""

    def _by_error(self, search: Search, most: int) -> tuple[Search, Trial]:
        """Search for the set of least error under white noise, effect by effect.

        This is the choice if no set passes its tests.
        """
        plain = Search(search.case, most, colored=False, alone=False).run()
        for trial in search.trials:
            if not trial.hypothesis.ratio:
                plain.add(plain.fitter.scored(replace(trial)))
        for _ in range(most):
            before = self._chosen(plain)
            plain.climbed(before)
            if self._chosen(plain) is before:
                break
        return plain, self._chosen(plain)

    def _chosen(self, search: Search) -> Trial:
        """Return the most probable set that passes, else that of least error."""
        levels, nothing = search.case.levels, search.trials[0]
        keeps = -float(np.log(self.significance))
        if search.posterior(search.best) - search.posterior(nothing) < keeps and search.passed(nothing):
            return nothing
        tried = [t for t in search.ranked() if search.determined(t) and not t.hypothesis.ratio][:_JUDGED]
        without = self._log_error(self.start)
        errors = {trial: self._log_error(trial.model.refinement) for trial in tried}
        near = [t for t in tried if search.posterior(t) > search.posterior(tried[0]) - 0.5 * levels.rival]
        passed = [t for t in near if errors[t] < without + levels.spoiled and search.passed(t)][:1]
        if passed:
            return self._plainer(passed[0], search, keeps)
        return self._of_least_error(tried, errors, without) or nothing

    def _of_least_error(
        self, tried: Sequence[Trial], errors: dict[Trial, float], without: float
    ) -> Trial | None:
        """Return the set of least error with effects that the data determine.

        None if no set decreases the error enough for its coefficients.
        """
        cost = {trial: 0.5 * (_log(trial.model.refinement.rmse) + errors[trial]) for trial in tried}
        for trial in tried:
            cost[trial] += levels().earned * sum(len(effect.free) for effect in trial.effects)
        least = 0.5 * (_log(self.start.rmse) + without)
        for trial in sorted(tried, key=cost.__getitem__)[:_SETTLED]:
            if not cost[trial] < least:
                break
            if not _loose(self._settled(_with_spread(trial)), trial.effects):
                return trial
        return None

    def _plainer(self, trial: Trial, search: Search, keeps: float) -> Trial:
        """Return the trial of a special case, or one without nuisances.

        Its effects must be determined. It must be almost as probable and pass, or, of the same effects, have
        almost the same error.
        """
        least = search.posterior(trial) - search.case.levels.family
        simpler = [t for t in search.ranked() if special(t.effects, trial.effects) and search.determined(t)]
        likely = (t for t in simpler if search.posterior(t) > least)
        trial = next(filter(search.passed, likely), trial)
        for other in search.trials:
            if set(other.effects) != set(trial.effects) or other.hypothesis.nuisances:
                continue
            near = search.posterior(other) > search.posterior(trial) - keeps and search.passed(other)
            errors = [self._log_error(one.model.refinement) for one in (other, trial)]
            if search.determined(other) and (near or errors[0] < errors[1] + search.case.levels.spoiled):
                return other
        return trial

    def _log_error(self, refinement: Refinement) -> float:
        """Return the log free-run error on the second part, mean over outputs."""
        return _log(self._errors(refinement, self.parts.choose))

    def _errors(self, refinement: Refinement, records: Sequence[Any]) -> Array:
        """Return the root mean square error (n_y,) of the free run.

        The windows are those of `compare`. Infinite if the model diverges.
        """
        found = []
        for record in records:
            try:
                found.append(_left(refinement, record, self.settings["horizon"]))
            except DivergenceError:
                return np.full(refinement.physical_model.linear.n_outputs, np.inf)
        return np.asarray(np.sqrt(np.mean(np.concatenate(found, axis=1) ** 2, axis=1)))

    # ------------------------------------------------------------------ telling
    def _rungs(self, chosen: Trial, search: Search) -> list[tuple[Effect | None, str, Refinement]]:
        """Return the models of the steps: start, parameters, then each effect."""
        rungs: list[tuple[Effect | None, str, Refinement]] = [(None, "start", self._settled(self.start))]
        held, last = chosen.hypothesis.nuisances, _with_spread(chosen)
        if not chosen.effects:
            return [*rungs, *([(None, "parameters", self._settled(last))] if held else [])]
        if held and self.start is self.nominal:
            rungs.append((None, "parameters", self._settled(search.base(held).refinement)))
        whole = self._settled(last)
        order = list(chosen.effects)
        if len(order) > 1:  # first the effect without which the error is largest
            lost = {e: _log(self._without(whole, [e]).rmse) for e in order}
            order.sort(key=lambda e: -lost[e])
        for k in range(1, len(order)):
            rungs.append((order[k - 1], "add", self._without(whole, order[k:])))
        return [*rungs, (order[-1], "add", whole)]

    def _settled(self, refinement: Refinement) -> Refinement:
        """Refit a model on the first two parts; keep it as it is if that diverges."""
        with self.progress.step("last fits"):
            learned = refit(refinement, self.parts.learn, elsewhere=False, **self.settings)
        return learned if np.isfinite(self._log_error(learned)) else refinement

    def _without(self, model: Refinement, effects: Iterable[Effect]) -> Refinement:
        """Return a model without some of its effects, refitted."""
        for effect in effects:
            model = refit(model, self.parts.learn, without=effect, elsewhere=False, **self.settings)
        return model

    def _tabulated(self, search: Search, last: Refinement) -> tuple[Effect | None, str, Refinement] | None:
        """Return the step of the unknown force, tabulated, or None.

        None if there is no such force, if an effect already acts at its place, or if the table cannot be
        fitted. None also if it decreases the error on the second part by less than 5 % (`Levels.earned`).
        """
        with self.progress.step("free forces"):
            free, _ = open_force(search)
        law = None if free is None else free.law
        held = [e for e in last.effects if law is not None and e.place == law.effect.place]
        roles = dict(zip(last.effects, last.roles, strict=True))
        if law is None or any(roles[e] == "effect" for e in held):
            return None
        try:
            with_table = refine(last, self.parts.learn, [law.effect], **self.settings)
        except (DataError, ModelError):
            return None
        saved = self._log_error(last) - self._log_error(with_table)
        return (law.effect, "add", with_table) if saved >= search.case.levels.earned else None

    def _tell(self, rungs: Iterable[tuple[Effect | None, str, Refinement]], verdict: str) -> None:
        """Append steps with their errors and coefficients."""
        for effect, action, model in rungs:
            rows = {} if effect is None else estimates(model, effect)
            values = {name: float(row.coefficient) for name, row in rows.items()}
            std = {name: float(row.std) for name, row in rows.items()}
            parts = self.parts
            train = self._errors(model, parts.fit) if model.of_responses else model.rmse.copy()
            choice, judged = (self._errors(model, part) for part in (parts.choose, parts.judge))
            said = "effect" if action == "add" else verdict
            self.steps.append(Step(effect, action, train, choice, judged, values, std, said, (), model))

    def _cut(self) -> None:
        """Remove last steps that decrease the second-part error too little."""
        costs = [
            _log(step.choice_rmse) + levels().earned * sum(len(s.coefficients) for s in self.steps[: k + 1])
            for k, step in enumerate(self.steps)
        ]
        self.steps = self.steps[: int(np.argmin(costs)) + 1]

    def _tie(self, chosen: Trial, search: Search) -> list[str]:
        """Set the effects that the data cannot distinguish from that of each step.

        Returns notes on the effects that equal another one together with a constant offset.
        """
        said = []
        near = search.posterior(chosen) - 0.5 * search.case.levels.rival
        ties: dict[Effect, list[Effect]] = {e: [] for e in chosen.effects}
        for row in table(search):
            sets = [set(trial.effects) for trial in (row.trials[0], *row.same)]
            if set(chosen.effects) in sets:
                own, *names = (" + ".join(sorted(e.label for e in one)) for one in sets)
                said += [f"For these inputs and outputs {own} is the same change as {n}." for n in names]
                continue
            if special(chosen.effects, row.effects):  # a law that contains it is no other explanation
                continue
            gone = set(chosen.effects) - set(row.effects)
            new = set(row.effects) - set(chosen.effects)
            if row.value > near and len(gone) == len(new) == 1:
                ties[gone.pop()].append(new.pop())
        for i, step in enumerate(self.steps):
            if step.effect in ties:
                others = _other_name(step)
                rivals = (*not_held(ties[step.effect], others), *others)
                self.steps[i] = replace(step, rivals=tuple(not_held(rivals, [step.effect])))
                said += [
                    f"{step.effect.label} with the constant offset is {other.label} by another name: the "
                    "data cannot distinguish them."
                    for other in others
                ]
        return said

    def _back(self) -> list[str]:
        """Remove last steps that fail on the held-out data; return their names.

        A step is removed if the third part has a larger error than at the start, or if the data do not
        determine an effect.
        """
        back: list[str] = []
        while len(self.steps) > 1:
            first, last = (float(np.mean(np.log(s.validation_rmse))) for s in (self.steps[0], self.steps[-1]))
            held = [step.effect for step in self.steps if step.effect is not None]
            if last <= first and not _loose(self.steps[-1].refinement, held):
                break
            back.insert(0, self.steps.pop().name)
        return back

    def _ending(self, verdict: str, back: list[str], full: bool, law: Any) -> str:
        """Return the reason why the improvement ended."""
        said = "" if law is None or back else f" The force at {law[0].place} is unknown: a table holds it."
        names = ", ".join(back)
        if verdict == "adequate":
            return (
                f"No residual test is significant. Removed, since the held-out error increased: {names}."
                if back
                else "No residual test is significant: this record shows no missing effect."
            )
        if back:
            return (
                f"Removed: {names}. The held-out error was larger than at the start, or the data "
                "do not determine them. The residual is not noise."
            )
        if full:
            return f"Stopped at max_effects = {len(self.steps) - 1}; the residual is not noise.{said}"
        return f"No other set of effects reduces the held-out error enough.{said}"


def by_smaller_motion(found: Diagnosis, case: Case, model: Any) -> Diagnosis:
    """Return the diagnosis of decays by what holds for smaller motion, too.

    What only imitates a law where the motion is large fails where it is small. A decay offers both: effects
    are fitted to its first part, chosen on the next one and judged on the last, as in `improve`. The
    diagnosis is returned as it is if no set of named effects leaves too little to matter.

    Parameters
    ----------
    found : Diagnosis
        Diagnosis; where it names an effect that passes its tests, or needs none, it is returned.
    case : Case
        Records and settings. If inputs move, the diagnosis is returned.
    model : StateSpace, PhysicalModel or Refinement
        Initial model.

    Returns
    -------
    Diagnosis
    """
    inexact = found.verdict == "unexplained" or np.isfinite(found.adequate_to)
    if not (found.ranking and inexact and case.in_time and at_rest(case.ordered)):
        return found
    try:
        parts = split_in_parts(case.records, None)
    except DataError:  # too short for three parts
        return found
    horizon, _ = common_horizon(case.base.physical_model, case.ordered, case.settings["horizon"])
    settings = case.options | {"horizon": horizon}
    start = base_fit(model, parts.fit, free=case.settings["free"], **settings)
    library = not_held(case.library, start.effects)
    about = settings, library, case.significance, case.progress, case.effort, case.levels.matters
    improver = _Improver(start, start, parts, *about)
    _, _, notes = improver.improve(_MOST)
    steps = {step.effect: step for step in improver.steps if step.effect is not None}
    if not steps or not improver.is_close or any(effect.spec.needs_law for effect in steps):
        return found
    return _renamed(found, improver, steps, notes)


def _renamed(
    found: Diagnosis, improver: _Improver, steps: Mapping[Effect, Step], notes: Sequence[str]
) -> Diagnosis:
    """Return a diagnosis that names the effects of an improvement."""
    best = _ranked(list(steps), improver.steps[-1].refinement, found)
    tied = [e for effect, step in steps.items() if step.rivals for e in (effect, *step.rivals)]
    left = improver.errors_on(improver.parts.judge, best.refinement)
    said = "The effects were fitted to the first part of each decay and chosen on the next, smaller one."
    rest = (replace(row, alike=False, probability=np.nan) for row in found.ranking)
    return replace(
        found, verdict="ambiguous" if tied else "effect", ranking=(best, *rest), open_law=None,
        ambiguous=tuple(tied), winner_tests=improver.tests, error_shares=left, none_of_these=np.nan,
        adequate_to=max(one.model for one in left), notes=(said, *notes),
    )  # fmt: skip


def _ranked(effects: Sequence[Effect], model: Refinement, found: Diagnosis) -> RankedEffect:
    """Return effects and the model that holds them as a row of a ranking."""
    first, *beside = effects
    rows = estimates(model, first)
    values = {name: row.coefficient for name, row in rows.items()}
    std = {name: row.std for name, row in rows.items()}
    p_value = next((row.p_value for row in found.ranking if row.effect == first), np.nan)
    figures = float(np.mean(found.base.fit)), float(np.mean(model.fit)), p_value, np.nan, np.nan
    return RankedEffect(first, values, std, *figures, model, tuple(beside), alike=True)


def _log(errors: Array) -> float:
    """Return the log error, mean over the outputs."""
    return float(np.mean(np.log(errors + 1e-300)))


def _loose(model: Refinement, effects: Sequence[Effect]) -> bool:
    """Return whether the data leave an effect of a model undetermined."""
    return any(undetermined(model, effect, levels()) for effect in effects)


def _left(refinement: Refinement, record: Any, horizon: float | None) -> Array:
    """Return the residual (n_y, N) of a model on a record.

    That of a frequency response is taken at its points, in units of their noise.
    """
    if in_frequency([record]):
        structure, theta, _ = refinement.simulation_structure()
        ordered = ordered_record(refinement.physical_model, record)
        run = engine_on(structure, ordered).run(theta, sensitivity=False)
        if run.blew_up >= 0:
            raise DivergenceError("the model runs away")
        return np.asarray(ordered.outputs - run.outputs)
    record = completed(refinement.physical_model, record)
    ordered = record_for(record, match_channels(refinement.physical_model.linear, record))
    with unheard(ExcitationWarning):  # the user did not choose the excitation of a part
        return np.atleast_2d(compare(refinement, ordered, horizon=horizon).residual)


def _with_spread(chosen: Trial) -> Refinement:
    """Return the model of a trial with the most probable parameter priors."""
    model = chosen.model.refinement
    spread = max(chosen.log_evidence, key=lambda s: chosen.log_evidence[s])
    if not chosen.hypothesis.floated or not spread:
        return model
    factor = spread / chosen.hypothesis.spread
    effects = tuple(
        e.replace(prior={n: factor * sd for n, sd in e.prior.items()}) if role == "linear" and e.prior else e
        for e, role in zip(model.effects, model.roles, strict=True)
    )
    return replace(model, effects=effects)


def _other_name(step: Step) -> list[Effect]:
    """Return the effect that a step equals together with a constant offset.

    The list is empty if there is none, or if no offset acts at the same place.
    """
    effect, held = step.effect, step.refinement
    if effect is None or not effect.spec.with_offset:
        return []
    linear = held.physical_model.linear
    act = held.physical_model.port(effect.place).act
    for offset, role in zip(held.effects, held.roles, strict=True):
        if role != "offset":
            continue
        port = next((p for p in held.physical_model.ports if p.name == offset.place), None)
        push = offset.spec.push(linear, offset.place, None if port is None else port.act)
        if push is not None and abs(push @ act) > (1 - 1e-9) * np.linalg.norm(push) * np.linalg.norm(act):
            other = Effect(effect.spec.with_offset, effect.place)
            return not_held([other], held.effects)
    return []
