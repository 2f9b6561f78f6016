"""From the table of hypotheses to a verdict: pure functions, and the only levels of the decision."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

NAMED = 0.95  # probability from which a set of effects is named alone
EXCLUDED = 0.01  # odds below which another set is excluded
FAMILY = 20.0  # odds within which the simplest member of a family is named, and "nothing" is kept
SURE = 3.0  # standard deviations that each effect must be from zero


class Row(NamedTuple):
    """A set of effects, all nuisances averaged."""

    effects: tuple[Any, ...]
    floated: bool  # of the empty set: whether parameters are free
    value: float  # log posterior
    trials: list[Any]  # the most probable first


class Answer(NamedTuple):
    """What is said of a record."""

    word: str
    effects: tuple[Any, ...]
    probability: float
    trial: Any
    ties: tuple[tuple[Any, ...], ...]


def eligible(trial: Any) -> bool:
    """Whether each effect of a trial is determined."""
    return all(x >= SURE for x in trial.surest())


def rows_of(search: Any) -> list[Row]:
    """The table by sets of effects, the most probable first."""
    by_set: dict[Any, list[tuple[float, Any]]] = {}
    for trial in search.trials:
        if eligible(trial):
            key = frozenset(trial.effects) or search.is_floated(trial)
            by_set.setdefault(key, []).append((search.posterior(trial), trial))
    found = []
    for key, entries in by_set.items():
        entries.sort(key=lambda entry: -entry[0])
        value = float(np.logaddexp.reduce([v for v, _ in entries]))
        near = [t for v, t in entries if v > entries[0][0] + np.log(EXCLUDED)]
        found.append(Row(near[0].effects, key is True, value, near))
    return sorted(found, key=lambda row: -row.value)


def special(one: tuple[Any, ...], other: tuple[Any, ...]) -> bool:
    """Whether a set of effects is a special case of another: each a member, or contained in one."""
    if len(one) != len(other) or set(one) == set(other):
        return False
    inside = [any(e == o or (o.place == e.place and e.kind in o.spec.contains) for o in other) for e in one]
    return all(inside)


def verdict(search: Any) -> Answer:
    """The verdict on a search."""
    rows = rows_of(search)
    total = float(np.logaddexp.reduce([row.value for row in rows]))
    nothing = next(row for row in rows if not row.effects and not row.floated)
    if rows[0].value - nothing.value < np.log(FAMILY) and search.passed(nothing.trials[0]):
        share = float(np.exp(nothing.value - total))
        return Answer("adequate", (), share, nothing.trials[0], ())
    for row in rows[:4]:
        if row.value < rows[0].value + np.log(EXCLUDED):
            break
        trial = next((t for t in row.trials[:3] if search.passed(t)), None)
        if trial is not None:
            return _named(search, rows, row, trial, total)
    return Answer("unexplained", (), float(np.exp(rows[0].value - total)), rows[0].trials[0], ())


def _named(search: Any, rows: list[Row], row: Row, trial: Any, total: float) -> Answer:
    """The answer where a set of effects passes its tests."""
    family = [r for r in rows if special(r.effects, row.effects) or special(row.effects, r.effects)]
    simpler = [r for r in family if special(r.effects, row.effects)]
    simpler = [r for r in simpler if r.value > row.value - np.log(FAMILY) and search.passed(r.trials[0])]
    if simpler:
        row = simpler[0]
        trial = row.trials[0]
    mass = float(np.logaddexp.reduce([r.value for r in [row, *family] if r is not row] + [row.value]))
    probability = float(np.exp(mass - total) / (1.0 + np.exp(search.odds[id(trial)])))
    free = search.is_floated(trial)
    effects = tuple(e for e in row.effects if not (free and search.is_gain(e)))
    if not effects:
        word = "parameters" if free or row.effects else "adequate"
        return Answer(word, (), probability, trial, ())
    others = [r for r in rows if r is not row and r not in family]
    ties = tuple(r.effects for r in others if r.value > row.value + np.log(EXCLUDED))
    alone = probability >= NAMED or (probability >= 0.5 and not ties)
    return Answer("effect" if alone else "ambiguous", effects, probability, trial, ties)
