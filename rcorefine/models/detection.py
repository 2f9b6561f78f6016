"""Places and parameters of a plain StateSpace, found in its matrices."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import lru_cache
from typing import TYPE_CHECKING, Any

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
from .incidence import Declared, Displacement, Incidence
from .links import find_links
from .masses import find_masses
from .parameters import NominalParameter, rate_at
from .ports import Element, Port, port_at, row_of, sensor_row

if TYPE_CHECKING:
    from .physical_model import PhysicalModel

_SAME = 1e-6  # relative difference of equal values
_LEFT = 1e-9  # relative size of rounding after cancellation
_ROUNDED = 2e-3  # relative rounding of a coupling when entries have four digits
_MOST = 60  # most entries of B, C and D that count as parameters
_ALONG = 1e-6  # one minus the cosine of equal directions, for entries of four digits
_KEPT = 16  # models whose places are kept for the next call
_ANONYMOUS = re.compile(r"x\[\d+\]")


@dataclass(frozen=True)
class _Content:
    """Model with declarations, equal to another one where all entries are."""

    key: tuple[Any, ...]
    found: Incidence = field(compare=False)


def recognize(
    kind: type[PhysicalModel], sys: ct.StateSpace, dt: float | None, declared: Declared | None = None
) -> PhysicalModel:
    """Return a plain model, as one of this class, with its places.

    The same content gives the same object, whose arrays are read-only. See
    `PhysicalModel.from_statespace`.
    """
    found = Incidence(*_in_continuous_time(sys, dt), declared or Declared())
    linear = found.linear
    # a StateSpace can be changed, so that its entries are the key, and not the object
    arrays = [(X.shape, X.tobytes()) for X in (getattr(linear, key) for key in "ABCD")]
    labels = linear.input_labels, linear.output_labels, linear.state_labels, linear.name
    return _recognize(_Content((kind, *arrays, *labels, found.tolerance, repr(found.declared)), found))


@lru_cache(maxsize=_KEPT)
def _recognize(content: _Content) -> PhysicalModel:
    found = content.found
    linear = found.linear
    for key in "ABCD":  # the cached arrays cannot be changed
        getattr(linear, key).setflags(write=False)
    # displacements and modes, masses, links; then places with springs and dampers
    found.masses = find_masses(found)
    found.links, found.ambiguous = find_links(found)
    # ports by state: modes, displacements, then stores and speeds without a displacement
    by_state = {mode.states[0]: mode.port for mode in found.modes}
    by_state |= {item.state: _displacement_port(found, item) for item in found.physical}
    own = {*found.moving, *found.stores}.difference(found.velocity.values())
    by_state |= {i: _state_port(found, i) for i in sorted(own)}
    # links, flows between stores, currents past capacitors
    ports = [by_state[i] for i in sorted(by_state)] + [link.port for link in found.links]
    ports += [_exchange_port(found, *pair) for pair in found.exchange]
    ports += [_shunt_port(linear, item) for item in found.physical if _is_voltage(found, item)]
    parameters = find_parameters(found, by_state)
    # accelerometers, load cells, entries of B, C and D
    rate, ports, parameters = find_meters(found, find_rate_sensors(found), ports, parameters)
    parameters += find_weights(found, rate, ports)
    parameters.sort(key=lambda q: q.kind == InputGain.name)
    kind: type[PhysicalModel] = content.key[0]
    # y = C_x x + C_a dx/dt + D_w w, with C = C_x + C_a A
    outputs = linear.C - rate @ linear.A, rate, linear.D - rate @ linear.B
    return kind(linear, *outputs, tuple(ports), tuple(parameters))


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


def find_parameters(found: Incidence, by_state: Mapping[int, Port]) -> list[NominalParameter]:
    """Return stiffness and damping by place, entries of A, and input gains.

    The links are taken off a copy of A, then springs and dampers to the ground. What is left over
    (first-order states, one-way couplings) is listed entry by entry.
    """
    linear, masses = found.linear, found.masses
    # subtract the links from a copy of [A B]
    rest, elements = _Rest(found), [*found.modes, *found.links]
    for element in elements:
        rest.subtract(element.port, Stiffness.name, element.stiffness)
        rest.subtract(element.port, Damping.name, element.damping)
        rest.left[list(element.states)] = 0.0  # rows of a mode are explained
    if found.links:
        rest.round_off(found.velocity)
    # springs and dampers of elongations
    for item in found.physical:
        if not item.absolute:
            rest.take_elongation(by_state[item.state], item)
    # springs and dampers to the ground
    for state, row in found.velocity.items():
        rest.take(by_state[state], Stiffness.name, row, state)
        rest.take(by_state[state], Damping.name, row, row)
    if masses.shared:
        rest.left[np.abs(rest.left) <= _ROUNDED * rest.scale] = 0.0
    # viscous friction of speeds without a displacement
    for i, port in by_state.items():
        if port.kind == "mechanical" and not port.has_position:
            rest.take(port, Damping.name, i, i)
    rest.left[[item.state for item in found.physical]] = 0.0  # kinematic rows
    rest.left[_shifts(linear)] = 0.0
    # zero losses of a physical structure, then the entries that are left over
    places = {port.name: port for port in [*(e.port for e in elements), *by_state.values()]}
    zeros = _lossless(found, list(places.values()), elements, rest.found)
    # a gain for each input, except the acceleration of the base
    drives = linear.B.any(axis=0) & (masses.base_acceleration == 0)
    gains = [
        NominalParameter(f"gain[{label}]", 1.0, "1", InputGain.name, label, False)
        for label, is_driven in zip(linear.input_labels, drives, strict=True)
        if is_driven
    ]
    return [*rest.found, *zeros, *_entries("A", linear.A, rest.left[:, : linear.n_states] != 0), *gains]


def _entries(name: str, values: Array, listed: Any) -> list[NominalParameter]:
    """Return the listed entries of a matrix as parameters."""
    return [
        NominalParameter(place := f"{name}[{i},{j}]", float(values[i, j]), "", Entry.name, place, False)
        for i, j in np.argwhere(listed).tolist()
    ]


def _shifts(linear: LinearModel) -> Array:
    """Return the rows of A such as x1' = x2: kinematics, not numbers."""
    A = linear.A
    one = (np.count_nonzero(A, axis=1) == 1) & (np.abs(A).max(axis=1, initial=0.0) == 1.0)
    return np.asarray(one & ~np.diag(A).astype(bool) & ~linear.B.any(axis=1))


