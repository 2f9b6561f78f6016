"""Samples in, memory out: a filter for coefficients."""

from __future__ import annotations

from dataclasses import replace

from ..gaps import Block
from .guard import explain_divergence
from .kernel import DIVERGED, MOVED, SURPRISED
from .memory import CoefficientMemory
from .packed import CoefficientRecord
from .setup import Setup

__all__ = ["advanced", "take"]


def take(
    setup: Setup, memory: CoefficientMemory, block: Block, *, keep: bool = False
) -> tuple[CoefficientMemory, CoefficientRecord]:
    """Memory after some samples; the one given stays as it is.

    Parameters
    ----------
    setup, memory
        The stage.
    block : Block
        Samples.
    keep : bool
        Whether to record every sample.

    Raises
    ------
    DivergenceError
        If the state leaves all bounds.
    """
    memory = memory.copied()
    total = len(block.inputs)
    record = setup.layout.record(total if keep else 0)
    position = 0
    while position < total:
        target = setup.milestone(memory.rounds)
        stop = total if target < 0 else min(total, position + target - memory.n_samples)
        part = block.part(position, stop)
        if target >= 0:
            memory = replace(memory, **Block.joined([memory.first, part])._asdict())
        if memory.rounds == 0:
            memory.counters[0] += stop - position
            if keep:
                record.theta[position:stop] = memory.origin
        else:
            memory, done = advanced(setup, memory, part, record.part(position, stop))
            if done < stop - position:
                raise explain_divergence(setup, memory, memory.n_samples)
        position = stop
        if target >= 0 and memory.n_samples == target:
            memory = setup.go_over(memory)
            if target == setup.milestones[-1]:
                nothing = {name: part.copy() for name, part in memory.first.part(0, 0)._asdict().items()}
                memory = replace(memory, rivals=memory.rivals[:0].copy(), **nothing)
    return memory, record


def advanced(
    setup: Setup, memory: CoefficientMemory, block: Block, record: CoefficientRecord
) -> tuple[CoefficientMemory, int]:
    """Return the memory after a block, and the number of samples done.

    The memory is changed in place. Fewer samples are done if the filter diverged.

    The model is discretized anew where coefficients have moved.
    """
    position, total = 0, len(block.inputs)
    while position < total:
        if memory.kernel is None:
            memory = replace(memory, kernel=setup.compile(memory))
        done, why = memory.kernel.over(
            memory.packed, memory.counters, block.part(position, total), record.part(position, total)
        )
        position += done
        if why == DIVERGED:
            break
        if why == SURPRISED:
            memory = setup.renewed(memory)
        if why == MOVED:
            centre = setup.layout.view(memory.packed, "theta").copy()
            memory = replace(memory, centre=centre, discretized=memory.discretized + 1, kernel=None)
    return memory, position
