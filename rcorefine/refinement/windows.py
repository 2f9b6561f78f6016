"""The records, cut into free runs where the model integrates."""

from __future__ import annotations

from itertools import pairwise
from typing import Any

import control as ct
import numpy as np

from ..exceptions import DataError
from ..measurement import Measurement
from ..physics.physical_model import PhysicalModel
from ..systems.linear import LinearModel

__all__ = ["as_records", "integrates", "windows"]


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


def integrates(linear: LinearModel, record: Measurement) -> bool:
    """Whether a constant input drives an output away for as long as the record lasts."""
    if linear.n_states == 0:
        return False
    duration = record.n_samples * record.dt
    poles, right = np.linalg.eig(linear.A)
    slow = np.abs(poles) * duration < 1e-3
    if not slow.any():
        return False
    step = np.linalg.norm(linear.C, axis=0) @ np.abs(right[:, slow])
    return bool(np.any(step > 1e-9 * np.linalg.norm(linear.C)))


def windows(
    physical: PhysicalModel, records: list[Measurement], horizon: float | None, known_start: bool = False
) -> tuple[list[Measurement], str]:
    """Cut the records into free-run windows where asked for, or where the model integrates."""
    note, seconds = "", 0.0
    if horizon is None:
        if known_start or not integrates(physical.linear, records[0]):
            return records, note
        seconds = max(record.n_samples * record.dt for record in records) / 10
        note = (
            f"The model integrates, so free runs are cut into windows of {seconds:.3g} s "
            "with an initial state each (horizon=)."
        )
    else:
        if isinstance(horizon, (bool, np.bool_)) or not isinstance(horizon, (int, float, np.number)):
            raise ct.ControlArgument(f"horizon must be a time in seconds, not {horizon!r}")
        if not (np.isfinite(horizon) and horizon > 0):
            raise ct.ControlArgument(f"horizon must be a positive time in seconds, not {horizon!r}")
        if known_start:
            raise ct.ControlArgument("a given x0 holds for one start only; leave horizon or x0 out")
        seconds = float(horizon)
    least = 4 * physical.linear.n_states + 4
    pieces = []
    for record in records:
        length = max(round(seconds / record.dt), least)
        count = max(1, record.n_samples // length)
        edges = np.linspace(0, record.n_samples, count + 1).astype(int)
        for first, last in pairwise(edges):
            pieces.append(record._part(slice(int(first), int(last))))
    return pieces, note
