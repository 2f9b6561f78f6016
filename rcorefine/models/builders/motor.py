"""DC motors: the two-parameter speed model and the electromechanical one."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import control as ct

from ... import arguments
from ...arguments import as_flag, as_text
from ...exceptions import ModelError
from ..parameters import NominalParameter
from ..physical_model import PhysicalModel
from ..ports import Port
from ..units import combine_units
from ._checks import as_number, as_sensors
from ._direct import Equations, Reading, Row

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
    speed_unit = combine_units("angle/s", {"angle": as_text(angle_unit, "angle_unit")})
    if simple:
        motor = _speed_model(gain, time_constant, load_torque)
    else:
        motor = _electromechanical(parts, Ke, b, load_torque)
    rates = {"angle": {"speed": 1.0}, **motor.rates} if "angle" in asked else motor.rates
    channels = ["voltage", "load_torque"] if load_torque else ["voltage"]
    equations = Equations(tuple(rates), tuple(channels), rates)
    unit = {"angle": angle_unit, "speed": speed_unit, "current": "A"}
    ports, parameters = _places(equations, motor, (angle_unit, speed_unit, motor.force_unit))
    return equations.build(
        [Reading(sensor, unit[sensor], {sensor: 1.0}, {}, {}) for sensor in asked],
        ports,
        parameters,
        (inputs, outputs, states, name),
        input_units=("V", "N m")[: len(channels)],
        state_units=tuple(unit[item] for item in rates),
    )


@dataclass(frozen=True, slots=True)
class _Motor:
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
    gain = arguments.as_number(gain, "gain", error=ModelError)
    as_number(abs(gain), "the size of gain")
    tau = as_number(time_constant, "time_constant")
    speed = {"speed": -1.0 / tau, "voltage": gain / tau}
    # resisting forces oppose the motion whatever the sign of the gain
    return _Motor({"speed": speed}, tau / abs(gain), 1.0 / abs(gain), ("tau/gain", "1/gain"), "V")


def _electromechanical(
    parts: dict[str, float | None], Ke: float | None, b: float | None, load_torque: bool
) -> _Motor:
    missing = [key for key, value in parts.items() if value is None]
    if missing:
        raise ct.ControlArgument(
            "give gain and time_constant (speed model), or R, L, Kt and J (electromechanical model); "
            f"{', '.join(missing)} missing"
        )
    R, L, Kt, J = (as_number(number, key) for key, number in parts.items())
    voltage_constant = Kt if Ke is None else as_number(Ke, "Ke")
    friction = 0.0 if b is None else as_number(b, "b", positive=False)
    speed = {"speed": -friction / J, "current": Kt / J}
    if load_torque:
        speed["load_torque"] = -1.0 / J
    current = {"speed": -voltage_constant / L, "current": -R / L, "voltage": 1.0 / L}
    return _Motor({"speed": speed, "current": current}, J, friction, ("J", "b"), "N m", (R, L))


def _places(
    equations: Equations, motor: _Motor, si: tuple[str, str, str]
) -> tuple[list[Port], list[NominalParameter]]:
    """Shaft, and winding where there is one."""
    words = "shaft against the housing: friction, inertia"
    shaft = equations.port(
        "shaft",
        "mechanical",
        act={"speed": -1.0 / motor.mass},
        velocity={"speed": 1.0},
        position={"angle": 1.0} if "angle" in equations.states else None,
        units=si,
        description=words if motor.winding else f"{words}, torques as the voltage that overcomes them",
    )
    units = dict(zip(("position", "velocity", "force"), si, strict=True))
    inertia, damping = combine_units("force s/velocity", units), combine_units("force/velocity", units)
    parameters = [
        NominalParameter(motor.names[0], motor.mass, inertia, "mass", "shaft"),
        NominalParameter(motor.names[1], motor.friction, damping, "damping", "shaft"),
    ]
    if motor.winding is None:
        return [shaft], parameters
    R, L = motor.winding
    winding = equations.port(
        "winding",
        "first_order",
        act={"current": -1.0 / L},
        velocity={"current": 1.0},
        units=("", "A", "V"),
        description="winding: voltage drop by the current",
    )
    parameters += [
        NominalParameter("L", L, "H", "mass", "winding"),
        NominalParameter("R", R, "Ohm", "damping", "winding"),
    ]
    return [shaft, winding], parameters
