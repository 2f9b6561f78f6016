"""Stores, fields and bodies, and entries of the matrices."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from math import inf
from types import MappingProxyType
from typing import Any

import numpy as np
from scipy.signal import lfilter

from ..systems.linear import Array
from .formula import PortLaw
from .law import (
    ONE_SIDE,
    PORTS,
    AbsorbedLaw,
    Assembly,
    Coefficient,
    Seen,
    Site,
    positive,
    register,
    rms,
)

_SMALL = 0.03  # initial force over the force that moves the port
_PACES = (1.0, 4.0, 0.25)  # initial time constants over that of the motion


class _Coupled(AbsorbedLaw):
    """Element with states of its own that hangs on a port."""

    linear = True
    needs = frozenset(["velocity"])
    secant = True
    along_motion = False


@register
class MaxwellElement(_Coupled):
    """Spring and damper in series."""

    where = PORTS
    of_speeds = True
    coefficients = (
        positive("stiffness", "force/position", "its spring"),
        positive("time_constant", "s", "time in which its force fades, damper over spring", shapes=True),
    )
    formula = "f = k s, ds/dt = v - s / T"
    explanation = "The joint at {place} relaxes: a spring and a damper in series, like rubber or foam."
    words = (
        "{elastic} that relaxes",
        "An {elastic} that loses its {moved} with time is coupled in at {place}.",
    )
    contains = MappingProxyType({"stiffness": {"time_constant": inf}, "damping": {"time_constant": 0.0}})
    inner_states = 1
    essential = ("stiffness", "time_constant")
    belongs_to = "stiffness"
    states = ("stretch",)

    def absorb(self, into: Assembly, site: Site, *values: Any) -> None:
        """Add the stretch s of its spring."""
        stiffness, time_constant = values
        # the spring pulls at the port with k s
        into.A[:, site.state] += stiffness * site.act
        # ds/dt = v - s / T
        into.A[site.state] += site.velocity
        into.A[site.state, site.state] -= 1.0 / time_constant
        into.Bu[site.state] += site.velocity_input

    def starts(self, seen: Seen) -> Sequence[dict[str, float]]:
        """One that relaxes as fast as the port moves, slower, and faster."""
        found = []
        for time in _times(seen):
            # spring force of 3 % of the force that moves the port
            stretch = time * _lag(seen.v, time, seen.dt)
            found.append({"stiffness": _SMALL * seen.pull / (rms(stretch) or 1.0), "time_constant": time})
        return found


@register
class HiddenStore(_Coupled):
    """Store that is filled and emptied through a resistance."""

    where = frozenset(["first_order"])
    coefficients = (
        positive("mass", "force s/velocity", "what it stores per unit of the state"),
        positive("damping", "force/velocity", "what flows into it per difference"),
    )
    formula = "f = c (v - z), m dz/dt = f"
    explanation = "A store that the model lacks hangs on {place}: it fills and empties through a resistance."
    words = (
        "hidden {store}",
        "A {store} that the model lacks is coupled to {place}: it takes up and gives back with a delay.",
    )
    contains = MappingProxyType({"mass": {"damping": inf}, "damping": {"mass": inf}})
    inner_states = 1
    essential = ("mass", "damping")
    belongs_to = "mass"
    states = ("level",)

    def absorb(self, into: Assembly, site: Site, *values: Any) -> None:
        """Add its level z.

        The level is absolute, because the surroundings of the port do not affect it.
        """
        mass, damping = values
        # flow into the store: c (v - z)
        flow = np.zeros(into.constant.size, into.A.dtype)
        flow[site.state] -= damping
        flow += damping * site.velocity
        into.A += np.outer(site.act, flow)
        # m dz/dt = flow
        into.A[site.state] += flow / mass

    def starts(self, seen: Seen) -> Sequence[dict[str, float]]:
        """One that follows as fast as the state changes, slower, and faster."""
        found = []
        for time in _times(seen):
            # flow of 3 % of what moves the state
            damping = _SMALL * seen.pull / (rms(seen.v - _lag(seen.v, time, seen.dt)) or 1.0)
            found.append({"mass": damping * time, "damping": damping})
        return found


def _times(seen: Seen) -> Iterator[float]:
    """Return time constants near that of the motion.

    None is much shorter than a sample.
    """
    # time scale of the motion: rms v over rms dv/dt
    pace = (rms(seen.v - seen.v.mean()) or 1.0) / (rms(np.gradient(seen.v, seen.dt)) or 1.0)
    return (max(factor * pace, 0.3 * seen.dt) for factor in _PACES)


def _lag(signal: Array, time: float, dt: float) -> Array:
    """A signal behind a lag that has settled to its first value."""
    # exact recursion of a first-order lag for a held signal
    kept = float(np.exp(-dt / time))
    return np.asarray(lfilter([1.0 - kept], [1.0, -kept], signal, zi=[kept * signal[0]])[0])


@register
class Gravity(PortLaw):
    """Weight on a lever."""

    coefficients = (Coefficient("torque", "force", explanation="m g l: torque of the weight, held level"),)
    constants = MappingProxyType({"tangent": 1.0})
    from_zero = frozenset(["tangent"])  # a model linearized about the lowest point contains the slope
    formula = "f = t (sin(d) - (1 - tangent) d), d the angle from where it hangs in rad"
    explanation = "The weight at {place} pulls back by the sine of the angle, as at a pendulum (m g l sin)."
    belongs_to = "stiffness"
    domains = frozenset(["rotational"])

    @staticmethod
    def law(d, torque, tangent):  # type: ignore[no-untyped-def]
        """Formula."""
        # tangent = 1: the whole sine; 0: the sine without its slope at d = 0
        return torque * (math.sin(d) - (1.0 - tangent) * d)


@register
class Cogging(PortLaw):
    """Force that repeats with the position."""

    coefficients = (
        Coefficient("sine", "force", explanation="part that is zero at rest"),
        Coefficient("cosine", "force", explanation="part that is largest at rest"),
        positive("period", "position", "distance from one cog to the next", shapes=True),
    )
    formula = "f = a sin(2 pi d/P) + b (cos(2 pi d/P) - 1)"
    explanation = "The force at {place} repeats with the position: cogging of a motor, ripple of gears."
    belongs_to = "stiffness"
    on_request = True  # the cost has many local minima over the period: it must be known

    @staticmethod
    def law(d, sine, cosine, period):  # type: ignore[no-untyped-def]
        """Formula."""
        # zero at d = 0, so that the coefficients do not change the rest position
        angle = 2.0 * math.pi * d / period
        return sine * math.sin(angle) + cosine * (math.cos(angle) - 1.0)

    def starts(self, seen: Seen) -> Sequence[dict[str, float]]:
        """Shares of the way that the record shows."""
        # whole numbers of cogs within the range of the motion
        way = float(np.ptp(seen.d))
        return [{"period": way / q} for q in (2.0, 4.0, 8.0, 16.0, 32.0, 1.0)]


@register
class MagneticForce(PortLaw):
    """Pull of an electromagnet."""

    coefficients = (
        Coefficient(
            "strength", "force position^2/signal^2", explanation="k: pull at unit current and distance"
        ),
    )
    constants = MappingProxyType({"gap": 1.0, "current": 1.0, **ONE_SIDE})
    formula = "f = -k side i^2/(gap - side d)^2, i the input numbered `current` from 1"
    explanation = "A magnet pulls at {place}, by the square of its current over the square of its distance."
    belongs_to = "stiffness"
    on_request = True  # the input that is the current, and the distance of the magnet, must be known

    @staticmethod
    def law(d, w, strength, gap, current, side):  # type: ignore[no-untyped-def]
        """Formula: a pull towards positive d is a negative resistance."""
        return -strength * side * (w[int(current) - 1] / (gap - side * d)) ** 2


@register
class Mass(AbsorbedLaw):
    """Change of a moving mass, or of a store."""

    where = PORTS
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
    of_known_stores = True  # only where a builder knows the store; else it rescales a row of A

    def absorb(self, into: Assembly, site: Site, *values: Any) -> None:
        """Add t to the inertia along the port."""
        (t,) = values
        # act = -1/m, so the inertia 1 becomes 1 + t/m; inputs that accelerate the port move the mass too
        into.inertia -= t * np.outer(site.act, site.velocity)
        into.Bu += t * np.outer(site.act, site.acceleration_input)

    def bounds_in(self, structure: Any, place: str) -> tuple[float, float]:
        """Something is left that moves."""
        # the mass at the port stays positive
        return -structure.inertia(place) * (1 - 1e-9), inf


@register
class HiddenMode(_Coupled):
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
    inner_states = 2
    essential = ("mass", "stiffness")
    senses = frozenset({"position", "velocity", "acceleration"})
    belongs_to = "mass"
    states = ("stretch", "velocity")

    def absorb(self, into: Assembly, site: Site, *values: Any) -> None:
        """Add its stretch u and speed s: f = k u + c (v - s)."""
        mass, c, k = values
        stretch, speed = site.state, site.state + 1
        # pull at the port: k u + c (v - s)
        pull = np.zeros(into.constant.size, into.A.dtype)
        pull[stretch] += k
        pull[speed] -= c
        pull += c * site.velocity
        into.A += np.outer(site.act, pull)
        into.Bu += c * np.outer(site.act, site.velocity_input)
        # du/dt = v - s
        into.A[stretch] += site.velocity
        into.A[stretch, speed] -= 1.0
        into.Bu[stretch] += site.velocity_input
        # m ds/dt = pull
        into.A[speed] += pull / mass
        into.Bu[speed] += c / mass * site.velocity_input

    def starts(self, seen: Seen) -> Sequence[dict[str, float]]:
        """A mode at each of the highest peaks of the residual."""
        # peaks of the residual, else a tenth of the Nyquist frequency
        turns = list(seen.peaks) or [0.1 * np.pi / seen.dt]
        # 3 % of the moving mass, with a damping ratio of 3 %
        mass = 0.03 / (seen.mobility or 1.0)
        return [{"mass": mass, "damping": 0.06 * mass * o, "stiffness": mass * o**2} for o in turns]


@register
class ConstantForce(AbsorbedLaw):
    """Weight, preload, leak."""

    where = PORTS
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


@register
class Entry(AbsorbedLaw):
    """Change of an entry."""

    name = "coefficient"
    where = frozenset(["any"])
    coefficients = (Coefficient("value", "entry", explanation="change of the entry"),)
    formula = "dx_i/dt = ... + t x_j, with a signal w_j or an output y_i where the entry is of B, C or D"
    explanation = "The entry {place} of the model's matrices differs from what they say."
    linear = True
    is_parameter = True
    may_wear = True
    signal = "value"

    def absorb(self, into: Assembly, site: Site, *values: Any) -> None:
        """Add t to the entry."""
        row, column = site.entry
        states = into.A.shape[0]
        # entry of A or B
        if row < states:
            into.rates[row, column] += values[0]
            return
        # entry of C or D: one more signal that the output reads
        read = np.zeros((into.output_gain.size, into.rates.shape[1] + 1 + states), into.A.dtype)
        read[row - states, column] = values[0]
        into.felt.append(read)

    def sits(self, model: Any, place: str) -> bool:
        """At an entry of a matrix."""
        return bool(model.entry(place))

    def bounds_in(self, structure: Any, place: str) -> tuple[float, float]:
        """A decay does not turn into growth."""
        row, column = structure.model.entry(place)
        base = structure.linear_model
        # a negative entry on the diagonal (decay) stays negative
        rate = float(base.A[row, row]) if row == column < base.n_states else 0.0
        return -inf, -rate if rate < 0 else inf
