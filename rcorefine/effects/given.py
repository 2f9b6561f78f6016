"""Laws that a user hands over: a function, or a table of values at knots."""

from __future__ import annotations

import inspect
import math
from collections.abc import Callable, Hashable
from dataclasses import dataclass
from functools import lru_cache
from keyword import iskeyword
from types import MappingProxyType, MethodType
from typing import Any

import control as ct
import numpy as np
from numpy.typing import ArrayLike

from ..arguments import as_array
from ..exceptions import ModelError
from ..jit import compiled_law, number_at
from ..systems.linear import Array
from .compiled import MAX_COEFFICIENTS, forces_along
from .formula import FormulaLaw, InputLaw, OutputLaw, PortLaw
from .law import Coefficient, register

# test points (d, v) for a law before it is compiled
_POINTS = ((0.01, 0.02), (-0.3, 0.5), (0.7, -1.1), (0.0, 0.0))


@register
class Custom(PortLaw):
    """A function that the user gives."""

    where = frozenset(["any", "first_order", "mechanical"])
    coefficients = (Coefficient("scale", "force", explanation="scale of the law"),)
    formula = "f = t law(d, v)"
    explanation = "A law of your own acts at {place}."
    needs_law = True

    def of(self, law: Any, names: tuple[str, ...], label: str) -> Custom:
        """The law of a function.

        Raises
        ------
        control.ControlArgument
            If it is none.
        """
        if not callable(law) or isinstance(law, type):
            raise ct.ControlArgument(f"{label} needs law=, a function law(d, v) that returns the force")
        # its coefficients are those that have a starting value
        return custom_law(law, () if set(names) <= {"scale"} else names)

    @property
    def needs_starts(self) -> bool:
        """As a function tells nothing about its coefficients."""
        return not self.scaled

    def __reduce__(self) -> tuple[object, tuple[Any, ...]]:
        if "law" not in vars(self):
            return super().__reduce__()
        return (custom_law, (self.law, () if self.scaled else self.coefficient_names))


def custom_law(function: Callable[..., Any], names: tuple[str, ...]) -> Custom:
    """Law of a function.

    Parameters
    ----------
    function : callable
        ``function(d, v)``, the force per unit of a scale, or ``function(d, v, **names)``, the force;
        ``z_start``, ``d_start`` and ``w`` beside them as a `PortLaw` may take them.
    names : tuple of str
        Its coefficients; none for a scale.

    Returns
    -------
    Custom

    Raises
    ------
    control.ControlArgument
        If it takes something else.
    """
    # objects that are equal now may differ later; some cannot be looked up at all
    found = _custom_law(function, names) if isinstance(function, Hashable) else None
    if found is not None and (found.law is function or isinstance(function, MethodType)):
        return found
    return _custom_law.__wrapped__(function, names)


@lru_cache(maxsize=256)
def _custom_law(function: Callable[..., Any], names: tuple[str, ...]) -> Custom:
    # law with the arguments of this function
    for name in names:  # the names become part of the compiled code
        if not name.isidentifier() or iskeyword(name):
            raise ct.ControlArgument(f"a coefficient has a Python name such as 'scale', not {name!r:.80}")
    law: Any = Custom()
    law.law = function
    law.scaled = not names
    if names:
        law.coefficients = tuple(Coefficient(name, "") for name in names)
    found, law.by_name = _arguments(function, names)
    # a trial call: compiled code could not report an error
    if {*found[2:]} <= {*names}:
        _try(function, found[2:])
    # the first two arguments are d and v, whatever their names
    law._learn(law, (*found[2:],), True)
    law.arguments = found
    law.signals = {**PortLaw.signals, found[0]: "d", found[1]: "v"}
    made: Custom = law
    return made


