"""Variables out of MATLAB files, read in a process of its own with limits of time and memory."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from ..archives import arrays_of, most_bytes
from ..exceptions import DataError

__all__ = ["Other", "read_matlab"]

_CHILD = Path(__file__).with_name("mat_child.py")
_PATIENCE = 60.0  # s for any file ...
_SPEED = 2e6  # ... and bytes per second beyond that


class Other(NamedTuple):
    """A variable that is no array: what MATLAB calls it."""

    kind: str


def read_matlab(path: str | os.PathLike[str]) -> dict[str, Any]:
    """All variables of a MATLAB file (up to version 7.2) by name.

    Parameters
    ----------
    path : str or path
        File written by MATLAB's `save`.

    Returns
    -------
    dict
        Arrays; a structure as a dict of its fields, a cell array of texts as an array,
        anything else as `Other`.

    Raises
    ------
    DataError
        If it is another file, is damaged, takes too long or unfolds to too much; for version
        7.3 the message says what to do.
    OSError
        If it cannot be opened.
    """
    with open(path, "rb"):  # whether it is there is the system's message, not the reader's
        size = os.stat(path).st_size
    patience = _PATIENCE + size / _SPEED
    try:
        done = subprocess.run(
            [sys.executable, "-P", str(_CHILD), os.fspath(path), str(most_bytes(size))],
            env={**os.environ, "PYTHONPATH": os.pathsep.join(filter(None, sys.path))},
            stdin=subprocess.DEVNULL,
            capture_output=True,
            timeout=patience,
            check=False,
        )
    except subprocess.TimeoutExpired as error:
        raise DataError(f"{path} could not be read within {patience:.0f} s; it may be damaged") from error
    if done.returncode:
        last = done.stderr.decode(errors="replace").strip().splitlines()[-1:] or ["no message"]
        raise DataError(
            f"{path} is no MATLAB file that scipy can read, or it is damaged: reading it ended with code "
            f"{done.returncode} ({last[0]})"
        )
    arrays = arrays_of(done.stdout)
    report = json.loads(str(arrays.pop("report")))
    if "error" in report:
        kind, message = report["error"]
        if kind == "NotImplementedError":
            raise DataError(
                f"{path} is a MATLAB 7.3 (HDF5) file; save it anew in MATLAB with save(..., '-v7'), "
                'or install the extra "formats": pip install "rcorefine[formats]"'
            )
        raise DataError(
            f"{path} is not a MATLAB file that scipy can read, or it is damaged: {kind}: {message}"
        )
    return {name: _value(node, arrays) for name, node in report["nodes"].items()}


def _value(node: dict[str, Any], arrays: dict[str, np.ndarray[Any, Any]]) -> Any:
    if "array" in node:
        return arrays[node["array"]]
    if "fields" in node:
        return {name: _value(part, arrays) for name, part in node["fields"].items()}
    return Other(node["other"])
