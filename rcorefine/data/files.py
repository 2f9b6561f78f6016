"""Reading of a record for a model from a file of any known kind.

The suffix gives the kind. The channels get the names of the model's signals.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from ..exceptions import DataError
from ..systems.linear import LinearModel
from .measurement import Measurement

__all__ = ["SUFFIXES", "read_record"]

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
    ".bag": Measurement.from_rosbag,
    ".mcap": Measurement.from_rosbag,
    ".db3": Measurement.from_rosbag,
}
SUFFIXES = tuple(_READERS)


def read_record(
    path: Path,
    model: Any,
    *,
    inputs: Sequence[str] | None = None,
    outputs: Sequence[str] | None = None,
    time: str | None = None,
    dt: float | None = None,
    hold: str = "zoh",
    decimal: str | None = None,
) -> Measurement:
    """Record for a model.

    Parameters
    ----------
    path : Path
        Text (.csv, .tsv, .txt, .lvm, .log), .mat, .npz, .h5, .hdf5, .tdms, or a bag (.bag, .mcap, .db3).
    model : StateSpace or PhysicalModel
        Model whose signals are looked for where `inputs` or `outputs` is None.
    inputs, outputs : sequence of str, optional
        Columns by the model's names, or as many of other names in the model's order.
    time : str, optional
        Column of times in s; "time" where `dt` is not given either. The messages of a bag bear theirs.
    dt : float, optional
        Sampling time in s.
    hold : {"zoh", "foh", "bandlimited"}
        As `Measurement`.
    decimal : {".", ","}, optional
        Decimal mark of a text file; by default what its columns show.

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
        raise DataError(f"{path}: a record is a {', '.join(SUFFIXES[:-1])} or {SUFFIXES[-1]} file")
    text: dict[str, Any] = {} if decimal is None else {"decimal": decimal}
    if text and reader != Measurement.from_csv:
        raise DataError(f"{path} is no text file, which alone has a decimal mark")
    clock: dict[str, Any] = {"time": "time" if time is None and dt is None else time}
    if reader == Measurement.from_rosbag:
        clock = {}
    if time is not None and not clock:
        raise DataError(f"{path} is a bag, whose messages bear their times; leave out the name of a column")
    linear = LinearModel.from_statespace(getattr(model, "system", model))
    columns, labels = _columns(inputs, linear.input_labels)
    measured, output_labels = _columns(outputs, linear.output_labels)
    record = reader(
        path,
        columns,
        measured,
        dt=dt,
        hold=hold,
        **clock,
        **text,
        input_labels=labels,
        output_labels=output_labels,
    )
    return record._changed(
        input_units=_units(
            record.input_units, labels, linear.input_labels, getattr(model, "input_units", ())
        ),
        output_units=_units(
            record.output_units, output_labels, linear.output_labels, getattr(model, "output_units", ())
        ),
    )


def _columns(given: Sequence[str] | None, model: tuple[str, ...]) -> tuple[list[str], list[str]]:
    """Columns to read, and what they are called in the model."""
    if given is None:
        return list(model), list(model)
    by_name = set(given) <= set(model) or len(given) != len(model)
    return list(given), list(given if by_name else model)


def _units(
    own: tuple[str, ...], labels: list[str], model: tuple[str, ...], units: tuple[str, ...]
) -> list[str]:
    """The file's units, and the model's where the file has none."""
    known = dict(zip(model, units, strict=False))
    return [unit or known.get(label, "") for unit, label in zip(own, labels, strict=True)]
