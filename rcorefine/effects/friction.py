"""Friction: forces that turn with the velocity of a port."""

from __future__ import annotations

import math
from collections.abc import Sequence
from types import MappingProxyType

import numpy as np

from .formula import PortLaw
from .law import Coefficient, positive, register
from .seen import Seen

# the width over which sgn(v) is smoothed is fixed, because a free one only fits noise
SIGN_WIDTH = 0.005  # of the rms velocity
SEEN_TO_FADE = (3.0, 1e5)  # widths of sgn(v): from where that has turned over to far beyond the motion


@register
class CoulombFriction(PortLaw):
    """Dry friction of one level."""

    where = frozenset(["first_order", "mechanical"])
    coefficients = (Coefficient("force", "force", explanation="friction force, whatever the speed"),)
    constants = MappingProxyType({"width": None})
    formula = "f = t sgn(v)"
    explanation = "Dry friction acts at {place}: a force of constant size that opposes the motion."
    words = (
        "{loss} of constant size",
        "The {loss} at {place} has a part of constant size, with the sign of the {state}.",
    )
    needs = frozenset(["velocity"])
    jumps = True
    turns = True
    width_share = SIGN_WIDTH
    with_offset = "asymmetric_friction"

    @staticmethod
    def law(v, force, width):  # type: ignore[no-untyped-def]
        """Formula."""
        return force * math.tanh(v / width)

    @staticmethod
    def slopes(v, force, width):  # type: ignore[no-untyped-def]
        """With its derivatives."""
        sign = math.tanh(v / width)
        return force * sign, force * (1.0 - sign * sign) / width, sign, 0.0

    def plausible_in_store(self, *, one_way: bool, between: bool, known_mass: bool) -> bool:
        """A flow that has one direction has no sign to jump with."""
        return not one_way


@register
class SmoothFriction(PortLaw):
    """Friction that builds up over a range of speeds."""

    where = frozenset(["first_order", "mechanical"])
    coefficients = (
        Coefficient("force", "force", explanation="friction force at high speed"),
        positive(
            "velocity",
            "velocity",
            "speed at which it has reached three quarters of that",
            widths=(20.0, 1000.0),  # below it is a jump, above a damper
            shapes=True,
        ),
    )
    formula = "f = t tanh(v/v0)"
    explanation = (
        "Friction at {place} builds up with speed and levels off, without a jump: as an oiled contact does."
    )
    words = (
        "saturating {loss}",
        "The {loss} at {place} has a part that grows with the {state} and levels off.",
    )
    needs = frozenset(["velocity"])
    turns = True
    width_share = SIGN_WIDTH
    contains = MappingProxyType({"damping": {}})

    @staticmethod
    def law(v, force, velocity):  # type: ignore[no-untyped-def]
        """Formula."""
        return force * math.tanh(v / velocity)

    @staticmethod
    def slopes(v, force, velocity):  # type: ignore[no-untyped-def]
        """With its derivatives."""
        share = math.tanh(v / velocity)
        slope = force * (1.0 - share * share) / velocity
        return force * share, slope, share, -slope * v / velocity

    def plausible_in_store(self, *, one_way: bool, between: bool, known_mass: bool) -> bool:
        """A flow that has one direction is no odd function."""
        return not one_way

    def starts(self, seen: Seen) -> Sequence[dict[str, float]]:
        """Widths about that of the motion."""
        rms = float(np.sqrt(np.mean(seen.v**2)))
        return [{"velocity": q * rms} for q in (1.0, 0.3, 3.0)]


@register
class AsymmetricFriction(PortLaw):
    """Dry friction of two levels."""

    where = frozenset(["mechanical"])
    coefficients = (
        Coefficient("force_plus", "force", explanation="friction force where v > 0"),
        Coefficient(
            "force_minus",
            "force",
            explanation="friction force where v < 0 (positive = resistance)",
        ),
    )
    constants = MappingProxyType({"width": None})
    formula = "f = t+ where v > 0, -t- where v < 0"
    explanation = "Dry friction at {place} differs between the two directions of motion, like a worn screw."
    words = (
        "{loss} of two sizes",
        "The {loss} at {place} has a part of constant size, another one for each sign of the {state}.",
    )
    needs = frozenset(["velocity"])
    jumps = True
    turns = True
    width_share = SIGN_WIDTH
    holds_constant = True
    contains = MappingProxyType({"coulomb_friction": {}, "constant_force": {}})

    @staticmethod
    def law(v, force_plus, force_minus, width):  # type: ignore[no-untyped-def]
        """Formula."""
        return (force_plus if v > 0.0 else force_minus) * math.tanh(v / width)

    @staticmethod
    def slopes(v, force_plus, force_minus, width):  # type: ignore[no-untyped-def]
        """With its derivatives."""
        sign = math.tanh(v / width)
        slope = (1.0 - sign * sign) / width
        if v > 0.0:
            return force_plus * sign, force_plus * slope, sign, 0.0, 0.0
        return force_minus * sign, force_minus * slope, 0.0, sign, 0.0

    def starts(self, seen: Seen) -> Sequence[dict[str, float]]:
        """Return initial guesses, which include equal levels.

        From zero, a push in one direction and a brake in the other can fit equally well.
        """
        return [{"force_plus": q * seen.pull, "force_minus": q * seen.pull} for q in (0.0, 0.05, 0.2)]


