"""A whole record that the monitor is to take."""

from __future__ import annotations

import math
from typing import Any

from ...data.channels import match_channels, record_for
from ...data.measurement import Measurement
from ...data.records import as_record
from ...exceptions import DataError
from ...systems.linear import LinearModel

__all__ = ["record_to_watch"]


def record_to_watch(model: LinearModel, dt: float, hold: str, data: Any) -> Measurement:
    """A record in the order of the model's channels, if it was taken as the stream is."""
    data = as_record(data)
    if not math.isclose(data.dt, dt, rel_tol=1e-6):
        raise DataError(f"the record has dt = {data.dt:g} s and the monitor {dt:g} s; resample one")
    if data.hold != hold:
        raise DataError(
            f"the record has hold={data.hold!r} and the monitor hold={hold!r}; build the "
            f"monitor with hold={data.hold!r}"
        )
    return record_for(data, match_channels(model, data))
