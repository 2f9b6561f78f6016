"""Flows out of a store, and dampers: forces by the velocity of a port."""

from __future__ import annotations

import math
from collections.abc import Sequence
from types import MappingProxyType
from typing import Any

from .formula import PortLaw
from .law import (
    ONE_SIDE,
    PORTS,
    STORES,
    AbsorbedLaw,
    Assembly,
    Coefficient,
    Seen,
    Site,
    at_quantiles,
    nominal_is_left,
    positive,
    register,
)

ROOT_WIDTH = 1e-3  # smoothing width of a root over the rms level, since a root has no slope at zero


# flows out of a store
@register
class SqrtFlow(PortLaw):
    """Orifice."""

    where = STORES
    constants = ONE_SIDE
    coefficients = (Coefficient("flow", "force/velocity^0.5", explanation="flow per root of the state"),)
    formula = "f = t side sqrt(max(side x, 0))"
    explanation = (
        "The outflow at {place} follows the square root of the level, as through an orifice (Torricelli)."
    )
    domains = frozenset(["first_order", "hydraulic"])
    width_share = ROOT_WIDTH
    of_levels = True  # a level has a root, the difference of two temperatures has not

    @staticmethod
    def law(v, flow, side, width):  # type: ignore[no-untyped-def]
        """Formula."""
        # v / (v^2 + width^2)^(1/4): the root, smooth at zero
        return flow * v / math.sqrt(math.sqrt(v * v + width * width)) if side * v > 0.0 else 0.0


@register
class ThresholdFlow(PortLaw):
    """Overflow."""

    where = STORES
    constants = ONE_SIDE
    coefficients = (
        Coefficient("flow", "force/velocity", explanation="flow per unit beyond the threshold"),
        Coefficient(
            "threshold", "velocity", default_start=None, shapes=True, explanation="level at which it starts"
        ),
    )
    formula = "f = t side max(side (x - threshold), 0)"
    explanation = "Beyond a certain level something spills over at {place}."
    contains = MappingProxyType({"damping": {"threshold": 0.0}})  # of a level, which is not negative
    domains = frozenset(["first_order", "hydraulic"])
    of_levels = True  # a level has a rim, the difference of two temperatures has not

    @staticmethod
    def law(v, flow, threshold, side):  # type: ignore[no-untyped-def]
        """Formula."""
        # no flow up to the threshold
        return flow * side * max(0.0, side * (v - threshold))

    def starts(self, seen: Seen) -> Sequence[dict[str, float]]:
        """Rims that the level reaches."""
        # thresholds at quantiles of the level
        return at_quantiles("threshold", seen.v, [0.7, 0.9, 0.5])


@register
class CurvedLoss(PortLaw):
    """Loss that grows faster on one side of zero."""

    where = STORES
    coefficients = (Coefficient("curvature", "force/velocity^2", explanation="force per squared state"),)
    formula = "f = t v^2"
    explanation = "The loss at {place} is curved: it grows faster on one side of zero than on the other."
    words = ("curved {loss}", "The {loss} at {place} grows faster on one side of zero than on the other.")
    two_signed = True  # else it is a quadratic loss

    @staticmethod
    def law(v, curvature):  # type: ignore[no-untyped-def]
        """Formula."""
        return curvature * v * v


@register
class ExponentialLoss(PortLaw):
    """Diode."""

    where = STORES
    coefficients = (
        Coefficient("flow", "force", explanation="what flows on the side that blocks"),
        Coefficient(
            "scale",
            "velocity",
            default_start=None,
            shapes=True,
            explanation="state that multiplies the flow by e; its sign is the side that conducts",
        ),
    )
    formula = "f = t sgn(s) (exp(v/s) - 1)"
    explanation = "The loss at {place} grows exponentially on one side: a diode, a junction."
    words = ("exponential {loss}", "The {loss} at {place} grows exponentially on one side, as at a diode.")
    domains = frozenset(["first_order", "current", "voltage"])
    resists = True
    both_ways = True  # a flow that has one direction has no side that blocks

    @staticmethod
    def law(v, flow, scale):  # type: ignore[no-untyped-def]
        """Formula."""
        # the exponent is limited, so that the search cannot overflow
        return flow * math.copysign(math.exp(min(v / scale, 40.0)) - 1.0, v)

    def starts(self, seen: Seen) -> Sequence[dict[str, float]]:
        """Shares of the largest value on either side."""
        sides = float(seen.v.max()), float(seen.v.min())
        # scales from the largest and the smallest value, for a junction of either direction
        return [{"scale": q * side} for q in (0.15, 0.4) for side in sides if side]


