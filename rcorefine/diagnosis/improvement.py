"""Result of `improve`: its steps in figures, words and one picture."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Unpack

import control as ct

from ..effects.effect import Effect
from ..inference.refinement import Refinement
from ..results import Options, ReportedModel, Row, picture, show
from ..systems.linear import Array
from ..words import with_error
from .checks.row import CheckRow

__all__ = ["Improvement", "Step"]


@dataclass(frozen=True, slots=True, eq=False)
class Step(Row):
    """One step of the improvement.

    Attributes
    ----------
    effect : Effect or None
        What was added (None for the start, and where the model's own numbers were fitted).
    action : str
        "start", "parameters" (the numbers of the model float from here on), "add", "pair" (added
        together with the row before), "swap", "drop".
    train_rmse, choice_rmse, validation_rmse : ndarray, shape (n_y,)
        Root mean square error of the free run on the part that was fitted, on the part
        on which the step was chosen, and on the held-out data.
    coefficients, std : dict
        Of the effect, after all effects of this step were fitted together.
    verdict : str
        Verdict of the diagnosis that led to this step; for the last one see
        `Improvement.verdict`.
    rivals : tuple of Effect
        Effects that explained the same alike.
    refinement : Refinement
        Model after this step.
    """

    effect: Effect | None
    action: str
    train_rmse: Array
    choice_rmse: Array
    validation_rmse: Array
    coefficients: dict[str, float]
    std: dict[str, float]
    verdict: str
    rivals: tuple[Effect, ...]
    refinement: Refinement

    @property
    def name(self) -> str:
        """Action of the step, in words."""
        if self.effect is None:
            return "initial model" if self.action == "start" else self.action
        return f"{self.action} {self.effect.label}"


@dataclass(frozen=True, slots=True, eq=False)
class Improvement(ReportedModel):
    """Steps from the initial model to the improved one.

    Attributes
    ----------
    steps : tuple of Step
        The start, then one row per effect that earned its place.
    verdict : str
        Verdict on the last model: "adequate", or why the improvement ends.
    message : str
        Why it ended, in words.
    output_labels, output_units : tuple of str
        Names and units of the outputs, units "" where unknown.
    notes : tuple of str
        What was noticed about the record: its parts, its hold.
    checks : tuple of CheckRow
        What `check` finds odd about the records, or the first model beside them.
    """

    steps: tuple[Step, ...]
    verdict: str
    message: str
    output_labels: tuple[str, ...]
    output_units: tuple[str, ...]
    notes: tuple[str, ...] = ()
    checks: tuple[CheckRow, ...] = ()

    @property
    def refinement(self) -> Refinement:
        """Model after the last step.

        Its `hold` is the one that was found to suit the inputs.
        """
        return self.steps[-1].refinement

    @property
    def effects(self) -> tuple[Effect, ...]:
        """Effects in the last model that were asked for."""
        last = self.refinement
        return tuple(e for e, role in zip(last.effects, last.roles, strict=True) if role == "effect")

    def sentences(self) -> list[str]:
        """Return the steps and the outcome, one sentence each.

        Returns
        -------
        list of str
        """
        first, last = self.steps[0], self.steps[-1]
        lines = []
        for i, label in enumerate(self.output_labels):
            before, after = first.validation_rmse[i], last.validation_rmse[i]
            unit = f" {self.output_units[i]}" if self.output_units[i] else ""
            fell = f" -> {after:.4g}{unit} ({100 * (after / before - 1):+.0f} %)" if before > 0 else unit
            error = f"{before:.4g}{fell if len(self.steps) > 1 else unit}"
            lines.append(f"Error of {label} on held-out data: {error}.")
        for i, step in enumerate(self.steps):
            if step.effect is not None and step.rivals and step.action != "drop":
                others = ", ".join(effect.label for effect in step.rivals)
                lines.append(f"Step {i}: the data cannot distinguish {step.effect.label} from {others}.")
        lines.append(self.message)
        return [*lines, *self._estimates(), *self.notes]

    def _estimates(self) -> list[str]:
        """Return a sentence on the estimates of the last model.

        The list is empty where the table holds all of them.
        """
        rows = [row for row in self.refinement.parameters if row.role != "offset"]
        if len(rows) < 2 and not any(row.role == "linear" for row in rows):
            return []
        told = [f"{r.name} at {r.place} {r.initial:g} -> {with_error(r.value, r.std, r.unit)}" for r in rows]
        return [f"Estimates of the last model, initial -> value +/- std: {'; '.join(told)}."]

    @picture
    def plot(self, **options: Unpack[Options]) -> ct.ControlPlot:
        """The staircase of held-out error, the effect's name on each step.

        Parameters
        ----------
        ax : Axes, optional
            Where to draw.
        label : str, optional
            Label of the held-out line.
        legend_loc : str or False, optional
            Place of the legend, by default "upper right"; False for none.

        Returns
        -------
        ControlPlot
        """
        return show(self, "plot", **options)
