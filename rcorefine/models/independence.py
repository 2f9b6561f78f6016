"""Parameters of a plain StateSpace that can be estimated together.

No record determines a parameter that only rescales others.
"""

from __future__ import annotations

from functools import lru_cache
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from ..effects.entries import Entry
from ..effects.input_path import InputGain
from ..effects.law import KINDS
from ..effects.springs import Stiffness
from ..systems.entries import entry_of
from ..systems.linear import Array
from .parameters import NominalParameter

if TYPE_CHECKING:
    from .physical_model import PhysicalModel

__all__ = ["independent_parameters"]

_OWN = 1e-6  # share of what a number does that none before it does, below which it is none of its own
_POINTS = 4  # in the complex plane for each state


@lru_cache(maxsize=8)  # by identity: every fit of a model asks for them
def independent_parameters(model: PhysicalModel) -> tuple[NominalParameter, ...]:
    """Return the parameters of a model without the redundant ones.

    A parameter is redundant if other parameters have the same influence.

    Parameters
    ----------
    model : PhysicalModel
        Model; where it holds no entries of B, C and D, all its parameters are what is returned.

    Returns
    -------
    tuple of NominalParameter
        Left out are those of C where those of B are free and a single signal passes, or the gain of an
        input all of whose weights are free: judged by what they change in the transfer function.
    """
    entries = {q.name: entry_of(model.linear, q.place) for q in model.parameters if q.kind == Entry.name}
    if not any(max(entry) >= model.linear.n_states for entry in entries.values()):
        return model.parameters
    responses = _Responses(model)
    basis: list[Array] = []
    found = []
    for q in model.parameters:
        if KINDS[q.kind].inertial:  # where gains are it stays: it may not stand in for what floats
            found.append(q)
            continue
        column = responses.change(q)
        size = float(np.linalg.norm(column))
        for _ in range(2):  # twice: the first projection leaves rounding of what it takes away
            for known in basis:
                column = column - (known @ column) * known
        left = float(np.linalg.norm(column))
        if left > _OWN * size:
            basis.append(column / left)
            found.append(q)
    return tuple(found)


class _Responses:
    """Influence of parameters on the transfer function.

    It is evaluated at points away from the poles.
    """

    def __init__(self, model: PhysicalModel) -> None:
        linear, self.model = model.linear, model
        n = linear.n_states
        sizes = np.abs(np.linalg.eigvals(linear.A))
        low, high = sizes[sizes > 0].min(initial=np.inf), sizes.max(initial=0.0)
        low, high = (low, high) if high > 0 else (1.0, 1.0)
        s = np.geomspace(0.1 * low, 10 * high, _POINTS * (n + 1)) * np.exp(1j * np.pi / 3)
        away = [at * np.eye(n) - linear.A for at in s]
        states = np.array([np.linalg.solve(M, linear.B) for M in away])  # (k, n, n_w): of the inputs
        read = np.array([np.linalg.solve(M.T, linear.C.T).T for M in away]) + model.output_rate
        ones = np.ones((s.size, 1, 1))
        self.outputs = np.concatenate([read, ones * np.eye(linear.n_outputs)], axis=2)
        self.inputs = np.concatenate([states, ones * np.eye(linear.n_inputs)], axis=1)
        self.whole = linear.C @ states + linear.D
        size = np.sqrt(np.mean(np.abs(self.whole) ** 2, axis=0))
        self.scale = 1.0 / np.where(size > 0, size, np.inf)  # each way through the plant counts alike

    def change(self, q: NominalParameter) -> NDArray[np.float64]:
        """By a relative change of one number, real and imaginary parts in a row."""
        linear = self.model.linear
        if q.kind == InputGain.name:
            changed = self.whole * (np.array(linear.input_labels) == q.place)
        else:
            if q.kind == Entry.name:
                row, column = entry_of(linear, q.place)
                act = np.eye(linear.n_states + linear.n_outputs)[row]
                sense = np.eye(linear.n_states + linear.n_inputs)[column]
            else:
                port, spring = self.model.port(q.place), q.kind == Stiffness.name
                d = (port.position, port.position_input) if spring else (port.velocity, port.velocity_input)
                felt = port.output if port.output.size else np.zeros(linear.n_outputs)
                act, sense = np.concatenate([port.act, felt]), np.concatenate(d)
            changed = q.value * (self.outputs @ act)[:, :, None] * (sense @ self.inputs)[:, None, :]
        flat = (changed * self.scale).reshape(-1)
        return np.concatenate([flat.real, flat.imag])
