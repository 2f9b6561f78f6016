"""Table of a `Check`, and of its warnings in the report of a result.

The report shows them if its result rests on the same record.
"""

from __future__ import annotations

from collections.abc import Sequence

from ..diagnosis.checks.result import Check
from ..diagnosis.checks.row import CheckRow
from .tables import Table, Told, tells

__all__ = ["check_told", "odd"]

_HEADERS = ["", "looked at", "where", "found"]


@tells(Check)
def check_told(found: Check) -> Told:
    """Return the warnings of a check and the table of all its findings."""
    looks = [f"{row.status.upper()}: {row.sentence}" for row in found.looks]
    head = looks or ["No problem found: the record and the model can be compared."]
    quiet = [row.sentence for row in found.rows if row.what == "information" and row not in found.looks]
    return head, Table(_HEADERS, _rows(found.rows), "Check", [*head, *quiet], 4), quiet


def odd(rows: Sequence[CheckRow]) -> list[Table]:
    """A table of what asks for attention, none where nothing does.

    Parameters
    ----------
    rows : sequence of CheckRow
        Rows that ask for attention.

    Returns
    -------
    list of Table
    """
    title, notes = "Checks that need attention", [row.sentence for row in rows]
    return [Table(_HEADERS, _rows(rows), title, notes, 4)] if rows else []


def _rows(rows: Sequence[CheckRow]) -> list[list[str]]:
    return [[row.status, row.what, row.where, row.figure] for row in rows]
