"""Expressions of numbers, with exact derivatives, as straight-line code.

A function is called with symbols. What hangs on a value (a comparison, a conversion) is `Untraceable`.
"""

from __future__ import annotations

import math
import operator
from collections.abc import Callable, Iterable, Mapping
from functools import partial, reduce
from typing import Any, Final, TypeAlias

import numpy as np

__all__ = ["Number", "Symbolic", "Tape", "Untraceable", "as_numpy_calls", "is_number", "maximum", "minimum"]

_MOST = 20_000  # operations: beyond, straight-line code takes longer to compile than it saves


class Untraceable(TypeError):
    """The function asks for more than the symbol of a number."""


class Symbolic:
    """A number that is not known yet: an operation on a tape."""

    __slots__ = ("at", "tape")
    __hash__ = None  # type: ignore[assignment]

    def __init__(self, tape: Tape, at: int) -> None:
        self.tape, self.at = tape, at

    def __add__(self, other: Any) -> Number:
        return self.tape.take("+", self, other)

    def __radd__(self, other: Any) -> Number:
        return self.tape.take("+", other, self)

    def __sub__(self, other: Any) -> Number:
        return self.tape.take("-", self, other)

    def __rsub__(self, other: Any) -> Number:
        return self.tape.take("-", other, self)

    def __mul__(self, other: Any) -> Number:
        return self.tape.take("*", self, other)

    def __rmul__(self, other: Any) -> Number:
        return self.tape.take("*", other, self)

    def __truediv__(self, other: Any) -> Number:
        return self.tape.take("/", self, other)

    def __rtruediv__(self, other: Any) -> Number:
        return self.tape.take("/", other, self)

    def __pow__(self, other: Any) -> Number:
        return self.tape.take("**", self, other)

    def __rpow__(self, other: Any) -> Number:
        return self.tape.take("**", other, self)

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
    __eq__ = __ne__ = __lt__ = __le__ = __gt__ = __ge__ = __mod__ = __floordiv__ = __round__ = _value


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
    "fabs": lambda u, v: _both("pick", u, 0.0, 1.0, -1.0),
}

#: The same functions as numpy calls them.
_BY_NUMPY: Final[Mapping[str, str]] = {
    **{name: name for name in _SLOPES},
    **{"arcsin": "asin", "arccos": "acos", "arctan": "atan", "arcsinh": "asinh", "arctan2": "atan2"},
    "absolute": "fabs",
    **{"add": "+", "subtract": "-", "multiply": "*", "divide": "/", "power": "**", "float_power": "**"},
}
_COMPOSED: Final[Mapping[str, Callable[..., Any]]] = {
    **dict.fromkeys(["maximum", "fmax"], maximum),
    **dict.fromkeys(["minimum", "fmin"], minimum),
    "negative": lambda u: -u,
    "square": lambda u: u * u,
    "reciprocal": lambda u: 1.0 / u,
    **dict.fromkeys(["radians", "deg2rad"], lambda u: u * (math.pi / 180.0)),
    "log10": lambda u: _both("log", u) / math.log(10.0),
    "log2": lambda u: _both("log", u) / math.log(2.0),
    "hypot": lambda a, b: _both("sqrt", a * a + b * b),
}


def as_numpy_calls(name: str) -> Callable[..., Any] | None:
    """Return the function that has this name in numpy, or None.

    Its arguments are symbols or known numbers.
    """
    return partial(_both, _BY_NUMPY[name]) if name in _BY_NUMPY else _COMPOSED.get(name)


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
        self._made: list[tuple[str, tuple[Number | str, ...]]] = []
        self._known: dict[Any, int] = {}
        self._slopes: dict[tuple[int, int], Number] = {}

    def symbol(self, name: str) -> Symbolic:
        """A number that is called so in the code."""
        return self._keep("symbol", (name,))

    def take(self, name: str, *given: Any) -> Number:
        """An operation, carried out as far as its numbers are known."""
        numbers = tuple(one if isinstance(one, Symbolic) else _known(one) for one in given)
        if not any(isinstance(one, Symbolic) for one in numbers):
            try:
                return float(_KNOWN.get(name, getattr(math, name, None))(*numbers))  # type: ignore[misc]
            except (ArithmeticError, ValueError) as error:
                raise Untraceable(str(error)) from error
        simple = _simplified(name, numbers)
        return self._keep(name, numbers) if simple is None else simple

    def _keep(self, name: str, given: tuple[Any, ...]) -> Symbolic:
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
        # in the order of the tape, for a long sum is deeper than Python can call
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
            return 1.0 if at == by else 0.0
        slopes = [self._slopes[one.at, by] if isinstance(one, Symbolic) else 0.0 for one in given]
        here, a, da = Symbolic(self, at), given[0], slopes[0]
        if name in _SLOPES:
            return 0.0 if is_number(da, 0.0) else self.take("*", _SLOPES[name](a, here), da)
        if name == "pick":
            return self.take("pick", a, given[1], slopes[2], slopes[3])
        b, db = given[1], slopes[1]
        match name:
            case "+" | "-":
                return self.take(name, da, db)
            case "*":
                return self.take("+", self.take("*", da, b), self.take("*", a, db))
            case "/":
                return self.take("/", self.take("-", da, self.take("*", here, db)), b)
            case "atan2":
                crossed = self.take("-", self.take("*", da, b), self.take("*", a, db))
                return self.take("/", crossed, self.take("+", self.take("*", a, a), self.take("*", b, b)))
            case "max":
                return self.take("pick", a, b, da, db)
            case "min":
                return self.take("pick", a, b, db, da)
        found: Number = 0.0  # of a power
        if not is_number(da, 0.0):
            found = self.take("*", self.take("*", b, self.take("**", a, self.take("-", b, 1.0))), da)
        if not is_number(db, 0.0):
            found = self.take("+", found, self.take("*", self.take("*", here, self.take("log", a)), db))
        return found

    def code(self, wanted: Iterable[Number], done: set[int] | None = None) -> list[str]:
        """Return the lines of code that compute the wanted values.

        Values in `done` are left out, and the new ones are added to it.
        """
        done = set() if done is None else done
        lines = []
        for at in self._below(*(one.at for one in wanted if isinstance(one, Symbolic))):
            if at not in done and self._made[at][0] != "symbol":
                lines.append(f"t{at} = {self._written(at)}")
            done.add(at)
        return lines

    def _written(self, at: int) -> str:
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


def _known(value: Any) -> float:
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


def _simplified(name: str, given: tuple[Number, ...]) -> Number | None:
    """Return the simplified result of an operation, or None.

    Known numbers can make an operation simple.
    """
    if name == "pick" and _same(given[2], given[3]):
        return given[2]
    if len(given) != 2:
        return None
    a, b = given
    match name:
        case "+":
            return b if is_number(a, 0.0) else a if is_number(b, 0.0) else None
        case "-":
            return a if is_number(b, 0.0) else 0.0 if _same(a, b) else None
        case "*":
            if is_number(a, 0.0) or is_number(b, 0.0):
                return 0.0
            return b if is_number(a, 1.0) else a if is_number(b, 1.0) else None
        case "/":
            return 0.0 if is_number(a, 0.0) else a if is_number(b, 1.0) else None
        case "**" if any(is_number(b, whole) for whole in range(5)):  # quicker than a power, and at any sign
            return reduce(operator.mul, [a] * int(b), 1.0)
    return None


def _same(a: Number, b: Number) -> bool:
    """Return whether two values are the same symbol or number."""
    at, where = (one.at if isinstance(one, Symbolic) else None for one in (a, b))
    return at == where if at is not None or where is not None else a == b
