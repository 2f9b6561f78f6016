"""What happens to an output before it is recorded."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from .absorbed import AbsorbedLaw, Assembly, Site
from .formula import OutputLaw
from .law import Coefficient, Seen, positive, register


@register
class OutputGain(AbsorbedLaw):
    """Sensor that reads larger."""

    where = frozenset(["output"])
    coefficients = (Coefficient("gain", "1", explanation="relative change of the gain"),)
    formula = "y -> (1 + t) y"
    explanation = "The sensor {place} reads larger than the model says (smaller, if negative)."
    linear = True
    relative = True
    signal = "value"

    def absorb(self, into: Assembly, site: Site, *values: Any) -> None:
        """Scale the output."""
        into.output_gain[site.channel] += values[0]


@register
class OutputOffset(AbsorbedLaw):
    """Sensor with an offset."""

    where = frozenset(["output"])
    coefficients = (Coefficient("offset", "signal", explanation="constant added to the output"),)
    formula = "y -> y + t"
    explanation = "The sensor {place} has an offset: a constant is added to what it measures."
    holds_constant = True
    signal = "constant"

    def absorb(self, into: Assembly, site: Site, *values: Any) -> None:
        """Add a constant to the output."""
        into.output_offset[site.channel] += values[0]


@register
class OutputDelay(OutputLaw):
    """Sensor that reports late."""

    where = frozenset(["output"])
    coefficients = (positive("delay", "s", "dead time"),)
    formula = "y(t) -> y(t - delay)"
    explanation = "The sensor {place} reports late: a dead time."
    linear = True
    delays = True
    signal = "rate"

    def starts(self, seen: Seen) -> Sequence[dict[str, float]]:
        """A few samples."""
        return [{"delay": q * seen.dt} for q in (0.5, 2.5, 6.0)]


@register
class OutputLag(AbsorbedLaw):
    """Slow sensor."""

    where = frozenset(["output"])
    coefficients = (positive("time_constant", "s", "time constant"),)
    formula = "T dr/dt + r = y, y -> r"
    explanation = "The sensor {place} is slow: it follows what it measures with a lag, like a filter."
    linear = True
    inner_states = 1
    states = ("lag",)
    secant = True
    signal = "rate"

    def absorb(self, into: Assembly, site: Site, *values: Any) -> None:
        """Put a state between the model and the output."""
        into.output_lags.append((site.channel, site.state, values[0]))

    def starts(self, seen: Seen) -> Sequence[dict[str, float]]:
        """A few samples."""
        return [{"time_constant": q * seen.dt} for q in (1.0, 5.0, 25.0)]


@register
class OutputSaturation(OutputLaw):
    """Sensor with a limit."""

    where = frozenset(["output"])
    coefficients = (positive("limit", "signal", "largest size it can show", shapes=True),)
    signal = "saturation"
    formula = "y -> min(max(y, -limit), limit)"
    explanation = "The sensor {place} is capped: beyond a limit it shows the limit."
    secant = True

    @staticmethod
    def law(y, limit):  # type: ignore[no-untyped-def]
        """Formula."""
        return min(max(y, -limit), limit)

    @staticmethod
    def slopes(y, limit):  # type: ignore[no-untyped-def]
        """With its derivatives."""
        if abs(y) <= limit:
            return y, 1.0, 0.0
        side = 1.0 if y > 0.0 else -1.0
        return side * limit, 0.0, side

    def starts(self, seen: Seen) -> Sequence[dict[str, float]]:
        """Limits at the top of the record, and below."""
        top = float(np.abs(seen.signal).max())
        return [{"limit": q * top} for q in (0.995, 0.9)]


@register
class OutputRectification(OutputLaw):
    """Sensor that loses the sign."""

    where = frozenset(["output"])
    coefficients = (positive("fraction", "1", "rectified share", upper=1.0),)
    signal = "rectification"
    formula = "y -> (1 - t) y + t |y|"
    explanation = "The sensor {place} loses the sign: it shows the size, in whole (1) or in part."

    @staticmethod
    def law(y, fraction):  # type: ignore[no-untyped-def]
        """Formula."""
        return (1.0 - fraction) * y + fraction * abs(y)

    @staticmethod
    def slopes(y, fraction):  # type: ignore[no-untyped-def]
        """With its derivatives."""
        if y >= 0.0:
            return y, 1.0, 0.0
        return (1.0 - 2.0 * fraction) * y, 1.0 - 2.0 * fraction, -2.0 * y

    def starts(self, seen: Seen) -> Sequence[dict[str, float]]:
        """In whole, or in part."""
        return [{"fraction": q} for q in (0.9, 0.2)]
