"""Candidate effects of a model, place by place."""

from __future__ import annotations

import re
from collections.abc import Sequence
from typing import Any

import control as ct
import numpy as np

from ..arguments import as_texts
from ..effects.bodies import ConstantForce, Entry, Gravity, Mass
from ..effects.dampers import Damping
from ..effects.domains import kind_named
from ..effects.effect import Effect, as_effects
from ..effects.law import KINDS, Law
from ..effects.products import ProductOfStates, StateDependentGain
from ..effects.right_hand_side import ModelParameter
from ..effects.springs import Stiffness
from ..exceptions import ModelError
from ..systems.linear import Array
from .conversion import as_physical
from .incidence import is_companion
from .physical_model import PhysicalModel
from .ports import Port

_MOST_ENTRIES, _MOST_PRODUCTS = 20, 6
_ROUNDING = 1e-9
_RATE = re.compile(r"speed|veloc|omega|rpm|tacho|_rate|rate_", re.IGNORECASE)
_OF_RATES = {"m/s", "mm/s", "cm/s", "km/h", "rad/s", "deg/s", "rev/s", "rev/min", "rpm", "1/min"}
_MOTIONS = ("mechanical", "rotational")
_ANGLE = re.compile(r"angle|theta|phi|psi|roll|pitch|yaw|swing", re.IGNORECASE)


def effect_library(
    model: ct.StateSpace | PhysicalModel | Any,
    *,
    kinds: str | Sequence[str] | None = None,
    places: str | Sequence[str] | None = None,
    dt: float | None = None,
) -> list[Effect]:
    """List what could be missing from a model.

    Parameters
    ----------
    model : StateSpace, PhysicalModel, or object with a `physical_model`
        Initial model.
    kinds : str or sequence of str, optional
        Kinds to list, wherever they can sit; default those that are plausible at
        each place.
    places : str or sequence of str, optional
        Ports, inputs, outputs or entries ``"A[i,j]"`` to list; default all.
    dt : float, optional
        Sampling time [s] of a discrete-time `StateSpace` that does not tell its own.

    Returns
    -------
    list of Effect
        Port by port, then inputs, outputs, entries of A and the `params` of a nonlinear model; linear
        effects first at each. Each has an `.explanation`; `describe_effects` makes a table.

    Raises
    ------
    control.ControlArgument
        If a kind is unknown.
    ModelError
        If a place does not exist, or nothing is left.

    Notes
    -----
    Left out unless asked for by `kinds`: springs between a mass and the ground where the model
    has neither spring nor another link at that mass; masses, hidden modes and constant
    forces between two masses; gravity where the displacement is no angle in rad by its unit or its name;
    laws that need to know more than a model says (`cogging`, `magnetic_force`, `radiation`,
    `output_average`, `load_friction`, `play`, `input_play`, `input_range`, `input_rate_limit`); `custom` and
    tabulated laws (which need a law); entries of A that a port explains; friction of two levels or with a
    peak, a damper of two rates and a Maxwell element at a state that is no speed by its unit or its name;
    `output_play` where no displacement is read; gains and couplings that depend on the state
    (`state_dependent_gain`, `product_of_states`) unless both sides are stores and few.
    Effects that act exactly alike are listed once, at the place whose parameter they change
    (in a series circuit, resistance at the resistor).

    In arbitrary coordinates no displacement is recognized, so no springs or friction are
    listed: use a builder or give the model in physical coordinates.

    Examples
    --------
    >>> from rcorefine import dc_motor
    >>> motor = dc_motor(gain=2.0, time_constant=0.5, inputs="voltage")
    >>> library = effect_library(motor, places="voltage")
    >>> print(library[5].explanation)
    The input voltage has a dead zone: small values do nothing, and larger ones lose that much.
    """
    physical = as_physical(model, dt=dt)
    # kinds and places to which the list is restricted
    named = _names("kinds", kinds)
    asked = None if named is None else tuple(kind_named(kind) for kind in named)
    for kind in asked or ():
        if KINDS[kind].needs_law:
            raise ct.ControlArgument(
                f"a {kind} effect needs its law; make it with Effect({kind!r}, place, law=...)"
            )
    wanted = _names("places", places)
    for place in sorted(set(wanted or ()).difference(physical.places)):
        if place[:2] not in ("A[", "B[", "C[", "D["):
            raise ModelError(f"there is no place {place!r}; the places are {', '.join(physical.places)}")
        physical.entry(place)

    # candidates at ports, inputs, outputs and entries of the matrices
    found = _at_ports(physical, asked) + _at_channels(physical, asked) + _at_entries(physical, asked, wanted)
    found += _products(physical, asked)
    # parameters of a nonlinear model
    if asked is None or ModelParameter.name in asked:
        found += [Effect(q.kind, q.place) for q in physical.parameters if q.kind == ModelParameter.name]
    found = [effect for effect in found if wanted is None or effect.place in wanted]
    if not found:
        what, where = ", ".join(asked or ("any",)), ", ".join(wanted or ("any place",))
        raise ModelError(
            f"no effect of kind {what} can sit at {where} of model {physical.name!r}; "
            f"its places are {', '.join(physical.places)}"
        )
    return found


