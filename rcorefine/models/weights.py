"""Input and output weights of a plain StateSpace: entries of B, C and D."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ..effects.entries import Entry
from ..systems.linear import Array, LinearModel
from .displacements import find_displacements
from .parameters import NominalParameter
from .ports import Port

__all__ = ["read_weights"]

_MOST = 60
_LEFT = 1e-9  # relative size of what cancellation leaves behind
_ALONG = 1e-6  # of the cosine between two directions that are one: four digits of their entries are kept


def read_weights(
    linear: LinearModel,
    rate: Array,
    ports: Sequence[Port],
    tolerance: float,
) -> list[NominalParameter]:
    """Entries of B, C and D that are numbers of the plant.

    Parameters
    ----------
    linear : LinearModel
        Continuous-time model.
    rate : ndarray, shape (n_y, n)
        What its outputs read of rates (accelerometers), which is taken off C and D.
    ports : sequence of Port
        Its places; what a sensor reads of a force there is no weight.
    tolerance : float
        Relative size below which an entry counts as zero.

    Returns
    -------
    list of NominalParameter
        Not listed is a weight of one, which is how a signal is mounted; a single one of its input or
        output, which is a gain; and those of an input that is a force at a port, which masses divide.
        Empty where there are more than 60: shapes of many modes, not numbers that somebody measured.
    """
    whole = np.hstack([linear.C, linear.D])
    rest = whole - rate @ np.hstack([linear.A, linear.B])
    rest[np.abs(rest) <= _LEFT * np.abs(whole)] = 0.0
    mixed = np.abs(rest) > tolerance * np.abs(rest).max(axis=1, keepdims=True, initial=0.0)
    mixed[[y for port in ports for y in np.flatnonzero(port.output)]] = False
    mixed[(mixed.sum(axis=1) == 1) & mixed[:, : linear.n_states].any(axis=1)] = False

    driven = np.abs(linear.B) > tolerance * np.abs(linear.B).max(axis=0, initial=0.0)
    driven[[item.state for item in find_displacements(linear, tolerance)]] = False  # kinematics
    driven[:, driven.sum(axis=0) == 1] = False
    driven[:, [_enters(linear.B[:, j], ports) for j in range(linear.n_inputs)]] = False

    found = []
    n = linear.n_states
    for name, values, which in (
        ("B", linear.B, driven),
        ("C", rest[:, :n], mixed[:, :n]),
        ("D", rest[:, n:], mixed[:, n:]),
    ):
        for i, j in np.argwhere(which & (np.abs(np.abs(values) - 1.0) > tolerance)).tolist():
            place = f"{name}[{i},{j}]"
            found.append(NominalParameter(place, float(values[i, j]), "", Entry.name, place, False))
    return found if len(found) <= _MOST else []


def _enters(column: Array, ports: Sequence[Port]) -> bool:
    """Return whether an input acts like the force of a port."""
    size = float(np.linalg.norm(column))
    acts = [port.act / np.linalg.norm(port.act) for port in ports if port.act.any()]
    return size > 0 and any(abs(act @ column) > (1 - _ALONG) * size for act in acts)
