"""Tracing of a user's function with symbols.

The functions of math, numpy and Python that it calls are replaced by ones that take symbols.
"""

from __future__ import annotations

import builtins
import math
from collections.abc import Callable
from functools import partial
from types import CellType, FunctionType, MethodType
from typing import Any

import numpy as np

from .expressions import Number, Symbolic, Untraceable, as_numpy_calls, maximum, minimum

__all__ = ["OF_NUMPY", "as_numbers", "tracing"]

_Function = Callable[..., Any]
#: What numpy calls the functions of math, where it is another name.
OF_NUMPY = {"asin": "arcsin", "acos": "arccos", "atan": "arctan", "asinh": "arcsinh"}
OF_NUMPY |= {"atan2": "arctan2", "pow": "power"}


def tracing(function: _Function) -> _Function:
    """Return the function with its modules and helpers replaced.

    The replacements take symbols.

    Parameters
    ----------
    function : callable
        As a user wrote it, or compiled by numba.

    Returns
    -------
    callable
        It raises whatever comes of what cannot be traced.
    """
    return _Replacing().of(getattr(function, "py_func", function))  # type: ignore[no-any-return]


def as_numbers(values: Any) -> list[Number]:
    """Return the values that a function returned, as a flat list."""
    entries = np.asarray(values, dtype=object).reshape(-1).tolist()
    return [one if isinstance(one, Symbolic) else float(one) for one in entries]


class _Replacing:
    """Functions in which the names from outside are replaced.

    Each function is replaced once.
    """

    def __init__(self) -> None:
        self._made: dict[int, Any] = {}

    def of(self, value: Any) -> Any:
        """Return the replacement of a value that a function names."""
        if isinstance(value, MethodType):
            return MethodType(self.of(value.__func__), value.__self__)
        if isinstance(value, partial):
            return partial(self.of(value.func), *value.args, **value.keywords)
        if value is math:
            return _MATH
        if value is np:
            return _NUMPY
        if id(value) in _PYTHON:
            return _PYTHON[id(value)]
        name = str(getattr(value, "__name__", ""))
        for module, stand in ((math, _MATH), (np, _NUMPY)):
            if name and vars(module).get(name) is value:
                return getattr(stand, name)
        value = getattr(value, "py_func", value)
        if not isinstance(value, FunctionType) or (value.__module__ or "").partition(".")[0] == "numpy":
            return value
        if id(value) not in self._made:
            self._function(value)
        return self._made[id(value)]

    def _function(self, function: FunctionType) -> None:
        scope = {"__builtins__": builtins, **_REPLACED}
        cells = tuple(CellType() for _ in function.__closure__ or ())
        made = FunctionType(function.__code__, scope, function.__name__, function.__defaults__, cells)
        made.__kwdefaults__ = function.__kwdefaults__
        self._made[id(function)] = made  # before what it names, which may be itself
        for cell, before in zip(cells, function.__closure__ or (), strict=True):
            cell.cell_contents = self.of(before.cell_contents)
        for name, value in function.__globals__.items():
            if name != "__builtins__":
                scope[name] = self.of(value) if name in _named(function) else value


def _named(function: FunctionType) -> set[str]:
    """Names that the code uses, with those of functions inside it."""
    found: set[str] = set()
    waiting = [function.__code__]
    while waiting:
        code = waiting.pop()
        found.update(code.co_names)
        waiting += [one for one in code.co_consts if hasattr(one, "co_names")]
    return found


class _Math:
    """The module math, for symbols."""

    def __getattr__(self, name: str) -> Any:
        plain = getattr(math, name)
        if not callable(plain):
            return plain

        def taken(*given: Any) -> Any:
            if not any(isinstance(one, Symbolic) for one in given):
                return plain(*given)
            ufunc = getattr(np, OF_NUMPY.get(name, name), None)
            if not isinstance(ufunc, np.ufunc):
                raise Untraceable(name)
            return ufunc(*given)

        return taken


class _Numpy:
    """The module numpy, whose arrays have room for symbols."""

    def __getattr__(self, name: str) -> Any:
        found = getattr(np, name)
        clip = name == "clip"
        function = (lambda x, low, high: minimum(maximum(x, low), high)) if clip else as_numpy_calls(name)
        if function is not None:
            return partial(_entry_by_entry, function, found)
        if name not in _MAKERS:
            return found

        def made(*given: Any, dtype: Any = None, **more: Any) -> Any:
            return found(*given[: _MAKERS[name]], dtype=object, **more)

        return made


def _entry_by_entry(function: _Function, plain: _Function, *given: Any, **more: Any) -> Any:
    """A function of numbers on arrays of which entries may be symbols."""
    if more or not any(np.asarray(one).dtype == object for one in given):
        return plain(*given, **more)
    if any(np.ndim(one) for one in given if not isinstance(one, Symbolic)):
        return np.frompyfunc(function, len(given), 1)(*given)
    return function(*given)


def _as_float(value: Any = 0.0) -> Any:
    return value if isinstance(value, Symbolic) else float(value)


def _extreme(plain: _Function, symbolic: _Function, *given: Any, **more: Any) -> Any:
    values = list(given[0]) if len(given) == 1 else given
    return symbolic(*values) if any(isinstance(one, Symbolic) for one in values) else plain(*given, **more)


#: Functions of numpy that make arrays, with the number of arguments before the type.
_MAKERS = {"array": 1, "asarray": 1, "zeros": 1, "ones": 1, "empty": 1, "zeros_like": 1, "empty_like": 1}
_REPLACED: dict[str, Any] = {"float": _as_float, "max": partial(_extreme, max, maximum)}
_REPLACED["min"] = partial(_extreme, min, minimum)
_PYTHON = {id(getattr(builtins, name)): stand for name, stand in _REPLACED.items()}
_MATH, _NUMPY = _Math(), _Numpy()
