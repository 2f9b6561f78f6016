"""Heat capacities joined by thermal resistances."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import control as ct

from ...arguments import as_flag
from ...exceptions import ModelError
from ..parameters import NominalParameter
from ..physical_model import PhysicalModel
from ..ports import Port
from ._checks import as_index, as_labels, as_number, as_several, as_vector
from ._direct import Equations, Reading, Row

__all__ = ["thermal_network"]


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
    stored = as_vector(capacities, "capacities")
    n = stored.size
    nodes = list(as_labels(states, "states", [f"T{i + 1}" for i in range(n)]))
    heated = [as_index(item, "a node of heat", n) for item in as_several(heat, "heat", "nodes")]
    edges = _edges(resistances, n)
    as_flag(ambient_input, "ambient_input")
    ends = [(nodes[i], "ambient" if j is None else nodes[j], resistance) for i, j, resistance in edges]
    channels = _channels(nodes, heated, heat, bool(ambient_input) and any(j is None for _, j, _ in edges))
    ambient = "ambient" in channels
    capacity = dict(zip(nodes, stored.tolist(), strict=True))
    rates = _rates(capacity, [nodes[i] for i in heated], channels, ends)
    equations = Equations(tuple(nodes), tuple(channels), rates)
    asked = range(1, n + 1) if sensors is None else as_several(sensors, "sensors", "nodes")
    measured = [nodes[as_index(item, "a sensor", n)] for item in asked]
    if not measured or len(set(measured)) != len(measured):
        raise ModelError(f"sensors={sensors!r} must name at least one node, and each once")
    parameters = [NominalParameter(f"C[{node}]", capacity[node], "J/K", "mass", node) for node in nodes]
    parameters += [
        NominalParameter(f"1/R[{one}-{two}]", 1.0 / resistance, "W/K", "damping", f"{one}-{two}")
        for one, two, resistance in ends
    ]
    return equations.build(
        [Reading(node, "K", {node: 1.0}, {}, {}) for node in measured],
        _ports(equations, capacity, ends, {"ambient": -1.0} if ambient else {}),
        parameters,
        (inputs, outputs, None, name),
        input_units=("W",) * len(heated) + ("K",) * ambient,
        state_units=("K",) * n,
    )


def _channels(nodes: Sequence[str], heated: Sequence[int], heat: Any, ambient: bool) -> list[str]:
    """Inputs: heat flows by node, and the temperature of the surroundings."""
    channels = [f"heat{i + 1}" for i in heated] + ["ambient"] * ambient
    if not channels:
        raise ModelError(
            "the network has no input; name a heated node (heat=1) or join a node to the surroundings (0)"
        )
    if len(set(channels)) != len(channels):
        raise ModelError(f"heat={heat!r} names a node twice")
    if set(nodes) & set(channels):
        raise ModelError(f"states must not be named like the inputs: {', '.join(set(nodes) & set(channels))}")
    return channels


def _rates(
    capacity: Mapping[str, float],
    heated: Sequence[str],
    channels: Sequence[str],
    ends: Sequence[tuple[str, str, float]],
) -> dict[str, dict[str, float]]:
    """dT/dt of every node by nodes and inputs."""
    rates: dict[str, dict[str, float]] = {node: {} for node in capacity}
    for node, channel in zip(heated, channels, strict=False):
        rates[node][channel] = 1.0 / capacity[node]
    for one, two, resistance in ends:
        for here, there in ((one, two), (two, one)):
            if here in capacity:
                flow = 1.0 / (resistance * capacity[here])
                rates[here][here] = rates[here].get(here, 0.0) - flow
                if there in capacity or there in channels:
                    rates[here][there] = rates[here].get(there, 0.0) + flow
    return rates


def _ports(
    equations: Equations,
    capacity: Mapping[str, float],
    ends: Sequence[tuple[str, str, float]],
    ambient: Row,
) -> list[Port]:
    """One per node, and one per resistance."""
    units = ("", "K", "W")
    ports = [
        equations.port(
            node,
            "first_order",
            act={node: -1.0 / size},
            velocity={node: 1.0, **ambient},
            units=units,
            description=f"node {node}: heat that it loses to the surroundings",
        )
        for node, size in capacity.items()
    ]
    for one, two, _ in ends:
        inside = {two: 1.0 / capacity[two]} if two in capacity else {}
        ports.append(
            equations.port(
                f"{one}-{two}",
                "first_order",
                act={one: -1.0 / capacity[one], **inside},
                velocity={one: 1.0, **({two: -1.0} if two in capacity else ambient)},
                units=units,
                description=f"heat from {one} to {two}, driven by their difference",
            )
        )
    return ports


def _edges(resistances: Any, n: int) -> list[tuple[int, int | None, float]]:
    """Return both nodes and the value of each resistance.

    The second node is None for the surroundings. Each pair of nodes occurs once.
    """
    if not isinstance(resistances, Mapping) or not resistances:
        raise ct.ControlArgument(
            f"resistances must be a mapping such as {{(1, 2): 0.5, (2, 0): 2.0}}, not {resistances!r}"
        )
    found: dict[tuple[int, ...], tuple[int, int | None, float]] = {}
    for ends, value in resistances.items():
        if not isinstance(ends, tuple) or len(ends) != 2:
            raise ct.ControlArgument(f"the ends of a resistance must be a pair such as (1, 2), not {ends!r}")
        pair = ends[::-1] if ends[0] == 0 else ends
        one = as_index(pair[0], "a node of resistances", n)
        two = None if pair[1] == 0 else as_index(pair[1], "a node of resistances", n)
        key = tuple(sorted((one, -1 if two is None else two)))
        if one == two or key in found:
            raise ModelError(
                f"resistance {ends!r} joins a node to itself or a pair that is joined already; "
                "give each pair once (the resistance of two in parallel is R1 R2 / (R1 + R2))"
            )
        found[key] = (one, two, as_number(value, f"resistances[{ends!r}]"))
    return list(found.values())
