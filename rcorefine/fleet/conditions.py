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

import control as ct

from rcorefine import Effect

from ..arguments import as_path
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
    for number, table in enumerate(_tables(conditions, {effect.kind for effect in survey.effects}), 1):
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


#: Keys beside the test of a table; those but the last hold text.
_WORDS = ("name", "effect", "place", "machine", "share")


def _tables(conditions: Any, held: set[str]) -> list[dict[str, Any]]:
    """The tables, each with one test, and no word that means nothing."""
    where = "conditions"
    if not isinstance(conditions, Mapping):
        path = as_path(conditions, "conditions")
        where = str(path)
        try:
            conditions = tomllib.loads(path.read_text(encoding="utf-8"))
        except ValueError as error:
            raise DataError(f"{where} is not TOML: {error}") from error
    tables: Any = conditions.get("condition")
    listed = isinstance(tables, list) and all(isinstance(table, Mapping) for table in tables)
    if set(conditions) != {"condition"} or not listed or not tables:
        raise DataError(f"{where} must hold tables [[condition]] and nothing else")
    for number, table in enumerate(tables, 1):
        _check(table, f"{where}, condition {number}", held)
    return list(tables)


def _check(table: Mapping[str, Any], where: str, held: set[str]) -> None:
    """Check one table; `held` are the kinds of effects in the survey."""
    unknown = [key for key in table if key not in (*_TESTS, *_WORDS)]
    tests = [key for key in table if key in _TESTS]
    if unknown or len(tests) != 1:
        said = f"no key {unknown[0]!r}" if unknown else f"{len(tests)} tests"
        raise DataError(f"{where}: {said}; one of {', '.join(_TESTS)}, and any of {', '.join(_WORDS)}")
    for key, value in table.items():
        _check_value(key, value, where)
    if "share" in table and tests != ["verdict"]:
        raise DataError(f"{where}: share goes with verdict alone")
    if "effect" in table and table["effect"] not in held:
        try:
            Effect(table["effect"], "any place")
        except ct.ControlArgument as error:
            raise DataError(f"{where}: {error}") from error


def _check_value(key: str, value: Any, where: str) -> None:
    """Check that a key holds text or a number, as it must."""
    if key in _WORDS[:-1] or key == "verdict":  # of verdicts there may be several
        words = value if key == "verdict" and isinstance(value, list) else [value]
        fine, what = all(isinstance(word, str) for word in words), "text"
    else:
        fine = isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value)
        what = "a number"
    if not fine:
        raise DataError(f"{where}: {key} must be {what}")
