"""Dampers: forces that grow with the velocity of a port."""

from __future__ import annotations

import math
from collections.abc import Sequence
from types import MappingProxyType
from typing import Any

from .absorbed import AbsorbedLaw, Assembly, Site, nominal_is_left
from .flows import ROOT_WIDTH
from .formula import PortLaw
from .law import Coefficient, positive, register
from .seen import Seen


@register
class Damping(AbsorbedLaw):
    """Change of a damper, or of a loss in proportion."""

    where = frozenset(["first_order", "mechanical"])
    coefficients = (Coefficient("damping", "force/velocity", explanation="change of damping"),)
    formula = "f = t v"
    explanation = "The damping at {place} is larger than the model says (smaller, if negative)."
    words = ("{linear}", "The {linear} at {place} is larger than the model says (smaller, if negative).")
    linear = True
    needs = frozenset(["velocity"])
    is_parameter = True
    may_wear = True
    signal = "velocity"

    def absorb(self, into: Assembly, site: Site, *values: Any) -> None:
        """Add t v to the force at the port."""
        into.rates += values[0] * site.by_velocity

    def bounds_in(self, structure: Any, place: str) -> tuple[float, float]:
        """Return bounds that keep the remaining damping positive."""
        return nominal_is_left(self.name, structure, place)


@register
class AsymmetricDamping(PortLaw):
    """Damper of two rates."""

    where = frozenset(["mechanical"])
    coefficients = (
        Coefficient("damping_plus", "force/velocity", explanation="damping where v > 0"),
        Coefficient("damping_minus", "force/velocity", explanation="damping where v < 0"),
    )
    formula = "f = t+ v where v > 0, t- v where v < 0"
    explanation = (
        "The damping at {place} differs between the two directions of motion, like a car's shock absorber."
    )
    words = (
        "asymmetric {loss}",
        "The {loss} at {place} differs between the two directions of the {state}, as at a valve or a diode.",
    )
    needs = frozenset(["velocity"])
    covers = ("damping",)
    contains = MappingProxyType({"damping": {}})

    @staticmethod
    def law(v, damping_plus, damping_minus):  # type: ignore[no-untyped-def]
        """Formula."""
        return (damping_plus if v > 0.0 else damping_minus) * v

    @staticmethod
    def slopes(v, damping_plus, damping_minus):  # type: ignore[no-untyped-def]
        """With its derivatives."""
        if v > 0.0:
            return damping_plus * v, damping_plus, v, 0.0
        return damping_minus * v, damping_minus, 0.0, v


@register
class QuadraticDamping(PortLaw):
    """Drag."""

    where = frozenset(["first_order", "mechanical"])
    coefficients = (
        Coefficient("quadratic_damping", "force/velocity^2", explanation="force per squared velocity"),
    )
    formula = "f = t v |v|"
    explanation = (
        "A drag that grows with the square of the speed acts at {place}, as in air, water or a valve."
    )
    words = (
        "quadratic {loss}",
        "The {loss} at {place} has a part that grows with the square of the {state}.",
    )
    resists = True
    needs = frozenset(["velocity"])

    @staticmethod
    def law(v, quadratic_damping):  # type: ignore[no-untyped-def]
        """Formula."""
        return quadratic_damping * v * abs(v)

    @staticmethod
    def slopes(v, quadratic_damping):  # type: ignore[no-untyped-def]
        """With its derivatives."""
        drag = v * abs(v)
        return quadratic_damping * drag, 2.0 * quadratic_damping * abs(v), drag


@register
class CubicDamping(PortLaw):
    """Damper that grows with the cube."""

    where = frozenset(["first_order", "mechanical"])
    coefficients = (Coefficient("cubic_damping", "force/velocity^3", explanation="force per cubed velocity"),)
    formula = "f = t v^3"
    explanation = "The damping at {place} grows with the cube of the speed."
    words = ("cubic {loss}", "The {loss} at {place} has a part that grows with the cube of the {state}.")
    resists = True
    needs = frozenset(["velocity"])

    @staticmethod
    def law(v, cubic_damping):  # type: ignore[no-untyped-def]
        """Formula."""
        return cubic_damping * v**3

    @staticmethod
    def slopes(v, cubic_damping):  # type: ignore[no-untyped-def]
        """With its derivatives."""
        cube = v * v * v
        return cubic_damping * cube, 3.0 * cubic_damping * v * v, cube

    def plausible_in_store(self, *, one_way: bool, between: bool, known_mass: bool) -> bool:
        """A flow that has one direction is no odd function."""
        return not one_way


@register
class PowerDamping(PortLaw):
    """Damper with an exponent of its own."""

    where = frozenset(["first_order", "mechanical"])
    coefficients = (
        Coefficient("damping", "force", explanation="force at unit speed"),
        positive("power", "1", "exponent of the speed", lower=0.3, upper=5.0, shapes=True),
    )
    constants = MappingProxyType({"width": None})
    formula = "f = t |v|^p sgn(v)"
    explanation = (
        "The damping at {place} grows with a power of the speed of its own, as in an orifice or a seal."
    )
    words = ("power-law {loss}", "The {loss} at {place} has a part that grows with a power of the {state}.")
    resists = True
    needs = frozenset(["velocity"])
    width_share = ROOT_WIDTH
    powers = (("damping", "power"),)
    contains = MappingProxyType(
        {
            "damping": {"power": 1.0},
            "quadratic_damping": {"power": 2.0},
            "cubic_damping": {"power": 3.0},
            "sqrt_flow": {"power": 0.5},
        }
    )

    @staticmethod
    def law(v, damping, power, width):  # type: ignore[no-untyped-def]
        """Formula."""
        return damping * v * max(v * v + width * width, 1e-300) ** (0.5 * power - 0.5)

    @staticmethod
    def slopes(v, damping, power, width):  # type: ignore[no-untyped-def]
        """With its derivatives."""
        square = max(v * v + width * width, 1e-300)
        unit = v * square ** (0.5 * power - 0.5)
        by_v = damping * square ** (0.5 * power - 0.5) * (1.0 + (power - 1.0) * v * v / square)
        return damping * unit, by_v, unit, 0.5 * damping * unit * math.log(square), 0.0

    def starts(self, seen: Seen) -> Sequence[dict[str, float]]:
        """Between and beyond the exponents that have a law of their own."""
        return [{"power": p} for p in (1.5, 0.5, 2.5)]
