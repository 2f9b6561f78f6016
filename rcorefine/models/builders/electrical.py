"""A resistor, an inductor and a capacitor in series."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from ..parameters import NominalParameter
from ..physical_model import PhysicalModel
from ._assembly import Place, SecondOrder, Sensor, Units
from ._checks import as_number, as_sensors

__all__ = ["series_rlc"]

_SENSORS = {
    "resistor_voltage": "V",
    "current": "A",
    "charge": "C",
    "capacitor_voltage": "V",
    "inductor_voltage": "V",
}


def series_rlc(
    R: float,
    L: float,
    C: float,
    *,
    sensors: str | Sequence[str] = "resistor_voltage",
    inputs: str | None = None,
    outputs: str | Sequence[str] | None = None,
    states: Sequence[str] | None = None,
    name: str = "series_rlc",
) -> PhysicalModel:
    """Series RLC circuit driven by a voltage.

    Parameters
    ----------
    R : float
        Resistance [Ohm], not negative.
    L : float
        Inductance [H], positive.
    C : float
        Capacitance [F], positive.
    sensors : str or sequence of str, optional
        What is measured: ``"resistor_voltage"`` (default), ``"current"``, ``"charge"``,
        ``"capacitor_voltage"``, ``"inductor_voltage"``.
    inputs, outputs, states : str or sequence of str, optional
        Labels; default ``"voltage"``, those of the sensors, and ``"charge", "current"``.
    name : str, optional
        Name of the system.

    Returns
    -------
    PhysicalModel
        Model with the ports ``"resistor"``, ``"inductor"`` and ``"capacitor"``, where
        d is the charge, v the current and f a voltage drop.

    Raises
    ------
    ModelError
        If a value is not positive.

    Notes
    -----
    L q'' + R q' + q/C = w, equations (55)-(57) of the paper. The circuit is a mass on a spring: inductance
    is `mass` at ``"inductor"``, resistance `damping` at ``"resistor"``, and the elastance 1/C
    `stiffness` at ``"capacitor"``. All three sit in one loop, so a law acts alike at each.

    A voltmeter reads all that its element drops: an effect at the resistor shows in ``"resistor_voltage"``,
    one at the capacitor in ``"capacitor_voltage"``, and so on. Resistance beside the metered resistor (of
    the coil, of the source) is `damping` at ``"inductor"``.

    Examples
    --------
    >>> model = series_rlc(250.0, 55e-3, 23.5e-6)
    >>> [(item.name, item.place, item.unit) for item in model.parameters]
    [('L', 'inductor', 'H'), ('R', 'resistor', 'Ohm'), ('1/C', 'capacitor', '1/F')]
    """
    resistance = as_number(R, "R", positive=False)
    inductance, capacitance = as_number(L, "L"), as_number(C, "C")
    asked = as_sensors(sensors, list(_SENSORS))
    one, none = np.ones(1), np.zeros(1)
    gains = {
        "resistor_voltage": (none, resistance * one, none),
        "current": (none, one, none),
        "charge": (one, none, none),
        "capacitor_voltage": (one / capacitance, none, none),
        "inductor_voltage": (none, none, inductance * one),
    }
    found = []
    for label in asked:
        found.append(Sensor(label, _SENSORS[label], *gains[label], none))
    units = Units("C", "V", velocity="A", acceleration="A/s")
    places = [
        Place("inductor", one, "inductor: voltage drop per rate of the current", absolute=False),
        Place("resistor", one, "resistor: voltage drop per current", absolute=False),
        Place("capacitor", one, "capacitor: voltage drop per charge", absolute=False),
    ]
    parameters = [
        NominalParameter("L", inductance, units.coefficient("mass"), "mass", "inductor"),
        NominalParameter("R", resistance, units.coefficient("damping"), "damping", "resistor"),
        NominalParameter("1/C", 1.0 / capacitance, units.coefficient("stiffness"), "stiffness", "capacitor"),
    ]
    system = SecondOrder(
        np.array([[inductance]]),
        np.array([[resistance]]),
        np.array([[1.0 / capacitance]]),
        np.ones((1, 1)),
        none,
        units,
    )
    model = system.build(
        places,
        found,
        parameters,
        (inputs, outputs, ["charge", "current"] if states is None else states, name),
        inputs=["voltage"],
        input_units=["V"],
    )
    voltmeters = [[float(label == f"{port.name}_voltage") for label in asked] for port in model.ports]
    ports = (
        replace(port, output=np.array(reads)) for port, reads in zip(model.ports, voltmeters, strict=True)
    )
    return replace(model, ports=tuple(ports))
