"""Records, their levels of excitation, and outputs at the end of range."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise
from typing import Any

import control as ct
import numpy as np
from numpy.typing import NDArray
from scipy import stats

from ..arguments import as_list, shown
from ..exceptions import DataError
from ..systems.linear import Array
from .measurement import Measurement
from .response_record import as_responses
from .signals import spreads

MOST_LEVELS = 3  # levels of a record that are told apart
_BLOCKS = 24  # pieces of a record whose level is looked at
_RATIO = 1.6  # of the levels of two stretches that count as different
_FEWEST = 4  # blocks of a stretch
_RUN = 4  # samples in a row that make a standstill
_STEPS = 3.0  # of the converter by which a smooth signal may leave a peak that it shows as flat
_CLIPPED = 0.005  # share of the samples that sit at the very same extreme
_SAME = 1e-9  # of the range, below which two readings are one


def as_record(data: Any) -> Measurement:
    """One record in time.

    Raises
    ------
    control.ControlArgument
        If it is something else.
    DataError
        If an output has no sample.
    """
    if not isinstance(data, Measurement):
        raise ct.ControlArgument(
            f"data must be a Measurement, one record in time, not {shown(data)}; build one with "
            "Measurement(inputs, outputs, dt=...) or Measurement.from_response(...)"
        )
    return _measured(data)


def _measured(record: Measurement) -> Measurement:
    """Refuse a record with an output that has no sample at all."""
    there = record.there
    if there is not None and not there.any(axis=1).all():
        label = record.output_labels[int(np.argmin(there.any(axis=1)))]
        raise DataError(
            f"output {label!r} of record {record.name!r} has none of its {record.n_samples} samples; leave "
            "the output out of the record, or give a stretch in which it was measured"
        )
    return record


def as_records(data: Any, name: str = "data") -> list[Measurement]:
    """One record or several, as a list.

    Raises
    ------
    control.ControlArgument
        If it is something else.
    DataError
        If the list is empty, or an output has no sample.
    """
    if isinstance(_first(data), ct.FrequencyResponseData):
        raise ct.ControlArgument(
            f"{name} is a frequency response, and this needs a record in time; compare, refine, "
            "diagnose and improve take responses"
        )
    records = [data] if isinstance(data, Measurement) else as_list(data, name, "Measurement objects")
    for i, record in enumerate(records):
        if not isinstance(record, Measurement):
            raise ct.ControlArgument(
                f"{name}[{i}] is a {type(record).__name__}; {name} must be a Measurement or a list of them"
            )
    if not records:
        raise DataError(f"{name} is an empty list; give at least one Measurement")
    return [*map(_measured, records)]


def _first(data: Any) -> Any:
    return data[0] if isinstance(data, list | tuple) and data else data


def as_data(
    data: Any,
    *,
    x0: Any = "estimate",
    horizon: Any = None,
    noise: Any = None,
    controller: Any = None,
    several: bool = True,
) -> list[Any]:
    """Return the data as records in time or as frequency responses.

    Settings that frequency responses cannot use are refused, and more than one record in time, too, where
    `several` is False.

    Raises
    ------
    control.ControlArgument
        If it is neither, or a setting belongs to records in time.
    """
    if not isinstance(_first(data), ct.FrequencyResponseData):
        return as_records(data) if several else [as_record(data)]
    for name, value, instead in (
        ("x0", None if isinstance(x0, str) and x0 == "estimate" else x0, "a response has no initial state"),
        ("horizon", horizon, "a response has no free run"),
        ("controller", controller, "give the loop as a model (control.feedback)"),
        ("noise", noise, "give the standard deviation of the points to FrequencyResponse(..., std=...)"),
    ):
        if value is not None:
            raise ct.ControlArgument(f"{name} belongs to records in time; {instead}")
    return as_responses(data)


class FreeRun(Measurement):
    """Record whose free run was asked for: no observer corrects it."""


def at_rest(records: Sequence[Measurement]) -> bool:
    """Return whether no input changes in any record (free decays)."""
    return not any(np.ptp(record.inputs, axis=1).any() for record in records)


def amplitude(record: Measurement) -> float:
    """Return the root mean square of the inputs.

    If no input changes, it is that of the outputs.
    """
    signals = record.outputs if at_rest([record]) else record.inputs
    return float(np.sqrt(np.nanmean(signals**2)))


def stretches_by_level(data: Measurement) -> list[tuple[float, Measurement]]:
    """Longest stretch of a record at each level of its excitation.

    Parameters
    ----------
    data : Measurement
        Record.

    Returns
    -------
    list of (float, Measurement)
        Root mean square of the inputs about their mean, and the stretch, the lowest level first; the
        whole record where the level does not change.

    Examples
    --------
    >>> w = np.random.default_rng(0).standard_normal(4000)
    >>> w[2000:] *= 5
    >>> data = rco.Measurement(w, w, dt=0.01)
    >>> [(round(level), part.n_samples) for level, part in stretches_by_level(data)]
    [(1, 2000), (5, 2000)]
    """
    n, centered = data.n_samples, data.inputs - data.inputs.mean(axis=1, keepdims=True)
    relative = centered / spreads(data.inputs)[:, None]
    edges = np.linspace(0, n, min(_BLOCKS, max(1, n // 64)) + 1).round().astype(int)
    power = np.array([np.mean(relative[:, a:b] ** 2) for a, b in pairwise(edges)])
    whole = [(_level(data), data)]
    if power.size < 2 * _FEWEST or not (power > 0).all():
        return whole
    height = 0.5 * np.log(power)
    # the step that starts a new stretch is larger than what chance makes of one level
    jumps = np.flatnonzero(np.abs(np.diff(height)) > np.log(_RATIO)) + 1
    bounds = [0, *jumps.tolist(), power.size]
    bounds = [0] + [cut for a, b in pairwise(bounds) for cut in _thirds(height, a, b)]
    found: list[tuple[float, Measurement]] = []
    for a, b in sorted(pairwise(bounds), key=lambda pair: pair[0] - pair[1]):
        if b - a < _FEWEST:
            continue
        stop = float(data.timepts[edges[b]]) if edges[b] < n else None
        part = data.segment(float(data.timepts[edges[a]]), stop)
        level = _level(part)
        if all(max(level, other) / min(level, other) > _RATIO for other, _ in found):
            found.append((level, part))
    return sorted(found[:MOST_LEVELS], key=lambda pair: pair[0]) if found else whole


def _thirds(height: Array, first: int, last: int) -> list[int]:
    """Return the ends of the parts of a stretch.

    There are three parts if the level of the stretch rises or falls all the way, otherwise one.
    """
    blocks = last - first
    if blocks < 3 * _FEWEST:
        return [last]
    line = stats.linregress(np.arange(blocks), height[first:last])
    climbs = abs(line.slope) * blocks > 2 * np.log(_RATIO) and line.pvalue < 1e-4
    return [first + blocks // 3, first + 2 * blocks // 3, last] if climbs else [last]


def _level(data: Measurement) -> float:
    """Root mean square of the inputs about their mean."""
    return float(np.sqrt(np.mean(data.inputs.var(axis=1))))


def resolution(y: Array) -> float:
    """Return the smallest difference between two readings (N,).

    It is the step of the converter; without a converter it is close to zero.
    """
    apart = np.diff(np.unique(y))
    apart = apart[apart > _SAME * np.ptp(y)]
    return float(apart.min()) if apart.size else 0.0


def coarse_noise(y: Array) -> float:
    """Estimate the standard deviation of white noise on a smooth signal.

    The signal has shape (N,). Outliers do not count.
    """
    return float(1.4826 * np.median(np.abs(np.diff(y, 2))) / np.sqrt(6.0))


def runs(at: NDArray[np.bool_]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """First sample and end (exclusive) of each run of True."""
    edges = np.flatnonzero(np.diff(np.concatenate([[0], at.astype(np.int8), [0]])))
    return edges[::2], edges[1::2]


def cut_off(y: Array, limit: float) -> bool:
    """Return whether a record (N,) runs into a limit at speed and stays.

    A peak shows as four equal readings of a converter only where it is so flat that the
    readings beside them are within three steps, and a response that settles comes slowly; a
    signal that is cut off comes and goes at whatever speed it has.

    Parameters
    ----------
    y : ndarray, shape (N,)
        Readings.
    limit : float
        Largest or smallest of them.

    Returns
    -------
    bool

    Examples
    --------
    >>> t = 0.05 * np.arange(2000)
    >>> steps = np.round(np.sin(t) * 20) / 20
    >>> cut_off(steps, 1.0), cut_off(np.minimum(steps, 0.8), 0.8)
    (False, False)
    >>> fine = np.round(np.sin(t) * 2000) / 2000
    >>> cut_off(fine, fine.max()), cut_off(np.minimum(fine, 0.8), 0.8)
    (False, True)
    """
    first, end = runs(y == limit)
    whole = (end - first >= _RUN) & (first > 0) & (end < y.size)
    before, after = np.abs(y[first[whole] - 1] - limit), np.abs(y[end[whole]] - limit)
    slower = min(np.median(before), np.median(after)) if whole.any() else 0.0
    return bool(slower > _STEPS * resolution(y))


def clipped(y: Array) -> tuple[float, int] | None:
    """Return the extreme at which an output (N,) stays, and for how long.

    The time is the longest one, in samples. None if the output is not clipped.
    """
    if np.unique(y).size < 20:
        return None
    for level in (float(y.max()), float(y.min())):
        at = y == level
        if at.mean() >= _CLIPPED and cut_off(y, level):
            first, end = runs(at)
            return level, int((end - first).max())
    return None
