"""The records of a fit, cut into free runs where the model integrates."""

from __future__ import annotations

from typing import Any

import control as ct

from ..data.measurement import Measurement, as_records
from ..engine.controlled import as_it_runs
from ..engine.free_runs import free_runs
from ..models.conversion import as_physical
from ..models.operating_point import ordered_record
from ..models.physical_model import PhysicalModel

__all__ = ["as_records", "check_validation", "windows"]


def check_validation(model: Any, record: Any) -> None:
    """Whether a record can judge the model; said before the work, whatever it will find."""
    if not isinstance(record, Measurement):
        raise ct.ControlArgument(
            f"validation must be a Measurement that took no part in the fit, not {type(record).__name__}"
        )
    ordered_record(as_physical(model), record)


def windows(
    physical: PhysicalModel, records: list[Measurement], horizon: float | None, known_start: bool = False
) -> tuple[list[Measurement], str]:
    """Cut the records into the windows of `physics.windows.free_runs`, and say why."""
    cuts, note = free_runs([as_it_runs(physical, r) for r in records], records, horizon, known_start)
    pieces = []
    for record, parts in zip(records, cuts, strict=True):
        pieces += [record] if len(parts) == 1 else [record._part(part) for part in parts]
    return pieces, note
