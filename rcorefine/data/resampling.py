"""Resampling of a record to a regular grid, and decimation.

The filter of the decimation keeps the relation between inputs and outputs.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import control as ct
import numpy as np
from scipy.interpolate import CubicSpline
from scipy.signal import fftconvolve

from ..arguments import as_array
from ..exceptions import DataError
from ..systems.linear import Array
from .signals import in_seconds, step_of

_FINEST = 100  # samples per stamp that may be asked for
_DOUBLED = 0.2  # of a step: stamps that are closer count as one
_GAP = 3.0  # steps
_DISORDER = 0.02  # of the stamps before the one ahead: more is no clock that was set
_CROWDED = 1.5  # times as many stamps as a stretch of time has room for
_PASSES = 0.75  # of the new Nyquist frequency: up to there the filter is flat
_HALF = 20  # new samples on either side that it takes
_BETA = 7.857  # Kaiser's window for 80 dB
_NODES, _WEIGHTS = np.polynomial.legendre.leggauss(8)


class Resampled(NamedTuple):
    """Signals on a regular grid."""

    inputs: Array
    outputs: Array
    dt: float
    timepts: Array
    hold: str
    notes: tuple[str, ...]
    elapsed: float = 0.0  # s that were cut off before the first sample


class Stamped(NamedTuple):
    """Signals (n, N) by one clock."""

    times: Array
    rows: Array
    name: str


def decimated(inputs: Array, outputs: Array, dt: float, timepts: Array, hold: str, factor: int) -> Resampled:
    """Return every `factor`-th sample after a low-pass filter.

    Inputs, as they are held, and outputs pass the same filter.

    Parameters
    ----------
    inputs, outputs : ndarray, shape (n_w, N) and (n_y, N)
        Signals.
    dt : float
        Their sampling time.
    timepts : ndarray, shape (N,)
        Their times.
    hold : {"zoh", "foh", "bandlimited"}
        How the inputs run between the samples.
    factor : int
        How many times slower.

    Returns
    -------
    Resampled
        Band-limited. Shorter by 20 new samples at either end, where the filter is not full.

    Raises
    ------
    DataError
        If nothing would be left.

    Notes
    -----
    With f(t) the filter's impulse response (a sinc under Kaiser's window, even in t), outputs become
    sum_n dt f(n dt) y(k - n). An input is a function of time by its hold, u(t) = sum_k u(k) p(t - k dt),
    and becomes the samples of f * u, sum_n u(k - n) int f(n dt + s) p(-s) ds. As f * (G u) = G (f * u) for
    any linear time-invariant G, the new samples belong to the same model under band-limited inputs: nothing
    has to be added to it. Content above the new Nyquist frequency is 80 dB down.
    """
    half = _HALF * factor
    if outputs.shape[1] < 2 * (half + 1) + 2 * factor:
        raise DataError(
            f"{outputs.shape[1]} samples are too few to be decimated by {factor}: the filter takes {half} at "
            f"either end; at least {2 * (half + 1) + 2 * factor} are needed"
        )
    lags: Array = np.arange(-half - 1, half + 2, dtype=float) * dt
    taps = _response(lags, dt, factor)
    held = taps
    if hold != "bandlimited":
        held = np.zeros_like(taps)
        for start in (-1.0,) if hold == "zoh" else (-1.0, 0.0):
            for node, weight in zip(_NODES, _WEIGHTS, strict=True):
                s = start + (node + 1) / 2
                kernel = 1.0 if hold == "zoh" else 1.0 - abs(s)
                held += weight / 2 * kernel * _response(lags + s * dt, dt, factor)

    def through(signals: Array, weights: Array) -> Array:
        if not signals.size:
            return signals[:, half + 1 : signals.shape[1] - half - 1 : factor]
        # constants pass exactly, and a large one costs no digits of the rest
        level = signals.mean(axis=1, keepdims=True)
        passed = fftconvolve(signals - level, (weights / weights.sum())[None], mode="valid", axes=1)
        found: Array = passed[:, ::factor] + level
        return found

    edge = np.pi / (factor * dt)
    note = (
        f"decimated by {factor}: inputs (as held, {hold}) and outputs passed the same zero-phase low-pass, "
        f"flat to {_PASSES * edge:.4g} rad/s and 80 dB down above {edge:.4g}, so a linear model keeps its "
        f"relation to both; {half + 1} samples at either end and all faster content, that of jumps and kinks "
        "included, are gone"
    )
    times = timepts[half + 1 : timepts.size - half - 1 : factor]
    return Resampled(
        through(inputs, held), through(outputs, taps), factor * dt, times, "bandlimited", (note,),
        (half + 1) * dt,
    )  # fmt: skip


def _response(t: Array, dt: float, factor: int) -> Array:
    """Impulse response of the low-pass at times `t`, times dt."""
    edge = (1 + _PASSES) / 2 / (factor * dt)  # twice the cutoff in Hz
    inside = np.clip(1.0 - (t / (_HALF * factor * dt)) ** 2, 0.0, None)
    found: Array = dt * edge * np.sinc(edge * t) * np.i0(_BETA * np.sqrt(inside)) / np.i0(_BETA)
    return np.where(inside > 0.0, found, 0.0)


def as_stamps(values: Any, name: str) -> Array:
    """Return time stamps in s, shape (N,).

    Dates count from the first one.

    Raises
    ------
    control.ControlDimension
        If they are no vector.
    DataError
        If one is missing, or there are fewer than four.
    """
    stamps = as_array(in_seconds(values), f"{name} (in seconds)", finite=False)
    if stamps.ndim != 1:
        raise ct.ControlDimension(f"{name} has shape {stamps.shape}; give one time per sample, shape (N,)")
    if not np.isfinite(stamps).all():
        raise DataError(
            f"{name} is not finite at sample {int(np.argmin(np.isfinite(stamps)))}; drop that sample"
        )
    if stamps.size < 4:
        raise DataError(f"{name} holds {stamps.size} times; a grid is found from at least 4")
    return stamps


def regular(
    inputs: Stamped, outputs: Stamped, dt: float | None, hold: str, longest_gap: float | None
) -> Resampled:
    """Resample inputs and outputs to one regular grid.

    See `Measurement.from_timestamps`.
    """
    notes: list[str] = []
    held = hold == "zoh"
    inputs, outputs = _in_order(inputs, held, notes), _in_order(outputs, False, notes)
    for one in (outputs,) if held else (inputs, outputs):  # a held input may be stamped only when it changes
        _check_gaps(one.times, one.name, longest_gap)
    step = _step(outputs.times)
    dt = step if dt is None else dt
    factor = 1 if dt <= 1.1 * step else int(np.ceil(dt / step * (1 - 1e-9)))
    fine = dt / factor
    first, count = _grid(inputs, outputs, held, fine)
    if count > _FINEST * max(inputs.times.size, outputs.times.size):
        raise DataError(
            f"dt = {dt:g} s makes {count} samples of stamps {step:.6g} s apart, and nothing is known between "
            "these; give a longer dt"
        )
    grid: Array = first + fine * np.arange(count, dtype=float)
    y = CubicSpline(outputs.times, outputs.rows, axis=1)(grid)
    if held:
        w = _held_mean(inputs, np.append(grid, grid[-1] + fine))
        how = "mean of the held value over each step, which keeps what they drive"
    elif hold == "foh":
        w = np.array([np.interp(grid, inputs.times, row) for row in inputs.rows])
        how = "straight lines between their stamps"
    else:
        w = CubicSpline(inputs.times, inputs.rows, axis=1)(grid)
        how = "a cubic spline"
    steps = np.diff(outputs.times) / step
    scatter = np.std(steps - np.maximum(np.round(steps), 1.0))
    errors = ", ".join(f"{error:.3g}" for error in _left_out(outputs))
    said = (
        f"resampled to dt = {dt:.6g} s from stamps whose steps scatter by {100 * scatter:.2g} % of "
        f"{step:.6g} s; inputs: {how}; outputs: a cubic spline, whose rms error, noise included, is at most "
        f"{errors} (found by leaving out every other sample)"
    )
    notes.insert(0, said)
    if factor == 1:
        return Resampled(w, y, dt, grid, hold, tuple(notes))
    try:
        slow = decimated(w, y, fine, grid, hold, factor)
    except DataError as reason:
        raise DataError(f"dt = {dt:g} s is too long for stamps {step:.6g} s apart: {reason}") from reason
    return slow._replace(dt=dt, notes=(*notes, *slow.notes), elapsed=0.0)


def _grid(inputs: Stamped, outputs: Stamped, held: bool, step: float) -> tuple[float, int]:
    """Return start and length of a grid over what inputs and outputs share.

    Where inputs are held it lies where they switch, so that no switch is split between two samples.
    """
    first = max(float(inputs.times[0]), float(outputs.times[0]))
    last = float(outputs.times[-1]) if held else min(float(inputs.times[-1]), float(outputs.times[-1]))
    switches = inputs.times[1:][np.diff(inputs.rows, axis=1).any(axis=0)]
    if held and switches.size:
        turns = 2j * np.pi * (switches - first) / step
        share = float(np.angle(np.mean(np.exp(turns)))) / (2.0 * np.pi) % 1.0
        first += share * step if share <= 1.0 - 1e-6 else 0.0  # rounding is no whole step
    count = int(np.floor((last - first) / step * (1 + 1e-12))) + 1
    if last <= first or count < 2:
        spans = [f"{s.name} ({s.times[0]:g} ... {s.times[-1]:g} s)" for s in (inputs, outputs)]
        raise DataError(
            f"{' and '.join(spans)} have no stretch of time in common that holds two samples; bring them to "
            "one zero"
        )
    return first, count


def _in_order(signals: Stamped, last: bool, notes: list[str]) -> Stamped:
    """Sort the stamps, and merge samples with equal stamps.

    Stamps that are nearly equal count as equal.
    """
    _check_clock(signals)
    times, rows, name = signals
    order = np.argsort(times, kind="stable")
    late = int(np.sum(np.diff(times) < 0))
    times, rows = times[order], rows[:, order]
    step = float(np.median(np.diff(np.unique(times)))) if times[-1] > times[0] else 0.0
    if step == 0.0:
        raise DataError(f"all {name} are stamped {times[0]:g} s; give the time of every sample")
    new = np.concatenate([[True], np.diff(times) > _DOUBLED * step])
    starts = np.flatnonzero(new)
    sizes = np.diff(np.append(starts, times.size))
    if late:
        notes.append(f"{name}: {late} stamps lay before the one ahead of them and were sorted")
    if starts.size == times.size:
        return Stamped(times, rows, name)
    rule = "the last value was kept" if last else "their mean was taken"
    notes.append(
        f"{name}: {times.size - starts.size} stamps were double (closer than {_DOUBLED:g} steps); {rule}"
    )
    if last:
        return Stamped(times[starts], rows[:, np.append(starts[1:], times.size) - 1], name)
    mean = np.add.reduceat(times, starts) / sizes, np.add.reduceat(rows, starts, axis=1) / sizes
    return Stamped(*mean, name)


def _check_clock(signals: Stamped) -> None:
    """Raise an error if the clock was set back.

    Such a clock stamps two stretches with the same times, while a late sample fills a hole.
    """
    times, rows, name = signals
    steps = np.diff(times)
    back = np.flatnonzero(steps < 0)
    if not 0 < back.size <= max(1.0, _DISORDER * times.size):
        return
    step = float(np.median(steps[steps > 0])) if (steps > 0).any() else 0.0
    for k in back:
        low, high = times[k + 1], times[k]
        before = np.flatnonzero(times[: k + 1] >= low)
        after = k + 1 + np.flatnonzero(times[k + 1 :] <= high)
        room = (high - low) / step + 1 if step else 0.0
        if room < 3 or before.size + after.size < _CROWDED * room:
            continue
        nearest = before[np.argmin(np.abs(times[before][:, None] - times[after][:1]), axis=0)]
        sent_again = np.array_equal(rows[:, nearest[0] : nearest[0] + after.size], rows[:, after])
        if not sent_again:
            raise DataError(
                f"{name}: the clock was set back by {high - low + step:.6g} s behind sample {k} "
                f"(t = {high:.6g} s), so {before.size + after.size} samples share {room:.0f} times; "
                "make a record of each stretch, or correct the stamps"
            )


def _step(times: Array) -> float:
    """Return the usual step between stamps; lost samples do not count.

    It is the span divided by the number of steps in it.
    """
    steps = np.diff(times)
    usual = np.median(steps)
    counts = np.where(steps > 1.75 * usual, np.round(steps / usual), 1.0)  # jitter is not a lost sample
    return step_of(times, int(counts.sum()))


def _check_gaps(times: Array, name: str, longest: float | None) -> None:
    steps, usual = np.diff(times), _step(times)
    most = _GAP * usual if longest is None else longest
    gaps = np.flatnonzero(steps > most * (1 + 1e-9))
    if gaps.size:
        listed = ", ".join(f"{times[k]:.6g} ... {times[k + 1]:.6g} s" for k in gaps[:5])
        raise DataError(
            f"{name}: {gaps.size} gap(s) of more than {most:.3g} s ({listed}); one step is {usual:.3g} s. "
            "Make a record of each stretch between them, or set longest_gap= to have them filled in"
        )


def _held_mean(signals: Stamped, at: Array) -> Array:
    """Return the means of held values over each step between `at`.

    A value is held until the next stamp.
    """
    times = signals.times
    ends = np.append(times, max(times[-1], at[-1]) + 1.0)
    area = np.insert(np.cumsum(signals.rows * np.diff(ends), axis=1), 0, 0.0, axis=1)
    means: Array = np.diff([np.interp(at, ends, row) for row in area]) / np.diff(at)
    return means


def _left_out(signals: Stamped) -> Array:
    """Rms errors at every other sample of the spline through the rest."""
    times, rows, _ = signals
    if times.size < 8:
        return np.asarray(rows.std(axis=1))
    inside = slice(1, None if times.size % 2 else -1, 2)  # between samples that are kept
    spline = CubicSpline(times[::2], rows[:, ::2], axis=1)
    return np.asarray(np.sqrt(np.mean((spline(times[inside]) - rows[:, inside]) ** 2, axis=1)))
