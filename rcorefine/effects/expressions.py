"""Python functions as straight-line code with exact derivatives.

A function is called with symbols; the functions of math, numpy and Python that it calls are replaced by
ones that take symbols. What hangs on a value (a conversion, a loop) is `Untraceable`. Where it compares
values, `Tape.branches` calls it once for each answer.
"""

from __future__ import annotations

import builtins
import math
import operator
import pickle
from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import partial, reduce
from types import (
    BuiltinFunctionType,
    CellType,
    CodeType,
    FunctionType,
    MethodType,
    ModuleType,
    NoneType,
    SimpleNamespace,
)
from typing import Any, Final, TypeAlias, TypeVar

import numpy as np

#: What numpy calls the functions of math, where it is another name.
OF_NUMPY = {"asin": "arcsin", "acos": "arccos", "atan": "arctan", "asinh": "arcsinh"}
OF_NUMPY |= {"atan2": "arctan2", "pow": "power"}
_LIBRARIES = {"builtins", "math", "numpy", "scipy", "rcorefine"}  # numba knows these
_CONSTANT = {bool, int, float, str, bytes, NoneType}  # what numba takes as it is
_NUMPY_VALUE = np.generic, np.ndarray
_QUIET = SimpleNamespace(  # functions of math that return inf and NaN
    **{name: getattr(np, OF_NUMPY.get(name, name), None) for name in dir(math) if not name.startswith("_")}
)
_MOST_BRANCHES = 6  # most comparisons on one path through a function
_MOST = 20_000  # most operations; longer code takes more time to compile than it saves


class Untraceable(TypeError):
    """The function asks for more than the symbol of a number."""


class _Fork(BaseException):  # no `except Exception` of the traced function may catch it
    """The function compares two values, and the answer is not known."""


# operators of a symbol: each adds an operation to the tape
def _operation(name: str, swapped: bool = False) -> Callable[[Symbolic, Any], Number]:
    def taken(self: Symbolic, other: Any) -> Number:
        return self.tape.take(name, *((other, self) if swapped else (self, other)))

    return taken


def _comparison(relation: str) -> Callable[[Symbolic, Any], bool]:
    return lambda self, other: self.tape.holds(self, relation, other)


class Symbolic:
    """A number that is not known yet: an operation on a tape."""

    __slots__ = ("at", "tape")
    __hash__ = None  # type: ignore[assignment]

    def __init__(self, tape: Tape, at: int) -> None:
        self.tape, self.at = tape, at

    __add__, __radd__ = _operation("+"), _operation("+", swapped=True)
    __sub__, __rsub__ = _operation("-"), _operation("-", swapped=True)
    __mul__, __rmul__ = _operation("*"), _operation("*", swapped=True)
    __truediv__, __rtruediv__ = _operation("/"), _operation("/", swapped=True)
    __pow__, __rpow__ = _operation("**"), _operation("**", swapped=True)

    def __neg__(self) -> Number:
        return self.tape.take("-", 0.0, self)

    def __abs__(self) -> Number:
        return self.tape.take("fabs", self)

    def clip(self, low: Any, high: Any, out: None = None) -> Number:
        """Held between two numbers, as `numpy.clip` asks of an object."""
        held = self if low is None else maximum(self, low)
        return held if high is None else minimum(held, high)

    def __array_ufunc__(self, ufunc: np.ufunc, method: str, *given: Any, **more: Any) -> Any:
        if method != "__call__" or more:
            raise Untraceable(f"{ufunc.__name__} {method}")
        # an array with symbols: entry by entry
        if any(isinstance(one, np.ndarray) for one in given):
            return ufunc(*(_entry(one) if isinstance(one, Symbolic) else one for one in given))
        function = as_numpy_calls(ufunc.__name__)
        if function is None:
            raise Untraceable(ufunc.__name__)
        return function(*given)

    def __getattr__(self, name: str) -> Callable[..., Number]:
        """Return the method that numpy calls on entries of an array of objects.

        For example, ``np.sin(x)`` calls ``x[i].sin()``.
        """
        function = as_numpy_calls(name)
        if function is None:
            raise AttributeError(name)
        return partial(function, self)

    def _value(self, *_: Any) -> Any:
        raise Untraceable("the value of a number decides")

    __bool__ = __float__ = __int__ = __index__ = __complex__ = __iter__ = __len__ = _value
    __mod__ = __floordiv__ = __round__ = _value

    __eq__, __ne__ = _comparison("=="), _comparison("!=")
    __lt__, __le__ = _comparison("<"), _comparison("<=")
    __gt__, __ge__ = _comparison(">"), _comparison(">=")


