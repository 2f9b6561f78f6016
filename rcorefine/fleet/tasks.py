"""Tasks for one record, and the row that results."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any

from rcorefine import (
    Effect,
    EstimatedParameter,
    Measurement,
    Refinement,
    diagnose,
    improve,
    localize_damage,
    refine,
)

from .comparison import Estimate

_Leading = tuple[str | None, str | None]  # kind and place of an effect


def _found(
    verdict: str,
    leading: _Leading = (None, None),
    estimates: tuple[Estimate, ...] = (),
    effects: tuple[Effect, ...] = (),
    sentences: Sequence[str] = (),
    probability: float | None = None,
    shown: tuple[Estimate, ...] = (),
) -> dict[str, Any]:
    """Return the fields of a `SurveyRow`.

    `shown` are estimates of the leading effect that do not enter the comparison.
    """
    first = next((e for e in (*estimates, *shown) if (e.kind, e.place) == leading), None)
    return {
        "verdict": verdict,
        "effect": leading[0],
        "place": leading[1],
        "coefficient": None if first is None else first.value,
        "std": None if first is None else first.std,
        "unit": "" if first is None else first.unit,
        "probability": probability,
        "estimates": estimates,
        "effects": effects,
        "sentences": tuple(sentences),
    }


def _diagnosed(model: Any, data: Measurement, options: Mapping[str, Any]) -> dict[str, Any]:
    """Return the result of a diagnosis.

    It holds the best effect if that stands alone, or the parameters of the model if these explain the record.
    """
    found = diagnose(model, data, **options)
    best, said = found.best, found.sentences()
    if found.verdict == "parameters":
        assert found.floated is not None
        return _found(found.verdict, estimates=_estimates(found.floated.parameters, "linear"), sentences=said)
    if best is None or found.verdict == "unexplained":
        return _found(found.verdict, (None, found.place), sentences=said)
    leading = (best.effect.kind, best.effect.place)
    rows = _estimates(best.refinement.parameters, "effect", [(e.kind, e.place) for e in best.effects])
    probability = float(best.probability) if math.isfinite(best.probability) else None
    if found.verdict == "effect":
        return _found(found.verdict, leading, rows, best.effects, said, probability)
    return _found(found.verdict, leading, sentences=said, probability=probability, shown=rows)


def _improved(model: Any, data: Measurement, options: Mapping[str, Any]) -> dict[str, Any]:
    """The effects of the last model, the surest first."""
    found = improve(model, data, **options)
    wanted = [(e.kind, e.place) for e in found.effects]
    rows = _estimates(found.refinement.parameters, "effect", wanted)
    return _found(found.verdict, _surest(rows), rows, found.effects, found.sentences())


def _localized(model: Any, data: Measurement, options: Mapping[str, Any]) -> dict[str, Any]:
    """Every place, all estimated together, whether it is named or not."""
    found = localize_damage(model, data, **options)
    rows = tuple(
        Estimate(row.kind, row.place, row.name, row.joint, row.joint_std, row.unit)
        for row in found.rows
        if _usable(row.joint, row.joint_std)
    )
    leading = (found.named[0].kind, found.named[0].place) if found.named else (None, None)
    verdict = ("changed" if found.named else "unchanged") if found.explained else "unexplained"
    return _found(verdict, leading, rows, found.effects, [found.message])


def _refined(model: Any, data: Measurement, options: Mapping[str, Any]) -> dict[str, Any]:
    """Return the effects and parameters that `refine` fitted."""
    found = refine(model, data, **options)
    wanted = {(e.kind, e.place) for e in found.effects}
    rows = _estimates(found.parameters, "effect", wanted) + _estimates(found.parameters, "linear")
    effects = tuple(e for e, role in zip(found.effects, found.roles, strict=True) if role == "effect")
    verdict = "fitted" if found.success else "doubtful"
    return _found(verdict, _surest(rows), rows, effects, [found.message, *found.warnings])


#: What a survey can ask of every record.
TASKS: dict[str, Callable[[Any, Measurement, Mapping[str, Any]], dict[str, Any]]] = {
    "diagnose": _diagnosed,
    "improve": _improved,
    "localize": _localized,
    "refine": _refined,
}

_OF_FIT = ("tolerance", "offset", "noise", "horizon", "free")  # options of `refine` among those of a task


def estimate_again(
    model: Any, data: Measurement, effects: Sequence[Effect], options: Mapping[str, Any], floats: bool
) -> dict[str, Any]:
    """Return the field of a row with the coefficients of given effects.

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
    dict
        "estimates": empty where the fit came to no end that means anything.
    """
    held = {(e.kind, e.place) for e in getattr(model, "effects", ())}
    settings = {name: options[name] for name in _OF_FIT if name in options}
    settings |= {"free": "linear"} if floats else {}
    found: Refinement = refine(model, data, [e for e in effects if (e.kind, e.place) not in held], **settings)
    wanted = {(e.kind, e.place) for e in effects}
    return {"estimates": _estimates(found.parameters, "effect", wanted) if found.success else ()}


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


def _surest(rows: Sequence[Estimate]) -> _Leading:
    best = max(rows, key=lambda e: abs(e.value) / e.std, default=None)
    return (None, None) if best is None else (best.kind, best.place)
