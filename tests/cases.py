"""Cases of a sweep that only the long run tries: parametrize("seed", [0, *slow(1, 2)])."""

from __future__ import annotations

import itertools
from collections.abc import Iterable
from typing import Any

import pytest

import rcorefine as rco


def slow(*cases: Any) -> list[Any]:
    """Return the cases, each a value or a tuple of them, marked `slow`."""
    return [
        pytest.param(*(case if isinstance(case, tuple) else (case,)), marks=pytest.mark.slow)
        for case in cases
    ]


def sweep(quick: list[tuple[Any, ...]], *axes: Iterable[Any]) -> list[Any]:
    """Return all combinations of the axes; those that are not among the quick ones are marked `slow`."""
    every = list(itertools.product(*axes))
    assert all(case in every for case in quick)
    return [*quick, *slow(*(case for case in every if case not in quick))]


def few_or_all(*kinds: str) -> list[Any]:
    """Return these kinds of effects, and None for the whole library, which is marked `slow`."""
    return [pytest.param(kinds, id="few"), pytest.param(None, id="all", marks=pytest.mark.slow)]


def named(found: Any, effect: rco.Effect, value: float, share: float = 0.0) -> None:
    """Assert that an effect is named, alone or among those that tie, with its first coefficient."""
    assert found.verdict in ("effect", "ambiguous")
    assert effect in (*found.ambiguous, *found.effects)
    rows = [one for row in found.ranking for one in (row, *row.same)]
    row = next(one for one in rows if one.effect == effect)
    size, std = next(iter(row.coefficients.values())), next(iter(row.std.values()))
    assert abs(size - value) < 4 * std + share * abs(value), (size, std, value)


def offered(model: Any, kinds: tuple[str, ...] | None) -> list[rco.Effect] | None:
    """Return the candidates of these kinds at all places, None for the whole library."""
    return kinds and [effect for effect in rco.effect_library(model) if effect.kind in kinds]
