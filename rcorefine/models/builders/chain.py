"""A chain of masses between springs and dampers."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import control as ct
import numpy as np

from ...arguments import as_text
from ...systems.linear import Array
from ..physical_model import PhysicalModel
from ._assembly import Place, SecondOrder, Units, parameters_of, unit_vector
from ._checks import as_vector
from ._sensors import input_map, parse_sensors

__all__ = ["mass_spring_damper"]


def mass_spring_damper(
    m: float | Sequence[float],
    c: float | Sequence[float],
    k: float | Sequence[float],
    *,
    excitation: str = "force",
    force: int | Sequence[int] | Array | None = None,
    sensors: Any = "displacement",
    inputs: str | Sequence[str] | None = None,
    outputs: str | Sequence[str] | None = None,
    states: Sequence[str] | None = None,
    position_unit: str = "m",
    force_unit: str = "N",
    name: str = "chain",
) -> PhysicalModel:
    """Chain of masses on springs and dampers.

    Parameters
    ----------
    m : float or sequence of n floats
        Masses [kg], positive.
    c : float or sequence of n or n+1 floats
        Dampers [N s/m], not negative: the first joins mass 1 to the
        ground, entry n+1 (if given) mass n to the ground.
    k : float or sequence of n or n+1 floats
        Springs [N/m], in the same order. With n entries in both the far end is free.
    excitation : {"force", "base"}, optional
        ``"base"`` makes the acceleration of the base [m/s^2] the first input; the
        states are then relative to the base.
    force : int, sequence of int or ndarray of shape (n, n_w), optional
        Masses that a force acts on, counted from 1, one input each; default mass 1
        (none under base excitation). A 2-D array tells how each input acts on the
        masses.
    sensors : str, tuple or list, optional
        ``"velocity"`` measures all masses, ``("velocity", 1)`` the first,
        ``("velocity", (1, 3))`` two of them, ``("displacement", "link2")`` an
        elongation, ``("force", "link2")`` what its spring and damper hold, and with them whatever
        else is missing there: a load cell; a list of these measures them all, in order. Under base
        excitation accelerations of masses are absolute, the others
        are relative to the base.
    inputs, outputs, states : str or sequence of str, optional
        Labels; default ``"force"`` or ``"base_acceleration"``, ``"q1"``, ``"v1"``, ``"a1"``
        by quantity and mass, and states ``q1..qn, v1..vn``.
    position_unit, force_unit : str, optional
        Units to print.
    name : str, optional
        Name of the system.

    Returns
    -------
    PhysicalModel
        Model with the ports ``link1..link{n}`` (or ``link{n+1}``) and ``mass1..mass{n}``.

    Raises
    ------
    control.ControlDimension
        If `c`, `k` or labels have the wrong number of entries.
    ModelError
        If a mass is not positive, a spring or damper negative, or a mass does not exist.

    Notes
    -----
    ``link1`` joins the ground to mass 1 (d = q_1), ``link{i}`` mass i-1 to mass i
    (d = q_i - q_(i-1), its elongation), ``link{n+1}`` mass n to the ground, taken in the sense
    of mass n (d = q_n). The equations are (49)-(51) of the paper.

    Examples
    --------
    >>> model = mass_spring_damper([0.8, 0.5], [100, 200, 120], [1000, 1500, 2000],
    ...                            sensors=("velocity", 1))
    >>> [port.name for port in model.ports]
    ['link1', 'link2', 'link3', 'mass1', 'mass2']
    >>> model.system.C
    array([[0., 0., 1., 0.]])
    """
    masses = as_vector(m, "m")
    n = masses.size
    damping, stiffness = _link_values("c", c, n), _link_values("k", k, n)
    count = max(damping.size, stiffness.size)
    damping = np.concatenate([damping, np.zeros(count - damping.size)])
    stiffness = np.concatenate([stiffness, np.zeros(count - stiffness.size)])

    places = _places(n, count)
    links, points = places[:count], places[count:]
    G = np.array([link.direction for link in links])
    M = np.diag(masses)
    units = Units(as_text(position_unit, "position_unit"), as_text(force_unit, "force_unit"))
    F, base, input_default, input_units = input_map(excitation, force, M, units)
    names = [link.name for link in links]
    parameters = [
        *parameters_of("m", "mass", masses, [point.name for point in points], units),
        *parameters_of("c", "damping", damping, names, units),
        *parameters_of("k", "stiffness", stiffness, names, units),
    ]
    found = parse_sensors(sensors, n, {place.name: place for place in places}, base, units, parameters)
    system = SecondOrder(M, G.T @ np.diag(damping) @ G, G.T @ np.diag(stiffness) @ G, F, base, units)
    return system.build(
        places,
        found,
        parameters,
        (inputs, outputs, states, name),
        inputs=input_default,
        input_units=input_units,
    )


def _link_values(name: str, value: Any, n: int) -> Array:
    values = as_vector(value, name, positive=False)
    if values.size not in (n, n + 1):
        raise ct.ControlDimension(
            f"{name} has {values.size} entries for {n} masses; give {n} (the far end is free) or {n + 1} "
            "(the last joins the last mass to the ground)"
        )
    return values


def _places(n: int, count: int) -> list[Place]:
    links = []
    for i in range(count):
        if i == 0:
            direction, words = unit_vector(n, (0, 1.0)), "between the ground and mass 1 (d = q1)"
        elif i < n:
            direction = unit_vector(n, (i, 1.0), (i - 1, -1.0))
            words = f"between mass {i} and mass {i + 1} (d = q{i + 1} - q{i})"
        else:
            direction, words = unit_vector(n, (n - 1, 1.0)), f"between mass {n} and the ground (d = q{n})"
        links.append(Place(f"link{i + 1}", direction, f"spring and damper {words}", absolute=False))
    points = [
        Place(f"mass{i + 1}", unit_vector(n, (i, 1.0)), f"mass {i + 1} itself (d = q{i + 1})", absolute=True)
        for i in range(n)
    ]
    return [*links, *points]
