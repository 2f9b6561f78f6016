"""Models on held-out data.

They are the steps of an improvement, or fits to the large motion of a decay that its smaller motion judges.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from ..comparison.compare import compare
from ..data.channels import match_channels, record_for
from ..data.records import at_rest
from ..data.signals import over_time
from ..effects.effect import Effect
from ..engine.amplitude_response import engine_on
from ..exceptions import DataError, DivergenceError, ExcitationWarning, unheard
from ..inference.levels import levels
from ..inference.refinement import Refinement
from ..inference.whitening import Whitener
from ..models.controller import completed
from ..models.operating_point import ordered_record
from ..refinement.refine import base_fit, refit
from ..systems.linear import Array
from .case import Case, Parts, common_horizon, not_held, split_in_parts
from .hypothesis import Trial
from .noise import ErrorShare, error_shares_of, found_share, matter
from .nuisances import about_hold, with_offsets
from .result import Diagnosis, RankedEffect, Step
from .search import Search
from .verdict import close_models, sizes_of, special, table, undetermined


class HeldOutPath:
    """Steps from the initial model to the improved one.

    Parameters
    ----------
    parts : Parts
        Three parts of the records.
    case : Case
        Case of the whole records.

    Attributes
    ----------
    settings : dict
        tolerance, offset, noise and horizon as in `refine`, one horizon for all parts.
    said : list of str
        What is said of this horizon.
    matters : float
        Share of the spread of an output below which an error of the model does not matter.
    steps : list of Step
        Steps so far.
    found : float
        Share of the innovations' power that the residual tests of the last model find.
    """

    def __init__(self, parts: Parts, case: Case) -> None:
        self.parts, self.matters, self.progress = parts, case.levels.matters, case.progress
        horizon, self.said = common_horizon(case.base.physical_model, case.ordered, case.settings["horizon"])
        self.settings = case.options | {"horizon": horizon}
        self.steps, self.found = list[Step](), 0.0

    @property
    def last(self) -> Refinement:
        """Model of the last step."""
        return self.steps[-1].refinement

    def follow(
        self,
        start: Refinement,
        parameters: Refinement | None,
        last: Refinement,
        effects: Sequence[Effect],
        verdict: str,
        ties: Mapping[Effect, Sequence[Effect]],
    ) -> None:
        """Record the steps from the initial model to the last one.

        Parameters
        ----------
        start : Refinement
            Initial model.
        parameters : Refinement or None
            Model with re-estimated parameters and without effects, if it is a step.
        last : Refinement
            Model with all effects.
        effects : sequence of Effect
            Its effects that are steps. The first step is the one without which the error is largest.
        verdict : str
            Verdict on the last model.
        ties : dict
            Effects that the data cannot distinguish from an effect.
        """
        # initial model, re-estimated parameters, then one effect after the other
        self.add(None, "start", self.settled(start), verdict)
        if parameters is not None:
            self.add(None, "parameters", self.settled(parameters), verdict)
        if not effects:
            return
        whole, order = self.settled(last), list(effects)
        # order: the effect whose removal increases the error most comes first
        if len(order) > 1:
            lost = {effect: mean_log(self._without(whole, [effect]).rmse) for effect in order}
            order.sort(key=lambda effect: -lost[effect])
        for k, effect in enumerate(order, 1):
            model = self._without(whole, order[k:]) if order[k:] else whole
            self.add(effect, "add", model, "effect", ties.get(effect, ()))

    def add(
        self,
        effect: Effect | None,
        action: str,
        model: Refinement,
        verdict: str,
        ties: Sequence[Effect] = (),
    ) -> None:
        """Append a step with its errors and coefficients."""
        # errors on the three parts, and coefficients of the added effect
        values, std = ({}, {}) if effect is None else sizes_of(model, effect)
        train = self._errors(model, self.parts.fit) if model.of_responses else model.rmse.copy()
        choice, judged = (self._errors(model, part) for part in (self.parts.choose, self.parts.judge))
        other = () if effect is None else tuple(not_held(ties, [effect]))
        self.steps.append(Step(effect, action, train, choice, judged, values, std, verdict, other, model))

    def settled(self, refinement: Refinement) -> Refinement:
        """Refit a model on the first two parts; keep it as it is if that diverges."""
        with self.progress.step("last fits"):
            learned = refit(refinement, self.parts.learn, elsewhere=False, **self.settings)
        return learned if np.isfinite(self.log_error(learned)) else refinement

    def _without(self, model: Refinement, effects: Iterable[Effect]) -> Refinement:
        """Return a model without some of its effects, refitted."""
        for effect in effects:
            model = refit(model, self.parts.learn, without=effect, elsewhere=False, **self.settings)
        return model

    # ------------------------------------------------------------------ errors
    def log_error(self, refinement: Refinement) -> float:
        """Return the log free-run error on the second part, mean over outputs."""
        return mean_log(self._errors(refinement, self.parts.choose))

    def _errors(self, refinement: Refinement, records: Sequence[Any]) -> Array:
        """Return the root mean square error (n_y,) of the free run.

        The windows are those of `compare`. Infinite if the model diverges.
        """
        found = []
        # free-run residuals of all records, joined
        for record in records:
            try:
                found.append(_left(refinement, record, self.settings["horizon"]))
            except DivergenceError:
                return np.full(refinement.physical_model.linear.n_outputs, np.inf)
        return np.asarray(np.sqrt(over_time(np.mean, np.concatenate(found, axis=1) ** 2)))

    def errors_on(self, records: Sequence[Any], model: Refinement) -> tuple[ErrorShare, ...]:
        """Return the shares of the spread that a model leaves on a part."""
        labels = model.physical_model.linear.output_labels
        if not records[0].in_time:
            return ()
        try:
            left = [_left(model, record, self.settings["horizon"]) for record in records]
        except DivergenceError:
            return tuple(ErrorShare(label, np.inf, np.inf, 0.0) for label in labels)
        # innovations of the residual separate noise from model error
        innovations = Whitener.fit(left, floor=1e-150).scales
        every = [*self.parts.learn, *self.parts.judge]
        outputs = [ordered_record(model.physical_model, record).outputs for record in every]
        return error_shares_of(labels, left, outputs, innovations, self.found)

    @property
    def is_close(self) -> bool:
        """True if the error of the last model does not matter on any part."""
        parts = (self.parts.learn, self.parts.judge)
        left = [one for part in parts for one in self.errors_on(part, self.last)]
        return bool(left) and not matter(left, self.matters)

    # ------------------------------------------------------------------ taking steps back
    def cut(self) -> None:
        """Remove last steps that decrease the second-part error too little."""
        # log error on the second part plus a price per coefficient; its minimum ends the path
        costs = [
            mean_log(step.choice_rmse)
            + levels().earned * sum(len(s.coefficients) for s in self.steps[: k + 1])
            for k, step in enumerate(self.steps)
        ]
        self.steps = self.steps[: int(np.argmin(costs)) + 1]

    def back(self) -> list[str]:
        """Remove last steps that fail on the held-out data; return their names.

        A step is removed if the third part has a larger error than at the start, or if the data do not
        determine an effect.
        """
        back: list[str] = []
        while len(self.steps) > 1:
            # the third part has not been used by fit or choice
            first, last = (mean_log(s.validation_rmse) for s in (self.steps[0], self.steps[-1]))
            held = [step.effect for step in self.steps if step.effect is not None]
            if last <= first and not loose(self.last, held):
                break
            back.insert(0, self.steps.pop().name)
        return back


def loose(model: Refinement, effects: Sequence[Effect]) -> bool:
    """Return whether the data leave an effect of a model undetermined.

    Parameters
    ----------
    model : Refinement
        Model that holds the effects.
    effects : sequence of Effect
        Effects.
    """
    return any(undetermined(model, effect, levels()) for effect in effects)


def mean_log(errors: Array) -> float:
    """Return the mean of the logarithms over the outputs.

    Parameters
    ----------
    errors : ndarray, shape (n_y,)
        Errors; zero counts as 1e-300.
    """
    return float(np.mean(np.log(errors + 1e-300)))


def _left(refinement: Refinement, record: Any, horizon: float | None) -> Array:
    """Return the residual (n_y, N) of a model on a record.

    That of a frequency response is taken at its points, in units of their noise.
    """
    # frequency responses at their points, records as in `compare`
    if not record.in_time:
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


_DECAY = 4  # effects that are added to a decay


def by_smaller_motion(found: Diagnosis, case: Case, model: Any) -> Diagnosis:
    """Return the diagnosis of decays by what holds for smaller motion, too.

    What only imitates a law where the motion is large fails where it is small. A decay offers both: effects
    are fitted to its first part, chosen on the next one and judged on the last. The diagnosis is returned as
    it is if no set of named effects leaves too little to matter.

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
    path = HeldOutPath(parts, case)
    # search on the first part, with the largest motion
    start, part = case_of_part(case, model, parts.fit, path.settings)
    search = Search(part, _DECAY).run()
    # choose on the smaller one
    close = sorted(close_models(search), key=lambda trial: path.log_error(trial.model.refinement))
    if not close or not close[0].effects or any(e.spec.needs_law for e in close[0].effects):
        return found
    chosen = close[0]
    path.found = found_share(chosen.tested, search.tests(chosen), case.significance)
    # judge on the smallest
    tied = _tied_effects(chosen, search)
    path.follow(start, None, chosen.model.refinement, chosen.effects, "effect", tied)
    if path.back() or not path.is_close:
        return found
    return _renamed(found, chosen, tied, path, search)