Number: TypeAlias = Symbolic | float


def _entry(one: Symbolic) -> Any:
    """An array of objects without dimensions that holds it."""
    found = np.empty((), dtype=object)
    found[()] = one
    return found


def _both(name: str, *given: Any) -> Number:
    """An operation on numbers of which some may be known."""
    tape = next((one.tape for one in given if isinstance(one, Symbolic)), None)
    return Tape().take(name, *given) if tape is None else tape.take(name, *given)


# extremes of numbers of which some are symbols
def maximum(*given: Any) -> Number:
    """The largest of some numbers."""
    return reduce(partial(_both, "max"), given)  # type: ignore[no-any-return]


def minimum(*given: Any) -> Number:
    """The smallest of some numbers."""
    return reduce(partial(_both, "min"), given)  # type: ignore[no-any-return]


#: Operations on numbers that are known, by name.
_KNOWN: Final[Mapping[str, Callable[..., float]]] = {
    "+": operator.add,
    "-": operator.sub,
    "*": operator.mul,
    "/": operator.truediv,
    "**": math.pow,
    "max": max,
    "min": min,
    "pick": lambda a, b, yes, no: yes if a >= b else no,
}


#: Operations that known numbers make simple; None where they do not.
_SIMPLER: Final[Mapping[str, Callable[..., Number | None]]] = {
    "+": lambda a, b: b if is_number(a, 0.0) else a if is_number(b, 0.0) else None,
    "-": lambda a, b: a if is_number(b, 0.0) else 0.0 if _same(a, b) else None,
    "*": lambda a, b: (
        0.0
        if is_number(a, 0.0) or is_number(b, 0.0)
        else b
        if is_number(a, 1.0)
        else a
        if is_number(b, 1.0)
        else None
    ),
    "/": lambda a, b: 0.0 if is_number(a, 0.0) else a if is_number(b, 1.0) else None,
    # small whole powers as products: faster than a power, and valid for negative bases
    "**": lambda a, b: (
        None if isinstance(b, Symbolic) or b not in range(5) else reduce(operator.mul, [a] * int(b), 1.0)
    ),
    "pick": lambda a, b, yes, no: yes if _same(yes, no) else None,
}


#: Derivative of a function of `math` by its argument u, its value being v.
_SLOPES: Final[Mapping[str, Callable[[Any, Any], Number]]] = {
    "sin": lambda u, v: _both("cos", u),
    "cos": lambda u, v: -_both("sin", u),
    "tan": lambda u, v: 1.0 + v * v,
    "asin": lambda u, v: 1.0 / _both("sqrt", 1.0 - u * u),
    "acos": lambda u, v: -1.0 / _both("sqrt", 1.0 - u * u),
    "atan": lambda u, v: 1.0 / (1.0 + u * u),
    "sinh": lambda u, v: _both("cosh", u),
    "cosh": lambda u, v: _both("sinh", u),
    "tanh": lambda u, v: 1.0 - v * v,
    "asinh": lambda u, v: 1.0 / _both("sqrt", 1.0 + u * u),
    "exp": lambda u, v: v,
    "expm1": lambda u, v: 1.0 + v,
    "log": lambda u, v: 1.0 / u,
    "log1p": lambda u, v: 1.0 / (1.0 + u),
    "sqrt": lambda u, v: 0.5 / v,
    # slope of the absolute value: 1 where u >= 0, else -1
    "fabs": lambda u, v: _both("pick", u, 0.0, 1.0, -1.0),
}


