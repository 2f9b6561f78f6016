"""Dampers and friction: forces along the velocity of a port."""

from __future__ import annotations

from collections.abc import Sequence
from types import MappingProxyType
from typing import Any

import numpy as np

from .law import AbsorbedLaw, Assembly, Coefficient, PortLaw, Seen, Site, nominal_is_left, register

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
    number = 5

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
    number = 6

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
    number = 7


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
    number = 8

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
    number = 9


@register
class CubicDamping(PortLaw):
    """Damper that grows with the cube."""

    where = frozenset(["first_order", "mechanical"])
    coefficients = (Coefficient("cubic_damping", "force/velocity^3", explanation="force per cubed velocity"),)
    formula = "f = t v^3"
    explanation = "The damping at {place} grows with the cube of the speed."
    explanation_first_order = "A loss that grows with the cube of the state acts at {place}."
    needs = frozenset(["velocity"])
    number = 10

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
    number = 11

    def starts(self, seen: Seen) -> Sequence[dict[str, float]]:
        """Presliding in shares of the motion."""
        rms = float(np.sqrt(np.mean(seen.d**2)))
        return [{"displacement": q * rms} for q in (0.3, 0.05, 1.0)]