def _try(function: Callable[..., Any], names: tuple[str, ...]) -> None:
    """Raise an error if a law returns no finite force at any test point.

    A compiled law could not report this.
    """
    label, force = getattr(function, "__name__", function), math.nan
    failed: Exception | None = None
    # one finite force at any of the points is enough
    for d, v in _POINTS:
        try:
            with np.errstate(all="ignore"):
                returned = function(d, v, **dict.fromkeys(names, 1.0))
        except Exception as error:
            failed = error
            continue
        if np.ndim(returned) or not isinstance(returned, (int, float, np.number, np.bool_)):
            raise ct.ControlArgument(
                f"the law {label!r} returns {returned!r}; it must return one real number"
            )
        force = float(returned)
        if math.isfinite(force):
            return
    if failed is not None:
        raise ct.ControlArgument(
            f"the law {label!r} raises {type(failed).__name__} wherever it was tried: {failed}"
        ) from failed
    raise ct.ControlArgument(f"the law {label!r} returns {force} wherever it was tried; give a finite force")


def _arguments(
    function: Callable[..., Any], names: tuple[str, ...]
) -> tuple[tuple[str, ...], frozenset[str]]:
    """Arguments that are handed over, and which of them by name."""
    try:
        given = list(inspect.signature(function).parameters.values())
    except (TypeError, ValueError):  # a function without a signature
        return ("d", "v", *names), frozenset()
    # *args and **kwargs accept any
    kinds = {p.kind for p in given}
    first = _first_two(function, given)
    # the others are told by name
    others = [p for p in given if p.name not in first and p.kind in (p.POSITIONAL_OR_KEYWORD, p.KEYWORD_ONLY)]
    known = {*names, *Custom.signals}
    taken = [p.name for p in others if p.name in known or p.default is p.empty]
    keyword = {p.name for p in others if p.kind is p.KEYWORD_ONLY}
    # arguments after one that keeps its default go by name
    if len(taken) < len(others):
        keyword |= set(taken)
    if inspect.Parameter.VAR_KEYWORD in kinds:
        taken += [name for name in names if name not in taken]
        keyword |= set(names)
    return (*first, *taken), frozenset(keyword & set(taken))


def _first_two(function: Callable[..., Any], given: list[inspect.Parameter]) -> list[str]:
    """Return the names of the first two arguments: displacement and velocity."""
    placed = [p.name for p in given if p.kind in (p.POSITIONAL_ONLY, p.POSITIONAL_OR_KEYWORD)]
    if len(placed) > 1:
        return placed[:2]
    if not any(p.kind is p.VAR_POSITIONAL for p in given):
        raise ct.ControlArgument(
            f"the law {getattr(function, '__name__', function)!r} takes {len(placed)} arguments; "
            "it must take displacement and velocity, law(d, v)"
        )
    return ["d", "v"]


