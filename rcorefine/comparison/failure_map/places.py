"""Places where a hidden force could act on a compared model.

The channels are in the record's order.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from ...data.channels import Channels
from ...exceptions import RCOError, unheard
from ...models.physical_model import PhysicalModel
from ...models.ports import Port, felt
from ...systems.linear import Array, LinearModel

__all__ = ["Places", "found_places", "given_places"]


@dataclass(frozen=True, slots=True, eq=False)
class Places:
    """The continuous model that forces act on, and the places.

    Attributes
    ----------
    A, C : ndarray
        State matrix in continuous time and output matrix of the compared outputs.
    places : tuple of Port
        Of that model; `output` is all that a unit of force does to the compared outputs at once.
    """

    A: Array
    C: Array
    places: tuple[Port, ...]


def given_places(
    model: Any, linear: LinearModel, channels: Channels, n_inputs: int, outputs: Sequence[int]
) -> Places | None:
    """Places of a `PhysicalModel` or `Refinement`; None for a plain system.

    Parameters
    ----------
    model : PhysicalModel, Refinement or StateSpace
        What was compared.
    linear : LinearModel
        Its linear part, aligned with the record.
    channels : Channels
        Places of the model's channels in the record.
    n_inputs : int
        Inputs of the record.
    outputs : sequence of int
        Rows of the record's outputs that are compared.

    Returns
    -------
    Places or None
    """
    physical = model if isinstance(model, PhysicalModel) else getattr(model, "physical_model", None)
    if not isinstance(physical, PhysicalModel) or not linear.is_continuous:
        return None
    rows = [channels.outputs.index(place) for place in outputs]
    return _places(physical, linear, list(channels.inputs), n_inputs, rows)


def found_places(linear: LinearModel, dt: float) -> Places | None:
    """Find the places in the matrices of a plain state-space system.

    None if none can be found.
    """
    try:
        with unheard():
            physical = PhysicalModel.from_statespace(linear.to_statespace(), dt=dt)
    except (RCOError, np.linalg.LinAlgError):
        return None
    same = list(range(linear.n_inputs))
    return _places(physical, physical.linear, same, len(same), list(range(linear.n_outputs)))


def _places(
    physical: PhysicalModel, linear: LinearModel, columns: list[int], n_inputs: int, rows: list[int]
) -> Places:
    n = linear.n_states

    def states(row: Array) -> Array:
        padded = np.zeros(n)  # a refinement may have states that the initial model has not
        padded[: row.size] = row
        return padded

    def inputs(row: Array) -> Array:
        placed = np.zeros(n_inputs)
        placed[columns] = row
        return placed

    places = tuple(
        replace(
            port, act=states(port.act), position=states(port.position), velocity=states(port.velocity),
            position_input=inputs(port.position_input), velocity_input=inputs(port.velocity_input),
            acceleration_input=inputs(port.acceleration_input), output=felt(port, physical.output_rate)[rows],
        )
        for port in physical.ports
    )  # fmt: skip
    return Places(linear.A, linear.C, places)
