"""Columns for `Measurement` from MATLAB, NumPy and data frames."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import control as ct
import numpy as np

from ..archives import read_archive
from ..arguments import as_choice, as_number, as_text, as_texts
from ..exceptions import DataError
from ..extras import needed
from .apart import Other
from .matlab import read_matlab
from .signals import HOLDS

__all__ = ["Columns", "names_of", "read_frame", "read_mat", "read_npz", "vectors", "wanted_columns"]

_OPTIONS = {"hold", "input_labels", "output_labels", "input_units", "output_units", "name", "notes"}


class Columns(NamedTuple):
    """Columns of a file by name, with units and notes.

    The notes list what was assumed in reading.
    """

    values: dict[str, Any]
    units: dict[str, str] = {}  # noqa: RUF012
    notes: tuple[str, ...] = ()


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
    """Return the names of all columns to read, each once.

    All other arguments are checked before a file is opened.
    """
    unknown = options.keys() - _OPTIONS
    if unknown:
        raise TypeError(f"unrecognized keyword(s): {', '.join(map(repr, sorted(unknown)))}")
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


def _require(names: Sequence[str], present: Sequence[str], place: str) -> None:
    for name in names:
        if name not in present:
            listed = ", ".join(repr(p) for p in present if p)
            raise DataError(f"{place}: no column {name!r}; there are {listed or 'none'}")
        if list(present).count(name) > 1:
            raise DataError(f"{place}: column {name!r} stands there twice; rename one")


def read_mat(path: Any, names: Sequence[str]) -> Columns:
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
    Columns
        One array of shape (N,) per name.

    Raises
    ------
    DataError
        A variable that is not there or not a vector (those that are, are
        listed with their shapes), or a file of version 7.3.
    """
    return vectors(path, read_matlab(path), names)


def read_npz(path: Any, names: Sequence[str]) -> Columns:
    """Named arrays of a file of `numpy.savez`, as 1-D arrays.

    Parameters
    ----------
    path : str or path
        File written by `numpy.savez`.
    names : sequence of str
        Arrays of shape (N,), (N, 1) or (1, N).

    Returns
    -------
    Columns
        One array of shape (N,) per name.

    Raises
    ------
    DataError
        An array that is not there or not a vector (those that are, are listed
        with their shapes), or another kind of file.
    """
    return vectors(path, read_archive(path), names)


def vectors(path: Any, variables: dict[str, Any], names: Sequence[str]) -> Columns:
    """Variables as 1-D arrays of numbers."""
    listed = ", ".join(f"{key} {_shape(value)}" for key, value in variables.items()) or "none"
    columns = {}
    for name in names:
        value = _variable(variables, name)
        if value is None:
            raise DataError(f"{path} has no variable {name!r}; there are: {listed}")
        array = isinstance(value, np.ndarray) and value.dtype.kind in "fiubc"
        if not array or value.ndim > 2 or (value.ndim == 2 and 1 not in value.shape):
            raise DataError(
                f"{path}: variable {name!r} is {_shape(value)}, not a vector of numbers; there are: {listed}"
            )
        columns[name] = value.ravel()
    return Columns(columns)


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
        tables = (
            " (tables and timetables: read them with mat-io, then from_frame)" if "MCOS" in value.kind else ""
        )
        return value.kind + tables
    return " x ".join(map(str, value.shape)) + ("" if value.dtype.kind in "fiub" else f" {value.dtype}")


def read_frame(frame: Any, names: Sequence[str]) -> Columns:
    """Read named columns of a data frame.

    A data frame is one of pandas, or any object with columns and to_numpy.

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
    return Columns(columns)
