"""Cascade of two tanks: a pump fills the first, which feeds the second."""

from __future__ import annotations

from collections.abc import Sequence

from ...arguments import as_text
from ...exceptions import ModelError
from ..parameters import NominalParameter
from ..physical_model import PhysicalModel
from ..units import combine_units
from ._checks import as_index, as_labels, as_number, as_several, as_vector
from ._direct import Equations, Reading

__all__ = ["two_tanks"]

_PASSED = "flow from the upper tank into the lower, by the level of the upper"


def two_tanks(
    areas: Sequence[float] = (1.0, 1.0),
    outflows: Sequence[float] = (1.0, 1.0),
    *,
    pump_gain: float = 1.0,
    sensors: int | Sequence[int] = 2,
    inputs: str | None = None,
    outputs: str | Sequence[str] | None = None,
    states: Sequence[str] | None = None,
    level_unit: str = "m",
    flow_unit: str = "m^3/s",
    pump_unit: str = "V",
    name: str = "two_tanks",
) -> PhysicalModel:
    """Cascaded tanks with an outflow in proportion to the level.

    Parameters
    ----------
    areas : sequence of 2 floats, optional
        Cross sections of the upper and the lower tank [m^2], positive.
    outflows : sequence of 2 floats, optional
        Outflow per level of either tank [m^2/s], positive. That of the upper tank runs into
        the lower one.
    pump_gain : float, optional
        Flow per unit of the input into the upper tank [m^3/(s V)], positive.
    sensors : int or sequence of int, optional
        Tanks whose level is measured, counted from 1; default the lower.
    inputs, outputs, states : str or sequence of str, optional
        Labels; default ``"pump"``, ``"h1", "h2"`` for levels.
    level_unit, flow_unit, pump_unit : str, optional
        Units to print.
    name : str, optional
        Name of the system.

    Returns
    -------
    PhysicalModel
        Model with the ports ``"tank1"`` (what leaves it is lost: a leak, an overflow to
        the outside), ``"tank2"`` (its outflow), and ``"tank1->tank2"`` (what leaves the upper
        tank reaches the lower: its outflow, an overflow into it).

    Raises
    ------
    ModelError
        If a value is not positive or a tank does not exist.

    Notes
    -----
    A_1 dh_1/dt = pump_gain w - k_1 h_1 and A_2 dh_2/dt = k_1 h_1 - k_2 h_2, the level being measured from
    empty. A tank empties by the root of its level: `sqrt_flow` adds that (the linear outflow,
    `damping`, then falls), and `threshold_flow` an overflow.

    Examples
    --------
    >>> model = two_tanks([2.0, 1.0], [0.5, 0.25])
    >>> model.system.A
    array([[-0.25,  0.  ],
           [ 0.5 , -0.25]])
    """
    area = as_vector(areas, "areas", 2).tolist()
    outflow = as_vector(outflows, "outflows", 2).tolist()
    gain = as_number(pump_gain, "pump_gain")
    asked = as_several(sensors, "sensors", "tanks")
    for key, unit in (("level_unit", level_unit), ("flow_unit", flow_unit), ("pump_unit", pump_unit)):
        as_text(unit, key)
    measured = [f"h{as_index(tank, 'a sensor', 2) + 1}" for tank in asked]
    if not measured or len(set(measured)) != len(measured):
        raise ModelError(f"sensors={sensors!r} must name at least one tank, and each once")
    equations = Equations(
        ("h1", "h2"),
        ("pump",),
        {
            "h1": {"h1": -outflow[0] / area[0], "pump": gain / area[0]},
            "h2": {"h1": outflow[0] / area[1], "h2": -outflow[1] / area[1]},
        },
    )
    units = ("", level_unit, flow_unit)
    lost, passed = {"h1": -1.0 / area[0]}, {"h1": -1.0 / area[0], "h2": 1.0 / area[1]}
    ports = [
        equations.port(place, "first_order", act=act, velocity={level: 1.0}, units=units, description=words)
        for place, level, act, words in (
            ("tank1", "h1", lost, "upper tank: flow out of it that is lost"),
            ("tank2", "h2", {"h2": -1.0 / area[1]}, "lower tank: flow out of it"),
            ("tank1->tank2", "h1", passed, _PASSED),
        )
    ]
    per_level = combine_units("flow/level", {"flow": flow_unit, "level": level_unit})
    square = combine_units("flow s/level", {"flow": flow_unit, "level": level_unit})
    parameters = [
        NominalParameter("k1", outflow[0], per_level, "damping", "tank1->tank2"),
        NominalParameter("k2", outflow[1], per_level, "damping", "tank2"),
        NominalParameter("A1", area[0], square, "mass", "tank1"),
        NominalParameter("A2", area[1], square, "mass", "tank2"),
    ]
    labels = as_labels(inputs, "inputs", ["pump"])
    parameters.append(NominalParameter("pump_gain", 1.0, "1", "input_gain", labels[0], False))
    return equations.build(
        [Reading(level, level_unit, {level: 1.0}, {}, {}) for level in measured],
        ports,
        parameters,
        (labels, outputs, states, name),
        input_units=(pump_unit,),
        state_units=(level_unit, level_unit),
    )
