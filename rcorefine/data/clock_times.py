"""Conversion of clock and calendar times to seconds.

Times are text (10:15:30.250 PM) or objects (`datetime`).
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from datetime import UTC, date, datetime
from typing import Any

import numpy as np

from ..exceptions import DataError
from ..systems.linear import Array

__all__ = ["in_seconds", "is_clock_time", "seconds_of"]

_DAY = 86400.0
_STAMP = re.compile(
    r"(?:(?P<date>\d{1,4}[-/.]\d{1,2}[-/.]\d{1,4})[T ,]\s*)?"
    r"(?P<h>\d{1,2}):(?P<m>[0-5]\d):(?P<s>[0-6]\d(?:[.,]\d+)?)"
    r"(?:\s?(?P<half>[AaPp])\.?[Mm]\.?)?(?:\s?(?P<zone>Z|UTC|GMT|[+-]\d\d(?::?\d\d)?))?"
)
_ORDERS = {"year first": (0, 1, 2), "day first": (2, 1, 0), "month first": (2, 0, 1)}


def is_clock_time(cell: str) -> bool:
    """Return whether a cell is a time of day, with or without its date.

    Examples
    --------
    >>> [is_clock_time(cell) for cell in ("10:15:30,5", "3/31/2024 1:59:59 PM", "2024-03-31", "1.5")]
    [True, True, False, False]
    """
    return _STAMP.fullmatch(cell) is not None


def in_seconds(values: Any) -> Any:
    """Convert dates, times of day and durations to seconds.

    Dates count from the earliest one. Other values are returned as they are.

    Parameters
    ----------
    values : array_like
        Times as numpy, pandas or `datetime` hold them, or as text.

    Returns
    -------
    ndarray, shape (N,), or `values`
        NaN where a date is missing.

    Examples
    --------
    >>> in_seconds(np.array(["2024-03-31T10:00:01", "2024-03-31T10:00"], "datetime64[ms]"))
    array([1., 0.])
    """
    try:
        times = np.asarray(values)
    except ValueError:  # ragged: who asked for times says so
        return values
    if times.ndim != 1 or not times.size:
        return values
    if times.dtype.kind == "M":
        times = times - np.fmin.reduce(times)  # the earliest that is none of NaT
    if times.dtype.kind == "m":
        return times / np.timedelta64(1, "s")
    cells = times.tolist()
    if all(isinstance(cell, datetime) and cell == cell for cell in cells):  # NaT is none, not even itself
        if len({cell.tzinfo is None for cell in cells}) == 1:
            if cells[0].tzinfo is not None:  # where summer begins, local times differ by an hour more
                cells = [cell.astimezone(UTC) for cell in cells]
            first = min(cells)
            return np.array([(cell - first).total_seconds() for cell in cells])
    elif all(isinstance(cell, str) for cell in cells) and is_clock_time(cells[0]):
        return seconds_of(cells, [f"time {k}" for k in range(len(cells))])[0]
    return values


def seconds_of(cells: Sequence[str], places: Sequence[str]) -> tuple[Array, str]:
    """Seconds from the first time on, and how they were read.

    Parameters
    ----------
    cells : sequence of str
        Times, at least one.
    places : sequence of str
        Where each stands, for messages.

    Returns
    -------
    seconds : ndarray, shape (N,)
        A clock without dates that falls by more than half a day has passed midnight.
    note : str
        What was taken for what.

    Raises
    ------
    DataError
        A cell that is no time, with or without a date or a time zone unlike the first, or dates whose
        order of day and month matters and cannot be told.

    Examples
    --------
    >>> seconds_of(["11:59:59.5 PM", "12:00:00.5 AM"], ["line 2", "line 3"])[0]
    array([0., 1.])
    """
    found = [_STAMP.fullmatch(cell) for cell in cells]
    for match, cell, place in zip(found, cells, places, strict=True):
        if match is None or any(
            (match[part] is None) != (found[0][part] is None)  # type: ignore[index]
            for part in ("date", "half", "zone")
        ):
            raise DataError(f"{place} is no time like the first one, {cells[0]!r}: {cell!r}")
    stamps = [match for match in found if match is not None]
    # whole seconds and their parts apart: what is subtracted keeps all digits
    clock, part = np.array([_clock(match, place) for match, place in zip(stamps, places, strict=True)]).T
    part = part - part[0]
    note = f"a clock, counted from {cells[0]}"
    if stamps[0]["date"] is None:
        nights = np.cumsum(np.diff(clock, prepend=clock[0]) < -_DAY / 2)
        return part + (clock - clock[0] + _DAY * nights), note
    days, order = _days([match["date"] for match in stamps], places)
    return part + (clock - clock[0] + _DAY * (days - days[0])), f"{note}, dates {order}"


def _clock(match: re.Match[str], place: str) -> tuple[float, float]:
    """Return whole seconds since midnight and the fraction of a second.

    If a time zone is given, midnight is that of Greenwich.
    """
    hour = int(match["h"])
    if (match["half"] is not None and not 1 <= hour <= 12) or hour > 23:
        raise DataError(f"{place} has no such hour: {match[0]!r}")
    if match["half"] is not None:
        hour = hour % 12 + 12 * (match["half"] in "pP")
    zone = match["zone"] or "Z"
    digits = zone[1:].replace(":", "") if zone[0] in "+-" else "0000"
    ahead = (int(digits[:2]) * 3600 + int(digits[2:] or 0) * 60) * (-1 if zone[0] == "-" else 1)
    whole = hour * 3600 + int(match["m"]) * 60 + int(match["s"][:2]) - ahead
    return whole, float(f"0.{match['s'][3:]}")


def _days(dates: Sequence[str], places: Sequence[str]) -> tuple[Array, str]:
    """Return the calendar days of dates and the order of their parts.

    The order of year, month and day is one in which all texts are dates.
    """
    known = {text: tuple(re.split("[-/.]", text)) for text in dict.fromkeys(dates)}
    ways: dict[str, Array] = {}
    for order, (y, m, d) in _ORDERS.items():
        numbers = {}
        for text, parts in known.items():
            year = int(parts[y]) + (2000 if len(parts[y]) == 2 else 0)
            try:
                if (order == "year first") != (len(parts[0]) == 4) or ("." in text and m == 0):
                    raise ValueError
                numbers[text] = date(year, int(parts[m]), int(parts[d])).toordinal()
            except ValueError:
                break
        else:
            ways[order] = np.array([numbers[text] for text in dates], dtype=float)
    if not ways:
        raise DataError(f"{places[0]} and those below hold dates that no order explains: {dates[0]!r} ...")
    order, days = next(iter(ways.items()))
    if any((other - other[0] != days - days[0]).any() for other in ways.values()):
        raise DataError(
            f"{places[0]} and those below hold {next(iter(known))!r} to {list(known)[-1]!r}, and day and "
            "month may stand in either order; write the year first (2024-03-31)"
        )
    return days, order if len(ways) == 1 else "within a day, in either order"
