"""Delayed responses: a spring or a store behind a resistance."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from math import inf
from types import MappingProxyType
from typing import Any

import numpy as np
from scipy.signal import lfilter

from ..systems.linear import Array
from .absorbed import AbsorbedLaw, Assembly, Site
from .law import positive, register
from .seen import Seen

_SMALL = 0.03  # of the force that moves the port, to start from
_PACES = (1.0, 4.0, 0.25)  # time constants, over that of the motion


@register
class MaxwellElement(AbsorbedLaw):
    """Spring and damper in series."""

    where = frozenset(["mechanical"])
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
    linear = True
    contains = MappingProxyType({"stiffness": {"time_constant": inf}, "damping": {"time_constant": 0.0}})
    needs = frozenset(["velocity"])
    inner_states = 1
    essential = ("stiffness", "time_constant")
    belongs_to = "stiffness"
    states = ("stretch",)
    secant = True
    along_motion = False

    def absorb(self, into: Assembly, site: Site, *values: Any) -> None:
        """Add the stretch s of its spring."""
        stiffness, time_constant = values
        into.A[:, site.state] += stiffness * site.act
        into.A[site.state] += site.velocity
        into.A[site.state, site.state] -= 1.0 / time_constant
        into.Bu[site.state] += site.velocity_input

    def starts(self, seen: Seen) -> Sequence[dict[str, float]]:
        """One that relaxes as fast as the port moves, slower, and faster."""
        found = []
        for time in _times(seen):
            stretch = time * _lagged(seen.v, time, seen.dt)
            found.append({"stiffness": _SMALL * seen.pull / _size(stretch), "time_constant": time})
        return found


@register
class HiddenStore(AbsorbedLaw):
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
    linear = True
    contains = MappingProxyType({"mass": {"damping": inf}, "damping": {"mass": inf}})
    needs = frozenset(["velocity"])
    inner_states = 1
    essential = ("mass", "damping")
    belongs_to = "mass"
    states = ("level",)
    secant = True
    along_motion = False

    def absorb(self, into: Assembly, site: Site, *values: Any) -> None:
        """Add its level z.

        The level is absolute, because the surroundings of the port do not affect it.
        """
        mass, damping = values
        flow = np.zeros(into.constant.size, into.A.dtype)
        flow[site.state] -= damping
        flow += damping * site.velocity
        into.A += np.outer(site.act, flow)
        into.A[site.state] += flow / mass

    def starts(self, seen: Seen) -> Sequence[dict[str, float]]:
        """One that follows as fast as the state changes, slower, and faster."""
        found = []
        for time in _times(seen):
            damping = _SMALL * seen.pull / _size(seen.v - _lagged(seen.v, time, seen.dt))
            found.append({"mass": damping * time, "damping": damping})
        return found


def _times(seen: Seen) -> Iterator[float]:
    """Return time constants near that of the motion.

    None is much shorter than a sample.
    """
    pace = _size(seen.v - seen.v.mean()) / _size(np.gradient(seen.v, seen.dt))
    return (max(factor * pace, 0.3 * seen.dt) for factor in _PACES)


def _lagged(signal: Array, time: float, dt: float) -> Array:
    """A signal behind a lag that has settled to its first value."""
    kept = float(np.exp(-dt / time))
    return np.asarray(lfilter([1.0 - kept], [1.0, -kept], signal, zi=[kept * signal[0]])[0])


def _size(signal: Array) -> float:
    return float(np.sqrt(np.mean(signal**2))) or 1.0
