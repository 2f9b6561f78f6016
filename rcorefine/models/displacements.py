"""Find displacement states in a plain StateSpace."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..systems.linear import Array, LinearModel

__all__ = ["Displacement", "find_displacements", "is_companion", "significant"]


@dataclass(frozen=True, slots=True)
class Displacement:
    """A state whose derivative is a velocity or a difference of two.

    Parameters
    ----------
    state : int
        Index of the displacement.
    moving, other : int or None
        Velocity states: d' = scale (x_moving - ratio x_other) + input part.
    absolute : bool
        Whether the state belongs to one mass (and not to a link, an elongation).
    scale : float
        1 unless displacement and velocity have different units.
    ratio : float
        Of the other end, as of a gear.
    """

    state: int
    moving: int | None
    other: int | None
    absolute: bool
    scale: float
    ratio: float = 1.0


def is_companion(A: Array, tolerance: float = 1e-9) -> bool:
    """Return whether A is a companion matrix (observable canonical form).

    Parameters
    ----------
    A : ndarray of shape (n, n)
        State matrix, the states in any order.
    tolerance : float, optional
        Relative size below which an entry counts as zero.

    Returns
    -------
    bool
        True for n >= 3 if all of A but one column is a chain of ones.

    Notes
    -----
    The controllable form, with a free row, is a chain of integrators, which
    `find_displacements` looks into: with two states it is a mass on a spring, and with a
    row that does not look back a mass behind a lagged actuator.
    """
    n = A.shape[0]
    if n < 3:
        return False
    for free in range(n):
        chain = np.where(np.abs(A) > tolerance, A, 0.0)
        chain[:, free] = 0.0
        rest = np.delete(chain, free, axis=1)
        if (np.count_nonzero(rest, axis=0) != 1).any() or not np.allclose(rest.sum(axis=0), 1.0):
            continue
        # nilpotent of full index = one path through all the states
        if np.any(np.linalg.matrix_power(chain, n - 1)):
            return True
    return False


def significant(A: Array, tolerance: float) -> Array:
    """Return A with negligible entries set to zero.

    An entry is negligible if it is small relative to its row and to its column.

    Parameters
    ----------
    A : ndarray of shape (n, n)
        State matrix.
    tolerance : float
        Relative size below which an entry counts as zero.

    Returns
    -------
    ndarray of shape (n, n)
        Copy of `A`.
    """
    size = np.abs(A)
    limit = tolerance * np.minimum(
        size.max(axis=1, keepdims=True, initial=0.0), size.max(axis=0, keepdims=True, initial=0.0)
    )
    return np.where(size > limit, A, 0.0)


def find_displacements(linear: LinearModel, tolerance: float = 1e-9) -> list[Displacement]:
    """Displacement states of a continuous-time model.

    Parameters
    ----------
    linear : LinearModel
        Continuous-time model.
    tolerance : float, optional
        Relative size below which an entry counts as zero.

    Returns
    -------
    list of Displacement
        In the order of the states; empty for canonical forms.
    """
    A, B = linear.A, linear.B
    n = linear.n_states
    if is_companion(A, tolerance):
        return []
    columns = np.abs(B).max(axis=0, initial=0.0)
    driven = [bool((np.abs(B[i]) > tolerance * np.maximum(columns, 1e-300)).any()) for i in range(n)]
    entries = [np.flatnonzero(np.abs(A[i]) > tolerance * np.abs(A[i]).max()) for i in range(n)]

    single = {
        i: int(entries[i][0])
        for i in range(n)
        if entries[i].size == 1 and entries[i][0] != i and not driven[i]
    }
    unit = {i: j for i, j in single.items() if abs(A[i, j] - 1.0) <= 10 * tolerance}
    pairs = _pairs(A, single, unit, entries)
    found: list[Displacement] = []
    for i in sorted(pairs, key=lambda i: (A[pairs[i], i] >= 0, i)):
        if all(item.moving != pairs[i] for item in found):  # else a second integral of one velocity
            found.append(Displacement(i, pairs[i], None, True, float(A[i, pairs[i]])))
    taken = {item.state for item in found}
    for i in range(n):
        if i not in taken and i not in unit:
            link = _elongation(A, B[i] if driven[i] else np.zeros(0), i, entries[i], taken)
            if link is not None:
                found.append(link)
    moving = {item.moving for item in found} | {item.other for item in found}
    return sorted((item for item in found if item.state not in moving), key=lambda item: item.state)


def _pairs(
    A: Array, single: dict[int, int], unit: dict[int, int], entries: list[NDArray[np.intp]]
) -> dict[int, int]:
    """Velocity of each displacement of a mass."""
    pairs = _unit_pairs(unit, entries)
    velocities = set(pairs.values())
    for i, j in single.items():
        # another unit of length (or an LC pair) is believed only if a spring acts back
        chained = i in single.values() and single.get(j) != i
        if i in unit or i in velocities or j in pairs or chained or single.get(j, i) != i:
            continue
        if A[i, j] > 0 and A[j, i] < 0:
            pairs[i] = j
    return pairs


def _unit_pairs(unit: dict[int, int], entries: list[NDArray[np.intp]]) -> dict[int, int]:
    """Displacement and velocity in chains x_i' = x_j with coefficient one.

    Three in a chain are position, velocity and a lagged actuator if the last does not look back at
    the others. If it does, they may as well be a canonical form or the integral of a
    position, so none of them is taken; nor is any of a longer chain.
    """
    pairs: dict[int, int] = {}
    for i in unit:
        chain = [i]
        while chain[-1] in unit and unit[chain[-1]] not in chain:
            chain.append(unit[chain[-1]])
        closed = chain[-1] in unit  # back to the start, as in an inverted pendulum at rest
        if closed and len(chain) == 2:
            pairs[min(chain)] = max(chain)
        elif i not in unit.values():
            looks_back = bool(set(chain[:-1]) & set(entries[chain[-1]].tolist()))
            if len(chain) == 2 or (len(chain) == 3 and not looks_back):
                pairs[chain[0]] = chain[1]
    return pairs


def _elongation(
    A: Array, driven: Array, i: int, entries: NDArray[np.intp], taken: set[int]
) -> Displacement | None:
    """Return state i as an elongation, or None if it is not one.

    Its derivative is v_j - v_k, v_j - w, w - v_k or v_j / N - v_k, and a spring acts back.
    """
    if i in entries or any(int(j) in taken for j in entries) or not 0 < entries.size <= 2:
        return None
    if any(A[i, j] * A[j, i] >= 0 for j in entries):
        return None
    one = int(next((j for j in entries if A[i, j] > 0), entries[0]))
    size = float(abs(A[i, one]))
    if entries.size == 1:
        if not _from_input(A, driven, i, one):
            return None
        moving, other = (one, None) if A[i, one] > 0 else (None, one)
        return Displacement(i, moving, other, False, size)
    if driven.size:
        return None
    end = int(entries[entries != one][0])
    ratio = float(-A[i, end] / A[i, one])
    if abs(ratio - 1.0) <= 1e-6:
        ratio = 1.0
    return Displacement(i, one, end, False, float(A[i, one]), ratio)


def _from_input(A: Array, driven: Array, i: int, j: int) -> bool:
    """Return whether an input moves the other end of an elongation.

    The input is a velocity in the same unit.
    """
    velocity = driven[driven != 0]
    if velocity.size != 1 or not np.isclose(velocity[0], -A[i, j], rtol=1e-6):
        return False
    # an entry of minus one that its velocity gets back is the observable form with unit gain
    canonical = A[i, j] < 0 and np.isclose(A[j, i], 1.0)
    return bool(np.isclose(abs(A[i, j]), 1.0, rtol=1e-6) and not canonical)
