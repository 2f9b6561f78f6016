"""DC motors: the two-parameter speed model and the electromechanical one."""

from __future__ import annotations

from collections.abc import Sequence

import control as ct

from ... import arguments
from ...arguments import as_flag, as_text
from ...exceptions import ModelError
from ..parameters import NominalParameter
from ..physical_model import PhysicalModel
from ..units import combine_units
from ._checks import as_labels, as_number, as_sensors
from ._direct import Equations, Reading

__all__ = ["dc_motor"]


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
    simple = gain is not None or time_constant is not None
    parts = {"R": R, "L": L, "Kt": Kt, "J": J}
    given = [key for key, value in {**parts, "Ke": Ke, "b": b}.items() if value is not None]
    if simple and given:
        raise ct.ControlArgument(
            f"give gain and time_constant, or R, L, Kt and J, not both (got {', '.join(given)} as well)"
        )
    known = ["speed", "angle"] if simple else ["speed", "angle", "current"]
    asked = as_sensors(sensors, known)
    as_flag(load_torque, "load_torque")
    turning = "angle" in asked
    speed_unit = combine_units("angle/s", {"angle": as_text(angle_unit, "angle_unit")})
    if simple:
        if gain is None or time_constant is None:
            raise ct.ControlArgument("the speed model needs both gain and time_constant")
        if load_torque:
            raise ct.ControlArgument("load_torque needs the electromechanical model (R, L, Kt, J)")
        gain = arguments.as_number(gain, "gain", error=ModelError)
        as_number(abs(gain), "the size of gain")
        tau = as_number(time_constant, "time_constant")
        # resisting forces oppose the motion whatever the sign of the gain
        mass, friction, force_unit = tau / abs(gain), 1.0 / abs(gain), "V"
        speed = {"speed": -1.0 / tau, "voltage": gain / tau}
        rates, names = {"speed": speed}, ["speed"]
    else:
        missing = [key for key, value in parts.items() if value is None]
        if missing:
            raise ct.ControlArgument(
                "give gain and time_constant (speed model), or R, L, Kt and J (electromechanical model); "
                f"{', '.join(missing)} missing"
            )
        value = {key: as_number(number, key) for key, number in parts.items()}
        voltage_constant = value["Kt"] if Ke is None else as_number(Ke, "Ke")
        mass, force_unit = value["J"], "N m"
        friction = 0.0 if b is None else as_number(b, "b", positive=False)
        speed = {"speed": -friction / mass, "current": value["Kt"] / mass}
        if load_torque:
            speed["load_torque"] = -1.0 / mass
        current = {
            "speed": -voltage_constant / value["L"],
            "current": -value["R"] / value["L"],
            "voltage": 1.0 / value["L"],
        }
        rates, names = {"speed": speed, "current": current}, ["speed", "current"]
    if turning:
        rates, names = {"angle": {"speed": 1.0}, **rates}, ["angle", *names]

    channels = ["voltage", "load_torque"] if load_torque else ["voltage"]
    equations = Equations(tuple(names), tuple(channels), rates)
    unit = {"angle": angle_unit, "speed": speed_unit, "current": "A"}
    units = {"position": angle_unit, "velocity": speed_unit, "force": force_unit}
    ports = [
        equations.port(
            "shaft",
            "mechanical",
            act={"speed": -1.0 / mass},
            velocity={"speed": 1.0},
            position={"angle": 1.0} if turning else None,
            units=(angle_unit, speed_unit, force_unit),
            description="shaft against the housing: friction, inertia"
            + (", torques as the voltage that overcomes them" if simple else ""),
        )
    ]
    parameters = [
        NominalParameter(
            "tau/gain" if simple else "J", mass, combine_units("force s/velocity", units), "mass", "shaft"
        ),
        NominalParameter(
            "1/gain" if simple else "b", friction, combine_units("force/velocity", units), "damping", "shaft"
        ),
    ]
    if not simple:
        ports.append(
            equations.port(
                "winding",
                "first_order",
                act={"current": -1.0 / value["L"]},
                velocity={"current": 1.0},
                units=("", "A", "V"),
                description="winding: voltage drop by the current",
            )
        )
        parameters += [
            NominalParameter("L", value["L"], "H", "mass", "winding"),
            NominalParameter("R", value["R"], "Ohm", "damping", "winding"),
        ]
    return equations.build(
        [Reading(sensor, unit[sensor], {sensor: 1.0}, {}, {}) for sensor in asked],
        ports,
        parameters,
        labels=(
            as_labels(inputs, "inputs", channels),
            as_labels(outputs, "outputs", asked),
            as_labels(states, "states", names),
        ),
        input_units=("V", "N m")[: len(channels)],
        state_units=tuple(unit[item] for item in names),
        name=as_text(name, "name"),
    )
