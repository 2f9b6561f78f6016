"""Samples in, memory out: a filter for coefficients."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from ...effects.compiled import raise_pending
from ...systems.linear import Array
from .guard import explain_divergence
from .kernel import DIVERGED, MOVED, SURPRISED
from .memory import CoefficientMemory
from .setup import Setup

__all__ = ["CoefficientRecord", "take"]


@dataclass(frozen=True, slots=True, eq=False)
class CoefficientRecord:
    """Course over a block: coefficients, predicted outputs and states, each of shape (N, .)."""

    theta: Array
    predicted: Array
    x: Array


def take(
    setup: Setup,
    memory: CoefficientMemory,
    inputs: Array,
    known: NDArray[np.uint8],
    outputs: Array,
    use: NDArray[np.uint8],
    *,
    keep: bool = False,
) -> tuple[CoefficientMemory, CoefficientRecord]:
    """Memory after some samples; the one given stays as it is.

    Parameters
    ----------
    setup, memory
        The stage.
    inputs, outputs : ndarray of shape (N, n_w), (N, n_y)
        Samples, finite; what is not to be used may hold anything finite.
    known, use : ndarray of uint8, shape (N,), (N, n_y)
        Which inputs (as a whole) and which outputs were measured.
    keep : bool
        Whether to record every sample.
    """
    memory = memory.copied()
    lay = setup.layout
    total = inputs.shape[0]
    W = np.ones((total, lay.nu))
    W[:, :-1] = inputs
    if not keep and memory.rounds and not memory.inputs.size and setup.milestone(memory.rounds) < 0:
        nothing = _nothing(setup)
        return _advance(setup, memory, W, known, outputs, use, nothing, slice(0, total)), nothing
    shape = total if keep else 0
    record = CoefficientRecord(*(np.full((shape, width), np.nan) for width in (lay.p, lay.ny, lay.n)))
    position = 0
    while position < total:
        buffered = memory.n_samples
        target = setup.milestone(memory.rounds)
        stop = total if target < 0 else min(total, position + target - buffered)
        part = slice(position, stop)
        if target >= 0:
            memory = replace(
                memory,
                inputs=np.concatenate([memory.inputs, inputs[part]]),
                outputs=np.concatenate([memory.outputs, outputs[part]]),
                known=np.concatenate([memory.known, known[part]]),
                use=np.concatenate([memory.use, use[part]]),
            )
        if memory.rounds == 0:
            memory.counters[0] += stop - position
            if keep:
                record.theta[part] = memory.origin
        else:
            memory = _advance(setup, memory, W[part], known[part], outputs[part], use[part], record, part)
        position = stop
        if target >= 0 and memory.n_samples == target:
            memory = _gone_over(setup, memory)
    return memory, record


@lru_cache(maxsize=64)
def _nothing(setup: Setup) -> CoefficientRecord:
    """Record of no sample."""
    lay = setup.layout
    return CoefficientRecord(np.zeros((0, lay.p)), np.zeros((0, lay.ny)), np.zeros((0, lay.n)))


def _gone_over(setup: Setup, memory: CoefficientMemory) -> CoefficientMemory:
    memory = setup.go_over(memory)
    if memory.n_samples >= setup.milestones[-1]:
        memory = replace(
            memory,
            inputs=memory.inputs[:0].copy(),
            outputs=memory.outputs[:0].copy(),
            known=memory.known[:0].copy(),
            use=memory.use[:0].copy(),
            rivals=memory.rivals[:0].copy(),
        )
    return memory


def _advance(
    setup: Setup,
    memory: CoefficientMemory,
    W: Array,
    known: NDArray[np.uint8],
    outputs: Array,
    use: NDArray[np.uint8],
    record: CoefficientRecord,
    part: slice,
) -> CoefficientMemory:
    """Run the loop, in place, discretizing anew where coefficients have moved."""
    keep = record.theta.shape[0] > 0
    lay = setup.layout
    position, total = 0, W.shape[0]
    first = memory.n_samples
    if memory.kernel is None:
        memory = replace(memory, kernel=setup.compile(memory))
    none = _nothing(setup)
    while position < total:
        rows = slice(part.start + position, part.start + total)
        kept = (
            (record.theta[rows], record.predicted[rows], record.x[rows])
            if keep
            else (none.theta, none.predicted, none.x)
        )
        kernel = memory.kernel
        done, why = kernel.run(
            kernel.sizes, kernel.fixed, memory.packed, memory.counters, W[position:], known[position:],
            outputs[position:], use[position:], False, *kept, *kernel.rest,
        )  # fmt: skip
        raise_pending()
        position += done
        if why == DIVERGED:
            raise explain_divergence(setup, memory, first + position)
        if why == SURPRISED:
            memory = setup.renewed(memory)
            if memory.kernel is None:
                memory = replace(memory, kernel=setup.compile(memory))
        if why == MOVED:
            centre = lay.view(memory.packed, "theta").copy()
            memory = replace(memory, centre=centre, discretized=memory.discretized + 1)
            memory = replace(memory, kernel=setup.compile(memory))
    return memory
