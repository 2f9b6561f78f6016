"""Entries of the matrices."""

from __future__ import annotations

from math import inf
from typing import Any

import numpy as np

from .absorbed import AbsorbedLaw, Assembly, Site
from .law import Coefficient, register


@register
class Entry(AbsorbedLaw):
    """Change of an entry."""

    name = "coefficient"
    where = frozenset(["any"])
    coefficients = (Coefficient("value", "entry", explanation="change of the entry"),)
    formula = "dx_i/dt = ... + t x_j, with a signal w_j or an output y_i where the entry is of B, C or D"
    explanation = "The entry {place} of the model's matrices differs from what they say."
    linear = True
    is_parameter = True
    may_wear = True
    signal = "value"

    def absorb(self, into: Assembly, site: Site, *values: Any) -> None:
        """Add t to the entry."""
        row, column = site.entry
        states = into.A.shape[0]
        if row < states:
            into.rates[row, column] += values[0]
            return
        read = np.zeros((into.output_gain.size, into.rates.shape[1] + 1 + states), into.A.dtype)
        read[row - states, column] = values[0]
        into.felt.append(read)

    def sits(self, model: Any, place: str) -> bool:
        """At an entry of a matrix."""
        return bool(model.entry(place))

    def bounds_in(self, structure: Any, place: str) -> tuple[float, float]:
        """A decay does not turn into growth."""
        row, column = structure.model.entry(place)
        base = structure.linear_model
        rate = float(base.A[row, row]) if row == column < base.n_states else 0.0
        return -inf, -rate if rate < 0 else inf
