"""Records named on the command line, read and split.

The suffix selects the format. The signals have the names of the model by default.
"""

from __future__ import annotations

import re
from argparse import Namespace
from pathlib import Path
from typing import Any

from ..data import files
from ..data.measurement import Measurement
from ..exceptions import DataError

__all__ = ["fitted_and_held_out", "read_record"]


def read_record(path: Path, model: Any, arguments: Namespace) -> Measurement:
    """Record for a model; see `rcorefine.data.files.read_record`.

    Parameters
    ----------
    path : Path
        File.
    model : StateSpace or PhysicalModel
        Model whose signals are looked for where the command line names none.
    arguments : Namespace
        ``input``, ``output`` (lists of names or None), ``time``, ``dt``, ``hold``.

    Returns
    -------
    Measurement

    Raises
    ------
    DataError
        If the file is of another kind, or a column is missing; with the option that would help.
    """
    try:
        return files.read_record(path, model, **reading(arguments))
    except DataError as error:
        no_time = re.search("no (column|variable) 'time'", str(error))
        hint = ""
        if arguments.time is None and arguments.dt is None and no_time:
            hint = " (name the column of times with --time, or give the sampling time with --dt)"
        elif path.suffix.lower() in files.SUFFIXES and (arguments.input is None or arguments.output is None):
            hint = " (name the columns with --input and --output, in the order of the model's signals)"
        raise DataError(f"{error}{hint}") from error


def reading(arguments: Namespace) -> dict[str, Any]:
    """Return the options for the columns as `read_record` takes them.

    See `rcorefine.data.files.read_record`.
    """
    return {
        "inputs": arguments.input,
        "outputs": arguments.output,
        "time": arguments.time,
        "dt": arguments.dt,
        "hold": arguments.hold,
        "decimal": arguments.decimal,
    }


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
