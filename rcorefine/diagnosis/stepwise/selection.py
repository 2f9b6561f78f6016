"""The state of a climb: the present model, what it holds, and the steps that led to it."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from ...comparison.compare import compare
from ...data.channels import match_channels, record_for
from ...data.measurement import Measurement
from ...data.response_record import in_frequency
from ...effects.effect import Effect
from ...engine.response_engine import engine_on
from ...exceptions import DataError, DivergenceError, ExcitationWarning, ModelError, unheard
from ...inference.fitted import fitted_from
from ...inference.levels import levels
from ...inference.refinement import Refinement
from ...inference.windows import windows
from ...models.operating_point import ordered_record
from ...progress import Progress
from ...refinement.refine import refine, refit
from ...systems.linear import Array
from ..case import no_motion, not_held
from ..diagnose import investigate
from ..holds import best_hold
from ..ranking import estimates, undetermined
from ..result import Diagnosis
from ..without_a_law import Answer
from .improvement import Step
from .parts import Parts

__all__ = ["Choice", "Errors", "StepwiseSelection", "coefficients_of", "determined"]


Key = frozenset[tuple[str, str]]


@dataclass(frozen=True, slots=True, eq=False)
class Choice:
    """What a step adds.

    Attributes
    ----------
    effects : tuple of Effect
        One, or a pair.
    refinement : Refinement
        Model with them, fitted to the end.
    on_trust : bool
        Whether they have yet to earn their place on the choosing part.
    ties : tuple of Effect
        What explains the same alike.
    """

    effects: tuple[Effect, ...]
    refinement: Refinement
    on_trust: bool = False
    ties: tuple[Effect, ...] = ()


class Errors:
    """Root mean squares of the free run's residual, in the windows that `compare` chooses.

    Of frequency responses those of the points, over their noise. Every rival is held against the present
    model, and each stage asks again: what a record left of a model is worked out once.

    Parameters
    ----------
    horizon : float or None
        Length of the free runs (s).
    """

    def __init__(self, horizon: float | None) -> None:
        self.horizon = horizon
        # beside it what has these numbers, so that nothing else gets them
        self._known: dict[tuple[int, int], tuple[Array | None, Refinement, Measurement]] = {}

    def __call__(self, refinement: Refinement, records: Sequence[Measurement]) -> Array:
        """Error of a model on records, (n_y,); inf where it diverges."""
        if in_frequency(records):
            return _rms_of_points(refinement, records)
        found = []
        for record in records:
            left = self._left(refinement, record)
            if left is None:
                return np.full(refinement.physical_model.linear.n_outputs, np.inf)
            found.append(left)
        return np.asarray(np.sqrt(np.mean(np.concatenate(found, axis=1) ** 2, axis=1)))

    def _left(self, refinement: Refinement, record: Measurement) -> Array | None:
        """Residual of a record, None where the model diverges."""
        key = id(refinement), id(record)
        if key not in self._known:
            ordered = record_for(record, match_channels(refinement.physical_model.linear, record))
            try:
                with unheard(ExcitationWarning):  # parts are cut here: what they lack is nothing a user chose
                    left = np.atleast_2d(compare(refinement, ordered, horizon=self.horizon).residual)
            except DivergenceError:
                left = None
            self._known[key] = left, refinement, record
        return self._known[key][0]


def _rms_of_points(refinement: Refinement, responses: Sequence[Any]) -> Array:
    structure, theta, _ = refinement.simulation_structure()
    found = []
    for response in responses:
        record = ordered_record(refinement.physical_model, response)
        run = engine_on(structure, record).run(theta, sensitivity=False)
        if run.blew_up >= 0:
            return np.full(structure.n_outputs, np.inf)
        found.append(record.outputs - run.outputs)
    return np.asarray(np.sqrt(np.mean(np.concatenate(found, axis=1) ** 2, axis=1)))


class StepwiseSelection:
    """The present model and the steps that led to it.

    Parameters
    ----------
    model : StateSpace, PhysicalModel or Refinement
        Initial model.
    parts : Parts
        Records.
    free : str or sequence
        As in `refine`.
    settings : dict
        tolerance, offset, noise and horizon as in `refine`.
    significance : float
        Level of the gate.
    progress : Progress
        What does the steps and counts them.

    Raises
    ------
    DataError
        If nothing moves in the records.
    """

    def __init__(
        self,
        model: Any,
        parts: Parts,
        *,
        free: Any,
        settings: dict[str, Any],
        significance: float,
        progress: Progress,
    ) -> None:
        self.parts, self._first, self.free, self.settings = parts, parts, free, settings
        self.significance, self.progress = significance, progress
        self.levels = levels()
        with progress.step("model as it is"):
            start = refine(model, parts.fit, free=free, **settings)
        self.in_time = not in_frequency(parts.fit)
        still = self.in_time and no_motion(parts.fit)
        if still:
            raise DataError(still)
        self.effects: list[Effect] = []
        self.on_trust: list[Effect] = []
        self.by_error = False  # whether a step was taken for its error and not for its likelihood
        self._holds: dict[str | None, str] = {}
        self._visited: set[Key] = {frozenset()}
        self._verdicts: dict[Key, str] = {}
        self._errors = Errors(settings["horizon"])
        self._known: tuple[Refinement, Parts, list[Effect], bool, Answer] | None = None
        self.current = self._held(start)
        self.steps = [self._step(None, "start", "", ())]

    # ------------------------------------------------------------------ looking
    def rest(self, library: Iterable[Effect]) -> list[Effect]:
        """Candidates that the present model does not hold."""
        return not_held(list(library), self.current.effects)

    def is_new(self, effects: Iterable[Effect]) -> bool:
        """Whether a set of effects was never the present one: no set is walked to twice."""
        return _key(effects) not in self._visited

    def investigate(self, model: Refinement, library: list[Effect], *, numbers: bool = False) -> Answer:
        """Diagnosis of a model on the first part: "unexplained" of a trial that cannot be tested.

        With `numbers`, laws are sought beside numbers of the model that are off, too. What was last found
        about the present model is kept: who comes after the climb asks of where it ended.
        """
        if self._known is not None:
            *about, answer = self._known
            if about[0] is model and about[1] is self.parts and about[2:] == [library, numbers]:
                return answer
        answer = self._investigate(model, library, numbers)
        if model is self.current:
            self._known = model, self.parts, library, numbers, answer
        return answer

    def _investigate(self, model: Refinement, library: list[Effect], numbers: bool) -> Answer:
        about: dict[str, Any] = {
            "settings": {"free": self.free, **self.settings},
            "significance": self.significance,
        }
        try:
            return investigate(
                model,
                self.parts.fit,
                asked=library,
                validation=None,
                progress=self.progress,
                thorough=False,
                numbers=numbers,
                **about,
            )
        except ModelError:  # it runs away within one sample, or no observer leads it
            if model is self.steps[0].refinement:  # as it was given
                raise
        about |= {"base": model, "records": tuple(self.parts.fit)}
        return Answer(Diagnosis("unexplained", (), (), (), (), (), force_ratio=0.0, **about))

    def verdict(self, library: Iterable[Effect]) -> str:
        """Verdict on the present set of effects, asked for only where it is not known."""
        rest = self.rest(library)
        if _key(self.effects) not in self._verdicts:
            if not rest:
                return "unexplained"
            self.learn_verdict(self.investigate(self.refit(self.current), rest).found.verdict)
        return self._verdicts[_key(self.effects)]

    def learn_verdict(self, verdict: str) -> None:
        """Keep what was found about the present set of effects."""
        self._verdicts[_key(self.effects)] = verdict

    def log_error(self, refinement: Refinement, *parts: list[Measurement]) -> float:
        """Mean over the outputs of the log error of the free run."""
        records = [record for part in parts for record in part]
        return float(np.mean(np.log(self._errors(refinement, records) + 1e-300)))

    def rise(self, refinement: Refinement, *parts: list[Measurement]) -> float:
        """By how much a model's log error is above that of the present one."""
        return self.log_error(refinement, *parts) - self.log_error(self.current, *parts)

    def share(self, effects: Iterable[Effect], refinement: Refinement) -> float:
        """Log of the error on the choosing part that each coefficient of the effects saves."""
        size = sum(len(coefficients_of(effect, refinement)) for effect in effects)
        return -self.rise(refinement, self.parts.choose) / max(size, 1)

    def gain(self, one: Refinement, two: Refinement) -> float:
        """Log-likelihood of one model over another, under the whitening of the closer one.

        Each under its own whitening would not do: a filter of sixteen coefficients hides a
        missing effect.
        """
        both = []
        for refinement in (one, two):
            segments, _ = windows(refinement.physical_model, self.parts.fit, self.settings["horizon"])
            tolerance = self.settings["tolerance"]
            segments = [ordered_record(refinement.physical_model, record) for record in segments]
            fitted = fitted_from(refinement, segments, tolerance=tolerance, noise=1.0)
            both.append(fitted.residuals())
        closer = min(both, key=lambda blocks: sum(float(np.sum(r**2)) for r in blocks))
        whitener = fitted.problem.whitener(closer)
        first, second = (whitener.apply(blocks) for blocks in both)
        return 0.5 * float(second @ second - first @ first)

    def price(self, choices: int) -> float:
        """Twice the log-likelihood that one coefficient must earn: BIC plus the choice among many."""
        linear = self.current.physical_model
        samples = sum(ordered_record(linear, record).n_samples for record in self.parts.fit)
        return float(np.log(samples) + 2 * np.log(max(choices, 1)))

    # ------------------------------------------------------------------ fitting
    def refit(self, refinement: Refinement) -> Refinement:
        """A model fitted to the end on the first part."""
        return refit(refinement, self.parts.fit, **self.settings)

    def without(self, effect: Effect) -> Refinement:
        """The present model without one of its effects."""
        return refit(self.current, self.parts.fit, without=effect, elsewhere=False, **self.settings)

    def pool(self) -> None:
        """From here on fit on all that does not judge; what passed on less of it is open again."""
        self.parts = self.parts.pooled()
        self.current = self.refit(self.current)
        self._verdicts.clear()
        for i, step in enumerate(self.steps):  # more data may tell apart what was tied
            if step.effect in self.effects and step.rivals:
                asked = [step.effect, *step.rivals]
                alike = self.investigate(self.without(step.effect), asked).found.ambiguous
                if step.effect in alike:
                    self.steps[i] = replace(step, rivals=tuple(e for e in alike if e != step.effect))

    # ------------------------------------------------------------------ moving
    def add(self, choice: Choice, verdict: str) -> None:
        """Take a step up."""
        # a wrong hold looks like a missing effect, and a missing effect like a wrong hold: twice is enough
        first = not self.effects
        self.effects += choice.effects
        self.on_trust += choice.effects if choice.on_trust else ()
        self._now(self._held(choice.refinement) if first else choice.refinement)
        action = "add" if len(choice.effects) == 1 else "pair"
        rivals = tuple(not_held(choice.ties, choice.effects))
        self.steps += [self._step(effect, action, verdict, rivals) for effect in choice.effects]

    def float_numbers(self, floated: Refinement, most: float | None = None) -> bool:
        """Let the numbers of the model float from here on, unless that costs too much where it is chosen.

        It may raise the log error there by `most`; by default what a step on trust may cost.
        """
        settled = self.refit(floated)
        if not self.rise(settled, self.parts.choose) < (self.levels.spoiled if most is None else most):
            return False
        self.current = settled
        self.steps.append(self._step(None, "parameters", "parameters", ()))
        return True

    def take_linear_fit(self) -> bool:
        """Begin anew with every linear parameter re-estimated, where that explains the choosing part better.

        Chance alone hardly makes it likelier there by `Levels.swap`: both are fitted to the first part alone.
        """
        part, choose = self._first.fit, self._first.choose
        try:
            fitted = refine(self.steps[0].refinement, part, free="linear", **self.settings)
        except (DataError, ModelError):  # too few samples for so many parameters, or it runs away
            return False
        own = refit(self.current, part, elsewhere=False, **self.settings)
        size = sum(ordered_record(fitted.physical_model, record).outputs.size for record in choose)
        gained = size * (self.log_error(own, choose) - self.log_error(fitted, choose))
        if "linear" not in fitted.roles or not gained > self.levels.swap:
            return False
        self.effects, self.on_trust, self.by_error = [], [], False
        self._visited, self._verdicts = {frozenset()}, {}
        self.current = self.refit(fitted)
        self.steps = [self.steps[0], self._step(None, "parameters", "parameters", ())]
        return True

    def swap(self, old: Effect, new: Effect, refinement: Refinement, verdict: str) -> None:
        """Put one effect in the place of another; it has yet to earn it."""
        self.effects[self.effects.index(old)] = new
        self.on_trust = [*(e for e in self.on_trust if e is not old), new]
        self._now(refinement)
        self.steps.append(self._step(new, "swap", verdict, (old,)))

    def drop(self, effect: Effect, refinement: Refinement) -> None:
        """Leave an effect out."""
        self.effects = [e for e in self.effects if e is not effect]
        self.on_trust = [e for e in self.on_trust if e is not effect]
        self._now(refinement)
        self.steps.append(self._step(effect, "drop", "", ()))

    def take_back(self) -> None:
        """Undo the last step as if it had not been tried."""
        self.steps.pop()
        self.current = self.steps[-1].refinement
        taken = {(s.effect.kind, s.effect.place): s.effect for s in self.steps if s.effect is not None}
        self.effects = [e for e in taken.values() if (e.kind, e.place) in _key(self.current.effects)]
        self.on_trust = [e for e in self.on_trust if e in self.effects]

    def _now(self, refinement: Refinement) -> None:
        self.current = refinement
        self._visited.add(_key(self.effects))

    def _held(self, refinement: Refinement) -> Refinement:
        """The model under the hold that suits it, and keeps from then on."""
        if not self.in_time:
            return refinement
        with self.progress.step("holds"):
            hold, sentence = best_hold(refinement, self.parts.fit, self.settings)
        if not sentence:
            return refinement
        self._holds[hold] = sentence
        return self.refit(refinement.with_hold(hold))

    # ------------------------------------------------------------------ ending
    def settle(self, last: bool = False) -> None:
        """Fit each model once more, on all that was not kept to judge; of a long record only the last."""
        first = len(self.steps) - 1 if last or not self.parts.whole else 0
        for i in self.progress.over(range(first, len(self.steps)), "last fits"):
            step = self.steps[i]
            refinement = refit(step.refinement, self.parts.learn, elsewhere=False, **self.settings)
            if np.isfinite(self.log_error(refinement, self.parts.choose)):
                self.steps[i] = self._measured(step, refinement)
        self.current = self.steps[-1].refinement

    def is_worse_than_start(self) -> bool:
        """Whether the last model is farther off than the start on the part that took part in nothing."""
        first, last = (float(np.mean(np.log(s.validation_rmse))) for s in (self.steps[0], self.steps[-1]))
        return last > first

    def notes(self) -> list[str]:
        """What was noticed about its parts, and the hold of the last model."""
        hold = self._holds.get(self.current.hold)
        return [*self.parts.remarks, *([hold] if hold else [])]

    def _step(self, effect: Effect | None, action: str, verdict: str, rivals: tuple[Effect, ...]) -> Step:
        nothing = np.zeros(0)
        empty = Step(effect, action, nothing, nothing, nothing, {}, {}, verdict, rivals, self.current)
        return self._measured(empty, self.current)

    def _measured(self, step: Step, refinement: Refinement) -> Step:
        """The step with a model, and the figures of that model."""
        effect = step.effect
        return replace(
            step,
            train_rmse=refinement.rmse.copy() if self.in_time else self._errors(refinement, self.parts.fit),
            choice_rmse=self._errors(refinement, self.parts.choose),
            validation_rmse=self._errors(refinement, self.parts.judge),
            coefficients={} if effect is None else coefficients_of(effect, refinement),
            std={} if effect is None else coefficients_of(effect, refinement, "std"),
            refinement=refinement,
        )


def coefficients_of(effect: Effect, refinement: Refinement, what: str = "coefficient") -> dict[str, float]:
    """Coefficients of an effect in a model, or their standard deviations; none where it was dropped."""
    return {name: float(getattr(row, what)) for name, row in estimates(refinement, effect).items()}


def determined(effects: Iterable[Effect], refinement: Refinement) -> bool:
    """Whether the record determines each of these effects, so that `diagnose` would name it."""
    return not any(undetermined(refinement, effect, levels()) for effect in effects)


def _key(effects: Iterable[Effect]) -> Key:
    return frozenset((effect.kind, effect.place) for effect in effects)
