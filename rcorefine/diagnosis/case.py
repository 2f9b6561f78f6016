"""What a diagnosis is asked: a fitted model, its records, and the candidates."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import control as ct
import numpy as np

from ..data.measurement import Measurement
from ..effects.effect import Effect
from ..effects.law import KINDS
from ..exceptions import DataError
from ..inference.fitted import FittedModel, fitted_from
from ..inference.levels import Levels, levels
from ..inference.refinement import Refinement
from ..inference.starts import Motion
from ..inference.whitening import FTest
from ..inference.windows import windows
from ..models.library import effect_library
from ..models.operating_point import ordered_record
from ..models.physical_model import PhysicalModel
from ..progress import Progress
from .holds import best_hold
from .verdict import passes

__all__ = ["OBSERVERS", "Case", "candidates_of", "not_held"]

OBSERVERS = (1.0, 0.1)  # a high gain follows the record, a low one tells candidates apart
_SHORTEST = 200  # samples of a record that can be tested


@dataclass(eq=False)
class Case:
    """A fitted model that is asked what it lacks.

    Attributes
    ----------
    base : Refinement
        The model at its minimum.
    records : tuple of Measurement
        What it was fitted to.
    settings : dict
        Options of fitting, as in `diagnose`.
    significance : float
        Level of the tests.
    progress : Progress
        What does the steps and counts them.
    thorough : bool
        Whether to try harder where no candidate passes, and pairs of them.
    fitted : FittedModel
        The model on the free runs that are tested.
    motions : list of Motion
        Estimated motion on each of them.
    library : list of Effect
        Candidates that the model does not hold.
    levels : Levels
        Of the decisions.
    """

    base: Refinement
    records: tuple[Measurement, ...]
    settings: dict[str, Any]
    significance: float
    progress: Progress
    thorough: bool
    ordered: list[Measurement]
    fitted: FittedModel
    motions: list[Motion]
    library: list[Effect]
    levels: Levels = field(default_factory=levels)

    @classmethod
    def prepare(
        cls,
        base: Refinement,
        records: Sequence[Measurement],
        asked: Sequence[Effect] | None,
        settings: dict[str, Any],
        significance: float,
        progress: Progress,
        thorough: bool,
    ) -> Case:
        """A case from a model that was fitted to the records already.

        Raises
        ------
        DataError
            If a record is too short to test.
        ControlArgument
            If no candidate is left that the model does not hold.
        """
        physical = base.physical_model
        ordered = [ordered_record(physical, r) for r in records]
        for record in ordered:
            if record.n_samples < _SHORTEST:
                raise DataError(
                    f"record {record.name!r} of {record.n_samples} samples is too short to test; "
                    f"give at least {_SHORTEST}"
                )
        segments, _ = windows(physical, ordered, settings["horizon"])
        fitted = fitted_from(base, segments, tolerance=settings["tolerance"], noise=settings["noise"])
        motions = [Motion(fitted.structure, fitted.theta, record) for record in segments]
        if len(records) > 1:
            motions[0].companions = motions[1:]
        library = not_held(candidates_of(physical) if asked is None else asked, base.effects)
        if not library:
            raise ct.ControlArgument("no candidate is left that the model does not hold already")
        given = (tuple(records), settings, significance, progress, thorough)
        return cls(base, *given, ordered, fitted, motions, library)

    @property
    def about(self) -> dict[str, Any]:
        """What every diagnosis of this case carries."""
        return {
            "base": self.base,
            "records": self.records,
            "significance": self.significance,
            "settings": self.settings,
        }

    @cached_property
    def hold(self) -> tuple[str, str]:
        """The hold that suits the records, and a sentence where it is not the declared one."""
        with self.progress.step("holds"):
            return best_hold(self.base, self.ordered, self.options)

    @property
    def options(self) -> dict[str, Any]:
        """Options of fitting other than what floats."""
        return {name: self.settings[name] for name in ("tolerance", "offset", "noise", "horizon")}

    def excess(self, fitted: FittedModel) -> float:
        """Residual over the declared noise, 0 where none was declared."""
        if self.settings["noise"] is None:
            return 0.0
        residual = np.concatenate(fitted.residuals(), axis=1)
        return float(np.sqrt(np.mean(residual**2, axis=1)).max())

    def passes(self, tests: Sequence[FTest], fitted: FittedModel) -> bool:
        """Whether the residual of a model is noise."""
        return passes(tests, self.excess(fitted), self.significance, self.levels)


def candidates_of(physical: PhysicalModel) -> list[Effect]:
    """What could be missing from a model, and what may be wrong with a record as a whole."""
    inputs = physical.linear.input_labels[:1]  # such a fault is the same at all of them
    faults = [Effect(law.name, place) for law in KINDS.values() if law.of_record for place in inputs]
    return [*effect_library(physical), *faults]


def not_held(candidates: Sequence[Effect], held: Sequence[Effect]) -> list[Effect]:
    """Candidates of another kind, or at another place, than what a model holds."""
    names = {(effect.kind, effect.place) for effect in held}
    return [effect for effect in candidates if (effect.kind, effect.place) not in names]
