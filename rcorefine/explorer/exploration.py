"""State of an exploration: model, record, added effects, undo."""

from __future__ import annotations

from dataclasses import dataclass
from os import PathLike
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from rcorefine import (
    Check,
    Comparison,
    Diagnosis,
    Effect,
    Measurement,
    Refinement,
    check,
    compare,
    diagnose,
    refine,
)

from ..arguments import Array, as_choice, as_instance, as_number, printable
from ..exceptions import ModelError
from ..refinement.by_hand import Addition, ByHand, values_of

if TYPE_CHECKING:
    from ..comparison.failure_map.search import Failure
    from ..comparison.failure_map.state import ResidualForce

_REACH = 3.0  # of its present size that a coefficient is moved to
_STEPS = 20  # of the best share, in which candidates are ordered


@dataclass(frozen=True, slots=True, eq=False)
class ExplorationStep:
    """One step of an exploration.

    Attributes
    ----------
    action : str
        "start", "add", "move" (a coefficient was set by hand) or "fit".
    name : str
        The same in words.
    effects : tuple of Effect
        Those added so far; what was set by hand is in `Effect.fixed`.
    refinement : Refinement
        The model with them.
    runs : ndarray, shape (n_y, N)
        Its free run.
    fit : ndarray, shape (n_y,)
        In percent, as in `Refinement.fit`.
    """

    action: str
    name: str
    effects: tuple[Effect, ...]
    refinement: Refinement
    runs: Array
    fit: Array

    @property
    def error(self) -> float:
        """Mean of 100 minus the fit over the outputs, in percent.

        It is the part of the outputs that the model does not explain.
        """
        return 100.0 - float(np.nanmean(self.fit))


