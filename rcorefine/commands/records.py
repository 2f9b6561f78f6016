"""The record that the command line names: read by its suffix, named after the model, split."""

from __future__ import annotations

import re
from argparse import Namespace
from pathlib import Path
from typing import Any

from ..data.measurement import Measurement
from ..exceptions import DataError
from ..systems.linear import LinearModel

__all__ = ["fitted_and_held_out", "read_record"]

_READERS = {
    ".csv": Measurement.from_csv,
    ".tsv": Measurement.from_csv,
    ".txt": Measurement.from_csv,
    ".lvm": Measurement.from_csv,
    ".log": Measurement.from_csv,
    ".mat": Measurement.from_mat,
    ".npz": Measurement.from_npz,
    ".h5": Measurement.from_hdf5,
    ".hdf5": Measurement.from_hdf5,
    ".tdms": Measurement.from_tdms,
}


def read_record(path: Path, model: Any, arguments: Namespace) -> Measurement:
    """Record for a model.

    Parameters
    ----------
    path : Path
        Text (.csv, .tsv, .txt, .lvm, .log), .mat, .npz, .h5, .hdf5 or .tdms.
    model : StateSpace or PhysicalModel
        Model whose signals are looked for where the command line names none.
    arguments : Namespace
        ``input``, ``output`` (lists of names or None), ``time``, ``dt``, ``hold``.

    Returns
    -------
    Measurement
        Columns that are named like the model's signals, or fewer than it has, are found by name;
        as many of other names stand in the model's order and take its names.

    Raises
    ------
    DataError
        If the file is of another kind, or a column is missing.
    """
    reader = _READERS.get(path.suffix.lower())
    if reader is None:
        raise DataError(
            f"{path}: a record is a .csv, .tsv, .txt, .lvm, .log, .mat, .npz, .h5, .hdf5 or .tdms file"
        )
    linear = LinearModel.from_statespace(getattr(model, "system", model))
    inputs, input_labels = _columns(arguments.input, linear.input_labels)
    outputs, output_labels = _columns(arguments.output, linear.output_labels)
    units = {
        "input_units": _units(input_labels, linear.input_labels, getattr(model, "input_units", ())),
        "output_units": _units(output_labels, linear.output_labels, getattr(model, "output_units", ())),
    }
    options: dict[str, Any] = {
        "hold": arguments.hold,
        "input_labels": input_labels,
        "output_labels": output_labels,
    }
    time = arguments.time
    if time is None and arguments.dt is None:
        time = "time"
    try:
        return reader(path, inputs, outputs, time=time, dt=arguments.dt, **options, **units)
    except DataError as error:
        hint = ""
        if (
            arguments.time is None
            and arguments.dt is None
            and re.search("no (column|variable) 'time'", str(error))
        ):
            hint = " (name the column of times with --time, or give the sampling time with --dt)"
        elif arguments.input is None or arguments.output is None:
            hint = " (name the columns with --input and --output, in the order of the model's signals)"
        raise DataError(f"{error}{hint}") from error


def _columns(given: list[str] | None, model: tuple[str, ...]) -> tuple[list[str], list[str]]:
    """Columns to read, and what they are called in the model."""
    if given is None:
        return list(model), list(model)
    by_name = set(given) <= set(model) or len(given) != len(model)
    return given, given if by_name else list(model)


def _units(labels: list[str], model: tuple[str, ...], units: tuple[str, ...]) -> list[str] | None:
    known = dict(zip(model, units, strict=False))
    return [known.get(label, "") for label in labels] if units else None


def fitted_and_held_out(model: Any, arguments: Namespace) -> tuple[Measurement, Measurement | None]:
    """The record to work on and the one to judge by, if any.

    Parameters
    ----------
    model : StateSpace or PhysicalModel
        Model.
    arguments : Namespace
        As `read_record`, and ``data``, ``validation`` (path or None), ``split`` (share or None).

    Returns
    -------
    data, validation : Measurement, Measurement or None
    """
    data = read_record(arguments.data, model, arguments)
    if arguments.validation is not None:
        return data, read_record(arguments.validation, model, arguments)
    if arguments.split is not None:
        return data.split(arguments.split)
    return data, None
