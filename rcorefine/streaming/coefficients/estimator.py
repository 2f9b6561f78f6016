"""Estimator of coefficients on a stream.

It takes samples and returns coefficients, their uncertainty and a model.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from typing import Any

import numpy as np

from ...systems.conversion import to_discrete
from ...systems.linear import Array, LinearModel
from ..gaps import Block
from ..restoring import check_course, check_like, check_range
from ..summary import Summary, summarize_coefficients
from .guard import cautions
from .kernel import DONE
from .memory import CoefficientMemory
from .packed import CoefficientRecord
from .setup import Setup
from .stage import take

__all__ = ["CoefficientFilter", "joined"]

# the first samples, and what was found about them
_GROWN = {**dict.fromkeys(("inputs", "outputs", "known", "use"), "samples"), "rivals": "valleys"}


class CoefficientFilter:
    """Joint Kalman filter for the state and coefficients of a model.

    It runs on a stream.

    Parameters
    ----------
    setup : Setup
        Model, coefficients, settings.
    keep : bool
        Whether to keep the course of every sample.
    """

    def __init__(self, setup: Setup, keep: bool) -> None:
        self.setup, self.keep = setup, keep
        self._unrecorded = setup.layout.record(0)
        self.reset()

    def reset(self) -> None:
        """Forget all samples."""
        self.memory: CoefficientMemory = self.setup.begin()
        self.records: list[tuple[CoefficientRecord, Array]] = []

    @property
    def n_samples(self) -> int:
        """Samples taken."""
        return self.memory.n_samples

    @property
    def filter(self) -> CoefficientFilter:
        """Filter of the coefficients that the refined model has."""
        return self

    @contextmanager
    def all_or_nothing(self) -> Iterator[None]:
        """Undo what was learned where an error follows."""
        memory, count = self.memory, len(self.records)
        try:
            yield
        except BaseException:
            self.memory = memory
            del self.records[count:]
            raise

    def take(self, block: Block, *, predict: bool = False) -> Array:
        """Learn from a block; with `predict` what was expected, one sample ahead."""
        self.memory, record = take(self.setup, self.memory, block, keep=self.keep or predict)
        if self.keep:
            self.records.append((record, np.where(block.use, block.outputs, np.nan)))
        return record.predicted

    def one(self, block: Block) -> bool:
        """Learn from a single sample by the fast path, if that is available.

        Otherwise do nothing and return False.
        """
        memory = self.memory
        kernel = memory.kernel
        if self.keep or kernel is None or memory.inputs.size or memory.rounds == 0:
            return False
        after = memory.copied()
        if kernel.over(after.packed, after.counters, block, self._unrecorded) != (1, DONE):
            return False
        self.memory = after
        return True

    def finish(self) -> None:
        """Learn from what is still held back, however short."""
        memory = self.memory
        if memory.rounds == 0 and memory.inputs.shape[0] > self.setup.layout.n + 2:
            self.memory = self.setup.go_over(memory)

    # -- results -----------------------------------------------------------------------------------

    @property
    def theta(self) -> Array:
        """Coefficients, shape (p,)."""
        return self.setup.layout.view(self.memory.packed, "theta").copy()

    @property
    def covariance(self) -> Array:
        """Covariance of the coefficients, shape (p, p).

        It is infinite before anything is learned.
        """
        found = self.setup.layout.view(self.memory.packed, "Pt").copy()
        if not found.any():
            found[np.diag_indices_from(found)] = np.inf
        return found

    @property
    def standard_deviations(self) -> Array:
        """Standard deviations of the coefficients, shape (p,).

        They are infinite before anything is learned.
        """
        return np.asarray(np.sqrt(np.maximum(np.diag(self.covariance), 0.0)))

    @property
    def parameters(self) -> tuple[Any, ...]:
        """Rows: name, kind, place, initial, value, coefficient, std, unit, role."""
        return self.setup.rows(self.theta, self.standard_deviations)

    @property
    def noise(self) -> Array:
        """Level of the innovations, shape (n_y,)."""
        return np.asarray(np.sqrt(self.setup.layout.view(self.memory.packed, "level")[1]))

    form = "coefficients"
    waits = False  # single samples are learned from at once

    @property
    def scores(self) -> dict[str, float]:
        """Nothing competes."""
        return {}

    def summary(self, model: LinearModel, stopped: str) -> Summary:
        """Cells and sentences of `str`."""
        return summarize_coefficients(model, self, stopped)

    def system(self, name: str) -> LinearModel:
        """Refined linear model, in the timebase that it is estimated in."""
        if self.memory.rounds == 0:
            return self.setup.model.with_arrays(name=name)
        return self.setup.system(self.theta, self.memory.widths, name)

    def discrete_system(self, name: str) -> LinearModel:
        """Refined linear model, its input held between samples."""
        return to_discrete(self.system(name), self.setup.settings.dt, self.setup.settings.hold)

    def predict(self, inputs: Array) -> Array:
        """Free run on further inputs of shape (N, n_w); outputs of shape (n_y, N)."""
        setup, memory, total = self.setup, self.memory, inputs.shape[0]
        if memory.rounds == 0:  # still the initial model, from rest
            inputs = np.vstack([memory.inputs, inputs])
            packed = np.zeros(setup.layout.size)
            setup.layout.view(packed, "theta")[:] = memory.centre
            memory = replace(memory, packed=packed, counters=np.array([1, 0, 0]), kernel=None)
        memory = replace(
            memory, rounds=1 << 30, inputs=memory.inputs[:0], outputs=memory.outputs[:0], rivals=memory.rivals
        )
        use = np.zeros((inputs.shape[0], setup.layout.ny), np.uint8)
        known = np.ones(inputs.shape[0], np.uint8)
        block = Block(inputs, np.zeros(use.shape), known, use)
        _, record = take(setup, memory, block, keep=True)
        return np.ascontiguousarray(record.predicted.T[:, -total:])

    def state(self) -> list[Any]:
        """All that is remembered, for a file."""
        return [self.memory, self.records]

    def restore(self, state: list[Any]) -> None:
        """Go on from what `state` gave, once it was held against a fresh memory."""
        memory, records = state
        lay, setup = self.setup.layout, self.setup
        fresh = setup.begin()
        if memory.spread.size:  # the first samples have told it
            fresh = replace(fresh, spread=np.zeros(lay.p))
        if memory.states.size:
            fresh = replace(fresh, states=np.zeros(lay.n))
        check_like(memory, fresh, "memory", _GROWN)
        target = setup.milestone(memory.rounds)
        check_range(memory.counters, 0, [target - 1 if target > 0 else np.inf, np.inf, 1], "memory.counters")
        check_range(memory.sizes, 0.0, np.inf, "memory.sizes")
        check_course(records, lay.record(0), lay.ny)
        self.memory, self.records = memory, records

    def cautions(self) -> list[str]:
        """Return the reasons not to trust the coefficients, one sentence each."""
        return cautions(self.setup, self.memory)

    def rows(self) -> list[list[str]]:
        """Cells of the table of parameters."""
        return [row.cells for row in self.parameters]


def joined(parts: Sequence[Array], width: int) -> Array:
    """Blocks of shape (N, width) as (width, sum of N)."""
    if not parts:
        return np.zeros((width, 0))
    return np.ascontiguousarray(np.concatenate(list(parts)).T)