@dataclass(frozen=True)
class Table:
    """Force tabulated at knots of displacement and velocity.

    It is bilinear between the knots and continues linearly beyond them.

    Parameters
    ----------
    d, v : array_like, shape (n_d,) and (n_v,)
        Knots in rising order, in units of the port; none or one where the force does not depend on it.
    force : array_like, shape (n_d, n_v)
        Resisting force at each pair of knots; one-dimensional where there are knots of one signal only.

    Raises
    ------
    ModelError
        If the knots do not rise, a number is not finite, or the sizes disagree.

    Examples
    --------
    >>> import rcorefine as rco
    >>> spring = rco.Table(d=[-0.1, 0.0, 0.2], force=[-2.0, 0.0, 10.0])
    >>> spring([0.1, 0.3], 0.0)
    array([ 5., 15.])
    >>> rco.Effect("tabulated", "link1", law=spring).label
    'tabulated at link1'
    """

    d: tuple[float, ...]
    v: tuple[float, ...]
    force: tuple[tuple[float, ...], ...]

    def __init__(self, d: ArrayLike = (), v: ArrayLike = (), force: ArrayLike = ()) -> None:
        knots = {
            name: as_array(x, f"{name} of a table", error=ModelError) for name, x in (("d", d), ("v", v))
        }
        values = as_array(force, "force of a table", error=ModelError)
        # knots of one signal alone form a table of one row or column
        size = tuple(max(each.size, 1) for each in knots.values())
        for name, each in knots.items():
            if each.ndim != 1 or np.any(np.diff(each) <= 0):
                raise ModelError(f"the knots {name} of a table must be a list of rising numbers, not {each}")
        if values.size != size[0] * size[1] or (values.ndim == 2 and values.shape != size):
            raise ModelError(f"force of a table has shape {values.shape}; its knots ask for {size}")
        # a table is immutable
        store = object.__setattr__
        for name, each in knots.items():
            store(self, name, tuple(each.tolist()))
        store(self, "force", tuple(map(tuple, values.reshape(size).tolist())))

    def __call__(self, d: ArrayLike, v: ArrayLike) -> Array:
        """Force along a motion.

        Parameters
        ----------
        d, v : array_like
            Displacement and velocity.

        Returns
        -------
        ndarray
        """
        # along the motion by the law of the table, per unit of its scale
        motion = np.array(np.broadcast_arrays(d, v), dtype=float)
        law, row = _tabulated(Tabulated.name, self), np.zeros((1, MAX_COEFFICIENTS))
        row[0, :2] = 1.0, law.constants["table"]
        found = np.zeros((1, motion[0].size))
        if found.size:
            x, rate = motion.reshape(2, -1)
            forces_along(law.code, x, rate, np.zeros((found.size, 0)), row, 1.0, found)
        return found.reshape(motion.shape[1:])


def share_beyond(table: Table, d: Array, v: Array) -> float:
    """Return the share of a motion that lies beyond the outer knots.

    The force is extrapolated linearly there.

    Parameters
    ----------
    table : Table
        Force at knots.
    d, v : ndarray, shape (N,)
        Displacement and velocity.

    Returns
    -------
    float
    """
    out = np.zeros(d.shape, dtype=bool)
    for knots, x in ((table.d, d), (table.v, v)):
        if len(knots) > 1:
            # rounding at the outer knots does not count
            slack = 1e-9 * (knots[-1] - knots[0])
            out |= (x < knots[0] - slack) | (x > knots[-1] + slack)
    return float(np.mean(out))


@compiled_law
def _cell(table, first, n, x):  # type: ignore[no-untyped-def]
    """Return the cell of x, the position inside it, and one over its width.

    There are n knots, the first of them at `first`.
    """
    if n < 2:
        return 0, 0.0, 0.0
    # linear search for the cell
    i = 0
    while i < n - 2 and x >= number_at(table, first + i + 1):
        i += 1
    low = number_at(table, first + i)
    rate = 1.0 / (number_at(table, first + i + 1) - low)
    return i, (x - low) * rate, rate


@compiled_law
def _looked_up(d, v, where):  # type: ignore[no-untyped-def]
    """Force of the table at an address, and its slopes."""
    if not where > 0.0:  # address zero: no table
        return 0.0, 0.0, 0.0
    # layout: n, m, knots of d, knots of v, forces row by row
    table = int(where)
    n, m = int(number_at(table, 0)), int(number_at(table, 1))
    i, p, p_rate = _cell(table, 2, n, d)
    j, q, q_rate = _cell(table, 2 + n, m, v)
    at = 2 + n + m + i * m + j
    # step to the next row and to the next column
    down, right = m if n > 1 else 0, 1 if m > 1 else 0
    a, b = number_at(table, at), number_at(table, at + right)
    c, e = number_at(table, at + down), number_at(table, at + down + right)
    # bilinear: along v in the rows below and above, then along d
    low, high = a + q * (b - a), c + q * (e - c)
    across = (b - a) + p * ((e - c) - (b - a))
    return low + p * (high - low), p_rate * (high - low), q_rate * across


@compiled_law
def _bent(x, scale, table):  # type: ignore[no-untyped-def]
    """Signal behind a curve, and its derivatives."""
    value, slope, _ = _looked_up(x, 0.0, table)
    # value and slope of (1 - scale) x + scale table(x); by the scale; no derivative by the address
    return x + scale * (value - x), 1.0 + scale * (slope - 1.0), value - x, 0.0


