"""Argument checks of builders, and models written state by state."""

from __future__ import annotations

import numbers
from collections.abc import Mapping, Sequence
from types import MappingProxyType
from typing import Any, NamedTuple

import numpy as np

from ... import arguments
from ...exceptions import ModelError
from ...systems.linear import Array, LinearModel
from ..parameters import NominalParameter
from ..physical_model import PhysicalModel
from ..ports import Port

Row = Mapping[str, float]
#: Arguments `inputs`, `outputs`, `states` and `name` of a builder, as they were given.
Given = tuple[Any, Any, Any, Any]


def as_vector(value: Any, name: str, size: int | None = None, *, positive: bool = True) -> Array:
    """Finite numbers that are positive, or at least not negative."""
    bound = {"above": 0.0} if positive else {"least": 0.0}
    return arguments.as_vector(value, name, size, **bound, error=ModelError)


def as_number(value: Any, name: str, *, positive: bool = True) -> float:
    """Return one finite number that is positive, or at least not negative."""
    return float(as_vector(value, name, 1, positive=positive)[0])


def as_index(value: Any, name: str, size: int) -> int:
    """Number of a mass, node or tank, counted from 1; returned counted from 0."""
    number = arguments.as_whole(value, name, error=ModelError)
    # counted from 1 by the user
    if not 1 <= number <= size:
        raise ModelError(f"{name} = {number} does not exist: there are 1 to {size}")
    return number - 1


def as_indices(value: Any, name: str, of: str, size: int) -> list[int]:
    """Return numbers of masses, nodes or tanks, each once, counted from 0."""
    # one number stands for a list with one entry
    single = isinstance(value, numbers.Number | np.bool_ | str | bytes)
    listed = [value] if single else arguments.as_list(value, name, f"{of}s")
    found = [as_index(item, f"a {of} of {name}", size) for item in listed]
    if len(set(found)) < len(found):
        raise ModelError(f"{name}={value!r} names a {of} twice; give each once")
    return found


def as_sensors(value: Any, choices: Sequence[str]) -> list[str]:
    """Names of sensors out of those that a model can have, each once."""
    asked = list(arguments.as_texts(value, "sensors"))
    if not asked:
        raise ModelError(f"sensors is empty; give at least one of {', '.join(choices)}")
    for sensor in asked:
        arguments.as_choice(sensor, "a sensor", choices)
    refuse_twice(asked)
    return asked


def refuse_twice(labels: Sequence[str]) -> None:
    """Check that each sensor is named once."""
    for label in labels:
        if labels.count(label) > 1:
            raise ModelError(f"sensor {label} is asked for more than once; name each sensor once")


def total(*terms: tuple[float, Row]) -> dict[str, float]:
    """Weighted sum of rows."""
    # factors times rows, label by label
    found: dict[str, float] = {}
    for factor, row in terms:
        for label, value in row.items():
            found[label] = found.get(label, 0.0) + factor * value
    return found


def built(
    matrices: tuple[Array, Array],
    readout: tuple[Array, Array, Array],
    given: Given,
    *,
    units: Sequence[Mapping[str, str]],
    ports: Sequence[Port],
    parameters: Sequence[NominalParameter],
) -> PhysicalModel:
    """Return the physical model of these matrices, places and parameters.

    Its outputs are ``state @ x + rate @ dx/dt + direct @ w``. `units` holds those of the inputs, the
    outputs and the states by the labels that are used where the user gave none.
    """
    (A, B), (state, rate, direct) = matrices, readout
    # labels of the user, else the default ones
    inputs, outputs, states = (
        arguments.as_labels(own, what, tuple(default), error=ModelError)
        for own, what, default in zip(given, ("inputs", "outputs", "states"), units, strict=False)
    )
    name = arguments.as_text(given[3], "name")
    # y = state x + rate dx/dt + direct w, with dx/dt = A x + B w
    linear = LinearModel(A, B, state + rate @ A, direct + rate @ B, 0, inputs, outputs, states, name)
    entry, read, state_units = (tuple(each.values()) for each in units)
    return PhysicalModel(
        linear, state, rate, direct, tuple(ports), tuple(parameters), entry, read, state_units
    )


class Reading(NamedTuple):
    """An output by the labels of states and inputs, and of rates of states."""

    unit: str
    row: Row
    rate: Row = MappingProxyType({})


class BuilderEquations(NamedTuple):
    """State equations: ``rates[i][j]`` multiplies the state or input j.

    `states` and `inputs` hold units. Labels that are no signal of the model drop out of a row.
    """

    rates: Mapping[str, Row]
    states: Mapping[str, str]
    inputs: Mapping[str, str]

    def rows(self, *entries: Row) -> tuple[Array, Array]:
        """Rows over the states and over the inputs."""
        # labels that are no signal of the model drop out
        states, inputs = (
            np.array([[row.get(label, 0.0) for label in labels] for row in entries])
            for labels in (self.states, self.inputs)
        )
        return states, inputs

    def port(
        self,
        name: str,
        description: str,
        act: Row,
        velocity: Row,
        position: Row | None = None,
        *,
        units: Sequence[str],
        **others: Any,
    ) -> Port:
        """Return a port by labels.

        It is mechanical if it has a displacement.
        """
        # force, velocity and position of the port, by states and by inputs
        states, inputs = self.rows(act, velocity, position or {})
        return Port(
            name,
            "first_order" if position is None else "mechanical",
            act=states[0],
            velocity=states[1],
            velocity_input=inputs[1],
            position=states[2],
            position_input=inputs[2],
            position_unit=units[0],
            velocity_unit=units[1],
            force_unit=units[2],
            description=description,
            **others,
        )

    def build(
        self,
        readings: Mapping[str, Reading],
        ports: Sequence[Port],
        parameters: Sequence[NominalParameter],
        given: Given,
    ) -> PhysicalModel:
        """Physical model of these equations."""
        # outputs read states and inputs, or rates of states
        state, direct = self.rows(*(reading.row for reading in readings.values()))
        rate, _ = self.rows(*(reading.rate for reading in readings.values()))
        units = self.inputs, {label: reading.unit for label, reading in readings.items()}, self.states
        # one row of A and B for each state
        matrices = self.rows(*(self.rates[label] for label in self.states))
        return built(matrices, (state, rate, direct), given, units=units, ports=ports, parameters=parameters)
