"""Friction and hysteresis: forces that depend on direction and path."""

from __future__ import annotations

import math
from collections.abc import Sequence
from types import MappingProxyType

import numpy as np

from .formula import PortLaw
from .law import PORTS, Coefficient, Seen, at_quantiles, positive, register, rms

# the smoothing width of sgn(v) is fixed, because a free one would only fit noise
SIGN_WIDTH = 0.005  # width over the rms velocity
SEEN_TO_FADE = (3.0, 1e5)  # bounds of a fading velocity in widths of sgn(v)


class _DryFriction(PortLaw):
    """Force that jumps with the sign of the velocity."""

    constants = MappingProxyType({"width": None})
    jumps = True
    turns = True
    width_share = SIGN_WIDTH


# friction without memory: force by velocity alone
@register
class CoulombFriction(_DryFriction):
    """Dry friction of one level."""

    where = PORTS
    coefficients = (Coefficient("force", "force", explanation="friction force, whatever the speed"),)
    formula = "f = t sgn(v)"
    explanation = "Dry friction acts at {place}: a force of constant size that opposes the motion."
    words = (
        "{loss} of constant size",
        "The {loss} at {place} has a part of constant size, with the sign of the {state}.",
    )
    with_offset = "asymmetric_friction"
    both_ways = True  # a flow that has one direction has no sign to jump with

    @staticmethod
    def law(v, force, width):  # type: ignore[no-untyped-def]
        """Formula."""
        # sgn(v) smoothed to tanh(v / width)
        return force * math.tanh(v / width)


