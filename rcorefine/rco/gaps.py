"""Samples that are missing: where they are, and how the paper's stages are carried over them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import control as ct
import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..arguments import as_choice
from ..exceptions import DataError
from ..systems.linear import Array
from .checks import as_samples, check_samples
from .kernels import Record
from .memory import Memory
from .setup import Sampled, Setup
from .stream import take

__all__ = ["Block", "as_missing", "block_with_gaps", "take_over_gaps", "whole_block"]

RAISE, HOLD_OUT = "raise", "hold-out"


@dataclass(frozen=True, slots=True, eq=False)
class Block:
    """Samples with gaps bridged, and which of them were measured.

    Parameters
    ----------
    inputs, outputs : ndarray of shape (N, n_w), (N, n_y)
        Finite samples; an input that is missing keeps its last value.
    known : ndarray of uint8, shape (N,)
        Whether all inputs of the sample were measured.
    use : ndarray of uint8, shape (N, n_y)
        Which outputs were measured.
    """

    inputs: Array
    outputs: Array
    known: NDArray[np.uint8]
    use: NDArray[np.uint8]

    @property
    def whole(self) -> bool:
        """Whether nothing is missing."""
        return bool(self.known.all() and self.use.all())


@lru_cache(maxsize=16)
def _all_there(n_samples: int, n_outputs: int) -> tuple[NDArray[np.uint8], NDArray[np.uint8]]:
    known, use = np.ones(n_samples, dtype=np.uint8), np.ones((n_samples, n_outputs), dtype=np.uint8)
    return known, use


def whole_block(inputs: Array, outputs: Array) -> Block:
    """Samples without a gap."""
    return Block(inputs, outputs, *_all_there(*outputs.shape))


def as_missing(value: Any) -> str:
    """What to do about missing samples."""
    return as_choice(value, "missing", (RAISE, HOLD_OUT))


def _unmasked(values: Any) -> Any:
    """Masked samples as NaN."""
    if np.ma.isMaskedArray(values):
        return np.ma.filled(np.ma.asarray(values, dtype=float), np.nan)
    return values


def block_with_gaps(setup: Sampled, w: ArrayLike, y: ArrayLike, first: int, latest: Array) -> Block:
    """One sample or a block of which NaN or masked samples are missing.

    Parameters
    ----------
    setup : Sampled
        Model with its labels.
    w, y : array_like
        As in `RCORefiner.update`.
    first : int
        Number of samples taken before.
    latest : ndarray of shape (n_w,)
        Inputs of the sample before, to go on with where one is missing.
    """
    model = setup.initial
    inputs = as_samples(_unmasked(w), "inputs", model.n_inputs)
    outputs = as_samples(_unmasked(y), "outputs", model.n_outputs)
    if inputs.shape[1] != outputs.shape[1]:
        raise ct.ControlDimension(
            f"inputs have {inputs.shape[1]} sample(s) and outputs {outputs.shape[1]}; "
            "give both at the same samples"
        )
    signals: Sequence[tuple[Array, tuple[str, ...], str]] = (
        (inputs, model.input_labels, "input"),
        (outputs, model.output_labels, "output"),
    )
    for signal, labels, what in signals:
        check_samples(np.where(np.isnan(signal), 0.0, signal), labels, what, first, setup.step)
    known, use = np.asarray(~np.isnan(inputs).any(axis=0)), ~np.isnan(outputs)
    inputs, outputs = np.ascontiguousarray(inputs.T), np.ascontiguousarray(outputs.T)
    before = latest
    for row in inputs:
        gap = np.isnan(row)
        row[gap] = before[gap]
        before = row
    outputs[~use.T] = 0.0
    return Block(inputs, outputs, known.astype(np.uint8), np.ascontiguousarray(use.T).astype(np.uint8))


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
