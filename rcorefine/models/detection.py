"""Places and parameters of a plain StateSpace, found in its matrices."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import control as ct
import numpy as np

from ..effects.bodies import Entry
from ..effects.channels import InputGain
from ..effects.dampers import Damping
from ..effects.springs import Stiffness
from ..exceptions import ModelError
from ..systems.conversion import d2c
from ..systems.discretization import check_sampling_time
from ..systems.linear import Array, LinearModel
from .displacements import Displacement, find_displacements, find_modes, is_companion, of_masses, significant
from .links import Declared, find_links
from .masses import MassScale, exchanging, relative_masses
from .parameters import NominalParameter, rate_at
from .ports import Element, Port, port_at, row_of

_SAME = 1e-6  # relative difference of equal values
_LEFT = 1e-9  # relative size of rounding after cancellation
_ROUNDED = 2e-3  # relative rounding of a coupling when entries have four digits
_MOST = 60  # most entries of B, C and D that count as parameters
_ALONG = 1e-6  # one minus the cosine of equal directions, for entries of four digits
_ANONYMOUS = re.compile(r"x\[\d+\]")


def recognized(sys: ct.StateSpace, dt: float | None, declared: Declared | None = None) -> dict[str, Any]:
    """Return the arguments of a `PhysicalModel`, found in a plain model.

    See `PhysicalModel.from_statespace`.
    """
    linear, tolerance = _in_continuous_time(sys, dt)
    # displacements, then places with springs and dampers
    displacements = find_displacements(linear, tolerance)
    ports, parameters = find_ports(linear, displacements, tolerance, declared or Declared())
    # accelerometers, load cells, entries of B, C and D
    rate = find_rate_sensors(linear, displacements, tolerance)
    rate, ports, parameters = find_meters(linear, rate, ports, parameters)
    weights = read_weights(linear, rate, displacements, ports, tolerance)
    return {
        "linear": linear,
        # y = C_x x + C_a dx/dt + D_w w, with C = C_x + C_a A
        "output_state": linear.C - rate @ linear.A if rate.any() else linear.C,
        "output_rate": rate,
        "output_input": linear.D - rate @ linear.B,
        "ports": tuple(ports),
        "parameters": tuple(sorted((*parameters, *weights), key=lambda q: q.kind == InputGain.name)),
    }


def _in_continuous_time(sys: ct.StateSpace, dt: float | None) -> tuple[LinearModel, float]:
    """The model, and the relative size below which its entries count as zero."""
    linear = LinearModel.from_statespace(sys)
    step = None if dt is None else check_sampling_time(dt)
    if linear.dt is None:  # python-control: unspecified timebase
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
    linear: LinearModel, displacements: Sequence[Displacement], tolerance: float, declared: Declared
) -> tuple[list[Port], list[NominalParameter]]:
    """Ports and nominal parameters of a plain model.

    Parameters
    ----------
    linear : LinearModel
        Continuous-time model.
    displacements : sequence of Displacement
        Its displacement states.
    tolerance : float
        Relative size below which an entry counts as zero.
    declared : Declared
        Links, units and masses that are known.

    Returns
    -------
    ports : list of Port
        Absolute ports in the order of the states, then relative ones.
    parameters : list of NominalParameter
        Nonzero stiffness, damping and coefficients, and the input gains.
    """
    labels = linear.state_labels
    # modal coordinates first; physical displacements are what remains
    modes = find_modes(linear, displacements, tolerance)
    modal = {state for mode in modes for state in mode.states}
    displacements = [item for item in displacements if item.state not in modal]
    velocity = dict(zip(*of_masses(displacements)[:2], strict=True))
    moving = {state for item in displacements for state in item.ends}
    # declared masses, by the velocity state
    known = {
        velocity.get(i, i): declared.masses[label]
        for i, label in enumerate(labels)
        if label in declared.masses
    }
    # masses that make stiffness and damping symmetric, then the links between them
    masses = relative_masses(linear, displacements, tolerance, known)
    links, open_ = find_links(linear, displacements, masses, tolerance, declared)
    # ports by state: modes, displacements, then states of their own
    by_state = {mode.states[0]: mode.port for mode in modes}
    for item in displacements:
        by_state[item.state] = _displacement_port(linear, item, masses, open_.get(item.state, ""))
    own = [i for i in range(linear.n_states) if i not in modal | by_state.keys() | set(velocity.values())]
    by_state |= {i: _state_port(linear, i, masses, mechanical=i in moving) for i in own}
    # flows between stores
    exchange = [
        _exchange_port(linear, source, sink, masses)
        for source, sink in exchanging(linear.A, [i for i in own if i not in moving], tolerance)
    ]
    shunts = [_shunt_port(linear, item) for item in displacements if _is_voltage(linear, item, declared)]
    parameters = _read_parameters(linear, displacements, by_state, [*modes, *links], masses, tolerance)
    return [
        *(by_state[i] for i in sorted(by_state)),
        *(link.port for link in links),
        *exchange,
        *shunts,
    ], parameters


def _read_parameters(
    linear: LinearModel,
    displacements: Sequence[Displacement],
    by_state: Mapping[int, Port],
    elements: Sequence[Element],
    masses: MassScale,
    tolerance: float,
) -> list[NominalParameter]:
    """Return stiffness and damping by place, entries of A, and input gains.

    The links are taken off a copy of A, then springs and dampers to the ground. What is left over
    (first-order states, one-way couplings) is listed entry by entry.
    """
    # subtract the links from a copy of [A B]
    rest = _Rest(linear, tolerance)
    for element in elements:
        rest.off(element.port, Stiffness.name, element.stiffness)
        rest.off(element.port, Damping.name, element.damping)
        rest.left[list(element.states)] = 0.0  # rows of a mode are explained
    velocity = dict(zip(*of_masses(displacements)[:2], strict=True))
    if not all(element.states for element in elements):
        rest.round_off(velocity)
    # springs and dampers of elongations
    for item in displacements:
        if not item.absolute:
            rest.take_elongation(by_state[item.state], item)
    # springs and dampers to the ground
    for state, row in velocity.items():
        rest.take(by_state[state], Stiffness.name, row, state)
        rest.take(by_state[state], Damping.name, row, row)
    if masses.shared:
        rest.left[np.abs(rest.left) <= _ROUNDED * rest.scale] = 0.0
    # viscous friction of speeds without a displacement
    for i, port in by_state.items():
        if port.kind == "mechanical" and not port.has_position:
            rest.take(port, Damping.name, i, i)
    rest.left[[item.state for item in displacements]] = 0.0  # kinematic rows
    # zero losses of a physical structure, then the entries that are left over
    parameters = rest.found + _lossless(linear, by_state, elements, rest.found, tolerance)
    for i, j in np.argwhere(rest.left[:, : linear.n_states]).tolist():
        place = f"A[{i},{j}]"
        parameters.append(NominalParameter(place, float(linear.A[i, j]), "", Entry.name, place, False))
    # a gain for each input, except the acceleration of the base
    for label, base, column in zip(linear.input_labels, masses.base_acceleration, linear.B.T, strict=True):
        if column.any() and not base:
            parameters.append(NominalParameter(f"gain[{label}]", 1.0, "1", InputGain.name, label, False))
    return parameters


def _lossless(
    linear: LinearModel,
    by_state: Mapping[int, Port],
    elements: Sequence[Element],
    found: Sequence[NominalParameter],
    tolerance: float,
) -> list[NominalParameter]:
    """Return the losses of a physical structure that are zero in the model.

    They are the damping beside a spring, the friction of a body that no link holds, and the loss of a store
    that others act back on. Where nothing brings back what moves, as in an integrator, there is none.
    """
    A = significant(linear.A, tolerance)
    if not len(A):
        return []
    # states on which the force of a link acts
    linked = np.any([e.port.act for e in elements], axis=0) if elements else np.zeros(len(A), dtype=bool)
    # rows such as x1' = x2 are kinematics
    kinematic = (np.count_nonzero(A, axis=1) == 1) & (np.abs(A).max(axis=1) == 1.0) & ~linear.B.any(axis=1)
    kinds = {(q.kind, q.place) for q in found}
    zero = []
    for port in {p.name: p for p in [*(e.port for e in elements), *by_state.values()]}.values():
        if port.kind == "mechanical":
            isolated = not (linked & (port.act != 0)).any()
        else:
            isolated = not port.velocity @ A @ port.act and not kinematic[port.velocity != 0].any()
        # a spring without damper, or a body without friction, whose motion comes back
        sprung = (Stiffness.name, port.name) in kinds
        if (Damping.name, port.name) not in kinds and (
            sprung or (isolated and rate_at(A, port.act, port.velocity))
        ):
            zero.append(NominalParameter(f"c[{port.name}]", 0.0, "", Damping.name, port.name, False))
    return zero


def _displacement_port(linear: LinearModel, item: Displacement, masses: MassScale, open_: str) -> Port:
    """Return the port of a displacement of a mass, or of an elongation.

    `open_` says what is unknown about its links.
    """
    label, nothing = linear.state_labels[item.state], np.zeros(linear.n_inputs)
    speed = " and ".join(linear.state_labels[state] for state in item.ends)
    what = f"displacement {label}, velocity" if item.absolute else f"elongation {label}, pulls on"
    words = [f"{what} {speed}", *dict.fromkeys(masses.origin[state] for state in item.ends)]
    return port_at(
        linear,
        label,
        "; ".join([*words, open_] if open_ else words),
        masses.act(item.ends),
        {state: weight * item.scale for state, weight in item.ends.items()},
        {item.state: 1.0},
        velocity_input=nothing if item.absolute else linear.B[item.state],
        acceleration_input=masses.base_acceleration if item.absolute else nothing,
    )


def _state_port(linear: LinearModel, i: int, masses: MassScale, *, mechanical: bool) -> Port:
    """Return the port of a state that is its own place.

    The state is a store, or the speed of a mass without displacement.
    """
    label, act = linear.state_labels[i], masses.act({i: 1.0})
    if mechanical:
        words, base = f"speed {label}; {masses.origin[i]}", masses.base_acceleration
        return port_at(linear, label, words, act, {i: 1.0}, acceleration_input=base)
    return port_at(
        linear, label, f"state {label}; {_storage_words(masses.origin[i])}", act, {i: 1.0}, kind="first_order"
    )


def _storage_words(origin: str) -> str:
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
    label = linear.state_labels[item.state]
    words = f"current past the capacitor of {label}, capacitance {1.0 / item.scale:.4g}"
    act = row_of(linear.n_states, {item.state: -item.scale})
    return port_at(linear, f"shunt {label}", words, act, {item.state: 1.0}, kind="first_order")


def _exchange_port(linear: LinearModel, source: int, sink: int, masses: MassScale) -> Port:
    """Return the port between two stores.

    It is an exchange in both directions (temperatures) or a flow (tanks).
    """
    A, (one, two) = linear.A, (linear.state_labels[i] for i in (source, sink))
    # both ways: the force is on the difference of the states
    if A[source, sink] > 0:
        name, words = f"{one}-{two}", f"exchange between {one} and {two}, driven by their difference"
        velocity = {source: 1.0, sink: -1.0}
        act = masses.act(velocity)
    else:
        name, velocity = f"{one}->{two}", {source: 1.0}
        words = f"flow from {one} to {two}, taken as if all that leaves {one} reached {two}"
        act = masses.act(velocity)
        # one way: share of the outflow that reaches the sink
        act[sink] = A[sink, source] / -A[source, source] / masses.mass[source]
    words += f"; {_storage_words(masses.origin[source])}"
    return port_at(linear, name, words, act, velocity, kind="first_order")


class _Rest:
    """Remainder of [A B] while links are subtracted."""

    def __init__(self, linear: LinearModel, tolerance: float) -> None:
        B, self.scale = np.abs(linear.B), np.abs(np.hstack([linear.A, linear.B]))
        # entries of B that are rounding count as zero
        driven = np.where(B > tolerance * B.max(axis=0, initial=0.0), linear.B, 0.0)
        self.left = np.hstack([significant(linear.A, tolerance), driven])
        self.found: list[NominalParameter] = []

    def take(self, port: Port, kind: str, row: int, column: int) -> None:
        """Find the coefficient that explains the rest of an entry.

        Its contribution to all entries is subtracted.
        """
        if abs(self.left[row, column]) > _LEFT * self.scale[row, column]:
            sensed = _sensor_row(port, kind)
            # coefficient = rest of the entry / (act * sensed)
            self.off(port, kind, float(self.left[row, column] / (port.act[row] * sensed[column])))

    def take_elongation(self, port: Port, item: Displacement) -> None:
        """Find spring and damper of a link whose elongation is a state.

        The other end of the damper may be an input: it shows in B.
        """
        end, *others = item.ends
        self.take(port, Stiffness.name, end, item.state)
        other = others[0] if others else port.velocity.size + int(np.argmax(np.abs(port.velocity_input)))
        self.take(port, Damping.name, end, other)

    def round_off(self, velocity: Mapping[int, int]) -> None:
        """Set the rounding errors of the links at masses to zero.

        `velocity` holds the velocity of each displacement.
        """
        for own, row in velocity.items():
            left = self.left[row]
            rounded = np.abs(left) <= _ROUNDED * self.scale[row]
            rounded[[row, own]] &= left[[row, own]] > 0  # a soft spring to the ground may be there
            left[rounded] = 0.0

    def off(self, port: Port, kind: str, value: float) -> None:
        """Enter a coefficient, and take its part off."""
        if value:
            name = f"{'k' if kind == Stiffness.name else 'c'}[{port.name}]"
            self.found.append(NominalParameter(name, float(value), "", kind, port.name, False))
            # subtract coefficient * act sensed' from all entries
            self.left -= value * np.outer(port.act, _sensor_row(port, kind))
            self.left[np.abs(self.left) <= _LEFT * self.scale] = 0.0


def _sensor_row(port: Port, kind: str) -> Array:
    """Return the row over states and inputs that a spring or damper senses."""
    if kind == Stiffness.name:
        return np.concatenate([port.position, port.position_input])
    return np.concatenate([port.velocity, port.velocity_input])


def find_rate_sensors(linear: LinearModel, displacements: Sequence[Displacement], tolerance: float) -> Array:
    """Find the outputs that read rates of velocity states (accelerometers).

    Parameters
    ----------
    linear : LinearModel
        Continuous-time model.
    displacements : sequence of Displacement
        Its displacement states.
    tolerance : float
        Relative size below which an entry counts as zero.

    Returns
    -------
    ndarray of shape (n_y, n)
        Ca with C = Ca A for the outputs that are accelerations, zero rows for others.

    Notes
    -----
    The row of C is an acceleration if it is a combination of rows of A that belong to
    velocity states, and that is the shorter way to say it. In an undamped model
    every displacement is such a combination, so there the weights must be 1 (or the direct
    part of the input must agree).
    """
    # rows of the velocity states
    rows = sorted({state for item in displacements for state in item.ends})
    rate = np.zeros((linear.n_outputs, linear.n_states))
    for y, (c, d) in enumerate(zip(linear.C, linear.D, strict=True)):
        weights = _rate_weights(linear, rows, c, d, tolerance)
        if weights is not None:
            rate[y, rows] = weights
    return rate


def _rate_weights(linear: LinearModel, rows: list[int], c: Array, d: Array, tolerance: float) -> Array | None:
    if not rows or not c.any():
        return None
    A, B = linear.A[rows], linear.B[rows]
    candidates: list[Array] = []
    for index, row in enumerate(A):  # first candidates: an accelerometer at one mass
        if row.any():
            weights = np.zeros(len(rows))
            weights[index] = (c @ row) / (row @ row)
            candidates.append(weights)
    candidates.sort(key=lambda weights: abs(abs(weights).max() - 1.0))
    # any combination of these rows, by least squares
    candidates.append(np.asarray(np.linalg.lstsq(A.T, c, rcond=None)[0], dtype=np.float64))
    for weights in candidates:
        weights = np.where(np.abs(weights) > 1e-9 * np.abs(weights).max(), weights, 0.0)
        # it must reproduce the row of C
        if np.abs(weights @ A - c).max() > max(10 * tolerance, 1e-9) * np.abs(c).max():
            continue
        used = np.flatnonzero(weights)
        unit = bool(np.allclose(np.abs(weights[used]), 1.0, rtol=1e-6))
        # the direct part of an accelerometer reads the force of the input, D = Ca B
        direct = weights @ B
        agrees = bool(direct.any() and np.allclose(direct, d, rtol=1e-6, atol=1e-9 * np.abs(direct).max()))
        damped = bool(np.any(c[rows]))
        shorter = used.size < np.count_nonzero(np.abs(c) > tolerance * np.abs(c).max())
        # accept it if D agrees, or if it is the shorter description of the row
        if agrees or (unit and (shorter or used.size == 1)) or (damped and shorter):
            return np.asarray(weights, dtype=np.float64)
    return None


def find_meters(
    linear: LinearModel, rate: Array, ports: Sequence[Port], parameters: Sequence[NominalParameter]
) -> tuple[Array, list[Port], list[NominalParameter]]:
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
    ports : list of Port
        With what the sensors read of a force there. A force at a single mass may act beside the cell: where
        the port holds one, a port ``"x1 (cell)"`` stands for what the sensor ``"cell"``, and any other at the
        same place, reads.
    parameters : list of NominalParameter
        Springs and dampers at the ports that hold them.

    Notes
    -----
    A row of C reads the force in a link if it is k d + c v with the k and c that A has there. One number
    alone could as well be the gain of a sensor: it must be the same, no power of ten, and the states must
    bear names, for a transfer function of unit gain looks like that.
    An accelerometer at a mass that only that link holds reads the same force over the mass.
    """
    rate, read_at = rate.copy(), dict[str, list[tuple[int, float]]]()
    for y in range(0 if is_companion(linear.A, 1e-9) else linear.n_outputs):
        # an accelerometer at one mass stays what it is
        if np.count_nonzero(rate[y]) == 1 and np.isclose(np.abs(rate[y]).max(), 1.0, rtol=_SAME):
            continue
        row = np.concatenate([linear.C[y], linear.D[y]])
        # ports whose force this output reads
        read = [(p.name, scale) for p in ports if (scale := _scale(linear, row, p, parameters))]
        if len(read) == 1 and (not rate[y].any() or abs(read[0][1]) == 1.0):
            rate[y] = 0.0
            read_at.setdefault(read[0][0], []).append((y, read[0][1]))
    found, moved = list[Port](), list(parameters)
    for port in ports:
        readings = read_at.get(port.name, [])
        # a port with a load cell, beside the port of the mass itself
        metered = replace(port, output=row_of(linear.n_outputs, dict(readings))) if readings else port
        if readings and np.count_nonzero(port.act) == 1:
            found.append(port)
            label = linear.output_labels[readings[0][0]]
            words = f"{port.description}; its force is read by {label}"
            metered = replace(metered, name=f"{port.name} ({label})", description=words)
            moved = [replace(q, place=metered.name) if q.place == port.name else q for q in moved]
        found.append(metered)
    return rate, found, moved


