"""Samples in, memory out: the physical static stage of a refiner."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from ..systems.linear import Array
from .effects_guard import explain_divergence
from .effects_kernel import DIVERGED, MOVED
from .effects_memory import EffectsMemory
from .effects_setup import EffectsSetup, compile_kernel
from .effects_start import go_over, last_milestone, milestone

__all__ = ["EffectsRecord", "begin_effects", "take_effects"]


@dataclass(frozen=True, slots=True, eq=False)
class EffectsRecord:
    """Course over a block: coefficients, predicted outputs and states, each of shape (N, .)."""

    theta: Array
    predicted: Array
    x: Array


def begin_effects(setup: EffectsSetup) -> EffectsMemory:
    """Memory before the first sample."""
    lay = setup.layout
    n_w = lay.nu - 1
    lower, upper = setup.bounds
    origin = np.clip(setup.bare.start(), lower, upper)
    packed = np.zeros(lay.size)
    lay.view(packed, "theta")[:] = origin
    return EffectsMemory(
        packed=packed,
        counters=np.array([0, 10 * lay.n + 10, int(setup.loose)], dtype=np.int64),
        centre=origin.copy(),
        origin=origin,
        spread=np.zeros(0),
        widths=np.full(len(setup.effects), np.nan),
        sizes=np.zeros(n_w + lay.ny),
        inputs=np.zeros((0, n_w)),
        outputs=np.zeros((0, lay.ny)),
        known=np.zeros(0, dtype=np.uint8),
        use=np.zeros((0, lay.ny), dtype=np.uint8),
        rivals=np.zeros((0, lay.p)),
        rounds=0,
        discretized=0,
    )


def take_effects(
    setup: EffectsSetup,
    memory: EffectsMemory,
    inputs: Array,
    known: NDArray[np.uint8],
    outputs: Array,
    use: NDArray[np.uint8],
    *,
    keep: bool = False,
) -> tuple[EffectsMemory, EffectsRecord]:
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
    if not keep and memory.rounds and not memory.inputs.size and milestone(setup, memory.rounds) < 0:
        nothing = _nothing(setup)
        return _advance(setup, memory, W, known, outputs, use, nothing, slice(0, total)), nothing
    shape = total if keep else 0
    record = EffectsRecord(*(np.full((shape, width), np.nan) for width in (lay.p, lay.ny, lay.n)))
    position = 0
    while position < total:
        buffered = memory.n_samples
        target = milestone(setup, memory.rounds)
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
def _nothing(setup: EffectsSetup) -> EffectsRecord:
    """Record of no sample."""
    lay = setup.layout
    return EffectsRecord(np.zeros((0, lay.p)), np.zeros((0, lay.ny)), np.zeros((0, lay.n)))


def _gone_over(setup: EffectsSetup, memory: EffectsMemory) -> EffectsMemory:
    memory = go_over(setup, memory)
    if memory.n_samples >= last_milestone(setup):
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
    setup: EffectsSetup,
    memory: EffectsMemory,
    W: Array,
    known: NDArray[np.uint8],
    outputs: Array,
    use: NDArray[np.uint8],
    record: EffectsRecord,
    part: slice,
) -> EffectsMemory:
    """Run the loop, in place, discretizing anew where coefficients have moved."""
    keep = record.theta.shape[0] > 0
    lay = setup.layout
    position, total = 0, W.shape[0]
    first = memory.n_samples
    if memory.kernel is None:
        memory = replace(memory, kernel=compile_kernel(setup, memory))
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
        position += done
        if why == DIVERGED:
            raise explain_divergence(setup, memory, first + position)
        if why == MOVED:
            centre = lay.view(memory.packed, "theta").copy()
            memory = replace(memory, centre=centre, discretized=memory.discretized + 1)
            memory = replace(memory, kernel=compile_kernel(setup, memory))
    return memory
