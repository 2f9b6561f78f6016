"""Steps up: which effect, or pair of effects, earns a place in the model."""

from __future__ import annotations

import numpy as np

from ...effects.effect import Effect
from ...inference.refinement import Refinement
from ...refinement.refine import refine
from ..candidate_fits import CandidateFits
from ..case import not_held
from ..open_law import open_law
from ..ranking import in_free_run
from ..result import Diagnosis
from .selection import Choice, StepwiseSelection, coefficients_of, determined

__all__ = ["climb", "tabulate"]

_TRIED = 12  # effects of smallest error that are judged on the second part
_REFITTED = 3  # of them, fitted to the end
_ALIKE = 0.2  # log of the error within which the linear parameters decide
_PAIRS_FROM = 3  # first effects of which pairs are tried where none helps alone


def climb(ladder: StepwiseSelection, library: list[Effect], most: int) -> str:
    """Add effects until every test passes, none earns its place, or there are enough.

    Parameters
    ----------
    ladder : StepwiseSelection
        The climb; is changed.
    library : list of Effect
        Candidates.
    most : int
        Effects at most.

    Returns
    -------
    str
        Verdict on the last model.
    """
    while rest := ladder.rest(library):
        ladder.progress.round(ahead=max(most - len(ladder.effects), 0))
        found, race, floated = ladder.investigate(ladder.current, rest, numbers=not ladder.effects)
        ladder.learn_verdict(found.verdict)
        if found.floated is not None and ladder.float_numbers(found.floated):
            continue
        if found.base.roles.count("linear") > ladder.current.roles.count("linear"):
            ladder.float_numbers(found.base)  # beside them a law has its name
        # one more where that passes every test: an early one may then turn out to be needless
        room = most - len(ladder.effects) + (found.verdict != "unexplained" and most > 1)
        if race is None or room < 1:
            return found.verdict
        choice = _one(ladder, found, race, len(rest))
        if floated is not None and _numbers_first(ladder, floated, choice):
            continue
        if choice is None and room > 1 and found.verdict != "adequate":
            choice = _pair(ladder, race, rest)
        if choice is None:
            return found.verdict
        ladder.add(choice, found.verdict)
    return "unexplained"


def tabulate(ladder: StepwiseSelection, library: list[Effect]) -> None:
    """The last rung: a force that follows none of the laws, as a table, where it earns its place."""
    rest = ladder.rest(library)
    if not rest:
        return
    found, race, _ = ladder.investigate(ladder.current, rest, numbers=not ladder.effects)  # as `climb` asked
    if race is None or found.verdict != "unexplained":
        return
    law = open_law(race).law
    if law is None:
        return
    with_table = refine(ladder.current, ladder.parts.fit, [law.effect], **ladder.settings)
    if ladder.share((law.effect,), with_table) >= ladder.levels.earned:
        ladder.add(Choice((law.effect,), with_table), found.verdict)


def _numbers_first(ladder: StepwiseSelection, floated: Refinement, choice: Choice | None) -> bool:
    """Whether no law passes, and numbers that are off lower the error by clearly more than the best law.

    They are the plainer words: a law that is chosen by error alone makes up for them.
    """
    law = 0.0 if choice is None else min(ladder.rise(choice.refinement, ladder.parts.choose), 0.0)
    return ladder.float_numbers(floated, law - ladder.levels.earned)


def _one(ladder: StepwiseSelection, found: Diagnosis, race: CandidateFits, choices: int) -> Choice | None:
    """The effect to add, if one earns it.

    The most probable of those with which the tests pass; else the one whose plain error on the
    second part falls most per coefficient; else, on trust, the most probable if its likelihood
    stands out. What has rivals, or likelihood only, may not raise the error on the second part.
    Where the model is adequate but for few samples, the second part alone decides.
    """
    if found.verdict in ("effect", "ambiguous"):
        tied = [row for row in found.ranking if row.effect in found.ambiguous]
        for row in tied[:_REFITTED]:
            settled = _settled(ladder, (row.effect,), row.refinement)
            if settled is None:
                continue
            saved, alone = ladder.share((row.effect,), settled), found.verdict == "effect"
            if saved > (-np.inf if alone else -ladder.levels.spoiled):
                return Choice(
                    (row.effect,), settled, not alone and saved < ladder.levels.earned, found.ambiguous
                )
    for effect, refinement, ties in _by_error(ladder, race):
        if ladder.share((effect,), refinement) < ladder.levels.earned:
            continue
        settled = _settled(ladder, (effect,), refinement)
        if settled is not None and ladder.share((effect,), settled) >= ladder.levels.earned:
            ladder.by_error = True
            return Choice((effect,), settled, ties=ties)
    if found.verdict == "adequate":
        return None
    top = found.ranking[0]
    if 2 * ladder.gain(top.refinement, ladder.current) > ladder.price(choices) * len(top.coefficients):
        settled = _settled(ladder, (top.effect,), top.refinement)
        if settled is not None and ladder.share((top.effect,), settled) > -ladder.levels.spoiled:
            return Choice((top.effect,), settled, True, found.ambiguous)
    return None


