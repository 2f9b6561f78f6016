"""A record, or several, and nothing else."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import control as ct
import numpy as np

from ..arguments import as_list, shown
from ..exceptions import DataError
from .measurement import Measurement

__all__ = ["amplitude", "as_record", "as_records", "at_rest"]


def as_record(data: Any) -> Measurement:
    """One record in time.

    Raises
    ------
    control.ControlArgument
        If it is something else.
    """
    if not isinstance(data, Measurement):
        raise ct.ControlArgument(
            f"data must be a Measurement, one record in time, not {shown(data)}; build one with "
            "Measurement(inputs, outputs, dt=...) or Measurement.from_response(...)"
        )
    return data


def as_records(data: Any, name: str = "data") -> list[Measurement]:
    """One record or several, as a list.

    Raises
    ------
    control.ControlArgument
        If it is something else.
    DataError
        If the list is empty.
    """
    first = data[0] if isinstance(data, list | tuple) and data else data
    if isinstance(first, ct.FrequencyResponseData):
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
    return records


def at_rest(records: Sequence[Measurement]) -> bool:
    """Return whether no input changes in any record (free decays)."""
    return not any(np.ptp(record.inputs, axis=1).any() for record in records)


def amplitude(record: Measurement) -> float:
    """Return the root mean square of the inputs.

    If no input changes, it is that of the outputs.
    """
    signals = record.outputs if at_rest([record]) else record.inputs
    return float(np.sqrt(np.mean(signals**2)))
