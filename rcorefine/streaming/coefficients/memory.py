"""All that the physical stage remembers and knows, packed into two plain arrays.

One array to copy makes a call all or nothing at no cost, and one array to write makes a save exact.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...systems.linear import Array

__all__ = ["CoefficientMemory", "Layout"]


@dataclass(frozen=True, slots=True)
class Layout:
    """Sizes, and where each quantity stands in the packed memory.

    Parameters
    ----------
    n, p, nu, ny, m : int
        States, coefficients, inputs with the constant one, outputs, inner states of laws.
    lag : int
        Samples of the input that delays look back on.
    kept : int
        Input laws, where one of them has an inner state.
    """

    n: int
    p: int
    nu: int
    ny: int
    m: int
    lag: int
    kept: int = 0

    @property
    def shapes(self) -> dict[str, tuple[int, ...]]:
        """Names and shapes in the order of the memory."""
        n, p, nu, ny = self.n, self.p, self.nu, self.ny
        return {
            "theta": (p,),
            "delta": (p,),
            "x": (n,),
            "S": (p, n),
            "Pb": (n, n),
            "Pt": (p, p),
            "level": (2, ny),
            "count": (ny,),
            "cost": (2, ny),
            "power": (2, ny),
            "surprise": (1,),
            "w": (nu,),
            "z": (self.m,),
            "ring": (self.lag, nu),
            "kept": (self.kept, 6),
        }

    @property
    def size(self) -> int:
        """Length of the memory."""
        return sum(int(np.prod(shape)) for shape in self.shapes.values())

    def view(self, memory: Array, name: str) -> Array:
        """One quantity, as a view into the memory."""
        at = 0
        for key, shape in self.shapes.items():
            length = int(np.prod(shape))
            if key == name:
                return memory[at : at + length].reshape(shape)
            at += length
        raise KeyError(name)


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
        Coefficients of other valleys, not yet out of the race.
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
