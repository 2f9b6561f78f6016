"""A record from a file; the suffix of its name tells the kind of file."""

from __future__ import annotations

from collections.abc import Sequence
from os import PathLike
from pathlib import Path
from typing import Any, NamedTuple

import control as ct

from ..arguments import as_path, as_texts
from ..exceptions import DataError
from ..systems.linear import LinearModel
from .measurement import Measurement

_READERS: dict[str, Any] = {
    **dict.fromkeys((".csv", ".tsv", ".txt", ".lvm", ".log"), Measurement.from_csv),
    ".mat": Measurement.from_mat,
    ".npz": Measurement.from_npz,
    **dict.fromkeys((".h5", ".hdf5"), Measurement.from_hdf5),
}


def read_record(
    path: str | PathLike[str],
    model: Any = None,
    *,
    inputs: str | Sequence[str] | None = None,
    outputs: str | Sequence[str] | None = None,
    time: str | None = None,
    dt: float | None = None,
    hold: str = "zoh",
    decimal: str | None = None,
    missing: str = "raise",
) -> Measurement:
    r"""Read a record from a file, with the columns that a model needs.

    Parameters
    ----------
    path : str or path
        Text (.csv, .tsv, .txt, .lvm, .log), .mat, .npz, .h5 or .hdf5.
    model : StateSpace, PhysicalModel or Refinement, optional
        Model whose signals are looked for where `inputs` or `outputs` is None.
    inputs, outputs : str or sequence of str, optional
        Columns by the model's names, or as many of other names in the model's order. Without a model
        both must be given.
    time : str, optional
        Column of times in s; "time" where `dt` is not given either.
    dt : float, optional
        Sampling time in s.
    hold : {"zoh", "foh", "bandlimited"}
        As `Measurement`.
    decimal : {".", ","}, optional
        Decimal mark of a text file; by default what its columns show.
    missing : {"raise", "hold-out"}
        Whether empty cells of outputs are refused, or left out as samples that were not measured.

    Returns
    -------
    Measurement
        Columns that are named like the model's signals, or fewer than it has, are found by name;
        as many of other names stand in the model's order and take its names. Units are those of the
        file, and the model's where the file has none.

    Raises
    ------
    DataError
        If the file is of another kind, or a column is missing.
    control.ControlArgument
        If neither a model nor a name tells which columns to read.

    Examples
    --------
    >>> import pathlib, tempfile
    >>> path = pathlib.Path(tempfile.mkdtemp()) / "bench.csv"
    >>> _ = path.write_text("time,force,v1\n0,1,0\n0.1,1,0.1\n0.2,1,0.2\n")
    >>> rco.read_record(path, inputs="force", outputs="v1").dt
    0.1
    >>> chain = rco.mass_spring_damper([1.0], [0.4], [100.0], outputs="v1")
    >>> rco.read_record(path, chain).output_labels
    ('v1',)
    """
    file = as_path(path)
    reader = _READERS.get(file.suffix.lower())
    if reader is None:
        *others, last = _READERS
        raise DataError(
            f"{file}: a record is a {', '.join(others)} or {last} file. For TDMS files, "
            'ROS bags and logs see "read a format of another package" on the how-to page'
        )
    text: dict[str, Any] = {} if decimal is None else {"decimal": decimal}
    if text and reader != Measurement.from_csv:
        raise DataError(f"{file} is no text file, which alone has a decimal mark")
    sides = {
        side: _columns_of(model, side, given, file)
        for side, given in (("input", inputs), ("output", outputs))
    }
    record = reader(
        file,
        sides["input"].columns,
        sides["output"].columns,
        time="time" if time is None and dt is None else time,
        dt=dt,
        hold=hold,
        input_labels=sides["input"].labels,
        output_labels=sides["output"].labels,
        missing=missing,
        **text,
    )
    # units of the file, and the model's where the file has none
    found: Measurement = record._changed(
        **{
            f"{side}_units": [
                one or own for one, own in zip(getattr(record, f"{side}_units"), of.units, strict=True)
            ]
            for side, of in sides.items()
        }
    )
    return found


class _Columns(NamedTuple):
    """Columns of the inputs or of the outputs, their labels and units."""

    columns: list[str]
    labels: list[str]
    units: list[str]


def _columns_of(model: Any, side: str, given: str | Sequence[str] | None, file: Path) -> _Columns:
    """Return the columns of the inputs or of the outputs."""
    if model is None:
        if given is None:
            raise ct.ControlArgument(f"{side}s must name columns of {file.name} where no model tells them")
        columns = list(as_texts(given, f"{side}s"))
        return _Columns(columns, columns, [""] * len(columns))
    # columns of the model's names, or as many of other names in the order of the model
    own = list(getattr(LinearModel.from_statespace(getattr(model, "system", model)), f"{side}_labels"))
    columns = own if given is None else list(as_texts(given, f"{side}s"))
    by_name = set(columns) <= set(own) or len(columns) != len(own)
    labels = columns if by_name else own
    units = dict(zip(own, getattr(model, f"{side}_units", ()), strict=False))
    return _Columns(columns, labels, [units.get(label, "") for label in labels])