def reads_rate(physical: PhysicalModel) -> list[bool]:
    """Return for each output whether it is a rate, such as a speed.

    Its unit says so, or its name, or its row of C if it reads the velocity of a mechanical place.
    """
    linear, motions = physical.linear, [p for p in physical.ports if p.domain in _MOTIONS]
    found = []
    for y, label in enumerate(linear.output_labels):
        row = linear.C[y]
        # outputs along the velocity of a mechanical place
        along = [p.velocity for p in motions if p.has_position and not physical.output_rate[y].any()]
        reads = any(abs(v @ row) > (1 - 1e-9) * np.linalg.norm(v) * np.linalg.norm(row) > 0 for v in along)
        # the unit decides, then the name or the row of C
        unit = physical.output_units[y]
        found.append(unit in _OF_RATES or (not unit and (bool(_RATE.search(label)) or reads)))
    return found


def zero_entries(physical: PhysicalModel) -> list[Effect]:
    """Return `coefficient` effects at entries of B, C and D that are zero.

    Only stores have them (currents, temperatures, levels): a sensor may read another store or an input, too,
    and an input may act on another store. Sensors and forces of masses sit where they are mounted; an input
    that acts on nothing may push any of them. Nothing is returned where they would be more than 20.
    """
    linear, names = physical.linear, [port.name for port in physical.ports]
    # states that are stores: currents, temperatures, levels
    store = np.ones(linear.n_states, dtype=bool)
    for port in physical.ports:
        if port.domain in _MOTIONS and f"shunt {port.name}" not in names:
            store &= (port.velocity == 0) & (port.position == 0)
    unused = ~linear.B.any(axis=0) & ~linear.D.any(axis=0)
    moving = ~store & np.any([port.velocity != 0 for port in physical.ports] or [~store], axis=0)
    # zero entries of C and D where a sensor reads stores, of B at stores
    reads = np.array([row.any() and store[row != 0].all() for row in linear.C], dtype=bool)[:, None]
    places = [
        f"{name}[{i},{j}]"
        for name, zero in (
            ("C", (linear.C == 0) & reads & store),
            ("D", (linear.D == 0) & reads),
            ("B", (linear.B == 0) & (store[:, None] | (moving[:, None] & unused))),
        )
        for i, j in np.argwhere(zero).tolist()
    ]
    return [Effect(Entry.name, place) for place in places] if len(places) <= _MOST_ENTRIES else []


def candidates_of(physical: PhysicalModel) -> list[Effect]:
    """Return the candidate effects and the possible faults of a record.

    Entries of B, C and D that are zero are candidates, too. A fault concerns a record as a whole.
    """
    inputs = physical.linear.input_labels[:1]  # such a fault is the same at all of them
    faults = [Effect(law.name, place) for law in KINDS.values() if law.of_record for place in inputs]
    return [*effect_library(physical), *zero_entries(physical), *faults]


def describe_effects(effects: Any) -> str:
    """Return effects as a table of at most 80 columns.

    Parameters
    ----------
    effects : sequence of Effect, StateSpace or PhysicalModel
        Effects; of a model what `effect_library` returns.

    Returns
    -------
    str
        One effect per line with its law, grouped by place.

    Examples
    --------
    >>> print(describe_effects([Effect("damping", "link1"), Effect("input_gain", "force")]))
    link1
      damping               f = t v
    force
      input_gain            w -> (1 + t) w
    """
    if isinstance(effects, (ct.StateSpace, PhysicalModel)):
        effects = effect_library(effects)
    effects = as_effects(effects, "effects")
    lines: list[str] = []
    for place in dict.fromkeys(effect.place for effect in effects):
        lines.append(place[:80])
        own = [effect for effect in effects if effect.place == place]
        lines += [f"  {(e.name or e.kind)[:26]:<21} {e.spec.formula}"[:80].rstrip() for e in own]
    return "\n".join(lines)


