"""Table of a `Check`."""

from __future__ import annotations

from ..diagnosis.checks.result import Check
from .tables import Table, Told, tells

__all__ = ["check_told"]


@tells(Check)
def check_told(found: Check) -> Told:
    """What asks for attention in words, above the table of all that was looked at."""
    looks = [f"{row.status.upper()}: {row.sentence}" for row in found.looks]
    head = looks or ["Nothing odd: the record and the model can be laid beside each other."]
    rows = [[row.status, row.what, row.where, row.figure] for row in found.rows]
    quiet = [row.sentence for row in found.rows if row.what == "information" and row not in found.looks]
    table = Table(["", "looked at", "where", "found"], rows, "Check", [*head, *quiet], 4)
    return head, table, quiet
