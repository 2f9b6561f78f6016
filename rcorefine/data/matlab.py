"""Variables out of MATLAB files."""

from __future__ import annotations

import os
from typing import Any

from .apart import read_apart

__all__ = ["read_matlab"]


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
    return read_apart(path, "mat", "MATLAB file that scipy", said={"NotImplementedError": _NEWER})


_NEWER = (
    "is a MATLAB 7.3 (HDF5) file; save it anew in MATLAB with save(..., '-v7'), "
    'or install the extra "formats": pip install "rcorefine[formats]"'
)
