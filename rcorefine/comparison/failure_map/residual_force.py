"""The force that a model lacks at a place, along the motion there."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from ...systems.linear import Array
from .motion import estimated_motion
from .record import model_on_record

if TYPE_CHECKING:
    from ..result import Comparison

__all__ = ["ResidualForce", "residual_force"]


@dataclass(frozen=True, slots=True, eq=False)
class ResidualForce:
    """Force that a model lacks at a place, along the motion there.

    Attributes
    ----------
    place : str
        Port.
    mechanical : bool
        Whether it has a displacement and a velocity.
    position, velocity, force : ndarray of shape (N,)
        Motion, and resisting force, in the model's units.
    position_unit, velocity_unit, force_unit : str
        Units.
    """

    place: str
    mechanical: bool
    position: Array
    velocity: Array
    force: Array
    position_unit: str
    velocity_unit: str
    force_unit: str


def residual_force(comparison: Comparison, index: int = 0, place: str | None = None) -> ResidualForce | None:
    """Estimate the force that a model lacks at a place.

    Parameters
    ----------
    comparison : Comparison
        Models on a record.
    index : int
        Which of the models.
    place : str, optional
        Port; default the one whose force explains most of the record.

    Returns
    -------
    ResidualForce or None
        None for a model without ports.
    """
    scene, _ = model_on_record(comparison, index)
    if scene.places is None:
        return None
    names = [p.name for p in scene.places.places]
    tried = range(len(names)) if place is None else [names.index(place)]
    estimates = [(estimated_motion(scene, [i]), i) for i in tried]
    estimate, chosen = max(estimates, key=lambda pair: pair[0].likelihood)
    port, x, w = scene.places.places[chosen], estimate.states, comparison.data.inputs
    return ResidualForce(
        port.name,
        port.kind == "mechanical",
        np.asarray(port.position @ x + port.position_input @ w),
        np.asarray(port.velocity @ x + port.velocity_input @ w),
        estimate.forces[0],
        port.position_unit,
        port.velocity_unit,
        port.force_unit,
    )
