"""Variables of binary files, and columns of data frames.

The files are those of MATLAB, NumPy and HDF5, and universal files.

Packages that not everybody has are imported when first needed. The libraries of MATLAB, HDF5 and Matrix
Market files may crash on a damaged file, so they run in a process of their own (`read_apart`).
"""

from __future__ import annotations

import json
import os
import pickle
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from ..arguments import as_number, as_texts
from ..exceptions import DataError, MissingExtraError, needed
from ..systems.linear import Array
from ..writing import damaged, most_bytes, read_archive

_CHILD = Path(__file__).with_name("apart_child.py")
_PATIENCE = 60.0  # s for any file ...
_SPEED = 2e6  # ... and bytes per second beyond that
_RESPONSE, _COHERENCE = 4, 6  # what an ordinate of type 58 is
_MODE, _ANALYSES = 55, (2, 3, 7)  # normal modes, complex ones of first and of second order


class FileColumns(NamedTuple):
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


def read_apart(
    path: str | os.PathLike[str], reader: str, what: str, names: Sequence[str] = ()
) -> dict[str, Any]:
    """Read the variables of a file in a separate process.

    Time and memory of the process are limited.

    Parameters
    ----------
    path : str or path
        File.
    reader : {"mat", "hdf5", "mtx"}
        Function of `apart_child` that reads it.
    what : str
        What it should be, for messages: "MATLAB file that scipy".
    names : sequence of str, optional
        Variables to read, if not all are read.

    Returns
    -------
    dict
        Arrays; a structure as a dict of its fields, anything else as a 1-tuple with the name of its type.

    Raises
    ------
    DataError
        If it is another file, is damaged, takes too long or unfolds to too much.
    OSError
        If it cannot be opened.
    """
    with open(path, "rb"):  # whether it is there is the system's message, not the reader's
        size = os.stat(path).st_size
    patience = _PATIENCE + size / _SPEED
    try:
        done = subprocess.run(
            [sys.executable, "-P", str(_CHILD), reader, os.fspath(path), str(most_bytes(size))],
            env={**os.environ, "PYTHONPATH": os.pathsep.join(filter(None, sys.path))},
            input=json.dumps(list(names)).encode(),  # a command's words bear no NUL, and not any length
            capture_output=True,
            timeout=patience,
            check=False,
        )
    except subprocess.TimeoutExpired as error:
        raise DataError(f"{path} could not be read within {patience:.0f} s; it may be damaged") from error
    if done.returncode:
        last = done.stderr.decode(errors="replace").strip().splitlines()[-1:] or ["no message"]
        why = f"reading it ended with code {done.returncode} ({last[0]})"
    else:
        found, why = pickle.loads(done.stdout)  # written by the script above, not by the file
        if not why:
            return dict(found)
    raise DataError(f"{path} is no {what} can read, or it is damaged: {why}")


def read_matlab(path: str | os.PathLike[str]) -> dict[str, Any]:
    """All variables of a MATLAB file up to version 7.2.

    They are those of `read_apart`.
    """
    if _is_new(path):
        raise DataError(
            f"{path} is a MATLAB 7.3 (HDF5) file; save it anew in MATLAB with save(..., '-v7'), "
            'or install the extra "formats": pip install "rcorefine[formats]"'
        )
    return read_apart(path, "mat", "MATLAB file that scipy")


def _is_new(path: str | os.PathLike[str]) -> bool:
    with open(path, "rb") as file:
        return file.read(10) == b"MATLAB 7.3"


def read_mat(path: Any, names: Sequence[str]) -> FileColumns:
    """Named vectors of a MATLAB file; version 7.3 of the format needs h5py."""
    if not _is_new(path):
        return _vectors(path, read_matlab(path), names)
    try:
        return read_hdf5(path, names)
    except MissingExtraError:
        return _vectors(path, read_matlab(path), names)  # which says what to do
    except DataError as error:
        raise DataError(
            f"{error}. As a MATLAB 7.3 file it may be saved anew with save(..., '-v7')"
        ) from error


def read_npz(path: Any, names: Sequence[str]) -> FileColumns:
    """Named vectors of a file of `numpy.savez`."""
    return _vectors(path, read_archive(path), names)


def read_hdf5(path: Any, names: Sequence[str]) -> FileColumns:
    """Named data sets of an HDF5 file: "group/name", or "group.name"."""
    needed("h5py", "formats", "from_hdf5")
    return _vectors(path, read_apart(path, "hdf5", "HDF5 file that h5py", names), names)


def _vectors(path: Any, variables: dict[str, Any], names: Sequence[str]) -> FileColumns:
    """Return the named variables as 1-D arrays of numbers.

    The field of a structure has a dotted name.

    Raises
    ------
    DataError
        A variable that is not there or not a vector; those that are, are listed with their shapes.
    """
    listed = ", ".join(f"{key} {_shape(value)}" for key, value in variables.items()) or "none"
    columns = {}
    for name in names:
        head, *fields = [name] if name in variables else name.split(".")
        value = variables.get(head)
        for field in fields:
            value = value.get(field) if isinstance(value, dict) else None
        if value is None:
            raise DataError(f"{path} has no variable {name!r}; there are: {listed}")
        array = isinstance(value, np.ndarray) and value.dtype.kind in "fiubc"
        if not array or value.ndim > 2 or (value.ndim == 2 and 1 not in value.shape):
            raise DataError(
                f"{path}: variable {name!r} is {_shape(value)}, not a vector of numbers; there are: {listed}"
            )
        columns[name] = value.ravel()
    return FileColumns(columns)


