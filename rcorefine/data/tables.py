"""Columns of numbers from text tables, with units, and from data frames.

Header, separator, decimal mark and units are found from the text; NumPy parses the numbers.
"""

from __future__ import annotations

import csv
import re
from collections.abc import Iterator, Sequence
from itertools import filterfalse, islice
from pathlib import Path
from typing import Any, NamedTuple

import control as ct
import numpy as np

from ..arguments import as_choice, as_text, as_texts, shown
from ..exceptions import DataError, needed
from ..systems.linear import Array
from .formats import FileColumns
from .signals import is_clock_time, seconds_of

_PREFIXED = (
    "m", "s", "g", "N", "V", "A", "W", "J", "Pa", "K", "C", "Hz", "rad", "F", "H", "T", "Wb", "l", "L", "bar",
    "Ohm", "ohm", "Ω", "Nm", "VA", "Wh", "eV", "mol", "lx", "cd", "S", "gn",
)  # fmt: skip
_ALONE = (
    "°", "%", "‰", "°C", "°F", "degC", "degF", "deg", "rpm", "rps", "min", "h", "d", "psi", "in", "inch",
    "ft", "lb", "lbf", "kgf", "mph", "kph", "kn", "rev", "cnt", "cnts", "count", "counts", "ticks", "steps",
    "px", "dB", "sec", "secs", "seconds", "hr", "grad", "ppm", "Volt", "Volts", "volts", "Amp", "Amps",
    "Newton",
)  # fmt: skip
_KNOWN = frozenset(_ALONE) | {
    prefix + base for base in _PREFIXED for prefix in ("", *"kMGmuµμnpcd", "da", "h")
}
_SECONDS = {
    "s": 1.0, "sec": 1.0, "secs": 1.0, "seconds": 1.0, "ms": 1e-3, "us": 1e-6, "µs": 1e-6, "μs": 1e-6,
    "ns": 1e-9, "min": 60.0, "h": 3600.0, "hr": 3600.0,
}  # fmt: skip
_KNOWN |= {write(unit) for unit in _SECONDS for write in (str.upper, str.capitalize)}
_BRACKETS = re.compile(r"(.*\S)\s*[\[(]([^\[\]()]+)[\])]|(.*\S) / (\S+)")


def is_unit(text: str) -> bool:
    """Return whether a text consists of unit symbols.

    Brackets around the text are allowed.

    Examples
    --------
    >>> [is_unit(text) for text in ("m/s^2", "[N m]", "°C", "-", "off", "n/a", "1")]
    [True, True, True, True, False, False, False]
    """
    text = re.sub("[²³⁻·]", " ", _bare(text))
    symbols = re.findall(r"°?[^\W\d_]+|[°%‰]", text)
    rest = re.sub(r"°?[^\W\d_]+|[°%‰]", "", text)
    if not symbols:
        return text == "-"
    return all(symbol in _KNOWN for symbol in symbols) and not re.search(r"[^\s/*.^\d()-]", rest)


def _bare(text: str) -> str:
    text = text.strip()
    return text[1:-1].strip() if text[:1] + text[-1:] in ("[]", "()", "<>", "{}") else text


def split_unit(cell: str) -> tuple[str, str]:
    """Split a header cell into name and unit.

    The unit is empty if there is none.

    Examples
    --------
    >>> split_unit("F [N]"), split_unit("speed / rpm"), split_unit("q(1)")
    (('F', 'N'), ('speed', 'rpm'), ('q(1)', ''))
    """
    found = _BRACKETS.fullmatch(cell)
    if found:
        name, unit = (found[1], found[2]) if found[1] is not None else (found[3], found[4])
        if is_unit(unit):
            return name, _bare(unit)
    return (cell, "") if not is_unit(cell) or cell[:1] not in "[(<{" else ("", _bare(cell))


def seconds_per(unit: str, column: str) -> float:
    """Seconds in a unit of time, in small letters or large.

    Raises
    ------
    DataError
        If it is no unit of time that is known.
    """
    known = unit if unit == "Ms" else unit.lower()  # that may be megaseconds or milliseconds
    if known not in _SECONDS:
        raise DataError(
            f"column {column!r} of times is in {unit!r}, not in one of {', '.join(_SECONDS)}; give dt in s "
            "instead of time="
        )
    return _SECONDS[known]


