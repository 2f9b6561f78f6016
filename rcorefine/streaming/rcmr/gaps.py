"""How the paper's stages are carried over samples that are missing."""

from __future__ import annotations

import numpy as np

from ...exceptions import DataError
from ...systems.linear import Array
from ..gaps import Block
from .arrays import Record
from .memory import Memory
from .setup import Setup
from .stream import take

__all__ = ["take_over_gaps"]


def take_over_gaps(
    setup: Setup, memory: Memory, block: Block, *, keep: bool = False
) -> tuple[Memory, list[tuple[Record, Array]]]:
    """Take stretch after stretch; in a gap stage 1's own output stands in for the measured one.

    So its performance is zero there, which asks for no change.
    """
    records: list[tuple[Record, Array]] = []
    complete = np.asarray(block.use.all(axis=1))
    position, total = 0, complete.size
    while position < total:
        ahead = np.flatnonzero(complete[position:] != complete[position])
        stop = position + (int(ahead[0]) if ahead.size else total - position)
        if not complete[position]:
            stop = position + 1
        inputs, outputs = block.inputs[position:stop], block.outputs[position:stop].copy()
        if not complete[position]:
            gap = block.use[position] == 0
            outputs[0, gap] = _stand_in(setup, memory, inputs, outputs)[gap]
        memory, record, learned = take(setup, memory, inputs, outputs, keep=keep)
        if keep and record is not None:
            records.append((record, learned.copy()))
        position = stop
    return memory, records


def _stand_in(setup: Setup, memory: Memory, inputs: Array, outputs: Array) -> Array:
    """Output of stage 1 at the next sample, before it has learned from it."""
    if memory.tuned is None:
        if memory.outputs.shape[0] == 0:
            raise DataError(
                "an output is missing at the first sample, before anything can stand in for it; "
                "start at a sample that is whole"
            )
        return np.asarray(memory.outputs[-1])
    _, record, _ = take(setup, memory, inputs, outputs, keep=True)
    assert record is not None
    return np.asarray(record.z1[0] + outputs[0])
