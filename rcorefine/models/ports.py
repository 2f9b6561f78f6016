"""Ports: places in the model with what they sense and where they act."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, NamedTuple

import control as ct
import numpy as np

from ..arguments import as_array, as_flag, as_text, shown
from ..effects.domains import DOMAINS, domain_of
from ..exceptions import ModelError
from ..results import Row
from ..systems.linear import Array, LinearModel

_TEXTS = ("kind", "position_unit", "velocity_unit", "force_unit", "description")
_ARRAYS = ("act", "position", "position_input", "velocity", "velocity_input", "acceleration_input")


@dataclass(frozen=True, slots=True, eq=False)
class Port(Row):
    """A place where a missing effect can sit.

    With the states x and the inputs w of the model the port senses::

        d = position @ x + position_input @ w          displacement
        v = velocity @ x + velocity_input @ w          velocity
        a = velocity @ dx/dt + acceleration_input @ w  acceleration

    and a resisting force f at the port changes the model by
    ``dx/dt += act * f`` and ``y += output * f``. At a ``"first_order"`` port (a level, a
    temperature, a current) there is no displacement, and v is the state
    itself or the difference of two.

    Parameters
    ----------
    name : str
        Name of the place: ``"x1"``, ``"x1-x2"``, ``"link2"``, ``"tank1->tank2"``.
    kind : {"mechanical", "first_order"}
        What v is: the rate of a displacement, or a state.
    act : ndarray of shape (n,)
        Effect of a unit resisting force on the rates of the states: -1/m on the
        moving mass and +1/m on the other end.
    position, velocity : ndarray of shape (n,)
        Rows that read d and v from the states; zero where there is none.
    position_input, velocity_input, acceleration_input : ndarray of shape (n_w,)
        Direct part of the inputs in d, v and a, for example 1 in
        `acceleration_input` where the input is the acceleration of the base and
        the states are relative to the base.
    position_unit, velocity_unit, force_unit : str
        Units, ``""`` where they are unknown.
    description : str
        The place in words.
    modal : bool
        Whether it is a mode, and no place that a force from elsewhere could reach alone.
    output : ndarray of shape (n_y,), optional
        What the sensors read of a unit resisting force beside its effect on the states: 1 for a voltmeter
        across the element, or a load cell in series with it. Nothing by default.

    Raises
    ------
    ModelError
        If the name is empty, the kind is unknown, or a number is not finite.
    control.ControlDimension
        If the rows have different lengths.

    Notes
    -----
    A relative port ``"x1-x2"`` has d = x1 - x2. Link i of a chain has
    d = q_i - q_(i-1), its elongation, so ``link1`` from the ground to mass 1 has
    d = q_1. The last link, from mass n to the ground, has d = q_n: its sense is
    the motion of mass n.

    Examples
    --------
    >>> mass = Port("x1", "mechanical", act=[0.0, -2.0], position=[1.0, 0.0], velocity=[0.0, 1.0])
    >>> mass.is_relative
    False
    """

    # name and rows over the states
    name: str
    kind: str
    act: Array
    position: Array
    velocity: Array
    # rows over the inputs, zero by default
    position_input: Array = ()  # type: ignore[assignment]
    velocity_input: Array = ()  # type: ignore[assignment]
    acceleration_input: Array = ()  # type: ignore[assignment]
    # units and words
    position_unit: str = ""
    velocity_unit: str = ""
    force_unit: str = ""
    description: str = ""
    # modes, and sensors that read the force at once
    modal: bool = False
    output: Array = ()  # type: ignore[assignment]

    def __post_init__(self) -> None:
        if not isinstance(self.name, str) or not self.name:
            raise ModelError(f"the name of a port must be a nonempty str, not {shown(self.name)}")
        as_flag(self.modal, f"modal of port {self.name!r}")
        for key in _TEXTS:
            as_text(getattr(self, key), f"{key} of port {self.name!r}")
        if self.kind not in ("mechanical", "first_order"):
            raise ModelError(
                f"kind of port {self.name!r} must be 'mechanical' or 'first_order', not {self.kind!r}"
            )
        # rows as vectors, read-only
        arrays = {
            key: as_array(getattr(self, key), f"{key} of port {self.name!r}", error=ModelError).reshape(-1)
            for key in (*_ARRAYS, "output")
        }
        # inputs: the longest row counts, empty ones are zero
        n_inputs = max(array.size for key, array in arrays.items() if key.endswith("_input"))
        for key, array in arrays.items():
            size = n_inputs if key.endswith("_input") else arrays["act"].size
            if key.endswith("_input") and array.size == 0:
                array = np.zeros(size)
            if array.size != size and key != "output":
                raise ct.ControlDimension(
                    f"{key} of port {self.name!r} has {array.size} entries, expected {size}"
                )
            array.setflags(write=False)
            object.__setattr__(self, key, array)

    def _restore(self, state: tuple[Any, ...]) -> None:
        # pickling loses the write protection of arrays
        for key, value in zip(self.__slots__, state, strict=True):
            if isinstance(value, np.ndarray):
                value.setflags(write=False)
            object.__setattr__(self, key, value)

    @property
    def has_position(self) -> bool:
        """Return whether a displacement can be read here."""
        return bool(self.position.any() or self.position_input.any())

    @property
    def has_velocity(self) -> bool:
        """Return whether a velocity (first order: a state) can be read here."""
        return bool(self.velocity.any() or self.velocity_input.any())

    @property
    def domain(self) -> str:
        """Domain whose words are used here.

        The unit of the sensed signal determines it. Where that is unknown, the name of the port does
        (``"level1"``, ``"speed"``), or its kind.
        """
        return domain_of(self.kind, self.velocity_unit, self.name)

    @property
    def acts_by(self) -> str:
        """Name of what acts here: a force, a torque, a flow, a heat flow, ..."""
        return DOMAINS[self.domain].get("force", "force")

    @property
    def senses(self) -> tuple[str, str]:
        """Names of the signals that are read here.

        Examples are displacement and velocity, or charge and current.
        """
        words = DOMAINS[self.domain]
        return words.get("moved", "displacement"), words.get("state", "velocity")

    @property
    def is_relative(self) -> bool:
        """Return whether the force acts between two places.

        It then acts on more than one state.
        """
        return bool(np.count_nonzero(self.act) > 1)

    @property
    def units(self) -> dict[str, str]:
        """Units by quantity: position, velocity, force."""
        return {"position": self.position_unit, "velocity": self.velocity_unit, "force": self.force_unit}

    def __str__(self) -> str:
        return f"{self.name} ({self.kind.replace('_', ' ')}): {self.description}"


# Python before 3.11.4 overwrites the method of a frozen dataclass with slots
Port.__setstate__ = Port._restore  # type: ignore[attr-defined]


def felt(port: Port, output_rate: Array) -> Array:
    """Return the sensor readings of a unit resisting force at a port.

    Only the immediate readings count, not those that arise through the states.

    Parameters
    ----------
    port : Port
        Where the force acts.
    output_rate : ndarray of shape (n_y, n)
        What they read of the rates of the states, as in `PhysicalModel`.

    Returns
    -------
    ndarray, shape (n_y,)
    """
    # an accelerometer reads the rates that the force changes
    at_once = output_rate @ port.act
    return at_once + port.output if port.output.size else at_once


def sensor_row(port: Port, *, spring: bool = False) -> Array:
    """Row over states and inputs that a damper senses at a port, or a spring."""
    rows = port.velocity, port.velocity_input
    return np.concatenate((port.position, port.position_input) if spring else rows)


class Element(NamedTuple):
    """A port with its spring and damper, and the two states of a mode."""

    port: Port
    stiffness: float
    damping: float
    states: tuple[int, ...] = ()


def row_of(size: int, entries: Mapping[int, float]) -> Array:
    """Row of zeros but for the given entries."""
    row = np.zeros(size)
    for index, value in entries.items():
        row[index] = value
    return row


def port_at(
    linear: LinearModel,
    name: str,
    description: str,
    act: Array,
    velocity: Mapping[int, float],
    position: Mapping[int, float] | None = None,
    **others: Any,
) -> Port:
    """Return a port whose rows are given by the numbers of the states.

    It is mechanical unless `others` says so; the rows of inputs in `others` are zero by default.
    """
    # rows are zero but for the given states
    n, nothing = linear.n_states, np.zeros(linear.n_inputs)
    rows = {"position": row_of(n, position or {}), "velocity": row_of(n, velocity), "position_input": nothing}
    return Port(
        **{"name": name, "kind": "mechanical", "act": act, "description": description, **rows, **others}
    )
