"""Nonlinear rest of the right-hand side of a model, for kernels.

It is straight-line code with exact derivatives, or the functions as they were written with differences.
"""

from __future__ import annotations

import math
import operator
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..exceptions import RCOWarning, warn
from ..jit import NUMBA, compiled_law
from ..systems.linear import Array
from .compiled import code_of
from .expressions import (
    Number,
    Symbolic,
    Tape,
    Untraceable,
    as_numbers,
    in_python,
    is_number,
    read_by,
    tracing,
)
from .law import Coefficient, Law, nominal_is_left, register

_AFFINE = 1e-12  # relative difference below which a slope equals that of the linear part
_LONGEST = 1000  # most lines; longer code takes more time to compile than it saves


@dataclass(frozen=True, slots=True, eq=False)
class Remainder:
    """Rates and outputs of a model less their linear part.

    Attributes
    ----------
    functions : RightHandSide
        The model.
    nominal : ndarray, shape (q,)
        Its parameters.
    level : ndarray, shape (n + n_w,)
        States and inputs about which the linear part stands.
    linear : ndarray, shape (n + n_y, n + n_w)
        The linear part, of the outputs without what they read of rates.
    rate_sensors : ndarray, shape (n_y, n)
        What outputs read of rates.
    outputs : ndarray, shape (n_y,)
        Outputs at the level.
    """

    functions: RightHandSide
    nominal: Array
    level: Array
    linear: Array
    rate_sensors: Array
    outputs: Array

    def whole(self, z: Sequence[Number], p: Sequence[Number]) -> list[Any]:
        """Rows before the linear part is taken away, at symbols above the level."""
        n = self.functions.n_states
        # absolute values: level + deviation
        both = [at + above for at, above in zip(self.level.tolist(), z, strict=True)]
        rows: list[Any] = self.functions.traced(both[:n], both[n:], p)
        # outputs without their level, and without the rates that they read
        for i, (sensed, rest) in enumerate(zip(self.rate_sensors, self.outputs.tolist(), strict=True)):
            rows[n + i] -= rest
            for j in np.flatnonzero(sensed):
                rows[n + i] -= float(sensed[j]) * rows[j]
        return rows


@dataclass(frozen=True, slots=True, eq=False)
class StraightLine:
    """Nonlinear rows, the signals they depend on, and their code.

    The function is ``fill(p, z, want, out)`` as `Field` has it, with those signals and rows alone.
    """

    rows: NDArray[np.intp]
    signals: NDArray[np.intp]
    source: str

    def made(self, compiled: Callable[..., Any] | None = None) -> Callable[..., None]:
        """Return the function, compiled or in Python."""
        if compiled is not None:
            return compiled(self._build(math))  # type: ignore[no-any-return]
        fill = in_python(self._build)
        return lambda p, z, want, out: fill(p.tolist(), z.tolist(), want, out)

    def _build(self, functions: Any) -> Callable[..., None]:
        scope: dict[str, Any] = {"math": functions}
        exec(self.source, scope)
        return scope["fill"]  # type: ignore[no-any-return]


def straight_line(of: Remainder, plain: Callable[[Array, Array], Array]) -> StraightLine | None:
    """Code of a remainder, None where its functions cannot be traced.

    Parameters
    ----------
    of : Remainder
        The model.
    plain : callable
        ``plain(z, p)``: all rows by the user's functions, with which the code has to agree.
    """
    try:
        found = _trace(of)
    except Exception:  # the user's code may raise anything when it gets symbols
        return None
    return found if _agrees(found, of, plain) else None


def _trace(of: Remainder) -> StraightLine:
    signals, q = of.level.size, of.nominal.size
    tape = Tape()
    # symbols for deviations and parameters
    z, p = [tape.symbol(f"z{j}") for j in range(signals)], [tape.symbol(f"p{c}") for c in range(q)]
    rows = of.whole(z, p)
    # slopes that differ from those of the linear part, (rows, signals)
    bent = np.array(
        [
            [_departs(slope, at) for slope, at in zip(tape.derivatives(row, z), line, strict=True)]
            for row, line in zip(rows, of.linear.tolist(), strict=True)
        ]
    )
    # rows that depend on the parameters, rows that are not zero at the level
    moved = np.array([any(not is_number(by, 0.0) for by in tape.derivatives(row, p)) for row in rows])
    rest = np.array(of.whole([0.0] * signals, of.nominal.tolist()))
    # nonlinear rows, and the signals on which they depend
    kept = np.flatnonzero(bent.any(axis=1) | moved | (rest != 0.0))
    active = np.flatnonzero(bent.any(axis=0))

    # the other signals act through the linear part alone
    tape = Tape()
    z, p = [tape.symbol(f"z{j}") for j in range(active.size)], [tape.symbol(f"p{c}") for c in range(q)]
    above: list[Number] = [0.0] * signals
    for j, symbol in zip(active, z, strict=True):
        above[j] = symbol
    rows = of.whole(above, p)
    source = _source(tape, [rows[i] for i in kept], of.linear[np.ix_(kept, active)], z, p)
    return StraightLine(kept, active, source)


