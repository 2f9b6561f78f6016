"""Networks of stores: circuit, thermal nodes and tanks."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import control as ct

from ...arguments import as_flag, as_labels, as_text
from ...exceptions import ModelError
from ..parameters import NominalParameter, combine_units
from ..physical_model import PhysicalModel
from ._equations import (
    BuilderEquations,
    Reading,
    Row,
    as_index,
    as_indices,
    as_number,
    as_sensors,
    as_vector,
    total,
)


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
    # the circuit as a mass on a spring: charge for displacement, current for velocity
    inductance, elastance = as_number(L, "L"), 1.0 / as_number(C, "C")
    charge, current = {"charge": 1.0}, {"current": 1.0}
    # voltmeters read the drop at their element
    readings = {
        "resistor_voltage": Reading("V", {"current": resistance}),
        "current": Reading("A", current),
        "charge": Reading("C", charge),
        "capacitor_voltage": Reading("V", {"charge": elastance}),
        "inductor_voltage": Reading("V", {}, {"current": inductance}),
    }
    asked = as_sensors(sensors, list(readings))
    # L di/dt = w - R i - q / C
    drops = {"charge": -elastance, "current": -resistance, "voltage": 1.0}
    equations = BuilderEquations(
        {"charge": current, "current": total((1.0 / inductance, drops))},
        {"charge": "C", "current": "A"},
        {"voltage": "V"},
    )
    # three ports in one loop: the same current, a voltage drop as the force
    places = {"inductor": "rate of the current", "resistor": "current", "capacitor": "charge"}
    ports = [
        equations.port(
            place,
            f"{place}: voltage drop per {cause}",
            {"current": -1.0 / inductance},
            current,
            charge,
            units=("C", "A", "V"),
            # the voltmeter at the element reads the drop of an effect there, too
            output=[float(label == f"{place}_voltage") for label in asked],
        )
        for place, cause in places.items()
    ]
    # nominal parameters
    parameters = [
        NominalParameter("L", inductance, "H", "mass", "inductor"),
        NominalParameter("R", resistance, "Ohm", "damping", "resistor"),
        NominalParameter("1/C", elastance, "1/F", "stiffness", "capacitor"),
    ]
    chosen = {sensor: readings[sensor] for sensor in asked}
    return equations.build(chosen, ports, parameters, (inputs, outputs, states, name))


def thermal_network(
    capacities: float | Sequence[float],
    resistances: Mapping[tuple[int, int], float],
    *,
    heat: int | Sequence[int] = 1,
    ambient_input: bool = True,
    sensors: int | Sequence[int] | None = None,
    inputs: str | Sequence[str] | None = None,
    outputs: str | Sequence[str] | None = None,
    states: Sequence[str] | None = None,
    name: str = "thermal_network",
) -> PhysicalModel:
    """Thermal network of n nodes.

    Parameters
    ----------
    capacities : float or sequence of n floats
        Heat capacities [J/K], positive.
    resistances : mapping of (int, int) to float
        Thermal resistances [K/W], positive, between nodes counted from 1; 0 is the
        surroundings: ``{(1, 2): 0.5, (2, 0): 2.0}``.
    heat : int or sequence of int, optional
        Nodes that a heat flow [W] enters, one input each; ``()`` for none.
    ambient_input : bool, optional
        Whether the temperature of the surroundings is an input, after the heat
        flows. Otherwise temperatures are relative to it.
    sensors : int or sequence of int, optional
        Nodes whose temperature is measured; default all.
    inputs, outputs : str or sequence of str, optional
        Labels; default ``"heat1"`` by node and ``"ambient"``, and those of the nodes.
    states : sequence of str, optional
        Names of the nodes, which name the ports too; default ``"T1", "T2", ...``.
    name : str, optional
        Name of the system.

    Returns
    -------
    PhysicalModel
        Model with a port per node (``"T1"``: loss of heat to the surroundings), per
        resistance (``"T1-T2"``, heat from the first to the second) and to the
        surroundings (``"T1-ambient"``).

    Raises
    ------
    ModelError
        If a value is not positive, a node does not exist, or there is no input.

    Notes
    -----
    C_i dT_i/dt = heat_i - sum_j (T_i - T_j) / R_ij. The nominal parameters are the conductances 1/R
    (`damping`) and the capacities (`mass`).

    Examples
    --------
    >>> model = thermal_network([10.0, 20.0], {(1, 2): 0.5, (2, 0): 2.0})
    >>> [port.name for port in model.ports]
    ['T1', 'T2', 'T1-T2', 'T2-ambient']
    >>> model.linear.input_labels
    ('heat1', 'ambient')
    """
    # nodes, heat inputs and resistances
    stored = as_vector(capacities, "capacities")
    n = stored.size
    nodes = as_labels(states, "states", [f"T{i + 1}" for i in range(n)], error=ModelError)
    heated = as_indices(heat, "heat", "node", n)
    edges = _edges(resistances, n)
    ambient = as_flag(ambient_input, "ambient_input") and any(two is None for _, two in edges)
    # inputs: heat flows, then the temperature of the surroundings
    channels = {f"heat{i + 1}": "W" for i in heated} | ({"ambient": "K"} if ambient else {})
    if not channels:
        raise ModelError(
            "the network has no input; name a heated node (heat=1) or join a node to the surroundings (0)"
        )
    if set(nodes) & set(channels):
        raise ModelError(f"states must not be named like the inputs: {', '.join(set(nodes) & set(channels))}")
    asked = range(n) if sensors is None else as_indices(sensors, "sensors", "node", n)
    if not asked:
        raise ModelError(f"sensors={sensors!r} must name at least one node")
    # heat balance of each node: C_i dT_i/dt = heat_i - sum_j (T_i - T_j) / R_ij
    capacity = dict(zip(nodes, stored.tolist(), strict=True))
    ends = {(nodes[i], "ambient" if j is None else nodes[j]): R for (i, j), R in edges.items()}
    heats = {nodes[i]: {f"heat{i + 1}": 1.0 / capacity[nodes[i]]} for i in heated}
    rates = _rates(capacity, heats, ends)
    equations = BuilderEquations(rates, dict.fromkeys(nodes, "K"), channels)
    # ports: from each node to the surroundings, then along each resistance
    places = [
        (node, f"node {node}: heat that it loses to the surroundings", {node: -1.0 / size}, "ambient")
        for node, size in capacity.items()
    ]
    for one, two in ends:
        # heat leaves the first node and enters the second, over their capacities
        act = {one: -1.0 / capacity[one], two: 1.0 / capacity.get(two, 1.0)}
        places.append((f"{one}-{two}", f"heat from {one} to {two}, driven by their difference", act, two))
    ports = [
        # a port senses the difference of the temperatures
        equations.port(place, words, act, {next(iter(act)): 1.0, other: -1.0}, units=("", "K", "W"))
        for place, words, act, other in places
    ]
    # nominal parameters: capacities and conductances
    parameters = [
        NominalParameter(f"C[{node}]", size, "J/K", "mass", node) for node, size in capacity.items()
    ]
    parameters += [
        NominalParameter(f"1/R[{one}-{two}]", 1.0 / R, "W/K", "damping", f"{one}-{two}")
        for (one, two), R in ends.items()
    ]
    readings = {nodes[i]: Reading("K", {nodes[i]: 1.0}) for i in asked}
    return equations.build(readings, ports, parameters, (inputs, outputs, None, name))


def _rates(
    capacity: Mapping[str, float], heats: Mapping[str, Row], ends: Mapping[tuple[str, str], float]
) -> dict[str, Row]:
    """dT/dt of every node by nodes and inputs."""
    rates: dict[str, Row] = {node: heats.get(node, {}) for node in capacity}
    for (one, two), R in ends.items():
        # flow into each end of a resistance
        for here, there in ((one, two), (two, one)):
            if here in capacity:
                flow = 1.0 / (R * capacity[here])
                rates[here] = total((1.0, rates[here]), (flow, {here: -1.0, there: 1.0}))
    return rates


def _edges(resistances: Any, n: int) -> dict[tuple[int, int | None], float]:
    """Return the value of each resistance by its two nodes.

    The second node is None for the surroundings. Each pair of nodes occurs once.
    """
    if not isinstance(resistances, Mapping) or not resistances:
        raise ct.ControlArgument(
            f"resistances must be a mapping such as {{(1, 2): 0.5, (2, 0): 2.0}}, not {resistances!r}"
        )
    found: dict[tuple[int, int | None], float] = {}
    for ends, value in resistances.items():
        if not isinstance(ends, tuple) or len(ends) != 2:
            raise ct.ControlArgument(f"the ends of a resistance must be a pair such as (1, 2), not {ends!r}")
        # the surroundings come second
        first, second = ends[::-1] if ends[0] == 0 else ends
        one = as_index(first, "a node of resistances", n)
        two = None if second == 0 else as_index(second, "a node of resistances", n)
        # each pair of nodes once, in either order
        if one == two or (one, two) in found or (two, one) in found:
            raise ModelError(
                f"resistance {ends!r} joins a node to itself or a pair that is joined already; "
                "give each pair once (the resistance of two in parallel is R1 R2 / (R1 + R2))"
            )
        found[one, two] = as_number(value, f"resistances[{ends!r}]")
    return found


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
    # cross sections, outflows per level, gain of the pump
    (A1, A2), (k1, k2) = (as_vector(x, key, 2) for x, key in ((areas, "areas"), (outflows, "outflows")))
    gain = as_number(pump_gain, "pump_gain")
    units = {"level": level_unit, "flow": flow_unit, "pump": pump_unit}
    for key, unit in units.items():
        as_text(unit, f"{key}_unit")
    measured = [f"h{tank + 1}" for tank in as_indices(sensors, "sensors", "tank", 2)]
    if not measured:
        raise ModelError(f"sensors={sensors!r} must name at least one tank")
    # balance of volume: A1 dh1/dt = gain w - k1 h1, A2 dh2/dt = k1 h1 - k2 h2
    equations = BuilderEquations(
        {"h1": {"h1": -k1 / A1, "pump": gain / A1}, "h2": {"h1": k1 / A2, "h2": -k2 / A2}},
        {"h1": level_unit, "h2": level_unit},
        {"pump": pump_unit},
    )
    passed = "flow from the upper tank into the lower, by the level of the upper"
    # ports: a loss of either tank, and the flow from the upper into the lower one
    ports = [
        equations.port(place, words, act, {level: 1.0}, units=("", level_unit, flow_unit))
        for place, level, act, words in (
            ("tank1", "h1", {"h1": -1.0 / A1}, "upper tank: flow out of it that is lost"),
            ("tank2", "h2", {"h2": -1.0 / A2}, "lower tank: flow out of it"),
            ("tank1->tank2", "h1", {"h1": -1.0 / A1, "h2": 1.0 / A2}, passed),
        )
    ]
    # units of outflow per level and of cross section
    per_level, area = (combine_units(rule, units) for rule in ("flow/level", "flow s/level"))
    labels = as_labels(inputs, "inputs", ["pump"], error=ModelError)
    parameters = [
        NominalParameter("k1", float(k1), per_level, "damping", "tank1->tank2"),
        NominalParameter("k2", float(k2), per_level, "damping", "tank2"),
        NominalParameter("A1", float(A1), area, "mass", "tank1"),
        NominalParameter("A2", float(A2), area, "mass", "tank2"),
        # the gain is in B already, so its parameter is a factor 1
        NominalParameter("pump_gain", 1.0, "1", "input_gain", labels[0], False),
    ]
    readings = {level: Reading(level_unit, {level: 1.0}) for level in measured}
    return equations.build(readings, ports, parameters, (labels, outputs, states, name))
