"""Simulation mode of the compared models.

A model runs freely, in a control loop, or with process noise (Kalman predictor).
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from ..data.measurement import Measurement
from ..engine.controlled import as_it_runs
from ..engine.free_runs import runs_away
from ..engine.leading import leading_ratio
from ..models.conversion import known_physical
from ..models.operating_point import ordered_record
from ..models.physical_model import PhysicalModel
from ..systems.linear import LinearModel

__all__ = ["controlled", "led", "runs_of"]


def runs_of(models: Sequence[Any], linear: Sequence[LinearModel], data: Measurement) -> list[LinearModel]:
    """Return the linear models that are simulated.

    For a refinement this includes its initial model, by which `refine` decided whether it integrates.
    """
    known = [one for one in map(known_physical, models) if one is not None]
    if controlled(models):
        return [as_it_runs(one, data) for one in known]
    return [*linear, *(one.linear for one in known)]


def led(models: Sequence[Any], linear: Sequence[LinearModel], data: Measurement) -> bool:
    """Return whether a model has no free run and follows the record instead."""
    known = [one for one in map(known_physical, models) if one is not None]
    if controlled(models):
        return False
    away = any(each.is_continuous and runs_away(each, data) for each in linear)
    return away or any(leading_ratio(one, ordered_record(one, data)) is not None for one in known)


def controlled(models: Sequence[Any]) -> list[PhysicalModel]:
    """Those in a loop."""
    return [one for one in map(known_physical, models) if one is not None and one.controller is not None]