def _renamed(
    found: Diagnosis, chosen: Trial, tied: dict[Effect, list[Effect]], path: HeldOutPath, search: Search
) -> Diagnosis:
    """Return a diagnosis that names a set chosen on the smaller motion."""
    # errors on the last part, and the ranking with the chosen set first
    left, (first, *beside) = path.errors_on(path.parts.judge, path.last), chosen.effects
    p_value = next((row.p_value for row in found.ranking if row.effect == first), np.nan)
    figures = float(np.mean(found.base.fit)), float(np.mean(path.last.fit)), p_value, np.nan, np.nan
    own = RankedEffect(first, *sizes_of(path.last, first), *figures, path.last, tuple(beside), alike=True)
    alike = tuple(one for effect, others in tied.items() if others for one in (effect, *others))
    said = "The effects were fitted to the first part of each decay and chosen on the next, smaller one."
    rest = (replace(row, alike=False, probability=np.nan) for row in found.ranking)
    return replace(
        found, verdict="ambiguous" if alike else "effect", ranking=(own, *rest), open_law=None,
        ambiguous=alike, winner_tests=search.tests(chosen), error_shares=left, none_of_these=np.nan,
        adequate_to=max(one.model for one in left), notes=(said, *about_hold(chosen, search)),
    )  # fmt: skip