class Exploration:
    """A model beside a record, to which effects are added by hand.

    Each change is a step, and `undo` takes the last one back. The constant offset of the record and the
    initial state are estimated from the start, as `refine` does.

    Parameters
    ----------
    model : StateSpace, PhysicalModel or Refinement
        Initial model, continuous time.
    data : Measurement
        Record.
    horizon : float, optional
        Length in s of the free runs, as in `refine`.

    Raises
    ------
    control.ControlArgument
        If the data are no record in time.
    DivergenceError
        If the free run of the model leaves all bounds.

    Examples
    --------
    >>> from rcorefine.explorer import Exploration
    >>> model = rco.mass_spring_damper([1.0], [0.4], [100.0], sensors="displacement")
    >>> true = rco.mass_spring_damper([1.0], [0.4], [90.0], sensors="displacement")
    >>> force = np.random.default_rng(0).standard_normal(600)
    >>> y = rco.simulate(true, rco.Measurement(force, np.zeros(600), dt=0.02), "zero").outputs
    >>> tried = Exploration(model, rco.Measurement(force, y, dt=0.02))
    >>> tried.add(rco.Effect("stiffness", "link1"), stiffness=-5.0).error < tried.steps[0].error
    True
    >>> round(tried.fit().refinement.parameter("stiffness").value, 3)
    90.0
    """

    def __init__(self, model: Any, data: Measurement, *, horizon: float | None = None) -> None:
        self._by_hand = ByHand(model, data, horizon)
        self.data, self.horizon = data, horizon
        self.model, self.physical = self._by_hand.model, self._by_hand.physical
        #: the record in the order of the model's channels, above its operating point
        self.record, self.note = self._by_hand.record, self._by_hand.note
        self._steps: list[ExplorationStep] = []
        self._step("start", "initial model", (), self._by_hand.start())
        self._compared: tuple[ExplorationStep, Comparison] | None = None

    # ------------------------------------------------------------------ where it stands
    @property
    def steps(self) -> tuple[ExplorationStep, ...]:
        """All steps that count, the initial model first."""
        return tuple(self._steps)

    @property
    def refinement(self) -> Refinement:
        """The present model, which `compare`, `refine` and the others take."""
        return self._steps[-1].refinement

    @property
    def effects(self) -> tuple[Effect, ...]:
        """Effects added so far."""
        return self._steps[-1].effects

    @property
    def error(self) -> float:
        """Part of the record that the present model misses, in percent."""
        return self._steps[-1].error

    @property
    def comparison(self) -> Comparison:
        """Comparison of the present model with the record, as by `compare`.

        Its `failures` list where the model fails.
        """
        now = self._steps[-1]
        if self._compared is None or self._compared[0] is not now:
            self._compared = now, compare(now.refinement, self.data, horizon=self.horizon)
        return self._compared[1]

    def coefficients(self, effect: Effect) -> dict[str, float]:
        """Present values of an added effect, in the model's units."""
        if as_instance(effect, Effect, "effect").key not in [each.key for each in self.effects]:
            known = ", ".join(each.label for each in self.effects) or "none"
            raise ModelError(f"{effect.label} was not added; there are {known}")
        return values_of(self.refinement, self._keys().index(effect.key))

    def units(self, effect: Effect) -> dict[str, str]:
        """Unit of each coefficient of an effect, "" where unknown."""
        ranges = self._by_hand.ranges(as_instance(effect, Effect, "effect"))
        return {name: unit for name, (*_, unit) in ranges.items()}

    def reach(self, effect: Effect, name: str) -> tuple[float, float]:
        """Return the range in which it is useful to vary a coefficient.

        The range depends on the present value and stays inside the bounds.
        """
        ranges = self._by_hand.ranges(as_instance(effect, Effect, "effect"))
        lower, upper, natural, _ = ranges[as_choice(name, "name", ranges)]
        size = abs(self.coefficients(effect)[name]) or natural
        return max(lower, -_REACH * size), min(upper, _REACH * size)

    # ------------------------------------------------------------------ what could be missing
    def force(self, row: Failure | None = None) -> ResidualForce | None:
        """Return the force that the present model lacks at a failure.

        The failure is a row of its failure map. By default, and where the row has no place, the force is that
        at the place that explains most of the record. It is None for a row at an input or an output, and for
        a model without places.
        """
        return self._by_hand.force(self.comparison, row)

    def candidates(self, row: Failure | None = None, force: ResidualForce | None = None) -> list[Addition]:
        """Return the effects that could explain a row of the failure map.

        Effects that the model already holds are left out. By default, all others are returned. With `force`,
        their force laws are fitted to it, and those that explain most come first.
        """
        found = self._by_hand.candidates(self.refinement.effects, row, force)
        best = max((one.share for one in found if one.share > 0), default=1.0)

        def rank(one: Addition) -> tuple[int, int]:  # of those that explain about the same, the simplest
            share = -1 if one.curve is None else round(_STEPS * max(one.share, 0.0) / best)
            return -share, len(one.coefficients)

        return sorted(found, key=rank)

    # ------------------------------------------------------------------ what can be done
    def add(self, effect: Effect, **values: float) -> ExplorationStep:
        """Add an effect with coefficients set by hand.

        Coefficients that are left out get the value at which the effect is absent, or a small one.

        Raises
        ------
        ModelError
            If the model holds it already, or it does not fit.
        DivergenceError
            If the model leaves all bounds with it; nothing has changed then.
        """
        if as_instance(effect, Effect, "effect").key in self._keys():
            raise ModelError(f"the model holds {effect.label} already; move its coefficient")
        first = self._by_hand.addition(effect).coefficients
        model = self._by_hand.settled(self.refinement, effect, first | _checked(effect, values))
        return self._step("add", f"add {effect.label}", (*self.effects, effect), model)

    def move(self, effect: Effect, **values: float) -> ExplorationStep:
        """Set coefficients of an added effect by hand.

        The offset and the initial state are estimated again.
        Moves of one effect after the other are one step. Raises as `add`.
        """
        held = self.coefficients(effect) | _checked(effect, values)
        model = self._by_hand.settled(self.refinement, effect, held)
        step = self._step("move", f"move {effect.label}", self.effects, model)
        if self._steps[-2].name == step.name:
            del self._steps[-2]
        return step

    def preview(self, effect: Effect, **values: float) -> tuple[Array, float]:
        """Return the free run and its error with coefficients changed.

        The run has shape (n_y, N), the error is in percent. The call is fast enough to follow a slider.
        Nothing is changed. Offset and initial state are estimated as for the linear part of the model; `move`
        does it for the whole. Raises as `add`.
        """
        held = self.coefficients(effect) | _checked(effect, values)
        runs, fit = self._by_hand.preview(self.refinement, effect, held)
        return runs, 100.0 - float(np.nanmean(fit))

    def fit(self) -> ExplorationStep:
        """Estimate all added effects together.

        The result is that of ``refine(model, data, effects)``.
        """
        found = refine(self.model, self.data, self.effects, horizon=self.horizon)
        return self._step("fit", "fit", self.effects, found)

    def undo(self) -> ExplorationStep:
        """Undo the last step and return the one before.

        The initial model always remains.
        """
        if len(self._steps) > 1:
            del self._steps[-1]
        return self._steps[-1]

    # ------------------------------------------------------------------ what is asked of it
    def diagnose(self) -> Diagnosis:
        """Verdict on the present model: whether anything is still missing."""
        return diagnose(self.refinement, self.data, horizon=self.horizon)

    def check(self) -> Check:
        """Check the record, and the initial model beside it."""
        return check(self.model, self.data)

    def script(self) -> str:
        """Return a Python program that reproduces the present model.

        Coefficients set by hand are held; the others are fitted.
        """
        return self.refinement.script(self.data, horizon=self.horizon)

    def report(self, path: str | PathLike[str], *, overwrite: bool = False) -> Path:
        """Write the report of the present model beside the record.

        It contains the steps and the script.
        Raises as `Refinement.report`.
        """
        steps = [f"# {printable(step.name)}: error {step.error:.3g} %" for step in self._steps]
        title, code = f"Exploration of {self.physical.name}", "\n".join(["# the steps by hand", *steps])
        return self.refinement.report(path, data=self.data, title=title, code=code, overwrite=overwrite)

    # ------------------------------------------------------------------ how it is done
    def _keys(self) -> list[str]:
        return [effect.key for effect in self.refinement.effects]

    def _step(
        self, action: str, name: str, effects: tuple[Effect, ...], model: Refinement
    ) -> ExplorationStep:
        step = ExplorationStep(action, name, effects, model, self._by_hand.run(model), model.fit)
        self._steps.append(step)
        return step


def _checked(effect: Effect, values: dict[str, float]) -> dict[str, float]:
    """Return coefficients of an effect that were given by hand."""
    for name in values:
        if name not in effect.coefficients:
            raise ModelError(f"{effect.label} has no {name}, only {', '.join(effect.coefficients)}")
    return {name: as_number(value, name) for name, value in values.items()}
