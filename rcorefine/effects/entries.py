"""Entries of the state matrix."""

from __future__ import annotations

from math import inf
from typing import Any

from .absorbed import AbsorbedLaw, Assembly, Site
from .law import Coefficient, register


@register
class Entry(AbsorbedLaw):
    """Change of an entry."""

    name = "coefficient"
    where = frozenset(["any"])
    coefficients = (Coefficient("value", "entry", explanation="change of the entry"),)
    formula = "dx_i/dt = ... + t x_j"
    explanation = "The entry {place} of the state matrix differs from the model's."
    linear = True
    is_parameter = True
    may_wear = True
    signal = "value"

    def absorb(self, into: Assembly, site: Site, *values: Any) -> None:
        """Add t to the entry."""
        into.A[site.entry] += values[0]

    def sits(self, model: Any, place: str) -> bool:
        """At an entry of A."""
        return bool(model.entry(place))

    def bounds_in(self, structure: Any, place: str) -> tuple[float, float]:
        """A decay does not turn into growth."""
        row, column = structure.model.entry(place)
        rate = float(structure.linear_model.A[row, column])
        return -inf, -rate if row == column and rate < 0 else inf
