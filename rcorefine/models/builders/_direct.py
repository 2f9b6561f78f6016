"""Models written as first-order equations, state by state."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from ...systems.linear import Array
from ..parameters import NominalParameter
from ..physical_model import PhysicalModel
from ..ports import Port
from ._model import Given, built

Row = Mapping[str, float]


@dataclass(frozen=True, slots=True, eq=False)
class Reading:
    """An output: y = state @ x + rate @ dx/dt + direct @ w, by labels."""

    label: str
    unit: str
    state: Row
    rate: Row
    direct: Row


@dataclass(frozen=True, slots=True, eq=False)
class Equations:
    """State equations by label.

    ``rates[i][j]`` multiplies the state or the input j.
    """

    states: tuple[str, ...]
    inputs: tuple[str, ...]
    rates: Mapping[str, Row]

    def row(self, entries: Row, labels: Sequence[str]) -> Array:
        """Vector in the order of `labels`."""
        vector = np.zeros(len(labels))
        for label, value in entries.items():
            vector[labels.index(label)] = value
        return vector

    def port(
        self,
        name: str,
        kind: str,
        *,
        act: Row,
        velocity: Row,
        position: Row | None = None,
        units: tuple[str, str, str],
        description: str,
    ) -> Port:
        """Port by labels; `position` and `velocity` may name states and inputs."""
        states, inputs = self.states, self.inputs
        parts: dict[str, Array] = {}
        for key, entries in (("position", position or {}), ("velocity", velocity)):
            for suffix, labels in (("", states), ("_input", inputs)):
                own = {label: value for label, value in entries.items() if label in labels}
                parts[key + suffix] = self.row(own, labels)
        return Port(
            name,
            kind,
            act=self.row(act, states),
            position=parts["position"],
            position_input=parts["position_input"],
            velocity=parts["velocity"],
            velocity_input=parts["velocity_input"],
            position_unit=units[0],
            velocity_unit=units[1],
            force_unit=units[2],
            description=description,
        )

    def build(
        self,
        readings: Sequence[Reading],
        ports: Sequence[Port],
        parameters: Sequence[NominalParameter],
        given: Given,
        *,
        input_units: Sequence[str],
        state_units: Sequence[str],
    ) -> PhysicalModel:
        """Physical model of these equations."""
        states, inputs = self.states, self.inputs
        A = np.zeros((len(states), len(states)))
        B = np.zeros((len(states), len(inputs)))
        for i, rated in enumerate(states):
            for label, value in self.rates.get(rated, {}).items():
                if label in states:
                    A[i, states.index(label)] += value
                else:
                    B[i, inputs.index(label)] += value
        state = np.array([self.row(item.state, states) for item in readings])
        rate = np.array([self.row(item.rate, states) for item in readings])
        direct = np.array([self.row(item.direct, inputs) for item in readings])
        direct = direct.reshape(len(readings), len(inputs))
        return built(
            A, B, (state, rate, direct), given,
            labels=(inputs, [item.label for item in readings], states),
            units=(input_units, [item.unit for item in readings], state_units),
            ports=ports, parameters=parameters,
        )  # fmt: skip
