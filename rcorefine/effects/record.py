"""Faults of a record as a whole."""

from __future__ import annotations

from collections.abc import Sequence
from types import MappingProxyType
from typing import Any

from .absorbed import AbsorbedLaw, Assembly, Site
from .law import Coefficient, register
from .seen import Seen


@register
class Clock(AbsorbedLaw):
    """Slow clock: all rates of the model appear larger by one factor."""

    where = frozenset(["input"])
    coefficients = (
        Coefficient("slow", "1", lower=-0.05, upper=0.05, explanation="share of the time that it misses"),
    )
    formula = "dx/dt = (1 + t) (A x + B w)"
    explanation = "The clock behind {place} runs slow: more time passes than it says (less, if negative)."
    linear = True
    relative = True
    along_motion = False
    on_request = True
    of_record = True

    def absorb(self, into: Assembly, site: Site, *values: Any) -> None:
        """Speed up all states."""
        into.pace = into.pace + values[0]


@register
class ClocksApart(AbsorbedLaw):
    """Different clocks of inputs and outputs: their time shift grows.

    Inputs act increasingly earlier, or later, than the record states.

    The clocks agree where each record began: a part of it keeps the lag that it had, a record of its own, as
    for validation, begins without one. One that was cut elsewhere says so by `Measurement(elapsed=...)`.
    """

    where = frozenset(["input"])
    coefficients = (
        Coefficient("apart", "1", lower=-0.05, upper=0.05, explanation="share that the outputs' clock lags"),
        Coefficient("slow", "1", lower=-0.05, upper=0.05, explanation="share of the time that it misses"),
    )
    formula = "dx/dt = (1 + slow) (A x + B w((1 + apart) t))"
    explanation = "The outputs follow another clock than {place}: the lag between them grows, or falls."
    along_motion = False
    on_request = True
    of_record = True
    secant = True
    drifts = ("apart",)
    contains = MappingProxyType({"clock": {}})

    def absorb(self, into: Assembly, site: Site, *values: Any) -> None:
        """Speed up all states.

        The clock of the inputs does not change the matrices.
        """
        into.pace = into.pace + values[1]

    def starts(self, seen: Seen) -> Sequence[dict[str, float]]:
        """Either clock may be the right one."""
        return [{"apart": a, "slow": slow} for a in seen.drifts for slow in (a, 0.0)]