_DELIMITERS = ",;\t| "
_WORDS = {",": "comma", ";": "semicolon", "\t": "tab", "|": "bar", " ": "blanks", ".": "point"}
_NUMBER = re.compile(r"[+-]?(\d+[.,]?\d*|[.,]\d+)([eE][+-]?\d+)?|[+-]?(nan|inf|infinity)", re.IGNORECASE)
_THOUSANDS = re.compile(r"[+-]?[1-9]\d{0,2}(,\d{3})+")
_WITH_COMMA = re.compile(rf"[+-]?\d*,\d*([eE][+-]?\d+)?|{_THOUSANDS.pattern}")
_LOOK = 1000  # lines whose decimal marks are looked at


class _Layout(NamedTuple):
    """Position of the numbers in a text table.

    Columns and units are given by name.
    """

    places: dict[str, int]
    width: int
    units: dict[str, str]
    first: int
    delimiter: str
    decimal: str
    text: str


def read_csv(
    path: Any,
    names: Sequence[str],
    *,
    delimiter: str | None = None,
    decimal: str | None = None,
    header: Sequence[str] | None = None,
    blank: Sequence[str] = (),
) -> FileColumns:
    """Named columns of a text file.

    Parameters
    ----------
    path : str or path
        Text file in UTF-8, in UTF-16 with its mark, or else in Windows-1252 (which holds Latin-1).
    names : sequence of str
        Columns to read; the others are not looked at.
    delimiter, decimal, header
        As in `Measurement.from_csv`.
    blank : sequence of str
        Columns whose empty cells are NaN.

    Returns
    -------
    Columns
        One array of shape (N,) per name, its units, and what was taken for what; times of a clock
        are in seconds from the first.

    Raises
    ------
    DataError
        As in `Measurement.from_csv`.
    """
    if delimiter is not None and (len(as_text(delimiter, "delimiter")) != 1 or delimiter in '"\r\n'):
        raise ct.ControlArgument(f"delimiter must be one character such as ';', not {shown(delimiter)}")
    if decimal is not None:
        as_choice(decimal, "decimal", (".", ","))
    if header is not None:
        header = as_texts(header, "header")
    text, notes = _text(path)
    lines = text.splitlines()
    del text  # the lines weigh three times as much
    layout = _find_layout(lines, names, str(path), delimiter, decimal, header)
    body = lines[layout.first :]
    while body and not body[-1].strip(f'" {layout.delimiter}'):
        body.pop()
    if not body:
        raise DataError(f"{path} has a header but no data lines")
    here = f"{path}, line"
    clocks, told = _clocks(body, layout, here)
    rest = layout._replace(places={k: place for k, place in layout.places.items() if k not in clocks})
    table = _by_numpy(body, rest) if rest.places else ()
    if table is None:
        table = np.array(list(_by_line(body, rest, here, blank))).T.copy()
    read = clocks | dict(zip(rest.places, table, strict=True))
    said = f"{Path(path).name}: " + "; ".join((layout.text, *notes, *told))
    units = layout.units | dict.fromkeys(clocks, "s")
    return FileColumns({name: read[name] for name in names}, units, (said,))


def _clocks(body: list[str], layout: _Layout, here: str) -> tuple[dict[str, Array], list[str]]:
    """Return the requested columns of a clock in seconds, and notes on them."""
    read, told = {}, []
    cells = _asked(body[0], layout.places, layout.delimiter)
    for (name, place), first in zip(layout.places.items(), cells, strict=True):
        if is_clock_time(first):
            rows = list(_rows_of(body, layout.delimiter, here, layout.first))
            times = [row[place].strip() if place < len(row) else "" for _, row in rows]
            spots = [f"{here} {line}, column {name!r} ({place + 1})" for line, _ in rows]
            read[name], how = seconds_of(times, spots)
            told.append(f"{name!r} holds times of {how}")
    return read, told


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


def _cells(line: str, delimiter: str) -> list[str]:
    """Cells of one line, without the blanks around them."""
    try:
        row = next(csv.reader([line], delimiter=delimiter, skipinitialspace=True), [])
    except csv.Error:
        return []
    return [cell.strip() for cell in row]


