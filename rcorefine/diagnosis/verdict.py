"""Verdict of a diagnosis from the table of hypotheses."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np

from ..effects.effect import Effect
from .case import not_held
from .hypothesis import Trial
from .search import Search, is_gain, is_number

__all__ = ["Answer", "TableRow", "answer", "special", "table"]


class TableRow(NamedTuple):
    """A set of effects with its probability over all nuisances.

    Attributes
    ----------
    effects : tuple of Effect
        The set; empty if nothing is missing.
    floated : bool
        For the empty set: whether the parameters of the model are re-estimated. False for other sets.
    value : float
        Log posterior probability, summed over the nuisances, up to a constant.
    trials : list of Trial
        Fits that the data do not exclude, the most probable first.
    """

    effects: tuple[Effect, ...]
    floated: bool
    value: float
    trials: list[Trial]


class Answer(NamedTuple):
    """A verdict with the row and the fit that support it.

    Attributes
    ----------
    verdict : str
        As `Diagnosis.verdict`.
    row : TableRow
        Row of the answer, or the most probable row if the verdict is "unexplained".
    trial : Trial
        Fit of this row that passes the tests, or its most probable fit if the verdict is "unexplained".
    effects : tuple of Effect
        Named effects; those of the most probable row if the verdict is "unexplained".
    ties : tuple of TableRow
        Other rows that the data cannot distinguish from it.
    inside : tuple of TableRow
        Rows that contain it or are special cases of it; their probability counts for it.
    probability : float
        Probability of the answer; NaN if the verdict is "unexplained".
    none : float
        Probability that no candidate effect is right: a free force explains the record instead. NaN if the
        verdict is "adequate" because of the row without effects.
    """

    verdict: str
    row: TableRow
    trial: Trial
    effects: tuple[Effect, ...]
    ties: tuple[TableRow, ...]
    inside: tuple[TableRow, ...]
    probability: float
    none: float


def table(search: Search) -> list[TableRow]:
    """Return the table of sets of effects, the most probable first.

    Trials with an effect that the data do not determine are left out. The empty set has two rows: with the
    parameters held, and with them re-estimated.
    """
    by_set: dict[Any, list[Trial]] = {}
    for trial in search.ranked():
        if search.determined(trial):
            by_set.setdefault(frozenset(trial.effects) or trial.hypothesis.floated, []).append(trial)
    excluded = -0.5 * search.case.levels.rival
    rows = []
    for key, trials in by_set.items():
        values = [search.posterior(trial) for trial in trials]
        near = [t for t, v in zip(trials, values, strict=True) if v > values[0] + excluded]
        rows.append(TableRow(near[0].effects, key is True, float(np.logaddexp.reduce(values)), near))
    return sorted(rows, key=lambda row: -row.value)


def special(one: Sequence[Effect], other: Sequence[Effect]) -> bool:
    """Return whether a set of effects is a special case of another.

    Both have the same number of effects. Each effect of the first is in the second, or is contained in an
    effect of the second at the same place.
    """
    if len(one) != len(other) or set(one) == set(other):
        return False
    return all(any(e == o or (o.place == e.place and e.kind in o.spec.contains) for o in other) for e in one)


def answer(search: Search, rows: Sequence[TableRow], passed: Callable[[Trial], bool]) -> Answer:
    """Return the verdict of a table.

    Parameters
    ----------
    search : Search
        Search with its fitted trials.
    rows : sequence of TableRow
        Table of the search.
    passed : callable
        Function that tells whether a trial passes its tests.

    Returns
    -------
    Answer
    """
    levels = search.case.levels
    keeps, excluded = -float(np.log(search.case.significance)), -0.5 * levels.rival
    total = float(np.logaddexp.reduce([row.value for row in rows]))
    nothing = next(row for row in rows if not row.effects and not row.floated)
    top, first = search.ranked()[0], rows[0]
    unexplained = Answer("unexplained", first, first.trials[0], first.effects, (), (), np.nan, 1.0)
    if search.posterior(top) > rows[0].value + keeps + search.price and not search.determined(top):
        return unexplained
    plainest = sorted(nothing.trials, key=lambda trial: len(trial.hypothesis.nuisances))
    fine = rows[0].value - nothing.value < keeps and next(filter(passed, plainest), None)
    if fine:
        share = float(np.exp(nothing.value - total))
        return Answer("adequate", nothing, fine, (), (), (), share, np.nan)
    for row in rows[:4]:
        if row.value < rows[0].value + excluded:
            break
        trial = next((t for t in row.trials[:3] if passed(t)), None)
        if trial is not None:
            return _named(search, rows, row, trial, passed) if _likely(rows, row, total) else unexplained
    return unexplained


def _likely(rows: Sequence[TableRow], row: TableRow, total: float) -> bool:
    """Return whether failed rows have less than half the probability.

    Rows before the given one failed. Its special cases, and rows that contain it, do not count.
    """
    before = rows[: next(i for i, one in enumerate(rows) if one is row)]
    failed = [one.value for one in before if not _related(one, row)]
    return bool(np.logaddexp.reduce(failed or [-np.inf]) < total + np.log(0.5))


def _related(one: TableRow, other: TableRow) -> bool:
    """Return whether one set of effects is a special case of the other."""
    return special(one.effects, other.effects) or special(other.effects, one.effects)


def _named(
    search: Search, rows: Sequence[TableRow], row: TableRow, trial: Trial, passed: Callable[[Trial], bool]
) -> Answer:
    """Return the answer for a row with a trial that passes its tests."""
    levels = search.case.levels
    family = [r for r in rows if _related(r, row)]
    if row.effects and all(is_number(effect) for effect in row.effects):  # parameters of the model only
        family += [r for r in rows if not r.effects and r.floated]
    simpler = [r for r in family if special(r.effects, row.effects) and r.value > row.value - levels.family]
    passing = [(r, t) for r in simpler[:1] for t in r.trials[:3] if passed(t)]
    if passing:
        family = [*(r for r in family if r is not passing[0][0]), row]
        row, trial = passing[0]
    total = float(np.logaddexp.reduce([r.value for r in rows]))
    mass = float(np.logaddexp.reduce([r.value for r in [row, *family]]))
    none = 1.0 / (1.0 + float(np.exp(-search.criticized(trial).odds)))
    probability = float(np.exp(mass - total)) * (1.0 - none)
    free = trial.hypothesis.floated
    asked = [e for e in row.effects if not not_held([e], search.case.library)]
    effects = tuple(e for e in asked if not (free and is_gain(e)))
    if not effects:
        word = "parameters" if free or row.effects else "adequate"
        return Answer(word, row, trial, (), (), (), probability, none)
    near = [r for r in rows if r.value > row.value - 0.5 * levels.rival]
    ties = tuple(r for r in near if not any(r is one for one in [row, *family]))
    alone = probability >= levels.named or (probability >= 0.5 and not ties)
    word = "effect" if alone else "ambiguous"
    return Answer(word, row, trial, effects, ties, tuple(family), probability, none)
