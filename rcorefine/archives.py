"""Safe reading of named arrays from NumPy archives.

The sizes of the arrays are checked before memory is allocated.
"""

from __future__ import annotations

import io
import math
import zipfile
from os import PathLike, fspath
from pathlib import Path
from typing import Any

import numpy as np

from .exceptions import DataError

_ROOM = 50 << 20  # bytes that any file may unfold to ...
_TIMES = 8  # ... and how many times its own size beyond that: records seldom, bombs a thousand times
_HEADERS = {
    (1, 0): np.lib.format.read_array_header_1_0,
    (2, 0): np.lib.format.read_array_header_2_0,
}


def most_bytes(size: int) -> int:
    """Bytes that a file of some size may unfold to, compressed."""
    return _ROOM + _TIMES * size


def read_archive(path: str | PathLike[str]) -> dict[str, np.ndarray[Any, Any]]:
    """Arrays of a file of `numpy.savez` by name.

    Parameters
    ----------
    path : str or path
        File.

    Returns
    -------
    dict of ndarray
        Independent arrays.

    Raises
    ------
    DataError
        If the file is another one, is damaged, or holds Python objects.
    OSError
        If it cannot be read.

    Examples
    --------
    >>> import pathlib, tempfile
    >>> path = pathlib.Path(tempfile.mkdtemp()) / "run.npz"
    >>> np.savez(path, force=np.ones(3))
    >>> read_archive(path)
    {'force': array([1., 1., 1.])}
    """
    raw = Path(path).read_bytes()
    if raw.startswith(np.lib.format.MAGIC_PREFIX):
        raise DataError(f"{fspath(path)} holds one array without a name; save named arrays with numpy.savez")
    try:
        return arrays_of(raw)
    except Exception as error:  # zipfile, zlib and the header's parser fail in a dozen ways
        raise DataError(
            f"{fspath(path)} is not a file of named arrays as numpy.savez writes it, or it is damaged: "
            f"{error or type(error).__name__}"
        ) from error


def arrays_of(raw: bytes) -> dict[str, np.ndarray[Any, Any]]:
    """Return the arrays of an archive that is in memory.

    The errors of zipfile and NumPy are passed on.
    """
    found: dict[str, np.ndarray[Any, Any]] = {}
    with zipfile.ZipFile(io.BytesIO(raw)) as archive:
        members = [item for item in archive.infolist() if item.filename.endswith(".npy")]
        claimed = sum(item.file_size for item in members)
        if claimed > most_bytes(len(raw)):
            raise ValueError(
                f"its arrays claim {claimed} bytes, {most_bytes(len(raw))} are allowed; save what packs "
                "so well without compression"
            )
        for item in members:
            name = item.filename.removesuffix(".npy")
            if name in found:
                raise ValueError(f"two arrays are called {name!r}")
            found[name] = array_of(archive.read(item), name)
    return found


def array_of(content: bytes, name: str) -> np.ndarray[Any, Any]:
    """One array; its header must claim as many bytes as follow."""
    stream = io.BytesIO(content)
    version = np.lib.format.read_magic(stream)
    if version not in _HEADERS:
        raise ValueError(f"array {name!r} is of version {version}, unknown here")
    shape, fortran, dtype = _HEADERS[version](stream)
    if dtype.hasobject:
        raise ValueError(f"array {name!r} holds Python objects, which are never opened")
    claimed, there = math.prod(shape) * dtype.itemsize, len(content) - stream.tell()
    if min(shape, default=0) < 0 or claimed != there:
        raise ValueError(f"array {name!r} of shape {shape} needs {claimed} bytes, {there} are there")
    flat: np.ndarray[Any, Any] = np.empty(math.prod(shape), dtype)
    if claimed:
        flat[:] = np.frombuffer(content, dtype, offset=stream.tell())
    return flat.reshape(shape, order="F" if fortran else "C")
