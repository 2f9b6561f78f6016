"""Effects on inputs, on outputs and on the clocks of a record."""

from __future__ import annotations

import math
from collections.abc import Sequence
from types import MappingProxyType
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline

from ..systems.linear import Array
from .formula import FADED, FormulaLaw, InputLaw, OutputLaw
from .law import (
    ONE_SIDE,
    AbsorbedLaw,
    Assembly,
    Coefficient,
    Seen,
    Site,
    at_quantiles,
    delays,
    positive,
    register,
    rms,
)  # fmt: skip


# common parts of the laws at inputs and outputs
class _ChannelGain(AbsorbedLaw):
    """Gain of a channel."""

    coefficients = (Coefficient("gain", "1", explanation="relative change of the gain"),)
    linear = True
    relative = True
    signal = "value"

    def absorb(self, into: Assembly, site: Site, *values: Any) -> None:
        """Scale the channel."""
        if "input" in self.where:
            # u = Uw [w; 1]
            into.Uw[site.channel, site.channel] += values[0]
        else:
            into.output_gain[site.channel] += values[0]


class _Offset(AbsorbedLaw):
    """Offset of a channel."""

    coefficients = (Coefficient("offset", "signal", explanation="constant added to the signal"),)
    holds_constant = True
    signal = "constant"

    def absorb(self, into: Assembly, site: Site, *values: Any) -> None:
        """Add a constant to the channel."""
        if "input" in self.where:
            into.Uw[site.channel, -1] += values[0]
        else:
            into.output_offset[site.channel] += values[0]


class _Delay(FormulaLaw):
    """Dead time of a channel."""

    coefficients = (positive("delay", "s", "dead time"),)
    linear = True
    delays = True
    signal = "rate"

    def unseen(self, dt: float, *values: float) -> float:
        """As many as fit into it."""
        return values[0] / dt

    def starts(self, seen: Seen) -> Sequence[dict[str, float]]:
        """A few samples, or as many as the outputs come late."""
        return delays(seen)


class _Lag(AbsorbedLaw):
    """Channel that follows what it carries."""

    coefficients = (positive("time_constant", "s", "time constant"),)
    linear = True
    inner_states = 1
    states = ("lag",)
    secant = True
    signal = "rate"

    def absorb(self, into: Assembly, site: Site, *values: Any) -> None:
        """Put a state between the channel and the model."""
        # the engine connects the added state, dr/dt = (w - r) / T
        lags = into.input_lags if "input" in self.where else into.output_lags
        lags.append((site.channel, site.state, values[0]))

    def starts(self, seen: Seen) -> Sequence[dict[str, float]]:
        """A few samples."""
        return [{"time_constant": q * seen.dt} for q in (1.0, 5.0, 25.0)]


class _Saturation(FormulaLaw):
    """Channel with a limit."""

    coefficients = (positive("limit", "signal", "largest size that passes", shapes=True),)
    signal = "saturation"
    secant = True

    @staticmethod
    def law(s, limit):  # type: ignore[no-untyped-def]
        """Formula."""
        return min(max(s, -limit), limit)


class _Range(FormulaLaw):
    """Channel with two limits."""

    coefficients = (
        Coefficient("low", "signal", explanation="least that passes", default_start=None),
        Coefficient("high", "signal", explanation="most that passes", default_start=None),
    )
    secant = True

    @staticmethod
    def law(s, low, high):  # type: ignore[no-untyped-def]
        """Formula."""
        return min(max(s, low), high)


class _ChannelPlay(FormulaLaw):
    """Channel that moves on only a gap after its signal has turned."""

    coefficients = (positive("gap", "signal", "play on either side", shapes=True),)
    secant = True

    @staticmethod
    def law(s, z_start, gap):  # type: ignore[no-untyped-def]
        """Formula."""
        # the result stays within the gap of the signal
        r = min(max(z_start, s - gap), s + gap)
        return r, r


# laws at inputs
@register
class InputGain(_ChannelGain):
    """Actuator that acts more strongly."""

    where = frozenset(["input"])
    formula = "w -> (1 + t) w"
    explanation = "The input {place} acts more strongly than the model says (less, if negative)."


@register
class InputOffset(_Offset):
    """Actuator with an offset."""

    where = frozenset(["input"])
    formula = "w -> w + t"
    explanation = "The input {place} has an offset: a constant is added before it acts."

    def push(self, linear: Any, place: str, act: Array | None) -> Array | None:
        """Along the column of the input."""
        return np.asarray(linear.B)[:, linear.input_labels.index(place)]


@register
class InputDelay(_Delay, InputLaw):
    """Actuator with a dead time."""

    formula = "w(t) -> w(t - delay)"
    explanation = "The input {place} acts later than the record says: a dead time."


