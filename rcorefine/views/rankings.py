"""Bars of candidates and tests, shared by all pictures of diagnoses."""

from __future__ import annotations

from typing import Any

import numpy as np

from ..diagnosis.result import Diagnosis
from .figures import plain, style

__all__ = ["ranking_bars", "test_bars", "title_of"]

_SHOWN = 8


def title_of(found: Diagnosis) -> str:
    """The verdict in one line."""
    place, unexplained = found.place, found.verdict == "unexplained"
    if found.best is None or found.verdict == "adequate" or (unexplained and place is None):
        return f"Diagnosis: {found.verdict}"
    if unexplained and place is not None:
        return f"Diagnosis: {found.verdict} (at {place}, probability {found.places[place]:.2f})"
    return f"Diagnosis: {found.verdict} ({found.best.label}, probability {found.best.probability:.2f})"


def ranking_bars(ax: Any, found: Diagnosis) -> list[Any]:
    """Draw the misfit of each refitted candidate as a bar.

    The misfit is 100 minus the fit in percent.
    """
    rows = found.ranking[:_SHOWN][::-1]
    where = np.arange(len(rows))
    colors = [style(1).color if row.alike or row is found.best else "0.75" for row in rows]
    loss = [100 - row.fit_after for row in rows]
    bars = ax.barh(where, loss, color=colors, edgecolor="0.3", height=0.65)
    before = 100 - rows[0].fit_before
    line = ax.axvline(before, color=style(0).color, ls="--", lw=1.4, label="model as given")
    for y, row, value in zip(where, rows, loss, strict=True):
        ax.annotate(
            "" if found.verdict == "unexplained" else f"P = {row.probability:.2f}",
            (value, y),
            xytext=(4, 0),
            textcoords="offset points",
            va="center",
            fontsize=8,
        )
    ax.set_yticks(where, [_wrapped(row.label) for row in rows], fontsize=7)
    ax.set_xlim(0, 1.25 * max(before, *loss))
    ax.set_xlabel("100 - fit of the refitted model [%]")
    ax.set_title("Candidate effects, refitted")
    return [*bars, line]


def _wrapped(label: str) -> str:
    one, *more = label.split(" + ")  # each effect of a set has a line, a single one has two
    lines = [one, *more] if more else one.replace(" at ", "\nat ", 1).split("\n")
    words = [a.replace("_", " ") + at + b for a, at, b in (line.partition("at ") for line in lines)]
    return plain(("\n+ " if more else "\n").join(words))


def test_bars(ax: Any, found: Diagnosis) -> list[Any]:
    """The tests of the model as it is."""
    tests = [t for t in found.tests if t.dof][::-1]
    where = np.arange(len(tests))
    bars = ax.barh(
        where, [-np.log10(max(t.p_value, 1e-300)) for t in tests], color="0.75", edgecolor="0.3", height=0.65
    )
    level = -np.log10(found.significance / max(len(tests), 1))
    line = ax.axvline(level, color=style(1).color, ls="--", lw=1.4, label="significance level")
    ax.set_yticks(where, [t.name.split(" (")[0] for t in tests], fontsize=8)
    ax.set_xlim(0, max(1.2 * level, ax.get_xlim()[1]))
    ax.set_xlabel("-log10 of the p-value")
    ax.set_title("Residual tests of the model")
    return [*bars, line]
