"""A quarter of a car: body, suspension, wheel, tire, road."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import control as ct

from ...arguments import as_choice, as_flag
from ..parameters import NominalParameter
from ..physical_model import PhysicalModel
from ..ports import Port
from ._checks import as_number, as_sensors
from ._direct import Equations, Reading, Row

__all__ = ["quarter_car"]

_POSITIONS = ("body_position", "wheel_position")


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
    mb, mw = as_number(body_mass, "body_mass"), as_number(wheel_mass, "wheel_mass")
    ks, kt = (
        as_number(suspension_stiffness, "suspension_stiffness"),
        as_number(tire_stiffness, "tire_stiffness"),
    )
    cs = as_number(suspension_damping, "suspension_damping", positive=False)
    ctire = as_number(tire_damping, "tire_damping", positive=False)
    as_choice(road, "road", ["velocity", "displacement"])
    as_flag(actuator, "actuator")
    deflections = road == "velocity"
    if ctire and not deflections:
        raise ct.ControlArgument('tire_damping needs the velocity of the road; use road="velocity"')
    channels = ["road", "force"] if actuator else ["road"]
    path = _ON_DEFLECTIONS if deflections else _ON_POSITIONS
    rates = path.rates(mb, mw, (ks, cs), (kt, ctire), actuator)
    names = tuple(rates)
    equations = Equations(names, tuple(channels), rates)
    readings = _readings(names, path.suspension, path.tire)
    asked = as_sensors(sensors, list(readings))
    parameters = [
        NominalParameter("body_mass", mb, "kg", "mass", "body"),
        NominalParameter("wheel_mass", mw, "kg", "mass", "wheel"),
        NominalParameter("suspension_damping", cs, "N s/m", "damping", "suspension"),
        NominalParameter("suspension_stiffness", ks, "N/m", "stiffness", "suspension"),
        NominalParameter("tire_stiffness", kt, "N/m", "stiffness", "tire"),
    ]
    if deflections:
        parameters.append(NominalParameter("tire_damping", ctire, "N s/m", "damping", "tire"))
    return equations.build(
        [readings[sensor] for sensor in asked],
        _ports(equations, path, mb, mw),
        parameters,
        (inputs, outputs, states, name),
        input_units=("m/s" if deflections else "m", "N")[: len(channels)],
        state_units=("m", "m", "m/s", "m/s"),
    )


@dataclass(frozen=True, slots=True)
class _Path:
    """Kinematics of a vehicle model for one kind of road input.

    It holds the equations of all states but the velocities, and both elongations by states and inputs.
    """

    kinematics: dict[str, Row]
    suspension: Row
    tire: Row
    tire_rate: Row

    def rates(
        self,
        mb: float,
        mw: float,
        suspension: tuple[float, float],
        tire: tuple[float, float],
        actuator: bool,
    ) -> dict[str, Row]:
        """Return the state equations from masses, stiffness and damping.

        `suspension` and `tire` hold stiffness and damping.
        """
        (ks, cs), (kt, ctire) = suspension, tire
        sprung: Row = {"body_velocity": 1.0, "wheel_velocity": -1.0}
        lifted = _sum((-ks / mb, self.suspension), (-cs / mb, sprung))
        rolled = _sum(
            (ks / mw, self.suspension),
            (cs / mw, sprung),
            (-kt / mw, self.tire),
            (-ctire / mw, self.tire_rate),
        )
        push: Row = {"force": 1.0} if actuator else {}
        return {
            **self.kinematics,
            "body_velocity": _sum((1.0, lifted), (1.0 / mb, push)),
            "wheel_velocity": _sum((1.0, rolled), (-1.0 / mw, push)),
        }


_ON_DEFLECTIONS = _Path(
    {
        "suspension": {"body_velocity": 1.0, "wheel_velocity": -1.0},
        "tire": {"wheel_velocity": 1.0, "road": -1.0},
    },
    {"suspension": 1.0},
    {"tire": 1.0},
    {"wheel_velocity": 1.0, "road": -1.0},
)
_ON_POSITIONS = _Path(
    {"body_position": {"body_velocity": 1.0}, "wheel_position": {"wheel_velocity": 1.0}},
    {"body_position": 1.0, "wheel_position": -1.0},
    {"wheel_position": 1.0, "road": -1.0},
    {},
)


def _ports(equations: Equations, path: _Path, body: float, wheel: float) -> list[Port]:
    """Suspension, tire, and the two masses by themselves."""
    vb, vw = "body_velocity", "wheel_velocity"
    at_body, at_wheel = ({state: 1.0} if state in equations.states else None for state in _POSITIONS)
    places: tuple[tuple[str, Row, Row, Row | None, str], ...] = (
        (
            "suspension",
            {vb: -1 / body, vw: 1 / wheel},
            {vb: 1.0, vw: -1.0},
            path.suspension,
            "spring and damper under the body",
        ),
        ("tire", {vw: -1 / wheel}, path.tire_rate, path.tire, "tire, between wheel and road"),
        ("body", {vb: -1 / body}, {vb: 1.0}, at_body, "body itself"),
        ("wheel", {vw: -1 / wheel}, {vw: 1.0}, at_wheel, "wheel itself"),
    )
    return [
        equations.port(
            place, "mechanical", act=act, velocity=rate, position=length, units=("m", "m/s", "N"),
            description=words,
        )
        for place, act, rate, length, words in places
    ]  # fmt: skip


def _readings(names: Sequence[str], suspension: Row, tire: Row) -> dict[str, Reading]:
    found = {
        f"{part}_acceleration": Reading(f"{part}_acceleration", "m/s^2", {}, {f"{part}_velocity": 1.0}, {})
        for part in ("body", "wheel")
    }
    for name in names:
        if name.endswith(("velocity", "position")):
            found[name] = Reading(name, "m/s" if name.endswith("velocity") else "m", {name: 1.0}, {}, {})
    for label, row in (("suspension_deflection", suspension), ("tire_deflection", tire)):
        inside = {key: value for key, value in row.items() if key in names}
        outside = {key: value for key, value in row.items() if key not in names}
        found[label] = Reading(label, "m", inside, {}, outside)
    return found


def _sum(*terms: tuple[float, Row]) -> dict[str, float]:
    total: dict[str, float] = {}
    for factor, row in terms:
        for label, value in row.items():
            total[label] = total.get(label, 0.0) + factor * value
    return total
