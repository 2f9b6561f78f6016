"""The physical static stage as a part of a refiner: samples in, coefficients and model out."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import control as ct
import numpy as np
from numpy.typing import NDArray

from ..physics.structure import Structure
from ..systems.conversion import to_discrete
from ..systems.linear import Array, LinearModel
from .effects_guard import cautions
from .effects_kernel import DONE
from .effects_memory import EffectsMemory
from .effects_setup import EffectsSetup, engine_on
from .effects_stage import EffectsRecord, begin_effects, take_effects
from .effects_start import go_over

__all__ = ["PhysicalPart"]


class PhysicalPart:
    """Physical effects estimated on a stream.

    Parameters
    ----------
    setup : EffectsSetup
        Settings.
    keep : bool
        Whether to keep the course of every sample.
    """

    def __init__(self, setup: EffectsSetup, keep: bool) -> None:
        self.setup, self.keep = setup, keep
        lay = setup.layout
        self._row = np.ones((1, lay.nu))
        self._there = np.ones(1, np.uint8), np.ones((1, lay.ny), np.uint8)
        self._none = np.zeros((0, lay.p)), np.zeros((0, lay.ny)), np.zeros((0, lay.n))
        self.reset()

    def reset(self) -> None:
        """Forget all samples."""
        self.memory: EffectsMemory = begin_effects(self.setup)
        self.records: list[tuple[EffectsRecord, Array]] = []

    def taken(
        self, inputs: Array, known: NDArray[np.uint8], outputs: Array, use: NDArray[np.uint8], record: bool
    ) -> tuple[EffectsMemory, EffectsRecord]:
        """Memory and course after some samples; nothing changes until `commit`."""
        return take_effects(self.setup, self.memory, inputs, known, outputs, use, keep=self.keep or record)

    def one(self, inputs: Array, outputs: Array) -> bool:
        """Learn from a single sample on the shortest way; False, and nothing done, where that is not open."""
        memory = self.memory
        kernel = memory.kernel
        if self.keep or kernel is None or memory.inputs.size or memory.rounds == 0:
            return False
        W = self._row
        W[0, :-1] = inputs[0]
        after = memory.copied()
        done, why = kernel.run(
            kernel.sizes, kernel.fixed, after.packed, after.counters, W, self._there[0], outputs,
            self._there[1], False, *self._none, *kernel.rest,
        )  # fmt: skip
        if done != 1 or why != DONE:
            return False
        self.memory = after
        return True

    def commit(
        self, taken: tuple[EffectsMemory, EffectsRecord], outputs: Array, use: NDArray[np.uint8]
    ) -> None:
        """Make what was taken the present."""
        self.memory, record = taken
        if self.keep:
            self.records.append((record, np.where(use, outputs, np.nan)))

    def finish(self) -> None:
        """Learn from what is still held back, however short."""
        memory = self.memory
        if memory.rounds == 0 and memory.inputs.shape[0] > self.setup.layout.n + 2:
            self.memory = go_over(self.setup, memory)

    # -- results -----------------------------------------------------------------------------------

    @property
    def theta(self) -> Array:
        """Coefficients, shape (p,)."""
        return self.setup.layout.view(self.memory.packed, "theta").copy()

    @property
    def covariance(self) -> Array:
        """Covariance of the coefficients, shape (p, p); infinite before anything is learned."""
        found = self.setup.layout.view(self.memory.packed, "Pt").copy()
        if not found.any():
            found[np.diag_indices_from(found)] = np.inf
        return found

    @property
    def parameters(self) -> tuple[Any, ...]:
        """Rows: name, kind, place, initial, value, coefficient, std, unit, role."""
        from ..refinement.outcome import _rows

        roles = ["effect"] * len(self.setup.effects)
        return _rows(self.setup.bare, roles, self.theta, np.sqrt(np.diag(self.covariance)))

    @property
    def noise(self) -> Array:
        """Level of the innovations, shape (n_y,)."""
        return np.asarray(np.sqrt(self.setup.layout.view(self.memory.packed, "level")[1]))

    def system(self, name: str) -> ct.StateSpace:
        """Refined linear model in continuous time."""
        if self.memory.rounds == 0:
            return self.setup.model.with_arrays(name=name).to_statespace()
        return self.setup.structure(self.memory.widths).system(self.theta, name)

    def discrete_system(self, name: str) -> ct.StateSpace:
        """Refined linear model, its input held between samples."""
        return to_discrete(LinearModel.from_statespace(self.system(name)), self.setup.dt).to_statespace(name)

    def predict(self, inputs: Array) -> Array:
        """Free run on further inputs of shape (N, n_w); outputs of shape (n_y, N)."""
        setup, memory = self.setup, self.memory
        total = inputs.shape[0]
        outputs = np.zeros((total, setup.layout.ny))
        if memory.rounds == 0:  # still the initial model, from rest
            drive = np.vstack([memory.inputs, inputs])
            initial = Structure(setup.physical)
            engine = engine_on(setup, initial, drive, np.zeros((drive.shape[0], setup.layout.ny)))
            return engine.run(np.zeros(0), sensitivity=False).outputs[:, -total:]
        memory = replace(
            memory, rounds=1 << 30, inputs=memory.inputs[:0], outputs=memory.outputs[:0], rivals=memory.rivals
        )
        _, record = take_effects(
            setup, memory, inputs, np.ones(total, np.uint8), outputs, np.zeros(outputs.shape, np.uint8),
            keep=True,
        )  # fmt: skip
        return np.ascontiguousarray(record.predicted.T)

    def cautions(self) -> list[str]:
        """What speaks against trusting the coefficients, one sentence each."""
        return cautions(self.setup, self.memory)

    def rows(self) -> list[list[str]]:
        """Cells of the table of parameters."""
        return [
            [
                row.name,
                row.kind if row.name != row.kind else "",
                row.place,
                f"{row.initial:.5g}",
                f"{row.value:.5g}",
                f"{row.std:.2g}",
                row.unit,
            ]
            for row in self.parameters
        ]


def joined(parts: Sequence[Array], width: int) -> Array:
    """Blocks of shape (N, width) as (width, sum of N)."""
    if not parts:
        return np.zeros((width, 0))
    return np.ascontiguousarray(np.concatenate(list(parts)).T)
