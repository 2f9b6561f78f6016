"""Tables and picture of a `FailureMap`."""

from __future__ import annotations

import textwrap
from typing import TYPE_CHECKING

from .tables import WIDTH, html_table, number, text_table

if TYPE_CHECKING:
    from ..comparison.failure_map import FailureMap

__all__ = ["failure_html", "failure_text"]

_HEADERS = ["", "", "where", "measure", "share", "p-value"]
_ROLES = {"first": "1", "besides": "+", "instead": "="}


def _cells(found: FailureMap) -> tuple[list[list[str]], str, list[str]]:
    rows = [
        [
            _ROLES[row.role],
            row.dimension,
            row.where,
            row.measure,
            f"{100 * row.share:.0f} %",
            _chance(row.p_value),
        ]
        for row in found.rows
    ]
    title = f"Where {found.name!r} fails: {len(rows)} row{'s' if len(rows) != 1 else ''}"
    if not rows:
        title = f"No failure of {found.name!r} found (looked at: {', '.join(found.looked) or 'nothing'})"
    if not rows and found.looked:
        notes = [
            "Nothing stands out: what is left looks like noise that knows nothing of input, motion or time."
        ]
    elif not rows:
        notes = []
    else:
        notes = [f"1. {found.rows[0].sentence}"]
        notes += [f"{k}. {row.sentence}" for k, row in enumerate(found.rows[1:4], 2)]
        notes.append(
            "share: part of the error's energy that the row explains (rows overlap); p-value: chance of such "
            "a row anywhere in the map if the model were right. 1: leaves least unexplained; +: besides, "
            "what is left when the rows above are allowed for; =: instead, another view of the same error."
        )
    notes += [f"{note}." for note in found.notes]
    return rows, title, notes


def _chance(p: float) -> str:
    return "< 1e-99" if p < 1e-99 else number(p, 1)


def failure_text(found: FailureMap) -> str:
    """Table with one row per failure, at most 80 columns."""
    rows, title, notes = _cells(found)
    if not rows:
        return "\n".join(line for text in (title, *notes) for line in textwrap.wrap(text, WIDTH))
    return text_table(_HEADERS, rows, title=title, notes=notes, left=4)


def failure_html(found: FailureMap) -> str:
    """Table with one row per failure, HTML."""
    rows, title, notes = _cells(found)
    return html_table(_HEADERS, rows, title=title, notes=notes, left=4)
