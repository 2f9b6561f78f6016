"""Nonlinear rest of the right-hand side of a model, for kernels."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from ..exceptions import RCOWarning, warn
from ..jit import NUMBA, compiled_law
from ..systems.linear import Array
from .absorbed import nominal_is_left
from .compiled import code_of
from .expressions import Number
from .law import Coefficient, Law, register
from .straight_line import Remainder, StraightLine, straight_line
from .tracing import as_numbers, tracing

__all__ = ["Field", "ModelParameter", "RightHandSide"]

_AHEAD = 2  # columns of the table before the derivatives: the value, and the size of what it came from
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
        params = {**self.others, **dict(zip(self.names, values.tolist(), strict=True))}
        rates = np.asarray(_plain(self.update)(t, x, u, params), dtype=float).reshape(-1)
        shown = x[: self.n_outputs]
        if self.output is not None:
            shown = np.asarray(_plain(self.output)(t, x, u, params), dtype=float).reshape(-1)
        return np.concatenate([rates, shown])

    def traced(self, x: Sequence[Number], u: Sequence[Number], p: Sequence[Number]) -> list[Number]:
        """Rates and outputs of symbols, see `Tape`.

        Raises
        ------
        Exception
            Whatever comes of functions that cannot be traced.
        """
        states, inputs = np.array(x, dtype=object), np.array(u, dtype=object)
        params = {**self.others, **dict(zip(self.names, p, strict=True))}
        rows = as_numbers(tracing(self.update)(0.0, states, inputs, params))
        if self.output is None:
            return rows + as_numbers(states[: self.n_outputs])
        return rows + as_numbers(tracing(self.output)(0.0, states, inputs, params))

    def compiled(self) -> _Function:
        """Return the compiled function ``f(x, u, values, row)``.

        It fills a row with rates and outputs.
        """
        entries = "".join(f"{name!r}: p[{i}], " for i, name in enumerate(self.names))
        held = "".join(f"{name!r}: held_{i}, " for i, name in enumerate(self.others))
        lines = [
            "def whole(x, u, p, row):",
            f"    params = {{'': True, {entries}{held}}}",  # of several types: its keys are known to numba
            "    rates = update(0.0, x, u, params)",
            *(f"    row[{i}] = rates[{i}]" for i in range(self.n_states)),
        ]
        if self.output is None:
            lines += [f"    row[{self.n_states + i}] = x[{i}]" for i in range(self.n_outputs)]
        else:
            lines += ["    shown = output(0.0, x, u, params)"]
            lines += [f"    row[{self.n_states + i}] = shown[{i}]" for i in range(self.n_outputs)]
        scope: dict[str, Any] = {f"held_{i}": value for i, value in enumerate(self.others.values())}
        scope |= {"update": compiled_law(self.update)}
        scope |= {"output": None if self.output is None else compiled_law(self.output)}
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
    """

    def __init__(self, of: Remainder) -> None:
        self._of = of
        self.functions, self.nominal = of.functions, of.nominal
        self._plain = fill_of(_tolerant(of.functions), of, lambda function: function)
        found = straight_line(of, self._values)
        everything = np.arange(of.linear.shape[0]), np.arange(of.linear.shape[1])
        self.rows, self.signals = everything if found is None else (found.rows, found.signals)
        self.n_rows, self.n_signals = self.rows.size, self.signals.size
        self.n_columns = _AHEAD + self.n_signals + of.nominal.size
        self._fill = self._plain if found is None else found.made()
        self.speed = "Python"
        self.code, self._keep = self._address(found)

    def _values(self, z: Array, p: Array) -> Array:
        """All rows by the functions as they were written."""
        out = np.zeros((self._of.linear.shape[0], _AHEAD))
        self._plain(p, z, 0.0, out)
        return out[:, 0]

    def _address(self, found: StraightLine | None) -> tuple[int, Any]:
        q, z, shape, fill = self.nominal.size, self.n_signals, (self.n_rows, self.n_columns), self._fill

        def plain(d: Any, v: Any, d0: Any, z0: Any, p: Any, want: float, w: Any, nw: int, out: Any) -> None:
            fill(_row(p, q), np.array(w[:z]), want, _row(out, shape[0] * shape[1]).reshape(shape))

        if NUMBA:
            try:
                if found is None:
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
        for share in (0.0, 1e-3):
            z = share * np.maximum(np.abs(self._of.level), 1.0)
            there = np.zeros((self.n_rows, self.n_columns))
            try:
                fast(self.nominal, z, 2.0, there)
            except Exception as error:  # numba's own errors have no common base
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

    def whole(x: Array, u: Array, p: Array, row: Array) -> None:
        try:
            row[:] = functions(x, u, p)
        except ArithmeticError:
            row[:] = np.nan
        except ValueError as error:  # of math.sqrt and math.log
            if "math domain" not in str(error) and "expected a" not in str(error):
                raise
            row[:] = np.nan

    return whole


def fill_of(whole: _Function, of: Remainder, made: _Function) -> _Function:
    """Return the function that fills the table of all rows.

    It takes differences of ``whole(x, u, p, row)``.
    """
    numbers = (of.level, of.linear, of.rate_sensors, of.outputs)
    level, linear, rate_sensors, outputs = (np.ascontiguousarray(one, dtype=float) for one in numbers)
    n, (rows, signals) = of.functions.n_states, linear.shape

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
        for i in range(rows):
            straight = 0.0
            for j in range(signals):
                straight += linear[i, j] * z[j]
            out[i, 0] = at[i] - straight
            out[i, 1] = abs(at[i]) + abs(straight)
        if want < 1.0:
            return
        moved = z.copy()
        for j in range(signals):
            h = 1e-5 * max(abs(level[j] + z[j]), 1e-4)
            moved[j] = z[j] + h
            remainder(moved, p, up)
            moved[j] = z[j] - h
            remainder(moved, p, low)
            moved[j] = z[j]
            for i in range(rows):
                out[i, 2 + j] = (up[i] - low[i]) / (2.0 * h) - linear[i, j]
        if want < 2.0:
            return
        other = p.copy()
        for c in range(p.size):
            h = 1e-5 * (abs(p[c]) if p[c] != 0.0 else 1e-2)
            other[c] = p[c] + h
            remainder(z, other, up)
            other[c] = p[c] - h
            remainder(z, other, low)
            other[c] = p[c]
            for i in range(rows):
                out[i, 2 + signals + c] = (up[i] - low[i]) / (2.0 * h)

    return made(fill)  # type: ignore[no-any-return]