@register
class SmoothFriction(PortLaw):
    """Friction that builds up over a range of speeds."""

    where = PORTS
    coefficients = (
        Coefficient("force", "force", explanation="friction force at high speed"),
        positive(
            "velocity",
            "velocity",
            "speed at which it has reached three quarters of that",
            widths=(20.0, 1000.0),  # below the bounds it is a jump, above them a damper
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
    turns = True
    width_share = SIGN_WIDTH
    contains = MappingProxyType({"damping": {}, "coulomb_friction": {"velocity": 1e-9}})
    both_ways = True  # a flow that has one direction is no odd function

    @staticmethod
    def law(v, force, velocity):  # type: ignore[no-untyped-def]
        """Formula."""
        # sgn(v) with a width that is estimated
        return force * math.tanh(v / velocity)

    def starts(self, seen: Seen) -> Sequence[dict[str, float]]:
        """Widths about that of the motion."""
        # widths around the rms velocity
        return [{"velocity": q * rms(seen.v)} for q in (1.0, 0.3, 3.0)]


@register
class AsymmetricFriction(_DryFriction):
    """Dry friction of two levels."""

    where = PORTS
    of_speeds = True
    coefficients = (
        Coefficient("force_plus", "force", explanation="friction force where v > 0"),
        Coefficient("force_minus", "force", explanation="friction force where v < 0 (positive = resistance)"),
    )
    formula = "f = t+ where v > 0, -t- where v < 0"
    explanation = "Dry friction at {place} differs between the two directions of motion, like a worn screw."
    words = (
        "{loss} of two sizes",
        "The {loss} at {place} has a part of constant size, another one for each sign of the {state}.",
    )
    holds_constant = True
    contains = MappingProxyType({"coulomb_friction": {}, "constant_force": {}})

    @staticmethod
    def law(v, force_plus, force_minus, width):  # type: ignore[no-untyped-def]
        """Formula."""
        # one level for each direction
        return (force_plus if v > 0.0 else force_minus) * math.tanh(v / width)

    def starts(self, seen: Seen) -> Sequence[dict[str, float]]:
        """Return initial guesses, which include equal levels.

        From zero, a push in one direction and a brake in the other can fit equally well.
        """
        # no friction, and friction of 5 and 20 % of the force that moves the port
        return [{"force_plus": q * seen.pull, "force_minus": q * seen.pull} for q in (0.0, 0.05, 0.2)]


@register
class StribeckFriction(_DryFriction):
    """Dry friction that is higher at breakaway."""

    where = PORTS
    of_speeds = True
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
    formula = "f = sgn(v) (Fc + (Fs - Fc) exp(-(v/vs)^2))"
    explanation = (
        "Dry friction at {place} is at least as high at breakaway as in motion; any excess fades with "
        "speed (stick and slip)."
    )
    words = (
        "falling {loss}",
        "The {loss} at {place} has a part that is higher at a small {state} than at a large one.",
    )
    order = (("static_force", "coulomb_force"),)
    contains = MappingProxyType({"coulomb_friction": {}})

    @staticmethod
    def law(v, coulomb_force, static_force, velocity, width):  # type: ignore[no-untyped-def]
        """Formula."""
        # Stribeck effect: the excess at breakaway fades as a Gaussian of the velocity
        fading = math.exp(-((v / velocity) ** 2))
        return math.tanh(v / width) * (coulomb_force + (static_force - coulomb_force) * fading)

    def starts(self, seen: Seen) -> Sequence[dict[str, float]]:
        """A level to begin with: at zero force the fading speed has no gradient."""
        return [
            {
                "velocity": q * rms(seen.v),
                "coulomb_force": share * seen.pull,
                "static_force": 2 * share * seen.pull,
            }
            for share in (0.05, 0.2)
            for q in (0.3, 0.1, 1.0)
        ]


# friction with the load
@register
class LoadFriction(_DryFriction):
    """Dry friction under a load that the deflection brings."""

    coefficients = (
        Coefficient("load_friction", "force/position", explanation="friction force per deflection"),
    )
    formula = "f = t |d| sgn(v)"
    explanation = (
        "Dry friction at {place} grows with the load that its deflection brings: leaf springs, wedges, gears."
    )
    belongs_to = "stiffness"
    on_request = True  # the load must be known to come from this deflection

    @staticmethod
    def law(d, v, load_friction, width):  # type: ignore[no-untyped-def]
        """Formula."""
        # Coulomb friction with the normal force |d|
        return load_friction * abs(d) * math.tanh(v / width)


# friction with an inner state: presliding displacement
@register
class Hysteresis(PortLaw):
    """Dahl's law: presliding and slip."""

    coefficients = (
        Coefficient("force", "force", explanation="force that the hysteresis saturates at"),
        positive(
            "displacement",
            "position",
            "presliding displacement: how far it gives before it slips",
            shapes=True,
        ),
    )
    formula = "f = t z/D, dz/dt = v - |v| z/D (Dahl)"
    explanation = (
        "The force at {place} depends on the path taken: a joint that gives a little before it slips."
    )
    words = (
        "hysteresis of the {moved}",
        "The {elastic} at {place} depends on the path that the {moved} took.",
    )
    needs = frozenset(["position", "velocity"])
    inner_states = 1
    belongs_to = "stiffness"
    turns = True
    contains = MappingProxyType({"coulomb_friction": {}, "stiffness": {}})

    @staticmethod
    def law(d, d_start, z_start, force, displacement):  # type: ignore[no-untyped-def]
        """Formula."""
        # Dahl's equation dz/ds = 1 - z sgn(v), solved exactly over the step; z scaled to 1 at slip
        side = math.copysign(1.0, d - d_start)
        z = side + (z_start - side) * math.exp(-abs(d - d_start) / displacement)
        return force * z, z

    @staticmethod
    def rate(d, v, z, force, displacement):  # type: ignore[no-untyped-def]
        """Of the inner state."""
        # dz/dt = (v - |v| z) / D
        return (v - abs(v) * z) / displacement

    def starts(self, seen: Seen) -> Sequence[dict[str, float]]:
        """Presliding in shares of the motion."""
        # presliding displacements around a third of the rms displacement
        return [{"displacement": q * rms(seen.d)} for q in (0.3, 0.05, 1.0)]


@register
class LugreFriction(PortLaw):
    """LuGre friction: bristles that deflect before they slip.

    The friction level falls with speed.

    The step is exact for the level at its end, so stiff bristles need no finer ones. Damping of the
    bristles themselves is left out: only micrometers before slip show it.
    """

    coefficients = (
        Coefficient("force", "force", explanation="friction force at high speed"),
        positive("static_ratio", "1", "friction at breakaway over that", lower=1.0, upper=10.0, shapes=True),
        positive(
            "velocity",
            "velocity",
            "speed at which the static part has faded",
            widths=SEEN_TO_FADE,
            shapes=True,
        ),
        positive(
            "displacement",
            "position",
            "how far it gives before it slips: force over stiffness of the bristles",
            shapes=True,
        ),
    )
    formula = "f = F z, D dz/dt = v - |v| z/g, g = 1 + (r - 1) exp(-(v/vs)^2) (LuGre)"
    explanation = (
        "Friction at {place} gives before it slips, and is higher at breakaway than in motion (LuGre)."
    )
    words = ("lagging {loss}", "The {loss} at {place} has a part that builds up behind the {state}.")
    inner_states = 1
    belongs_to = "stiffness"
    turns = True
    width_share = SIGN_WIDTH
    contains = MappingProxyType(
        {
            "hysteresis": {"static_ratio": 1.0},
            "coulomb_friction": {"static_ratio": 1.0},
            "stribeck_friction": {},
        }
    )

    @staticmethod
    def law(v, d, d_start, z_start, force, static_ratio, velocity, displacement):  # type: ignore[no-untyped-def]
        """Formula."""
        # Stribeck curve: level at which the bristles slip
        level = 1.0 + (static_ratio - 1.0) * math.exp(-((v / velocity) ** 2))
        # the same solution as Dahl's, with the level in place of 1
        end = math.copysign(level, d - d_start)
        z = end + (z_start - end) * math.exp(-abs(d - d_start) / (displacement * level))
        return force * z, z

    @staticmethod
    def rate(d, v, z, force, static_ratio, velocity, displacement):  # type: ignore[no-untyped-def]
        """Of the inner state."""
        level = 1.0 + (static_ratio - 1.0) * np.exp(-((v / velocity) ** 2))
        return (v - abs(v) * z / level) / displacement

    def starts(self, seen: Seen) -> Sequence[dict[str, float]]:
        """Presliding and fading in shares of the motion."""
        d, v = rms(seen.d), rms(seen.v)
        # pairs of presliding displacement and fading velocity, in shares of the rms
        pairs = ((0.05, 0.3), (0.3, 0.3), (0.05, 0.1))
        return [{"static_ratio": 1.5, "velocity": q * v, "displacement": p * d} for p, q in pairs]


@register
class Play(PortLaw):
    """Spring behind a gap that is carried along: backlash with memory."""

    coefficients = (
        Coefficient("stiffness", "force/position", explanation="stiffness of what is dragged along"),
        positive("gap", "position", "play on either side", shapes=True),
    )
    formula = "f = t z, z follows d with play of +- gap"
    explanation = "A spring at {place} is dragged along behind a play: the force depends on the path taken."
    belongs_to = "stiffness"
    inner_states = 1
    contains = MappingProxyType({"stiffness": {"gap": 0.0}})
    on_request = True  # in parallel to a spring it is hysteresis

    @staticmethod
    def law(d, z_start, stiffness, gap):  # type: ignore[no-untyped-def]
        """Formula."""
        # play operator: z stays within the gap of d
        z = min(max(z_start, d - gap), d + gap)
        return stiffness * z, z

    def starts(self, seen: Seen) -> Sequence[dict[str, float]]:
        """Gaps in shares of the motion."""
        return at_quantiles("gap", np.abs(seen.d), [0.3, 0.6, 0.1])
