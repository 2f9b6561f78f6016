"""M q'' + C q' + K q = F w, put together with its places and sensors."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from ...systems.linear import Array
from ..parameters import NominalParameter
from ..physical_model import PhysicalModel
from ..ports import Port
from ..units import combine_units
from ._model import Given, built


@dataclass(frozen=True, slots=True, eq=False)
class Place:
    """A direction in the space of the displacements, d = direction @ q.

    A place of a mass (`absolute`) moves with the base where that is excited, one
    between two masses or between a mass and the base does not.
    """

    name: str
    direction: Array
    description: str
    absolute: bool


@dataclass(frozen=True, slots=True, eq=False)
class Sensor:
    """Sensor of motions and inputs, and possibly of the force at a place.

    Without that force, y = displacement @ q + velocity @ q' + acceleration @ q'' + direct @ w.
    """

    label: str
    unit: str
    displacement: Array
    velocity: Array
    acceleration: Array
    direct: Array
    reads: str = ""


@dataclass(frozen=True, slots=True)
class Units:
    """Units of displacement and force; the others follow."""

    position: str = "m"
    force: str = "N"
    velocity: str = field(default="")
    acceleration: str = field(default="")

    def of(self, quantity: str) -> str:
        """Unit of displacement, velocity, acceleration or force."""
        if quantity == "velocity":
            return self.velocity or combine_units("position/s", {"position": self.position})
        if quantity == "acceleration":
            return self.acceleration or combine_units("position/s^2", {"position": self.position})
        return self.force if quantity == "force" else self.position

    def coefficient(self, kind: str) -> str:
        """Unit of a stiffness, a damping or a mass."""
        rule = {"stiffness": "force/position", "damping": "force/velocity", "mass": "force s/velocity"}
        units = {"position": self.position, "velocity": self.of("velocity"), "force": self.force}
        return combine_units(rule[kind], units)


@dataclass(frozen=True, slots=True, eq=False)
class SecondOrder:
    """M q'' + C q' + K q = F w - M 1 w_base, in the coordinates (q, q')."""

    M: Array
    C: Array
    K: Array
    force: Array  # (n, n_w), the column of a base acceleration is -M @ 1
    base: Array  # (n_w,), 1 for the input that is the base acceleration
    units: Units

    @property
    def size(self) -> int:
        """Number of displacements."""
        return int(self.M.shape[0])

    def build(
        self,
        places: Sequence[Place],
        sensors: Sequence[Sensor],
        parameters: Sequence[NominalParameter],
        given: Given,
        *,
        inputs: Sequence[str],
        input_units: Sequence[str],
        letters: tuple[str, str] = ("q", "v"),
    ) -> PhysicalModel:
        """Return the physical model with these places, sensors and parameters.

        States are named by letter and number.
        """
        n, n_w = self.size, self.force.shape[1]
        solved = np.linalg.solve(self.M, np.hstack([self.K, self.C, self.force]))
        A = np.zeros((2 * n, 2 * n))
        A[:n, n:] = np.eye(n)
        A[n:, :n], A[n:, n:] = -solved[:, :n], -solved[:, n : 2 * n]
        B = np.vstack([np.zeros((n, n_w)), solved[:, 2 * n :]])
        # a rigid row of M^-1 M 1 is one; the solver may leave it off by rounding
        B[n:, self.base > 0] = -1.0
        state = np.array([np.concatenate([item.displacement, item.velocity]) for item in sensors])
        rate = np.array([np.concatenate([np.zeros(n), item.acceleration]) for item in sensors])
        direct = np.array([item.direct for item in sensors]).reshape(len(sensors), n_w)
        states = [f"{letter}{i + 1}" for letter in letters for i in range(n)]
        return built(
            A, B, (state, rate, direct), given,
            labels=(inputs, [item.label for item in sensors], states),
            units=(
                input_units,
                [item.unit for item in sensors],
                [self.units.of("position")] * n + [self.units.of("velocity")] * n,
            ),
            ports=self._ports(places, sensors), parameters=parameters,
        )  # fmt: skip

    def _ports(self, places: Sequence[Place], sensors: Sequence[Sensor]) -> tuple[Port, ...]:
        """Ports, with one factorization of M for all: a long chain has thousands."""
        if not places:
            return ()
        moved = np.linalg.solve(self.M, np.column_stack([place.direction for place in places]))
        metered = any(sensor.reads for sensor in sensors)
        return tuple(
            self._port(place, column, [float(s.reads == place.name) for s in sensors] if metered else ())
            for place, column in zip(places, moved.T, strict=True)
        )

    def _port(self, place: Place, moved: Array, output: Sequence[float]) -> Port:
        nothing = np.zeros(self.size)
        moved[np.abs(moved) <= 1e-14 * np.abs(moved).max()] = 0.0
        return Port(
            place.name,
            "mechanical",
            act=np.concatenate([nothing, -moved]),
            position=np.concatenate([place.direction, nothing]),
            position_input=np.zeros_like(self.base),
            velocity=np.concatenate([nothing, place.direction]),
            acceleration_input=self.base * place.direction.sum() if place.absolute else 0.0 * self.base,
            position_unit=self.units.of("position"),
            velocity_unit=self.units.of("velocity"),
            force_unit=self.units.of("force"),
            description=place.description,
            output=np.array(output),
        )


def unit_vector(size: int, *entries: tuple[int, float]) -> Array:
    """Vector of zeros but for the given entries."""
    vector = np.zeros(size)
    for index, value in entries:
        vector[index] = value
    return vector


def parameters_of(
    letter: str, kind: str, values: Array, places: Sequence[str], units: Units
) -> list[NominalParameter]:
    """Nominal parameters ``k1, k2, ...``, those of value zero included."""
    unit = units.coefficient(kind)
    return [
        NominalParameter(f"{letter}{number}", value, unit, kind, place)
        for number, (value, place) in enumerate(zip(values.tolist(), places, strict=True), start=1)
    ]