def _slope_of_power(given: Sequence[Any], slopes: Sequence[Number], value: Number) -> Number:
    # d(a^b) = b a^(b - 1) da + a^b log(a) db
    (a, b), (da, db) = given, slopes
    found: Number = 0.0
    if not is_number(da, 0.0):
        found = _both("*", _both("*", b, _both("**", a, _both("-", b, 1.0))), da)
    if not is_number(db, 0.0):
        found = _both("+", found, _both("*", _both("*", value, _both("log", a)), db))
    return found


#: Derivative of other operations, by their arguments g, the slopes d of these and the value v: chain rule,
#: product rule, quotient rule and so on.
_SLOPES_OF_MORE: Final[Mapping[str, Callable[..., Number]]] = {
    "+": lambda g, d, v: _both("+", *d),
    "-": lambda g, d, v: _both("-", *d),
    "*": lambda g, d, v: _both("+", _both("*", d[0], g[1]), _both("*", g[0], d[1])),
    # d(a / b) = (da - (a / b) db) / b, with one division for all slopes
    "/": lambda g, d, v: _both("*", _both("-", d[0], _both("*", v, d[1])), _both("/", 1.0, g[1])),
    "**": _slope_of_power,
    "atan2": lambda g, d, v: _both(
        "/",
        _both("-", _both("*", d[0], g[1]), _both("*", g[0], d[1])),
        _both("+", _both("*", g[0], g[0]), _both("*", g[1], g[1])),
    ),
    "max": lambda g, d, v: _both("pick", *g, *d),
    "min": lambda g, d, v: _both("pick", g[1], g[0], *d),
    "pick": lambda g, d, v: _both("pick", g[0], g[1], d[2], d[3]),
}

#: The same functions as numpy calls them.
_BY_NUMPY: Final[Mapping[str, str]] = {
    **{name: name for name in _SLOPES},
    **{theirs: name for name, theirs in OF_NUMPY.items()},
    "absolute": "fabs",
    **{"add": "+", "subtract": "-", "multiply": "*", "divide": "/", "power": "**", "float_power": "**"},
}
# functions that are made of others
_COMPOSED: Final[Mapping[str, Callable[..., Any]]] = {
    **dict.fromkeys(["maximum", "fmax"], maximum),
    **dict.fromkeys(["minimum", "fmin"], minimum),
    "negative": lambda u: -u,
    "square": lambda u: u * u,
    "reciprocal": lambda u: 1.0 / u,
    **dict.fromkeys(["radians", "deg2rad"], lambda u: u * (math.pi / 180.0)),
    "log10": lambda u: _both("log", u) / math.log(10.0),
    "log2": lambda u: _both("log", u) / math.log(2.0),
    "copysign": lambda a, b: _both("pick", b, 0.0, 1.0, -1.0) * abs(a),
    "hypot": lambda a, b: _both("sqrt", a * a + b * b),
}


def as_numpy_calls(name: str) -> Callable[..., Any] | None:
    """Return the function that has this name in numpy, or None.

    Its arguments are symbols or known numbers.
    """
    return partial(_both, _BY_NUMPY[name]) if name in _BY_NUMPY else _COMPOSED.get(name)


_Values = TypeVar("_Values")


