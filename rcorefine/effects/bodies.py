"""Bodies: what a port moves, what hangs on it, what pulls at it."""

from __future__ import annotations

from collections.abc import Sequence
from math import inf
from typing import Any

import numpy as np

from ..systems.linear import Array
from .absorbed import AbsorbedLaw, Assembly, Site
from .law import Coefficient, positive, register
from .seen import Seen


@register
class Mass(AbsorbedLaw):
    """Change of a moving mass, or of a store."""

    where = frozenset(["first_order", "mechanical"])
    coefficients = (Coefficient("mass", "force s/velocity", explanation="added mass"),)
    formula = "f = t dv/dt"
    explanation = "The moving mass at {place} is larger than the model says (smaller, if negative)."
    words = ("{store}", "The {store} at {place} is larger than the model says (smaller, if negative).")
    linear = True
    needs = frozenset(["velocity"])
    senses = frozenset({"velocity", "acceleration"})
    belongs_to = "mass"
    is_parameter = True
    inertial = True
    signal = "acceleration"

    def absorb(self, into: Assembly, site: Site, *values: Any) -> None:
        """Add t to the inertia along the port."""
        (t,) = values
        into.inertia -= t * np.outer(site.act, site.velocity)
        into.Bu += t * np.outer(site.act, site.acceleration_input)

    def bounds_in(self, structure: Any, place: str) -> tuple[float, float]:
        """Something is left that moves."""
        return -structure.inertia(place) * (1 - 1e-9), inf

    def plausible_in_store(self, *, one_way: bool, between: bool, known_mass: bool) -> bool:
        """Only where a builder knows the store; else it rescales a row of A."""
        return known_mass


@register
class HiddenMode(AbsorbedLaw):
    """Mass, spring and damper that hang on a port."""

    where = frozenset(["mechanical"])
    coefficients = (
        positive("mass", "force s/velocity", "attached mass"),
        positive("damping", "force/velocity", "its damper"),
        positive("stiffness", "force/position", "its spring"),
    )
    formula = "m z'' = f = c (v - z') + k (d - z)"
    explanation = (
        "Something is attached at {place} and vibrates on its own spring: a mass, spring and damper "
        "that the model lacks."
    )
    words = ("hidden {resonance}", "A {resonance} that the model lacks is coupled in at {place}.")
    linear = True
    needs = frozenset(["velocity"])
    inner_states = 2
    essential = ("mass", "stiffness")
    senses = frozenset({"position", "velocity", "acceleration"})
    belongs_to = "mass"
    states = ("stretch", "velocity")
    secant = True
    along_motion = False

    def absorb(self, into: Assembly, site: Site, *values: Any) -> None:
        """Add its stretch u and speed s: f = k u + c (v - s)."""
        mass, c, k = values
        stretch, speed = site.state, site.state + 1
        pull = np.zeros(into.constant.size, into.A.dtype)
        pull[stretch] += k
        pull[speed] -= c
        pull += c * site.velocity
        into.A += np.outer(site.act, pull)
        into.Bu += c * np.outer(site.act, site.velocity_input)
        into.A[stretch] += site.velocity
        into.A[stretch, speed] -= 1.0
        into.Bu[stretch] += site.velocity_input
        into.A[speed] += pull / mass
        into.Bu[speed] += c / mass * site.velocity_input

    def starts(self, seen: Seen) -> Sequence[dict[str, float]]:
        """A mode at each of the highest peaks of the residual."""
        turns = list(seen.peaks) or [0.1 * np.pi / seen.dt]
        mass = 0.03 / (seen.mobility or 1.0)
        return [{"mass": mass, "damping": 0.06 * mass * o, "stiffness": mass * o**2} for o in turns]


@register
class ConstantForce(AbsorbedLaw):
    """Weight, preload, leak."""

    where = frozenset(["first_order", "mechanical"])
    coefficients = (Coefficient("force", "force", explanation="constant resisting force"),)
    formula = "f = t"
    explanation = "A constant force acts at {place}: weight, preload or a tilted base."
    words = ("{constant}", "There is a {constant} at {place} that the model lacks.")
    belongs_to = "mass"
    holds_constant = True
    signal = "constant"

    def absorb(self, into: Assembly, site: Site, *values: Any) -> None:
        """Add t to the force at the port."""
        into.constant += values[0] * site.act

    def push(self, linear: Any, place: str, act: Array | None) -> Array | None:
        """Along the port."""
        return act