@register
class StribeckFriction(PortLaw):
    """Dry friction that is higher at breakaway."""

    where = frozenset(["mechanical"])
    coefficients = (
        Coefficient("coulomb_force", "force", lower=0.0, explanation="friction force at high speed"),
        Coefficient("static_force", "force", lower=0.0, explanation="friction force at breakaway"),
        positive(
            "velocity",
            "velocity",
            "speed at which the static part has faded",
            widths=SEEN_TO_FADE,
            shapes=True,
        ),
    )
    constants = MappingProxyType({"width": None})
    formula = "f = sgn(v) (Fc + (Fs - Fc) exp(-(v/vs)^2))"
    explanation = (
        "Dry friction at {place} is at least as high at breakaway as in motion; any excess fades with "
        "speed (stick and slip)."
    )
    words = (
        "falling {loss}",
        "The {loss} at {place} has a part that is higher at a small {state} than at a large one.",
    )
    needs = frozenset(["velocity"])
    order = (("static_force", "coulomb_force"),)
    jumps = True
    turns = True
    width_share = SIGN_WIDTH
    contains = MappingProxyType({"coulomb_friction": {}})

    @staticmethod
    def law(v, coulomb_force, static_force, velocity, width):  # type: ignore[no-untyped-def]
        """Formula."""
        fading = math.exp(-((v / velocity) ** 2))
        return math.tanh(v / width) * (coulomb_force + (static_force - coulomb_force) * fading)

    @staticmethod
    def slopes(v, coulomb_force, static_force, velocity, width):  # type: ignore[no-untyped-def]
        """With its derivatives."""
        sign = math.tanh(v / width)
        slope = (1.0 - sign * sign) / width
        fading = math.exp(-((v / velocity) ** 2))
        excess = (static_force - coulomb_force) * fading
        level = coulomb_force + excess
        by_v = level * slope - excess * 2.0 * v / (velocity * velocity) * sign
        by_velocity = excess * 2.0 * v * v / (velocity * velocity * velocity) * sign
        return level * sign, by_v, (1.0 - fading) * sign, fading * sign, by_velocity, 0.0

    def starts(self, seen: Seen) -> Sequence[dict[str, float]]:
        """A level to begin with: at zero force the fading speed has no gradient."""
        rms = float(np.sqrt(np.mean(seen.v**2)))
        return [
            {"velocity": q * rms, "coulomb_force": share * seen.pull, "static_force": 2 * share * seen.pull}
            for share in (0.05, 0.2)
            for q in (0.3, 0.1, 1.0)
        ]


@register
class LoadFriction(PortLaw):
    """Dry friction under a load that the deflection brings."""

    where = frozenset(["mechanical"])
    coefficients = (
        Coefficient("load_friction", "force/position", explanation="friction force per deflection"),
    )
    constants = MappingProxyType({"width": None})
    formula = "f = t |d| sgn(v)"
    explanation = (
        "Dry friction at {place} grows with the load that its deflection brings: leaf springs, wedges, gears."
    )
    needs = frozenset(["position", "velocity"])
    belongs_to = "stiffness"
    on_request = True  # who knows that the load is this deflection can say so
    jumps = True
    turns = True
    width_share = SIGN_WIDTH

    @staticmethod
    def law(d, v, load_friction, width):  # type: ignore[no-untyped-def]
        """Formula."""
        return load_friction * abs(d) * math.tanh(v / width)

    @staticmethod
    def slopes(d, v, load_friction, width):  # type: ignore[no-untyped-def]
        """With its derivatives."""
        sign = math.tanh(v / width)
        side = 1.0 if d > 0.0 else -1.0
        by_v = load_friction * abs(d) * (1.0 - sign * sign) / width
        return load_friction * abs(d) * sign, load_friction * side * sign, by_v, abs(d) * sign, 0.0