class Tape:
    """Operations in the order in which they were asked for, each of them once.

    Examples
    --------
    >>> tape = Tape()
    >>> x, y = tape.symbol("x"), tape.symbol("y")
    >>> z = 3.0 * x + np.sin(y)
    >>> slopes = tape.derivatives(z, [x, y])
    >>> slopes[0], tape.code([slopes[1]])
    (3.0, ['t5 = math.cos(y)'])
    """

    def __init__(self) -> None:
        # operations in order, their places, known derivatives, answers to comparisons
        self._made: list[tuple[str, tuple[Number | str, ...]]] = []
        self._known: dict[Any, int] = {}
        self._slopes: dict[tuple[int, int], Number] = {}
        self._answers: dict[str, bool] | None = None

    def symbol(self, name: str) -> Symbolic:
        """A number that is called so in the code."""
        return self._keep("symbol", (name,))

    def take(self, name: str, *given: Any) -> Number:
        """An operation, carried out as far as its numbers are known."""
        # all numbers known: carry it out now
        numbers = tuple(one if isinstance(one, Symbolic) else _finite_number(one) for one in given)
        if not any(isinstance(one, Symbolic) for one in numbers):
            try:
                return float(_KNOWN.get(name, getattr(math, name, None))(*numbers))  # type: ignore[misc]
            except (ArithmeticError, ValueError) as error:
                raise Untraceable(str(error)) from error
        # rules such as x + 0 = x and x * 1 = x
        simple = _SIMPLER[name](*numbers) if name in _SIMPLER else None
        return self._keep(name, numbers) if simple is None else simple

    def _keep(self, name: str, given: tuple[Any, ...]) -> Symbolic:
        # the same operation is kept once (common subexpression)
        key = (name, *(("t", one.at) if isinstance(one, Symbolic) else one for one in given))
        if key not in self._known:
            if len(self._made) >= _MOST:
                raise Untraceable(f"more than {_MOST} operations")
            self._known[key] = len(self._made)
            self._made.append((name, given))
        return Symbolic(self, self._known[key])

    def derivatives(self, value: Number, symbols: Iterable[Symbolic]) -> list[Number]:
        """Return the exact derivatives of a value by symbols.

        A derivative that does not depend on any symbol is a number.
        """
        return [self._derivative(value, symbol.at) for symbol in symbols]

    def _derivative(self, value: Number, by: int) -> Number:
        if not isinstance(value, Symbolic):
            return 0.0
        # forward differentiation in the order of the tape, for a long sum is deeper than Python can call
        for at in self._below(value.at):
            if (at, by) not in self._slopes:
                self._slopes[at, by] = self._slope(at, by)
        return self._slopes[value.at, by]

    def _below(self, *wanted: int) -> list[int]:
        """Operations that lead to those wanted, in order."""
        found, waiting = set(), list(wanted)
        while waiting:
            at = waiting.pop()
            if at not in found:
                found.add(at)
                waiting += [one.at for one in self._made[at][1] if isinstance(one, Symbolic)]
        return sorted(found)

    def _slope(self, at: int, by: int) -> Number:
        name, given = self._made[at]
        if name == "symbol":
            # dx/dx = 1
            return 1.0 if at == by else 0.0
        slopes = [self._slopes[one.at, by] if isinstance(one, Symbolic) else 0.0 for one in given]
        here = Symbolic(self, at)
        if name not in _SLOPES:
            return _SLOPES_OF_MORE[name](given, slopes, here)
        # chain rule: df(u) = f'(u) du
        return 0.0 if is_number(slopes[0], 0.0) else self.take("*", _SLOPES[name](given[0], here), slopes[0])

    def code(self, wanted: Iterable[Number], done: set[int] | None = None) -> list[str]:
        """Return the lines of code that compute the wanted values.

        Values in `done` are left out, and the new ones are added to it.
        """
        done = set() if done is None else done
        lines = []
        # only operations that the wanted values need, in order
        for at in self._below(*(one.at for one in wanted if isinstance(one, Symbolic))):
            if at not in done and self._made[at][0] != "symbol":
                lines.append(f"t{at} = {self._as_code(at)}")
            done.add(at)
        return lines

    def holds(self, a: Any, relation: str, b: Any) -> bool:
        """Return the answer to a comparison on the way that `branches` follows."""
        if self._answers is None or len(self._answers) > _MOST_BRANCHES:
            raise Untraceable("the value of a number decides")
        # a comparison is known by its text
        numbers = [one if isinstance(one, Symbolic) else _finite_number(one) for one in (a, b)]
        text = f"{self.name(numbers[0])} {relation} {self.name(numbers[1])}"
        if text not in self._answers:
            raise _Fork(text, numbers)
        return self._answers[text]

    def branches(
        self,
        function: Callable[[], _Values],
        written: Callable[[_Values, set[int]], list[str]],
        done: Iterable[int] = (),
    ) -> list[str]:
        """Return code with an ``if`` for each comparison of a function.

        `written` returns the code for what the function returns on one way through it, as `code` does.
        """
        # follow one way; at an unknown comparison branch, and call the function again for both answers
        known, self._answers = self._answers, dict(self._answers or {})
        here = set(done)
        try:
            return written(function(), here)
        except _Fork as fork:
            text, numbers = fork.args
        finally:
            answers, self._answers = self._answers, known
        # operations before the comparison, then one branch each
        lines = self.code(numbers, here)
        for answer, word in ((True, f"if {text}:"), (False, "else:")):
            self._answers = answers | {text: answer}
            lines += [word, *(f"    {line}" for line in self.branches(function, written, here))]
        self._answers = known
        return lines

    def finite(self, slope: Number, value: Number) -> str:
        """Return the code of a slope of a value, with 0 where it is not finite.

        For example, a root has no slope at zero.
        """
        name = self.name(slope)
        return (
            f"{name} if math.isfinite({name}) else 0.0" if self._poles(slope) - self._poles(value) else name
        )

    def _poles(self, value: Number) -> set[int]:
        """Operations by whose result a value divides, and powers in it."""
        found: set[int] = set()
        # divisions, logarithms and powers may have no finite slope
        for at in self._below(value.at) if isinstance(value, Symbolic) else ():
            name, given = self._made[at]
            operand = {"/": given[-1], "log": given[0], "**": Symbolic(self, at)}.get(name)
            if isinstance(operand, Symbolic):
                found.add(operand.at)
        return found

    def _as_code(self, at: int) -> str:
        name, given = self._made[at]
        words = [self.name(one) for one in given]  # type: ignore[arg-type]
        if name in ("+", "-", "*", "/"):
            return f"{words[0]} {name} {words[1]}"
        if name == "**":
            return f"math.pow({words[0]}, {words[1]})"
        if name == "pick":
            return f"{words[2]} if {words[0]} >= {words[1]} else {words[3]}"
        return f"{'' if name in ('max', 'min') else 'math.'}{name}({', '.join(words)})"

    def name(self, value: Number) -> str:
        """Return the name of a value in the code."""
        if not isinstance(value, Symbolic):
            return repr(value) if value >= 0 else f"({value!r})"
        kind, given = self._made[value.at]
        return str(given[0]) if kind == "symbol" else f"t{value.at}"


