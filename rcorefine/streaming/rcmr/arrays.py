"""Inputs and results of the kernels, as tuples of arrays.

Signals are rows in time (time first, so that one sample is contiguous) and
scaled to unit size; `delay` is d and `H` holds H_d ... H_(d+mu-1).
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ...systems.linear import Array

__all__ = [
    "AGE", "LEARNED", "PADDING", "RECENT", "SLOT", "STALE", "Design", "Integers", "Plant", "Record", "Stage",
]  # fmt: skip

Integers = NDArray[np.int64]

# Columns of Stage.counters
SLOT, AGE, STALE, RECENT, LEARNED = 0, 1, 2, 3, 4
# theta, rows and gain are padded with zeros to a multiple of this, which the passes run faster over.
PADDING = 4


class Plant(NamedTuple):
    """Scaled discrete model: x+ = A x + B w + B_u u, y = C x + D w + D_u u."""

    A: Array
    B: Array
    Bu: Array
    C: Array
    D: Array
    Du: Array


class Design(NamedTuple):
    """Settings of one stage; `H` has shape (mu, n_y, l_u)."""

    H: Array
    delay: int
    order: int
    alpha: float


class Stage(NamedTuple):
    """Everything that one stage remembers.

    theta : (m,), the rows of the (l_u, l_psi) matrix and padding;
    gain : (m, m), (Phi'Phi + alpha I)^-1
    but for the last sample's change, which is pending, (2, m);
    rows, offsets : the window, (p n_y, m) and (p n_y,); psi : (l_psi,);
    past_psi, past_u : the last samples, as a ring; x : (n,);
    energy : (1,), trace of Phi'Phi; counters : (5,).
    """

    theta: Array
    gain: Array
    pending: Array
    rows: Array
    offsets: Array
    psi: Array
    past_psi: Array
    past_u: Array
    x: Array
    energy: Array
    counters: Integers


class Record(NamedTuple):
    """History of a block, time first.

    Its length is 0 where it was not requested.
    """

    z1: Array
    z2: Array
    theta1: Array
    theta2: Array
    x: Array
