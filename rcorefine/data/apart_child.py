"""Script that reads one file in a process of its own.

The library that reads the file can crash on a damaged file, or fill the memory. `rcorefine.data.apart` runs
this script without the package, so that it starts fast. The script writes an archive of plain arrays to
standard output. One of these arrays holds the names and everything that is no array.
"""

import io
import json
import os
import sys
from typing import Any

import numpy as np

_Arrays = dict[str, np.ndarray[Any, Any]]


def main() -> None:
    """Read the file named on the command line, within a memory limit.

    The requested names come from standard input.
    """
    reader, path, room = sys.argv[1:]
    names = json.load(sys.stdin)
    report: dict[str, Any] = {}
    arrays: _Arrays = {}
    try:
        report = {"mat": _mat, "hdf5": _hdf5, "mtx": _mtx}[reader](path, int(room), names, arrays)
    except Exception as error:
        arrays.clear()
        report["error"] = type(error).__name__, str(error)
    stream = io.BytesIO()
    np.savez(stream, allow_pickle=False, report=np.array(json.dumps(report)), **arrays)
    sys.stdout.buffer.write(stream.getbuffer())


def _mat(path: str, room: int, names: list[str], arrays: _Arrays) -> dict[str, Any]:
    """All variables of a MATLAB file."""
    from scipy.io import loadmat

    _limit(room)
    content = loadmat(path, appendmat=False)
    nodes = {key: _node(value, arrays, 0) for key, value in content.items() if not key.startswith("__")}
    return {"nodes": nodes}


def _hdf5(path: str, room: int, names: list[str], arrays: _Arrays) -> dict[str, Any]:
    """Read named data sets of an HDF5 file.

    The report also describes the other data sets, or gives the reason why the file is refused.
    """
    import h5py

    _limit(room)
    with h5py.File(path, "r") as file:
        found: dict[str, Any] = {}

        def note(name: str, item: Any) -> None:
            if hasattr(item, "shape"):
                found[name] = item

        file.visititems(note)
        texts = {k for k, item in found.items() if item.attrs.get("MATLAB_class", b"") == b"char"}
        asked = {name: name.replace(".", "/").strip("/") for name in names}
        numbers = {k for k, item in found.items() if item.dtype.kind in "biufc"} - texts
        asked = {name: k for name, k in asked.items() if k in numbers}
        for name, k in asked.items():
            if found[k].external or found[k].is_virtual:
                return {"refused": f"the data set {name!r} lies in another file; copy its values here"}
        claimed = sum(found[k].size * found[k].dtype.itemsize for k in asked.values())
        if claimed > room:
            return {
                "refused": f"{', '.join(asked)} claim {claimed} bytes, {room} are allowed in a file of its "
                "size; save what packs so well without compression"
            }
        nodes = {k: {"other": "text" if k in texts else str(item.dtype)} for k, item in found.items()}
        return {"nodes": nodes | {name: _node(np.asarray(found[k]), arrays, 0) for name, k in asked.items()}}


def _mtx(path: str, room: int, names: list[str], arrays: _Arrays) -> dict[str, Any]:
    """Read the matrix of a Matrix Market file.

    A sparse matrix is stored as its entries and their positions.
    """
    from scipy.io import mminfo, mmread

    _limit(room)
    if mminfo(path)[2] > os.path.getsize(path):
        return {"refused": "promises more numbers than it holds bytes"}
    found = mmread(path)
    parts = {"data": found}
    if not isinstance(found, np.ndarray):
        parts = {"data": found.data, "row": found.row, "col": found.col, "shape": np.array(found.shape)}
    return {"nodes": {key: _node(part, arrays, 0) for key, part in parts.items()}}


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


def _node(value: Any, arrays: _Arrays, depth: int) -> Any:
    """Return a description of a value of a MATLAB file.

    It names the stored array, the fields of a structure, the stored texts of a cell array, or another type.
    """
    if not isinstance(value, np.ndarray) or depth > 20:
        return {"other": type(value).__name__}
    if value.dtype.names is not None:
        if value.size != 1:
            return {"other": f"array of {value.size} structures"}
        only = value.ravel()[0]
        return {"fields": {name: _node(only[name], arrays, depth + 1) for name in value.dtype.names}}
    if value.dtype == object:
        items = [np.asarray(item) for item in value.ravel()]
        if not items or any(item.dtype.kind != "U" for item in items):
            return {"other": "cell array"}
        value = np.array([text for item in items for text in item.ravel()])
    key = f"a{len(arrays)}"
    arrays[key] = value
    return {"array": key}


if __name__ == "__main__":
    main()
