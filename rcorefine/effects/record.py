"""What is wrong with a record as a whole."""

from __future__ import annotations

from typing import Any

from .absorbed import AbsorbedLaw, Assembly, Site
from .law import Coefficient, register


@register
class Clock(AbsorbedLaw):
    """Clock that runs slow: every rate of the model looks larger by one factor."""

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
