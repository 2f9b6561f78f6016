"""Missing samples, and how the paper's stages handle them."""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..arguments import as_choice
from ..systems.linear import Array, LinearModel
from .checks import as_block, check_samples

__all__ = ["Block", "as_missing", "block_with_gaps", "whole_block"]

RAISE, HOLD_OUT = "raise", "hold-out"


class Block(NamedTuple):
    """Samples with gaps bridged, and flags for what was measured.

    The arrays are in the form that the kernels take.

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
        """Return whether nothing is missing."""
        # of a single sample ten times as fast as .all()
        return b"\0" not in self.use.tobytes() and b"\0" not in self.known.tobytes()

    def part(self, start: int, stop: int) -> Block:
        """Samples from `start` up to `stop`."""
        rows = slice(start, stop)
        return Block(self.inputs[rows], self.outputs[rows], self.known[rows], self.use[rows])

    @staticmethod
    def joined(blocks: Sequence[Block]) -> Block:
        """Blocks one after the other."""
        return Block(*map(np.concatenate, zip(*blocks, strict=True)))


@lru_cache(maxsize=16)
def _all_there(n_samples: int, n_outputs: int) -> tuple[NDArray[np.uint8], NDArray[np.uint8]]:
    known, use = np.ones(n_samples, dtype=np.uint8), np.ones((n_samples, n_outputs), dtype=np.uint8)
    return known, use


def whole_block(inputs: Array, outputs: Array) -> Block:
    """Samples without a gap."""
    return Block(inputs, outputs, *_all_there(*outputs.shape))


def as_missing(value: Any) -> str:
    """Return the checked choice of what to do about missing samples."""
    return as_choice(value, "missing", (RAISE, HOLD_OUT))


def _unmasked(values: Any) -> Any:
    """Masked samples as NaN."""
    if np.ma.isMaskedArray(values):
        return np.ma.filled(np.ma.asarray(values, dtype=float), np.nan)
    return values


def block_with_gaps(
    model: LinearModel, step: float | None, w: ArrayLike, y: ArrayLike, first: int, latest: Array
) -> Block:
    """One sample or a block of which NaN or masked samples are missing.

    Parameters
    ----------
    model : LinearModel
        Model with its labels.
    step : float or None
        Sampling time in s, for the messages.
    w, y : array_like
        As in `RCORefiner.update`.
    first : int
        Number of samples taken before.
    latest : ndarray of shape (n_w,)
        Inputs of the sample before, to go on with where one is missing.
    """
    inputs, outputs = as_block(model, _unmasked(w), _unmasked(y))
    for signal, labels, what in (
        (inputs, model.input_labels, "input"),
        (outputs, model.output_labels, "output"),
    ):
        check_samples(np.where(np.isnan(signal), 0.0, signal), labels, what, first, step)
    known, use = np.asarray(~np.isnan(inputs).any(axis=0)), ~np.isnan(outputs)
    inputs, outputs = np.ascontiguousarray(inputs.T), np.ascontiguousarray(outputs.T)
    before = latest
    for row in inputs:
        gap = np.isnan(row)
        row[gap] = before[gap]
        before = row
    outputs[~use.T] = 0.0
    return Block(inputs, outputs, known.astype(np.uint8), np.ascontiguousarray(use.T).astype(np.uint8))
