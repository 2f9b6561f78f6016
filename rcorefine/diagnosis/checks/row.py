"""One thing that `check` looked at."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

__all__ = ["LOOK", "OK", "STOP", "CheckRow", "warned"]

_MOST = 4  # rows that stand above another result

OK, LOOK, STOP = "ok", "look", "stop"


@dataclass(frozen=True, slots=True)
class CheckRow:
    """One thing that was looked at.

    Attributes
    ----------
    status : str
        "ok", "look" (go on, but know this) or "stop" (what follows means nothing before it is mended).
    what, where : str
        What was looked at, and the signal, "" for the whole record.
    figure : str
        What was found, with its unit.
    sentence : str
        What it means, and what to do.
    """

    status: str
    what: str
    where: str
    figure: str
    sentence: str


def warned(rows: Sequence[CheckRow]) -> list[str]:
    """What stands above a result that rests on a record with these rows.

    Parameters
    ----------
    rows : sequence of CheckRow
        Rows that ask for attention.

    Returns
    -------
    list of str
        A line each; of many the first ones, and how many are left out.
    """
    said = [f"{row.status.upper()}: {row.sentence}" for row in rows[:_MOST]]
    return said if len(rows) <= _MOST else [*said, f"LOOK: {len(rows) - _MOST} more rows in .checks."]
