"""Conditions that a fleet must keep, read from a TOML file.

A check that runs every night can use them.
"""

from __future__ import annotations

import math
import tomllib
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from os import PathLike
from typing import TYPE_CHECKING, Any

from ..arguments import as_path
from ..effects.law import KINDS
from ..exceptions import DataError
from ..results import chance, with_error
from .comparison import FleetEffect, MachineEffect

if TYPE_CHECKING:
    from .result import Survey


@dataclass(frozen=True, slots=True)
class Breach:
    """A condition that is not kept.

    Attributes
    ----------
    condition : str
        Its name, or its number in the file.
    machine : str
        Who breaks it; "" for the whole fleet.
    sentence : str
        What is the case.
    """

    condition: str
    machine: str
    sentence: str


def breaches(survey: Survey, conditions: str | PathLike[str] | Mapping[str, Any]) -> tuple[Breach, ...]:
    """See `Survey.breaches`."""
    found: list[Breach] = []
    for number, table in enumerate(_tables(conditions), 1):
        name = str(table.get("name", f"condition {number}"))
        [test] = [word for word in _TESTS if word in table]
        found += [
            Breach(name, machine, sentence) for machine, sentence in _TESTS[test](survey, table, table[test])
        ]
    return tuple(found)


_Said = Iterator[tuple[str, str]]


def _effects(survey: Survey, table: Mapping[str, Any]) -> list[FleetEffect]:
    """Return the coefficients to which a condition applies.

    The keys "effect" and "place" may be left out.
    """
    return [
        effect
        for effect in survey.effects
        if table.get("effect", effect.kind) == effect.kind
        and table.get("place", effect.place) == effect.place
    ]


def _against_fleet(survey: Survey, table: Mapping[str, Any], most: float) -> _Said:
    for effect, machine, side, sign in _machines(survey, table):
        if machine.deviation is None:
            said = "cannot be judged: fewer than 3 other machines have it"
            yield machine.machine, f"{effect.label} {said}"
        elif sign * machine.deviation >= most:
            size = f"{machine.value:.4g} {effect.unit}".rstrip()
            far = f"{abs(machine.deviation):.3g} standard deviations {side} the fleet"
            yield machine.machine, f"{effect.label} is {size}, {far}"


def _limit(survey: Survey, table: Mapping[str, Any], limit: float) -> _Said:
    for effect, machine, side, sign in _machines(survey, table):
        if sign * (machine.value - limit) > 0:
            size = with_error(machine.value, machine.std, effect.unit)
            yield machine.machine, f"{effect.label} is {size}, {side} {limit:g}"


def _machines(
    survey: Survey, table: Mapping[str, Any]
) -> Iterator[tuple[FleetEffect, MachineEffect, str, int]]:
    """Yield the coefficients to which a condition applies.

    Each comes with the side of the limit that breaks the condition, and its sign.
    """
    side, sign = ("above", 1) if {"above", "above_fleet"} & set(table) else ("below", -1)
    for effect in _effects(survey, table):
        for machine in _of(effect.machines, table):
            yield effect, machine, side, sign


def _growth(survey: Survey, table: Mapping[str, Any], level: float) -> _Said:
    keys = {(effect.kind, effect.place) for effect in _effects(survey, table)}
    for trend in _of(survey.trends, table):
        if (trend.kind, trend.place) in keys and trend.p_value <= level:
            slope = with_error(trend.slope, trend.std, f"{trend.unit} per {trend.per}".strip())
            yield trend.machine, f"{trend.label} changes by {slope} ({chance(trend.p_value, 'p')})"


def _verdict(survey: Survey, table: Mapping[str, Any], words: str | list[str]) -> _Said:
    wanted = [words] if isinstance(words, str) else words
    rows = _of(survey.rows, table)
    hit = [row for row in rows if row.verdict in wanted]
    share = float(table.get("share", 0.0))
    if len(hit) > share * len(rows):
        for row in hit:
            name = f" ({row.label})" if row.effect else ""
            yield row.machine, f"{row.record}: verdict {row.verdict}{name}"


def _errors(survey: Survey, table: Mapping[str, Any], most: float) -> _Said:
    failed = [row for row in _of(survey.rows, table) if row.error is not None]
    if len(failed) > most:
        for row in failed:
            yield row.machine, f"{row.record} failed: {row.error}"


def _of(entries: Any, table: Mapping[str, Any]) -> list[Any]:
    return [entry for entry in entries if table.get("machine", entry.machine) == entry.machine]


_TESTS: dict[str, Callable[[Any, Mapping[str, Any], Any], _Said]] = {
    **dict.fromkeys(("above_fleet", "below_fleet"), _against_fleet),
    **dict.fromkeys(("above", "below"), _limit),
    "growth": _growth,
    "verdict": _verdict,
    "errors": _errors,
}
_WORDS = ("name", "effect", "place", "machine", "share")


def _tables(conditions: Any) -> list[dict[str, Any]]:
    """The tables, each with one test, and no word that means nothing."""
    where = "conditions"
    if not isinstance(conditions, Mapping):
        path = as_path(conditions, "conditions")
        where = str(path)
        try:
            conditions = tomllib.loads(path.read_text(encoding="utf-8"))
        except ValueError as error:
            raise DataError(f"{where} is not TOML: {error}") from error
    tables = conditions.get("condition")
    if set(conditions) != {"condition"} or not isinstance(tables, list) or not tables:
        raise DataError(f"{where} must hold tables [[condition]] and nothing else")
    for number, table in enumerate(tables, 1):
        _check(table, f"{where}, condition {number}")
    return tables


def _check(table: Any, where: str) -> None:
    if not isinstance(table, Mapping):
        raise DataError(f"{where} must be a table")
    unknown = [key for key in table if key not in (*_TESTS, *_WORDS)]
    tests = [key for key in table if key in _TESTS]
    if unknown or len(tests) != 1:
        said = f"no key {unknown[0]!r}" if unknown else f"{len(tests)} tests"
        raise DataError(f"{where}: {said}; one of {', '.join(_TESTS)}, and any of {', '.join(_WORDS)}")
    [test] = tests
    for key, value in table.items():
        text = key in ("name", "effect", "place", "machine")
        words = key == "verdict" and (isinstance(value, str) or _are_texts(value))
        number = not isinstance(value, bool) and isinstance(value, int | float) and math.isfinite(value)
        if not (isinstance(value, str) if text else words if key == "verdict" else number):
            raise DataError(f"{where}: {key} must be {'text' if text or key == 'verdict' else 'a number'}")
    if "share" in table and test != "verdict":
        raise DataError(f"{where}: share goes with verdict alone")
    if "effect" in table and table["effect"] not in KINDS:
        raise DataError(f"{where}: no effect is called {table['effect']!r}; there are {', '.join(KINDS)}")


def _are_texts(value: Any) -> bool:
    return isinstance(value, list) and all(isinstance(word, str) for word in value)
