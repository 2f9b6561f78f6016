"""Columns out of CSV files, MATLAB files, NumPy files and data frames, for `Measurement`."""

from __future__ import annotations

import csv
import zipfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import control as ct
import numpy as np

from .exceptions import DataError, MissingExtraError
from .systems.linear import Array

__all__ = [
    "names_of",
    "read_csv",
    "read_frame",
    "read_mat",
    "read_npz",
    "variables_of_mat",
    "variables_of_npz",
]

_DELIMITERS = ",;\t|"


def names_of(values: str | Sequence[str], what: str) -> list[str]:
    """List of column names from one name or several."""
    names = [values] if isinstance(values, str) else list(values)
    if not names:
        raise DataError(f"{what} names no column; give at least one")
    for name in names:
        if not isinstance(name, str):
            raise ct.ControlArgument(f"{what} must be column names, not {name!r}")
    return names


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
        unreadable cell (line and column are named), no data lines.
    """
    try:
        lines = Path(path).read_text(encoding="utf-8-sig").splitlines()
    except UnicodeDecodeError as error:
        raise DataError(f"{path} is not a text file in UTF-8: {error}") from error
    start = _header_line(lines, names)
    if start is None:
        raise DataError(f"{path} holds no header line with the names of the columns")
    head = lines[start].lstrip("#% ")
    split_at = _sniff(head, names) if delimiter is None else delimiter
    reader = _rows([head, *lines[start + 1 :]], split_at)
    header = [cell.strip() for cell in next(reader)[1]]
    _require(names, header, f"{path}, line {start + 1}")
    where = {name: header.index(name) for name in names}
    columns: dict[str, list[float]] = {name: [] for name in names}
    blank: int | None = None
    for number, row in reader:
        line = number + start
        if not any(cell.strip() for cell in row):
            blank = line if blank is None else blank
            continue
        if blank is not None:
            raise DataError(
                f"{path}, line {blank} is empty in the midst of the data; remove it or fill the gap"
            )
        for name, index in where.items():
            cell = row[index].strip() if index < len(row) else ""
            columns[name].append(
                _number(cell, f"{path}, line {line}, column {name!r} ({index + 1})", split_at)
            )
    if not columns[names[0]]:
        raise DataError(f"{path} has a header but no data lines")
    return {name: np.array(values) for name, values in columns.items()}


def _header_line(lines: list[str], names: Sequence[str]) -> int | None:
    """First line that is no comment, or a comment that holds the names (as numpy.savetxt writes it)."""
    for index, line in enumerate(lines):
        comment = line.lstrip().startswith(("#", "%"))
        if line.strip() and (not comment or all(name in line for name in names)):
            return index
    return None


def _sniff(header: str, names: Sequence[str]) -> str:
    """Delimiter that finds most of the names; ties go to the one that splits most."""

    def score(delimiter: str) -> tuple[int, int]:
        cells = [cell.strip() for cell in next(_rows([header], delimiter))[1]]
        return sum(name in cells for name in names), len(cells)

    best: str = max([*_DELIMITERS, " "], key=score)
    return best


def _rows(lines: list[str], delimiter: str) -> Any:
    """Pairs of line number (from 1) and cells."""
    reader = csv.reader(lines, delimiter=delimiter, skipinitialspace=True)
    for row in reader:
        yield reader.line_num, row


def _number(cell: str, place: str, delimiter: str) -> float:
    if cell == "":
        raise DataError(f"{place} is missing; fill the gap or cut the file before it")
    try:
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
    return _vectors(path, variables_of_mat(path), names)


def variables_of_mat(path: Any) -> dict[str, Any]:
    """All variables of a MATLAB file, by name.

    Raises
    ------
    DataError
        If scipy cannot read the file; for version 7.3 the message says what to do.
    """
    from scipy.io import loadmat
    from scipy.io.matlab import MatReadError

    Path(path).open("rb").close()  # loadmat would look for path + ".mat" instead of saying that it is missing
    try:
        content = loadmat(str(path), appendmat=False)
    except NotImplementedError as error:
        raise DataError(
            f"{path} is a MATLAB 7.3 (HDF5) file; save it anew in MATLAB with save(..., '-v7'), "
            "or read it with h5py and pass the arrays to Measurement"
        ) from error
    except (ValueError, MatReadError) as error:
        raise DataError(f"{path} is not a MATLAB file that scipy can read: {error}") from error
    return {key: value for key, value in content.items() if not key.startswith("__")}


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
    return _vectors(path, variables_of_npz(path), names)


def variables_of_npz(path: Any) -> dict[str, Any]:
    """All arrays of a file of `numpy.savez`, by name.

    Raises
    ------
    DataError
        If it is another kind of file, or holds Python objects.
    """
    try:
        content = np.load(path, allow_pickle=False)
        arrays = dict(content.items()) if isinstance(content, np.lib.npyio.NpzFile) else None
    except (ValueError, EOFError, zipfile.BadZipFile) as error:
        raise DataError(f"{path} is not a file of named arrays as numpy.savez writes it: {error}") from error
    if arrays is None:
        raise DataError(f"{path} holds one array without a name; save named arrays with numpy.savez")
    content.close()
    return arrays


def _vectors(path: Any, variables: dict[str, Any], names: Sequence[str]) -> dict[str, Array]:
    """Variables as 1-D arrays of numbers."""
    listed = ", ".join(f"{key} {_shape(value)}" for key, value in variables.items()) or "none"
    columns = {}
    for name in names:
        value = _variable(variables, name)
        if value is None:
            raise DataError(f"{path} has no variable {name!r}; there are: {listed}")
        array = np.asarray(value)
        if array.dtype.kind not in "fiubc" or array.ndim > 2 or (array.ndim == 2 and 1 not in array.shape):
            raise DataError(
                f"{path}: variable {name!r} is {_shape(value)}, not a vector of numbers; there are: {listed}"
            )
        columns[name] = array.ravel()
    return columns


def _variable(variables: dict[str, Any], name: str) -> Any:
    """Variable, or the field of a 1 x 1 structure by its dotted name."""
    if name in variables:
        return variables[name]
    head, *fields = name.split(".")
    value = variables.get(head)
    for field in fields:
        if value is None or value.dtype.names is None or field not in value.dtype.names or value.size != 1:
            return None
        value = value.ravel()[0][field]
    return value


def _shape(value: Any) -> str:
    array = np.asarray(value)
    if array.dtype.names is not None:
        return f"structure with fields {', '.join(array.dtype.names)}"
    return " x ".join(map(str, array.shape)) + ("" if array.dtype.kind in "fiub" else f" {array.dtype}")


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
        frame = pd.DataFrame(frame)
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
