"""Reads one MATLAB file in a process of its own: scipy's reader can crash on a damaged one, or fill memory.

Run as a script by `rcorefine.data.matlab`, without the package, so that it starts fast. What it finds goes to
standard output as an archive of plain arrays; what they are called, and what is no array, is one of them.
"""

import io
import json
import sys
from typing import Any

import numpy as np
from scipy.io import loadmat


def main() -> None:
    """Read the file that is named on the command line, within so many bytes of memory."""
    path, room = sys.argv[1], int(sys.argv[2])
    _limit(room)
    report: dict[str, Any] = {}
    arrays: dict[str, np.ndarray[Any, Any]] = {}
    try:
        content = loadmat(path, appendmat=False)
        nodes = {key: _node(value, arrays, 0) for key, value in content.items() if not key.startswith("__")}
        report["nodes"] = nodes
    except Exception as error:
        arrays = {}
        report["error"] = type(error).__name__, str(error)
    stream = io.BytesIO()
    np.savez(stream, allow_pickle=False, report=np.array(json.dumps(report)), **arrays)
    sys.stdout.buffer.write(stream.getbuffer())


def _limit(room: int) -> None:
    """Memory beyond what the libraries have taken; on other systems than Linux time alone is a limit."""
    if not sys.platform.startswith("linux"):
        return
    import resource

    with open("/proc/self/statm") as file:
        taken = int(file.read().split()[0]) * resource.getpagesize()
    _, hard = resource.getrlimit(resource.RLIMIT_AS)
    limit = taken + room if hard == resource.RLIM_INFINITY else min(taken + room, hard)
    resource.setrlimit(resource.RLIMIT_AS, (limit, hard))


def _node(value: Any, arrays: dict[str, np.ndarray[Any, Any]], depth: int) -> Any:
    """Where an array stands, the fields of a structure, the texts of a cell array, or what else it is."""
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
