"""Where a hidden force could act on a compared model, in the order of the record's channels."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from ...data.channels import Channels
from ...exceptions import RCOError, RCOWarning
from ...models.physical_model import PhysicalModel
from ...models.ports import felt
from ...systems.linear import Array, LinearModel

__all__ = ["Place", "Places", "found_places", "given_places"]


@dataclass(frozen=True, slots=True, eq=False)
class Place:
    """A port as the failure map sees it.

    Attributes
    ----------
    name, kind : str
        Those of the port.
    act : ndarray of shape (n,)
        What a unit of resisting force does to the rates of the states.
    position, velocity : ndarray of shape (n,)
        Rows that read displacement and velocity from the states.
    position_input, velocity_input : ndarray of shape (n_w,)
        The same from the inputs.
    through : ndarray of shape (n_y,)
        What a unit of force does to the outputs at once (accelerometers).
    position_unit, velocity_unit : str
        Units.
    """

    name: str
    kind: str
    act: Array
    position: Array
    velocity: Array
    position_input: Array
    velocity_input: Array
    through: Array
    position_unit: str
    velocity_unit: str


@dataclass(frozen=True, slots=True, eq=False)
class Places:
    """The continuous model that forces act on, and the places.

    Attributes
    ----------
    A, C : ndarray
        State matrix in continuous time and output matrix of the compared outputs.
    places : tuple of Place
        Ports.
    """

    A: Array
    C: Array
    places: tuple[Place, ...]


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
    """Places found in the matrices of a plain system; None where none can be found."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", RCOWarning)
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

    return Places(
        linear.A,
        linear.C,
        tuple(
            Place(
                port.name, port.kind, states(port.act), states(port.position), states(port.velocity),
                inputs(port.position_input), inputs(port.velocity_input),
                felt(port, physical.output_rate)[rows], port.position_unit, port.velocity_unit,
            )
            for port in physical.ports
        ),
    )  # fmt: skip
