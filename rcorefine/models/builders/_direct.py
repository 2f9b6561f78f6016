"""Models written as first-order equations, state by state."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from ...systems.linear import Array, LinearModel
from ..parameters import NominalParameter
from ..physical_model import PhysicalModel
from ..ports import Port

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
    """State equations by label: rates[i][j] multiplies the state or the input j."""

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
            acceleration_input=np.zeros(len(inputs)),
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
        *,
        labels: tuple[tuple[str, ...], tuple[str, ...], tuple[str, ...]],
        input_units: tuple[str, ...],
        state_units: tuple[str, ...],
        name: str,
    ) -> PhysicalModel:
        """Physical model; `labels` are those to show for inputs, outputs and states."""
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
        linear = LinearModel(
            A=A,
            B=B,
            C=state + rate @ A,
            D=direct + rate @ B,
            dt=0,
            input_labels=labels[0],
            output_labels=labels[1],
            state_labels=labels[2],
            name=name,
        )
        return PhysicalModel(
            linear=linear,
            output_state=state,
            output_rate=rate,
            output_input=direct,
            ports=tuple(ports),
            parameters=tuple(parameters),
            input_units=input_units,
            output_units=tuple(item.unit for item in readings),
            state_units=state_units,
        )
