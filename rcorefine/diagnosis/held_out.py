"""Models of an improvement, and their errors on held-out data."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from ..comparison.compare import compare
from ..data.channels import match_channels, record_for
from ..effects.effect import Effect
from ..engine.amplitude_response import engine_on
from ..exceptions import DivergenceError, ExcitationWarning, unheard
from ..inference.levels import levels
from ..inference.refinement import Refinement
from ..inference.whitening import Whitener
from ..models.controller import completed
from ..models.operating_point import ordered_record
from ..progress import Progress
from ..refinement.refine import refit
from ..systems.linear import Array
from .case import Parts, not_held
from .error_shares import ErrorShare, error_shares_of, matter
from .result import Step
from .verdict import estimates, undetermined


@dataclass(eq=False)
class HeldOutPath:
    """Steps from the initial model to the improved one.

    Attributes
    ----------
    parts : Parts
        Three parts of the records.
    settings : dict
        tolerance, offset, noise and horizon as in `refine`.
    matters : float
        Share of the spread of an output below which an error of the model does not matter.
    progress : Progress
        Progress display.
    steps : list of Step
        Steps so far.
    found : float
        Share of the innovations' power that the residual tests of the last model find.
    """

    parts: Parts
    settings: dict[str, Any]
    matters: float
    progress: Progress
    steps: list[Step] = field(default_factory=list)
    found: float = 0.0

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
        rows = {} if effect is None else estimates(model, effect)
        values = {name: float(row.coefficient) for name, row in rows.items()}
        std = {name: float(row.std) for name, row in rows.items()}
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
        return np.asarray(np.sqrt(np.mean(np.concatenate(found, axis=1) ** 2, axis=1)))

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

    def close(self, model: Refinement, *parts: Sequence[Any]) -> bool:
        """Return whether the error of a model does not matter on some parts."""
        left = [one for part in parts for one in self.errors_on(part, model)]
        return bool(left) and not matter(left, self.matters)

    @property
    def is_close(self) -> bool:
        """True if the error of the last model does not matter on any part."""
        return self.close(self.steps[-1].refinement, self.parts.learn, self.parts.judge)

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
            if last <= first and not loose(self.steps[-1].refinement, held):
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
