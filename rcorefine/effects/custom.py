"""A law of the user's own, given as a function."""

from __future__ import annotations

import inspect
import math
from collections.abc import Callable
from functools import lru_cache
from keyword import iskeyword
from typing import Any

import control as ct
import numpy as np

from .formula import PortLaw
from .law import Coefficient, register

__all__ = ["Custom", "custom_law"]

_POINTS = ((0.01, 0.02), (-0.3, 0.5), (0.7, -1.1), (0.0, 0.0))  # where a law is tried before it is compiled


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
        return custom_law(law, () if set(names) <= {"scale"} else names)

    @property
    def needs_starts(self) -> bool:
        """As a function tells nothing about its coefficients."""
        return not self.scaled

    def __reduce__(self) -> tuple[object, tuple[Any, ...]]:
        if "law" not in vars(self):
            return super().__reduce__()
        return (custom_law, (self.law, () if self.scaled else self.coefficient_names))


@lru_cache(maxsize=256)
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
    for name in names:  # they stand in the code that is compiled
        if not name.isidentifier() or iskeyword(name):
            raise ct.ControlArgument(f"a coefficient has a Python name such as 'scale', not {name!r:.80}")
    law: Any = Custom()
    law.law = function
    law.scaled = not names
    if names:
        law.coefficients = tuple(Coefficient(name, "") for name in names)
    found, law.by_name = _arguments(function, names)
    if {*found[2:]} <= {*names}:
        _try(function, found[2:])
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
    placed = [p for p in given if p.kind in (p.POSITIONAL_ONLY, p.POSITIONAL_OR_KEYWORD)]
    rest = any(p.kind is p.VAR_POSITIONAL for p in given)
    anything = any(p.kind is p.VAR_KEYWORD for p in given)
    if len(placed) < 2 and not rest:
        raise ct.ControlArgument(
            f"the law {getattr(function, '__name__', function)!r} takes {len(placed)} arguments; "
            "it must take displacement and velocity, law(d, v)"
        )
    first = [p.name for p in placed[:2]] if len(placed) > 1 else ["d", "v"]
    others = [p for p in given if p.name not in first and p.kind in (p.POSITIONAL_OR_KEYWORD, p.KEYWORD_ONLY)]
    known = {*names, *Custom.signals}
    taken = [p.name for p in others if p.name in known or p.default is p.empty]
    taken += [name for name in names if anything and name not in taken]
    keyword = {p.name for p in others if p.kind is p.KEYWORD_ONLY} | (set(names) if anything else set())
    skipped = [p.name for p in others if p.name not in taken]
    if skipped:  # a default that is kept stands before names that follow it
        keyword |= set(taken)
    return (*first, *taken), frozenset(keyword)
