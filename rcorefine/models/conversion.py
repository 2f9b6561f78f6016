"""Any model as a physical one, and the places that it has."""

from __future__ import annotations

from typing import Any

import control as ct

from ..systems.discretization import check_sampling_time
from .physical_model import PhysicalModel
from .ports import Port

__all__ = ["as_physical", "ports"]


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
    if isinstance(model, PhysicalModel):
        return model
    inner = getattr(model, "physical_model", None)
    if isinstance(inner, PhysicalModel):
        return inner
    return PhysicalModel.from_statespace(model, dt=dt)


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
    from .conversion import as_physical

    return as_physical(model, dt=dt).ports
