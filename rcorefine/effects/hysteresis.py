"""Hysteresis: forces that remember the path of a port."""

from __future__ import annotations

import math
from collections.abc import Sequence
from types import MappingProxyType

import numpy as np

from .formula import PortLaw
from .friction import SEEN_TO_FADE, SIGN_WIDTH
from .law import Coefficient, positive, register
from .seen import Seen


@register
class Hysteresis(PortLaw):
    """Dahl's law: presliding and slip."""

    where = frozenset(["mechanical"])
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


@register
class LugreFriction(PortLaw):
    """LuGre friction: bristles that deflect before they slip.

    The friction level falls with speed.

    The step is exact for the level at its end, so stiff bristles need no finer ones. Damping of the
    bristles themselves is left out: only micrometers before slip show it.
    """

    where = frozenset(["mechanical"])
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
    words = (
        "lagging {loss}",
        "The {loss} at {place} has a part that builds up behind the {state}.",
    )
    needs = frozenset(["position", "velocity"])
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
        level = 1.0 + (static_ratio - 1.0) * math.exp(-((v / velocity) ** 2))
        end = level if d >= d_start else -level
        z = end + (z_start - end) * math.exp(-abs(d - d_start) / (displacement * level))
        return force * z, z

    @staticmethod
    def slopes(v, d, d_start, z_start, force, static_ratio, velocity, displacement):  # type: ignore[no-untyped-def]
        """With its derivatives."""
        fading = math.exp(-((v / velocity) ** 2))
        level = 1.0 + (static_ratio - 1.0) * fading
        side = 1.0 if d >= d_start else -1.0
        steps = abs(d - d_start) / (displacement * level)
        decay = math.exp(-steps)
        left = (z_start - side * level) * decay
        z = side * level + left
        by_level = side * (1.0 - decay) + left * steps / level
        by_fading = by_level * (static_ratio - 1.0) * fading * 2.0 * v / (velocity * velocity)
        by_d = -left * side / (displacement * level)
        by_displacement = left * steps / displacement
        own = (by_level * fading, by_fading * v / velocity, by_displacement)
        f = (force * own[0], force * own[1], force * own[2])
        return (
            (force * z, -force * by_fading, force * by_d, -force * by_d, force * decay, z, f[0], f[1], f[2]),
            (z, -by_fading, by_d, -by_d, decay, 0.0, own[0], own[1], own[2]),
        )

    @staticmethod
    def rate(d, v, z, force, static_ratio, velocity, displacement):  # type: ignore[no-untyped-def]
        """Of the inner state."""
        level = 1.0 + (static_ratio - 1.0) * np.exp(-((v / velocity) ** 2))
        return (v - abs(v) * z / level) / displacement

    def starts(self, seen: Seen) -> Sequence[dict[str, float]]:
        """Presliding and fading in shares of the motion."""
        d, v = (float(np.sqrt(np.mean(s**2))) for s in (seen.d, seen.v))
        pairs = ((0.05, 0.3), (0.3, 0.3), (0.05, 0.1))
        return [{"static_ratio": 1.5, "velocity": q * v, "displacement": p * d} for p, q in pairs]


@register
class Play(PortLaw):
    """Spring behind a gap that is carried along: backlash with memory."""

    where = frozenset(["mechanical"])
    coefficients = (
        Coefficient("stiffness", "force/position", explanation="stiffness of what is dragged along"),
        positive("gap", "position", "play on either side", shapes=True),
    )
    formula = "f = t z, z follows d with play of +- gap"
    explanation = "A spring at {place} is dragged along behind a play: the force depends on the path taken."
    needs = frozenset(["position"])
    belongs_to = "stiffness"
    inner_states = 1
    contains = MappingProxyType({"stiffness": {"gap": 0.0}})
    on_request = True  # beside a spring it is slip behind a spring: hysteresis says that already

    @staticmethod
    def law(d, z_start, stiffness, gap):  # type: ignore[no-untyped-def]
        """Formula."""
        z = min(max(z_start, d - gap), d + gap)
        return stiffness * z, z

    @staticmethod
    def slopes(d, z_start, stiffness, gap):  # type: ignore[no-untyped-def]
        """With its derivatives."""
        if d - gap > z_start:
            z, by_d, by_start, by_gap = d - gap, 1.0, 0.0, -1.0
        elif d + gap < z_start:
            z, by_d, by_start, by_gap = d + gap, 1.0, 0.0, 1.0
        else:
            z, by_d, by_start, by_gap = z_start, 0.0, 1.0, 0.0
        f = (stiffness * z, stiffness * by_d, stiffness * by_start, z, stiffness * by_gap)
        return f, (z, by_d, by_start, 0.0, by_gap)

    def starts(self, seen: Seen) -> Sequence[dict[str, float]]:
        """Gaps in shares of the motion."""
        return [{"gap": float(q)} for q in np.quantile(np.abs(seen.d), [0.3, 0.6, 0.1])]
