"""A law of the user's own."""

from __future__ import annotations

from .law import Coefficient, PortLaw, register


@register
class Custom(PortLaw):
    """A function that the user gives."""

    where = frozenset(["any", "first_order", "mechanical"])
    coefficients = (Coefficient("scale", "force", explanation="scale of the law"),)
    formula = "f = t law(d, v)"
    explanation = "A law of your own acts at {place}."
