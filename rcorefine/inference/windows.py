"""The records of a fit, cut into free runs where the model integrates."""

from __future__ import annotations

from typing import Any

import control as ct
import numpy as np

from ..data.frequency_response import FrequencyResponse
from ..data.measurement import Measurement
from ..data.records import as_records
from ..data.response_record import ResponseRecord, as_responses, in_frequency, some_lines
from ..engine.controlled import as_it_runs, free_runs
from ..engine.observer import leading_ratio
from ..models.conversion import as_physical
from ..models.operating_point import ordered_record
from ..models.physical_model import PhysicalModel

_LOOPED = "The model was fitted to predictions one sample ahead; compare and simulate run the closed loop."
_PREDICTED = (
    "The motion is chaotic and cannot be simulated from the initial state (no free run). It is judged "
    "by predictions one sample ahead, with process noise (horizon= gives short simulations)."
)

_MOST_LINES, _FEWEST_LINES = 200, 40  # frequencies that nonlinear effects are sought at, in all and of each


def check_validation(model: Any, record: Any) -> None:
    """Check that a record can validate the model, before the fit begins."""
    if not isinstance(record, (Measurement, FrequencyResponse)):
        raise ct.ControlArgument(
            f"validation must be a Measurement that the fit does not use, not {type(record).__name__}"
        )
    ordered_record(as_physical(model), record)


def as_data(
    data: Any, *, x0: Any = "estimate", horizon: Any = None, noise: Any = None, controller: Any = None
) -> list[Any]:
    """Return the data as records in time or as frequency responses.

    Settings that frequency responses cannot use are refused.

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


def spread_lines(data: list[Any]) -> list[Any]:
    """Limit the number of frequencies of responses at known amplitudes.

    Harmonic balance would take too long at all of them, so evenly spread ones are kept.
    """
    if not in_frequency(data) or any(one.amplitude is None for one in data):
        return data
    total = sum(one.omega.size for one in data)
    if total <= _MOST_LINES:
        return data
    kept = [max(_FEWEST_LINES, one.omega.size * _MOST_LINES // total) for one in data]
    numbers = [
        np.linspace(0, one.omega.size - 1, min(n, one.omega.size)) for one, n in zip(data, kept, strict=True)
    ]
    return [some_lines(one, np.unique(k.astype(int))) for one, k in zip(data, numbers, strict=True)]


def about_noise(physical: PhysicalModel, data: list[Any], given: list[Any]) -> list[str]:
    """Return notes on the noise and the used points of frequency responses."""
    if not in_frequency(data):
        return []
    said = windows(physical, [ResponseRecord.of(one, physical.linear) for one in data], None)[1]
    taken, of = (sum(one.omega.size for one in some) for some in (data, given))
    fewer = f"The search for nonlinear effects used {taken} of {of} frequencies; refine() uses all of them."
    return [sentence for sentence in (said, fewer if taken < of else "") if sentence]


def windows(
    physical: PhysicalModel, records: list[Any], horizon: float | None, known_start: bool = False
) -> tuple[list[Any], str]:
    """Cut the records into windows, and return a note with the reason.

    The windows are those of `engine.free_runs`. Responses stay whole, and the note is about their noise.
    """
    if in_frequency(records):
        return records, " ".join(dict.fromkeys(record.note for record in records if record.note))
    cuts, note = free_runs([as_it_runs(physical, r) for r in records], records, horizon, known_start)
    if len(cuts[0]) == 1 and not note and any(leading_ratio(physical, r) is not None for r in records):
        note = _PREDICTED if physical.controller is None else _LOOPED
    pieces = []
    for record, parts in zip(records, cuts, strict=True):
        pieces += [record] if len(parts) == 1 else [record._part(part) for part in parts]
    return pieces, note
