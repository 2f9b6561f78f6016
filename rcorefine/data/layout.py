"""Layout of a text table: header, separator, decimal mark, units row."""

from __future__ import annotations

import csv
import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import islice

from ..exceptions import DataError
from .clock_times import is_clock_time
from .units import is_unit, split_unit

__all__ = ["Layout", "find_layout", "rows_of"]

_DELIMITERS = ",;\t| "
_WORDS = {",": "comma", ";": "semicolon", "\t": "tab", "|": "bar", " ": "blanks", ".": "point"}
_NUMBER = re.compile(r"[+-]?(\d+[.,]?\d*|[.,]\d+)([eE][+-]?\d+)?|[+-]?(nan|inf|infinity)", re.IGNORECASE)
_DECIMAL_COMMA = re.compile(r"[+-]?\d*,\d*([eE][+-]?\d+)?")
_THOUSANDS = re.compile(r"[+-]?[1-9]\d{0,2}(,\d{3})+")
_LOOK = 1000  # lines whose decimal marks are looked at


@dataclass(frozen=True, slots=True)
class Layout:
    """Position of the numbers in a text table.

    Parameters
    ----------
    places : dict
        Column of each name.
    width : int
        Number of columns of the header.
    units : dict
        Unit of each name that has one.
    first : int
        Index of the first line behind header and units.
    delimiter, decimal : str
        Separator of cells (a blank: any number of them) and decimal mark.
    header : str
        Where the names come from, in words.
    units_line : int or None
        Number of the line of units.
    """

    places: dict[str, int]
    width: int
    units: dict[str, str]
    first: int
    delimiter: str
    decimal: str
    header: str
    units_line: int | None

    def cells_of(self, line: str) -> dict[str, str]:
        """Return the cells of a line in the requested columns."""
        return dict(zip(self.places, _asked(line, self.places, self.delimiter), strict=True))

    @property
    def text(self) -> str:
        """Description of the layout in one line."""
        units = "no line of units" if self.units_line is None else f"units in line {self.units_line}"
        return (
            f"{self.header}, {units}, cells separated by {_WORDS.get(self.delimiter, repr(self.delimiter))}, "
            f"decimal {_WORDS[self.decimal]}"
        )


def _cells(line: str, delimiter: str) -> list[str]:
    """Cells of one line, without the blanks around them."""
    try:
        row = next(csv.reader([line], delimiter=delimiter, skipinitialspace=True), [])
    except csv.Error:
        return []
    return [cell.strip() for cell in row]


def rows_of(lines: list[str], delimiter: str, here: str, start: int) -> Iterator[tuple[int, list[str]]]:
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


def find_layout(
    lines: list[str],
    names: Sequence[str],
    here: str,
    delimiter: str | None = None,
    decimal: str | None = None,
    header: Sequence[str] | None = None,
) -> Layout:
    """Layout of a text table in which the columns asked for are found.

    Parameters
    ----------
    lines : list of str
        The file.
    names : sequence of str
        Columns asked for: as they stand in the header, or without the unit behind them.
    here : str
        Name of the file, for messages.
    delimiter, decimal : str, optional
        What is known already.
    header : sequence of str, optional
        Names of all columns, of a file that has no header.

    Returns
    -------
    Layout

    Raises
    ------
    DataError
        No header, no such column, or more than one way to read the file.
    """
    if header is None:
        start, split_at = _header_line(lines, names, here, delimiter)
        _, row = next(rows_of([lines[start].lstrip("#% ")], split_at, f"{here}, line", start))
        cells = [cell.strip() for cell in row]
        places = _places(names, cells, f"{here}, line {start + 1}")
        where, first = f"header in line {start + 1}", start + 1
    else:
        cells = list(header)
        places = _places(names, cells, f"header= for {here}")
        first, split_at = _first_numbers(lines, cells, places, here, delimiter)
        where = f"names by header=, {first} lines skipped" if first else "names by header="
    units = {name: unit for name, place in places.items() if (unit := split_unit(cells[place])[1])}
    below = _next(lines, first)
    units_line = None
    if below is not None and _all_units(asked := _asked(lines[below], places, split_at)):
        units |= {
            name: split_unit(f"[{cell}]" if cell[:1] not in "[(<{" else cell)[1]
            for name, cell in zip(places, asked, strict=True)
            if cell not in ("", "-")
        }
        units_line, below = below + 1, _next(lines, below + 1)
    first = len(lines) if below is None else below
    mark = decimal or _decimal(lines[first:], places, split_at, here)
    return Layout(places, len(cells), units, first, split_at, mark, where, units_line)