def _departs(slope: Number, linear: float) -> bool:
    """Return whether a slope differs from that of the linear part.

    A slope that is not constant differs as well.
    """
    return isinstance(slope, Symbolic) or abs(slope - linear) > _AFFINE * (abs(slope) + abs(linear))


def _source(
    tape: Tape, rows: Sequence[Any], linear: Array, z: Sequence[Symbolic], p: Sequence[Symbolic]
) -> str:
    """Values and sizes first; then derivatives by signals; then by parameters."""
    values, slopes, by_numbers = [], [], []
    for i, (row, line) in enumerate(zip(rows, linear.tolist(), strict=True)):
        # row less its linear part, and a size for the judgment of rounding
        straight: Any = sum(map(operator.mul, line, z), 0.0)
        values += [(f"{i}, 0", row - straight), (f"{i}, 1", abs(row) + abs(straight))]
        found = map(operator.sub, tape.derivatives(row, z), line)
        slopes += [(f"{i}, {j}", slope) for j, slope in enumerate(found, 2)]
        by_numbers += [(f"{i}, {j}", slope) for j, slope in enumerate(tape.derivatives(row, p), 2 + len(z))]
    # code: symbols, values, then derivatives
    names = [f"{name}{j} = {name}[{j}]" for name, some in (("z", z), ("p", p)) for j in range(len(some))]
    done: set[int] = set()
    lines = [*names, *tape.code([value for _, value in values], done)]
    lines += [f"out[{at}] = {tape.name(value)}" for at, value in values]
    # derivatives follow only where they are wanted
    for wanted, some in ((1.0, slopes), (2.0, by_numbers)):
        # the table is zero before: leave out entries that are always zero
        entries = [(at, slope) for at, slope in some if not is_number(slope, 0.0)]
        lines += [f"if want < {wanted}:", "    return", *tape.code([slope for _, slope in entries], done)]
        lines += [f"out[{at}] = {tape.finite(slope, 0.0)}" for at, slope in entries]
    if len(lines) > _LONGEST:
        raise Untraceable(f"{len(lines)} lines")
    return "def fill(p, z, want, out):\n" + "".join(f"    {line}\n" for line in lines)


def _agrees(found: StraightLine, of: Remainder, plain: Callable[[Array, Array], Array]) -> bool:
    """Return whether the code agrees with the user's functions.

    The functions must also be linear in the other rows.
    """
    # points at growing distance from the level
    fill, size = found.made(), np.maximum(np.abs(of.level), 1.0)
    out = np.zeros((found.rows.size, 2 + found.signals.size + of.nominal.size))
    angles = np.arange(size.size)
    apart, sizes = [], []
    for turn, share in enumerate((0.0, 1e-3, 0.03, 0.3, 1.0)):
        z = share * size * np.cos(1.7 * angles + 2.3 * turn)
        p = of.nominal * (1.0 + 0.1 * share)
        fill(p, z[found.signals], 0.0, out)
        there = plain(z, p)
        here = np.zeros(there.size)
        here[found.rows] = out[:, 0]
        both = np.isfinite(here) & np.isfinite(there)
        apart.append(np.where(both, np.abs(here - there), 0.0))
        sizes.append(np.where(both, np.abs(of.linear) @ np.abs(z) + np.abs(there), 0.0))
    # a row that nearly vanishes at one point is compared with its size at the others
    return bool(np.all(np.array(apart) <= 1e-9 * np.array(sizes) + 1e-12 * np.max(sizes, axis=0)))


def exact_slopes(functions: RightHandSide, level: Array, nominal: Array) -> Array | None:
    """Return the exact derivatives by states and inputs, or None.

    Their shape is (n + n_y, n + n_w). None means that the functions cannot be traced.
    """
    try:
        # trace rates and outputs, then run the code of the derivatives at the level
        tape, z, rows = functions.on_tape(level.size, nominal.tolist())
        slopes = [tape.derivatives(row, z) for row in rows]
        scope: dict[str, Any] = {"math": math, **dict(zip(map(tape.name, z), level.tolist(), strict=True))}
        exec("\n".join(tape.code([slope for row in slopes for slope in row])), scope)
        return np.array([[float(eval(tape.name(slope), scope)) for slope in row] for row in slopes])
    except Exception:  # as above
        return None


