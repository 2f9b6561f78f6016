"""Force sensors of a plain StateSpace: load cells, shunts, flow meters."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from ..effects.dampers import Damping
from ..effects.springs import Stiffness
from ..systems.linear import Array, LinearModel
from .displacements import is_companion
from .parameters import NominalParameter
from .ports import Port

__all__ = ["find_meters"]

_SAME = 1e-6  # relative misfit of numbers that are the same
_ANONYMOUS = re.compile(r"x\[\d+\]")


def find_meters(
    linear: LinearModel,
    rate: Array,
    ports: Sequence[Port],
    parameters: Sequence[NominalParameter],
) -> tuple[Array, tuple[Port, ...], tuple[NominalParameter, ...]]:
    """Find the sensors that read the force at a port.

    The remaining accelerometers are returned as well.

    Parameters
    ----------
    linear : LinearModel
        Continuous-time model.
    rate : ndarray of shape (n_y, n)
        What its outputs may read of rates of velocity states.
    ports : sequence of Port
        Its places.
    parameters : sequence of NominalParameter
        Its springs and dampers.

    Returns
    -------
    rate : ndarray of shape (n_y, n)
        With zero rows for sensors that read a force.
    ports : tuple of Port
        With what the sensors read of a force there. A force at a single mass may act beside the cell: where
        the port holds one, a port ``"x1 (cell)"`` stands for what the sensor ``"cell"``, and any other at the
        same place, reads.
    parameters : tuple of NominalParameter
        Springs and dampers at the ports that hold them.

    Notes
    -----
    A row of C reads the force in a link if it is k d + c v with the k and c that A has there. One number
    alone could as well be the gain of a sensor: it must be the same, no power of ten, and the states must
    bear names, for a transfer function of unit gain looks like that.
    An accelerometer at a mass that only that link holds reads the same force over the mass.
    """
    found, moved, rate = list(ports), list(parameters), rate.copy()
    cells: dict[str, str] = {}  # by the port of a single mass that they stand beside
    if is_companion(linear.A, 1e-9):
        return rate, tuple(found), tuple(moved)
    for y, label in enumerate(linear.output_labels):
        if np.count_nonzero(rate[y]) == 1 and np.isclose(np.abs(rate[y]).max(), 1.0, rtol=_SAME):
            continue
        row = np.concatenate([linear.C[y], linear.D[y]])
        read = [(p, scale) for p in ports if (scale := _scale(linear, row, p, parameters))]
        if len(read) != 1 or (rate[y].any() and abs(read[0][1]) != 1.0):
            continue
        port, scale = read[0]
        rate[y] = 0.0
        felt = np.zeros(linear.n_outputs)
        felt[y] = scale
        name = port.name if np.count_nonzero(port.act) > 1 else cells.get(port.name, "")
        if name:
            at = next(i for i, other in enumerate(found) if other.name == name)
            known = found[at].output
            found[at] = replace(found[at], output=felt + (known if known.size else 0.0))
            continue
        cell = replace(
            port,
            name=f"{port.name} ({label})",
            output=felt,
            description=f"{port.description}; its force is read by {label}",
        )
        cells[port.name] = cell.name
        found.insert(1 + next(i for i, other in enumerate(found) if other.name == port.name), cell)
        moved = [replace(q, place=cell.name) if q.place == port.name else q for q in moved]
    return rate, tuple(found), tuple(moved)


def _scale(linear: LinearModel, row: Array, port: Port, parameters: Sequence[NominalParameter]) -> float:
    """Return the reading of a unit force at a port in an output row.

    It is 0 if the row does not read that force.
    """
    k, c = (
        sum(q.value for q in parameters if q.kind == kind and q.place == port.name)
        for kind in (Stiffness.name, Damping.name)
    )
    force = k * np.concatenate([port.position, port.position_input])
    force = force + c * np.concatenate([port.velocity, port.velocity_input])
    if port.modal or not force.any() or not row.any():
        return 0.0
    scale = float(row @ force / (force @ force))
    # entry by entry: a spring in N/m and a damper in N s/m have no common size
    if np.any(np.abs(row - scale * force) > _SAME * np.maximum(np.abs(row), np.abs(scale * force))):
        return 0.0
    if abs(abs(scale) - 1.0) <= _SAME:
        scale = float(np.sign(scale))
    named = not any(_ANONYMOUS.fullmatch(label) for label in linear.state_labels)
    if k and c:
        return scale if named or linear.n_states > 2 else 0.0
    decades = np.log10(abs(k or c))
    return scale if abs(scale) == 1.0 and named and abs(decades - round(decades)) > _SAME else 0.0
