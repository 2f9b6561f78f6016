"""One thing that `check` looked at."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass

from ...results import Row

__all__ = ["LOOK", "OK", "STOP", "CheckRow", "warned"]

_MOST, _LONG = 4, 150  # rows that are named above another result; letters of the first one there
_OF_THE_FREE_RUN = ("delay", "drift", "gain", "level", "rectified", "stops", "units")

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


def warned(rows: Sequence[CheckRow], explained: bool = False, places: Collection[str] = ()) -> list[str]:
    """Return the warnings for a result that rests on these rows.

    Parameters
    ----------
    rows : sequence of CheckRow
        Rows that ask for attention.
    explained : bool
        Whether the result explains the record. Then it explains what the model's free run leaves, too.
    places : collection of str
        Where the effects are that it found: they explain that an output is cut off there.

    Returns
    -------
    list of str
        The first one in a sentence, the others by name: the answer is what was asked for.
    """
    if explained:
        left = [row for row in rows if row.what != "clipping" or row.where.split(", ")[0] not in places]
        rows = [row for row in left if row.status == STOP or row.what not in _OF_THE_FREE_RUN]
    if not rows:
        return []
    first, *others = rows
    short = f"{first.what} {first.where}: {first.figure} (see .checks)."
    whole = len(first.sentence) <= _LONG or first.status == STOP
    said = [f"{first.status.upper()}: {first.sentence if whole else short}"]
    named = [f"{row.what} of {row.where}" if row.where else row.what for row in others]
    if named:
        more = f" and {len(named) - _MOST} more" if len(named) > _MOST else ""
        said.append(f"{others[0].status.upper()}: also {', '.join(named[:_MOST])}{more} (see .checks).")
    return said