def _pair(ladder: StepwiseSelection, race: CandidateFits, rest: list[Effect]) -> Choice | None:
    """Two effects that help only together: every second one behind each of the best first ones."""
    found: list[tuple[float, tuple[Effect, Effect], Refinement]] = []
    for one, first in _in_free_run(race, _PAIRS_FROM):
        others = not_held(rest, [one])
        second = ladder.investigate(first, others).race if others else None
        for two, both in _in_free_run(second, _TRIED) if second is not None else []:
            found.append((ladder.share((one, two), both), (one, two), both))
    for saved, pair, both in sorted(found, key=lambda row: -row[0])[:_REFITTED]:
        settled = _settled(ladder, pair, both) if saved >= ladder.levels.earned else None
        if settled is not None and ladder.share(pair, settled) >= ladder.levels.earned:
            ladder.by_error = True
            return Choice(pair, settled)
    return None


def _in_free_run(race: CandidateFits, most: int) -> list[tuple[Effect, Refinement]]:
    """The rivals whose plain error is smallest, at the minimum of that error."""
    plain = in_free_run(race)
    return [(r.effect, plain.model(i).refinement) for i, r in enumerate(plain.rivals[:most])]


def _settled(
    ladder: StepwiseSelection, effects: tuple[Effect, ...], refinement: Refinement
) -> Refinement | None:
    """The model fitted to the end; None where it was tried before, diverges, or does not determine them."""
    held = [*ladder.effects, *effects]
    if not ladder.is_new(held):
        return None
    settled = ladder.refit(refinement)
    runs = np.isfinite(ladder.log_error(settled, ladder.parts.fit, ladder.parts.choose))
    return settled if runs and determined(effects, settled) else None


def _by_error(
    ladder: StepwiseSelection, race: CandidateFits
) -> list[tuple[Effect, Refinement, tuple[Effect, ...]]]:
    """The rivals that lower the error on both first parts most per coefficient, each with its ties.

    Where the errors hardly differ, the one behind which the linear parameters stay at the
    model's own numbers goes first: the others bend them to imitate it.
    """
    parts = ladder.parts
    rows = []
    for effect, refinement in _in_free_run(race, _TRIED):
        size = max(len(coefficients_of(effect, refinement)), 1)
        saved = -ladder.rise(refinement, parts.fit, parts.choose) / size
        if saved > ladder.levels.earned and ladder.is_new([*ladder.effects, effect]):
            rows.append((saved, effect, refinement))
    rows = sorted(rows, key=lambda row: -row[0])[: 2 * _REFITTED]
    if not rows:
        return []
    alike = [row for row in rows if row[0] > rows[0][0] - _ALIKE]
    home = min(alike, key=lambda row: _far_from_home(row[2]))
    if _far_from_home(home[2]) < 0.5 * _far_from_home(rows[0][2]):
        rows.remove(home)
        rows.insert(0, home)
    return [
        (effect, refinement, tuple(other[1] for other in alike if other[1] is not effect))
        for _, effect, refinement in rows[:_REFITTED]
    ]


def _far_from_home(refinement: Refinement) -> float:
    """Relative distance of the linear parameters from the model's own numbers."""
    moved = [
        abs(row.value - row.initial) / abs(row.initial)
        for row in refinement.parameters
        if row.role == "linear" and row.initial
    ]
    return float(np.sqrt(np.mean(np.square(moved)))) if moved else 0.0
