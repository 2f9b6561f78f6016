"""Tasks for one record, and the row that results."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from ..data.measurement import Measurement
from ..diagnosis.diagnose import diagnose
from ..diagnosis.improve import improve
from ..effects.effect import Effect
from ..inference.refinement import EstimatedParameter, Refinement
from ..localization.localize import localize_damage
from ..refinement.refine import refine
from .row import Estimate

__all__ = ["TASKS", "Found", "estimate_again"]


@dataclass(frozen=True, slots=True)
class Found:
    """The answer of one record; the fields are those of `SurveyRow`."""

    verdict: str
    leading: tuple[str | None, str | None] = (None, None)
    probability: float | None = None
    estimates: tuple[Estimate, ...] = ()
    effects: tuple[Effect, ...] = ()
    sentences: tuple[str, ...] = ()
    shown: tuple[Estimate, ...] = ()  # of the leading effect, where it does not enter the comparison

    def fields(self) -> dict[str, Any]:
        """Fields of the row."""
        mine = [e for e in (*self.estimates, *self.shown) if (e.kind, e.place) == self.leading]
        first = mine[0] if mine else None
        return {
            "verdict": self.verdict,
            "effect": self.leading[0],
            "place": self.leading[1],
            "coefficient": None if first is None else first.value,
            "std": None if first is None else first.std,
            "unit": "" if first is None else first.unit,
            "probability": self.probability,
            "estimates": self.estimates,
            "effects": self.effects,
            "sentences": self.sentences,
        }


def _diagnosed(model: Any, data: Measurement, options: Mapping[str, Any]) -> Found:
    """Return the result of a diagnosis.

    It holds the best effect if that stands alone, or the parameters of the model if these explain the record.
    """
    found = diagnose(model, data, **options)
    best, said = found.best, tuple(found.sentences())
    if found.verdict == "parameters":
        assert found.floated is not None
        return Found(found.verdict, estimates=_estimates(found.floated.parameters, "linear"), sentences=said)
    if best is None or found.verdict == "unexplained":
        return Found(found.verdict, (None, found.place), sentences=said)
    leading = (best.effect.kind, best.effect.place)
    rows = _estimates(best.refinement.parameters, "effect", [(e.kind, e.place) for e in best.effects])
    alone = found.verdict == "effect"
    return Found(
        found.verdict, leading, _finite(best.probability), rows if alone else (),
        best.effects if alone else (), said, () if alone else rows,
    )  # fmt: skip


def _improved(model: Any, data: Measurement, options: Mapping[str, Any]) -> Found:
    """The effects of the last model, the surest first."""
    improvement = improve(model, data, **options)
    wanted = [(e.kind, e.place) for e in improvement.effects]
    rows = _estimates(improvement.refinement.parameters, "effect", wanted)
    said = (*improvement.sentences(),)
    return Found(improvement.verdict, _surest(rows), None, rows, improvement.effects, said)


def _localized(model: Any, data: Measurement, options: Mapping[str, Any]) -> Found:
    """Every place, all estimated together, whether it is named or not."""
    found = localize_damage(model, data, **options)
    rows = tuple(
        Estimate(row.kind, row.place, row.name, row.joint, row.joint_std, row.unit)
        for row in found.rows
        if _usable(row.joint, row.joint_std)
    )
    named = found.named
    leading = (named[0].kind, named[0].place) if named else (None, None)
    verdict = ("changed" if named else "unchanged") if found.explained else "unexplained"
    return Found(verdict, leading, None, rows, found.effects, (found.message,))


def _refined(model: Any, data: Measurement, options: Mapping[str, Any]) -> Found:
    """Return the effects and parameters that `refine` fitted."""
    found = refine(model, data, **options)
    wanted = {(e.kind, e.place) for e in found.effects}
    rows = _estimates(found.parameters, "effect", wanted) + _estimates(found.parameters, "linear")
    effects = tuple(e for e, role in zip(found.effects, found.roles, strict=True) if role == "effect")
    verdict = "fitted" if found.success else "doubtful"
    return Found(verdict, _surest(rows), None, rows, effects, (found.message, *found.warnings))


#: What a survey can ask of every record.
TASKS: dict[str, Callable[[Any, Measurement, Mapping[str, Any]], Found]] = {
    "diagnose": _diagnosed,
    "improve": _improved,
    "localize": _localized,
    "refine": _refined,
}

_OF_FIT = ("tolerance", "offset", "noise", "horizon", "free")  # options of `refine` among those of a task


def estimate_again(
    model: Any, data: Measurement, effects: Sequence[Effect], options: Mapping[str, Any], floats: bool
) -> tuple[Estimate, ...]:
    """Return the coefficients of given effects for one record.

    The record may need these effects or not.

    Parameters
    ----------
    model, data
        As in `refine`.
    effects : sequence of Effect
        All that the fleet has.
    options : mapping
        Of the task; those of the fit are kept.
    floats : bool
        Whether the numbers of this model were found to be off, and float along.

    Returns
    -------
    tuple of Estimate
        Empty where the fit came to no end that means anything.
    """
    held = {(e.kind, e.place) for e in getattr(model, "effects", ())}
    settings = {name: options[name] for name in _OF_FIT if name in options}
    settings |= {"free": "linear"} if floats else {}
    found: Refinement = refine(model, data, [e for e in effects if (e.kind, e.place) not in held], **settings)
    wanted = {(e.kind, e.place) for e in effects}
    return _estimates(found.parameters, "effect", wanted) if found.success else ()


def _estimates(rows: Sequence[EstimatedParameter], role: str, wanted: Any = None) -> tuple[Estimate, ...]:
    """Return the coefficients of one role that the record determines.

    If `wanted` is given, only the coefficients of its effects are returned.
    """
    return tuple(
        Estimate(row.kind, row.place, row.name, float(row.coefficient), float(row.std), row.unit)
        for row in rows
        if row.role == role
        and (wanted is None or (row.kind, row.place) in wanted)
        and _usable(row.coefficient, row.std)
    )


def _usable(value: float, std: float) -> bool:
    return math.isfinite(value) and math.isfinite(std) and std > 0


def _surest(rows: Sequence[Estimate]) -> tuple[str | None, str | None]:
    best = max(rows, key=lambda e: abs(e.value) / e.std, default=None)
    return (None, None) if best is None else (best.kind, best.place)


def _finite(value: float) -> float | None:
    return float(value) if math.isfinite(value) else None