class _OfTable(FormulaLaw):
    """Law whose values stand in a table."""

    constants = MappingProxyType({"table": None})
    needs_law = True

    @property
    def adjustable(self) -> tuple[str, ...]:
        """Return no name: the address of the table is not a setting."""
        return ()

    def of(self, law: Any, names: tuple[str, ...], label: str) -> FormulaLaw:
        """Return the law of a table.

        Raises
        ------
        control.ControlArgument
            If `law` is no `Table`, or a curve of a channel has knots `v`.
        """
        if not isinstance(law, Table):
            raise ct.ControlArgument(f"{label} needs law=, a Table of the values at knots")
        if self.at_channel and (len(law.d) < 2 or law.v):
            raise ct.ControlArgument(f"{label} needs a Table with two knots d or more, and without knots v")
        return _tabulated(self.name, law)

    def __reduce__(self) -> tuple[object, tuple[Any, ...]]:
        held = vars(self).get("held")
        return super().__reduce__() if held is None else (_tabulated, (self.name, held))


@register
class Tabulated(_OfTable, PortLaw):
    """Unknown force, tabulated."""

    where = frozenset(["mechanical", "first_order"])
    coefficients = (Coefficient("scale", "", default_start=1.0, explanation="factor on the tabulated force"),)
    formula = "f = t table(d, v)"
    explanation = "An unknown force acts at {place}: its values are tabulated."

    @staticmethod
    def law(d, v, scale, table):  # type: ignore[no-untyped-def]
        """Formula."""
        return scale * _looked_up(d, v, table)[0]

    @staticmethod
    def slopes(d, v, scale, table):  # type: ignore[no-untyped-def]
        """With its derivatives."""
        force, by_d, by_v = _looked_up(d, v, table)
        return scale * force, scale * by_d, scale * by_v, force, 0.0


_WHOLE = Coefficient("scale", "1", default_start=1.0, explanation="1: the whole curve, 0: none of it")


# curves of inputs and outputs
@register
class InputCurve(_OfTable, InputLaw):
    """Actuator with a tabulated curve."""

    coefficients = (_WHOLE,)
    formula = "w -> (1 - t) w + t table(w)"
    explanation = "The input {place} acts by a tabulated static curve."
    slopes = staticmethod(_bent)

    @staticmethod
    def law(w, scale, table):  # type: ignore[no-untyped-def]
        """Formula."""
        return _bent(w, scale, table)[0]


@register
class OutputCurve(_OfTable, OutputLaw):
    """Sensor with a tabulated curve."""

    coefficients = (_WHOLE,)
    formula = "y -> (1 - t) y + t table(y)"
    explanation = "The sensor {place} shows a tabulated static curve."
    slopes = staticmethod(_bent)

    @staticmethod
    def law(y, scale, table):  # type: ignore[no-untyped-def]
        """Formula."""
        return _bent(y, scale, table)[0]


@lru_cache(maxsize=256)
def _tabulated(name: str, table: Table) -> _OfTable:
    """Return the law of a table.

    One of its constants is the address of its values, for the kernels.
    """
    law: Any = {kind.name: kind for kind in (Tabulated, InputCurve, OutputCurve)}[name]()
    # table as one row of numbers; its address is a constant of the law
    size = [max(len(table.d), 1), max(len(table.v), 1)]
    knots = [table.d or (0.0,), table.v or (0.0,)]
    law.held, law.numbers = table, np.concatenate([size, *knots, np.ravel(table.force)])
    law.constants = {"table": float(law.numbers.ctypes.data)}
    # a port needs the signals that the table depends on
    if not law.at_channel:
        sensed = [name for name, each in zip(("position", "velocity"), knots, strict=True) if len(each) > 1]
        law.needs = law.senses = frozenset(sensed)
    made: _OfTable = law
    return made
