"""Any model as a physical one, and the places that it has."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from numbers import Real
from typing import Any
from weakref import WeakKeyDictionary

import control as ct
import numpy as np

from ..arguments import as_list, as_mapping, as_number, as_text, shown
from ..effects.bodies import Mass
from ..effects.effect import Effect
from ..effects.law import KINDS
from ..effects.right_hand_side import Field, ModelParameter, Remainder, RightHandSide, exact_slopes
from ..exceptions import ModelError
from ..systems.discretization import check_sampling_time
from ..systems.linear import Array, LinearModel, realized
from .controller import HELD, as_controller, unrecorded
from .detection import recognize
from .incidence import Declared
from .links import weighted
from .operating_point import as_operating_point
from .parameters import NominalParameter, combine_units
from .physical_model import PhysicalModel
from .ports import Port

_KNOWN: WeakKeyDictionary[Any, Any] = WeakKeyDictionary()  # models, and what they hold


def is_nonlinear(model: Any) -> bool:
    """Return whether a model is a nonlinear system of python-control.

    A StateSpace does not count, although its class is derived from that of nonlinear systems.
    """
    return isinstance(model, ct.NonlinearIOSystem) and not isinstance(model, ct.StateSpace)


def as_known(system: ct.NonlinearIOSystem) -> PhysicalModel:
    """Return the physical model of a system without declarations.

    Its functions are compiled, so it is made anew only if the system, or what its functions read, has changed
    since, or if that cannot be known.
    """
    model, before = _KNOWN.get(system, (None, None))
    if not before or _held(system, model) != before:
        model = from_nonlinear(system)
        _KNOWN[system] = model, _held(system, model)
    return model  # type: ignore[no-any-return]


def _held(system: ct.NonlinearIOSystem, model: Any) -> Any:
    """Return what a model would hold of its system as it is now.

    It is empty if that is not known.
    """
    read = model.operating_point.field.read(_functions(system))
    return read and (read, repr(vars(system)))


def _functions(system: ct.NonlinearIOSystem) -> RightHandSide:
    # numbers among the parameters may be estimated, other values are held
    names = tuple(k for k, v in system.params.items() if isinstance(v, Real) and not isinstance(v, bool))
    others = {k: v for k, v in system.params.items() if k not in names}
    n, ny = system.nstates, system.noutputs
    return RightHandSide(system.updfcn, system.outfcn, names, others, n, ny, f"{system.name!r}")


def from_nonlinear(
    system: ct.NonlinearIOSystem,
    declared: Declared | None = None,
    operating_point: Mapping[str, Any] | None = None,
) -> PhysicalModel:
    """Physical model of a nonlinear system.

    Parameters
    ----------
    system : NonlinearIOSystem
        In continuous time, its functions independent of time.
    declared : Declared, optional
        Links, units and masses.
    operating_point : mapping, optional
        As in `physical`; where the model is linearized for observers and starts, default the origin.

    Returns
    -------
    PhysicalModel
        Its linear part, with ports found there, and the field; numbers among `params` are its parameters.

    Raises
    ------
    ModelError
        If the system is in discrete time, has no states, depends on time, or gives no numbers at the point.
    """
    if system.dt not in (0, None):
        raise ModelError(
            f"{system.name!r} is in discrete time; give a nonlinear model in continuous time, dx/dt = f"
        )
    if not system.nstates or system.ninputs is None or system.noutputs is None:
        raise ModelError(
            f"{system.name!r} does not say how many states, inputs and outputs it has; "
            "name them: control.nlsys(..., states=[...], inputs=[...], outputs=[...])"
        )
    n, nw, ny = system.nstates, system.ninputs, system.noutputs
    functions = _functions(system)
    # the numbers are the parameters of the model
    numbers = tuple(
        NominalParameter(name, float(system.params[name]), "", ModelParameter.name, name)
        for name in functions.names
    )
    nominal = np.array([q.value for q in numbers])
    A, B, C, D = (np.zeros((rows, columns)) for rows in (n, ny) for columns in (n, nw))
    labels = system.input_labels, system.output_labels, system.state_labels
    bare = LinearModel(A, B, C, D, 0, *map(tuple, labels), system.name)  # type: ignore[call-arg, arg-type]
    # linearize about the declared point, or about the origin
    given = {"inputs": np.zeros(nw), "states": np.zeros(n)} if operating_point is None else operating_point
    point = as_operating_point(given, bare)
    level = np.concatenate([point.states, point.inputs])
    here = _check_rates(functions, level, nominal)
    # slopes: exact ones where the functions can be traced and agree with differences
    L, exact = _slopes(functions, level, nominal), exact_slopes(functions, level, nominal)
    if not np.isfinite(L).all():
        raise ModelError(_NOWHERE.format(label=functions.label, what="have no slope"))
    if exact is not None and np.allclose(exact, L, rtol=1e-6, atol=1e-9 * np.abs(L).max(initial=0.0)):
        L = exact  # not at a corner, where the traced path may be another one
    linear = bare.with_arrays(A=L[:n, :n], B=L[:n, n:], C=L[n:, :n], D=L[n:, n:])
    # places of the linear part
    model = recognize(PhysicalModel, linear.to_statespace(), None, declared)
    if operating_point is None or "outputs" not in operating_point:
        point = replace(point, outputs=here[n:])
    # linear part of the outputs without the rates that they read, as the field takes it
    straight = np.vstack([L[:n], np.hstack([model.output_state, model.output_input])])
    field = Field(Remainder(functions, nominal, level, straight, model.output_rate, point.outputs))
    return replace(model, parameters=numbers, operating_point=replace(point, field=field))


def _check_rates(functions: RightHandSide, level: Array, nominal: Array) -> Array:
    """Return rates and outputs at a point, after checks.

    They must not depend on time, and there must be as many as declared.
    """
    n = functions.n_states
    # autonomous: the same rates at two times
    first, later = (functions(level[:n], level[n:], nominal, t) for t in (0.0, 1.7))
    if first.size != n + functions.n_outputs:
        raise ModelError(
            f"the functions of {functions.label} give {first.size} numbers for {n} states and "
            f"{functions.n_outputs} outputs"
        )
    if not np.isfinite(first).all():
        raise ModelError(_NOWHERE.format(label=functions.label, what="are no numbers"))
    if not np.array_equal(first, later):
        raise ModelError(f"{functions.label} depends on time; make what changes with time an input")
    return first


_NOWHERE = (
    "the functions of {label} {what} at the point about which they are linearized (the origin, unless "
    "declared): give physical(system, operating_point={{'inputs': ..., 'states': ...}}) where it works"
)


def _slopes(functions: RightHandSide, level: Array, nominal: Array) -> Array:
    """Return the derivatives by states and inputs.

    They are Richardson's central differences, rounded to ten digits.
    """
    n = functions.n_states

    # central difference
    def central(j: int, h: float) -> Array:
        step = h * np.eye(level.size)[j]
        with np.errstate(all="ignore"):
            up, low = (functions((level + s)[:n], (level + s)[n:], nominal) for s in (step, -step))
        return (up - low) / (2.0 * h)

    # Richardson extrapolation: (4 D(h/2) - D(h)) / 3
    steps = 1e-3 * np.maximum(np.abs(level), 1.0)
    found = np.column_stack([(4.0 * central(j, 0.5 * h) - central(j, h)) / 3.0 for j, h in enumerate(steps)])
    size = np.abs(found).max(axis=1, initial=0.0, keepdims=True)
    # rounding becomes zero, the rest is rounded to ten digits
    found[np.abs(found) < 1e-9 * size] = 0.0
    digits: Array = 9.0 - np.floor(np.log10(np.abs(found) + (found == 0.0)))
    return np.round(found * 10.0**digits) / 10.0**digits


def as_model(model: Any) -> Any:
    """Return the model, converted if necessary.

    A transfer function is converted to state space, a nonlinear system to a physical model.
    """
    if isinstance(model, ct.TransferFunction):
        return realized(model)
    return as_known(model) if is_nonlinear(model) else model


def known_physical(model: Any) -> PhysicalModel | None:
    """Return the physical model that belongs to a model, or None."""
    physical = getattr(model, "physical_model", model)
    return physical if isinstance(physical, PhysicalModel) else None


def as_physical(model: Any, *, dt: float | None = None) -> PhysicalModel:
    """Physical model behind whatever a user hands over.

    Parameters
    ----------
    model : StateSpace, PhysicalModel, or object with a `physical_model`
        A plain `StateSpace` is searched for ports.
    dt : float, optional
        Sampling time [s] of a discrete-time `StateSpace` that does not tell its own.

    Returns
    -------
    PhysicalModel
        The model itself if it is one.

    Raises
    ------
    control.ControlArgument
        If it is none of these.

    Examples
    --------
    >>> as_physical(ct.ss([[-1.0]], [[1.0]], [[1.0]], 0, states=["T"])).ports[0].name
    'T'
    """
    if dt is not None:
        check_sampling_time(dt)
    known = known_physical(as_model(model))
    return PhysicalModel.from_statespace(model, dt=dt) if known is None else known


def under_control(model: Any, controller: Any, data: Any) -> Any:
    """Return `as_model` of the model, with its controller for these records.

    The controller is the given one, or the one that the model has.
    """
    model = as_model(model)
    # the given controller, or the one that the model has
    physical = known_physical(model) if controller is None else as_physical(model)
    known = None if physical is None else physical.controller
    records = data if isinstance(data, (list, tuple)) else [data]
    if controller is not None and physical is not None:
        known = as_controller(controller, physical.linear, records)
    if known is None or physical is None:
        return model
    # does a record lack an input that the controller drives?
    known = replace(known, recorded=not any(unrecorded(known.driven, physical.linear, r) for r in records))
    closed = replace(physical, controller=known)
    if not hasattr(model, "physical_model"):
        return closed
    # refinement under another controller: other known effects
    held = known.effects if controller is not None and hasattr(model, "roles") else None
    return replace(model, physical_model=closed, **({} if held is None else _replace_known(model, held)))


def _replace_known(model: Any, held: tuple[Effect, ...]) -> dict[str, Any]:
    """Return the fields of a refinement under another controller.

    Raises
    ------
    ModelError
        If the refinement itself has an effect of the controller.
    """
    # effects of the refinement itself
    kept = [i for i, role in enumerate(model.roles) if role != HELD]
    own = {(model.effects[i].kind, model.effects[i].place) for i in kept}
    for effect in held:
        if (effect.kind, effect.place) in own:
            raise ModelError(
                f"{effect.label} is an effect of the model and of the controller; leave it out of one of them"
            )
    return {
        "effects": (*(model.effects[i] for i in kept), *held),
        "roles": (*(model.roles[i] for i in kept), *[HELD] * len(held)),
        # indices of the effects have changed
        "constants": {kept.index(i): width for i, width in model.constants.items()},
    }


def ports(model: ct.StateSpace | Any, *, dt: float | None = None) -> tuple[Port, ...]:
    """List the places where an effect could be missing.

    Parameters
    ----------
    model : StateSpace or PhysicalModel
        In a plain `StateSpace` the ports are found: see
        `PhysicalModel.from_statespace`.
    dt : float, optional
        Sampling time [s] of a discrete-time model that does not tell its own.

    Returns
    -------
    tuple of Port
        Ports in the order of the states, the relative ones after them.

    Raises
    ------
    control.ControlArgument
        If `model` is neither.

    Examples
    --------
    >>> A = [[0, 0, 1, 0], [0, 0, 0, 1], [-2, 1, 0, 0], [1, -2, 0, 0]]
    >>> B, C = [[0], [0], [1], [0]], [[0, 0, 1, 0]]
    >>> model = ct.ss(A, B, C, 0, states=["x1", "x2", "v1", "v2"])
    >>> [port.name for port in ports(model)]
    ['x1', 'x2', 'x1-x2']
    """
    return as_physical(model, dt=dt).ports


def physical(
    system: ct.StateSpace | Any,
    *,
    links: Mapping[str, Mapping[str, float]] | None = None,
    units: Mapping[str, str] | None = None,
    parameters: Mapping[str, tuple[str, str, float]] | None = None,
    operating_point: Mapping[str, Any] | None = None,
    dt: float | None = None,
) -> PhysicalModel:
    """Say what is known about a plain model: its links, units and masses.

    Parameters
    ----------
    system : StateSpace or PhysicalModel
        Linear model in physical coordinates.
    links : mapping of str to mapping of str to float, optional
        ``{name: {state: weight}}``: the link senses d = sum of weight times state, and its force acts
        back along the same weights. The states are displacements (a shaft behind a gear,
        ``{"th1": 1/5, "th2": -1}``), speeds, or stores (a flow between two levels). The other end may
        be an input, with the unit of these states: ``{"wheel": 1, "road": -1}``.
    units : mapping of str to str, optional
        ``{signal: unit}`` of states, inputs and outputs. States of different units are not
        subtracted where links are searched for.
    parameters : mapping of str to (kind, place, value), optional
        Numbers that the model was built from: ``{"J1": ("mass", "th1", 0.01), "k": ("stiffness",
        "shaft", 120.0)}``. A mass makes the forces at its place, and at all that is linked to
        it, physical ones; the others name what `refine` and `diagnose` report.
    operating_point : mapping, optional
        ``{"inputs": ..., "states": ..., "outputs": ...}``, each numbers in order or ``{signal: value}``:
        where the plant rests, and about which the model is linear. Records, and states given or
        returned, are absolute then, and laws feel absolute values: drag grows with v^2, not with the
        square of what v has above 24 m/s. What a law gives at the point is part of the balance there,
        and only the rest of it is added. Without ``"outputs"`` they are what the states and inputs
        of the point give.
    dt : float, optional
        Sampling time [s] of a discrete-time `StateSpace` that does not tell its own.

    Returns
    -------
    PhysicalModel
        Of a nonlinear system with the numbers that its functions read now; after a change call it again.
        What was declared, and beside it what the matrices tell; see `PhysicalModel.from_statespace`.

    Raises
    ------
    ModelError
        If a link, a unit or a parameter names what does not exist, or a link joins what cannot be
        added; the message says which.

    Examples
    --------
    >>> import numpy as np
    >>> g, J, k = np.array([1 / 5, -1.0]), np.array([[0.01], [0.3]]), 120.0
    >>> A = np.block([[np.zeros((2, 2)), np.eye(2)], [-k * np.outer(g, g) / J, -0.1 * np.eye(2)]])
    >>> drive = ct.ss(A, [[0], [0], [100], [0]], [[0, 0, 1, 0]], 0, states=["th1", "th2", "w1", "w2"])
    >>> model = physical(drive, links={"shaft": {"th1": 1 / 5, "th2": -1}}, units={"th1": "rad"})
    >>> round(next(q.value for q in model.parameters if q.place == "shaft"))
    120
    """
    # declarations: links, units, parameters
    given = {name: _weights(name, ends) for name, ends in as_mapping(links, "links", "weights").items()}
    named = {k: as_text(v, f"unit of {k!r}") for k, v in as_mapping(units, "units", "units").items()}
    numbers = {k: _number(k, v) for k, v in as_mapping(parameters, "parameters", "parameters").items()}
    masses = {place: value for kind, place, value in numbers.values() if kind == Mass.name}
    declared = Declared(given, named, masses)
    # places by the structure of the matrices, together with the declarations
    if is_nonlinear(system):
        model = from_nonlinear(system, declared, operating_point)
    elif isinstance(system, ct.StateSpace):
        model = recognize(PhysicalModel, system, dt, declared)
    else:
        model = as_physical(system, dt=dt)
    # declared links that join existing places
    own = {port.name for port in model.ports}
    more = [_sum_port(model, name, ends) for name, ends in given.items() if name not in own]
    model = _in_units(replace(model, ports=(*model.ports, *more)), named)
    model = replace(model, parameters=_merge_parameters(model, numbers))
    if operating_point is None or model.operating_point is not None:
        return model
    return replace(model, operating_point=as_operating_point(operating_point, model.linear))


def _weights(name: str, ends: Any) -> dict[str, float]:
    weights = as_mapping(ends, f"link {name!r}", "weights")
    found = {k: as_number(v, f"weight of {k!r} in link {name!r}") for k, v in weights.items()}
    if not name or not found or not all(found.values()):
        raise ModelError(f"link {name!r} needs a name, and states with weights that are not zero")
    return found


def _number(name: str, given: Any) -> tuple[str, str, float]:
    entry = as_list(given, f"parameter {name!r}", "kind, place and value")
    if len(entry) != 3 or not isinstance(entry[0], str) or not isinstance(entry[1], str):
        raise ct.ControlArgument(
            f"parameter {name!r} must be (kind, place, value) such as ('mass', 'x1', 2.0), not {shown(given)}"
        )
    if entry[0] not in KINDS or not KINDS[entry[0]].is_parameter:
        known = ", ".join(kind for kind, law in KINDS.items() if law.is_parameter)
        raise ModelError(f"parameter {name!r} cannot be of kind {entry[0]!r}; the kinds are {known}")
    return entry[0], entry[1], as_number(entry[2], f"value of parameter {name!r}")


def _sum_port(model: PhysicalModel, name: str, weights: Mapping[str, float]) -> Port:
    """Port of a link that joins places of the model, or a place and an input."""
    linear = model.linear
    # ends of the link: states and inputs
    states = [label for label in weights if label in linear.state_labels]
    inputs = [label for label in weights if label not in linear.state_labels]
    strange = [label for label in inputs if label not in linear.input_labels]
    if strange:
        raise ModelError(
            f"link {name!r} names {strange[0]!r}, which is neither a state "
            f"({', '.join(linear.state_labels)}) nor an input ({', '.join(linear.input_labels)})"
        )
    if not states:
        raise ModelError(f"link {name!r} joins inputs alone; give it a state to act on")
    ends = [(_own_port(model, name, label), weights[label]) for label in states]
    # only displacements, speeds or stores are added to each other
    kinds = {(port.kind, port.has_position) for port, _ in ends}
    if len(kinds) > 1:
        raise ModelError(
            f"link {name!r} adds {', '.join(states)}, which are not of one sort (displacements, speeds, "
            "stores); write it in states of one sort"
        )
    (kind, positioned) = kinds.pop()
    direct = np.array([weights[label] if label in inputs else 0.0 for label in linear.input_labels])
    # weighted sum of the rows of the ports
    rows = {
        key: sum(size * getattr(port, key) for port, size in ends)
        for key in ("act", "position", "velocity", "velocity_input", "acceleration_input")
    }
    if not positioned:
        rows["velocity_input"] = rows["velocity_input"] + direct
    # an input is the unit of the displacement, or of the velocity where there is none
    elif inputs:  # the rate of the input is unknown
        rows |= {"velocity": np.zeros(linear.n_states), "velocity_input": 0.0 * direct}
    at_once = direct if positioned else 0.0 * direct
    words = f"declared, {'d' if positioned else 'v'} = {weighted(weights)}"
    return Port(name, kind, position_input=at_once, description=words, **rows)


def _own_port(model: PhysicalModel, name: str, label: str) -> Port:
    """The port that senses one state alone."""
    state = model.linear.state_labels.index(label)
    row = np.eye(model.linear.n_states)[state]
    # a port whose displacement is this state alone
    for port in model.ports:
        if not port.position_input.any() and np.array_equal(port.position, row):
            return port
    # a port whose velocity is this state alone, with positive sign
    for port in model.ports:
        if not port.velocity_input.any() and np.flatnonzero(port.velocity).tolist() == [state]:
            sign, none = np.sign(port.velocity[state]), 0.0 * port.position_input
            return replace(port, position=0.0 * row, position_input=none, velocity=row, act=sign * port.act)
    sensed = ", ".join(port.name for port in model.ports) or "none"
    raise ModelError(
        f"link {name!r} needs state {label!r}, at which no force of its own is known; the places are "
        f"{sensed}. Give the model in displacements, velocities and stores"
    )


def _in_units(model: PhysicalModel, units: Mapping[str, str]) -> PhysicalModel:
    """Return the model with the units of its signals.

    The units at its ports follow from these.
    """
    linear = model.linear
    signals = (linear.state_labels, linear.input_labels, linear.output_labels)
    for label in units:
        if not any(label in labels for labels in signals):
            raise ModelError(
                f"units names {label!r}, which is no signal; there are {', '.join(sum(signals, ()))}"
            )
    old = (model.state_units, model.input_units, model.output_units)
    # declared units by signal
    state, entry, read = (
        tuple(map(units.get, labels, given)) for labels, given in zip(signals, old, strict=True)
    )
    ports = []
    for port in model.ports:
        # velocity unit: given, or that of the position per second, or that of the state
        position = port.position_unit or _unit_of(port.position, state)
        rate = combine_units("position/s", {"position": position})
        velocity = port.velocity_unit or rate or _unit_of(port.velocity, state)
        ports.append(replace(port, position_unit=position, velocity_unit=velocity))
    return replace(model, ports=tuple(ports), state_units=state, input_units=entry, output_units=read)


def _unit_of(row: np.ndarray[Any, Any], units: tuple[str, ...]) -> str:
    """Unit of a sum: that of the state that counts whole."""
    entries = np.flatnonzero(row)
    if not entries.size:
        return ""
    return units[int(entries[np.argmin(np.abs(np.abs(row[entries]) - 1.0))])]


def _merge_parameters(
    model: PhysicalModel, numbers: Mapping[str, tuple[str, str, float]]
) -> tuple[NominalParameter, ...]:
    """Return the declared parameters and those read from the matrices."""
    declared = []
    for name, (kind, place, value) in numbers.items():
        try:
            effect = model.check(Effect(kind, place))
        except ModelError as error:
            raise ModelError(f"parameter {name!r}: {error}") from error
        declared.append(NominalParameter(name, value, model.unit(effect, effect.free[0]), kind, place))
    # declared parameters replace those found at the same place
    held = {(item.kind, item.place) for item in declared}
    return (*declared, *(item for item in model.parameters if (item.kind, item.place) not in held))
