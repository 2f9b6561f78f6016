"""Columns out of CSV files, MATLAB files, NumPy files and data frames, for `Measurement`."""

from __future__ import annotations

import csv
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import control as ct
import numpy as np

from ..archives import read_archive
from ..arguments import as_choice, as_number, as_text, as_texts
from ..exceptions import DataError, MissingExtraError
from ..systems.linear import Array
from .matlab import Other, read_matlab
from .signals import HOLDS

__all__ = ["names_of", "read_csv", "read_frame", "read_mat", "read_npz", "wanted_columns"]

_DELIMITERS = ",;\t|"


def names_of(values: str | Sequence[str], what: str) -> list[str]:
    """List of column names from one name or several."""
    names = as_texts(values, f"{what} (column names)")
    if not names:
        raise DataError(f"{what} names no column; give at least one")
    for name in names:
        if names.count(name) > 1:
            raise DataError(f"{what} must be unique, but names {name!r} twice")
    return list(names)


def wanted_columns(
    inputs: str | Sequence[str],
    outputs: str | Sequence[str],
    time: str | None,
    dt: float | None,
    options: Mapping[str, Any],
) -> list[str]:
    """Names of all columns to read, each once; what else was given is checked before a file is opened."""
    if dt is not None:
        as_number(dt, "dt", above=0.0, what="a time in seconds", error=DataError)
    if options.get("name") is not None:
        as_text(options["name"], "name", empty=False)
    if "hold" in options:
        as_choice(options["hold"], "hold", HOLDS)
    for key in ("input_labels", "output_labels"):
        if options.get(key) is not None:
            names_of(options[key], key)
    for key in ("input_units", "output_units"):
        if options.get(key) is not None:
            as_texts(options[key], key)
    times = () if time is None else (as_text(time, "time"),)
    return list(dict.fromkeys((*names_of(inputs, "inputs"), *names_of(outputs, "outputs"), *times)))


def read_csv(path: Any, names: Sequence[str], *, delimiter: str | None = None) -> dict[str, Array]:
    """Named columns of a CSV file with a header line.

    Parameters
    ----------
    path : str or path
        Text file in UTF-8 (a byte order mark is accepted).
    names : sequence of str
        Columns to read; the others are not looked at.
    delimiter : str, optional
        Default: the one of comma, semicolon, tab, bar (or blanks) that
        splits the header into the names asked for.

    Returns
    -------
    dict of ndarray
        One array of shape (N,) per name.

    Raises
    ------
    DataError
        A column that is not there (those that are, are listed), a missing or
        unreadable cell (line and column are named), a quote that its line does
        not close, a line with more cells than the header, no data lines.
    """
    if delimiter is not None and (
        not isinstance(delimiter, str) or len(delimiter) != 1 or delimiter in '"\r\n'
    ):
        raise ct.ControlArgument(f"delimiter must be one character such as ';', not {delimiter!r}")
    try:
        lines = Path(path).read_text(encoding="utf-8-sig").splitlines()
    except UnicodeDecodeError as error:
        raise DataError(f"{path} is not a text file in UTF-8: {error}") from error
    start = _header_line(lines, names)
    if start is None:
        raise DataError(f"{path} holds no header line with the names of the columns")
    head = lines[start].lstrip("#% ")
    here = f"{path}, line"
    split_at = _sniff(head, names, here, start) if delimiter is None else delimiter
    reader = _rows([head, *lines[start + 1 :]], split_at, here, start)
    header = [cell.strip() for cell in next(reader)[1]]
    _require(names, header, f"{here} {start + 1}")
    found = list(_table(reader, header, names, here, split_at))
    if not found:
        raise DataError(f"{path} has a header but no data lines")
    return dict(zip(names, np.array(found).T.copy(), strict=True))


def _table(
    reader: Iterator[tuple[int, list[str]]], header: list[str], names: Sequence[str], here: str, split_at: str
) -> Iterator[list[float]]:
    """Numbers of the named columns, line by line."""
    where = [(name, header.index(name)) for name in names]
    blank: int | None = None
    for line, row in reader:
        if not any(cell.strip() for cell in row):
            blank = line if blank is None else blank
            continue
        if blank is not None:
            raise DataError(f"{here} {blank} is empty in the midst of the data; remove it or fill the gap")
        if any(row[len(header) :]):
            raise DataError(
                f"{here} {line} has {len(row)} cells and the header {len(header)}; remove a delimiter, or "
                "name every column"
            )
        yield [
            _number(
                row[index].strip() if index < len(row) else "",
                f"{here} {line}, column {name!r} ({index + 1})",
                split_at,
            )
            for name, index in where
        ]


def _header_line(lines: list[str], names: Sequence[str]) -> int | None:
    """First line that is no comment, or a comment that holds the names (as numpy.savetxt writes it)."""
    for index, line in enumerate(lines):
        comment = line.lstrip().startswith(("#", "%"))
        if line.strip() and (not comment or all(name in line for name in names)):
            return index
    return None


def _sniff(header: str, names: Sequence[str], here: str, start: int) -> str:
    """Delimiter that finds most of the names; ties go to the one that splits most."""

    def score(delimiter: str) -> tuple[int, int]:
        cells = [cell.strip() for cell in next(_rows([header], delimiter, here, start))[1]]
        return sum(name in cells for name in names), len(cells)

    best: str = max([*_DELIMITERS, " "], key=score)
    return best