def _scale(linear: LinearModel, row: Array, port: Port, parameters: Sequence[NominalParameter]) -> float:
    """Return the reading of a unit force at a port in an output row.

    It is 0 if the row does not read that force.
    """
    k, c = (
        sum(q.value for q in parameters if q.kind == kind and q.place == port.name)
        for kind in (Stiffness.name, Damping.name)
    )
    # force of spring and damper at the port, k d + c v
    force = k * _sensor_row(port, Stiffness.name) + c * _sensor_row(port, Damping.name)
    if port.modal or not force.any() or not row.any():
        return 0.0
    # least-squares factor between the row and that force
    scale = float(row @ force / (force @ force))
    # entry by entry, since spring and damper have different units
    if np.any(np.abs(row - scale * force) > _SAME * np.maximum(np.abs(row), np.abs(scale * force))):
        return 0.0
    if abs(abs(scale) - 1.0) <= _SAME:
        scale = float(np.sign(scale))
    named = not any(_ANONYMOUS.fullmatch(label) for label in linear.state_labels)
    if k and c:
        return scale if named or linear.n_states > 2 else 0.0
    decades = np.log10(abs(k or c))
    return scale if abs(scale) == 1.0 and named and abs(decades - round(decades)) > _SAME else 0.0


def read_weights(
    linear: LinearModel,
    rate: Array,
    displacements: Sequence[Displacement],
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
    displacements : sequence of Displacement
        Its displacement states.
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
    # outputs without what they read of the rates
    rest = whole - rate @ np.hstack([linear.A, linear.B])
    rest[np.abs(rest) <= _LEFT * np.abs(whole)] = 0.0
    # entries of C and D that count, but no load cells and no single gains
    mixed = np.abs(rest) > tolerance * np.abs(rest).max(axis=1, keepdims=True, initial=0.0)
    mixed[[y for port in ports for y in np.flatnonzero(port.output)]] = False
    mixed[(mixed.sum(axis=1) == 1) & mixed[:, : linear.n_states].any(axis=1)] = False

    # entries of B that count, but no kinematics, single gains and plain forces
    driven = np.abs(linear.B) > tolerance * np.abs(linear.B).max(axis=0, initial=0.0)
    driven[[item.state for item in displacements]] = False  # kinematic rows
    driven[:, driven.sum(axis=0) == 1] = False
    driven[:, [_enters(linear.B[:, j], ports) for j in range(linear.n_inputs)]] = False

    found = []
    n = linear.n_states
    for name, values, which in (
        ("B", linear.B, driven),
        ("C", rest[:, :n], mixed[:, :n]),
        ("D", rest[:, n:], mixed[:, n:]),
    ):
        # a weight of one is no number of the plant
        for i, j in np.argwhere(which & (np.abs(np.abs(values) - 1.0) > tolerance)).tolist():
            place = f"{name}[{i},{j}]"
            found.append(NominalParameter(place, float(values[i, j]), "", Entry.name, place, False))
    return found if len(found) <= _MOST else []


def _enters(column: Array, ports: Sequence[Port]) -> bool:
    """Return whether an input acts like the force of a port."""
    size = float(np.linalg.norm(column))
    acts = [port.act / np.linalg.norm(port.act) for port in ports if port.act.any()]
    return size > 0 and any(abs(act @ column) > (1 - _ALONG) * size for act in acts)