def _names(what: str, given: Any) -> tuple[str, ...] | None:
    if given is None:
        return None
    names = as_texts(given, what)
    if not names:
        raise ct.ControlArgument(f"{what} must be a name or a list of names, not an empty one")
    return names


def _at_ports(physical: PhysicalModel, asked: Sequence[str] | None) -> list[Effect]:
    # laws whose signals the port senses
    candidates = [
        (port, law)
        for port in physical.ports
        for law in KINDS.values()
        if port.kind in law.where
        and not law.needs_law
        and (port.has_position or "position" not in law.needs)
        and (port.has_velocity or "velocity" not in law.needs)
        and (law.name in asked if asked is not None else _is_plausible(physical, port, law))
    ]
    best: dict[Any, tuple[bool, Port]] = {}
    for port, law in candidates:  # of effects that act alike keep the one at the place with the parameter
        holds, key = _has_parameter(physical, port, law.belongs_to), _action(port, law)
        if key not in best or holds > best[key][0]:
            best[key] = holds, port
    held = {"tangent": 0.0} if asked is None else {}  # the model holds the slope at rest
    return [
        Effect(law.name, port.name, fixed=held if law.name == Gravity.name else {}).at_port(port.domain)
        for port, law in candidates
        if best[_action(port, law)][1] is port
    ]


def _is_plausible(physical: PhysicalModel, port: Port, law: Law) -> bool:
    """Return whether this effect is plausible at this port."""
    if law.on_request or not _suits(physical, port, law):
        return False
    if port.modal:  # modes: only stiffness and damping
        return law.name in (Stiffness.name, Damping.name)
    joined = _joins(port)
    # a body is one mass or store rather than what joins two
    flow = law.name == ConstantForce.name and port.kind == "first_order"  # from one store to another
    if law.belongs_to == Mass.name and not flow and (joined or _body_elsewhere(physical, port)):
        return False
    if port.kind == "first_order":
        return law.plausible_in_store(
            one_way=joined and not _has_both_signs(port.velocity),
            between=_has_both_signs(np.concatenate([port.velocity, port.velocity_input])),
            known_mass=_has_parameter(physical, port, Mass.name),
        )
    # every law but a spring; springs where there is one, or between two bodies
    return law.belongs_to != Stiffness.name or joined or _takes_spring(physical, port)


def _suits(physical: PhysicalModel, port: Port, law: Law) -> bool:
    """Return whether a law goes with the domain and the motion of a port."""
    if law.name == Gravity.name:  # an angle in rad, by its unit or its name
        labels = [physical.linear.state_labels[i] for i in np.flatnonzero(port.position)]
        named = len(labels) == 1 and bool(_ANGLE.search(labels[0]))
        return not _joins(port) and (port.position_unit == "rad" if port.position_unit else named)
    if law.of_speeds and port.kind == "first_order" and port.domain not in _MOTIONS:
        return False
    return not law.domains or port.domain in law.domains


def _takes_spring(physical: PhysicalModel, port: Port) -> bool:
    """Return whether a spring between a body and the ground is plausible.

    It is where the model has one, and at a mass that no other spring or body holds.
    """
    return _has_parameter(physical, port, Stiffness.name) or not any(
        _joins(other) or _has_parameter(physical, other, Stiffness.name)
        for other in physical.ports
        if other is not port and other.kind == "mechanical" and ((other.act != 0) & (port.act != 0)).any()
    )


def _joins(port: Port) -> bool:
    """Return whether a force acts on two bodies or several displacements."""
    return _has_both_signs(port.act) or bool(np.count_nonzero(port.velocity) > 1)


def _has_both_signs(row: Array) -> bool:
    return bool((row > 0).any() and (row < 0).any())


