"""Effects on an output before it is recorded."""

from __future__ import annotations

from collections.abc import Sequence
from types import MappingProxyType
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline

from ..systems.linear import Array
from .absorbed import AbsorbedLaw, Assembly, Site
from .formula import FADED, OutputLaw
from .law import Coefficient, positive, register
from .seen import Seen, delays

_SMALL = 1e-4  # of a phase, and of a window in samples: below it, series


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

    def unseen(self, dt: float, *values: float) -> float:
        """As many as fit into it."""
        return values[0] / dt

    def starts(self, seen: Seen) -> Sequence[dict[str, float]]:
        """A few samples, or as many as the outputs come late."""
        return delays(seen)


@register
class OutputAverage(OutputLaw):
    """Sensor that averages over time."""

    where = frozenset(["output"])
    coefficients = (positive("window", "s", "length of the moving average"),)
    formula = "y(t) -> mean of y from t - window to t"
    explanation = "The sensor {place} shows the mean over the last moments: a moving average."
    linear = True
    delays = True
    on_request = True
    signal = "rate"

    def response(self, omega: Array, value: float) -> tuple[NDArray[Any], NDArray[Any]]:
        """Return (1 - exp(-j omega T)) / (j omega T) and its derivative by T."""
        turn = -1j * np.asarray(omega) * value
        small = np.abs(turn) < _SMALL
        safe = np.where(small, 1.0, turn)
        mean = np.where(small, 1.0 + turn / 2.0, np.expm1(safe) / safe)
        slope = np.where(small, 0.5 + turn / 3.0, (np.exp(safe) - mean) / safe)
        return mean, -1j * omega * slope

    def later(self, course: CubicSpline, value: float) -> tuple[Array, Array]:
        """Return the mean over the window, from the integral of the spline."""
        t, area = course.x, course.antiderivative()
        first, then = np.minimum(t - value, 0.0), np.maximum(t - value, 0.0)
        over = (slice(None), *[None] * (course.c.ndim - 2))
        if value < _SMALL * (t[1] - t[0]):
            return course(t), -0.5 * course(t, 1)
        mean = (area(t) - area(then) - first[over] * course(0.0)) / value
        return mean, (course(then) - mean) / value

    def unseen(self, dt: float, *values: float) -> float:
        """As many as fit into it."""
        return values[0] / dt

    def starts(self, seen: Seen) -> Sequence[dict[str, float]]:
        """As late, on average, as a dead time."""
        return [{"window": 2.0 * start["delay"]} for start in delays(seen)]


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
class OutputRange(OutputLaw):
    """Sensor with two limits."""

    where = frozenset(["output"])
    coefficients = (
        Coefficient("low", "signal", explanation="least that it can show", default_start=None),
        Coefficient("high", "signal", explanation="most that it can show", default_start=None),
    )
    formula = "y -> min(max(y, low), high)"
    explanation = "The sensor {place} shows nothing below one limit and nothing above another one."
    secant = True
    contains = MappingProxyType({"output_saturation": {}})

    @staticmethod
    def law(y, low, high):  # type: ignore[no-untyped-def]
        """Formula."""
        return min(max(y, low), high)

    @staticmethod
    def slopes(y, low, high):  # type: ignore[no-untyped-def]
        """With its derivatives."""
        if max(y, low) > high:
            return high, 0.0, 0.0, 1.0
        if y < low:
            return low, 0.0, 1.0, 0.0
        return y, 1.0, 0.0, 0.0

    def starts(self, seen: Seen) -> Sequence[dict[str, float]]:
        """The ends of the record, and where noise upon it would have its limits."""
        tails = (0.0, 1.0), (0.05, 0.95), (0.05, 1.0), (0.0, 0.95)
        return [dict(zip(("low", "high"), np.quantile(seen.signal, q).tolist(), strict=True)) for q in tails]


@register
class OutputSmoothing(OutputLaw):
    """Sensor that smooths its readings by a program, one after the other."""

    where = frozenset(["output"])
    coefficients = (positive("kept", "1", "share of the reading before that is kept", upper=0.999),)
    formula = "r(k) = t r(k-1) + (1 - t) y(k), y -> r"
    explanation = "The sensor {place} smooths its readings: each keeps a share of the one before."
    secant = True

    @staticmethod
    def law(y, y_start, z_start, kept):  # type: ignore[no-untyped-def]
        """Formula; the inner state is what the reading is ahead of the signal."""
        r = y + kept * (y_start + z_start - y)
        return r, r - y

    @staticmethod
    def slopes(y, y_start, z_start, kept):  # type: ignore[no-untyped-def]
        """With its derivatives."""
        before = y_start + z_start - y
        r = y + kept * before
        return (r, 1.0 - kept, kept, kept, before), (r - y, -kept, kept, kept, before)

    def unseen(self, dt: float, *values: float) -> float:
        """Readings until the first has faded."""
        return float(np.log(FADED) / np.log(np.clip(values[0], 1e-3, 0.999)))

    def starts(self, seen: Seen) -> Sequence[dict[str, float]]:
        """Over a few samples."""
        return [{"kept": q} for q in (0.5, 0.8, 0.95)]


@register
class OutputCurvature(OutputLaw):
    """Sensor with a curved characteristic."""

    where = frozenset(["output"])
    coefficients = (Coefficient("curvature", "1/signal", explanation="added share per unit of the signal"),)
    formula = "y -> y + t y^2"
    explanation = "The sensor {place} is curved: it reads more on one side of zero and less on the other."

    @staticmethod
    def law(y, curvature):  # type: ignore[no-untyped-def]
        """Formula."""
        return y + curvature * y * y

    @staticmethod
    def slopes(y, curvature):  # type: ignore[no-untyped-def]
        """With its derivatives."""
        return y + curvature * y * y, 1.0 + 2.0 * curvature * y, y * y


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
