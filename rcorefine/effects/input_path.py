"""Effects on an input before it acts."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np

from ..systems.linear import Array
from .absorbed import AbsorbedLaw, Assembly, Site
from .formula import FADED, InputLaw
from .law import Coefficient, positive, register
from .seen import Seen, delays


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
    coefficients = (positive("delay", "s", "dead time"),)
    formula = "w(t) -> w(t - delay)"
    explanation = "The input {place} acts later than the record says: a dead time."
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
class InputLag(AbsorbedLaw):
    """Slow actuator."""

    where = frozenset(["input"])
    coefficients = (positive("time_constant", "s", "time constant"),)
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
class InputSmoothing(InputLaw):
    """Command that a program smooths, one value after the other."""

    where = frozenset(["input"])
    coefficients = (positive("time_constant", "s", "time constant"),)
    formula = "r(k) = a r(k-1) + (1 - a) w(k), a = exp(-dt/T), w -> r"
    explanation = "The input {place} is smoothed sample by sample, or all sensors are, which looks the same."
    secant = True

    @staticmethod
    def law(w, z_start, step, time_constant):  # type: ignore[no-untyped-def]
        """Formula."""
        T = time_constant
        kept = math.exp(-step / T) if T > 1e-3 * step else 0.0
        r = w + kept * (z_start - w)
        return r, r

    @staticmethod
    def slopes(w, z_start, step, time_constant):  # type: ignore[no-untyped-def]
        """With its derivatives."""
        T = time_constant
        row = (w, 1.0, 0.0, 0.0, 0.0)
        if T > 1e-3 * step:
            kept = math.exp(-step / T)
            late = kept * (z_start - w)
            row = (w + late, 1.0 - kept, kept, -late / T, late * step / (T * T))
        return row, row

    def unseen(self, dt: float, *values: float) -> float:
        """Samples until what was before has faded."""
        return -float(np.log(FADED)) * values[0] / dt

    def starts(self, seen: Seen) -> Sequence[dict[str, float]]:
        """A few samples."""
        return [{"time_constant": q * seen.dt} for q in (1.5, 5.0, 20.0)]


@register
class InputDeadzone(InputLaw):
    """Actuator that ignores small values."""

    where = frozenset(["input"])
    coefficients = (positive("threshold", "signal", "input that is lost", shapes=True),)
    signal = "deadzone"
    secant = False
    formula = "w -> sgn(w) max(|w| - threshold, 0)"
    explanation = (
        "The input {place} has a dead zone: small values do nothing, and larger ones lose that much."
    )

    @staticmethod
    def law(w, threshold):  # type: ignore[no-untyped-def]
        """Formula."""
        return math.copysign(max(abs(w) - threshold, 0.0), w)

    @staticmethod
    def slopes(w, threshold):  # type: ignore[no-untyped-def]
        """With its derivatives."""
        if abs(w) <= threshold:
            return 0.0, 0.0, 0.0
        side = 1.0 if w > 0.0 else -1.0
        return w - side * threshold, 1.0, -side

    def starts(self, seen: Seen) -> Sequence[dict[str, float]]:
        """Return thresholds that the input often crosses, and a lower one.

        The lower one is for an input that has only two levels.
        """
        w = np.abs(seen.signal[seen.signal != 0])
        levels = np.quantile(w, [0.2, 0.2, 0.4, 0.6]) * [0.5, 1.0, 1.0, 1.0] if w.size else [0.1]
        return [{"threshold": float(q)} for q in levels]


@register
class InputSaturation(InputLaw):
    """Actuator with a limit."""

    where = frozenset(["input"])
    coefficients = (positive("limit", "signal", "largest size that acts", shapes=True),)
    signal = "saturation"
    formula = "w -> min(max(w, -limit), limit)"
    explanation = "The input {place} saturates: it cannot exceed a limit in either direction."
    secant = True

    @staticmethod
    def law(w, limit):  # type: ignore[no-untyped-def]
        """Formula."""
        return min(max(w, -limit), limit)

    @staticmethod
    def slopes(w, limit):  # type: ignore[no-untyped-def]
        """With its derivatives."""
        if abs(w) <= limit:
            return w, 1.0, 0.0
        side = 1.0 if w > 0.0 else -1.0
        return side * limit, 0.0, side

    def starts(self, seen: Seen) -> Sequence[dict[str, float]]:
        """Return limits that the input reaches, and a lower one.

        The lower one is for an input that has only two levels.
        """
        levels = np.quantile(np.abs(seen.signal), [0.97, 0.85, 0.6]) * [1.0, 1.0, 0.7]
        return [{"limit": float(q)} for q in levels]


@register
class InputPower(InputLaw):
    """Actuator that acts by a power of its command."""

    where = frozenset(["input"])
    coefficients = (
        positive("power", "1", "exponent of the command", lower=0.2, upper=5.0, shapes=True),
        positive("level", "signal", "command at which it acts as the model says", shapes=True),
    )
    formula = "w -> sgn(w) level |w/level|^p"
    explanation = "The input {place} acts by a power of its size: the thrust of a fan, the flow of a valve."
    one_signed = True

    @staticmethod
    def law(w, power, level):  # type: ignore[no-untyped-def]
        """Formula."""
        return math.copysign(level * (abs(w) / level) ** power, w)

    @staticmethod
    def slopes(w, power, level):  # type: ignore[no-untyped-def]
        """With its derivatives."""
        share = max(abs(w) / level, 1e-6)
        r = math.copysign(level * share**power, w)
        return r, power * share ** (power - 1.0), r * math.log(share), (1.0 - power) * r / level

    def starts(self, seen: Seen) -> Sequence[dict[str, float]]:
        """Squares and roots about the size of the command."""
        rms = float(np.sqrt(np.mean(seen.signal**2)))
        return [{"power": p, "level": rms} for p in (2.0, 0.6, 1.4)]


@register
class InputAsymmetry(InputLaw):
    """Actuator whose gain depends on the direction."""

    where = frozenset(["input"])
    coefficients = (Coefficient("difference", "1", explanation="half the difference of the two gains"),)
    formula = "w -> w + t |w|"
    explanation = "The input {place} acts stronger in one direction than in the other."

    @staticmethod
    def law(w, difference):  # type: ignore[no-untyped-def]
        """Formula."""
        return w + difference * abs(w)

    @staticmethod
    def slopes(w, difference):  # type: ignore[no-untyped-def]
        """With its derivatives."""
        side = 1.0 if w > 0.0 else -1.0
        return w + difference * abs(w), 1.0 + side * difference, abs(w)


@register
class InputPlay(InputLaw):
    """Backlash of an actuator: inside the gap nothing moves on."""

    where = frozenset(["input"])
    coefficients = (positive("gap", "signal", "play on either side", shapes=True),)
    formula = "r follows w with play of +- gap, w -> r"
    explanation = "The input {place} has play: it acts again only a gap after it has turned."
    on_request = True  # a force has no play, a position or an angle that is commanded has

    @staticmethod
    def law(w, z_start, gap):  # type: ignore[no-untyped-def]
        """Formula."""
        r = min(max(z_start, w - gap), w + gap)
        return r, r

    @staticmethod
    def slopes(w, z_start, gap):  # type: ignore[no-untyped-def]
        """With its derivatives."""
        row = (z_start, 0.0, 1.0, 0.0)
        if w - gap > z_start:
            row = (w - gap, 1.0, 0.0, -1.0)
        elif w + gap < z_start:
            row = (w + gap, 1.0, 0.0, 1.0)
        return row, row

    def starts(self, seen: Seen) -> Sequence[dict[str, float]]:
        """Gaps in shares of the command."""
        return [{"gap": float(q)} for q in np.quantile(np.abs(seen.signal), [0.1, 0.3, 0.6])]


@register
class InputRateLimit(InputLaw):
    """Actuator that cannot move faster than a rate.

    It moves towards the command at that rate until it has reached it. Before the record it stands at the
    command's first value (at zero where the initial state is given as zero). Between samples the command
    is what the record's hold says. A held one is chased over the sample, and what acts are straight lines
    over the substeps of the engine: exact but for how it turns within one. Else it runs in straight lines
    between their nodes, exact at them but for where it turns between two.
    """

    where = frozenset(["input"])
    coefficients = (positive("rate", "signal/s", "fastest change", shapes=True),)
    formula = "dr/dt = rate sgn(w - r) until r = w, w -> r"
    explanation = "The input {place} cannot change faster than a rate: the actuator lags behind large moves."
    on_request = True  # a servo or a valve has one; a force that is switched has none

    @staticmethod
    def law(w, z_start, step, held, rate):  # type: ignore[no-untyped-def]
        """Formula."""
        gap, reach = w - z_start, rate * step
        r = z_start + min(max(gap, -reach), reach)
        if held == 0.0:
            return r, r
        if abs(gap) < reach:
            return w - 0.5 * gap * abs(gap) / reach, r
        return 0.5 * (z_start + r), r

    @staticmethod
    def slopes(w, z_start, step, held, rate):  # type: ignore[no-untyped-def]
        """With its derivatives."""
        gap, reach = w - z_start, rate * step
        if abs(gap) < reach:
            row = (w, 1.0, 0.0, 0.0, 0.0, 0.0)
            if held == 0.0:
                return row, row
            late = abs(gap) / reach
            mean = w - 0.5 * gap * late
            return (mean, 1.0 - late, late, 0.5 * gap * late / step, 0.0, 0.5 * gap * late / rate), row
        side = 1.0 if gap > 0.0 else -1.0
        row = (z_start + side * reach, 0.0, 1.0, side * rate, 0.0, side * step)
        if held == 0.0:
            return row, row
        return (z_start + 0.5 * side * reach, 0.0, 1.0, 0.5 * side * rate, 0.0, 0.5 * side * step), row

    def starts(self, seen: Seen) -> Sequence[dict[str, float]]:
        """Return rates that the command exceeds now and then.

        They are taken over one sample and over stretches between steps.
        """
        found = []
        for samples in (64, 16, 4, 1):
            rates = np.abs(seen.signal[samples:] - seen.signal[:-samples]) / (samples * seen.dt)
            rates = rates[rates > 0]
            if rates.size:
                found.append({"rate": float(np.quantile(rates, 0.7))})
        return found or [{"rate": 1.0}]