def _asked(line: str, places: dict[str, int], split_at: str) -> list[str]:
    row = _cells(line, split_at)
    return [row[place] if place < len(row) else "" for place in places.values()]


def _is_value(cell: str) -> bool:
    return _NUMBER.fullmatch(cell) is not None or is_clock_time(cell)


def _rows_of(lines: list[str], delimiter: str, here: str, start: int) -> Iterator[tuple[int, list[str]]]:
    """Yield the line number in the file and the cells of each line.

    A quote that is left open is refused, because it would swallow lines.
    """
    reader = csv.reader([*lines, ""], delimiter=delimiter, skipinitialspace=True)
    try:
        for number, row in enumerate(reader, start=1):
            if reader.line_num != number:
                raise DataError(
                    f"{here} {start + number}: a quote opens a cell that does not close in this line; "
                    "close it or remove it"
                )
            if number <= len(lines):
                yield start + number, row
    except csv.Error as error:
        raise DataError(f"{here} {start + reader.line_num} cannot be read: {error}") from error


def _find_layout(
    lines: list[str],
    names: Sequence[str],
    here: str,
    delimiter: str | None,
    decimal: str | None,
    header: Sequence[str] | None,
) -> _Layout:
    """Find the layout of a text table that has the requested columns.

    Raises
    ------
    DataError
        No header, no such column, or more than one way to read the file.
    """
    if header is None:
        start, split_at = _header_line(lines, names, here, delimiter)
        _, row = next(_rows_of([lines[start].lstrip("#% ")], split_at, f"{here}, line", start))
        cells = [cell.strip() for cell in row]
        places = _places(names, cells, f"{here}, line {start + 1}")
        where, first = f"header in line {start + 1}", start + 1
    else:
        cells = list(header)
        places = _places(names, cells, f"header= for {here}")
        first, split_at = _first_numbers(lines, cells, places, here, delimiter)
        where = f"names by header=, {first} lines skipped" if first else "names by header="
    units = {name: unit for name, place in places.items() if (unit := split_unit(cells[place])[1])}
    below, units_line = _below(lines, first, places, split_at)
    if units_line is not None:
        for name, cell in zip(places, _asked(lines[units_line], places, split_at), strict=True):
            if cell not in ("", "-"):
                units[name] = split_unit(cell if cell[:1] in "[(<{" else f"[{cell}]")[1]
    first = len(lines) if below is None else below
    mark = decimal or _decimal(lines[first:], places, split_at, here)
    said = "no line of units" if units_line is None else f"units in line {units_line + 1}"
    text = (
        f"{where}, {said}, cells separated by {_WORDS.get(split_at, repr(split_at))}, decimal {_WORDS[mark]}"
    )
    return _Layout(places, len(cells), units, first, split_at, mark, text)


def _header_line(lines: list[str], names: Sequence[str], here: str, delimiter: str | None) -> tuple[int, str]:
    """Find the header line with all names, and its separator.

    Numbers must follow it. If no line qualifies, the likeliest one is taken.
    """
    likeliest = (0, 0, 0, "")
    for index, line in enumerate(lines):
        if not line.strip() or (index >= 200 and not all(name in line for name in names)):
            continue
        found = {}
        for split_at in delimiter or _DELIMITERS:
            cells, named, numbers = _cut(lines, index, names, split_at)
            comment = line.lstrip().startswith(("#", "%")) and named < len(names)
            likeliest = max(likeliest, (0 if comment else named + 1, -index, cells, split_at))
            if numbers:
                found[split_at] = cells
        if len(set(found.values())) > 1:
            marks = " and ".join(_WORDS.get(mark, repr(mark)) for mark in found)
            raise DataError(
                f"{here}, line {index + 1} can be cut at {marks} alike, with other numbers; give delimiter="
            )
        if found:
            return index, next(iter(found))
    if likeliest[0] == 0:
        raise DataError(
            f"{here} holds no header line with the names of the columns; if it has none, name them all "
            "with header="
        )
    return -likeliest[1], likeliest[3]