@register
class Radiation(PortLaw):
    """Heat that is radiated."""

    where = STORES
    coefficients = (
        Coefficient("radiation", "force/velocity^4", explanation="emissivity times area times 5.67e-8"),
    )
    constants = MappingProxyType({"temperature": 293.15})
    from_zero = frozenset(["temperature"])  # of a state that is an absolute temperature itself
    formula = "f = t ((T0 + x)^4 - T0^4), T0 the absolute `temperature` where x = 0"
    explanation = "Heat is radiated at {place}, by the fourth power of the absolute temperature."
    on_request = True  # the state must be known to be a temperature

    @staticmethod
    def law(v, radiation, temperature):  # type: ignore[no-untyped-def]
        """Formula."""
        hot, cold = temperature + v, temperature
        return (
            radiation * v * (hot + cold) * (hot * hot + cold * cold)
        )  # hot^4 - cold^4, without cancellation


# dampers
@register
class Damping(AbsorbedLaw):
    """Change of a damper, or of a loss in proportion."""

    where = PORTS
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
        # f = t v, by all signals that make up the velocity
        into.rates += values[0] * site.by_velocity

    def bounds_in(self, structure: Any, place: str) -> tuple[float, float]:
        """Return bounds that keep the remaining damping positive."""
        return nominal_is_left(self.name, structure, place)


@register
class AsymmetricDamping(PortLaw):
    """Damper of two rates."""

    where = PORTS
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
    of_speeds = True
    covers = ("damping",)
    contains = MappingProxyType({"damping": {}})

    @staticmethod
    def law(v, damping_plus, damping_minus):  # type: ignore[no-untyped-def]
        """Formula."""
        # one rate for each direction
        return (damping_plus if v > 0.0 else damping_minus) * v


@register
class QuadraticDamping(PortLaw):
    """Drag."""

    where = PORTS
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

    @staticmethod
    def law(v, quadratic_damping):  # type: ignore[no-untyped-def]
        """Formula."""
        # v |v| opposes the motion in both directions
        return quadratic_damping * v * abs(v)


@register
class CubicDamping(PortLaw):
    """Damper that grows with the cube."""

    where = PORTS
    coefficients = (Coefficient("cubic_damping", "force/velocity^3", explanation="force per cubed velocity"),)
    formula = "f = t v^3"
    explanation = "The damping at {place} grows with the cube of the speed."
    words = ("cubic {loss}", "The {loss} at {place} has a part that grows with the cube of the {state}.")
    resists = True
    both_ways = True  # a flow that has one direction is no odd function

    @staticmethod
    def law(v, cubic_damping):  # type: ignore[no-untyped-def]
        """Formula."""
        return cubic_damping * v**3


@register
class PowerDamping(PortLaw):
    """Damper with an exponent of its own."""

    where = PORTS
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
        # |v|^p sgn(v) = v (v^2 + width^2)^((p - 1) / 2), smooth at zero
        return damping * v * math.exp((0.5 * power - 0.5) * math.log(max(v * v + width * width, 1e-300)))

    def starts(self, seen: Seen) -> Sequence[dict[str, float]]:
        """Between and beyond the exponents that have a law of their own."""
        # exponents between those of the laws that it contains
        return [{"power": p} for p in (1.5, 0.5, 2.5)]
