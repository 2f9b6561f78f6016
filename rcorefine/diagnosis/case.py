"""Inputs of a diagnosis: fitted model, records and candidate effects."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import control as ct
import numpy as np

from ..data.measurement import Measurement
from ..data.records import at_rest
from ..data.response_record import ResponseRecord, in_frequency, noise_is_known
from ..effects.effect import Effect
from ..effects.law import KINDS
from ..engine.line_balance import remembering
from ..engine.response_engine import is_linear
from ..engine.structure import Structure
from ..exceptions import DataError, ModelError
from ..inference.doubts import explains_nothing
from ..inference.f_tests import FTest
from ..inference.fitted import FittedModel, fitted_from
from ..inference.levels import Levels, levels
from ..inference.refinement import Refinement
from ..inference.starts import estimated_motion
from ..inference.windows import windows
from ..models.library import effect_library
from ..models.operating_point import ordered_record
from ..models.physical_model import PhysicalModel
from ..progress import Progress
from .residual_tests import passes

__all__ = ["SHORTEST", "Case", "candidates_of", "no_motion", "not_excited", "not_held", "seen_in"]

_FEW_LEVELS = 3  # distinct values of an output that does not move but for its last digit
_SOLVED = 1e-7  # of a response: its balance of harmonics is solved to 1e-8, which grows near a resonance
SHORTEST, _FEWEST = 200, 60  # samples of a record, and values of a frequency response, that can be tested


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
    fitted : FittedModel
        The model on the free runs that are tested.
    motions : list of Motion or ResponseMotion
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
    ordered: list[Measurement]
    fitted: FittedModel
    motions: list[Any]
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
        least = _FEWEST if in_frequency(ordered) else SHORTEST
        for record in ordered:
            if record.n_samples < least:
                raise DataError(
                    f"record {record.name!r} of {record.n_samples} samples is too short to test; "
                    f"give at least {least}{' (real and imaginary parts count)' if least == _FEWEST else ''}"
                )
        segments, _ = windows(physical, ordered, settings["horizon"])
        fitted = fitted_from(base, segments, tolerance=settings["tolerance"], noise=settings["noise"])
        motions = [estimated_motion(fitted.structure, fitted.theta, record) for record in segments]
        if len(records) > 1:
            motions[0].companions = motions[1:]
        library = candidates_of(physical) if asked is None else asked
        library = seen_in(physical, library, ordered, asked is not None)
        library = not_held(library, base.effects)
        if not library:
            raise ct.ControlArgument("no candidate is left that the model does not hold already; give others")
        given = (tuple(records), settings, significance, progress)
        return cls(base, *given, ordered, fitted, motions, library)

    @property
    def about(self) -> dict[str, Any]:
        """Return the fields that every diagnosis of this case holds."""
        return {
            "base": self.base,
            "records": self.records,
            "significance": self.significance,
            "settings": self.settings,
        }

    @property
    def in_time(self) -> bool:
        """Return whether the records are time series.

        If not, they are frequency responses.
        """
        return self.fitted.problem.in_time

    @property
    def options(self) -> dict[str, Any]:
        """Options of fitting other than what floats."""
        return {name: self.settings[name] for name in ("tolerance", "offset", "noise", "horizon")}

    def excess(self, fitted: FittedModel) -> float:
        """Residual over the declared noise, 0 where none was declared."""
        if self.settings["noise"] is None and not noise_is_known(self.ordered):
            return 0.0
        residual = np.concatenate(fitted.residuals(), axis=1)
        return float(np.sqrt(np.mean(residual**2, axis=1)).max())

    def passes(self, tests: Sequence[FTest], fitted: FittedModel) -> bool:
        """Return whether the residual of a model is noise.

        A residual of frequency responses passes, too, if it is no larger than their numerical error.
        """
        left, records = np.concatenate(fitted.residuals(), axis=1), fitted.problem.records
        whole = fitted.problem.weights[:, None] * np.concatenate([r.outputs for r in records], axis=1)
        if not self.in_time and (np.sum(left**2, axis=1) <= _SOLVED**2 * np.sum(whole**2, axis=1)).all():
            return True
        return passes(tests, self.excess(fitted), self.significance, self.levels)


def candidates_of(physical: PhysicalModel) -> list[Effect]:
    """Return the candidate effects and the possible faults of a record.

    Such a fault concerns a record as a whole.
    """
    inputs = physical.linear.input_labels[:1]  # such a fault is the same at all of them
    faults = [Effect(law.name, place) for law in KINDS.values() if law.of_record for place in inputs]
    return [*effect_library(physical), *faults]


def not_held(candidates: Sequence[Effect], held: Sequence[Effect]) -> list[Effect]:
    """Return the candidates that the model does not contain.

    Candidates are the same if kind and place agree.
    """
    names = {(effect.kind, effect.place) for effect in held}
    return [effect for effect in candidates if (effect.kind, effect.place) not in names]


def seen_in(
    physical: PhysicalModel, candidates: Sequence[Effect], records: Sequence[Any], asked: bool
) -> list[Effect]:
    """Return the candidates that records of this kind show.

    Raises
    ------
    ModelError
        If one was asked for that they cannot show.
    """
    if in_frequency(records):
        return _seen_in_responses(physical, candidates, records, asked)
    if at_rest(records):
        return _seen_at_rest(physical, candidates, asked)
    if asked:
        return list(candidates)
    # a power of a command that changes its sign is a saturation or a dead zone by another name
    inputs = np.concatenate([record.inputs for record in records], axis=1)
    turns = (inputs.min(axis=1) < 0) & (inputs.max(axis=1) > 0)
    turning = {label for label, turn in zip(physical.linear.input_labels, turns, strict=True) if turn}
    return [e for e in candidates if not (e.spec.one_signed and e.place in turning)]


def _seen_in_responses(
    physical: PhysicalModel, candidates: Sequence[Effect], records: Sequence[ResponseRecord], asked: bool
) -> list[Effect]:
    """Return the candidates that a frequency response can show.

    Constants are not among them, and nonlinear effects only if the amplitude is known.

    Raises
    ------
    ModelError
        If one was asked for that it cannot.
    """
    amplitudes = all(record.measured.amplitude is not None for record in records)
    seen = []
    for effect in candidates:
        law = effect.spec
        structure = Structure(physical, [effect])
        linear = is_linear(structure)
        fits = linear or (amplitudes and not remembering(structure))
        if fits and not law.of_record and not (law.holds_constant and linear):
            seen.append(effect)
        elif asked:
            why = "needs the amplitude of the sines (amplitude=)"
            if fits or amplitudes:
                why = "is not seen in a response" if fits else "has memory, and takes records in time"
            raise ModelError(f"{effect.label} {why}; leave it out of candidates")
    return seen


def _seen_at_rest(physical: PhysicalModel, candidates: Sequence[Effect], asked: bool) -> list[Effect]:
    """Return the candidates that a free decay shows.

    Effects of an input need an input that moves. A gain, a lag or a delay of an output cannot be told from
    another initial state.

    Raises
    ------
    ModelError
        If one was asked for that it cannot show.
    """
    inputs = set(physical.linear.input_labels)
    hidden = [
        e
        for e in candidates
        if e.place in inputs or (e.spec.at_channel and (e.spec.linear or e.spec.inner_states))
    ]
    if asked and hidden:
        raise ModelError(
            f"{hidden[0].label} cannot be seen while no input moves; leave it out of candidates, or give a "
            "record in which the inputs move"
        )
    return not_held(candidates, hidden)


def no_motion(records: Sequence[Measurement]) -> str:
    """Return the reason why records without motion allow no diagnosis.

    The string is empty where they show motion.

    Parameters
    ----------
    records : sequence of Measurement
        Records.

    Returns
    -------
    str
    """
    labels = records[0].output_labels
    still = []
    for i, label in enumerate(labels):
        y = np.concatenate([record.outputs[i] for record in records])
        moving = np.abs(np.diff(y)) > 1e-9 * max(float(np.abs(y).max()), 1e-300)
        levels = np.unique(np.round(y / (1e-9 * max(float(np.abs(y).max()), 1e-300)))).size
        if not moving.any() or (levels <= _FEW_LEVELS and moving.mean() < 0.05):
            still.append(label)
    if len(still) < len(labels):
        return ""
    return (
        f"Cannot tell: {', '.join(still)} does not move in this record, so every effect that holds it still "
        "explains it alike. Give a record with motion."
    )


def not_excited(base: Refinement, records: Sequence[Measurement]) -> str:
    """Return a message if nothing was excited, or an empty string.

    It is empty where an input moves or the outputs settle as the model does.

    Parameters
    ----------
    base : Refinement
        The model fitted to the records.
    records : sequence of Measurement
        Records.

    Returns
    -------
    str
    """
    if not at_rest(records):
        return ""
    samples = sum(record.n_samples for record in records)
    if not explains_nothing(base.fit, samples, base.theta.size + base.initial_states.size):
        return ""
    return (
        f"Cannot tell: nothing was excited. {', '.join(records[0].input_labels)} is constant, and the "
        "outputs show no free motion of the model. Give a record in which the inputs move."
    )