def _cut(lines: list[str], index: int, names: Sequence[str], split_at: str) -> tuple[int, int, bool]:
    """Return how many cells and how many of the names a line has.

    The third value says whether it has all names and numbers follow below them.
    """
    cells = _cells(lines[index].lstrip("#% "), split_at)
    bare = [split_unit(cell)[0] for cell in cells]
    places = {name: (cells if name in cells else bare).index(name) for name in names if name in cells + bare}
    first = _below(lines, index + 1, places, split_at)[0] if len(places) == len(names) else None
    numbers = first is not None and all(map(_is_value, _asked(lines[first], places, split_at)))
    return len(cells), len(places), numbers


def _below(
    lines: list[str], start: int, places: dict[str, int], split_at: str
) -> tuple[int | None, int | None]:
    """Return the first line of a table, and the line of units before it.

    Either is None if there is no such line from `start` on.
    """
    filled = [k for k in range(start, min(start + 12, len(lines))) if lines[k].strip()]
    if filled:
        cells = _asked(lines[filled[0]], places, split_at)
        if any(cell not in ("", "-") for cell in cells) and all(not cell or is_unit(cell) for cell in cells):
            return (filled[1] if filled[1:] else None), filled[0]
    return (filled[0] if filled else None), None


def _first_numbers(
    lines: list[str], cells: list[str], places: dict[str, int], here: str, delimiter: str | None
) -> tuple[int, str]:
    """Find the first line of numbers, and its separator.

    It has as many cells as there are names, and numbers in the requested columns.
    """
    for index, line in enumerate(lines):
        for split_at in delimiter or _DELIMITERS:
            row = _cells(line, split_at)
            if len(row) == len(cells) and all(_is_value(row[place]) for place in places.values()):
                return index, split_at
    raise DataError(f"{here} has no line of {len(cells)} cells, as header= names, with numbers in them")


def _places(names: Sequence[str], cells: list[str], where: str) -> dict[str, int]:
    """Column of each name: as it stands there, or without its unit."""
    bare = [split_unit(cell)[0] for cell in cells]
    places = {}
    for name in names:
        if cells.count(name) > 1:
            raise DataError(f"{where}: column {name!r} stands there twice; rename one")
        found = [k for k, cell in enumerate(cells if name in cells else bare) if cell == name]
        if len(found) > 1:
            listed = " or ".join(repr(cells[k]) for k in found)
            raise DataError(f"{where}: column {name!r} could be {listed}; name one of them in full")
        if not found:
            listed = ", ".join(repr(cell) for cell in cells if cell)
            raise DataError(f"{where}: no column {name!r}; there are {listed or 'none'}")
        places[name] = found[0]
    return places


def _decimal(lines: list[str], places: dict[str, int], split_at: str, here: str) -> str:
    """Decimal mark of the columns asked for."""
    sign = '"' if split_at == "," else ","  # between commas, only a quoted number may hold one
    some = islice((line for line in lines if sign in line), _LOOK)  # the first may stand far below
    cells = [cell for line in some for cell in _asked(line, places, split_at)]
    commas = list(filter(_WITH_COMMA.fullmatch, cells))
    if not commas:
        return "."
    pointed = [cell for cell in filter(_NUMBER.fullmatch, cells) if "." in cell]
    if pointed:
        raise DataError(
            f"{here} holds {commas[0]!r} and {pointed[0]!r}: comma and point cannot both be the decimal "
            "mark; give decimal=',' or decimal='.', and write no separators of thousands"
        )
    others = filterfalse(_THOUSANDS.fullmatch, cells)
    if not any("," in cell or len(cell.lstrip("+-")) > 3 for cell in others):
        raise DataError(
            f"{here} holds {commas[0]!r}, which may have a decimal comma or a separator of thousands, and "
            "nothing in the file tells which; give decimal=',' or write the numbers without separators"
        )
    return ","


def _by_numpy(body: list[str], layout: _Layout) -> Array | None:
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
        if _widest(body, delimiter) > layout.width:
            return None
        table = np.loadtxt(
            body, delimiter=None if delimiter == " " else delimiter, usecols=columns, comments=None,
            quotechar='"', ndmin=2,
        )  # fmt: skip
    except (ValueError, csv.Error):
        return None
    whole = len(table) == len(body) and np.isfinite(table).all()
    return np.ascontiguousarray(table.T) if whole else None