def _lossless(
    found: Incidence, ports: Sequence[Port], elements: Sequence[Element], known: Sequence[NominalParameter]
) -> list[NominalParameter]:
    """Return the losses of a physical structure that are zero in the model.

    They are the damping beside a spring, the friction of a body that no link holds, and the loss of a store
    that others act back on. Where nothing brings back what moves, as in an integrator, there is none.
    """
    A = found.A
    # states on which the force of a link acts
    linked = np.any([e.port.act for e in elements] or [np.zeros(len(A))], axis=0)
    kinematic = _shifts(found.linear)
    kinds, zero = {(q.kind, q.place) for q in known}, []
    for port in ports:
        if port.kind == "mechanical":
            isolated = not (linked & (port.act != 0)).any()
        else:
            isolated = not port.velocity @ A @ port.act and not kinematic[port.velocity != 0].any()
        # a spring without damper, or a body without friction, whose motion comes back
        if (Damping.name, port.name) not in kinds and (
            (Stiffness.name, port.name) in kinds or (isolated and rate_at(A, port.act, port.velocity))
        ):
            zero.append(NominalParameter(f"c[{port.name}]", 0.0, "", Damping.name, port.name, False))
    return zero


def _displacement_port(found: Incidence, item: Displacement) -> Port:
    """Return the port of a displacement of a mass, or of an elongation."""
    linear, masses = found.linear, found.masses
    label, nothing = linear.state_labels[item.state], np.zeros(linear.n_inputs)
    speed = " and ".join(linear.state_labels[state] for state in item.ends)
    what = f"displacement {label}, velocity" if item.absolute else f"elongation {label}, pulls on"
    words = [f"{what} {speed}", *dict.fromkeys(masses.origin[state] for state in item.ends)]
    if item.state in found.ambiguous:
        words.append(found.ambiguous[item.state])
    return port_at(
        linear,
        label,
        "; ".join(words),
        masses.act(item.ends),
        {state: weight * item.scale for state, weight in item.ends.items()},
        {item.state: 1.0},
        velocity_input=nothing if item.absolute else linear.B[item.state],
        acceleration_input=masses.base_acceleration if item.absolute else nothing,
    )


