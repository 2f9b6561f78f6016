"""Path from the correction to the outputs.

It is described by discrete arrays, Markov parameters and zeros.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy import linalg

from ...exceptions import ModelError
from ...systems.linear import Array
from .arrays import Plant

__all__ = ["TOLERANCE", "column_delays", "markov_parameters", "path_zeros", "relative_degree"]

# A Markov parameter counts as zero below this share of the largest |C| |A^(i-1) B_u| of its entry
# over the first n + 1 samples: what is left of an exact cancellation after rounding.
TOLERANCE = 1e-10


def markov_parameters(plant: Plant, count: int) -> Array:
    """H_0 = D_u and H_i = C A^(i-1) B_u, shape (count, n_y, l_u)."""
    values = np.empty((count, *plant.Du.shape))
    values[0] = plant.Du
    power = plant.Bu
    for i in range(1, count):
        values[i] = plant.C @ power
        power = plant.A @ power
    return values


def _nonzero(plant: Plant) -> tuple[Array, NDArray[np.bool_]]:
    """Return n + 1 Markov parameters after H_0, and the nonzero entries.

    An entry counts as nonzero if it exceeds the rounding error.
    """
    count = plant.A.shape[0] + 2
    values = markov_parameters(plant, count)
    bound = np.abs(plant.Du)
    power = plant.Bu
    for _ in range(1, count):
        bound = np.maximum(bound, np.abs(plant.C) @ np.abs(power))
        power = plant.A @ power
    return values, np.abs(values) > TOLERANCE * bound


def relative_degree(plant: Plant) -> int:
    """Return the index d of the first nonzero Markov parameter.

    With feedthrough, d = 0.

    Raises
    ------
    ModelError
        If the correction reaches no output at all.
    """
    _, nonzero = _nonzero(plant)
    reached = nonzero.any(axis=(1, 2))
    if not reached.any():
        raise ModelError(
            "the correction reaches no output: every Markov parameter D_u, C A^i B_u is zero; "
            "choose correction_input (B_u) so that it drives a state that the outputs see"
        )
    return int(np.argmax(reached))


def column_delays(plant: Plant) -> Array:
    """Return the first nonzero Markov parameter of each correction.

    The shape is (n_y, l_u).

    Raises
    ------
    ModelError
        If a correction reaches no output.
    """
    values, nonzero = _nonzero(plant)
    reached = nonzero.any(axis=1)
    dead = ~reached.any(axis=0)
    if dead.any():
        raise ModelError(
            f"correction {int(np.argmax(dead))} (column of B_u, D_u) reaches no output; "
            "leave the column out, or measure where it acts"
        )
    first = np.argmax(reached, axis=0)
    return np.stack([values[first[c], :, c] for c in range(first.size)], axis=1)


def path_zeros(plant: Plant) -> NDArray[np.complex128]:
    """Return the finite zeros of the path u -> y.

    They are invariant zeros if the path is square, otherwise the zeros of every single path.
    """
    n_y, l_u = plant.Du.shape
    if n_y == l_u:
        pairs = [(slice(None), slice(None))]
    else:
        pairs = [(slice(r, r + 1), slice(c, c + 1)) for r in range(n_y) for c in range(l_u)]
    found = [_invariant_zeros(plant.A, plant.Bu[:, c], plant.C[r], plant.Du[r, c]) for r, c in pairs]
    return np.concatenate([*found, np.zeros(0, dtype=complex)])


def _invariant_zeros(a: Array, b: Array, c: Array, d: Array) -> NDArray[np.complex128]:
    n = a.shape[0]
    pencil = np.block([[a, b], [c, d]])
    mass = np.zeros_like(pencil)
    mass[:n, :n] = np.eye(n)
    alpha, beta = linalg.eig(pencil, mass, right=False, homogeneous_eigvals=True)
    finite = np.abs(beta) > 1e-10 * np.maximum(np.abs(alpha), 1e-300)
    zeros = np.asarray(alpha[finite] / beta[finite], dtype=complex)
    return np.asarray(zeros[np.isfinite(zeros)])
