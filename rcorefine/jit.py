"""Kernels are plain Python that numba compiles where it is installed.

This is the only file that knows numba. With the environment variable
``RCOREFINE_NUMBA=0`` the very same functions run as plain Python, which is
how the tests compare both ways.
"""

from __future__ import annotations

import ctypes
import gc
import operator
import os
import stat
import tempfile
from collections.abc import Callable
from contextlib import suppress
from functools import cache
from types import FunctionType
from typing import Any, TypeVar

import numpy as np

_Function = TypeVar("_Function", bound=Callable[..., Any])

#: Reordering of sums is allowed (that is what vectorizes them); NaN and Inf keep their
#: meaning, for the kernels rely on them to notice divergence.
FASTMATH = {"reassoc", "contract", "nsz", "arcp"}


_NUMBA: Any = None  # absent, or switched off
if os.environ.get("RCOREFINE_NUMBA", "1") != "0":
    with suppress(ImportError):
        import numba

        _NUMBA = numba

#: Whether kernels are compiled in this process.
NUMBA: bool = _NUMBA is not None
if NUMBA:
    from llvmlite import ir  # type: ignore[import-untyped, unused-ignore]
    from numba import types
    from numba.core import imputils
    from numba.extending import intrinsic


def compiled(function: _Function, *, inline: bool = False, lanes: bool = False) -> _Function:
    """Compile a kernel with numba, or return it as it is.

    Parameters
    ----------
    function : callable
        Array function without objects, keywords or validation. Kernels that
        it calls must be compiled too, and stand in the same file: numba's
        cache notices a change of the file only.
    inline : bool
        Whether its code is copied into each kernel that calls it: for the small products that a march
        calls many times per sample. In small models the calls take more time than the products.
    lanes : bool
        Whether equal arithmetic on neighboring entries becomes vectors, and not loops: for loops of few
        rounds.

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
    dispatcher = _dispatcher(function, lanes)

    # For each kernel numba makes a second function that takes Python's objects, and compiles it anew for each
    # constant that it is given: where a kernel calls a kernel both are in vain, so there it is another one.
    @cache
    def within() -> Any:
        return _dispatcher(_renamed(function), lanes, no_cpython_wrapper=True, forceinline=inline)

    def template(args: Any, kws: Any) -> Any:
        return within().get_call_template([_NUMBA.types.unliteral(one) for one in args], kws)

    dispatcher.get_call_template = template
    dispatcher.get_overload = lambda signature: within().get_overload(signature)
    return dispatcher  # type: ignore[no-any-return]


def inlined(function: _Function) -> _Function:
    """Compile a kernel into each kernel that calls it; see `compiled`."""
    return compiled(function, inline=True, lanes=True)


def _dispatcher(function: Callable[..., Any], lanes: bool, **more: bool) -> Any:
    """Return a function that numba compiles when it is first called."""
    options = {"fastmath": FASTMATH, "error_model": "numpy", "no_cfunc_wrapper": True, "nogil": True, **more}
    found = _kept(_NUMBA.njit, function, **options)
    build = found.compile

    def undisturbed(signature: Any) -> Any:
        config, collects = _NUMBA.config, gc.isenabled()
        before = config.SLP_VECTORIZE, config.LOOP_VECTORIZE
        config.SLP_VECTORIZE, config.LOOP_VECTORIZE = (1, 0) if lanes else (0, 1)
        # numba makes so many lasting objects that looking for garbage among them is a seventh of its time
        gc.disable()
        try:
            return build(signature)
        finally:
            config.SLP_VECTORIZE, config.LOOP_VECTORIZE = before
            if collects:
                gc.enable()

    found.compile = undisturbed
    return found


def _kept(decorator: Callable[..., Any], function: Callable[..., Any], *given: Any, **options: Any) -> Any:
    """Return a function whose compiled code numba caches.

    The cache is beside the file, in the home folder, or in a folder of its own.
    """
    before = _NUMBA.config.CACHE_DIR
    for find in (lambda: before, _own_folder):
        try:
            _NUMBA.config.CACHE_DIR = find()
            return decorator(*given, cache=True, **options)(function)
        except RuntimeError:  # no file, as in an interactive session, or no folder that can be written to
            continue
        finally:
            _NUMBA.config.CACHE_DIR = before
    return decorator(*given, **options)(function)


@cache
def _own_folder() -> str:
    """Return a private temporary folder, or an empty string.

    Nobody else may write there, because its content is executed. The string is empty if there is no such
    folder.
    """
    if not hasattr(os, "getuid"):
        return ""
    try:
        folder = os.path.join(tempfile.gettempdir(), f"rcorefine-{os.getuid()}")
        with suppress(FileExistsError):
            os.mkdir(folder, 0o700)
        found = os.lstat(folder)
    except OSError:
        return ""
    own = stat.S_ISDIR(found.st_mode) and found.st_uid == os.getuid() and not found.st_mode & 0o077
    return folder if own else ""


def _renamed(function: Callable[..., Any]) -> Callable[..., Any]:
    """Return a copy of a function under another name.

    The file in numba's cache is distinguished by the name only.
    """
    found = FunctionType(
        function.__code__,
        function.__globals__,
        function.__name__,
        function.__defaults__,
        function.__closure__,
    )
    found.__qualname__ = f"{function.__qualname__}.within"
    found.__module__ = function.__module__
    return found


# Assigning one array to a part of another is short in Python, and long to compile: numba brings its checks
# of shapes along, with the text that they would raise. So kernels copy by these.
if NUMBA:

    @inlined
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
    """Return an intrinsic that calls the C function at an address.

    Its arguments are ``(address, 4 floats, row, float, row, int, row)``.
    """
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

    def lower(context: Any, builder: Any, signature: Any, given: Any) -> Any:
        row = builder.inttoptr(given[0], ir.DoubleType().as_pointer())
        return builder.load(builder.gep(row, [given[1]]))

    def read(typing, address, index):  # type: ignore[no-untyped-def]
        return types.float64(types.int64, types.int64), lower

    return intrinsic(read)


number_at: Any = (
    _number_at() if NUMBA else lambda address, index: ctypes.c_double.from_address(address + 8 * index).value
)


def by_address(
    kernel: Callable[..., int], example: Callable[[], tuple[Any, ...]]
) -> tuple[Callable[..., int], Callable[[], int]]:
    """Return the means to call a compiled kernel by its address.

    A large kernel is then compiled once, and not again into each kernel that calls it.

    Parameters
    ----------
    kernel : callable
        Compiled kernel that returns a whole number.
    example : callable
        Gives arguments that have its types.

    Returns
    -------
    call : callable
        ``call(address, ...)`` in kernels.
    address : callable
        The address in this process, without arguments.
    """
    if _NUMBA is None:
        return lambda address, *given: kernel(*given), lambda: 0
    kinds, whole = tuple(_NUMBA.typeof(given) for given in example()), types.int64

    def lower(context: Any, builder: Any, signature: Any, given: Any) -> Any:
        convention = context.call_conv
        function = builder.inttoptr(given[0], convention.get_function_type(whole, kinds).as_pointer())
        values = [builder.extract_value(given[1], i) for i in range(len(kinds))]
        status, found = convention.call_function(builder, function, whole, kinds, values)
        with builder.if_then(status.is_error, likely=False):
            convention.return_status_propagate(builder, status)
        return imputils.impl_ret_untracked(context, builder, whole, found)

    def call(typing, address, *given):  # type: ignore[no-untyped-def]
        for i, (one, kind) in enumerate(zip(given, kinds, strict=True)):
            if one != kind:
                raise _NUMBA.core.errors.TypingError(f"argument {i} is {one}, not {kind}")
        return whole(types.int64, types.StarArgTuple(given)), lower

    @cache
    def address() -> int:
        kernel.compile(kinds)  # type: ignore[attr-defined]
        found = kernel.overloads[kinds]  # type: ignore[attr-defined]
        return int(found.library.get_pointer_to_function(found.fndesc.llvm_func_name))

    return intrinsic(call), address


def _entries_by_list() -> None:
    """Teach numba ``x[[0, 2]]``, as users pick states in what a model shows."""

    def picked(x, index):  # type: ignore[no-untyped-def]
        if not (isinstance(x, types.Array) and x.ndim == 1 and isinstance(index, types.List)):
            return None
        if not isinstance(index.dtype, types.Integer):
            return None

        def entries(x, index):  # type: ignore[no-untyped-def]
            found = np.empty(len(index), x.dtype)
            for i in range(len(index)):
                found[i] = x[index[i]]
            return found

        return entries

    _NUMBA.extending.overload(operator.getitem)(picked)


if _NUMBA is not None:
    _entries_by_list()


def compiled_law(function: _Function) -> _Function:
    """Compile a small function into each function that calls it."""
    if _NUMBA is None or hasattr(function, "py_func"):
        return function
    return _NUMBA.njit(fastmath=FASTMATH, error_model="numpy")(function)  # type: ignore[no-any-return]


def address_of(function: Callable[..., None], cache: bool) -> tuple[int, Any]:
    """Compile a function and return its address for `call_at`.

    The second value keeps the compiled function alive.

    Raises
    ------
    TypeError
        If numba cannot compile it.
    """
    assert _NUMBA is not None
    function.__globals__["carray"] = _NUMBA.carray
    real, row = types.float64, types.CPointer(types.float64)
    signature = types.void(real, real, real, real, row, real, row, types.int64, row)
    try:
        if cache:
            found = _kept(_NUMBA.cfunc, function, signature, error_model="numpy")
        else:
            found = _NUMBA.cfunc(signature, error_model="numpy")(function)
    except Exception as error:  # errors of numba have no common base class
        raise TypeError(str(error)) from error
    return int(found.address), found