@register
class InputLag(_Lag):
    """Slow actuator."""

    where = frozenset(["input"])
    formula = "T dr/dt + r = w, w -> r"
    explanation = "The input {place} does not act at once but catches up with a lag, like a slow actuator."


@register
class InputSmoothing(InputLaw):
    """Command that a program smooths, one value after the other."""

    coefficients = (positive("time_constant", "s", "time constant"),)
    formula = "r(k) = a r(k-1) + (1 - a) w(k), a = exp(-dt/T), w -> r"
    explanation = "The input {place} is smoothed sample by sample, or all sensors are, which looks the same."
    secant = True

    @staticmethod
    def law(w, z_start, step, time_constant):  # type: ignore[no-untyped-def]
        """Formula."""
        # pole of the recursion; a time constant far below the step does not smooth
        T = time_constant
        kept = math.exp(-step / T) if T > 1e-3 * step else 0.0
        r = w + kept * (z_start - w)
        return r, r

    def unseen(self, dt: float, *values: float) -> float:
        """Samples until what was before has faded."""
        # exp(-t / T) is the share FADED
        return -float(np.log(FADED)) * values[0] / dt

    def starts(self, seen: Seen) -> Sequence[dict[str, float]]:
        """A few samples."""
        return [{"time_constant": q * seen.dt} for q in (1.5, 5.0, 20.0)]


@register
class InputDeadzone(InputLaw):
    """Actuator that ignores small values."""

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
        return math.copysign(max(0.0, abs(w) - threshold), w)

    def starts(self, seen: Seen) -> Sequence[dict[str, float]]:
        """Return thresholds that the input often crosses, and a lower one.

        The lower one is for an input that has only two levels.
        """
        # thresholds at quantiles of the amplitude
        w = np.abs(seen.signal[seen.signal != 0])
        levels = np.quantile(w, [0.2, 0.2, 0.4, 0.6]) * [0.5, 1.0, 1.0, 1.0] if w.size else [0.1]
        return [{"threshold": float(q)} for q in levels]


@register
class InputSaturation(_Saturation, InputLaw):
    """Actuator with a limit."""

    formula = "w -> min(max(w, -limit), limit)"
    explanation = "The input {place} saturates: it cannot exceed a limit in either direction."

    def starts(self, seen: Seen) -> Sequence[dict[str, float]]:
        """Return limits that the input reaches, and a lower one.

        The lower one is for an input that has only two levels.
        """
        # limits at quantiles of the amplitude
        levels = np.quantile(np.abs(seen.signal), [0.97, 0.85, 0.6]) * [1.0, 1.0, 0.7]
        return [{"limit": float(q)} for q in levels]


@register
class InputRange(_Range, InputLaw):
    """Actuator with two limits."""

    signal = "saturation"
    formula = "w -> min(max(w, low), high)"
    explanation = "The input {place} has two limits: nothing below one and nothing above the other acts."
    on_request = True  # most records do not distinguish it from saturation with an offset
    contains = MappingProxyType({"input_saturation": {}})

    def starts(self, seen: Seen) -> Sequence[dict[str, float]]:
        """Levels that the input passes in both directions, or in one."""
        # quantiles of the signal for both limits
        tails = (0.05, 0.95), (0.2, 0.8), (0.0, 0.85), (0.15, 1.0)
        return [{"low": low, "high": high} for low, high in np.quantile(seen.signal, tails).tolist()]


@register
class InputPower(InputLaw):
    """Actuator that acts by a power of its command."""

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

    def starts(self, seen: Seen) -> Sequence[dict[str, float]]:
        """Squares and roots about the size of the command."""
        # level: the rms of the command, where a power changes least
        return [{"power": p, "level": rms(seen.signal)} for p in (2.0, 0.6, 1.4)]


@register
class InputAsymmetry(InputLaw):
    """Actuator whose gain depends on the direction."""

    coefficients = (Coefficient("difference", "1", explanation="half the difference of the two gains"),)
    formula = "w -> w + t |w|"
    explanation = "The input {place} acts stronger in one direction than in the other."

    @staticmethod
    def law(w, difference):  # type: ignore[no-untyped-def]
        """Formula."""
        return w + difference * abs(w)


@register
class InputPlay(_ChannelPlay, InputLaw):
    """Backlash of an actuator: inside the gap nothing moves on."""

    formula = "r follows w with play of +- gap, w -> r"
    explanation = "The input {place} has play: it acts again only a gap after it has turned."
    on_request = True  # a force has no play, a position or an angle that is commanded has

    def starts(self, seen: Seen) -> Sequence[dict[str, float]]:
        """Gaps in shares of the command."""
        return at_quantiles("gap", np.abs(seen.signal), [0.1, 0.3, 0.6])


