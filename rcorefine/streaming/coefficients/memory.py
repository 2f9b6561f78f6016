"""All that a filter for coefficients remembers between two calls."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...systems.linear import Array
from ..gaps import Block

__all__ = ["CoefficientMemory"]


@dataclass(frozen=True, eq=False)
class CoefficientMemory:
    """State of the physical stage between two calls.

    Parameters
    ----------
    packed : ndarray
        As `Layout` says.
    counters : ndarray of int64, shape (3,)
        Samples taken; samples for which the initial state still matters; whether unknown forces act.
    centre : ndarray, shape (p,)
        Coefficients that the model was discretized for.
    origin : ndarray, shape (p,)
        Coefficients that the search starts from, the mean of their prior.
    spread : ndarray, shape (p,)
        Standard deviation of their prior; empty until the first samples tell the sizes.
    widths : ndarray
        Smoothing width of each law that has one, by effect; NaN for others.
    sizes : ndarray, shape (n_w + n_y,)
        Rms of inputs and outputs over the first samples.
    states : ndarray, shape (n,)
        Rms of the states over the first samples; empty until they tell it.
    inputs, outputs : ndarray, shape (K, n_w), (K, n_y)
        First samples, gone over again as the model improves; empty later.
    known, use : ndarray of uint8, shape (K,), (K, n_y)
        Which of them were measured.
    rivals : ndarray, shape (r, p)
        Coefficients of other valleys, not yet discarded.
    rounds : int
        Times that the first samples were gone over.
    discretized : int
        Times that the model was discretized.
    renewed : int
        Times that the filter began anew, its innovations far beyond what it was sure of.
    doubted : int
        Sample at which it last began anew with the state alone, 0 for never.
    kernel : Kernel
        The model discretized at `centre`, made from the other fields.
    """

    packed: Array
    counters: NDArray[np.int64]
    centre: Array
    origin: Array
    spread: Array
    widths: Array
    sizes: Array
    states: Array
    inputs: Array
    outputs: Array
    known: NDArray[np.uint8]
    use: NDArray[np.uint8]
    rivals: Array
    rounds: int
    discretized: int
    renewed: int
    doubted: int
    kernel: Any = None

    @property
    def first(self) -> Block:
        """The first samples, as far as they are kept."""
        return Block(self.inputs, self.outputs, self.known, self.use)

    @property
    def n_samples(self) -> int:
        """Samples taken."""
        return int(self.counters[0])

    def __getstate__(self) -> dict[str, Any]:
        return {**self.__dict__, "kernel": None}  # compiled code stays in its process

    def copied(self) -> CoefficientMemory:
        """Independent copy of what changes in place."""
        twin = object.__new__(CoefficientMemory)  # dataclasses.replace takes longer than the sample itself
        twin.__dict__.update(self.__dict__)
        twin.__dict__["packed"], twin.__dict__["counters"] = self.packed.copy(), self.counters.copy()
        return twin
