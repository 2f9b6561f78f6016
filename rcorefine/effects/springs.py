"""Springs: forces along the displacement of a port."""

from __future__ import annotations

import math
from collections.abc import Sequence
from types import MappingProxyType
from typing import Any

import numpy as np

from .formula import PortLaw
from .law import (
    ONE_SIDE,
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


# change of a linear spring
@register
class Stiffness(AbsorbedLaw):
    """Change of a spring."""

    where = frozenset(["mechanical"])
    coefficients = (Coefficient("stiffness", "force/position", explanation="change of stiffness"),)
    formula = "f = t d"
    explanation = "The spring at {place} is stiffer than the model says (softer, as by a crack, if negative)."
    words = ("{spring}", "The {spring} at {place} is larger than the model says (smaller, if negative).")
    linear = True
    needs = frozenset(["position"])
    belongs_to = "stiffness"
    is_parameter = True
    may_wear = True
    signal = "displacement"

    def absorb(self, into: Assembly, site: Site, *values: Any) -> None:
        """Add t d to the force at the port."""
        # f = t d, by all signals that make up the displacement
        into.rates += values[0] * site.by_displacement

    def bounds_in(self, structure: Any, place: str) -> tuple[float, float]:
        """Return bounds that keep the remaining stiffness positive."""
        return nominal_is_left(self.name, structure, place)


# smooth nonlinear springs
@register
class CubicStiffness(PortLaw):
    """Spring that hardens."""

    coefficients = (
        Coefficient("cubic_stiffness", "force/position^3", explanation="force per cubed displacement"),
    )
    formula = "f = t d^3"
    explanation = "The spring at {place} hardens as it is pushed either way (softens, if negative)."
    words = ("cubic {elastic}", "The {elastic} at {place} grows with the square of the {moved}.")
    belongs_to = "stiffness"

    @staticmethod
    def law(d, cubic_stiffness):  # type: ignore[no-untyped-def]
        """Formula."""
        # odd function: the same in both directions
        return cubic_stiffness * d**3


@register
class QuadraticStiffness(PortLaw):
    """Spring that is stiffer on one side, gradually."""

    coefficients = (
        Coefficient("quadratic_stiffness", "force/position^2", explanation="force per squared displacement"),
    )
    formula = "f = t d^2"
    explanation = (
        "The spring at {place} is stiffer on one side than on the other, more so the further it is moved."
    )
    words = ("quadratic {elastic}", "The {elastic} at {place} grows with the {moved}, sign included.")
    belongs_to = "stiffness"

    @staticmethod
    def law(d, quadratic_stiffness):  # type: ignore[no-untyped-def]
        """Formula."""
        # even function: stiffer on one side of rest
        return quadratic_stiffness * d * d


# piecewise linear springs: cracks, gaps and stops
@register
class BilinearStiffness(PortLaw):
    """Spring with a kink at rest."""

    coefficients = (
        Coefficient("bilinear_stiffness", "force/position", explanation="stiffness added on that side"),
    )
    constants = ONE_SIDE
    formula = "f = t side max(side d, 0)"
    explanation = (
        "The spring at {place} has another stiffness in one direction, like a crack that opens and closes."
    )
    words = ("bilinear {elastic}", "The {elastic} at {place} has another value for each sign of the {moved}.")
    belongs_to = "stiffness"

    @staticmethod
    def law(d, bilinear_stiffness, side):  # type: ignore[no-untyped-def]
        """Formula."""
        # added stiffness on one side, a breathing crack
        return bilinear_stiffness * side * max(0.0, side * d)


@register
class Clearance(PortLaw):
    """Stop behind a gap."""

    coefficients = (
        Coefficient("stiffness", "force/position", explanation="stiffness of the contact"),
        positive("gap", "position", "play on either side", shapes=True),
    )
    contains = MappingProxyType({"stiffness": {"gap": 0.0}})
    formula = "f = t sgn(d) max(|d| - gap, 0)"
    explanation = "There is play at {place}: a stop is hit once the displacement exceeds a gap."
    words = ("limit of the {moved}", "Beyond a limit of the {moved} the {elastic} at {place} jumps up.")
    belongs_to = "stiffness"

    @staticmethod
    def law(d, stiffness, gap):  # type: ignore[no-untyped-def]
        """Formula."""
        # no force inside the gap
        return stiffness * math.copysign(max(0.0, abs(d) - gap), d)

    def starts(self, seen: Seen) -> Sequence[dict[str, float]]:
        """Gaps that the motion reaches now and then."""
        # quantiles of the displacement
        return at_quantiles("gap", np.abs(seen.d), [0.4, 0.7, 0.9, 0.1])


@register
class EndStop(PortLaw):
    """Stop on one side."""

    coefficients = (
        Coefficient("stiffness", "force/position", explanation="stiffness of the contact"),
        Coefficient(
            "position",
            "position",
            default_start=None,
            explanation="where it is met, on the side of its sign",
            shapes=True,
        ),
    )
    contains = MappingProxyType({"bilinear_stiffness": {"position": 0.0}})
    formula = "f = t max(d - p, 0) if p >= 0, t min(d - p, 0) if p < 0"
    explanation = "There is a stop on one side of {place}: it is hit once the displacement passes it."
    words = (
        "limit on one side of the {moved}",
        "Beyond a limit on one side of the {moved} the {elastic} at {place} jumps up.",
    )
    belongs_to = "stiffness"

    @staticmethod
    def law(d, stiffness, position):  # type: ignore[no-untyped-def]
        """Formula."""
        # contact on the side of the sign of the position
        side = math.copysign(1.0, position)
        return stiffness * side * max(0.0, side * (d - position))

    def starts(self, seen: Seen) -> Sequence[dict[str, float]]:
        """Places on either side that the motion passes now and then."""
        # quantiles of the displacement on either side of rest
        sides = np.quantile(seen.d, [0.7, 0.9, 0.97, 0.3, 0.1, 0.03])
        reached = [q for q, sign in zip(sides, (1, 1, 1, -1, -1, -1), strict=True) if sign * q > 0]
        return [{"position": float(q)} for q in reached]


@register
class TwoStops(PortLaw):
    """Stops on both sides, each at a place of its own."""

    coefficients = (
        Coefficient("stiffness", "force/position", explanation="stiffness of both contacts"),
        Coefficient(
            "lower", "position", default_start=None, explanation="where the lower one is met", shapes=True
        ),
        Coefficient(
            "upper", "position", default_start=None, explanation="where the upper one is met", shapes=True
        ),
    )
    order = (("upper", "lower"),)
    contains = MappingProxyType({"end_stop": {"lower": -1e9}, "clearance": {}})
    formula = "f = t (d - upper) above upper, t (d - lower) below lower, else 0"
    explanation = "There are stops on both sides of {place}, each hit once the displacement passes it."
    words = (
        "limits on both sides of the {moved}",
        "Beyond either limit of the {moved} the {elastic} at {place} jumps up.",
    )
    belongs_to = "stiffness"

    @staticmethod
    def law(d, stiffness, lower, upper):  # type: ignore[no-untyped-def]
        """Formula."""
        # at most one of the contacts acts
        return stiffness * (max(0.0, d - upper) + min(0.0, d - lower))

    def starts(self, seen: Seen) -> Sequence[dict[str, float]]:
        """Places that the motion passes now and then, and rarely."""
        # share of the time beyond each stop
        shares = (0.15, 0.05, 0.3)
        return [
            {"lower": float(low), "upper": float(high)}
            for low, high in (np.quantile(seen.d, [q, 1.0 - q]) for q in shares)
            if low < high
        ]


# smooth stop
@register
class SoftClearance(PortLaw):
    """Stop that is met gradually: a gap with rounded corners."""

    coefficients = (
        Coefficient("stiffness", "force/position", explanation="stiffness of the contact"),
        positive("gap", "position", "play on either side, to the middle of the corner", shapes=True),
        positive("softness", "1", "rounding of the corner, in gaps", lower=0.1, upper=3.0, shapes=True),
    )
    formula = "f = t (d + (r(d - gap) - r(d + gap))/2), r(x) = sqrt(x^2 + (softness gap)^2)"
    explanation = "There is play at {place}, and its stop is met gradually, as through a layer of rubber."
    words = ("soft limit of the {moved}", "Beyond a limit of the {moved} the {elastic} at {place} grows.")
    belongs_to = "stiffness"
    contains = MappingProxyType({"stiffness": {"gap": 0.0}})

    @staticmethod
    def law(d, stiffness, gap, softness):  # type: ignore[no-untyped-def]
        """Formula."""
        # a hyperbola in place of each kink
        corner = softness * gap
        return stiffness * (d + 0.5 * (math.hypot(d - gap, corner) - math.hypot(d + gap, corner)))

    def starts(self, seen: Seen) -> Sequence[dict[str, float]]:
        """Gaps that the motion reaches now and then."""
        # quantiles of the displacement
        gaps = np.quantile(np.abs(seen.d), [0.4, 0.7, 0.9])
        return [{"gap": float(q), "softness": 1.0} for q in gaps]
