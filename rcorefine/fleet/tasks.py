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


def _found(
    verdict: str,
    sentences: Sequence[str],
    estimates: tuple[Estimate, ...] = (),
    effects: tuple[Effect, ...] = (),
    *,
    leading: Any = None,
    shown: tuple[Estimate, ...] = (),
    **more: Any,
) -> dict[str, Any]:
    """Return the fields of a `SurveyRow`.

    `leading` has the kind and the place of the leading effect. `shown` are estimates of it that do not enter
    the comparison.
    """
    if leading is not None:
        more |= {"effect": leading.kind, "place": leading.place}
        own = (e for e in (*estimates, *shown) if (e.kind, e.place) == (leading.kind, leading.place))
        first = next(own, None)
        more |= {} if first is None else {"coefficient": first.value, "std": first.std, "unit": first.unit}
    return {
        "verdict": verdict, "sentences": tuple(sentences), "estimates": estimates, "effects": effects, **more
    }  # fmt: skip


def _diagnosed(model: Any, data: Measurement, options: Mapping[str, Any]) -> dict[str, Any]:
    """Return the result of a diagnosis.

    It holds the best effect if that stands alone, or the parameters of the model if these explain the record.
    """
    found = diagnose(model, data, **options)
    best, said = found.best, found.sentences()
    if found.verdict == "parameters":
        assert found.floated is not None
        return _found(found.verdict, said, _estimates(found.floated.parameters, "linear"))
    if best is None or found.verdict == "unexplained":
        return _found(found.verdict, said, place=found.place)
    rows = _estimates(best.refinement.parameters, "effect", best.effects)
    known: dict[str, Any] = {"leading": best.effect, "shown": rows}
    known["probability"] = float(best.probability) if math.isfinite(best.probability) else None
    alone = (rows, best.effects) if found.verdict == "effect" else ()
    return _found(found.verdict, said, *alone, **known)


def _improved(model: Any, data: Measurement, options: Mapping[str, Any]) -> dict[str, Any]:
    """The effects of the last model, the surest first."""
    found = improve(model, data, **options)
    rows = _estimates(found.refinement.parameters, "effect", found.effects)
    return _found(found.verdict, found.sentences(), rows, found.effects, leading=_surest(rows))


def _localized(model: Any, data: Measurement, options: Mapping[str, Any]) -> dict[str, Any]:
    """Every place, all estimated together, whether it is named or not."""
    found = localize_damage(model, data, **options)
    rows = tuple(
        Estimate(row.kind, row.place, row.name, row.joint, row.joint_std, row.unit)
        for row in found.rows
        if _usable(row.joint, row.joint_std)
    )
    leading = found.named[0] if found.named else None
    verdict = ("changed" if found.named else "unchanged") if found.explained else "unexplained"
    return _found(verdict, [found.message], rows, found.effects, leading=leading)


def _refined(model: Any, data: Measurement, options: Mapping[str, Any]) -> dict[str, Any]:
    """Return the effects and parameters that `refine` fitted."""
    found = refine(model, data, **options)
    rows = _estimates(found.parameters, "effect") + _estimates(found.parameters, "linear")
    effects = tuple(e for e, role in zip(found.effects, found.roles, strict=True) if role == "effect")
    verdict, said = "fitted" if found.success else "doubtful", [found.message, *found.warnings]
    return _found(verdict, said, rows, effects, leading=_surest(rows))


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
    held = {e.key for e in getattr(model, "effects", ())}
    settings = {name: options[name] for name in _OF_FIT if name in options}
    settings |= {"free": "linear"} if floats else {}
    found: Refinement = refine(model, data, [e for e in effects if e.key not in held], **settings)
    return {"estimates": _estimates(found.parameters, "effect", effects) if found.success else ()}


def _estimates(
    rows: Sequence[EstimatedParameter], role: str, effects: Sequence[Effect] | None = None
) -> tuple[Estimate, ...]:
    """Return the coefficients of one role that the record determines.

    If `effects` are given, only their coefficients are returned.
    """
    wanted = None if effects is None else {(e.kind, e.place) for e in effects}
    return tuple(
        Estimate(row.kind, row.place, row.name, float(row.coefficient), float(row.std), row.unit)
        for row in rows
        if row.role == role
        and (wanted is None or (row.kind, row.place) in wanted)
        and _usable(row.coefficient, row.std)
    )


def _usable(value: float, std: float) -> bool:
    return math.isfinite(value) and math.isfinite(std) and std > 0


def _surest(rows: Sequence[Estimate]) -> Estimate | None:
    return max(rows, key=lambda e: abs(e.value) / e.std, default=None)
