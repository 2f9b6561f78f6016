"""Machines: DC motor and quarter car."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import control as ct

from ... import arguments
from ...arguments import as_choice, as_flag, as_text
from ...exceptions import ModelError
from ..parameters import NominalParameter, combine_units
from ..physical_model import PhysicalModel
from ._equations import BuilderEquations, Reading, Row, as_number, as_sensors, total


def dc_motor(
    *,
    gain: float | None = None,
    time_constant: float | None = None,
    R: float | None = None,
    L: float | None = None,
    Kt: float | None = None,
    Ke: float | None = None,
    J: float | None = None,
    b: float | None = None,
    load_torque: bool = False,
    sensors: str | Sequence[str] = "speed",
    inputs: str | Sequence[str] | None = None,
    outputs: str | Sequence[str] | None = None,
    states: Sequence[str] | None = None,
    angle_unit: str = "rad",
    name: str = "dc_motor",
) -> PhysicalModel:
    """DC motor, from gain and time constant or from its parts.

    Parameters
    ----------
    gain : float, optional
        Steady speed per volt [rad/(s V)], not zero. With `time_constant` this makes the
        speed model tau dv/dt + v = gain * voltage.
    time_constant : float, optional
        Time constant tau [s], positive.
    R, L : float, optional
        Resistance [Ohm] and inductance [H] of the winding, positive.
    Kt : float, optional
        Torque constant [N m/A], positive.
    Ke : float, optional
        Voltage constant [V s/rad]; default the same number as `Kt`.
    J : float, optional
        Inertia [kg m^2], positive. `R`, `L`, `Kt` and `J` make the electromechanical
        model: L di/dt = voltage - R i - Ke v, J dv/dt = Kt i - b v - load.
    b : float, optional
        Viscous friction [N m s/rad], default 0.
    load_torque : bool, optional
        Whether a load torque [N m] is a second input (electromechanical model only).
    sensors : str or sequence of str, optional
        ``"speed"`` (default), ``"angle"``, ``"current"`` (electromechanical model only). Only
        with ``"angle"`` is the angle a state.
    inputs, outputs, states : str or sequence of str, optional
        Labels.
    angle_unit : str, optional
        Unit of the angle, as in the numbers given; with ``"rev"`` speed is in rev/s.
    name : str, optional
        Name of the system.

    Returns
    -------
    PhysicalModel
        Model with the mechanical port ``"shaft"`` (friction, inertia) and, in the
        electromechanical model, the first-order port ``"winding"``.

    Raises
    ------
    control.ControlArgument
        If the parameters of neither model are complete, or those of both are given.
    ModelError
        If a value is not positive.

    Notes
    -----
    In the speed model forces at the shaft are in volts, that is, as the voltage that overcomes
    them: damping 1/gain [V s/rad], inertia tau/gain [V s^2/rad].

    Examples
    --------
    >>> model = dc_motor(gain=2.0, time_constant=0.5)
    >>> model.system.A, model.port("shaft").act
    (array([[-2.]]), array([-4.]))
    >>> dc_motor(R=1.0, L=1e-3, Kt=0.1, J=1e-3, sensors=["angle", "current"]).linear.state_labels
    ('angle', 'speed', 'current')
    """
    parts = {"R": R, "L": L, "Kt": Kt, "J": J}
    # first-order speed model, or electromechanical model
    simple = gain is not None or time_constant is not None
    given = [key for key, value in {**parts, "Ke": Ke, "b": b}.items() if value is not None]
    if simple and given:
        raise ct.ControlArgument(
            f"give gain and time_constant, or R, L, Kt and J, not both (got {', '.join(given)} as well)"
        )
    asked = as_sensors(sensors, ["speed", "angle"] if simple else ["speed", "angle", "current"])
    as_flag(load_torque, "load_torque")
    units = {"angle": as_text(angle_unit, "angle_unit")}
    units |= {"speed": combine_units("angle/s", units), "current": "A"}
    # state equations of the motor
    if simple:
        motor = _speed_model(gain, time_constant, load_torque)
    else:
        motor = _electromechanical(parts, Ke, b, load_torque)
    # the angle is a state only where it is measured
    rates = {"angle": {"speed": 1.0}, **motor.rates} if "angle" in asked else motor.rates
    channels = {"voltage": "V"} | ({"load_torque": "N m"} if load_torque else {})
    equations = BuilderEquations(rates, {state: units[state] for state in rates}, channels)
    at_shaft = {"position": units["angle"], "velocity": units["speed"], "force": motor.force_unit}
    words = "shaft against the housing: friction, inertia"
    if simple:
        words += ", torques as the voltage that overcomes them"
    # port at the shaft: a resisting torque decelerates it, act = -1/J
    speed, current = {"speed": 1.0}, {"current": 1.0}
    ports = [
        equations.port(
            "shaft",
            words,
            {"speed": -1.0 / motor.mass},
            speed,
            {"angle": 1.0},
            units=tuple(at_shaft.values()),
        )
    ]
    # nominal parameters: inertia and viscous friction at the shaft
    parameters = [
        NominalParameter(name, value, combine_units(rule, at_shaft), kind, "shaft")
        for name, value, rule, kind in (
            (motor.names[0], motor.mass, "force s/velocity", "mass"),
            (motor.names[1], motor.friction, "force/velocity", "damping"),
        )
    ]
    # port at the winding, first order in the current
    if motor.winding is not None:
        R, L = motor.winding
        words = "winding: voltage drop by the current"
        ports.append(equations.port("winding", words, {"current": -1.0 / L}, current, units=("", "A", "V")))
        parameters.append(NominalParameter("L", L, "H", "mass", "winding"))
        parameters.append(NominalParameter("R", R, "Ohm", "damping", "winding"))
    readings = {sensor: Reading(units[sensor], {sensor: 1.0}) for sensor in asked}
    return equations.build(readings, ports, parameters, (inputs, outputs, states, name))


class _Motor(NamedTuple):
    """Equations and parameters of a motor.

    The parameters are mass and friction at the shaft, with their names, and R and L of a winding.
    """

    rates: dict[str, Row]
    mass: float
    friction: float
    names: tuple[str, str]
    force_unit: str
    winding: tuple[float, float] | None = None


def _speed_model(gain: float | None, time_constant: float | None, load_torque: bool) -> _Motor:
    if gain is None or time_constant is None:
        raise ct.ControlArgument("the speed model needs both gain and time_constant")
    if load_torque:
        raise ct.ControlArgument("load_torque needs the electromechanical model (R, L, Kt, J)")
    # tau dv/dt + v = gain u, with the sizes of inertia and friction in volts
    gain = arguments.as_number(gain, "gain", error=ModelError)
    size, tau = as_number(abs(gain), "the size of gain"), as_number(time_constant, "time_constant")
    speed = {"speed": -1.0 / tau, "voltage": gain / tau}
    # resisting forces oppose the motion whatever the sign of the gain
    return _Motor({"speed": speed}, tau / size, 1.0 / size, ("tau/gain", "1/gain"), "V")


def _electromechanical(parts: dict[str, float | None], Ke: Any, b: Any, load_torque: bool) -> _Motor:
    missing = [key for key, value in parts.items() if value is None]
    if missing:
        raise ct.ControlArgument(
            "give gain and time_constant (speed model), or R, L, Kt and J (electromechanical model); "
            f"{', '.join(missing)} missing"
        )
    R, L, Kt, J = (as_number(number, key) for key, number in parts.items())
    voltage_constant = Kt if Ke is None else as_number(Ke, "Ke")
    friction = 0.0 if b is None else as_number(b, "b", positive=False)
    # J dv/dt = Kt i - b v - load
    speed = {"speed": -friction / J, "current": Kt / J} | ({"load_torque": -1.0 / J} if load_torque else {})
    # L di/dt = u - R i - Ke v
    current = {"speed": -voltage_constant / L, "current": -R / L, "voltage": 1.0 / L}
    return _Motor({"speed": speed, "current": current}, J, friction, ("J", "b"), "N m", (R, L))


def quarter_car(
    body_mass: float,
    wheel_mass: float,
    suspension_stiffness: float,
    suspension_damping: float,
    tire_stiffness: float,
    tire_damping: float = 0.0,
    *,
    road: str = "velocity",
    actuator: bool = False,
    sensors: str | Sequence[str] = ("body_acceleration", "suspension_deflection"),
    inputs: str | Sequence[str] | None = None,
    outputs: str | Sequence[str] | None = None,
    states: Sequence[str] | None = None,
    name: str = "quarter_car",
) -> PhysicalModel:
    """Quarter-car model on a road.

    Parameters
    ----------
    body_mass, wheel_mass : float
        Sprung and unsprung mass [kg], positive.
    suspension_stiffness : float
        Spring between body and wheel [N/m], positive.
    suspension_damping : float
        Damper between body and wheel [N s/m], not negative.
    tire_stiffness : float
        Spring between wheel and road [N/m], positive.
    tire_damping : float, optional
        Damper between wheel and road [N s/m]; only with ``road="velocity"``.
    road : {"velocity", "displacement"}, optional
        What the road input is: the vertical velocity of the road under the wheel [m/s],
        the states being deflections, or its height [m], the states being positions.
    actuator : bool, optional
        Whether a force between wheel and body (pushing them apart) [N] is a second input.
    sensors : str or sequence of str, optional
        Any of ``"body_acceleration"``, ``"wheel_acceleration"``, ``"suspension_deflection"``,
        ``"tire_deflection"``, ``"body_velocity"``, ``"wheel_velocity"``, and with
        ``road="displacement"`` ``"body_position"``, ``"wheel_position"``.
    inputs, outputs, states : str or sequence of str, optional
        Labels.
    name : str, optional
        Name of the system.

    Returns
    -------
    PhysicalModel
        Model with the ports ``"suspension"`` (d = body - wheel), ``"tire"`` (d = wheel -
        road), ``"body"`` and ``"wheel"``.

    Raises
    ------
    control.ControlArgument
        If a sensor or the kind of road input is unknown.
    ModelError
        If a value is out of range.

    Notes
    -----
    m_b z_b'' = -k_s (z_b - z_w) - c_s (z_b' - z_w') + u and
    m_w z_w'' = k_s (z_b - z_w) + c_s (z_b' - z_w') - k_t (z_w - z_r) - c_t (z_w' - z_r') - u,
    about equilibrium. With the height of the road as the input its velocity is unknown, so there
    ``"tire"`` senses no velocity and `tire_damping` must be zero.

    Examples
    --------
    >>> model = quarter_car(250.0, 35.0, 16e3, 1e3, 160e3)
    >>> model.linear.state_labels
    ('suspension', 'tire', 'body_velocity', 'wheel_velocity')
    """
    # masses, springs and dampers
    mb, mw = as_number(body_mass, "body_mass"), as_number(wheel_mass, "wheel_mass")
    ks = as_number(suspension_stiffness, "suspension_stiffness")
    kt = as_number(tire_stiffness, "tire_stiffness")
    cs = as_number(suspension_damping, "suspension_damping", positive=False)
    c_tire = as_number(tire_damping, "tire_damping", positive=False)
    height = as_choice(road, "road", ["velocity", "displacement"]) == "displacement"
    as_flag(actuator, "actuator")
    if c_tire and height:
        raise ct.ControlArgument('tire_damping needs the velocity of the road; use road="velocity"')
    # elongations of suspension and tire, and their rates, by states and inputs
    body, wheel = "body_velocity", "wheel_velocity"
    sprung: Row = {body: 1.0, wheel: -1.0}
    rolling: Row = {} if height else {wheel: 1.0, "road": -1.0}
    # input is the height of the road: states are positions; its velocity: states are elongations
    if height:
        suspension: Row = {"body_position": 1.0, "wheel_position": -1.0}
        tire: Row = {"wheel_position": 1.0, "road": -1.0}
        moved: dict[str, Row] = {"body_position": {body: 1.0}, "wheel_position": {wheel: 1.0}}
    else:
        suspension, tire = {"suspension": 1.0}, {"tire": 1.0}
        moved = {"suspension": sprung, "tire": rolling}
    # force of spring and damper of the suspension, force of the actuator
    strut, pushed = total((ks, suspension), (cs, sprung)), {"force": 1.0}
    # Newton's second law of body and wheel
    rates = {
        **moved,
        body: total((-1.0 / mb, strut), (1.0 / mb, pushed)),
        wheel: total((1.0 / mw, strut), (-kt / mw, tire), (-c_tire / mw, rolling), (-1.0 / mw, pushed)),
    }
    channels = {"road": "m" if height else "m/s"} | ({"force": "N"} if actuator else {})
    equations = BuilderEquations(rates, dict(zip(rates, ("m", "m", "m/s", "m/s"), strict=True)), channels)
    # sensors by name
    readings = {
        "body_acceleration": Reading("m/s^2", {}, {body: 1.0}),
        "wheel_acceleration": Reading("m/s^2", {}, {wheel: 1.0}),
        **{
            state: Reading(unit, {state: 1.0})
            for state, unit in equations.states.items()
            if state.endswith(("velocity", "position"))
        },
        "suspension_deflection": Reading("m", suspension),
        "tire_deflection": Reading("m", tire),
    }
    asked = as_sensors(sensors, list(readings))
    # resisting forces at the ports; the suspension acts on body and wheel with opposite signs
    on_body, on_wheel = {body: -1.0 / mb}, {wheel: -1.0 / mw}
    between = {body: -1.0 / mb, wheel: 1.0 / mw}
    ports = [
        equations.port(place, words, act, rate, length, units=("m", "m/s", "N"))
        for place, words, act, rate, length in (
            ("suspension", "spring and damper under the body", between, sprung, suspension),
            ("tire", "tire, between wheel and road", on_wheel, rolling, tire),
            ("body", "body itself", on_body, {body: 1.0}, {"body_position": 1.0}),
            ("wheel", "wheel itself", on_wheel, {wheel: 1.0}, {"wheel_position": 1.0}),
        )
    ]
    # nominal parameters
    parameters = [
        NominalParameter("body_mass", mb, "kg", "mass", "body"),
        NominalParameter("wheel_mass", mw, "kg", "mass", "wheel"),
        NominalParameter("suspension_damping", cs, "N s/m", "damping", "suspension"),
        NominalParameter("suspension_stiffness", ks, "N/m", "stiffness", "suspension"),
        NominalParameter("tire_stiffness", kt, "N/m", "stiffness", "tire"),
    ]
    if not height:
        parameters.append(NominalParameter("tire_damping", c_tire, "N s/m", "damping", "tire"))
    chosen = {sensor: readings[sensor] for sensor in asked}
    return equations.build(chosen, ports, parameters, (inputs, outputs, states, name))
