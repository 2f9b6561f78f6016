"""Dampers and friction: forces along the velocity of a port."""

from __future__ import annotations

import math
from collections.abc import Sequence
from types import MappingProxyType
from typing import Any

import numpy as np

from .absorbed import AbsorbedLaw, Assembly, Site, nominal_is_left
from .formula import PortLaw
from .law import Coefficient, Seen, register

# the width over which sgn(v) is smoothed is fixed, because a free one only fits noise
SIGN_WIDTH = 0.005  # of the rms velocity


@register
class Damping(AbsorbedLaw):
    """Change of a damper, or of a loss in proportion."""

    where = frozenset(["first_order", "mechanical"])
    coefficients = (Coefficient("damping", "force/velocity", explanation="change of damping"),)
    formula = "f = t v"
    explanation = "The damping at {place} is larger than the model says (smaller, if negative)."
    explanation_first_order = (
        "The loss or flow in proportion to the state at {place} is larger than the model says "
        "(smaller, if negative)."
    )
    linear = True
    needs = frozenset(["velocity"])
    is_parameter = True
    may_wear = True
    signal = "velocity"

    def absorb(self, into: Assembly, site: Site, *values: Any) -> None:
        """Add t v to the force at the port."""
        (t,) = values
        into.A += t * np.outer(site.act, site.velocity)
        into.Bu += t * np.outer(site.act, site.velocity_input)

    def bounds_in(self, structure: Any, place: str) -> tuple[float, float]:
        """What is left of the damper stays positive."""
        return nominal_is_left(self.name, structure, place)


@register
class CoulombFriction(PortLaw):
    """Dry friction of one level."""

    where = frozenset(["first_order", "mechanical"])
    coefficients = (Coefficient("force", "force", explanation="friction force, whatever the speed"),)
    constants = MappingProxyType({"width": None})
    formula = "f = t sgn(v)"
    explanation = "Dry friction acts at {place}: a force of constant size that opposes the motion."
    explanation_first_order = (
        "A loss of constant size acts at {place}, with the sign of the state, like dry friction."
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
    needs = frozenset(["velocity"])
    jumps = True
    turns = True
    width_share = SIGN_WIDTH
    holds_constant = True

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
        """Equal levels too: from zero, a push one way and a brake the other can look as good."""
        return [{"force_plus": q * seen.pull, "force_minus": q * seen.pull} for q in (0.0, 0.05, 0.2)]


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
    needs = frozenset(["velocity"])
    covers = ("damping",)

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
class StribeckFriction(PortLaw):
    """Dry friction that is higher at breakaway."""

    where = frozenset(["mechanical"])
    coefficients = (
        Coefficient("coulomb_force", "force", lower=0.0, explanation="friction force at high speed"),
        Coefficient("static_force", "force", lower=0.0, explanation="friction force at breakaway"),
        Coefficient(
            "velocity",
            "velocity",
            lower=0.0,
            default_start=None,
            shapes=True,
            explanation="speed at which the static part has faded",
        ),
    )
    constants = MappingProxyType({"width": None})
    formula = "f = sgn(v) (Fc + (Fs - Fc) exp(-(v/vs)^2))"
    explanation = (
        "Dry friction at {place} is at least as high at breakaway as in motion; any excess fades with "
        "speed (stick and slip)."
    )
    needs = frozenset(["velocity"])
    order = (("static_force", "coulomb_force"),)
    jumps = True
    turns = True
    width_share = SIGN_WIDTH

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
    explanation_first_order = "A loss that grows with the square of the state acts at {place}."
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
    explanation_first_order = "A loss that grows with the cube of the state acts at {place}."
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
class Hysteresis(PortLaw):
    """Dahl's law: presliding and slip."""

    where = frozenset(["mechanical"])
    coefficients = (
        Coefficient("force", "force", explanation="force that the hysteresis saturates at"),
        Coefficient(
            "displacement",
            "position",
            lower=0.0,
            default_start=None,
            shapes=True,
            explanation="presliding displacement: how far it gives before it slips",
        ),
    )
    formula = "f = t z/D, dz/dt = v - |v| z/D (Dahl)"
    explanation = (
        "The force at {place} depends on the path taken: a joint that gives a little before it slips."
    )
    needs = frozenset(["position", "velocity"])
    inner_states = 1
    belongs_to = "stiffness"
    turns = True

    @staticmethod
    def law(d, d_start, z_start, force, displacement):  # type: ignore[no-untyped-def]
        """Formula."""
        side = 1.0 if d >= d_start else -1.0
        z = side + (z_start - side) * math.exp(-abs(d - d_start) / displacement)
        return force * z, z

    @staticmethod
    def slopes(d, d_start, z_start, force, displacement):  # type: ignore[no-untyped-def]
        """With its derivatives."""
        step = d - d_start
        side = 1.0 if step >= 0.0 else -1.0
        decay = math.exp(-abs(step) / displacement)
        left = (z_start - side) * decay
        z, by_d = side + left, -left * side / displacement
        by_displacement = left * abs(step) / (displacement * displacement)
        return (
            (force * z, force * by_d, -force * by_d, force * decay, z, force * by_displacement),
            (z, by_d, -by_d, decay, 0.0, by_displacement),
        )

    @staticmethod
    def rate(d, v, z, force, displacement):  # type: ignore[no-untyped-def]
        """Of the inner state."""
        return (v - abs(v) * z) / displacement

    def starts(self, seen: Seen) -> Sequence[dict[str, float]]:
        """Presliding in shares of the motion."""
        rms = float(np.sqrt(np.mean(seen.d**2)))
        return [{"displacement": q * rms} for q in (0.3, 0.05, 1.0)]
