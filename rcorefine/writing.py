"""Safe replacement of files, and safe NumPy archives.

A file is written beside the old one and then takes its place: a reader finds either the old or the new one.
Whatever fails while a file is read is an error of the file (`damaged`).
"""

from __future__ import annotations

import contextlib
import errno
import io
import math
import os
import re
import secrets
import stat
import zipfile
from collections.abc import Iterator
from os import PathLike, fspath
from pathlib import Path
from typing import Any, BinaryIO, cast

import control as ct
import numpy as np

from .arguments import as_flag, as_path, as_text
from .exceptions import DataError, RCOError

try:
    import fcntl
except ImportError:  # Windows, where nobody removes or replaces a file that is open
    fcntl = None  # type: ignore[assignment]

_SHOWN = 60  # characters of the file's name in that of its draft: names may have 255 bytes


@contextlib.contextmanager
def replacing(path: str | os.PathLike[str]) -> Iterator[BinaryIO]:
    """Open a draft that takes the place of a file once it is written whole.

    Parameters
    ----------
    path : str or path
        File to write. A link is followed; an older file hands on its mode and,
        where the system allows it, its owner. What is no file (a pipe,
        ``/dev/stdout``) is written to directly.

    Yields
    ------
    binary stream
        To write to. Where the block raises, or the process dies, the older file stays.

    Raises
    ------
    IsADirectoryError
        If a folder is there.
    PermissionError
        If the file is write-protected, or the folder does not let one write.
    OSError
        If the disk is full, the folder missing and the like; the file is named.

    Examples
    --------
    >>> import pathlib, tempfile
    >>> path = pathlib.Path(tempfile.mkdtemp()) / "notes.txt"
    >>> with replacing(path) as stream:
    ...     _ = stream.write(b"whole")
    >>> path.read_bytes()
    b'whole'
    """
    target = as_path(path)
    old = _status(target)
    if old is not None and not stat.S_ISREG(old.st_mode):
        with target.open("wb") as straight:
            yield straight
        return
    target = Path(os.path.realpath(target))
    if old is not None and not os.access(target, os.W_OK):
        raise PermissionError(errno.EACCES, "the file is write-protected", str(target))
    beside = target.with_name(f".{target.name[:_SHOWN]}.")
    _sweep(beside)
    try:
        draft, stream = _draft(beside)
        try:
            yield stream
            stream.flush()
            os.fsync(stream.fileno())
            if old is not None:
                _hand_on(old, draft)
            if fcntl is None:
                stream.close()
            os.replace(draft, target)  # before the lock goes with the stream
        except BaseException:
            with contextlib.suppress(OSError):  # what it still held has no place on a full disk
                stream.close()
            draft.unlink(missing_ok=True)
            raise
        stream.close()
    except OSError as error:
        if error.errno is None or not str(error.filename or beside).startswith(str(beside)):
            raise
        raise OSError(error.errno, error.strerror, str(path)) from error  # the draft is nobody's business
    _keep_entry(target.parent)


def _status(target: Path) -> os.stat_result | None:
    try:
        return target.stat()
    except FileNotFoundError:
        return None


def _draft(beside: Path) -> tuple[Path, BinaryIO]:
    """New file in the same folder, locked for as long as it is open."""
    while True:
        draft = beside.with_name(f"{beside.name}{secrets.token_hex(4)}.tmp")
        stream = cast(BinaryIO, draft.open("xb"))
        if fcntl is None:
            return draft, stream
        with contextlib.suppress(OSError):  # a file system without locks is one without sweeping
            fcntl.flock(stream, fcntl.LOCK_EX)
        if os.fstat(stream.fileno()).st_nlink:
            return draft, stream
        stream.close()  # swept between the two lines above


def _sweep(beside: Path) -> None:
    """Remove drafts of a file whose writing process has died.

    Drafts that are still being written are locked, and stay.
    """
    pattern = re.compile(rf"{re.escape(beside.name)}[0-9a-f]{{8}}\.tmp")
    with contextlib.suppress(OSError):  # what cannot be removed is no hindrance to writing
        with os.scandir(beside.parent) as entries:
            left = [entry.path for entry in entries if pattern.fullmatch(entry.name)]
        for draft in left:
            with contextlib.suppress(OSError), open(draft, "rb") as stream:
                if fcntl is not None:
                    fcntl.flock(stream, fcntl.LOCK_EX | fcntl.LOCK_NB)
                    os.unlink(draft)
            if fcntl is None:
                with contextlib.suppress(OSError):
                    os.unlink(draft)


def _hand_on(old: os.stat_result, draft: Path) -> None:
    """Give a draft the group, owner and mode of the older file.

    The order matters: a new owner clears bits of the mode.
    """
    if hasattr(os, "chown"):
        for owner in ((-1, old.st_gid), (old.st_uid, -1)):
            with contextlib.suppress(PermissionError):  # only the administrator gives files away
                os.chown(draft, *owner)
    os.chmod(draft, stat.S_IMODE(old.st_mode))


def _keep_entry(folder: Path) -> None:
    """Write the folder to disk so that the new name survives a power cut."""
    if os.name == "nt":  # folders cannot be opened there
        return
    with contextlib.suppress(OSError):  # some file systems cannot; the file itself is there
        handle = os.open(folder, os.O_RDONLY)
        try:
            os.fsync(handle)
        finally:
            os.close(handle)


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


@contextlib.contextmanager
def damaged(path: str | PathLike[str], said: str = "is damaged") -> Iterator[None]:
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


#: How a report begins that `views` wrote: such a file may be replaced by another one.
REPORT = '<meta name="generator" content="rcorefine'


def check_target(
    path: str | PathLike[str],
    *,
    title: str | None = None,
    code: str | None = None,
    overwrite: bool = False,
    ours: str = REPORT,
) -> Path:
    """Absolute path of a report to be written; raises where that must not be.

    Parameters
    ----------
    path : str or path
        File to write.
    title, code : str, optional
        What it is to say, checked with it before the work begins.
    overwrite : bool
        Whether any file there may be replaced.
    ours : str
        What a file that may be replaced has in its first 2,000 bytes.

    Returns
    -------
    Path
        Absolute.

    Raises
    ------
    FileNotFoundError
        If the folder does not exist.
    FileExistsError
        If a file is there that is no report of rcorefine.
    IsADirectoryError
        If `path` is a folder.
    """
    for name, text in (("title", title), ("code", code)):
        if text is not None:
            as_text(text, name)
    as_flag(overwrite, "overwrite")
    target = as_path(path)
    with contextlib.suppress(RuntimeError):  # a tilde that is nobody's home is a name like any other
        target = target.expanduser()
    target = target.absolute()
    if target.is_dir():
        raise IsADirectoryError(f"{target} is a folder; give the name of a file in it, such as report.html")
    if not target.parent.is_dir():
        raise FileNotFoundError(f"the folder {target.parent} does not exist; make it first")
    if target.is_file() and not overwrite:
        with target.open("rb") as file:
            head = file.read(2000)
        if head and ours.encode() not in head:  # an empty file holds nothing to lose
            raise FileExistsError(
                f"{target} exists and is no report of rcorefine; choose another name or say overwrite=True"
            )
    return target
