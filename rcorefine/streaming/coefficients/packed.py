"""Layout of the quantities of a filter in two plain arrays.

One array holds what the filter remembers, the other what it is given.

One array to copy makes a call all or nothing at no cost, and one array to write makes a save exact.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import NamedTuple

import numpy as np

from ...jit import compiled
from ...systems.linear import Array

__all__ = [
    "CoefficientRecord",
    "Filter",
    "Given",
    "Layout",
    "Sample",
    "given_at",
    "matrix",
    "remembered",
    "row",
    "sample_of",
]


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
        part, shape = _places(self)[name]
        return memory[part].reshape(shape)

    def record(self, n_samples: int) -> CoefficientRecord:
        """Room for the course over some samples, nothing known of it yet."""
        return CoefficientRecord(
            *(np.full((n_samples, width), np.nan) for width in (self.p, self.ny, self.n))
        )


@lru_cache(maxsize=64)
def _places(layout: Layout) -> dict[str, tuple[slice, tuple[int, ...]]]:
    """Return the position and shape of each quantity in the memory."""
    found, at = {}, 0
    for name, shape in layout.shapes.items():
        stop = at + int(np.prod(shape))
        found[name] = slice(at, stop), shape
        at = stop
    return found


class CoefficientRecord(NamedTuple):
    """History over a block: coefficients, predicted outputs and states.

    Each has shape (N, .), or no rows.
    """

    theta: Array
    predicted: Array
    x: Array

    def part(self, start: int, stop: int) -> CoefficientRecord:
        """Samples from `start` up to `stop`."""
        return CoefficientRecord(*(column[start:stop] for column in self))


class Filter(NamedTuple):
    """State of the filter as views into the packed memory.

    theta : coefficients; delta : what a block of frozen ones says about them; x : state;
    S : sensitivity of the state, (p, n); Pb : covariance of the state for known coefficients;
    Pt : covariance of the coefficients; level : mean square of the innovations, quick and slow,
    (2, n_y); counted : samples in it; cost : sum of squares and count; power : what the prior doubt
    moves at an output; surprise : mean square of what the filter was sure of; w : last inputs;
    z, ring, kept : inner states of force laws, past inputs, inner states of input effects.
    """

    theta: Array
    delta: Array
    x: Array
    S: Array
    Pb: Array
    Pt: Array
    level: Array
    counted: Array
    cost: Array
    power: Array
    surprise: Array
    w: Array
    z: Array
    ring: Array
    kept: Array


class Given(NamedTuple):
    """Quantities that stay fixed until the next discretization.

    centre : coefficients of the discretization; limits : their bounds, (2, p); least : steps that do
    not matter; floor : declared variance of the noise; numbers : when to discretize (standard
    deviations), what is not forgotten, limit of the state, when to begin anew; Q, Qw : covariance of
    unknown forces, and of inputs that were not measured.
    """

    centre: Array
    limits: Array
    least: Array
    floor: Array
    numbers: Array
    Q: Array
    Qw: Array


class Sample(NamedTuple):
    """Prediction of one sample for its correction, and work space.

    F : transition; H, h : outputs by the state before and by the coefficients; yhat : outputs, the
    later ones corrected by the earlier; predicted : outputs as they were predicted; g : gain of the
    coefficients; gain : of the state, before and after the transition; T, loose : room.
    """

    F: Array
    H: Array
    h: Array
    yhat: Array
    predicted: Array
    g: Array
    gain: Array
    T: Array
    loose: Array


@compiled
def row(packed, at, size):
    """Numbers from `at` on, and where the next ones stand."""
    return packed[at : at + size], at + size


@compiled
def matrix(packed, at, rows, columns):
    """Return a matrix view of the packed array, and the next position."""
    return packed[at : at + rows * columns].reshape(rows, columns), at + rows * columns


@compiled
def remembered(sizes, packed):
    """Views of the packed memory, in the order of `memory.Layout`."""
    n, p, nu, ny = sizes[0], sizes[1], sizes[2], sizes[3]
    theta, at = row(packed, 0, p)
    delta, at = row(packed, at, p)
    x, at = row(packed, at, n)
    S, at = matrix(packed, at, p, n)
    Pb, at = matrix(packed, at, n, n)
    Pt, at = matrix(packed, at, p, p)
    level, at = matrix(packed, at, 2, ny)
    count, at = row(packed, at, ny)
    cost, at = matrix(packed, at, 2, ny)
    power, at = matrix(packed, at, 2, ny)
    surprise, at = row(packed, at, 1)
    w, at = row(packed, at, nu)
    z, at = row(packed, at, sizes[6])
    ring, at = matrix(packed, at, sizes[5], nu)
    kept, at = matrix(packed, at, sizes[7], 6)
    return Filter(theta, delta, x, S, Pb, Pt, level, count, cost, power, surprise, w, z, ring, kept)


@compiled
def given_at(sizes, fixed):
    """Views of what `Setup.head` packed, and where the model begins."""
    n, p, ny = sizes[0], sizes[1], sizes[3]
    centre, at = row(fixed, 0, p)
    limits, at = matrix(fixed, at, 2, p)
    least, at = row(fixed, at, p)
    floor, at = row(fixed, at, ny)
    numbers, at = row(fixed, at, 4)
    Q, at = matrix(fixed, at, n, n)
    Qw, at = matrix(fixed, at, n, n)
    return Given(centre, limits, least, floor, numbers, Q, Qw), at


@compiled
def sample_of(sizes):
    """Room for one sample."""
    n, p, ny = sizes[0], sizes[1], sizes[3]
    room = np.zeros(3 * n * n + ny * (n + p) + 2 * ny + p + 2 * n)
    F, at = matrix(room, 0, n, n)
    H, at = matrix(room, at, ny, n)
    h, at = matrix(room, at, ny, p)
    yhat, at = row(room, at, ny)
    predicted, at = row(room, at, ny)
    g, at = row(room, at, p)
    gain, at = matrix(room, at, 2, n)
    T, at = matrix(room, at, n, n)
    loose, at = matrix(room, at, n, n)
    return Sample(F, H, h, yhat, predicted, g, gain, T, loose)