@register
class InputRateLimit(InputLaw):
    """Actuator that cannot move faster than a rate.

    It moves towards the command at that rate until it has reached it. Before the record it stands at the
    command's first value (at zero where the initial state is given as zero). Between samples the command
    is what the record's hold says. A held one is chased over the sample, and what acts are straight lines
    over the substeps of the engine: exact but for how it turns within one. Else it runs in straight lines
    between their nodes, exact at them but for where it turns between two.
    """

    coefficients = (positive("rate", "signal/s", "fastest change", shapes=True),)
    formula = "dr/dt = rate sgn(w - r) until r = w, w -> r"
    explanation = "The input {place} cannot change faster than a rate: the actuator lags behind large moves."
    on_request = True  # a servo or a valve has one; a force that is switched has none

    @staticmethod
    def law(w, z_start, step, held, rate):  # type: ignore[no-untyped-def]
        """Formula."""
        # largest move within the step
        gap, reach = w - z_start, rate * step
        r = z_start + min(reach, max(-reach, gap))
        # straight command: value at the end of the step
        if held == 0.0:
            return r, r
        # held command, reached within the step: mean over the step
        if abs(gap) < reach:
            return w - 0.5 * gap * abs(gap) / reach, r
        # held command, not reached: mean of start and end
        return 0.5 * (z_start + r), r

    def starts(self, seen: Seen) -> Sequence[dict[str, float]]:
        """Return rates that the command exceeds now and then.

        They are taken over one sample and over stretches between steps.
        """
        found = []
        # rates over 64 to 1 samples, of steps and of slopes
        for samples in (64, 16, 4, 1):
            rates = np.abs(seen.signal[samples:] - seen.signal[:-samples]) / (samples * seen.dt)
            rates = rates[rates > 0]
            if rates.size:
                found.append({"rate": float(np.quantile(rates, 0.7))})
        return found or [{"rate": 1.0}]


_SMALL = 1e-4  # phase in radians, and window in samples, below which power series are used


# laws at outputs
@register
class OutputGain(_ChannelGain):
    """Sensor that reads larger."""

    where = frozenset(["output"])
    formula = "y -> (1 + t) y"
    explanation = "The sensor {place} reads larger than the model says (smaller, if negative)."


@register
class OutputOffset(_Offset):
    """Sensor with an offset."""

    where = frozenset(["output"])
    formula = "y -> y + t"
    explanation = "The sensor {place} has an offset: a constant is added to what it measures."


@register
class OutputDelay(_Delay, OutputLaw):
    """Sensor that reports late."""

    formula = "y(t) -> y(t - delay)"
    explanation = "The sensor {place} reports late: a dead time."


@register
class OutputAverage(_Delay, OutputLaw):
    """Sensor that averages over time."""

    coefficients = (positive("window", "s", "length of the moving average"),)
    formula = "y(t) -> mean of y from t - window to t"
    explanation = "The sensor {place} shows the mean over the last moments: a moving average."
    on_request = True
    of_differences = "window"

    def response(self, omega: Array, value: float) -> tuple[NDArray[Any], NDArray[Any]]:
        """Return (1 - exp(-j omega T)) / (j omega T) and its derivative by T."""
        # transfer function of the moving average; power series where omega T is small
        turn = -1j * np.asarray(omega) * value
        small = np.abs(turn) < _SMALL
        safe = np.where(small, 1.0, turn)
        mean = np.where(small, 1.0 + turn / 2.0, np.expm1(safe) / safe)
        slope = np.where(small, 0.5 + turn / 3.0, (np.exp(safe) - mean) / safe)
        return mean, -1j * omega * slope

    def later(self, course: CubicSpline, value: float) -> tuple[Array, Array]:
        """Return the mean over the window, from the integral of the spline."""
        t, area = course.x, course.antiderivative()
        # before the record the output stood at its first value
        first, then = np.minimum(t - value, 0.0), np.maximum(t - value, 0.0)
        over = (slice(None), *[None] * (course.c.ndim - 2))
        if value < _SMALL * (t[1] - t[0]):
            return course(t), -0.5 * course(t, 1)
        # mean = (integral to t - integral to t - T) / T, and its derivative by T
        mean = (area(t) - area(then) - first[over] * course(0.0)) / value
        return mean, (course(then) - mean) / value

    def starts(self, seen: Seen) -> Sequence[dict[str, float]]:
        """As late, on average, as a dead time."""
        # a moving average of length T delays by T / 2
        return [{"window": 2.0 * start["delay"]} for start in delays(seen)]


