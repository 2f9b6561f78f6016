"""Nonlinear rest of a model as straight-line code.

The code computes exact derivatives.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from types import SimpleNamespace
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from ..systems.linear import Array
from .expressions import Number, Symbolic, Tape, Untraceable, is_number
from .tracing import OF_NUMPY

if TYPE_CHECKING:
    from .right_hand_side import RightHandSide

__all__ = ["Remainder", "StraightLine", "exact_slopes", "straight_line"]

_AFFINE = 1e-12  # of a slope: within it the linear part has it
_LONGEST = 1000  # lines: beyond, they take longer to compile than they save
_QUIET = SimpleNamespace(  # math without errors
    **{name: getattr(np, OF_NUMPY.get(name, name), None) for name in dir(math) if not name.startswith("_")}
)


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
        both = [at + above for at, above in zip(self.level.tolist(), z, strict=True)]
        rows: list[Any] = self.functions.traced(both[:n], both[n:], p)
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
        """Return the function, compiled or in Python.

        In Python it returns inf and NaN as compiled code does.
        """
        if compiled is not None:
            return compiled(self._built(math))  # type: ignore[no-any-return]
        quick, quiet = self._built(math), self._built(_QUIET)

        def fill(p: Array, z: Array, want: float, out: Array) -> None:
            try:
                quick(p.tolist(), z.tolist(), want, out)
            except (ArithmeticError, ValueError):
                with np.errstate(all="ignore"):
                    quiet(p, z, want, out)

        return fill

    def _built(self, functions: Any) -> Callable[..., None]:
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
        found = _traced(of)
    except Exception:  # symbols go through a user's code: what that raises is not foreseeable
        return None
    return found if _agrees(found, of, plain) else None


def _traced(of: Remainder) -> StraightLine:
    signals, q = of.level.size, of.nominal.size
    tape = Tape()
    z, p = [tape.symbol(f"z{j}") for j in range(signals)], [tape.symbol(f"p{c}") for c in range(q)]
    rows = of.whole(z, p)
    bent = np.array(
        [
            [_departs(slope, at) for slope, at in zip(tape.derivatives(row, z), line, strict=True)]
            for row, line in zip(rows, of.linear.tolist(), strict=True)
        ]
    )
    moved = np.array([any(not is_number(by, 0.0) for by in tape.derivatives(row, p)) for row in rows])
    rest = np.array(of.whole([0.0] * signals, of.nominal.tolist()))
    kept = np.flatnonzero(bent.any(axis=1) | moved | (rest != 0.0))
    active = np.flatnonzero(bent.any(axis=0))

    # what the other signals do is in the linear part, whole
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
        straight: Any = sum((a * one for a, one in zip(line, z, strict=True)), 0.0)
        values += [(f"{i}, 0", row - straight), (f"{i}, 1", abs(row) + abs(straight))]
        found = zip(tape.derivatives(row, z), line, strict=True)
        slopes += [(f"{i}, {2 + j}", slope - a) for j, (slope, a) in enumerate(found)]
        columns = enumerate(tape.derivatives(row, p), 2 + len(z))
        by_numbers += [(f"{i}, {column}", slope) for column, slope in columns]
    names = [f"z{j} = z[{j}]" for j in range(len(z))] + [f"p{c} = p[{c}]" for c in range(len(p))]
    done: set[int] = set()
    lines = [*names, *tape.code([value for _, value in values], done)]
    lines += [f"out[{at}] = {tape.name(value)}" for at, value in values]
    # entries that are zero everywhere stay as they were made
    slopes, by_numbers = (
        [(at, slope) for at, slope in some if not is_number(slope, 0.0)] for some in (slopes, by_numbers)
    )
    for wanted, entries in ((1.0, slopes), (2.0, by_numbers)):
        lines += [f"if want < {wanted}:", "    return", *tape.code([slope for _, slope in entries], done)]
        lines += [f"out[{at}] = {_finite(tape, slope)}" for at, slope in entries]
    if len(lines) > _LONGEST:
        raise Untraceable(f"{len(lines)} lines")
    return "def fill(p, z, want, out):\n" + "".join(f"    {line}\n" for line in lines)


def _finite(tape: Tape, slope: Number) -> str:
    """A slope; none where there is a corner, as that of a root at zero."""
    name = tape.name(slope)
    return f"{name} if math.isfinite({name}) else 0.0" if isinstance(slope, Symbolic) else name


def _agrees(found: StraightLine, of: Remainder, plain: Callable[[Array, Array], Array]) -> bool:
    """Return whether the code agrees with the user's functions.

    The functions must also be linear in the other rows.
    """
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
    # a row that all but vanishes at one point is measured by what it is at the others
    return bool(np.all(np.array(apart) <= 1e-9 * np.array(sizes) + 1e-12 * np.max(sizes, axis=0)))


def exact_slopes(functions: RightHandSide, level: Array, nominal: Array) -> Array | None:
    """Return the exact derivatives by states and inputs, or None.

    Their shape is (n + n_y, n + n_w). None means that the functions cannot be traced.
    """
    n, tape = functions.n_states, Tape()
    names = [f"z{j}" for j in range(level.size)]
    try:
        z = [tape.symbol(name) for name in names]
        rows = functions.traced(z[:n], z[n:], nominal.tolist())
        slopes = [tape.derivatives(row, z) for row in rows]
        scope: dict[str, Any] = {"math": math, **dict(zip(names, level.tolist(), strict=True))}
        exec("\n".join(tape.code([slope for row in slopes for slope in row])), scope)
        return np.array([[float(eval(tape.name(slope), scope)) for slope in row] for row in slopes])
    except Exception:  # as above
        return None