def _header_line(lines: list[str], names: Sequence[str], here: str, delimiter: str | None) -> tuple[int, str]:
    """Find the header line with all names, and its separator.

    Numbers must follow it. If no line qualifies, the likeliest one is taken.
    """
    likeliest: tuple[int, int, int, str] | None = None
    for index, line in enumerate(lines):
        whole = all(name in line for name in names)
        if not line.strip() or not (whole or index < 200):
            continue
        found = []
        head = line.lstrip("#% ")
        for split_at in _DELIMITERS if delimiter is None else delimiter:
            cells = _cells(head, split_at)
            bare = [split_unit(cell)[0] for cell in cells]
            count = sum(name in cells or name in bare for name in names)
            comment = line.lstrip().startswith(("#", "%")) and count < len(names)
            rank = (0 if comment else count + 1, -index, len(cells), split_at)
            likeliest = rank if likeliest is None or rank > likeliest else likeliest
            if count == len(names) and _numbers_follow(lines, index + 1, names, cells, split_at):
                found.append((split_at, cells))
        if len({len(cells) for _, cells in found}) > 1:
            marks = " and ".join(_WORDS.get(mark, repr(mark)) for mark, _ in found)
            raise DataError(
                f"{here}, line {index + 1} can be cut at {marks} alike, with other numbers; give delimiter="
            )
        if found:
            return index, found[0][0]
    if likeliest is None or likeliest[0] == 0:
        raise DataError(
            f"{here} holds no header line with the names of the columns; if it has none, name them all "
            "with header="
        )
    return -likeliest[1], likeliest[3]


def _numbers_follow(
    lines: list[str], index: int, names: Sequence[str], cells: list[str], split_at: str
) -> bool:
    """Return whether numbers follow in the requested columns.

    They stand in the next line, or in the one after a line of units.
    """
    bare = [split_unit(cell)[0] for cell in cells]
    places = {name: cells.index(name) if name in cells else bare.index(name) for name in names}
    row = _next(lines, index)
    if row is not None and _all_units(_asked(lines[row], places, split_at)):
        row = _next(lines, row + 1)
    return row is not None and all(map(_is_value, _asked(lines[row], places, split_at)))


def _first_numbers(
    lines: list[str], cells: list[str], places: dict[str, int], here: str, delimiter: str | None
) -> tuple[int, str]:
    """Find the first line of numbers, and its separator.

    It has as many cells as there are names, and numbers in the requested columns.
    """
    for index, line in enumerate(lines):
        for split_at in _DELIMITERS if delimiter is None else delimiter:
            row = _cells(line, split_at)
            if len(row) == len(cells) and all(_is_value(row[place]) for place in places.values()):
                return index, split_at
    raise DataError(f"{here} has no line of {len(cells)} cells, as header= names, with numbers in them")


def _is_value(cell: str) -> bool:
    return _NUMBER.fullmatch(cell) is not None or is_clock_time(cell)


def _next(lines: list[str], index: int) -> int | None:
    """First line that is not blank."""
    return next((k for k in range(index, min(index + 10, len(lines))) if lines[k].strip()), None)


def _asked(line: str, places: dict[str, int], split_at: str) -> list[str]:
    row = _cells(line, split_at)
    return [row[place] if place < len(row) else "" for place in places.values()]


def _all_units(cells: list[str]) -> bool:
    return any(cell not in ("", "-") for cell in cells) and all(not cell or is_unit(cell) for cell in cells)


def _places(names: Sequence[str], cells: list[str], where: str) -> dict[str, int]:
    """Column of each name: as it stands there, or without its unit."""
    bare = [split_unit(cell)[0] for cell in cells]
    places = {}
    for name in names:
        found = [k for k, cell in enumerate(cells) if cell == name]
        if len(found) > 1:
            raise DataError(f"{where}: column {name!r} stands there twice; rename one")
        found = found or [k for k, cell in enumerate(bare) if cell == name]
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
    some = list(islice((line for line in lines if sign in line), _LOOK))  # the first may stand far below
    cells = [cell for line in some for cell in _asked(line, places, split_at)]
    commas = [cell for cell in cells if _DECIMAL_COMMA.fullmatch(cell) or _THOUSANDS.fullmatch(cell)]
    if not commas:
        return "."
    pointed = next((cell for cell in cells if "." in cell and _NUMBER.fullmatch(cell)), None)
    if pointed is not None:
        raise DataError(
            f"{here} holds {commas[0]!r} and {pointed!r}: comma and point cannot both be the decimal mark; "
            "give decimal=',' or decimal='.', and write no separators of thousands"
        )
    others = [cell for cell in cells if cell and not _THOUSANDS.fullmatch(cell)]
    if not any("," in cell or len(cell.lstrip("+-")) > 3 for cell in others):
        raise DataError(
            f"{here} holds {commas[0]!r}, which may have a decimal comma or a separator of thousands, and "
            "nothing in the file tells which; give decimal=',' or write the numbers without separators"
        )
    return ","