_AHEAD = 2  # columns before the derivatives: value, and size of its terms
_Function = Callable[..., Any]


@register
class ModelParameter(Law):
    """Number in the right-hand side of a nonlinear model."""

    where = frozenset(["parameter"])
    coefficients = (Coefficient("value", "", explanation="change of the parameter"),)
    formula = "params[place] + t"
    explanation = "The parameter {place} of the model differs from its value."
    is_parameter = True
    on_request = True
    along_motion = False

    def bounds_in(self, structure: Any, place: str) -> tuple[float, float]:
        """Return bounds that keep a positive parameter positive."""
        return nominal_is_left(self.name, structure, place)

    def sits(self, model: Any, place: str) -> bool:
        """At a parameter of the model."""
        return model.operating_point is not None and place in model.operating_point.parameters


@dataclass(frozen=True, slots=True, eq=False)
class RightHandSide:
    """The functions of a `control.NonlinearIOSystem`, and its parameters.

    Parameters
    ----------
    update, output : callable
        ``f(t, x, u, params)``; no `output` reads the first states.
    names : tuple of str
        Numbers among the parameters, in order.
    others : mapping
        What else stands among them, held.
    n_states, n_outputs : int
        Sizes.
    label : str
        For messages.
    """

    update: _Function
    output: _Function | None
    names: tuple[str, ...]
    others: Mapping[str, Any]
    n_states: int
    n_outputs: int
    label: str

    def __call__(self, x: Array, u: Array, values: Array, t: float = 0.0) -> Array:
        """Rates and outputs in one row, (n + n_y,)."""
        rows = self._rows(_plain, x, u, values.tolist(), t)
        return np.concatenate([np.asarray(some, dtype=float).reshape(-1) for some in rows])

    def traced(self, x: Sequence[Number], u: Sequence[Number], p: Sequence[Number]) -> list[Number]:
        """Rates and outputs of symbols, see `Tape`.

        Raises
        ------
        Exception
            Whatever comes of functions that cannot be traced.
        """
        # arrays of objects hold the symbols
        states, inputs = np.array(x, dtype=object), np.array(u, dtype=object)
        rates, shown = self._rows(tracing, states, inputs, p, 0.0)
        return as_numbers(rates) + as_numbers(shown)

    def _rows(self, made: _Function, x: Any, u: Any, p: Sequence[Number], t: float) -> tuple[Any, Any]:
        """Rates and outputs by functions made of those of the system."""
        # parameters by name, together with those that are held
        params = {**self.others, **dict(zip(self.names, p, strict=True))}
        rates = made(self.update)(t, x, u, params)
        shown = x[: self.n_outputs] if self.output is None else made(self.output)(t, x, u, params)
        return rates, shown

    def on_tape(self, n_signals: int, values: Sequence[Number] | None = None) -> tuple[Tape, Any, Any]:
        """Return a tape, symbols of states and inputs, and the rows of these.

        The rows are rates and outputs. Parameters without `values` are symbols as well.

        Raises
        ------
        Exception
            As `traced`.
        """
        tape, n = Tape(), self.n_states
        z = [tape.symbol(f"z{j}") for j in range(n_signals)]
        p = [tape.symbol(f"p{c}") for c in range(len(self.names))] if values is None else values
        return tape, z, self.traced(z[:n], z[n:], p)

    @property
    def held(self) -> bytes:
        """Return all that their compiled code holds, see `read_by`."""
        return read_by(self.update, self.output, *self.others.items())

    def compiled(self) -> _Function:
        """Return the compiled function ``f(x, u, values, row)``.

        It fills a row with rates and outputs.
        """
        # source of a function that numba compiles: the parameters as a dictionary
        entries = "".join(f"{name!r}: p[{i}], " for i, name in enumerate(self.names))
        held = "".join(f"{name!r}: held_{i}, " for i, name in enumerate(self.others))
        lines = [
            "def whole(x, u, p, row):",
            # entries of several types make numba treat the keys as constants
            f"    params = {{'': True, {entries}{held}}}",
            "    rates = update(0.0, x, u, params)",
            *(f"    row[{i}] = rates[{i}]" for i in range(self.n_states)),
            "    shown = x" if self.output is None else "    shown = output(0.0, x, u, params)",
            *(f"    row[{self.n_states + i}] = shown[{i}]" for i in range(self.n_outputs)),
        ]
        scope: dict[str, Any] = {f"held_{i}": value for i, value in enumerate(self.others.values())}
        scope |= {"update": compiled_law(self.update), "output": self.output and compiled_law(self.output)}
        exec("\n".join(lines), scope)
        made: _Function = compiled_law(scope["whole"])
        return made


