"""Script that reads one file in a process of its own.

The library that reads the file can crash on a damaged file, or fill the memory. `rcorefine.data.formats` runs
this script without the package, so that it starts fast. The script writes the variables and an error message
to standard output.
"""

import json
import os
import pickle
import sys
from typing import Any

import numpy as np


def main() -> None:
    """Read the file named on the command line, within a memory limit.

    The requested names come from standard input.
    """
    reader, path, room = sys.argv[1:]
    names = json.load(sys.stdin)
    found: dict[str, Any] = {}
    why = ""
    try:
        found = {"mat": _mat, "hdf5": _hdf5, "mtx": _mtx}[reader](path, int(room), names)
    except Exception as error:
        why = f"{type(error).__name__}: {error}"
    sys.stdout.buffer.write(pickle.dumps((found, why), protocol=5))


def _mat(path: str, room: int, names: list[str]) -> dict[str, Any]:
    """All variables of a MATLAB file."""
    from scipy.io import loadmat

    _limit(room)
    content = loadmat(path, appendmat=False)
    return {key: _plain(value) for key, value in content.items() if not key.startswith("__")}


def _hdf5(path: str, room: int, names: list[str]) -> dict[str, Any]:
    """Read named data sets of an HDF5 file; list the types of the others."""
    import h5py

    _limit(room)
    with h5py.File(path, "r") as file:
        found: dict[str, Any] = {}

        def note(name: str, item: Any) -> None:
            if hasattr(item, "shape"):
                found[name] = item

        file.visititems(note)
        texts = {k for k, item in found.items() if item.attrs.get("MATLAB_class", b"") == b"char"}
        numbers = {k for k, item in found.items() if item.dtype.kind in "biufc"} - texts
        asked = {name: found[k] for name in names if (k := name.replace(".", "/").strip("/")) in numbers}
        for name, item in asked.items():
            if item.external or item.is_virtual:
                raise ValueError(f"the data set {name!r} lies in another file; copy its values here")
        claimed = sum(item.size * item.dtype.itemsize for item in asked.values())
        if claimed > room:
            raise ValueError(
                f"{', '.join(asked)} claim {claimed} bytes, {room} are allowed in a file of its size; save "
                "what packs so well without compression"
            )
        listed = {k: ("text" if k in texts else str(item.dtype),) for k, item in found.items()}
        return listed | {name: np.asarray(item) for name, item in asked.items()}


def _mtx(path: str, room: int, names: list[str]) -> dict[str, Any]:
    """Read the matrix of a Matrix Market file.

    A sparse matrix is stored as its entries and their positions.
    """
    from scipy.io import mminfo, mmread

    _limit(room)
    if mminfo(path)[2] > os.path.getsize(path):
        raise ValueError("it promises more numbers than it holds bytes")
    found = mmread(path)
    if isinstance(found, np.ndarray):
        return {"data": found}
    return {"data": found.data, "row": found.row, "col": found.col, "shape": np.array(found.shape)}


def _limit(room: int) -> None:
    """Limit the memory beyond what the libraries have taken.

    This works on Linux only; on other systems only the time is limited.
    """
    if not sys.platform.startswith("linux"):
        return
    import resource

    with open("/proc/self/statm") as file:
        taken = int(file.read().split()[0]) * resource.getpagesize()
    _, hard = resource.getrlimit(resource.RLIMIT_AS)
    limit = taken + room if hard == resource.RLIM_INFINITY else min(taken + room, hard)
    resource.setrlimit(resource.RLIMIT_AS, (limit, hard))


def _plain(value: Any, depth: int = 0) -> Any:
    """Return a value of a MATLAB file in plain types.

    This is an array, a dict of fields, or a 1-tuple with the name of its type.
    """
    if not isinstance(value, np.ndarray) or depth > 20:
        return (type(value).__name__,)
    if type(value).__name__ == "MatlabOpaque":
        return ("MATLAB object",)
    if value.dtype.names is not None:
        if value.size != 1:
            return (f"array of {value.size} structures",)
        only = value.ravel()[0]
        return {name: _plain(only[name], depth + 1) for name in value.dtype.names}
    if value.dtype == object:
        items = [np.asarray(item) for item in value.ravel()]
        if not items or any(item.dtype.kind != "U" for item in items):
            return ("cell array",)
        return np.array([text for item in items for text in item.ravel()])
    return np.asarray(value)


if __name__ == "__main__":
    main()
