"""Ports of a plain StateSpace: masses, springs and stores in its matrices."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import control as ct
import numpy as np

from ..effects.dampers import Damping
from ..effects.entries import Entry
from ..effects.input_path import InputGain
from ..effects.springs import Stiffness
from ..exceptions import ModelError
from ..systems.conversion import d2c
from ..systems.discretization import check_sampling_time
from ..systems.linear import Array, LinearModel
from .displacements import Displacement, find_displacements, is_companion
from .link_ports import Declared, find_links, row_of
from .masses import MassScale, exchanging, relative_masses
from .modes import find_modes
from .parameters import NominalParameter
from .ports import Port
from .readout import find_rate_sensors, read_parameters

__all__ = ["displacement_port", "find_meters", "find_ports", "read_weights", "recognized"]

_SAME = 1e-6  # relative misfit of numbers that are the same
_ANONYMOUS = re.compile(r"x\[\d+\]")


def find_meters(
    linear: LinearModel,
    rate: Array,
    ports: Sequence[Port],
    parameters: Sequence[NominalParameter],
) -> tuple[Array, tuple[Port, ...], tuple[NominalParameter, ...]]:
    """Find the sensors that read the force at a port.

    The remaining accelerometers are returned as well.

    Parameters
    ----------
    linear : LinearModel
        Continuous-time model.
    rate : ndarray of shape (n_y, n)
        What its outputs may read of rates of velocity states.
    ports : sequence of Port
        Its places.
    parameters : sequence of NominalParameter
        Its springs and dampers.

    Returns
    -------
    rate : ndarray of shape (n_y, n)
        With zero rows for sensors that read a force.
    ports : tuple of Port
        With what the sensors read of a force there. A force at a single mass may act beside the cell: where
        the port holds one, a port ``"x1 (cell)"`` stands for what the sensor ``"cell"``, and any other at the
        same place, reads.
    parameters : tuple of NominalParameter
        Springs and dampers at the ports that hold them.

    Notes
    -----
    A row of C reads the force in a link if it is k d + c v with the k and c that A has there. One number
    alone could as well be the gain of a sensor: it must be the same, no power of ten, and the states must
    bear names, for a transfer function of unit gain looks like that.
    An accelerometer at a mass that only that link holds reads the same force over the mass.
    """
    found, moved, rate = list(ports), list(parameters), rate.copy()
    cells: dict[str, str] = {}  # by the port of a single mass that they stand beside
    if is_companion(linear.A, 1e-9):
        return rate, tuple(found), tuple(moved)
    for y, label in enumerate(linear.output_labels):
        if np.count_nonzero(rate[y]) == 1 and np.isclose(np.abs(rate[y]).max(), 1.0, rtol=_SAME):
            continue
        row = np.concatenate([linear.C[y], linear.D[y]])
        read = [(p, scale) for p in ports if (scale := _scale(linear, row, p, parameters))]
        if len(read) != 1 or (rate[y].any() and abs(read[0][1]) != 1.0):
            continue
        port, scale = read[0]
        rate[y] = 0.0
        felt = np.zeros(linear.n_outputs)
        felt[y] = scale
        name = port.name if np.count_nonzero(port.act) > 1 else cells.get(port.name, "")
        if name:
            at = next(i for i, other in enumerate(found) if other.name == name)
            known = found[at].output
            found[at] = replace(found[at], output=felt + (known if known.size else 0.0))
            continue
        cell = replace(
            port,
            name=f"{port.name} ({label})",
            output=felt,
            description=f"{port.description}; its force is read by {label}",
        )
        cells[port.name] = cell.name
        found.insert(1 + next(i for i, other in enumerate(found) if other.name == port.name), cell)
        moved = [replace(q, place=cell.name) if q.place == port.name else q for q in moved]
    return rate, tuple(found), tuple(moved)


def _scale(linear: LinearModel, row: Array, port: Port, parameters: Sequence[NominalParameter]) -> float:
    """Return the reading of a unit force at a port in an output row.

    It is 0 if the row does not read that force.
    """
    k, c = (
        sum(q.value for q in parameters if q.kind == kind and q.place == port.name)
        for kind in (Stiffness.name, Damping.name)
    )
    force = k * np.concatenate([port.position, port.position_input])
    force = force + c * np.concatenate([port.velocity, port.velocity_input])
    if port.modal or not force.any() or not row.any():
        return 0.0
    scale = float(row @ force / (force @ force))
    # entry by entry: a spring in N/m and a damper in N s/m have no common size
    if np.any(np.abs(row - scale * force) > _SAME * np.maximum(np.abs(row), np.abs(scale * force))):
        return 0.0
    if abs(abs(scale) - 1.0) <= _SAME:
        scale = float(np.sign(scale))
    named = not any(_ANONYMOUS.fullmatch(label) for label in linear.state_labels)
    if k and c:
        return scale if named or linear.n_states > 2 else 0.0
    decades = np.log10(abs(k or c))
    return scale if abs(scale) == 1.0 and named and abs(decades - round(decades)) > _SAME else 0.0


_MOST = 60
_LEFT = 1e-9  # relative size of what cancellation leaves behind
_ALONG = 1e-6  # of the cosine between two directions that are one: four digits of their entries are kept


def read_weights(
    linear: LinearModel,
    rate: Array,
    ports: Sequence[Port],
    tolerance: float,
) -> list[NominalParameter]:
    """Entries of B, C and D that are numbers of the plant.

    Parameters
    ----------
    linear : LinearModel
        Continuous-time model.
    rate : ndarray, shape (n_y, n)
        What its outputs read of rates (accelerometers), which is taken off C and D.
    ports : sequence of Port
        Its places; what a sensor reads of a force there is no weight.
    tolerance : float
        Relative size below which an entry counts as zero.

    Returns
    -------
    list of NominalParameter
        Not listed is a weight of one, which is how a signal is mounted; a single one of its input or
        output, which is a gain; and those of an input that is a force at a port, which masses divide.
        Empty where there are more than 60: shapes of many modes, not numbers that somebody measured.
    """
    whole = np.hstack([linear.C, linear.D])
    rest = whole - rate @ np.hstack([linear.A, linear.B])
    rest[np.abs(rest) <= _LEFT * np.abs(whole)] = 0.0
    mixed = np.abs(rest) > tolerance * np.abs(rest).max(axis=1, keepdims=True, initial=0.0)
    mixed[[y for port in ports for y in np.flatnonzero(port.output)]] = False
    mixed[(mixed.sum(axis=1) == 1) & mixed[:, : linear.n_states].any(axis=1)] = False

    driven = np.abs(linear.B) > tolerance * np.abs(linear.B).max(axis=0, initial=0.0)
    driven[[item.state for item in find_displacements(linear, tolerance)]] = False  # kinematics
    driven[:, driven.sum(axis=0) == 1] = False
    driven[:, [_enters(linear.B[:, j], ports) for j in range(linear.n_inputs)]] = False

    found = []
    n = linear.n_states
    for name, values, which in (
        ("B", linear.B, driven),
        ("C", rest[:, :n], mixed[:, :n]),
        ("D", rest[:, n:], mixed[:, n:]),
    ):
        for i, j in np.argwhere(which & (np.abs(np.abs(values) - 1.0) > tolerance)).tolist():
            place = f"{name}[{i},{j}]"
            found.append(NominalParameter(place, float(values[i, j]), "", Entry.name, place, False))
    return found if len(found) <= _MOST else []


def _enters(column: Array, ports: Sequence[Port]) -> bool:
    """Return whether an input acts like the force of a port."""
    size = float(np.linalg.norm(column))
    acts = [port.act / np.linalg.norm(port.act) for port in ports if port.act.any()]
    return size > 0 and any(abs(act @ column) > (1 - _ALONG) * size for act in acts)


def recognized(sys: ct.StateSpace, dt: float | None, declared: Declared | None = None) -> dict[str, Any]:
    """Return the arguments of a `PhysicalModel`, found in a plain model.

    See `PhysicalModel.from_statespace`.
    """
    linear, tolerance = _in_continuous_time(sys, dt)
    ports, parameters = find_ports(linear, tolerance, declared)
    rate, ports, parameters = find_meters(linear, find_rate_sensors(linear, tolerance), ports, parameters)
    weights = read_weights(linear, rate, ports, tolerance)
    return {
        "linear": linear,
        "output_state": linear.C - rate @ linear.A if rate.any() else linear.C,
        "output_rate": rate,
        "output_input": linear.D - rate @ linear.B,
        "ports": ports,
        "parameters": tuple(sorted((*parameters, *weights), key=lambda q: q.kind == InputGain.name)),
    }


def _in_continuous_time(sys: ct.StateSpace, dt: float | None) -> tuple[LinearModel, float]:
    """The model, and the relative size below which its entries count as zero."""
    linear = LinearModel.from_statespace(sys)
    step = None if dt is None else check_sampling_time(dt)
    if linear.dt is None:  # python-control: either time base
        linear = linear.with_arrays(dt=0)
    if linear.is_continuous:
        return linear, 1e-9
    if linear.dt is True:
        if step is None:
            raise ModelError(
                f"model {linear.name!r} is in discrete time but has no sampling time (dt = True); "
                "give the model a dt, or the time between samples as dt="
            )
        sys = linear.with_arrays(dt=step).to_statespace()
    # the matrix logarithm leaves noise where zeros were
    return replace(LinearModel.from_statespace(d2c(sys)), name=linear.name), 1e-7


def find_ports(
    linear: LinearModel, tolerance: float = 1e-9, declared: Declared | None = None
) -> tuple[tuple[Port, ...], tuple[NominalParameter, ...]]:
    """Ports and nominal parameters of a plain model.

    Parameters
    ----------
    linear : LinearModel
        Continuous-time model.
    tolerance : float, optional
        Relative size below which an entry counts as zero.
    declared : Declared, optional
        Links, units and masses that are known.

    Returns
    -------
    ports : tuple of Port
        Absolute ports in the order of the states, then relative ones.
    parameters : tuple of NominalParameter
        Nonzero stiffness, damping and coefficients, and the input gains.
    """
    displacements = find_displacements(linear, tolerance)
    modes = find_modes(linear, displacements, tolerance)
    modal = {state for mode in modes for state in mode.states}
    displacements = [item for item in displacements if item.state not in modal]
    declared = declared or Declared()
    known = _known_masses(linear, displacements, declared)
    masses = relative_masses(linear, displacements, tolerance, known)
    owned = {item.moving for item in displacements if item.absolute}
    others = {item.other for item in displacements} | {item.moving for item in displacements}
    taken = {item.state for item in displacements} | owned

    by_state = {item.state: displacement_port(linear, item, masses) for item in displacements}
    by_state |= {mode.states[0]: mode.port for mode in modes}
    for i in range(linear.n_states):
        if i not in taken | modal:
            by_state[i] = _state_port(linear, i, masses, mechanical=i in others)
    links, open_ = find_links(linear, displacements, masses, tolerance, declared)
    for item, words in open_.items():
        port = by_state[item.state]
        by_state[item.state] = replace(port, description=f"{port.description}; {words}")
    stores = [i for i in by_state if i not in taken and i not in others and i not in modal]
    exchange = [
        _exchange_port(linear, source, sink, masses)
        for source, sink in exchanging(linear.A, sorted(stores), tolerance)
    ]
    shunts = [_shunt_port(linear, item) for item in displacements if _is_voltage(linear, item, declared)]
    found = (*(by_state[i] for i in sorted(by_state)), *(link.port for link in links), *exchange, *shunts)
    return found, read_parameters(linear, displacements, by_state, links, modes, masses, tolerance)


def _known_masses(
    linear: LinearModel, displacements: Sequence[Displacement], declared: Declared
) -> dict[int, float]:
    """Declared masses by the velocity, or the store, that they belong to."""
    velocity = {item.state: item.moving for item in displacements if item.absolute}
    found = {}
    for i, label in enumerate(linear.state_labels):
        if label in declared.masses:
            moving = velocity.get(i)
            found[i if moving is None else moving] = declared.masses[label]
    return found


def displacement_port(linear: LinearModel, item: Displacement, masses: MassScale) -> Port:
    """Port of a displacement of a mass, or of an elongation.

    Parameters
    ----------
    linear : LinearModel
        Continuous-time model.
    item : Displacement
        The displacement.
    masses : MassScale
        Masses of the velocity states.

    Returns
    -------
    Port
        Mechanical port named after the displacement state.
    """
    n, labels = linear.n_states, linear.state_labels
    both = (item.moving, 1.0), (item.other, -item.ratio)
    ends = {state: sign for state, sign in both if state is not None}
    sources = "; ".join(dict.fromkeys(masses.origin[state] for state in ends))
    speed = " and ".join(labels[state] for state in ends)
    if item.absolute:
        description = f"displacement {labels[item.state]}, velocity {speed}; {sources}"
    else:
        description = f"elongation {labels[item.state]}, pulls on {speed}; {sources}"
    nothing = np.zeros(linear.n_inputs)
    return Port(
        labels[item.state],
        "mechanical",
        act=-masses.inverse @ row_of(n, ends),
        position=row_of(n, {item.state: 1.0}),
        position_input=nothing,
        velocity=row_of(n, {state: sign * item.scale for state, sign in ends.items()}),
        velocity_input=nothing if item.absolute else linear.B[item.state],
        acceleration_input=masses.base_acceleration if item.absolute else nothing,
        description=description,
    )


def _state_port(linear: LinearModel, i: int, masses: MassScale, *, mechanical: bool) -> Port:
    """Return the port of a state that is its own place.

    The state is a store, or the speed of a mass without displacement.
    """
    label, origin = linear.state_labels[i], masses.origin[i]
    nothing = np.zeros(linear.n_inputs)
    return Port(
        label,
        "mechanical" if mechanical else "first_order",
        act=row_of(linear.n_states, {i: -1.0 / masses.mass[i]}),
        position=np.zeros(linear.n_states),
        position_input=nothing,
        velocity=row_of(linear.n_states, {i: 1.0}),
        acceleration_input=masses.base_acceleration if mechanical else nothing,
        description=f"speed {label}; {origin}" if mechanical else f"state {label}; {_stored(origin)}",
    )


def _stored(origin: str) -> str:
    return origin.replace("mass", "storage").replace("forces are", "flows are")


def _is_voltage(linear: LinearModel, item: Displacement, declared: Declared) -> bool:
    """Return whether a state is the voltage of a capacitor between currents.

    Its declared unit decides, otherwise the names of the states.
    """
    label = linear.state_labels[item.state]
    ends = [linear.state_labels[i] for i in (item.moving, item.other) if i is not None]
    if label in declared.units:
        return declared.units[label] == "V"
    return label[0] in "vVuU" and all(end[0] in "iI" for end in ends)


def _shunt_port(linear: LinearModel, item: Displacement) -> Port:
    """Return the port of a current that bypasses a capacitor.

    The capacitor's own port is a voltage in series with it.
    """
    label, nothing = linear.state_labels[item.state], np.zeros(linear.n_inputs)
    return Port(
        f"shunt {label}",
        "first_order",
        act=row_of(linear.n_states, {item.state: -item.scale}),
        position=np.zeros(linear.n_states),
        position_input=nothing,
        velocity=row_of(linear.n_states, {item.state: 1.0}),
        description=f"current past the capacitor of {label}, capacitance {1.0 / item.scale:.4g}",
    )


def _exchange_port(linear: LinearModel, source: int, sink: int, masses: MassScale) -> Port:
    """Return the port between two stores.

    It is an exchange in both directions (temperatures) or a flow (tanks).
    """
    A, labels = linear.A, linear.state_labels
    both = A[source, sink] > 0
    gain = 1.0 / masses.mass[sink] if both else A[sink, source] / -A[source, source] / masses.mass[source]
    one, two = labels[source], labels[sink]
    if both:
        name, words = f"{one}-{two}", f"exchange between {one} and {two}, driven by their difference"
    else:
        name = f"{one}->{two}"
        words = f"flow from {one} to {two}, taken as if all that leaves {one} reached {two}"
    nothing = np.zeros(linear.n_inputs)
    return Port(
        name,
        "first_order",
        act=row_of(linear.n_states, {source: -1.0 / masses.mass[source], sink: float(gain)}),
        position=np.zeros(linear.n_states),
        position_input=nothing,
        velocity=row_of(linear.n_states, {source: 1.0, sink: -1.0} if both else {source: 1.0}),
        description=f"{words}; {_stored(masses.origin[source])}",
    )
