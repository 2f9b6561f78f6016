"""The force that a model lacks at a place, over the record."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Unpack

import control as ct

from ..data.measurement import Measurement
from ..inference.hidden_force import estimated_force
from ..inference.refinement import Refinement
from ..models.ports import Port
from ..results import Look, Result, picture, show
from ..systems.linear import Array

__all__ = ["HiddenForce", "hidden_force"]


@dataclass(frozen=True, slots=True, eq=False)
class HiddenForce(Result):
    """Unknown force at a place, estimated without a force law.

    The estimate comes from the record and the model.

    Attributes
    ----------
    place : str
        Port.
    timepts : ndarray, shape (N,)
        Time in s.
    d, v : ndarray, shape (N,)
        Displacement and velocity there, 0 where the port senses none.
    force, std : ndarray, shape (N,)
        Resisting force and its standard deviation. Its mean is no part of the estimate: it
        passes for the offset.
    position_unit, velocity_unit, force_unit : str
        Units, "" where unknown.
    """

    place: str
    timepts: Array
    d: Array
    v: Array
    force: Array
    std: Array
    position_unit: str = ""
    velocity_unit: str = ""
    force_unit: str = ""

    @picture
    def plot(self, **options: Unpack[Look]) -> ct.ControlPlot:
        """Plot the force over time, and over displacement and velocity.

        The plot over time shows two standard deviations.

        Returns
        -------
        ControlPlot
        """
        return show(self, "plot", **options)


def hidden_force(model: Refinement, noise: Array, port: Port, record: Measurement) -> HiddenForce:
    """Estimate the force at a port over a record; see `estimated_force`."""
    force, states, std = estimated_force(model, noise, port, record)
    d = port.position @ states + port.position_input @ record.inputs
    v = port.velocity @ states + port.velocity_input @ record.inputs
    spread = 0.0 * force + std
    units = (port.position_unit, port.velocity_unit, port.force_unit)
    return HiddenForce(port.name, record.timepts, d, v, force, spread, *units)
