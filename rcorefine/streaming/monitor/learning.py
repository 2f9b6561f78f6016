"""The end of the learning phase: what the first samples say of the model, and the stream that follows."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from ...data.measurement import Measurement
from ...exceptions import DataError
from ..gaps import Block
from .adequacy import Adequacy, adequacy_of, explained
from .bank import build_bank
from .baseline import check_outputs
from .numbers import numbers_of, offset, settled
from .observer import Observer
from .stream import Stream, Windows
from .thresholds import threshold
from .watching import watch_block

if TYPE_CHECKING:
    from .monitor import Monitor

__all__ = ["learned"]

_SLOW = 16  # periods of the mean that is taken off


def learned(monitor: Monitor, block: Block, per: int, blocks: int) -> tuple[Stream, Adequacy]:
    """Numbers, noise and columns from the first samples, which are then watched like any others.

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
    data, period = _record(block, monitor.dt, monitor.hold), monitor._pace.period
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


def _record(block: Block, dt: float, hold: str) -> Measurement:
    """The samples of the learning phase as a record."""
    if not block.known.all():
        sample = int(np.argmin(block.known))
        raise DataError(
            f"an input is missing at sample {sample}, in the learning phase of {len(block.inputs)} samples; "
            "start the stream where the inputs are whole"
        )
    return Measurement(block.inputs.T, block.outputs.T, dt=dt, hold=hold)