@register
class OutputLag(_Lag):
    """Slow sensor."""

    where = frozenset(["output"])
    formula = "T dr/dt + r = y, y -> r"
    explanation = "The sensor {place} is slow: it follows what it measures with a lag, like a filter."


@register
class OutputSaturation(_Saturation, OutputLaw):
    """Sensor with a limit."""

    formula = "y -> min(max(y, -limit), limit)"
    explanation = "The sensor {place} is capped: beyond a limit it shows the limit."

    def starts(self, seen: Seen) -> Sequence[dict[str, float]]:
        """Limits at the top of the record, and below."""
        # limits just below the largest value
        top = float(np.abs(seen.signal).max())
        return [{"limit": q * top} for q in (0.995, 0.9)]


@register
class OutputRange(_Range, OutputLaw):
    """Sensor with two limits."""

    formula = "y -> min(max(y, low), high)"
    explanation = "The sensor {place} shows nothing below one limit and nothing above another one."
    contains = MappingProxyType({"output_saturation": {}})

    def starts(self, seen: Seen) -> Sequence[dict[str, float]]:
        """The ends of the record, and where noise upon it would have its limits."""
        # quantiles of the signal: the extremes, or inside of the noise on them
        tails = (0.0, 1.0), (0.05, 0.95), (0.05, 1.0), (0.0, 0.95)
        return [{"low": low, "high": high} for low, high in np.quantile(seen.signal, tails).tolist()]


@register
class OutputSmoothing(OutputLaw):
    """Sensor that smooths its readings by a program, one after the other."""

    coefficients = (positive("kept", "1", "share of the reading before that is kept", upper=0.999),)
    formula = "r(k) = t r(k-1) + (1 - t) y(k), y -> r"
    explanation = "The sensor {place} smooths its readings: each keeps a share of the one before."
    secant = True

    @staticmethod
    def law(y, y_start, z_start, kept):  # type: ignore[no-untyped-def]
        """Formula; the inner state is what the reading is ahead of the signal."""
        # r(k) = t r(k-1) + (1 - t) y(k), with r(k-1) = y(k-1) + z(k-1)
        r = y + kept * (y_start + z_start - y)
        return r, r - y

    def unseen(self, dt: float, *values: float) -> float:
        """Readings until the first has faded."""
        # kept^k is the share FADED
        return float(np.log(FADED) / np.log(np.clip(values[0], 1e-3, 0.999)))

    def starts(self, seen: Seen) -> Sequence[dict[str, float]]:
        """Over a few samples."""
        return [{"kept": q} for q in (0.5, 0.8, 0.95)]


@register
class OutputPlay(_ChannelPlay, OutputLaw):
    """Backlash before a sensor: inside the gap its reading does not move on."""

    formula = "r follows y with play of +- gap, y -> r"
    explanation = "The sensor {place} has play: it follows only a gap after the motion has turned."
    of_displacements = True

    def starts(self, seen: Seen) -> Sequence[dict[str, float]]:
        """Gaps in shares of the motion."""
        return [{"gap": q * float(np.ptp(seen.signal))} for q in (0.01, 0.05, 0.15)]


@register
class OutputCurvature(OutputLaw):
    """Sensor with a curved characteristic."""

    coefficients = (Coefficient("curvature", "1/signal", explanation="added share per unit of the signal"),)
    formula = "y -> y + t y^2"
    explanation = "The sensor {place} is curved: it reads more on one side of zero and less on the other."

    @staticmethod
    def law(y, curvature):  # type: ignore[no-untyped-def]
        """Formula."""
        return y + curvature * y * y


@register
class OutputRectification(OutputLaw):
    """Sensor that loses the sign."""

    coefficients = (positive("fraction", "1", "rectified share", upper=1.0),)
    constants = ONE_SIDE
    formula = "y -> (1 - t) y + t side |y|"
    explanation = "The sensor {place} loses the sign: it shows the size, in whole (1) or in part."

    @staticmethod
    def law(y, fraction, side):  # type: ignore[no-untyped-def]
        """Formula."""
        return (1.0 - fraction) * y + fraction * side * abs(y)

    def starts(self, seen: Seen) -> Sequence[dict[str, float]]:
        """In whole, or in part."""
        return [{"fraction": q} for q in (0.9, 0.2)]


# clocks
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
        # dx/dt = (1 + t) (A x + B w)
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
        # the drift between the clocks acts on the inputs, see `engine.inputs`
        into.pace = into.pace + values[1]

    def starts(self, seen: Seen) -> Sequence[dict[str, float]]:
        """Either clock may be the right one."""
        # the scanned drift, with either clock as the slow one
        return [{"apart": a, "slow": slow} for a in seen.drifts for slow in (a, 0.0)]
