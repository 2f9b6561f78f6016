"""Steps back: what a finished ladder no longer needs, and what never earned its place."""

from __future__ import annotations

from collections.abc import Callable, Iterable

import numpy as np

from ...effects.effect import Effect
from ...inference.refinement import Refinement
from ..case import not_held
from .selection import StepwiseSelection, coefficients_of, determined

__all__ = ["drop_last", "drop_needless", "drop_undetermined", "return_trust", "shorten", "swap_better"]


Cost = Callable[[Effect, Refinement], float]


def drop_needless(ladder: StepwiseSelection, choices: int, by_error: bool) -> bool:
    """Drop effects whose absence costs less than their price, the cheapest first.

    Parameters
    ----------
    ladder : StepwiseSelection
        The climb; is changed.
    choices : int
        Candidates that there were.
    by_error : bool
        Whether the price is error (on the choosing part, and on it and the fitted one), or
        likelihood.

    Returns
    -------
    bool
        Whether anything was dropped.
    """

    def in_error(effect: Effect, without: Refinement) -> float:
        fit, choose = ladder.parts.fit, ladder.parts.choose
        return max(
            ladder.rise(without, choose), ladder.rise(without, fit, choose)
        ) - ladder.levels.earned * len(effect.coefficients)

    def in_likelihood(effect: Effect, without: Refinement) -> float:
        return 2 * ladder.gain(ladder.current, without) - ladder.price(choices) * len(effect.coefficients)

    dropped = False
    while len(ladder.effects) > 1:
        doubtful = [
            effect
            for effect in ladder.effects
            if ladder.is_new(e for e in ladder.effects if e is not effect)
            and (by_error or not _sure(ladder, effect, choices))
        ]
        if not doubtful:
            break
        cost, effect, without = _cheapest(ladder, doubtful, in_error if by_error else in_likelihood)
        if cost >= 0:
            break
        ladder.drop(effect, without)
        dropped = True
    return dropped


def drop_last(ladder: StepwiseSelection, choices: int) -> None:
    """Go back to no effect where the one that is left was of use only beside those that were dropped.

    Parameters
    ----------
    ladder : StepwiseSelection
        The climb; is changed.
    choices : int
        Candidates that there were.
    """
    if len(ladder.effects) != 1 or ladder.steps[-1].action != "drop":
        return
    (effect,) = ladder.effects
    without, parts = ladder.without(effect), ladder.parts
    size = len(effect.coefficients)
    risen = ladder.rise(without, parts.fit, parts.choose)
    lost = 2 * ladder.gain(ladder.current, without)
    if risen < ladder.levels.earned * size and lost < ladder.price(choices) * size:
        while ladder.effects:
            ladder.take_back()


def swap_better(ladder: StepwiseSelection, library: list[Effect]) -> bool:
    """Put another effect in the place of an older one where that explains the record better.

    Parameters
    ----------
    ladder : StepwiseSelection
        The climb; is changed.
    library : list of Effect
        Candidates.

    Returns
    -------
    bool
        Whether anything was swapped.
    """
    swapped = False
    for effect in list(ladder.effects):
        if ladder.steps[-1].action == "add" and effect is ladder.effects[-1]:
            break  # it has just won against all others
        without = ladder.without(effect)
        found = ladder.investigate(without, not_held(library, without.effects)).found
        if not found.ranking:
            continue
        row = found.ranking[0]
        after = [*(e for e in ladder.effects if e is not effect), row.effect]
        if ladder.is_new(after) and ladder.gain(row.refinement, ladder.current) > ladder.levels.swap:
            settled = ladder.refit(row.refinement)
            saved = ladder.share([row.effect], settled)
            if determined([row.effect], settled) and saved > -ladder.levels.spoiled:
                ladder.swap(effect, row.effect, settled, found.verdict)
                swapped = True
    return swapped


def return_trust(ladder: StepwiseSelection) -> None:
    """Take back what was added on trust and has not earned its place on the choosing part by now.

    Parameters
    ----------
    ladder : StepwiseSelection
        The climb; is changed.
    """

    def cost(effect: Effect, without: Refinement) -> float:
        return ladder.rise(without, ladder.parts.choose) - ladder.levels.earned * len(effect.coefficients)

    while ladder.on_trust:
        lost, effect, without = _cheapest(ladder, ladder.on_trust, cost)
        if lost >= 0:
            break
        _leave(ladder, effect, without)


def drop_undetermined(ladder: StepwiseSelection) -> bool:
    """Drop effects until the record determines every coefficient of those that stay.

    Parameters
    ----------
    ladder : StepwiseSelection
        The climb; is changed.

    Returns
    -------
    bool
        Whether anything was dropped.
    """
    dropped = False
    while unknown := [e for e in ladder.effects if not determined([e], ladder.current)]:
        _, effect, without = _cheapest(ladder, unknown, lambda _, without: _spread(without))
        ladder.drop(effect, without)
        dropped = True
    return dropped


def shorten(ladder: StepwiseSelection, most: int) -> None:
    """Drop what costs least until there are no more effects than asked for.

    Parameters
    ----------
    ladder : StepwiseSelection
        The climb; is changed.
    most : int
        Effects at most.
    """
    while len(ladder.effects) > most:
        _, effect, without = _cheapest(ladder, ladder.effects, lambda _, without: _spread(without))
        _leave(ladder, effect, without)


def _leave(ladder: StepwiseSelection, effect: Effect, without: Refinement) -> None:
    """Drop an effect; the last one that was added is as if it had not been tried."""
    last = ladder.steps[-1]
    if last.action == "add" and last.effect is effect:
        ladder.take_back()
    else:
        ladder.drop(effect, without)


def _cheapest(
    ladder: StepwiseSelection, effects: Iterable[Effect], cost: Cost
) -> tuple[float, Effect, Refinement]:
    """Which absence costs least, by how much, and the model without it."""
    tried = []
    with ladder.progress.step("what is needless"):
        for effect in effects:
            without = ladder.without(effect)
            tried.append((cost(effect, without), effect, without))
    return min(tried, key=lambda row: row[0])


def _spread(model: Refinement) -> float:
    """Mean log error on the fitted records."""
    return float(np.mean(np.log(model.rmse + 1e-300)))


def _sure(ladder: StepwiseSelection, effect: Effect, choices: int) -> bool:
    """Whether an effect is so many standard deviations from nothing that it need not be tried without."""
    (value, *more), (std, *_) = (
        coefficients_of(effect, ladder.current, what).values() for what in ("coefficient", "std")
    )
    return not more and 0 < std < np.inf and (value / std) ** 2 > 4 * ladder.price(choices)
