"""What happens to an input before it acts."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from ..systems.linear import Array
from .law import AbsorbedLaw, Assembly, Coefficient, InputLaw, Seen, Site, register


@register
class InputGain(AbsorbedLaw):
    """Actuator that acts more strongly."""

    where = frozenset(["input"])
    coefficients = (Coefficient("gain", "1", explanation="relative change of the gain"),)
    formula = "w -> (1 + t) w"
    explanation = "The input {place} acts more strongly than the model says (less, if negative)."
    linear = True
    relative = True
    signal = "value"

    def absorb(self, into: Assembly, site: Site, *values: Any) -> None:
        """Scale the input."""
        into.Uw[site.channel, site.channel] += values[0]


@register
class InputOffset(AbsorbedLaw):
    """Actuator with an offset."""

    where = frozenset(["input"])
    coefficients = (Coefficient("offset", "signal", explanation="constant added to the input"),)
    formula = "w -> w + t"
    explanation = "The input {place} has an offset: a constant is added before it acts."
    holds_constant = True
    signal = "constant"

    def absorb(self, into: Assembly, site: Site, *values: Any) -> None:
        """Add a constant to the input."""
        into.Uw[site.channel, -1] += values[0]

    def push(self, linear: Any, place: str, act: Array | None) -> Array | None:
        """Along the column of the input."""
        return np.asarray(linear.B)[:, linear.input_labels.index(place)]


@register
class InputDelay(InputLaw):
    """Actuator with a dead time."""

    where = frozenset(["input"])
    coefficients = (Coefficient("delay", "s", lower=0.0, default_start=None, explanation="dead time"),)
    number = 2
    formula = "w(t) -> w(t - delay)"
    explanation = "The input {place} acts later than the record says: a dead time."
    linear = True
    delays = True
    signal = "rate"

    def starts(self, seen: Seen) -> Sequence[dict[str, float]]:
        """A few samples."""
        return [{"delay": q * seen.dt} for q in (0.5, 2.5, 6.0)]


@register
class InputLag(AbsorbedLaw):
    """Slow actuator."""

    where = frozenset(["input"])
    coefficients = (
        Coefficient("time_constant", "s", lower=0.0, default_start=None, explanation="time constant"),
    )
    formula = "T dr/dt + r = w, w -> r"
    explanation = "The input {place} does not act at once but catches up with a lag, like a slow actuator."
    linear = True
    inner_states = 1
    states = ("lag",)
    secant = True
    signal = "rate"

    def absorb(self, into: Assembly, site: Site, *values: Any) -> None:
        """Put a state between the input and the model."""
        into.input_lags.append((site.channel, site.state, values[0]))

    def starts(self, seen: Seen) -> Sequence[dict[str, float]]:
        """A few samples."""
        return [{"time_constant": q * seen.dt} for q in (1.0, 5.0, 25.0)]


@register
class InputDeadzone(InputLaw):
    """Actuator that ignores small values."""

    where = frozenset(["input"])
    coefficients = (
        Coefficient(
            "threshold",
            "signal",
            lower=0.0,
            default_start=None,
            shapes=True,
            explanation="input that is lost",
        ),
    )
    signal = "deadzone"
    number = 0
    formula = "w -> sgn(w) max(|w| - threshold, 0)"
    explanation = (
        "The input {place} has a dead zone: small values do nothing, and larger ones lose that much."
    )

    def through(self, w: Array, *values: float) -> tuple[Any, Any, Any]:
        """Value, slope, derivative by the threshold."""
        (level,) = values
        side = np.sign(w)
        passed = 1.0 * (np.abs(w) > level)
        left = side * np.maximum(np.abs(w) - level, 0.0)
        return left, passed, -side * passed

    def starts(self, seen: Seen) -> Sequence[dict[str, float]]:
        """Levels that the input often crosses."""
        w = np.abs(seen.signal[seen.signal != 0])
        levels = np.quantile(w, [0.05, 0.2, 0.4, 0.6]) if w.size else [0.1]
        return [{"threshold": float(q)} for q in levels]


@register
class InputSaturation(InputLaw):
    """Actuator with a limit."""

    where = frozenset(["input"])
    coefficients = (
        Coefficient(
            "limit",
            "signal",
            lower=0.0,
            default_start=None,
            shapes=True,
            explanation="largest size that acts",
        ),
    )
    signal = "saturation"
    number = 1
    formula = "w -> min(max(w, -limit), limit)"
    explanation = "The input {place} saturates: it cannot exceed a limit in either direction."
    secant = True

    def through(self, w: Array, *values: float) -> tuple[Any, Any, Any]:
        """Value, slope, derivative by the limit."""
        (level,) = values
        beyond = 1.0 * (np.abs(w) > level)
        clipped = np.clip(w, -level, level)
        side = np.sign(w)
        return clipped, 1.0 - beyond, side * beyond

    def starts(self, seen: Seen) -> Sequence[dict[str, float]]:
        """Limits that the input reaches."""
        return [{"limit": float(q)} for q in np.quantile(np.abs(seen.signal), [0.97, 0.85, 0.6])]