def _rows(lines: list[str], delimiter: str, here: str, start: int) -> Iterator[tuple[int, list[str]]]:
    """Pairs of line number in the file and cells; a quote that is left open would swallow lines."""
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


def _number(cell: str, place: str, delimiter: str) -> float:
    if cell == "":
        raise DataError(f"{place} is missing; fill the gap or cut the file before it")
    try:
        if "_" in cell:  # which Python would take as a separator of digits
            raise ValueError
        return float(cell)
    except ValueError:
        hint = ""
        if delimiter != "," and cell.count(",") == 1 and cell.replace(",", "").lstrip("+-").isdigit():
            hint = " (a decimal comma? write decimal points)"
        raise DataError(f"{place} is not a number: {cell!r}{hint}") from None


def _require(names: Sequence[str], present: Sequence[str], place: str) -> None:
    for name in names:
        if name not in present:
            listed = ", ".join(repr(p) for p in present if p)
            raise DataError(f"{place}: no column {name!r}; there are {listed or 'none'}")
        if list(present).count(name) > 1:
            raise DataError(f"{place}: column {name!r} stands there twice; rename one")


def read_mat(path: Any, names: Sequence[str]) -> dict[str, Array]:
    """Named variables of a MATLAB file (up to version 7.2), as 1-D arrays.

    Parameters
    ----------
    path : str or path
        File written by MATLAB's `save`.
    names : sequence of str
        Variables of shape (N, 1), (1, N) or (N,); a structure's field as
        "data.voltage".

    Returns
    -------
    dict of ndarray
        One array of shape (N,) per name.

    Raises
    ------
    DataError
        A variable that is not there or not a vector (those that are, are
        listed with their shapes), or a file of version 7.3.
    """
    return _vectors(path, read_matlab(path), names)


def read_npz(path: Any, names: Sequence[str]) -> dict[str, Array]:
    """Named arrays of a file of `numpy.savez`, as 1-D arrays.

    Parameters
    ----------
    path : str or path
        File written by `numpy.savez`.
    names : sequence of str
        Arrays of shape (N,), (N, 1) or (1, N).

    Returns
    -------
    dict of ndarray
        One array of shape (N,) per name.

    Raises
    ------
    DataError
        An array that is not there or not a vector (those that are, are listed
        with their shapes), or another kind of file.
    """
    return _vectors(path, read_archive(path), names)


def _vectors(path: Any, variables: dict[str, Any], names: Sequence[str]) -> dict[str, Array]:
    """Variables as 1-D arrays of numbers."""
    listed = ", ".join(f"{key} {_shape(value)}" for key, value in variables.items()) or "none"
    columns = {}
    for name in names:
        value = _variable(variables, name)
        if value is None:
            raise DataError(f"{path} has no variable {name!r}; there are: {listed}")
        if not _is_vector(value):
            raise DataError(
                f"{path}: variable {name!r} is {_shape(value)}, not a vector of numbers; there are: {listed}"
            )
        columns[name] = value.ravel()
    return columns


def _is_vector(value: Any) -> bool:
    if not isinstance(value, np.ndarray) or value.dtype.kind not in "fiubc":
        return False
    return value.ndim < 2 or (value.ndim == 2 and 1 in value.shape)


def _variable(variables: dict[str, Any], name: str) -> Any:
    """Variable, or the field of a structure by its dotted name."""
    if name in variables:
        return variables[name]
    head, *fields = name.split(".")
    value = variables.get(head)
    for field in fields:
        value = value.get(field) if isinstance(value, dict) else None
    return value


def _shape(value: Any) -> str:
    if isinstance(value, dict):
        return f"structure with fields {', '.join(value)}"
    if isinstance(value, Other):
        return value.kind
    return " x ".join(map(str, value.shape)) + ("" if value.dtype.kind in "fiub" else f" {value.dtype}")


def read_frame(frame: Any, names: Sequence[str]) -> dict[str, Array]:
    """Named columns of a data frame (pandas, or whatever has columns and to_numpy).

    Raises
    ------
    MissingExtraError
        If `frame` is no data frame and pandas is not installed.
    DataError
        If a column is not there or holds missing values.
    """
    if not hasattr(frame, "columns"):
        try:
            import pandas as pd
        except ImportError as error:
            raise MissingExtraError(
                'from_frame needs a data frame; install the extra "pandas": pip install "rcorefine[pandas]"'
            ) from error
        if not isinstance(frame, (dict, pd.Series)):
            raise ct.ControlArgument(
                f"from_frame takes a pandas.DataFrame (or a dict of columns), not {type(frame).__name__}"
            )
        try:
            frame = pd.DataFrame(frame)
        except (ValueError, TypeError) as error:
            raise ct.ControlDimension(f"the columns of the frame do not fit together: {error}") from error
    _require(names, [str(column) for column in frame.columns], "the data frame")
    columns = {}
    for name in names:
        column = frame[name]
        missing = np.asarray(column.isna()) if hasattr(column, "isna") else np.zeros(len(column), dtype=bool)
        if missing.any():
            raise DataError(
                f"column {name!r} is missing at row {int(np.argmax(missing))} of the data frame "
                f"({int(missing.sum())} rows); fill the gaps or drop a stretch"
            )
        columns[name] = column.to_numpy()
    return columns
