"""The records of a fit, cut into free runs where the model integrates."""

from __future__ import annotations

from typing import Any

import control as ct

from ..comparison.channels import match_channels
from ..exceptions import DataError
from ..measurement import Measurement
from ..physics.physical_model import PhysicalModel, as_physical
from ..physics.windows import free_runs

__all__ = ["as_records", "check_validation", "windows"]


def as_records(data: Any) -> list[Measurement]:
    """One record or several, checked."""
    records = [data] if isinstance(data, Measurement) else list(data)
    for i, record in enumerate(records):
        if not isinstance(record, Measurement):
            raise ct.ControlArgument(
                f"data[{i}] is a {type(record).__name__}; give a Measurement or a list of them"
            )
    if not records:
        raise DataError("data is an empty list; give at least one Measurement")
    return records


def check_validation(model: Any, record: Any) -> None:
    """Whether a record can judge the model; said before the work, whatever it will find."""
    if not isinstance(record, Measurement):
        raise ct.ControlArgument(
            f"validation must be a Measurement that took no part in the fit, not {type(record).__name__}"
        )
    match_channels(as_physical(model).linear, record)


def windows(
    physical: PhysicalModel, records: list[Measurement], horizon: float | None, known_start: bool = False
) -> tuple[list[Measurement], str]:
    """Cut the records into the windows of `physics.windows.free_runs`, and say why."""
    cuts, note = free_runs([physical.linear], records, horizon, known_start)
    pieces = []
    for record, parts in zip(records, cuts, strict=True):
        pieces += [record] if len(parts) == 1 else [record._part(part) for part in parts]
    return pieces, note