def _body_elsewhere(physical: PhysicalModel, port: Port) -> bool:
    """Return whether another port is the body that this port only holds.

    Examples are wheel and tire, or mass and load cell.
    """
    return not _has_parameter(physical, port, Mass.name) and any(
        np.array_equal(other.act, port.act)
        and (_has_parameter(physical, other, Mass.name) or (port.output.any() and not other.output.any()))
        for other in physical.ports
    )


def _has_parameter(physical: PhysicalModel, port: Port, kind: str) -> bool:
    return any(item.place == port.name and item.kind == kind for item in physical.parameters)


def _action(port: Port, law: Law) -> tuple[Any, ...]:
    """Return a key that is equal for effects that act in the same way.

    Of the signals that the port senses, only those that the effect takes count.
    """
    # signals of the port that the law takes
    arrays = [port.act, port.output]
    for signal in ("position", "velocity"):
        if signal in law.senses:
            arrays += [getattr(port, signal), getattr(port, f"{signal}_input")]
    if "acceleration" in law.senses:
        arrays.append(port.acceleration_input)
    return (law.name, *(tuple((array + 0.0).tolist()) for array in arrays))  # no negative zeros


def _at_channels(physical: PhysicalModel, asked: Sequence[str] | None) -> list[Effect]:
    linear = physical.linear
    # outputs that read displacements alone
    moved = np.zeros(linear.n_states, dtype=bool)
    for port in physical.ports:
        moved |= (port.position != 0) & (port.domain in _MOTIONS)
    reads = linear.C.any(axis=1) & ~linear.C[:, ~moved].any(axis=1) & ~physical.output_rate.any(axis=1)
    displacements = np.array(linear.output_labels)[reads].tolist()
    return [
        Effect(law.name, label)
        for channel, labels in (("input", linear.input_labels), ("output", linear.output_labels))
        for label in labels
        for law in KINDS.values()
        if channel in law.where
        and not law.needs_law
        and (not law.on_request if asked is None else law.name in asked)
        and (asked is not None or not law.of_displacements or label in displacements)
    ]


def _products(physical: PhysicalModel, asked: Sequence[str] | None) -> list[Effect]:
    """Return the effects at entries of A and B that depend on the state.

    Unless asked for, both sides are stores or inputs, and at most 6 of a kind are there: in a network every
    coupling would be one.
    """
    linear, A = physical.linear, physical.linear.A
    # stores with a port of their own
    single = [p for p in physical.ports if p.kind == "first_order" and not _joins(p) and not p.modal]
    store = np.any([p.act != 0 for p in single] or [np.zeros(len(A), dtype=bool)], axis=0)
    if asked is not None:
        store[:] = True
    elif is_companion(A, _ROUNDING):
        store[:] = False
    # couplings between two stores, off the diagonal
    coupled = (A != 0) & store[:, None] & store & ~np.eye(len(A), dtype=bool)
    found = []
    for kind, name, there in (
        (StateDependentGain.name, "B", (linear.B != 0) & store[:, None]),
        (ProductOfStates.name, "A", coupled),
    ):
        places = [f"{name}[{i},{j}]" for i, j in np.argwhere(there).tolist()]
        if (len(places) <= _MOST_PRODUCTS) if asked is None else kind in asked:
            found += [Effect(kind, place) for place in places]
    return found


def _at_entries(
    physical: PhysicalModel, asked: Sequence[str] | None, wanted: Sequence[str] | None
) -> list[Effect]:
    """Return `coefficient` effects at entries of the matrices.

    They are the named entries, or those that remain after the ports are subtracted.
    """
    if asked is not None and Entry.name not in asked:
        return []
    if wanted is not None:
        return [Effect(Entry.name, place) for place in wanted if place not in physical.places]
    # entries that no port explains
    listed = [item.place for item in physical.parameters if item.kind == Entry.name]
    if asked is None:
        own = {int(np.flatnonzero(port.act)[0]) for port in physical.ports if not _joins(port)}
        # the damping of a first-order state is its diagonal entry already
        diagonal = {(state, state) for state in own}
        listed = [place for place in listed if physical.entry(place) not in diagonal]
        if len(listed) > _MOST_ENTRIES:  # too many: only entries of A
            listed = [place for place in listed if place.startswith("A")]
        if len(listed) > _MOST_ENTRIES:
            return []
    elif not listed:
        listed = [f"A[{i},{j}]" for i, j in np.argwhere(physical.linear.A).tolist()]
    return [Effect(Entry.name, place) for place in listed]
