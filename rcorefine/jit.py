"""Kernels are plain Python that numba compiles where it is installed.

`compiled` is the only place that knows numba. With the environment variable
``RCOREFINE_NUMBA=0`` the very same functions run as plain Python, which is
how the tests compare both ways.
"""

from __future__ import annotations

import os
from collections.abc import Callable
from typing import Any, TypeVar

__all__ = ["FASTMATH", "NUMBA", "compiled"]

_Function = TypeVar("_Function", bound=Callable[..., Any])

#: Reordering of sums is allowed (that is what vectorizes them); NaN and Inf keep their
#: meaning, for the kernels rely on them to notice divergence.
FASTMATH = {"reassoc", "contract", "nsz", "arcp"}


def _numba() -> Any:
    """Return the numba module, or None where it is absent or switched off."""
    if os.environ.get("RCOREFINE_NUMBA", "1") == "0":
        return None
    try:
        import numba
    except ImportError:
        return None
    return numba


_NUMBA = _numba()

#: Whether kernels are compiled in this process.
NUMBA: bool = _NUMBA is not None


def compiled(function: _Function) -> _Function:
    """Compile a kernel with numba, or return it as it is.

    Parameters
    ----------
    function : callable
        Array function without objects, keywords or validation. Kernels that
        it calls must be compiled too, and stand in the same file: numba's
        cache notices a change of the file only.

    Returns
    -------
    callable
        Compiled function (cached on disk, where there is a place to write),
        or `function` itself without numba.

    Examples
    --------
    >>> from rcorefine.jit import compiled
    >>> @compiled
    ... def add(a, b):
    ...     return a + b
    >>> add(1.0, 2.0)
    3.0
    """
    if _NUMBA is None:
        return function
    try:
        return _NUMBA.njit(cache=True, fastmath=FASTMATH, error_model="numpy")(function)  # type: ignore[no-any-return]
    except RuntimeError:  # no file or no folder to cache in, as in an interactive session
        return _NUMBA.njit(fastmath=FASTMATH, error_model="numpy")(function)  # type: ignore[no-any-return]
