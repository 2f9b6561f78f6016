"""Sensors and inputs of mechanical models, from what a user writes."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import control as ct
import numpy as np

from ...arguments import as_array, as_choice, shown
from ...exceptions import ModelError
from ...systems.linear import Array
from ..parameters import NominalParameter
from ._assembly import Place, Sensor, Units, unit_vector
from ._checks import as_index, as_several

_SENSORS = "a quantity, a pair (quantity, mass) or a list of these"
QUANTITIES = ("displacement", "velocity", "acceleration")
_LETTER = {"displacement": "q", "velocity": "v", "acceleration": "a", "force": "f"}


def parse_sensors(
    sensors: Any,
    size: int,
    places: Mapping[str, Place],
    base: Array,
    units: Units,
    parameters: Sequence[NominalParameter] = (),
) -> list[Sensor]:
    """Sensors from ``"velocity"``, ``("velocity", 1)`` or a list of such.

    A place may be the number of a mass, a list of numbers, or the name of a place
    (``("displacement", "link2")`` measures an elongation, ``("force", "link2")`` what its spring and damper
    among the `parameters` hold).
    """
    found: list[Sensor] = []
    for quantity, where in _requests(sensors, size):
        as_choice(quantity, "the quantity of a sensor", tuple(_LETTER))
        if isinstance(where, str):
            if where not in places:
                raise ModelError(f"sensor at {where!r}: no such place, only {', '.join(places)}")
            direction, absolute = places[where].direction, places[where].absolute
            label = f"{_LETTER[quantity]}_{where}"
        else:
            mass = as_index(where, "the mass of a sensor", size)
            direction, absolute, label = unit_vector(size, (mass, 1.0)), True, f"{_LETTER[quantity]}{where}"
        rows = {key: direction if key == quantity else np.zeros(size) for key in QUANTITIES}
        if quantity == "force":
            rows |= _held(where, direction, parameters)
        # displacements and velocities are relative to the base, an accelerometer feels it
        felt = quantity == "acceleration" and absolute
        found.append(
            Sensor(
                label,
                units.of(quantity),
                rows["displacement"],
                rows["velocity"],
                rows["acceleration"],
                base * direction.sum() if felt else 0.0 * base,
                where if quantity == "force" else "",
            )
        )
    if not found:
        raise ModelError('sensors is empty; give at least one, for example sensors=("velocity", 1)')
    labels = [sensor.label for sensor in found]
    for label in labels:
        if labels.count(label) > 1:
            raise ModelError(f"sensor {label} is asked for more than once; name each sensor once")
    return found


def _held(where: Any, direction: Array, parameters: Sequence[NominalParameter]) -> dict[str, Array]:
    """Rows of a load cell in series with the spring and the damper of a link."""
    k, c = (
        sum(q.value for q in parameters if (q.kind, q.place) == (kind, where))
        for kind in ("stiffness", "damping")
    )
    if not k and not c:
        links = {q.place for q in parameters if q.value and q.kind in ("stiffness", "damping")}
        raise ModelError(
            f"a load cell at {where!r} would read nothing, since no spring or damper is known there; "
            f"they are at {', '.join(sorted(links)) or 'no place'}"
        )
    return {"displacement": k * direction, "velocity": c * direction}


def _requests(sensors: Any, size: int, *, nested: bool = False) -> list[tuple[str, Any]]:
    if isinstance(sensors, str):
        return [(sensors, number) for number in range(1, size + 1)]
    if not isinstance(sensors, Sequence):
        raise ct.ControlArgument(f"sensors must be {_SENSORS}, not {shown(sensors)}")
    pair = len(sensors) == 2 and isinstance(sensors[0], str) and not _is_request(sensors[1])
    if pair:
        where = sensors[1]
        several = isinstance(where, Sequence) and not isinstance(where, str)
        return [(sensors[0], item) for item in (where if several else [where])]
    if nested:
        raise ct.ControlArgument(f"sensors must be {_SENSORS}; a list in the list is {shown(sensors)}")
    return [request for item in sensors for request in _requests(item, size, nested=True)]


def _is_request(item: Any) -> bool:
    """Return whether an item is a sensor of its own, not a place."""
    first = item if isinstance(item, str) else item[0] if isinstance(item, Sequence) and item else None
    return isinstance(first, str) and first in _LETTER


def parse_force(force: Any, size: int) -> tuple[Array, list[str]]:
    """Return the map from inputs to masses, and the labels of the inputs.

    `force` holds the numbers of the masses, or it is the matrix of the map.
    """
    if isinstance(force, np.ndarray) and force.ndim == 2:
        matrix = as_array(force, "the map of the forces", error=ModelError)
        if matrix.shape[0] != size:
            raise ct.ControlDimension(
                f"the map of the forces has {matrix.shape[0]} rows for {size} masses; "
                "each column tells how one input acts on the masses"
            )
        if not matrix.any(axis=0).all():
            raise ModelError(
                f"input {int(np.argmin(matrix.any(axis=0))) + 1} of the map of the forces acts on no mass"
            )
        count = matrix.shape[1]
        return matrix, ["force"] if count == 1 else [f"force{j + 1}" for j in range(count)]
    masses = as_several(force, "force", "numbers of masses")
    columns = [as_index(mass, "the mass that a force acts on", size) for mass in masses]
    if len(set(columns)) != len(columns):
        raise ModelError(f"force={force!r} names a mass twice; one input per mass is enough")
    matrix = np.zeros((size, len(columns)))
    for j, i in enumerate(columns):
        matrix[i, j] = 1.0
    return matrix, ["force"] if len(columns) == 1 else [f"force{i + 1}" for i in columns]


def input_map(
    excitation: str, force: Any, M: Any, units: Units
) -> tuple[Array, Array, list[str], tuple[str, ...]]:
    """Columns of F, base flags, labels and units of the inputs."""
    as_choice(excitation, "excitation", ("force", "base"))
    size = M.shape[0]
    matrix, labels = np.zeros((size, 0)), list[str]()
    if excitation == "force" or force is not None:
        matrix, labels = parse_force(1 if force is None else force, size)
    base = np.zeros(len(labels))
    kinds = [units.of("force")] * len(labels)
    if excitation == "base":
        matrix = np.hstack([-M @ np.ones((size, 1)), matrix])
        base = np.concatenate([[1.0], base])
        labels, kinds = ["base_acceleration", *labels], [units.of("acceleration"), *kinds]
    return matrix, base, labels, tuple(kinds)