def _widest(body: list[str], delimiter: str) -> float:
    """Return the largest number of cells of a line.

    It is infinite where quotes hold the end of a line.
    """
    if any('"' in line for line in body):
        widths = [len(row) for row in csv.reader(body, delimiter=delimiter)]
        return max(widths) if len(widths) == len(body) else float("inf")
    if delimiter == " ":
        return max(len(line.split()) for line in body)
    return max(line.count(delimiter) for line in body) + 1


def _by_line(body: list[str], layout: _Layout, here: str, blank: Sequence[str]) -> Iterator[list[float]]:
    """Yield the numbers of the requested columns, line by line.

    An error describes the first line that is wrong.
    """
    for line, row in _rows_of(body, layout.delimiter, here, layout.first):
        if not any(cell.strip() for cell in row):
            raise DataError(f"{here} {line} is empty in the midst of the data; remove it or fill the gap")
        if any(cell.strip() for cell in row[layout.width :]):
            hint = " (decimal commas between commas cannot be told apart)" if layout.delimiter == "," else ""
            raise DataError(
                f"{here} {line} has {len(row)} cells and the header {layout.width}{hint}; remove a "
                "delimiter, or name every column"
            )
        row += [""] * layout.width
        yield [
            _number(row[index].strip(), f"{here} {line}, column {name!r} ({index + 1})", layout.decimal)
            if row[index].strip() or name not in blank
            else np.nan
            for name, index in layout.places.items()
        ]


def _number(cell: str, place: str, decimal: str) -> float:
    if cell == "":
        raise DataError(
            f"{place} is missing; fill the gap, cut the file before it, or, in an output, leave such samples "
            "out with missing='hold-out'"
        )
    other = "." if decimal == "," else ","
    if _NUMBER.fullmatch(cell) and other not in cell:
        return float(cell.replace(decimal, "."))
    hint = ""
    if ":" in cell:
        hint = "; convert dates that are not like 2024-03-31 10:15:30.25 with pandas, then use from_frame"
    elif other in cell:
        hint = f" (the decimal mark of this file is {decimal!r}; another one is given by decimal=)"
    raise DataError(f"{place} is not a number: {cell!r}{hint}")


def read_frame(frame: Any, names: Sequence[str], blank: Sequence[str] = ()) -> FileColumns:
    """Read named columns of a data frame.

    A data frame is one of pandas, or any object with columns and to_numpy. In columns that `blank` names
    a value may be missing; it is NaN.

    Raises
    ------
    MissingExtraError
        If `frame` is no data frame and pandas is not installed.
    DataError
        If a column is not there or holds missing values.
    """
    if not hasattr(frame, "columns"):
        pd = needed("pandas", "pandas", "from_frame, where it is handed no data frame,")
        if not isinstance(frame, (dict, pd.Series)):
            raise ct.ControlArgument(
                f"from_frame takes a pandas.DataFrame (or a dict of columns), not {type(frame).__name__}"
            )
        try:
            frame = pd.DataFrame(frame)
        except (ValueError, TypeError) as error:
            raise ct.ControlDimension(f"the columns of the frame do not fit together: {error}") from error
    columns = {}
    for name, at in _places(names, _column_names(frame), "the data frame").items():
        column = frame.iloc[:, at] if hasattr(frame, "iloc") else frame[frame.columns[at]]
        missing = np.asarray(column.isna()) if hasattr(column, "isna") else np.zeros(len(column), dtype=bool)
        if missing.any() and name not in blank:
            raise DataError(
                f"column {name!r} is missing at row {int(np.argmax(missing))} of the data frame "
                f"({int(missing.sum())} rows); fill the gaps or drop a stretch (missing='hold-out' leaves "
                "them out in outputs)"
            )
        columns[name] = column.to_numpy(float, na_value=np.nan) if missing.any() else column.to_numpy()
    return FileColumns(columns)


def _column_names(frame: Any) -> list[str]:
    """Return the names of columns as texts.

    A column with several levels, of which one has a name, has that name. Otherwise it has the text of all:
    ``"('motor', 'u')"``.
    """
    names = []
    for column in frame.columns:
        levels = [str(one) for one in column if str(one)] if isinstance(column, tuple) else []
        names.append(levels[0] if len(levels) == 1 else str(column))
    return names