def _shape(value: Any) -> str:
    if isinstance(value, dict):
        return f"structure with fields {', '.join(value)}"
    if isinstance(value, tuple):  # what is neither array nor structure, by the name of its type
        hint = " (tables and timetables: read them with mat-io, then from_frame)"
        return str(value[0]) + (hint if value[0] == "MATLAB object" else "")
    kind = "" if value.dtype.kind in "fiub" else f" {value.dtype}"
    return f"{' x '.join(map(str, value.shape))}{kind}"


def _sets_of(path: Any, kind: int, asked: Sequence[int] | None = None) -> tuple[list[int], dict[int, Any]]:
    """Read the data sets of one type from a universal file.

    The types of all data sets are returned, and the requested sets (all for None) by their number. A set of
    another type is None.
    """
    pyuff = needed("pyuff", "formats", "from_uff")
    with open(path, "rb"):
        pass
    with damaged(path, "is not a universal file that pyuff can read, or it is damaged"):
        file = pyuff.UFF(str(path))
        kinds = [int(one) for one in file.get_set_types()]
        places = range(len(kinds)) if asked is None else asked
        read = {k: file.read_sets(k) if k < len(kinds) and kinds[k] == kind else None for k in places}
    for k, one in read.items():  # pyuff takes what there is
        if kind == 58 and one is not None and np.size(one["data"]) < (n := one["num_pts"]):
            raise DataError(f"{path}: data set {k} announces {n} values and holds fewer; it is damaged")
    return kinds, read


def read_uff(path: Any, sets: Sequence[int]) -> tuple[list[Array], list[str], list[str], float]:
    """Read time histories of a universal file.

    They are data sets of type 58. Values, names, units and the sampling time are returned.
    """
    kinds, read = _sets_of(path, 58, sets)
    for k, found in read.items():
        if found is None or found.get("func_type") not in (0, 1):
            what = "there is none" if k >= len(kinds) else "no time history of type 58"
            raise DataError(f"{path}: data set {k} is not a record ({what}); its sets are of types {kinds}")
    steps = {float(found["abscissa_inc"]) for found in read.values()}
    if len(steps) > 1:
        raise DataError(f"{path}: the data sets have different sampling times: {sorted(steps)} s")
    rows = [read[k] for k in sets]
    units = [str(row.get("ordinate_axis_units_lab", "")).strip().replace("NONE", "") for row in rows]
    return (
        [np.asarray(row["data"], dtype=float).ravel() for row in rows],
        [f"{row.get('rsp_node', k)}:{row.get('rsp_dir', 0)}" for k, row in zip(sets, rows, strict=True)],
        units,
        as_number(steps.pop(), "the sampling time of the file", above=0.0, error=DataError),
    )


def read_uff_responses(path: Any, sets: Sequence[int] | None) -> dict[str, Any]:
    """Read frequency responses of a universal file.

    They are data sets of type 58, and are returned as arguments of `FrequencyResponse`.
    """
    responses, known = _responses_of(path, sets)
    outputs, inputs = (list(dict.fromkeys(place[side] for place in responses)) for side in (0, 1))
    if len(responses) != len(outputs) * len(inputs):
        raise DataError(
            f"{path} holds {len(responses)} responses of {len(outputs)} outputs to {len(inputs)} inputs, not "
            "each to each; name those of a full matrix in sets="
        )
    axes = [np.asarray(one["x"], dtype=float).ravel() for one in responses.values()]
    for (y, w), x in zip(responses, axes, strict=True):
        if x.shape != axes[0].shape or not np.allclose(x, axes[0], rtol=1e-6):
            raise DataError(f"{path}: response {y} to {w} has other frequencies than the first")
    kept = axes[0] > 0
    table = np.array([[np.asarray(responses[y, w]["data"]).ravel() for w in inputs] for y in outputs])
    made: dict[str, Any] = {"response": table[:, :, kept], "omega": 2.0 * np.pi * axes[0][kept]}
    if len(inputs) == 1 and all((y, inputs[0]) in known for y in outputs):
        rows = np.array([np.asarray(known[y, inputs[0]]["data"]).real.ravel() for y in outputs])
        if rows.shape[1] == kept.size:
            made["coherence"] = np.clip(rows[:, kept], 0.0, 1.0)
    return made | {"input_labels": inputs, "output_labels": outputs}


def _responses_of(path: Any, sets: Sequence[int] | None) -> tuple[dict[tuple[str, str], Any], ...]:
    """Responses and coherences of a universal file by their two places."""
    kinds, read = _sets_of(path, 58, sets)
    sorts: dict[int, dict[tuple[str, str], Any]] = {_RESPONSE: {}, _COHERENCE: {}}
    for k, one in read.items():
        found = None if one is None else sorts.get(int(one.get("func_type", -1)))
        if found is not None:
            y, w = (f"{one.get(f'{side}_node', 0)}:{one.get(f'{side}_dir', 0)}" for side in ("rsp", "ref"))
            if (y, w) in found:
                raise DataError(f"{path} holds response {y} to {w} twice; name one in sets=")
            found[y, w] = one
        elif sets is not None:
            raise DataError(f"{path}: data set {k} is no frequency response; its sets are of types {kinds}")
    if not sorts[_RESPONSE]:
        hint = " Sets of type 55 are modes, a model and not a measurement: rcorefine.modal_model reads them"
        said = f"{path} holds no frequency response; its sets are of types {kinds}."
        raise DataError(said + hint * (_MODE in kinds))
    return tuple(sorts.values())


def read_uff_modes(path: Any) -> list[dict[str, Any]]:
    """Modes (data sets of type 55) of a universal file."""
    kinds, read = _sets_of(path, _MODE)
    modes = [one for one in read.values() if one is not None and one.get("analysis_type") in _ANALYSES]
    if not modes:
        raise DataError(f"{path} holds no modes (type 55 of a modal analysis); its sets are of types {kinds}")
    return modes
