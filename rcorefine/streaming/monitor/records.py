"""Records of the monitor: the samples that it learned from, and a whole one that it is to take."""

from __future__ import annotations

import math
from typing import Any

import control as ct
import numpy as np

from ...data.channels import match_channels, record_for
from ...data.measurement import Measurement
from ...exceptions import DataError
from ...systems.linear import LinearModel
from ..gaps import Block

__all__ = ["learning_record", "record_to_watch"]


def learning_record(block: Block, dt: float, hold: str) -> Measurement:
    """The samples of the learning phase as a record."""
    if not block.known.all():
        sample = int(np.argmin(block.known))
        raise DataError(
            f"an input is missing at sample {sample}, in the learning phase of {len(block.inputs)} samples; "
            "start the stream where the inputs are whole"
        )
    return Measurement(block.inputs.T, block.outputs.T, dt=dt, hold=hold)


def record_to_watch(model: LinearModel, dt: float, hold: str, data: Any) -> Measurement:
    """A record in the order of the model's channels, if it was taken as the stream is."""
    if not isinstance(data, Measurement):
        raise ct.ControlArgument(
            f"data must be a Measurement, not {type(data).__name__}; "
            "build one with Measurement(inputs, outputs, dt=...)"
        )
    if not math.isclose(data.dt, dt, rel_tol=1e-6):
        raise DataError(f"the record has dt = {data.dt:g} s and the monitor {dt:g} s; resample one")
    if data.hold != hold:
        raise DataError(
            f"the record has hold={data.hold!r} and the monitor hold={hold!r}; build the "
            f"monitor with hold={data.hold!r}"
        )
    return record_for(data, match_channels(model, data))