def _plain(function: _Function) -> _Function:
    """Return the Python function that numba compiled.

    It takes a dict.
    """
    return getattr(function, "py_func", function)


class Field:
    """Nonlinear rest of the rates and outputs of a model.

    It is the difference from the linear part of the model.

    Parameters
    ----------
    of : Remainder
        The model, and its linear part.

    Attributes
    ----------
    code : int
        What `evaluate` takes: coefficients are the parameters, inputs are the `signals` above the level,
        and the width says what is wanted: 0 values, 1 derivatives by those signals, 2 by parameters too.
        It writes a table (n_rows, 2 + n_signals + q) that was zero before: value, size, derivatives.
    rows : ndarray of int
        Of the rates and, behind them, outputs, those that are not linear.
    signals : ndarray of int
        Of the states and, behind them, inputs, those on which they hang.
    speed : str
        "compiled" or "Python".
    exact : bool
        Whether the functions could be traced.
    """

    def __init__(self, of: Remainder) -> None:
        self._of = of
        self.functions, self.nominal = of.functions, of.nominal
        self._plain = fill_of(_tolerant(of.functions), of, lambda function: function)
        # traced code with exact derivatives, or the functions as they are with differences
        found = straight_line(of, self._values)
        self.exact = found is not None
        everything = np.arange(of.linear.shape[0]), np.arange(of.linear.shape[1])
        self.rows, self.signals = everything if found is None else (found.rows, found.signals)
        self.n_rows, self.n_signals = self.rows.size, self.signals.size
        self.n_columns = _AHEAD + self.n_signals + of.nominal.size
        self._fill = self._plain if found is None else found.made()
        self.speed = "Python"
        self.code, self._keep = self._address(found)

    def read(self, functions: RightHandSide) -> str | bytes:
        """Return all that the code would hold of functions as they are now.

        It is empty where that is not known: untraceable now, or called in Python.
        """
        if not self.exact:
            return functions.held if self.speed == "compiled" else b""
        # the text of rates and outputs has all numbers that the functions read
        with suppress(Exception):  # as above
            tape, _, rows = functions.on_tape(self._of.level.size)
            return "\n".join([*tape.code(rows), *map(tape.name, rows)])
        return b""

    def _values(self, z: Array, p: Array) -> Array:
        """All rows by the functions as they were written."""
        out = np.zeros((self._of.linear.shape[0], _AHEAD))
        self._plain(p, z, 0.0, out)
        return out[:, 0]

    def _address(self, found: StraightLine | None) -> tuple[int, Any]:
        q, z, shape, fill = self.nominal.size, self.n_signals, (self.n_rows, self.n_columns), self._fill

        def plain(*given: Any) -> None:
            *_, p, want, w, _, out = given
            fill(_row(p, q), np.array(w[:z]), want, _row(out, shape[0] * shape[1]).reshape(shape))

        if NUMBA:
            # compiled where numba can, in Python otherwise
            try:
                if found is None:
                    if not self.functions.held:
                        raise TypeError("they read more than numbers, arrays and functions")
                    fast = fill_of(self.functions.compiled(), self._of, compiled_law)
                    self._compare(fast)
                else:
                    fast = found.made(compiled_law)
                scope = {"fill": fast, "carray": None}
                exec(_ENTRY.format(q=q, z=z, rows=shape[0], columns=shape[1]), scope)
                code = code_of(plain, scope["evaluate"])
            except (TypeError, ValueError) as error:
                warn(
                    f"the functions of {self.functions.label} cannot be compiled and are called in Python, "
                    f"which is some hundred times slower: {_reason(error)}",
                    RCOWarning,
                )
            else:
                self.speed = "compiled"
                return code
        return code_of(plain)

    def _compare(self, fast: _Function) -> None:
        """Check that the compiled functions agree with the Python functions."""
        # at the level and near it
        for share in (0.0, 1e-3):
            z = share * np.maximum(np.abs(self._of.level), 1.0)
            there = np.zeros((self.n_rows, self.n_columns))
            try:
                fast(self.nominal, z, 2.0, there)
            except Exception as error:  # errors of numba have no common base class
                raise TypeError(str(error)) from error
            here = self._values(z, self.nominal)
            if not np.allclose(here, there[:, 0], rtol=1e-9, atol=1e-12, equal_nan=True):
                raise ValueError("compiled, they give other values than in Python")

    def table(self, values: Array, z: Array, want: float = 0.0) -> Array:
        """Return value, size and derivatives of each of the `rows`.

        `z` holds the deviations of the `signals` from the level.
        """
        out = np.zeros((self.n_rows, self.n_columns))
        self._fill(values, z, want, out)
        return out

    def slopes(self, values: Array, z: Array) -> Array:
        """Return the derivatives of all rows by all states and inputs.

        Their shape is (n + n_y, n + n_w). `z` holds deviations from the level.
        """
        # derivatives of the nonlinear rows and signals; the others are zero
        found = np.zeros_like(self._of.linear)
        columns = slice(_AHEAD, _AHEAD + self.n_signals)
        found[np.ix_(self.rows, self.signals)] = self.table(values, z[self.signals], 1.0)[:, columns]
        return found

    def __reduce__(self) -> tuple[Any, ...]:
        return Field, (self._of,)