def case_of_part(
    case: Case, model: Any, records: Sequence[Any], settings: dict[str, Any]
) -> tuple[Refinement, Case]:
    """Return the initial model on a part of the records, and its case.

    Parameters
    ----------
    case : Case
        Case of the whole records.
    model : StateSpace, PhysicalModel or Refinement
        Initial model.
    records : sequence of Measurement
        Part of the records.
    settings : dict
        tolerance, offset, noise and horizon.

    Returns
    -------
    start : Refinement
    part : Case
        With offsets at all channels.
    """
    # the initial model fitted to this part, with its own offsets
    start = base_fit(model, records, free=case.settings["free"], **settings)
    asked = settings | {"free": (), "matters": case.levels.matters}
    library = not_held(case.library, start.effects)
    base = with_offsets(start, records, settings)
    return start, Case(base, records, library, asked, case.significance, case.progress, case.effort)


def _tied_effects(chosen: Trial, search: Search) -> dict[Effect, list[Effect]]:
    """Return the effects that the first part cannot distinguish from each one."""
    near = search.posterior(chosen) - 0.5 * search.case.levels.rival
    # a law that contains it is no other explanation
    others = (
        row.effects
        for row in table(search)
        if row.value > near and not special(chosen.effects, row.effects)
        if all(set(trial.effects) != set(chosen.effects) for trial in row.same)
    )
    return exchanged(chosen.effects, others)


def exchanged(own: Sequence[Effect], others: Iterable[Sequence[Effect]]) -> dict[Effect, list[Effect]]:
    """Return for each effect of a set those in its place in other sets.

    The other sets differ from the set in one effect.
    """
    ties: dict[Effect, list[Effect]] = {effect: [] for effect in own}
    for other in others:
        gone, new = set(own) - set(other), set(other) - set(own)
        if len(gone) == len(new) == 1:
            ties[gone.pop()].append(new.pop())
    return ties
