"""Columns of numbers from text files of labs.

NumPy's reader parses the numbers.
"""

from __future__ import annotations

import csv
import re
from collections.abc import Iterator, Sequence
from dataclasses import replace
from operator import methodcaller
from pathlib import Path
from typing import Any

import control as ct
import numpy as np

from ..arguments import as_choice, as_text, as_texts, shown
from ..exceptions import DataError
from ..systems.linear import Array
from .clock_times import is_clock_time, seconds_of
from .columns import Columns
from .layout import Layout, find_layout, rows_of

__all__ = ["read_csv", "unwrapped"]

_CLOCK = re.compile(r"\s*\d\d:\d\d:\d\d[.,]\d+ -> ?")
_LABEL = re.compile(r"([^\s,;:]+)\s*:\s*(?=[-+.\d])")
_HEAD = 100  # lines in which the form of a log shows


def unwrapped(lines: list[str], names: Sequence[str], path: object) -> tuple[list[str], tuple[str, ...]]:
    """Convert the lines of a serial log to those of a plain table.

    The notes list what was removed.

    Parameters
    ----------
    lines : list of str
        The file.
    names : sequence of str
        Columns asked for.
    path : str or path
        For messages.

    Returns
    -------
    lines : list of str
        As many; the first that is labeled in full becomes the header's line before it.
    notes : tuple of str

    Raises
    ------
    DataError
        If labels change from line to line.

    Examples
    --------
    >>> unwrapped(["12:00:01.250 -> u:1 y:2", "12:00:01.260 -> u:3 y:4"], ["u", "y"], "a.log")[0]
    ['u y', '1 2', '3 4']
    """
    notes: tuple[str, ...] = ()
    some = [line for line in lines[:_HEAD] if line.strip()]
    if some and 2 * sum(bool(_CLOCK.match(line)) for line in some) > len(some):
        lines = [_CLOCK.sub("", line, count=1) for line in lines]
        notes = ("the serial monitor's clock before '->' was not read",)
    head = enumerate(lines[:_HEAD])
    start = next((k for k, line in head if ":" in line and set(names) <= set(_LABEL.findall(line))), None)
    if start is None:
        return lines, notes
    labels = _LABEL.findall(lines[start])
    separator = re.search(r"[,;\t]", lines[start])
    joined = (separator[0] if separator else " ").join(labels)
    body = []
    for number, line in enumerate(lines[start:], start=start + 1):
        if line.strip() and _LABEL.findall(line) != labels:
            raise DataError(f"{path}, line {number} is not labeled {', '.join(labels)} like those before it")
        body.append(_LABEL.sub("", line))
    # the header takes the place of what stood before the first full line, so that lines keep their numbers
    return [*[""] * (start - 1), joined, *body], (*notes, "every value had its label before it")


def read_csv(
    path: Any,
    names: Sequence[str],
    *,
    delimiter: str | None = None,
    decimal: str | None = None,
    header: Sequence[str] | None = None,
) -> Columns:
    """Named columns of a text file.

    Parameters
    ----------
    path : str or path
        Text file in UTF-8, in UTF-16 with its mark, or else in Windows-1252 (which holds Latin-1).
    names : sequence of str
        Columns to read; the others are not looked at.
    delimiter, decimal, header
        As in `Measurement.from_csv`.

    Returns
    -------
    Columns
        One array of shape (N,) per name, its units, and what was taken for what; times of a clock
        or calendar are in seconds from the first.

    Raises
    ------
    DataError
        As in `Measurement.from_csv`.
    """
    if delimiter is not None and len(as_text(delimiter, "delimiter")) != 1:
        raise ct.ControlArgument(f"delimiter must be one character, not {shown(delimiter)}")
    if delimiter is not None and delimiter in '"\r\n':
        raise ct.ControlArgument(f"delimiter must be one character such as ';', not {delimiter!r}")
    if decimal is not None:
        as_choice(decimal, "decimal", (".", ","))
    if header is not None:
        header = as_texts(header, "header")
    text, notes = _text(path)
    lines = text.splitlines()
    del text  # the lines weigh three times as much
    lines, more = unwrapped(lines, names, path)
    layout = find_layout(lines, names, str(path), delimiter, decimal, header)
    body = lines[layout.first :]
    while body and not body[-1].strip(f'" {layout.delimiter}'):
        body.pop()
    if not body:
        raise DataError(f"{path} has a header but no data lines")
    here = f"{path}, line"
    first = layout.cells_of(body[0])
    clocks = {name: layout.places[name] for name, cell in first.items() if is_clock_time(cell)}
    read = {}
    for name, place in clocks.items():
        read[name], how = _by_clock(body, layout, here, name, place)
        more = (*more, f"{name!r} holds times of {how}")
    layout = replace(layout, places={k: v for k, v in layout.places.items() if k not in clocks})
    if layout.places:
        table = _by_numpy(body, layout)
        if table is None:
            table = np.array(list(_by_line(body, layout, here))).T.copy()
        read |= dict(zip(layout.places, table, strict=True))
    said = f"{Path(path).name}: " + "; ".join((layout.text, *notes, *more))
    return Columns({name: read[name] for name in names}, layout.units, (said,))