def _state_port(found: Incidence, i: int) -> Port:
    """Return the port of a state that is its own place.

    The state is a store, or the speed of a mass without displacement.
    """
    linear, masses = found.linear, found.masses
    label, origin, act = linear.state_labels[i], masses.origin[i], masses.act({i: 1.0})
    if i in found.moving:
        words, base = f"speed {label}; {origin}", masses.base_acceleration
        return port_at(linear, label, words, act, {i: 1.0}, acceleration_input=base)
    return port_at(
        linear, label, f"state {label}; {_storage_words(origin)}", act, {i: 1.0}, kind="first_order"
    )


def _storage_words(origin: str) -> str:
    return origin.replace("mass", "storage").replace("forces are", "flows are")


def _is_voltage(found: Incidence, item: Displacement) -> bool:
    """Return whether a state is the voltage of a capacitor between currents.

    Its declared unit decides, otherwise the names of the states.
    """
    labels, units = found.linear.state_labels, found.declared.units
    label, ends = labels[item.state], [labels[i] for i in item.ends]
    if label in units:
        return units[label] == "V"
    return label[0] in "vVuU" and all(end[0] in "iI" for end in ends)


def _shunt_port(linear: LinearModel, item: Displacement) -> Port:
    """Return the port of a current that bypasses a capacitor.

    The capacitor's own port is a voltage in series with it.
    """
    label = linear.state_labels[item.state]
    words = f"current past the capacitor of {label}, capacitance {1.0 / item.scale:.4g}"
    act = row_of(linear.n_states, {item.state: -item.scale})
    return port_at(linear, f"shunt {label}", words, act, {item.state: 1.0}, kind="first_order")


def _exchange_port(found: Incidence, source: int, sink: int) -> Port:
    """Return the port between two stores.

    It is an exchange in both directions (temperatures) or a flow (tanks).
    """
    linear, masses, A = found.linear, found.masses, found.linear.A
    one, two = (linear.state_labels[i] for i in (source, sink))
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

    def __init__(self, found: Incidence) -> None:
        B = found.linear.B
        self.scale = np.abs(np.hstack([found.linear.A, B]))
        # entries that are rounding count as zero
        self.left = np.hstack([found.A, np.where(found.driven, B, 0.0)])
        self.found: list[NominalParameter] = []

    def take(self, port: Port, kind: str, row: int, column: int) -> None:
        """Find the coefficient that explains the rest of an entry.

        Its contribution to all entries is subtracted.
        """
        if abs(self.left[row, column]) > _LEFT * self.scale[row, column]:
            sensed = sensor_row(port, spring=kind == Stiffness.name)
            # coefficient = rest of the entry / (act * sensed)
            self.subtract(port, kind, float(self.left[row, column] / (port.act[row] * sensed[column])))

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

    def subtract(self, port: Port, kind: str, value: float) -> None:
        """Enter a coefficient, and take its part off."""
        if value:
            name = f"{'k' if kind == Stiffness.name else 'c'}[{port.name}]"
            self.found.append(NominalParameter(name, float(value), "", kind, port.name, False))
            # subtract coefficient * act sensed' from all entries
            self.left -= value * np.outer(port.act, sensor_row(port, spring=kind == Stiffness.name))
            self.left[np.abs(self.left) <= _LEFT * self.scale] = 0.0


