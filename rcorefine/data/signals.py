"""Checks of arrays, labels and times; clock times in seconds.

Every error message names the problem, its position and the remedy.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Sequence
from datetime import UTC, datetime
from typing import Any

import control as ct
import numpy as np

from ..arguments import as_array, as_number
from ..exceptions import DataError
from ..systems.linear import Array

# A time axis may leave its regular grid by this share of a sample: the rounding of a text file passes,
# a lost, doubled or shifted sample does not.
GRID_TOLERANCE = 0.02
_STAMP = re.compile(
    r"(?:(?P<date>\d{4}-\d\d-\d\d)[T ])?(?P<hours>[0-2]?\d:[0-5]\d:[0-5]\d)(?:[.,](?P<part>\d+))?"
    r"(?P<zone>Z|[+-]\d\d:?\d\d)?"
)
_DAY = 86400.0


def as_signals(values: Any, what: str) -> Array:
    """Return signals as a new float array (signal, time).

    If that is not possible, an error gives the reason.

    Parameters
    ----------
    values : array_like
        One signal (N,), or several (n, N): signal first, time last.
    what : str
        "inputs" or "outputs", for the messages.

    Returns
    -------
    ndarray of shape (n, N)
        A copy in float64.

    Raises
    ------
    control.ControlArgument
        If the values are complex, text, dates or objects.
    control.ControlDimension
        If the array is transposed, ragged or has more than two dimensions.
    DataError
        If there is no sample or no signal, or if values are masked.
    """
    if hasattr(values, "columns") and hasattr(values, "iloc"):
        raise ct.ControlArgument(
            f"{what} is a table of columns ({type(values).__name__}); "
            "read it with Measurement.from_frame(frame, inputs=[...], outputs=[...])"
        )
    array = as_array(values, what, finite=False, flags=True)
    if array.ndim == 0:
        raise ct.ControlDimension(f"{what} is a single number; give a signal over time")
    if array.ndim > 2:
        raise ct.ControlDimension(
            f"{what} has shape {array.shape}; give (signal, time), one record at a time, "
            "or (time,) for one signal"
        )
    if array.size == 0:
        raise DataError(f"{what} is empty (shape {array.shape}); give at least one signal with one sample")
    if array.ndim == 2 and array.shape[0] > array.shape[1]:
        n_samples, n_signals = array.shape
        raise ct.ControlDimension(
            f"{what} has shape {array.shape}: it looks transposed "
            f"({n_signals} signal(s) of {n_samples} samples?). "
            f"Signals come first and time last, as in python-control; pass {what}.T"
        )
    return np.atleast_2d(array)


def default_labels(prefix: str, count: int) -> tuple[str, ...]:
    """Labels that python-control itself would give: u[0], u[1], ..."""
    return tuple(f"{prefix}[{index}]" for index in range(count))


#: Sizes of signals between which sums of their fourth powers, and ratios of squares, are numbers.
SMALLEST, LARGEST = 1e-70, 1e70


def check_sizes(signals: Array, labels: Sequence[str], what: str, smallest: float = SMALLEST) -> None:
    """Refuse a signal whose square is no number."""
    for label, size in zip(labels, np.fmax.reduce(np.abs(signals), axis=1, initial=0.0), strict=True):
        if size and not smallest <= size < LARGEST:
            raise DataError(
                f"{what} {label!r} reaches {size:.3g}, whose square is no number; give it in another unit"
            )


def spreads(signals: Array) -> Array:
    """Return the standard deviation of each signal, shape (n,) for (n, N).

    Of a constant signal it is the level, and 1 of one that is zero: weights and noise levels are relative to
    it, and the rounding of a mean is no size.

    Examples
    --------
    >>> print(spreads(np.array([[1.0, -1.0], [0.1, 0.1], [0.0, 0.0]])))
    [1.  0.1 1. ]
    """
    size, level = over_time(np.std, signals), over_time(np.max, np.abs(signals))
    found: Array = np.where(size > 8 * np.spacing(level), size, level) + (level == 0)
    return np.nan_to_num(found, nan=1.0)  # a signal without any sample


def over_time(figure: Callable[..., Any], signals: Array) -> Array:
    """Return a figure of each signal (n, N), over the samples that are there.

    It is NaN for a signal that has none.

    Examples
    --------
    >>> print(over_time(np.mean, np.array([[1.0, np.nan, 3.0], [0.0, 1.0, 2.0]])))
    [2. 1.]
    """
    gone = np.isnan(signals)
    if not gone.any():
        return np.asarray(figure(signals, axis=1))
    rows = [row[~gaps] for row, gaps in zip(signals, gone, strict=True)]
    return np.array([figure(row, axis=0) if row.size else np.nan for row in rows])


def measured(blocks: Iterable[Iterable[Any]]) -> int:
    """Return the number of samples that were measured."""
    return sum(int(np.count_nonzero(~np.isnan(row))) for block in blocks for row in block)


def difference(simulated: Array, measured: Array) -> Array:
    """Return simulated minus measured outputs, zero where none were measured."""
    error = simulated - measured
    error[np.isnan(measured)] = 0.0
    return error


def check_whole(data: Any, purpose: str) -> None:
    """Refuse a record with gaps, and name the first one."""
    if data.there is None:
        return
    row, sample = (int(first[0]) for first in np.nonzero(~data.there))
    raise DataError(
        f"{purpose} needs all samples; output {data.output_labels[row]!r} has none at sample {sample} "
        f"(t = {data.timepts[sample]:.6g} s). Use a stretch without gaps (segment)"
    )


def check_finite(signals: Array, labels: Sequence[str], times: Array | None, what: str) -> None:
    """Refuse NaN and Inf, naming signal and sample."""
    bad = ~np.isfinite(signals)
    if not bad.any():
        return
    row, sample = (int(i) for i in np.argwhere(bad)[np.argmin(np.argwhere(bad)[:, 1])])
    value = signals[row, sample]
    place = f"sample {sample}" + ("" if times is None else f" (t = {times[sample]:.6g} s)")
    count = int(bad.any(axis=0).sum())
    raise DataError(
        f"{what} {labels[row]!r} is {'NaN' if np.isnan(value) else 'Inf'} at {place}; "
        f"{count} of {signals.shape[1]} samples are not finite. Repair them, or use a stretch without them"
        + (", or leave NaN out with missing='hold-out'" if what == "output" and np.isnan(value) else "")
    )


def as_time_grid(dt: Any, timepts: Any, n_samples: int) -> tuple[float, Array]:
    """Sampling time and regular time axis from `dt`, `timepts` or both.

    Raises
    ------
    DataError
        If neither is given, if they contradict each other, or if the times
        are irregular; the message names place and size.
    """
    step = None if dt is None else as_number(dt, "dt", above=0.0, what="a time in seconds", error=DataError)
    if timepts is None:
        if step is None:
            raise DataError("the record has no time: give dt (sampling time in s) or timepts (times in s)")
        return step, step * np.arange(n_samples, dtype=np.float64)
    times = _as_times(timepts, n_samples)
    if n_samples == 1:
        if step is None:
            raise DataError("one sample has no sampling time: give dt in s")
        return step, times
    steps = np.diff(times)
    if (steps <= 0).any():
        k = int(np.argmax(steps <= 0))
        raise DataError(
            f"timepts does not increase from sample {k} ({times[k]:.9g} s) "
            f"to sample {k + 1} ({times[k + 1]:.9g} s); sort the record and remove doubled samples, "
            "let Measurement.from_timestamps do it (from a file: time= and dt= together), "
            "or give dt in place of the times"
        )
    mean = step_of(times, n_samples - 1)
    _check_regular(times, steps, mean)
    if step is not None and abs(step - mean) * (n_samples - 1) > GRID_TOLERANCE * mean:
        raise DataError(
            f"dt = {step:.9g} s contradicts timepts, which advance by {mean:.9g} s; "
            "give one of the two (timepts in seconds)"
        )
    step = mean if step is None else step
    grid: Array = float(times[0]) + step * np.arange(n_samples, dtype=np.float64)
    return step, grid


def step_of(times: Array, count: int) -> float:
    """Return the mean step, rounded to as few digits as possible.

    The rounding stays within the resolution of the times. 12 digits keep 0.01 from becoming
    0.010000000000000002; times since 1970 are good to 2e-7 s.
    """
    mean = float(times[-1] - times[0]) / count
    open_ = float(np.spacing(max(abs(times[0]), abs(times[-1])))) / count
    shorter = (float(f"{mean:.{digits}g}") for digits in range(1, 13))
    return next((step for step in shorter if abs(step - mean) <= open_), float(f"{mean:.12g}"))


def is_irregular(timepts: Any) -> bool:
    """Return whether times (N,) leave a regular grid.

    Times that go back or do not advance count, too. Times that are no finite numbers do not.
    """
    times = np.ravel(as_array(in_seconds(timepts), "timepts (in seconds)", finite=False))
    if times.size < 3 or not np.isfinite(times).all():
        return False
    mean = float(times[-1] - times[0]) / (times.size - 1)
    return bool((np.diff(times) <= 0).any() or _off_grid(times, mean).max() > GRID_TOLERANCE * mean)


def _off_grid(times: Array, mean: float) -> Array:
    return np.asarray(np.abs(times - times[0] - mean * np.arange(times.size)))


def _check_regular(times: Array, steps: Array, mean: float) -> None:
    """Refuse times off the regular grid, naming the step that differs most."""
    off_grid = _off_grid(times, mean)
    if off_grid.max() <= GRID_TOLERANCE * mean:
        return
    usual = float(np.sort(steps)[(steps.size - 1) // 2])  # a lower median: one of the steps, for two as well
    k = int(np.argmax(np.abs(steps - usual)))
    if abs(steps[k] - usual) > GRID_TOLERANCE * usual:
        where = (
            f"from sample {k} to {k + 1} (t = {times[k]:.9g} s) it advances by {steps[k]:.6g} s "
            f"instead of {usual:.6g} s"
        )
    else:
        k = int(np.argmax(off_grid))
        where = (
            f"sample {k} (t = {times[k]:.9g} s) is {off_grid[k]:.3g} s off the regular grid of {mean:.6g} s"
        )
    raise DataError(
        f"time is irregular: {where}. Bring it to a regular grid: from a file or frame by "
        f"time=..., dt={usual:.3g} together, from arrays by "
        f"rco.Measurement.from_timestamps(timepts, inputs, outputs, dt={usual:.3g}); "
        "or use a stretch without the gap"
    )


def _as_times(timepts: Any, n_samples: int) -> Array:
    times = as_array(in_seconds(timepts), "timepts (in seconds)", finite=False)
    if times.ndim == 2 and 1 in times.shape:
        times = times.ravel()
    if times.shape != (n_samples,):
        raise ct.ControlDimension(f"timepts has shape {times.shape} for signals of {n_samples} samples")
    if not np.isfinite(times).all():
        k = int(np.argmin(np.isfinite(times)))
        raise DataError(f"timepts is not finite at sample {k}; give the time of every sample, or dt")
    return times


def in_seconds(values: Any) -> Any:
    """Convert dates, times of day and durations to seconds.

    Dates count from the earliest one. Other values are returned as they are.

    Parameters
    ----------
    values : array_like
        Times as numpy, pandas or `datetime` hold them, or as text.

    Returns
    -------
    ndarray, shape (N,), or `values`
        NaN where a date is missing.

    Examples
    --------
    >>> in_seconds(np.array(["2024-03-31T10:00:01", "2024-03-31T10:00"], "datetime64[ms]"))
    array([1., 0.])
    """
    try:
        times = np.asarray(values)
    except ValueError:  # ragged: who asked for times says so
        return values
    if times.ndim != 1 or not times.size:
        return values
    if times.dtype.kind == "M":
        times = times - np.fmin.reduce(times)  # the earliest that is none of NaT
    if times.dtype.kind == "m":
        return times / np.timedelta64(1, "s")
    cells = times.tolist()
    kinds = {_kind(cell) for cell in cells}
    if kinds == {"local"}:  # where summer begins, such times differ by an hour more
        cells, kinds = [cell.astimezone(UTC) for cell in cells], {"plain"}
    if kinds == {"plain"}:
        first = min(cells)
        return np.array([(cell - first).total_seconds() for cell in cells])
    if kinds == {"text"} and is_clock_time(cells[0]):
        return seconds_of(cells, [f"time {k}" for k in range(len(cells))])[0]
    return values


def _kind(cell: Any) -> str:
    """Return the kind of a time: a date with or without a zone, or text."""
    if isinstance(cell, str):
        return "text"
    if not isinstance(cell, datetime) or cell != cell:  # NaT is none, not even itself
        return ""
    return "plain" if cell.tzinfo is None else "local"


def is_clock_time(cell: str) -> bool:
    """Return whether a text is a time of day, or a date and time in ISO form.

    Examples
    --------
    >>> [is_clock_time(cell) for cell in ("10:15:30,5", "2024-03-31 13:59:59Z", "2024-03-31", "1.5")]
    [True, True, False, False]
    """
    return _STAMP.fullmatch(cell) is not None


def seconds_of(cells: Sequence[str], places: Sequence[str]) -> tuple[Array, str]:
    """Convert times of day or ISO dates to seconds from the first.

    Times of day may pass midnight.

    Parameters
    ----------
    cells : sequence of str
        Times, all of one form.
    places : sequence of str
        Where each of them stands, for messages.

    Returns
    -------
    seconds : ndarray, shape (N,)
    note : str
        How they were read.

    Raises
    ------
    DataError
        If one is no time like the first one.

    Examples
    --------
    >>> seconds_of(["23:59:59.5", "00:00:00.25"], ["", ""])
    (array([0.  , 0.75]), 'a clock, counted from 23:59:59.5')
    """
    whole: list[int] = []
    part: list[float] = []
    form: tuple[bool, bool] | None = None
    for cell, place in zip(cells, places, strict=True):
        match = _STAMP.fullmatch(cell)
        own = None if match is None else (match["date"] is None, match["zone"] is None)
        form = form or own
        if match is None or own != form:
            raise DataError(f"{place} is no time like the first one, {cells[0]!r}: {cell!r}")
        try:
            moment = np.datetime64(f"{match['date'] or '1970-01-01'}T{match['hours']:0>8}", "s")
        except ValueError as error:
            raise DataError(f"{place} is no time that exists: {cell!r}") from error
        zone = (match["zone"] or "Z").replace("Z", "+0000").replace(":", "")
        whole.append(moment.astype(int) - int(zone[0] + "1") * (3600 * int(zone[1:3]) + 60 * int(zone[3:])))
        part.append(float(f"0.{match['part'] or 0}"))
    # whole seconds and their parts apart: what is subtracted keeps all digits
    clock, rest = np.array(whole, dtype=float) - whole[0], np.array(part) - part[0]
    if form is not None and form[0]:
        clock += _DAY * np.cumsum(np.diff(clock, prepend=0.0) < -_DAY / 2)
    return clock + rest, f"a clock, counted from {cells[0]}"
