"""Reading of files in a separate process, with time and memory limits.

The libraries that read these files may crash.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from types import MappingProxyType
from typing import Any, NamedTuple

import control as ct
import numpy as np

from ..archives import arrays_of, most_bytes
from ..exceptions import DataError, RCOError

__all__ = ["Other", "damaged", "read_apart"]

_CHILD = Path(__file__).with_name("apart_child.py")
_PATIENCE = 60.0  # s for any file ...
_SPEED = 2e6  # ... and bytes per second beyond that


@contextmanager
def damaged(path: str | os.PathLike[str], said: str = "is damaged") -> Iterator[None]:
    """Whatever fails while a file is read is the file's fault.

    Parameters
    ----------
    path : str or path
        File, for the message.
    said : str
        What is said of it.

    Raises
    ------
    DataError
        For any error that is not of this package, of python-control, or of the system about the file.
    """
    try:
        yield
    except (RCOError, ct.ControlArgument, ct.ControlDimension):
        raise
    except Exception as error:
        if isinstance(error, OSError) and error.filename is not None:
            raise  # no file there, or none that may be read
        raise DataError(f"{os.fspath(path)!r} {said}: {type(error).__name__}: {error}") from error


class Other(NamedTuple):
    """A variable that is no array: what its file calls it."""

    kind: str


def read_apart(
    path: str | os.PathLike[str],
    reader: str,
    what: str,
    names: Sequence[str] = (),
    *,
    said: Mapping[str, str] = MappingProxyType({}),
) -> dict[str, Any]:
    """Variables of a file by name.

    Parameters
    ----------
    path : str or path
        File.
    reader : {"mat", "hdf5", "mtx"}
        Who reads it.
    what : str
        What it should be, for messages: "MATLAB file that scipy".
    names : sequence of str, optional
        What is asked for, where not all is read.
    said : mapping of str to str, optional
        What the file is, by the name of the error of the library that says so.

    Returns
    -------
    dict
        Arrays; a structure as a dict of its fields, anything else as `Other`.

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
        raise DataError(
            f"{path} is no {what} can read, or it is damaged: reading it ended with code "
            f"{done.returncode} ({last[0]})"
        )
    arrays = arrays_of(done.stdout)
    report = json.loads(str(arrays.pop("report")))
    if "refused" in report:
        raise DataError(f"{path}: {report['refused']}")
    if "error" in report:
        kind, message = report["error"]
        words = said.get(kind, f"is no {what} can read, or it is damaged: {kind}: {message}")
        raise DataError(f"{path} {words}")
    return {name: _value(node, arrays) for name, node in report["nodes"].items()}


def _value(node: dict[str, Any], arrays: dict[str, np.ndarray[Any, Any]]) -> Any:
    if "array" in node:
        return arrays[node["array"]]
    if "fields" in node:
        return {name: _value(part, arrays) for name, part in node["fields"].items()}
    return Other(node["other"])