def _finite_number(value: Any) -> float:
    """A number of Python or numpy."""
    if isinstance(value, np.ndarray) and value.ndim:
        raise Untraceable("an array where a number was")
    found = float(value)
    if not math.isfinite(found):
        raise Untraceable("a number that is not finite")
    return found


def is_number(value: Number, number: float) -> bool:
    """Return whether a value is known and equal to a number."""
    return not isinstance(value, Symbolic) and value == number


def _same(a: Number, b: Number) -> bool:
    """Return whether two values are the same symbol or number."""
    at, where = (one.at if isinstance(one, Symbolic) else None for one in (a, b))
    return at == where if at is not None or where is not None else a == b


def in_python(built: Callable[[Any], Callable[..., None]]) -> Callable[..., None]:
    """Return straight-line code in Python, with inf and NaN for errors.

    ``built(math)`` makes the function, which writes to its last argument.
    """
    # first with errors of math; where one occurs, again with inf and NaN of numpy
    quick, quiet = built(math), built(_QUIET)

    def call(*given: Any) -> None:
        try:
            quick(*given)
        except (ArithmeticError, ValueError):
            *taken, out = given
            with np.errstate(all="ignore"):
                quiet(*(np.asarray(one, dtype=float)[()] for one in taken), out)

    return call


_Function = Callable[..., Any]


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
    return _Replacing().of(function)  # type: ignore[no-any-return]


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
        # methods and partial functions: replace what they call
        if isinstance(value, MethodType):
            return MethodType(self.of(value.__func__), value.__self__)
        if isinstance(value, partial):
            return partial(self.of(value.func), *value.args, **value.keywords)
        if id(value) in _PYTHON:
            return _PYTHON[id(value)]
        # math and numpy, and their functions by name
        name = str(getattr(value, "__name__", ""))
        for module, stand in ((math, _MATH), (np, _NUMPY)):
            if value is module:
                return stand
            if name and vars(module).get(name) is value:
                return getattr(stand, name)
        value = getattr(value, "py_func", value)
        # other values stay as they are
        if not isinstance(value, FunctionType) or (value.__module__ or "").partition(".")[0] == "numpy":
            return value
        if id(value) not in self._made:
            self._function(value)
        return self._made[id(value)]

    def _function(self, function: FunctionType) -> None:
        scope = {**_REPLACED, **function.__globals__, "__builtins__": builtins}
        cells = tuple(CellType() for _ in function.__closure__ or ())
        # same code, with globals and closures that are replaced
        made = FunctionType(function.__code__, scope, function.__name__, function.__defaults__, cells)
        made.__kwdefaults__ = function.__kwdefaults__
        self._made[id(function)] = made  # before its globals, since it may call itself
        for cell, before in zip(cells, function.__closure__ or (), strict=True):
            cell.cell_contents = self.of(before.cell_contents)
        for name in _names_in(function) & function.__globals__.keys():
            scope[name] = self.of(scope[name])