def find_rate_sensors(found: Incidence) -> Array:
    """Find the outputs that read rates of velocity states (accelerometers).

    The result is Ca (n_y, n) with C = Ca A for the outputs that are accelerations, zero rows for others.

    Notes
    -----
    The row of C is an acceleration if it is a combination of rows of A that belong to
    velocity states, and that is the shorter way to say it. In an undamped model
    every displacement is such a combination, so there the weights must be 1 (or the direct
    part of the input must agree).
    """
    # rows of the velocity states
    linear, rows = found.linear, sorted({state for item in found.displacements for state in item.ends})
    rate = np.zeros((linear.n_outputs, linear.n_states))
    for y, (c, d) in enumerate(zip(linear.C, linear.D, strict=True)):
        weights = _rate_weights(linear, rows, c, d, found.tolerance)
        if weights is not None:
            rate[y, rows] = weights
    return rate


def _rate_weights(linear: LinearModel, rows: list[int], c: Array, d: Array, tolerance: float) -> Array | None:
    if not rows or not c.any():
        return None
    A, B = linear.A[rows], linear.B[rows]
    # first candidates: an accelerometer at one mass
    candidates = [
        row_of(len(rows), {index: (c @ row) / (row @ row)}) for index, row in enumerate(A) if row.any()
    ]
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
            return weights
    return None


