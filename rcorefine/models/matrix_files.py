"""Matrix files: text (.csv), Matrix Market (.mtx) and NumPy (.npy)."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from scipy.sparse import coo_matrix

from ..archives import array_of
from ..data.apart import read_apart
from ..exceptions import ModelError

__all__ = ["SUFFIXES", "read_matrix"]

SUFFIXES = (".csv", ".mtx", ".npy")


def read_matrix(path: Path, where: str) -> Any:
    """Matrix of a file.

    Parameters
    ----------
    path : Path
        ``.csv`` (rows of numbers between commas, semicolons or blanks, ``#`` before remarks), ``.mtx``
        (Matrix Market, of which a symmetric one holds a half) or ``.npy``.
    where : str
        Who asks, for messages.

    Returns
    -------
    ndarray or sparse array
        As the file has it, numbers unchecked; sparse where a ``.mtx`` is.

    Raises
    ------
    ModelError
        If it is not there, or holds no matrix.
    """
    suffix = path.suffix.lower()
    if suffix not in SUFFIXES:
        raise ModelError(
            f"{where}: a matrix is rows of numbers or a {', '.join(SUFFIXES)} file, not {path.name!r}"
        )
    try:
        if suffix == ".csv":
            return _from_text(path)
        if suffix == ".npy":
            return array_of(path.read_bytes(), path.name)
        found = read_apart(path, "mtx", "Matrix Market file that scipy")
        if "shape" not in found:
            return found["data"]
        return coo_matrix((found["data"], (found["row"], found["col"])), shape=tuple(found["shape"]))
    except OSError as error:
        raise ModelError(f"{where}: {path} cannot be read: {error.strerror or error}") from error
    except Exception as error:  # a header's parser, too, fails in a dozen ways
        raise ModelError(f"{where}: {path} holds no matrix: {error}") from error


def _from_text(path: Path) -> Any:
    lines = path.read_text(encoding="utf-8-sig").splitlines()
    rows = [line.split("#")[0].strip() for line in lines]
    text = [row for row in rows if row]
    if any(";" in row for row in text):  # a comma is the decimal one there
        text = [row.replace(",", ".") for row in text]
    mark = next((mark for mark in ",;" if any(mark in row for row in text)), None)
    if not text:
        raise ValueError("it is empty")
    return np.loadtxt(text, delimiter=mark, ndmin=2)
