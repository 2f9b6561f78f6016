"""Kernels are plain Python that numba compiles where it is installed.

This is the only file that knows numba. With the environment variable
``RCOREFINE_NUMBA=0`` the very same functions run as plain Python, which is
how the tests compare both ways.
"""

from __future__ import annotations

import ctypes
import gc
import os
from collections.abc import Callable
from typing import Any, TypeVar

__all__ = [
    "FASTMATH",
    "NUMBA",
    "address_of",
    "call_at",
    "compiled",
    "compiled_law",
    "number_at",
    "put",
    "put_rows",
]

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
    options = {"fastmath": FASTMATH, "error_model": "numpy", "no_cfunc_wrapper": True}
    try:
        found = _NUMBA.njit(cache=True, **options)(function)
    except RuntimeError:  # no file or no folder to cache in, as in an interactive session
        found = _NUMBA.njit(**options)(function)
    return _soon_compiled(found)  # type: ignore[no-any-return]


def _soon_compiled(dispatcher: Any) -> Any:
    """Have a kernel compiled in three quarters of numba's time: once, and without the garbage collector.

    numba compiles a function anew for each constant that a kernel hands to it, and makes so many
    lasting objects that a seventh of its time goes into looking for garbage among them.
    """
    template, build = dispatcher.get_call_template, dispatcher.compile

    def template_of_types(args: Any, kws: Any) -> Any:
        return template([_NUMBA.types.unliteral(one) for one in args], kws)

    def undisturbed(signature: Any) -> Any:
        collects = gc.isenabled()
        gc.disable()
        try:
            return build(signature)
        finally:
            if collects:
                gc.enable()

    dispatcher.get_call_template, dispatcher.compile = template_of_types, undisturbed
    return dispatcher


# Assigning one array to a part of another is short in Python, and long to compile: numba brings its checks
# of shapes along, with the text that they would raise. So kernels copy by these.
if NUMBA:

    @compiled
    def put(out, at, values):  # type: ignore[no-untyped-def]
        """Copy a row into another, from entry `at` on."""
        for i in range(values.shape[0]):
            out[at + i] = values[i]

    @compiled
    def put_rows(out, values):  # type: ignore[no-untyped-def]
        """Copy a matrix over another, or over its first rows."""
        for i in range(values.shape[0]):
            for j in range(values.shape[1]):
                out[i, j] = values[i, j]

else:

    def put(out, at, values):  # type: ignore[no-untyped-def]
        """Copy a row into another, from entry `at` on."""
        out[at : at + values.shape[0]] = values

    def put_rows(out, values):  # type: ignore[no-untyped-def]
        """Copy a matrix over another, or over its first rows."""
        out[: values.shape[0]] = values


def _call_at() -> Any:
    """Intrinsic that calls a C function: ``(address, 4 floats, row, float, row, int, row)``."""
    from llvmlite import ir  # type: ignore[import-untyped, unused-ignore]
    from numba import types
    from numba.extending import intrinsic

    real, whole, pointer = types.float64, types.int64, types.uintp
    number, size = ir.DoubleType(), ir.IntType(64)
    row = number.as_pointer()
    kinds = [*[number] * 4, row, number, row, size, row]

    def lower(context: Any, builder: Any, signature: Any, given: Any) -> Any:
        function = builder.inttoptr(given[0], ir.FunctionType(ir.VoidType(), kinds).as_pointer())
        values = [
            builder.inttoptr(value, kind) if kind is row else value
            for value, kind in zip(given[1:], kinds, strict=True)
        ]
        builder.call(function, values)
        return context.get_dummy_value()

    def call(typing, code, a, b, c, d, first, e, second, n, third):  # type: ignore[no-untyped-def]
        return types.void(whole, *[real] * 4, pointer, real, pointer, whole, pointer), lower

    return intrinsic(call)


call_at: Any = None if _NUMBA is None else _call_at()


def _number_at() -> Any:
    """Intrinsic that reads a number of an array: ``(address, index)``."""
    from llvmlite import ir
    from numba import types
    from numba.extending import intrinsic

    def lower(context: Any, builder: Any, signature: Any, given: Any) -> Any:
        row = builder.inttoptr(given[0], ir.DoubleType().as_pointer())
        return builder.load(builder.gep(row, [given[1]]))

    def read(typing, address, index):  # type: ignore[no-untyped-def]
        return types.float64(types.int64, types.int64), lower

    return intrinsic(read)


def _plain_number_at(address: int, index: int) -> float:
    return ctypes.c_double.from_address(address + 8 * index).value


number_at: Any = _plain_number_at if _NUMBA is None else _number_at()


def compiled_law(function: _Function) -> _Function:
    """Compile a small function into each function that calls it."""
    if _NUMBA is None or hasattr(function, "py_func"):
        return function
    return _NUMBA.njit(fastmath=FASTMATH, error_model="numpy")(function)  # type: ignore[no-any-return]


def address_of(function: Callable[..., None], cache: bool) -> tuple[int, Any]:
    """Address of a function as `call_at` takes it, compiled; and what keeps it alive.

    Raises
    ------
    TypeError
        If numba cannot compile it.
    """
    assert _NUMBA is not None
    function.__globals__["carray"] = _NUMBA.carray
    types = _NUMBA.types
    real, row = types.float64, types.CPointer(types.float64)
    signature = types.void(real, real, real, real, row, real, row, types.int64, row)
    try:
        try:
            found = _NUMBA.cfunc(signature, cache=cache, error_model="numpy")(function)
        except RuntimeError:  # no file or no folder to cache in
            found = _NUMBA.cfunc(signature, error_model="numpy")(function)
    except _NUMBA.core.errors.NumbaError as error:
        raise TypeError(str(error)) from error
    return int(found.address), found
