"""Flows out of a store, by its level."""

from __future__ import annotations

from collections.abc import Sequence
from types import MappingProxyType

import numpy as np

from .formula import PortLaw
from .law import Coefficient, register
from .seen import Seen

ROOT_WIDTH = 1e-3  # of the rms level: a root has no slope at zero


@register
class SqrtFlow(PortLaw):
    """Orifice."""

    where = frozenset(["first_order"])
    coefficients = (Coefficient("flow", "force/velocity^0.5", explanation="flow per root of the state"),)
    formula = "f = t sqrt(max(x, 0))"
    explanation = (
        "The outflow at {place} follows the square root of the level, as through an orifice (Torricelli)."
    )
    needs = frozenset(["velocity"])
    domains = frozenset(["first_order", "hydraulic"])
    width_share = ROOT_WIDTH

    @staticmethod
    def law(v, flow, width):  # type: ignore[no-untyped-def]
        """Formula."""
        return flow * v / (v * v + width * width) ** 0.25 if v > 0.0 else 0.0

    @staticmethod
    def slopes(v, flow, width):  # type: ignore[no-untyped-def]
        """With its derivatives."""
        if v <= 0.0:
            return 0.0, 0.0, 0.0, 0.0
        root = (v * v + width * width) ** 0.25
        slope = flow * (1.0 / root - 0.5 * v * v / (root * root * root * root * root))
        return flow * v / root, slope, v / root, 0.0

    def plausible_in_store(self, *, one_way: bool, between: bool, known_mass: bool) -> bool:
        """A level has a root, the difference of two temperatures has not."""
        return not between


@register
class ThresholdFlow(PortLaw):
    """Overflow."""

    where = frozenset(["first_order"])
    coefficients = (
        Coefficient("flow", "force/velocity", explanation="flow per unit above the threshold"),
        Coefficient(
            "threshold", "velocity", default_start=None, shapes=True, explanation="level at which it starts"
        ),
    )
    formula = "f = t max(x - threshold, 0)"
    explanation = "Beyond a certain level something spills over at {place}."
    contains = MappingProxyType({"damping": {"threshold": 0.0}})  # of a level, which is not negative
    needs = frozenset(["velocity"])
    domains = frozenset(["first_order", "hydraulic"])

    @staticmethod
    def law(v, flow, threshold):  # type: ignore[no-untyped-def]
        """Formula."""
        return flow * max(v - threshold, 0.0)

    @staticmethod
    def slopes(v, flow, threshold):  # type: ignore[no-untyped-def]
        """With its derivatives."""
        excess = v - threshold
        if excess <= 0.0:
            return 0.0, 0.0, 0.0, 0.0
        return flow * excess, flow, excess, -flow

    def plausible_in_store(self, *, one_way: bool, between: bool, known_mass: bool) -> bool:
        """A level has a rim, the difference of two temperatures has not."""
        return not between

    def starts(self, seen: Seen) -> Sequence[dict[str, float]]:
        """Rims that the level reaches."""
        return [{"threshold": float(q)} for q in np.quantile(seen.v, [0.7, 0.9, 0.5])]


@register
class CarriedFlow(PortLaw):
    """Flow that an input carries away."""

    where = frozenset(["first_order"])
    coefficients = (
        Coefficient("flow", "force/velocity/signal", explanation="flow per unit of state and input"),
    )
    constants = MappingProxyType({"input": 1.0})
    formula = "f = t w v, w the input numbered `input` from 1"
    explanation = "An input carries the content of {place} away: a flow times a temperature or a level."
    belongs_to = "damping"
    on_request = True  # which input carries it, nobody can guess

    @staticmethod
    def law(v, w, flow, input):  # type: ignore[no-untyped-def]
        """Formula."""
        return flow * w[int(input) - 1] * v


@register
class Radiation(PortLaw):
    """Heat that is radiated."""

    where = frozenset(["first_order"])
    coefficients = (
        Coefficient("radiation", "force/velocity^4", explanation="emissivity times area times 5.67e-8"),
    )
    constants = MappingProxyType({"temperature": 293.15})
    from_zero = frozenset(["temperature"])  # of a state that is an absolute temperature itself
    formula = "f = t ((T0 + x)^4 - T0^4), T0 the absolute `temperature` where x = 0"
    explanation = "Heat is radiated at {place}, by the fourth power of the absolute temperature."
    on_request = True  # only who knows that the state is a temperature can say so

    @staticmethod
    def law(v, radiation, temperature):  # type: ignore[no-untyped-def]
        """Formula."""
        return radiation * ((temperature + v) ** 4 - temperature**4)

    @staticmethod
    def slopes(v, radiation, temperature):  # type: ignore[no-untyped-def]
        """With its derivatives."""
        absolute = temperature + v
        unit = absolute**4 - temperature**4
        by_temperature = 4.0 * radiation * (absolute**3 - temperature**3)
        return radiation * unit, 4.0 * radiation * absolute**3, unit, by_temperature