def _text(path: Any) -> tuple[str, tuple[str, ...]]:
    """The file, and how it was decoded where that is not plain."""
    raw = Path(path).read_bytes()
    try:
        if raw[:2] in (b"\xff\xfe", b"\xfe\xff"):
            return raw.decode("utf-16"), ("read as UTF-16",)
        if b"\0" in raw:
            raise DataError(f"{path} is not a text file in UTF-8 or Latin-1 (it holds zero bytes)")
        return raw.decode("utf-8-sig"), ()
    except UnicodeDecodeError as error:
        try:
            return raw.decode("cp1252"), ("read as Latin-1 (Windows-1252), for it is not UTF-8",)
        except UnicodeDecodeError:
            raise DataError(f"{path} is not a text file in UTF-8 or Latin-1: {error}") from error


def _by_numpy(body: list[str], layout: Layout) -> Array | None:
    """Read the requested columns with NumPy.

    None if a line is not plain. The other parser then reads it, or names the wrong line.
    """
    delimiter, columns = layout.delimiter, list(layout.places.values())
    comma = layout.decimal == ","
    if comma and delimiter == ",":
        return None
    if comma:  # a point in the midst of decimal commas must not pass for one
        marks = {ord(","): ".", ord("."): "_"}
        body = [line.translate(marks) for line in body]
    try:
        if any('"' in line for line in body):
            widths = [len(row) for row in csv.reader(body, delimiter=delimiter)]
            if len(widths) != len(body) or max(widths) > layout.width:
                return None
        elif delimiter == " ":
            if max(len(line.split()) for line in body) > layout.width:
                return None
        elif max(map(methodcaller("count", delimiter), body)) >= layout.width:
            return None
        table = np.loadtxt(
            body, delimiter=None if delimiter == " " else delimiter, usecols=columns, comments=None,
            quotechar='"', ndmin=2,
        )  # fmt: skip
    except (ValueError, csv.Error):
        return None
    whole = len(table) == len(body) and np.isfinite(table).all()
    return np.ascontiguousarray(table.T) if whole else None


def _by_clock(body: list[str], layout: Layout, here: str, name: str, place: int) -> tuple[Array, str]:
    """Seconds of a column of times of a clock, and how they were read."""
    cells, places = [], []
    for line, row in rows_of(body, layout.delimiter, here, layout.first):
        cells.append(row[place].strip() if place < len(row) else "")
        places.append(f"{here} {line}, column {name!r} ({place + 1})")
    return seconds_of(cells, places)


def _by_line(body: list[str], layout: Layout, here: str) -> Iterator[list[float]]:
    """Yield the numbers of the requested columns, line by line.

    An error describes the first line that is wrong.
    """
    for line, row in rows_of(body, layout.delimiter, here, layout.first):
        if not any(cell.strip() for cell in row):
            raise DataError(f"{here} {line} is empty in the midst of the data; remove it or fill the gap")
        if any(cell.strip() for cell in row[layout.width :]):
            hint = " (decimal commas between commas cannot be told apart)" if layout.delimiter == "," else ""
            raise DataError(
                f"{here} {line} has {len(row)} cells and the header {layout.width}{hint}; remove a "
                "delimiter, or name every column"
            )
        yield [
            _number(
                row[index].strip() if index < len(row) else "",
                f"{here} {line}, column {name!r} ({index + 1})",
                layout.decimal,
            )
            for name, index in layout.places.items()
        ]


def _number(cell: str, place: str, decimal: str) -> float:
    if cell == "":
        raise DataError(f"{place} is missing; fill the gap or cut the file before it")
    other = "." if decimal == "," else ","
    try:
        if "_" in cell or other in cell:  # Python would take the first as a separator of digits
            raise ValueError
        return float(cell.replace(decimal, "."))
    except ValueError:
        hint = ""
        if other in cell:
            hint = f" (the decimal mark of this file is {decimal!r}; another one is given by decimal=)"
        raise DataError(f"{place} is not a number: {cell!r}{hint}") from None
