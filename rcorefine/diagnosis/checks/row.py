"""One thing that `check` looked at."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from ...results import Row

__all__ = ["LOOK", "OK", "STOP", "CheckRow", "warned"]

_MOST, _LONG = 4, 150  # rows that are named above another result; letters of the first one there

OK, LOOK, STOP = "ok", "look", "stop"


@dataclass(frozen=True, slots=True)
class CheckRow(Row):
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
        The first one in a sentence, the others by name: the answer is what was asked for.
    """
    if not rows:
        return []
    first, *others = rows
    sentence = first.sentence if len(first.sentence) <= _LONG or first.status == STOP else _short(first)
    said = [f"{first.status.upper()}: {sentence}"]
    named = [f"{row.what} of {row.where}" if row.where else row.what for row in others]
    if named:
        more = f" and {len(named) - _MOST} more" if len(named) > _MOST else ""
        said.append(f"{others[0].status.upper()}: also {', '.join(named[:_MOST])}{more} (see .checks).")
    return said


def _short(row: CheckRow) -> str:
    return f"{row.what} {row.where}: {row.figure} (see .checks)."