def find_meters(
    found: Incidence, rate: Array, ports: Sequence[Port], parameters: Sequence[NominalParameter]
) -> tuple[Array, list[Port], list[NominalParameter]]:
    """Find the sensors that read the force at a port.

    The remaining accelerometers are returned as well.

    Parameters
    ----------
    found : Incidence
        Model and what was found in it.
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
    linear, rate, read_at = found.linear, rate.copy(), dict[str, dict[int, float]]()
    forces = _forces(found, ports, parameters)
    for y in range(linear.n_outputs):
        # an accelerometer at one mass stays what it is
        if np.count_nonzero(rate[y]) == 1 and np.isclose(np.abs(rate[y]).max(), 1.0, rtol=_SAME):
            continue
        # ports whose force this output reads
        row = np.concatenate([linear.C[y], linear.D[y]])
        read = [(name, scale) for name, force in forces.items() if (scale := _reading(row, *force))]
        if len(read) == 1 and (not rate[y].any() or abs(read[0][1]) == 1.0):
            rate[y] = 0.0
            read_at.setdefault(read[0][0], {})[y] = read[0][1]
    places, moved = list[Port](), list(parameters)
    for port in ports:
        readings = read_at.get(port.name, {})
        # a port with a load cell, beside the port of the mass itself
        metered = replace(port, output=row_of(linear.n_outputs, readings)) if readings else port
        if readings and np.count_nonzero(port.act) == 1:
            places.append(port)
            label = linear.output_labels[min(readings)]
            words = f"{port.description}; its force is read by {label}"
            metered = replace(metered, name=f"{port.name} ({label})", description=words)
            moved = [replace(q, place=metered.name) if q.place == port.name else q for q in moved]
        places.append(metered)
    return rate, places, moved


def _forces(
    found: Incidence, ports: Sequence[Port], parameters: Sequence[NominalParameter]
) -> dict[str, tuple[Array, bool]]:
    """Return by port the force k d + c v of spring and damper as a row.

    The second value is True if a sensor of that force may have another gain than one.
    """
    linear, forces = found.linear, {}
    named = not any(_ANONYMOUS.fullmatch(label) for label in linear.state_labels)
    for port in () if found.companion else ports:
        k, c = (
            sum(q.value for q in parameters if q.kind == kind and q.place == port.name)
            for kind in (Stiffness.name, Damping.name)
        )
        force = k * sensor_row(port, spring=True) + c * sensor_row(port)
        if port.modal or not force.any():
            continue
        # a single number must not be a power of ten, which is a gain
        both, decades = bool(k and c), np.log10(abs(k or c))
        if (named or linear.n_states > 2) if both else (named and abs(decades - round(decades)) > _SAME):
            forces[port.name] = force, both
    return forces


def _reading(row: Array, force: Array, scaled: bool) -> float:
    """Return the reading of a unit force in an output row, 0 if there is none.

    A force of spring and damper may be `scaled`.
    """
    if not row.any():
        return 0.0
    # least-squares factor between the row and that force
    scale = float(row @ force / (force @ force))
    # entry by entry, since spring and damper have different units
    if np.any(np.abs(row - scale * force) > _SAME * np.maximum(np.abs(row), np.abs(scale * force))):
        return 0.0
    if abs(abs(scale) - 1.0) <= _SAME:
        return float(np.sign(scale))
    return scale if scaled else 0.0


def find_weights(found: Incidence, rate: Array, ports: Sequence[Port]) -> list[NominalParameter]:
    """Entries of B, C and D that are numbers of the plant.

    Parameters
    ----------
    found : Incidence
        Model and what was found in it.
    rate : ndarray, shape (n_y, n)
        What its outputs read of rates (accelerometers), which is taken off C and D.
    ports : sequence of Port
        Its places; what a sensor reads of a force there is no weight.

    Returns
    -------
    list of NominalParameter
        Not listed is a weight of one, which is how a signal is mounted; a single one of its input or
        output, which is a gain; and those of an input that is a force at a port, which masses divide.
        Empty where there are more than 60: shapes of many modes, not numbers that somebody measured.
    """
    linear, tolerance, n = found.linear, found.tolerance, found.linear.n_states
    whole = np.hstack([linear.C, linear.D])
    # outputs without what they read of the rates
    rest = whole - rate @ np.hstack([linear.A, linear.B])
    rest[np.abs(rest) <= _LEFT * np.abs(whole)] = 0.0
    # entries of C and D that count, but no load cells and no single gains
    mixed = np.abs(rest) > tolerance * np.abs(rest).max(axis=1, keepdims=True, initial=0.0)
    mixed[[y for port in ports for y in np.flatnonzero(port.output)]] = False
    single = (mixed.sum(axis=1) == 1) & mixed[:, :n].any(axis=1)
    # the gain of an input scales all outputs alike: of several outputs without a structure each has its own
    mixed[single & (len(rest) == 1 or bool(found.physical))] = False
    # entries of B that count, but no kinematics, single gains and plain forces
    driven = found.driven.copy()
    driven[[item.state for item in found.displacements]] = False  # kinematic rows
    alone = (driven.sum(axis=0) == 1) | [_enters(column, ports) for column in linear.B.T]
    driven[:, alone & ~mixed[:, n:].any(axis=0)] = False  # a gain scales what passes directly, too
    # a weight of one is no number of the plant
    weights = [
        entry
        for name, values, listed in (
            ("B", linear.B, driven),
            ("C", rest[:, :n], mixed[:, :n]),
            ("D", rest[:, n:], mixed[:, n:]),
        )
        for entry in _entries(name, values, listed & (np.abs(np.abs(values) - 1.0) > tolerance))
    ]
    return weights if len(weights) <= _MOST else []


def _enters(column: Array, ports: Sequence[Port]) -> bool:
    """Return whether an input acts like the force of a port."""
    size = float(np.linalg.norm(column))
    acts = [port.act / np.linalg.norm(port.act) for port in ports if port.act.any()]
    return size > 0 and any(abs(act @ column) > (1 - _ALONG) * size for act in acts)
