"""Forms that a static correction may take.

A form says which entries of which model change.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass, replace

import control as ct
import numpy as np

from ...exceptions import ModelError
from ...systems.linear import Array, LinearModel
from .entries import EntriesSetup
from .setup import FilterSettings

__all__ = ["FORMS", "all_entries", "correction", "named_entries", "no_entries", "nonzero_entries"]

FORMS = ("nonzero", "discrete", "input")
_ENTRY = re.compile(r"\s*([ABCD])\s*\[\s*(\d+)\s*,\s*(\d+)\s*\]\s*")
_RATE = 0.1  # of what moves a row that an entry which is zero may do, one standard deviation
_WIDE = 0.5  # the same for a correction, of which nothing is known


@dataclass(frozen=True, slots=True)
class _Entry:
    """An entry of A, B, C or D."""

    matrix: str
    row: int
    column: int

    def __str__(self) -> str:
        return f"{self.matrix}[{self.row},{self.column}]"

    def place(self, model: LinearModel) -> tuple[int, int]:
        """Row and column in [A B; C D]."""
        n = model.n_states
        return self.row + n * (self.matrix in "CD"), self.column + n * (self.matrix in "BD")


def nonzero_entries(model: LinearModel, settings: FilterSettings) -> EntriesSetup:
    """Entries that are not zero, where physics may have put them.

    Rows x1' = x2 are kinematics, and an output that shows one state is a sensor: both are
    no parameters. An output that mixes several signals (an acceleration) holds some.
    """
    found = []
    for row in range(model.n_states):
        columns = np.flatnonzero(model.A[row])
        kinematic = columns.size == 1 and columns[0] != row and model.A[row, columns[0]] == 1.0
        if kinematic and not model.B[row].any():
            continue
        found += [_Entry("A", row, int(j)) for j in columns]
        found += [_Entry("B", row, int(j)) for j in np.flatnonzero(model.B[row])]
    found += _mixed_outputs(model)
    return replace(_of_entries(model, model, found, settings, 0.0), one_to_one=True)


def all_entries(model: LinearModel, discrete: LinearModel, settings: FilterSettings) -> EntriesSetup:
    """Return the setup with all entries of the discrete A and B.

    Entries of outputs that mix several signals are included.
    """
    n = model.n_states
    found = [_Entry("A", i, j) for i in range(n) for j in range(n)]
    found += [_Entry("B", i, j) for i in range(n) for j in range(model.n_inputs)]
    return _of_entries(model, discrete, found + _mixed_outputs(discrete), settings, _RATE)


def named_entries(model: LinearModel, names: Sequence[str], settings: FilterSettings) -> EntriesSetup:
    """Entries by their names, such as "A[1,0]", in the timebase of the model.

    Raises
    ------
    control.ControlArgument
        If a name is none of an entry.
    ModelError
        If the model has no such entry, or it is named twice.
    """
    found: list[_Entry] = []
    for name in names:
        match = _ENTRY.fullmatch(name)
        if match is None:
            raise ct.ControlArgument(
                f"static: {name!r} is no entry; write it as 'A[1,0]' (rows and columns from 0)"
            )
        entry = _Entry(match[1], int(match[2]), int(match[3]))
        shape = getattr(model, entry.matrix).shape
        if entry.row >= shape[0] or entry.column >= shape[1]:
            raise ModelError(f"static: the model has no entry {entry}; {entry.matrix} has shape {shape}")
        if entry in found:
            raise ModelError(f"static: {entry} is named twice; give each entry once")
        found.append(entry)
    return _of_entries(model, model, found, settings, _RATE)


def correction(
    model: LinearModel, inputs: Array, feedthrough: Array, settings: FilterSettings
) -> EntriesSetup:
    """Return the setup of the paper's correction u = theta [x; w].

    The correction acts through B_u and D_u, in the timebase of the model.
    """
    n, nw = model.n_states, model.n_inputs
    acts = np.vstack([inputs, feedthrough])
    patterns, names = [], []
    signals = (*model.state_labels, *model.input_labels)
    for c in range(acts.shape[1]):
        for j in range(n + nw):
            pattern = np.zeros((n + model.n_outputs, n + nw))
            pattern[:, j] = acts[:, c]
            patterns.append(pattern)
            names.append(f"u{c} from {signals[j]}" if acts.shape[1] > 1 else f"u from {signals[j]}")
    none = np.zeros(len(names))
    return EntriesSetup(model, model, np.array(patterns), tuple(names), none, none.copy(), _WIDE, settings)


def _mixed_outputs(model: LinearModel) -> list[_Entry]:
    found = []
    for row in range(model.n_outputs):
        states, inputs = np.flatnonzero(model.C[row]), np.flatnonzero(model.D[row])
        if states.size + inputs.size > 1 or (not states.size and inputs.size):
            found += [_Entry("C", row, int(j)) for j in states] + [_Entry("D", row, int(j)) for j in inputs]
    return found


def _of_entries(
    initial: LinearModel, base: LinearModel, entries: Sequence[_Entry], settings: FilterSettings, rate: float
) -> EntriesSetup:
    whole = np.block([[base.A, base.B], [base.C, base.D]])
    rest = whole - np.eye(*whole.shape) * (not base.is_continuous)
    places = [entry.place(base) for entry in entries]
    patterns = np.zeros((len(places), *whole.shape))
    for a, (i, j) in enumerate(places):
        patterns[a, i, j] = 1.0
    value = np.array([whole[place] for place in places], dtype=float)
    nominal = np.array([abs(rest[place]) for place in places], dtype=float)
    return EntriesSetup(initial, base, patterns, tuple(map(str, entries)), nominal, value, rate, settings)


def no_entries(model: LinearModel, settings: FilterSettings) -> EntriesSetup:
    """The initial model itself, whose state alone is estimated."""
    return _of_entries(model, model, [], settings, 0.0)