_ENTRY = """
def evaluate(_d, _v, _d_start, _z_start, _p, _width, _w, _nw, _out):
    fill(carray(_p, ({q},)), carray(_w, ({z},)), _width, carray(_out, ({rows}, {columns})))
"""


def _reason(error: BaseException) -> str:
    """The line of a message of numba that says what is wrong."""
    lines = [line.strip() for line in str(error).splitlines() if line.strip()]
    return next((line for line in lines if not line.startswith(("Failed in", "During"))), lines[0])


def _row(values: Any, size: int) -> Array:
    """An array of what a kernel hands over: a row, or its address."""
    if isinstance(values, np.ndarray):
        return values[:size]
    return np.ctypeslib.as_array(values, (max(size, 1),))[:size]


def _tolerant(functions: RightHandSide) -> _Function:
    """Return the functions in Python, with NaN outside their domain.

    A search may leave that domain.
    """

    # errors of math become NaN, and the step of the search is rejected
    def whole(x: Array, u: Array, p: Array, row: Array) -> None:
        try:
            row[:] = functions(x, u, p)
        except ArithmeticError:
            row[:] = np.nan
        except ValueError as error:  # domain errors of math.sqrt and math.log
            if "math domain" not in str(error) and "expected a" not in str(error):
                raise
            row[:] = np.nan

    return whole


def fill_of(whole: _Function, of: Remainder, made: _Function) -> _Function:
    """Return the function that fills the table of all rows.

    It takes differences of ``whole(x, u, p, row)``.
    """
    # arrays that the compiled function holds as constants
    numbers = (of.level, of.linear, of.rate_sensors, of.outputs)
    level, linear, rate_sensors, outputs = (np.ascontiguousarray(one, dtype=float) for one in numbers)
    n, (rows, signals) = of.functions.n_states, linear.shape

    # rates and outputs, outputs without level and rates
    def remainder(z, p, row):  # type: ignore[no-untyped-def]
        both = level + z
        whole(both[:n], both[n:], p, row)
        for i in range(rows - n):
            row[n + i] -= outputs[i]
            for j in range(n):
                row[n + i] -= rate_sensors[i, j] * row[j]

    remainder = made(remainder)

    def fill(p, z, want, out):  # type: ignore[no-untyped-def]
        at, up, low = np.empty(rows), np.empty(rows), np.empty(rows)
        remainder(z, p, at)
        # value less the linear part, and its size
        for i in range(rows):
            straight = 0.0
            for j in range(signals):
                straight += linear[i, j] * z[j]
            out[i, 0] = at[i] - straight
            out[i, 1] = abs(at[i]) + abs(straight)
        if want < 1.0:
            return
        # derivatives by the signals, then by the parameters: central differences
        moved = np.concatenate((z, p))
        for j in range(signals if want < 2.0 else moved.size):
            here = moved[j]
            size = max(abs(level[j] + here), 1e-4) if j < signals else abs(here) if here != 0.0 else 1e-2
            moved[j] = here + 1e-5 * size
            remainder(moved[:signals], moved[signals:], up)
            moved[j] = here - 1e-5 * size
            remainder(moved[:signals], moved[signals:], low)
            moved[j] = here
            for i in range(rows):
                straight = linear[i, j] if j < signals else 0.0
                out[i, 2 + j] = (up[i] - low[i]) / (2e-5 * size) - straight

    return made(fill)  # type: ignore[no-any-return]