def _names_in(function: FunctionType) -> set[str]:
    """Names that the code uses, with those of functions inside it."""
    found: set[str] = set()
    # code of nested functions is among the constants
    waiting = [function.__code__]
    while waiting:
        code = waiting.pop()
        found.update(code.co_names)
        waiting += [one for one in code.co_consts if hasattr(one, "co_names")]
    return found


def read_by(*functions: Any) -> bytes:
    """Return what numba makes constants of in functions, as bytes.

    That is their code, numbers, strings, tuples and arrays of variables from outside, defaults and attributes
    of modules, and helpers with what these read. Functions of libraries count by their names.

    Parameters
    ----------
    *functions : object
        Functions as a user wrote them, or compiled by numba, and values that go with them.

    Returns
    -------
    bytes
        Other ones after any change, the same in each process. Empty if they read something else (an object,
        a class, a dict, a file): its changes cannot be seen.
    """
    found: list[bytes] = []
    done: set[Any] = set()
    waiting: list[tuple[Any, tuple[str, ...]]] = [(functions, ())]
    while waiting:
        value, names = waiting.pop()
        value = getattr(value, "py_func", value)  # numba's functions: their Python code
        if type(value) in _CONSTANT or (isinstance(value, _NUMPY_VALUE) and not value.dtype.hasobject):
            found.append(pickle.dumps(value))
        elif isinstance(value, tuple):
            found.append(b"%d" % len(value))
            waiting += [(one, names) for one in value]
        elif isinstance(value, CodeType):
            waiting.append(((value.co_code, value.co_names, value.co_consts), names))
        elif _of_library(value):
            found.append(value.__name__.encode())
        elif (key := (id(value), names)) in done:
            continue
        # of a module, what the function may read
        elif isinstance(value, ModuleType):
            done.add(key)
            waiting += [(getattr(value, name, None), names) for name in names]
        # of a function its code, defaults and variables from outside
        elif isinstance(value, FunctionType) and "getattr" not in (own := tuple(sorted(_names_in(value)))):
            done.add(key)
            cells = [cell.cell_contents for cell in value.__closure__ or ()]
            scope = [value.__globals__.get(name, getattr(builtins, name, None)) for name in own]
            given = value.__defaults__, *sorted((value.__kwdefaults__ or {}).items())
            waiting.append(((value.__code__, *given, *cells, *scope), own))
        else:
            return b""
    return b"".join(found)


def _of_library(value: Any) -> bool:
    """Return whether a value is a function or class of a library.

    Its name is enough. Methods of objects in C are built-in functions as well, but their objects can change.
    """
    kinds = FunctionType, BuiltinFunctionType, type, np.ufunc, type(np.interp)
    home = str(getattr(value, "__module__", "numpy")).partition(".")[0]  # older ones of numpy say nothing
    bound = getattr(value, "__self__", None)
    return isinstance(value, kinds) and isinstance(bound, (ModuleType, NoneType)) and home in _LIBRARIES


class _Math:
    """The module math, for symbols."""

    def __getattr__(self, name: str) -> Any:
        plain = getattr(math, name)
        if not callable(plain):
            return plain

        def taken(*given: Any) -> Any:
            # plain numbers: the function of math itself
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
        # numpy's functions on arrays of objects work entry by entry
        function = Symbolic.clip if name == "clip" else as_numpy_calls(name)
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
