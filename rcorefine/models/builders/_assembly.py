"""M q'' + C q' + K q = F w with its places, inputs and sensors."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import control as ct
import numpy as np

from ...arguments import as_array, as_choice, as_text, shown
from ...exceptions import ModelError
from ...systems.linear import Array
from ..parameters import NominalParameter, combine_units
from ..physical_model import PhysicalModel
from ..ports import Port
from ._equations import Given, as_index, as_indices, built, refuse_twice

_SENSORS = "a quantity, a pair (quantity, mass) or a list of these"
Units = dict[str, str]  # of motions, force and coefficients by name
_LETTER = {"displacement": "q", "velocity": "v", "acceleration": "a", "force": "f"}


class Place(NamedTuple):
    """A direction in the space of the displacements, d = direction @ q.

    A place of a mass (`absolute`) moves with the base where that is excited, one
    between two masses or between a mass and the base does not.
    """

    name: str
    direction: Array
    description: str
    absolute: bool


class Sensor(NamedTuple):
    """Sensor of motions and inputs, and possibly of the force at a place.

    Without that force, y = motion[0] @ q + motion[1] @ q' + motion[2] @ q'' + direct @ w.
    """

    unit: str
    motion: Array
    direct: Array
    reads: str = ""


def units_of(position: str, force: str) -> Units:
    """Units that follow from those of displacement and force."""
    given = {"position": as_text(position, "position_unit"), "force": as_text(force, "force_unit")}
    rules = {
        "displacement": "position",
        "velocity": "position/s",
        "acceleration": "position/s^2",
        "stiffness": "force/position",
        "damping": "force s/position",
        "mass": "force s^2/position",
    }
    return given | {key: combine_units(rule, given) for key, rule in rules.items()}


class InputMap(NamedTuple):
    """Inputs: columns of F, 1 for a base acceleration, and units by label."""

    force: Array
    base: Array
    inputs: Mapping[str, str]


class BuilderArguments(NamedTuple):
    """Arguments of both builders beside the matrices, as they were given.

    `forces` is the name of the argument that holds `force`.
    """

    excitation: Any
    forces: str
    force: Any
    sensors: Any
    units: Units
    given: Given


def assembled(
    structure: tuple[Array, Array, Array],
    places: Sequence[Place],
    parameters: Sequence[NominalParameter],
    options: BuilderArguments,
) -> PhysicalModel:
    """Return the physical model of M, C and K with these places."""
    # inputs, then sensors, then the equations
    drive = input_map(options, structure[0])
    by_name = {place.name: place for place in places}
    found = parse_sensors(options, len(drive.force), by_name, drive.base, parameters)
    return second_order(structure, drive, places, found, parameters, options)


def second_order(
    structure: tuple[Array, Array, Array],
    drive: InputMap,
    places: Sequence[Place],
    sensors: Mapping[str, Sensor],
    parameters: Sequence[NominalParameter],
    options: BuilderArguments,
    letters: tuple[str, str] = ("q", "v"),
) -> PhysicalModel:
    """Return M q'' + C q' + K q = F w, in the coordinates (q, q').

    The column of a base acceleration (1 in `base`) is -M 1. States are named by letter and number.
    """
    (M, C, K), (F, base, inputs) = structure, drive
    n, units, rows = len(M), options.units, list(sensors.values())
    # directions of the places; a resisting force enters along each, with a minus sign
    G = np.column_stack([place.direction for place in places])
    # one factorization of M for all places
    solved = np.linalg.solve(M, np.hstack([K, C, F, G]))
    K, C, F, moved = np.split(solved, [n, 2 * n, 2 * n + F.shape[1]], axis=1)
    moved[np.abs(moved) <= 1e-14 * np.abs(moved).max(axis=0)] = 0.0
    # x = [q; q']: q'' = -M^-1 (K q + C q') + M^-1 F w
    A = np.block([[np.zeros((n, n)), np.eye(n)], [-K, -C]])
    B = np.vstack([np.zeros_like(F), F])
    # base excitation: exactly -1 without the rounding of the solver
    B[n:, base > 0] = -1.0
    motion = np.array([s.motion for s in rows])
    # sensors: displacement and velocity by the states, acceleration by their rates
    state, rate = motion[:, :2].reshape(-1, 2 * n), np.hstack([0.0 * motion[:, 2], motion[:, 2]])
    direct = np.array([s.direct for s in rows])
    states = {
        f"{letter}{i + 1}": units[kind]
        for letter, kind in zip(letters, ("position", "velocity"), strict=True)
        for i in range(n)
    }
    # load cells read the force of an effect at their place at once
    metered, nothing = any(s.reads for s in rows), np.zeros(n)
    ports = [
        Port(
            place.name,
            "mechanical",
            act=np.concatenate([nothing, -column]),
            position=np.concatenate([place.direction, nothing]),
            velocity=np.concatenate([nothing, place.direction]),
            acceleration_input=base * place.direction.sum() * place.absolute,
            position_unit=units["position"],
            velocity_unit=units["velocity"],
            force_unit=units["force"],
            description=place.description,
            output=np.array([float(s.reads == place.name) for s in rows] if metered else []),
        )
        for place, column in zip(places, moved.T, strict=True)
    ]
    signals = inputs, {label: s.unit for label, s in sensors.items()}, states
    readout = state, rate, direct
    return built((A, B), readout, options.given, units=signals, ports=ports, parameters=parameters)


def parse_sensors(
    options: BuilderArguments,
    size: int,
    places: Mapping[str, Place],
    base: Array,
    parameters: Sequence[NominalParameter] = (),
) -> dict[str, Sensor]:
    """Return sensors by label, from ``("velocity", 1)`` or a list of such.

    A place may be the number of a mass, a list of numbers, or the name of a place
    (``("displacement", "link2")`` measures an elongation, ``("force", "link2")`` what its spring and damper
    among the `parameters` hold).
    """
    found: list[tuple[str, Sensor]] = []
    # one sensor for each pair of quantity and place
    for quantity, where in _requests(options.sensors, size):
        as_choice(quantity, "the quantity of a sensor", tuple(_LETTER))
        if isinstance(where, str):
            if where not in places:
                raise ModelError(f"sensor at {where!r}: no such place, only {', '.join(places)}")
            direction, absolute = places[where].direction, places[where].absolute
            label = f"{_LETTER[quantity]}_{where}"
        else:
            mass = as_index(where, "the mass of a sensor", size)
            direction, absolute, label = np.eye(size)[mass], True, f"{_LETTER[quantity]}{where}"
        # a load cell reads k d + c d', another sensor its quantity
        gains = _load_cell_gains(where, parameters) if quantity == "force" else {quantity: 1.0}
        motion = np.outer([gains.get(key, 0.0) for key in _LETTER if key != "force"], direction)
        # displacements and velocities are relative to the base, accelerations absolute
        felt = base * direction.sum() * (quantity == "acceleration" and absolute)
        unit, reads = options.units[quantity], where if quantity == "force" else ""
        found.append((label, Sensor(unit, motion, felt, reads)))
    if not found:
        raise ModelError('sensors is empty; give at least one, for example sensors=("velocity", 1)')
    refuse_twice([label for label, _ in found])
    return dict(found)


def _load_cell_gains(where: Any, parameters: Sequence[NominalParameter]) -> dict[str, float]:
    """Return what a load cell in series with spring and damper reads."""
    # stiffness and damping that the parameters have at this place
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
    return {"displacement": k, "velocity": c}


def _requests(sensors: Any, size: int, *, nested: bool = False) -> list[tuple[str, Any]]:
    if isinstance(sensors, str):
        return [(sensors, number) for number in range(1, size + 1)]
    if not isinstance(sensors, Sequence):
        raise ct.ControlArgument(f"sensors must be {_SENSORS}, not {shown(sensors)}")
    # a pair (quantity, place or places), else a list of requests
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


def input_map(options: BuilderArguments, M: Any) -> InputMap:
    """Return how the inputs act on masses with the matrix M."""
    force, size, units, what = options.force, M.shape[0], options.units, options.forces
    base = as_choice(options.excitation, "excitation", ("force", "base")) == "base"
    matrix, numbers = np.zeros((size, 0)), []
    # F as a matrix, or the numbers of the masses that a force acts on
    rows = isinstance(force, list | tuple) and any(isinstance(row, list | tuple) for row in force)
    if rows or (isinstance(force, np.ndarray) and force.ndim == 2):
        matrix = _force_matrix(force, what, size)
        numbers = list(range(matrix.shape[1]))
    elif force is not None or not base:
        numbers = as_indices(1 if force is None else force, what, "mass", size)
        matrix = np.eye(size)[:, numbers]
    labels = ["force"] if len(numbers) == 1 else [f"force{i + 1}" for i in numbers]
    # an input with other entries than 0, 1 and -1 need not be a force
    known = [bool(np.isin(np.abs(column), (0.0, 1.0)).all()) for column in matrix.T]
    inputs = {label: units["force"] * plain for label, plain in zip(labels, known, strict=True)}
    if base:
        # in coordinates relative to the base its acceleration acts as the force -M 1 on the masses
        matrix = np.hstack([-M @ np.ones((size, 1)), matrix])
        inputs = {"base_acceleration": units["acceleration"], **inputs}
    return InputMap(matrix, np.array([float(label == "base_acceleration") for label in inputs]), inputs)


def _force_matrix(force: Any, what: str, size: int) -> Array:
    """Return the matrix by which inputs act on masses, checked."""
    # each column is one input
    matrix = as_array(force, what, error=ModelError)
    if matrix.ndim != 2 or matrix.shape[0] != size:
        raise ct.ControlDimension(
            f"{what} has {matrix.shape[0]} rows for {size} masses; "
            "each column tells how one input acts on the masses"
        )
    if not matrix.any(axis=0).all():
        raise ModelError(f"{what}: input {int(np.argmin(matrix.any(axis=0))) + 1} acts on no mass")
    return matrix
