"""Learning phase of the monitor.

It leads from the first samples to the stream that follows, with records, windows and thresholds.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

import control as ct
import numpy as np
from scipy.optimize import brentq

from ...arguments import as_list
from ...data.channels import match_channels, record_for
from ...data.measurement import Measurement
from ...data.records import as_record
from ...exceptions import DataError
from ...systems.linear import Array, LinearModel
from ..checks import as_size
from ..gaps import Block
from .adequacy import Adequacy, adequacy_of, explained
from .bank import build_bank
from .baseline import check_outputs
from .numbers import numbers_of, offset, settled
from .observer import Observer
from .stream import Stream, Windows
from .watching import watch_block

if TYPE_CHECKING:
    from .monitor import Monitor

__all__ = ["crossing_rate", "learned", "record_to_watch", "threshold", "window_lengths"]

_SLOW = 16  # periods of the mean that is taken off


def learned(monitor: Monitor, block: Block, per: int, blocks: int) -> tuple[Stream, Adequacy]:
    """Learn parameters, noise and columns from the first samples.

    These samples are then monitored like any others.

    Parameters
    ----------
    monitor : Monitor
        Its settings, watch and course.
    block : Block
        Samples of the learning phase.
    per : int
        Samples to which the rate of false alarms refers.
    blocks : int
        Blocks of samples that are kept.
    """
    if not block.known.all():
        sample = int(np.argmin(block.known))
        raise DataError(
            f"an input is missing at sample {sample}, in the learning phase of {len(block.inputs)} samples; "
            "start the stream where the inputs are whole"
        )
    data = Measurement(block.inputs.T, block.outputs.T, dt=monitor.dt, hold=monitor.hold)
    period = monitor._pace.period
    given = numbers_of(
        monitor._structure, monitor._theta, monitor._substeps, monitor._covariance, monitor.tolerance
    )
    check_outputs(given.structure, data, block.use)
    given = offset(given, data, block.use)
    numbers, healthy = settled(given, data, block.use, monitor.disturbance, period)
    bank = build_bank(numbers, monitor.candidates, data, monitor.hold, healthy.gain)
    keep = 1.0 - 1.0 / monitor._lengths
    heights = threshold(monitor.false_alarms / per, keep, bank.watched)
    windows = Windows(keep, heights, monitor._block, blocks, 1.0 / (_SLOW * period))
    observer = Observer(
        numbers.structure, numbers.theta, monitor.dt, monitor.hold, monitor._substeps, healthy.gain
    )
    stream = Stream(observer, healthy, bank, windows, monitor.learn)
    watch_block(stream, monitor._watch, monitor._course, block)
    before, after = (explained(numbers, at.theta, data, block.use, healthy.gain) for at in (given, numbers))
    return stream, adequacy_of(stream, given, numbers, monitor.tolerance, (before, after), monitor.dt)


def record_to_watch(model: LinearModel, dt: float, hold: str, data: Any) -> Measurement:
    """Return a record in the order of the model's channels.

    It must have the sample time and the hold of the stream.
    """
    data = as_record(data)
    if not math.isclose(data.dt, dt, rel_tol=1e-6):
        raise DataError(f"the record has dt = {data.dt:g} s and the monitor {dt:g} s; resample one")
    if data.hold != hold:
        raise DataError(
            f"the record has hold={data.hold!r} and the monitor hold={hold!r}; build the "
            f"monitor with hold={data.hold!r}"
        )
    return record_for(data, match_channels(model, data))


_LONGEST = 200  # periods in the longest window


def window_lengths(windows: tuple[int, int] | None, period: int) -> Array:
    """Return the samples in each window, doubled from one to the next.

    `period` is that of the first mode.
    """
    if windows is None:
        shortest, longest = max(8, period // 4), _LONGEST * period
    else:
        pair = as_list(windows, "windows", "two sizes, the shortest first")
        if len(pair) != 2:
            raise ct.ControlDimension(f"windows has {len(pair)} entries; give the shortest and the longest")
        shortest = as_size(pair[0], "windows[0]", 4, "samples in the shortest window")
        longest = as_size(pair[1], "windows[1]", shortest, "samples in the longest window")
    count = max(1, round(math.log2(longest / shortest)) + 1)
    return np.asarray(shortest * 2.0 ** np.arange(count))


def crossing_rate(level: float, keep: float) -> float:
    """Return the rate per sample of chance crossings of a level.

    The rate is that of one windowed statistic.

    Parameters
    ----------
    level : float
        Level of the absolute value of the statistic, which has unit variance.
    keep : float
        Share that the window keeps per sample, so that the correlation of the
        statistic over a lag of h samples is ``keep**h``.

    Returns
    -------
    float
        Expected number of crossings (clusters of them) per sample.

    Notes
    -----
    The statistic is a sampled Ornstein-Uhlenbeck process; a high level b is
    crossed at the rate ``2 c b phi(b)`` with c = -ln(keep) (Pickands), thinned by
    Siegmund's ``exp(-0.583 b sqrt(2 c))`` because the process is not seen between
    samples, and never more often than single samples lie above it.

    References
    ----------
    D. Siegmund, Sequential Analysis, Springer 1985, chapters IV and VIII.

    Examples
    --------
    >>> 0.9 < crossing_rate(4.0, 0.99) / 7.1e-6 < 1.1
    True
    """
    c = -math.log(keep)
    density = math.exp(-0.5 * level * level) / math.sqrt(2 * math.pi)
    clusters = 2 * c * level * density * math.exp(-0.583 * level * math.sqrt(2 * c))
    return min(clusters, math.erfc(level / math.sqrt(2)))


def threshold(rate: float, keep: Array, columns: int) -> Array:
    """Levels of the statistic for each window, the rate shared out evenly.

    Parameters
    ----------
    rate : float
        Expected false alarms per sample, all columns and windows together.
    keep : ndarray, shape (M,)
        Share that each window keeps per sample.
    columns : int
        Number of columns; their rates add up at most (Bonferroni).

    Returns
    -------
    ndarray, shape (M,)
        Levels.
    """
    goal = math.log(rate / (columns * keep.size))

    def excess(level: float, share: float) -> float:
        return math.log(max(crossing_rate(level, share), 1e-300)) - goal

    return np.array([brentq(excess, 1.5, 30.0, args=(float(share),), xtol=1e-6) for share in keep])
