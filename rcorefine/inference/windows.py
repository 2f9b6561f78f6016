"""The records of a fit, cut into free runs where the model integrates."""

from __future__ import annotations

from typing import Any

import control as ct

from ..data.frequency_response import FrequencyResponse
from ..data.measurement import Measurement, as_records
from ..data.response_record import ResponseRecord, as_responses, in_frequency
from ..engine.controlled import as_it_runs, is_led
from ..engine.free_runs import free_runs
from ..models.conversion import as_physical
from ..models.operating_point import ordered_record
from ..models.physical_model import PhysicalModel

__all__ = ["about_noise", "as_data", "check_validation", "windows"]


def check_validation(model: Any, record: Any) -> None:
    """Whether a record can judge the model; said before the work, whatever it will find."""
    if not isinstance(record, (Measurement, FrequencyResponse)):
        raise ct.ControlArgument(
            f"validation must be a Measurement that took no part in the fit, not {type(record).__name__}"
        )
    ordered_record(as_physical(model), record)


def as_data(
    data: Any, *, x0: Any = "estimate", horizon: Any = None, noise: Any = None, controller: Any = None
) -> list[Any]:
    """Records in time, or frequency responses; the settings that these have no use for are refused.

    Raises
    ------
    control.ControlArgument
        If it is neither, or a setting belongs to records in time.
    """
    if not in_frequency(data):
        return as_records(data)
    for name, value, instead in (
        ("x0", None if isinstance(x0, str) and x0 == "estimate" else x0, "a response has no initial state"),
        ("horizon", horizon, "a response has no free run"),
        ("controller", controller, "give the loop as a model (control.feedback)"),
        ("noise", noise, "give the standard deviation of the points to FrequencyResponse(..., std=...)"),
    ):
        if value is not None:
            raise ct.ControlArgument(f"{name} belongs to records in time; {instead}")
    return as_responses(data)


def about_noise(physical: PhysicalModel, data: list[Any]) -> list[str]:
    """What is said of the noise of frequency responses; nothing of records in time, or where it is known."""
    if not in_frequency(data):
        return []
    said = windows(physical, [ResponseRecord.of(one, physical.linear) for one in data], None)[1]
    return [said] if said else []


def windows(
    physical: PhysicalModel, records: list[Any], horizon: float | None, known_start: bool = False
) -> tuple[list[Any], str]:
    """Cut the records into the windows of `physics.windows.free_runs`, and say why.

    Frequency responses stay whole; said is what their noise is.
    """
    if in_frequency(records):
        return records, " ".join(dict.fromkeys(record.note for record in records if record.note))
    cuts, note = free_runs([as_it_runs(physical, r) for r in records], records, horizon, known_start)
    if physical.controller is not None and any(is_led(physical, r) for r in records):
        note = "Fitted by what it predicts one sample ahead (compare and simulate run the loop). " + note
    pieces = []
    for record, parts in zip(records, cuts, strict=True):
        pieces += [record] if len(parts) == 1 else [record._part(part) for part in parts]
    return pieces, note.strip()
