"""Fields: forces that a place feels where it is, by gravity or by magnets."""

from __future__ import annotations

import math
from collections.abc import Sequence
from types import MappingProxyType

import numpy as np

from .formula import PortLaw
from .law import Coefficient, positive, register
from .seen import Seen


@register
class Gravity(PortLaw):
    """Weight on a lever."""

    where = frozenset(["mechanical"])
    coefficients = (Coefficient("torque", "force", explanation="m g l: torque of the weight, held level"),)
    constants = MappingProxyType({"tangent": 1.0})
    from_zero = frozenset(["tangent"])  # a model that is linear about the lowest point has the slope already
    formula = "f = t (sin(d) - (1 - tangent) d), d the angle from where it hangs in rad"
    explanation = "The weight at {place} pulls back by the sine of the angle, as at a pendulum (m g l sin)."
    belongs_to = "stiffness"
    domains = frozenset(["rotational"])

    @staticmethod
    def law(d, torque, tangent):  # type: ignore[no-untyped-def]
        """Formula."""
        return torque * (math.sin(d) - (1.0 - tangent) * d)

    @staticmethod
    def slopes(d, torque, tangent):  # type: ignore[no-untyped-def]
        """With its derivatives."""
        bent = math.sin(d) - (1.0 - tangent) * d
        return torque * bent, torque * (math.cos(d) - 1.0 + tangent), bent, torque * d


@register
class Cogging(PortLaw):
    """Force that repeats with the position."""

    where = frozenset(["mechanical"])
    coefficients = (
        Coefficient("sine", "force", explanation="part that is zero at rest"),
        Coefficient("cosine", "force", explanation="part that is largest at rest"),
        positive("period", "position", "distance from one cog to the next", shapes=True),
    )
    formula = "f = a sin(2 pi d/P) + b (cos(2 pi d/P) - 1)"
    explanation = "The force at {place} repeats with the position: cogging of a motor, ripple of gears."
    belongs_to = "stiffness"
    on_request = True  # its period is many valleys where the drawing does not tell it

    @staticmethod
    def law(d, sine, cosine, period):  # type: ignore[no-untyped-def]
        """Formula."""
        angle = 2.0 * math.pi * d / period
        return sine * math.sin(angle) + cosine * (math.cos(angle) - 1.0)

    @staticmethod
    def slopes(d, sine, cosine, period):  # type: ignore[no-untyped-def]
        """With its derivatives."""
        angle = 2.0 * math.pi * d / period
        s, c = math.sin(angle), math.cos(angle)
        turn = sine * c - cosine * s
        by_d = turn * 2.0 * math.pi / period
        return sine * s + cosine * (c - 1.0), by_d, s, c - 1.0, -turn * angle / period

    def starts(self, seen: Seen) -> Sequence[dict[str, float]]:
        """Shares of the way that the record shows."""
        way = float(np.ptp(seen.d))
        return [{"period": way / q} for q in (2.0, 4.0, 8.0, 16.0, 32.0, 1.0)]


@register
class MagneticForce(PortLaw):
    """Pull of an electromagnet."""

    where = frozenset(["mechanical"])
    coefficients = (
        Coefficient(
            "strength", "force position^2/signal^2", explanation="k: pull at unit current and distance"
        ),
    )
    constants = MappingProxyType({"gap": 1.0, "current": 1.0})
    formula = "f = -k i^2/(gap - d)^2, i the input numbered `current` from 1"
    explanation = "A magnet pulls at {place}, by the square of its current over the square of its distance."
    belongs_to = "stiffness"
    on_request = True  # which input is the current, and how far the magnet is, nobody can guess

    @staticmethod
    def law(d, w, strength, gap, current):  # type: ignore[no-untyped-def]
        """Formula: a pull towards positive d is a negative resistance."""
        return -strength * (w[int(current) - 1] / (gap - d)) ** 2
