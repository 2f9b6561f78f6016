"""Displacements and modes in the matrices of a plain StateSpace."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.sparse.csgraph import connected_components

from ..systems.linear import Array, LinearModel
from .ports import Element, port_at, row_of

_SAME = 1e-3  # relative difference of entries that rounding to four digits explains


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

    @property
    def ends(self) -> dict[int, float]:
        """Weights of the velocity states."""
        both = (self.moving, 1.0), (self.other, -self.ratio)
        return {state: weight for state, weight in both if state is not None}


def of_masses(displacements: Sequence[Displacement]) -> tuple[list[int], list[int], Array]:
    """Return states, velocities and scales of the displacements of masses."""
    own = [d for d in displacements if d.absolute]
    velocities = [d.moving for d in own if d.moving is not None]
    return [d.state for d in own], velocities, np.array([d.scale for d in own])


def connected(linked: NDArray[np.bool_]) -> list[list[int]]:
    """Connected components, each in ascending order."""
    count, label = connected_components(linked, directed=False)
    return [np.flatnonzero(label == k).tolist() for k in range(count)]


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
    # one column is free; the others must be a chain of ones
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
    driven = (np.abs(B) > tolerance * np.maximum(np.abs(B).max(axis=0, initial=0.0), 1e-300)).any(axis=1)
    entries = [np.flatnonzero(np.abs(row) > tolerance * np.abs(row).max()) for row in A]
    # rows with one entry and no input: x_i' = a x_j
    single = {
        i: int(entries[i][0])
        for i in range(n)
        if entries[i].size == 1 and entries[i][0] != i and not driven[i]
    }
    # with a = 1, displacement and velocity are in the same unit
    unit = {i: j for i, j in single.items() if abs(A[i, j] - 1.0) <= 10 * tolerance}
    # displacement and velocity of a mass
    pairs = _pairs(A, single, unit, entries)
    found: list[Displacement] = []
    for i in sorted(pairs, key=lambda i: (A[pairs[i], i] >= 0, i)):
        if all(item.moving != pairs[i] for item in found):  # else a second integral of one velocity
            found.append(Displacement(i, pairs[i], None, True, float(A[i, pairs[i]])))
    taken = {item.state for item in found}
    # elongations: the rate is a difference of velocities
    for i in range(n):
        if i not in taken and i not in unit:
            link = _elongation(A, B[i] if driven[i] else np.zeros(0), i, entries[i], taken)
            if link is not None:
                found.append(link)
    # the velocity of one displacement is not a displacement itself
    moving = {state for item in found for state in item.ends}
    return sorted((item for item in found if item.state not in moving), key=lambda item: item.state)


def _pairs(
    A: Array, single: dict[int, int], unit: dict[int, int], entries: list[NDArray[np.intp]]
) -> dict[int, int]:
    """Velocity of each displacement of a mass."""
    pairs = _unit_pairs(unit, entries)
    velocities = set(pairs.values())
    for i, j in single.items():
        # displacement in another unit (or an LC pair): only if a spring acts back
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
        # follow the chain x_i' = x_j, x_j' = x_k, ...
        chain = [i]
        while chain[-1] in unit and unit[chain[-1]] not in chain:
            chain.append(unit[chain[-1]])
        closed = chain[-1] in unit  # closed chain, as in a linearized inverted pendulum
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
    # a spring acts back: the entries A_ij and A_ji have opposite signs
    if any(A[i, j] * A[j, i] >= 0 for j in entries):
        return None
    one = int(next((j for j in entries if A[i, j] > 0), entries[0]))
    size = float(abs(A[i, one]))
    # one velocity state: the other end is moved by an input
    if entries.size == 1:
        if not _from_input(A, driven, i, one):
            return None
        moving, other = (one, None) if A[i, one] > 0 else (None, one)
        return Displacement(i, moving, other, False, size)
    if driven.size:
        return None
    end = int(entries[entries != one][0])
    # ratio of a gear between both ends
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
    # entries -1 and 1 are an observable form with unit gain
    canonical = A[i, j] < 0 and np.isclose(A[j, i], 1.0)
    return bool(np.isclose(abs(A[i, j]), 1.0, rtol=1e-6) and not canonical)


def find_modes(
    linear: LinearModel, displacements: Sequence[Displacement], tolerance: float = 1e-9
) -> list[Element]:
    """Modes of a model in modal coordinates.

    Parameters
    ----------
    linear : LinearModel
        Continuous-time model.
    displacements : sequence of Displacement
        Its displacement states.
    tolerance : float, optional
        Relative size below which an entry counts as zero.

    Returns
    -------
    list of Element
        Displacement, squared frequency and damping of each, the modal mass taken as one; empty in physical
        coordinates.

    Notes
    -----
    Blocks ``[[s, w], [-w, s]]`` are modes. Blocks ``[[0, 1], [-k, -c]]`` may as well be masses on springs of
    their own: they are modes where an input drives, and an output reads, several of them.
    """
    A = significant(linear.A, tolerance)
    owned = {(item.state, item.moving) for item in displacements if item.absolute}
    rotating, oscillators = [], []
    # modes are coupled pairs of states
    for block in connected((A != 0) | (A != 0).T):
        if len(block) != 2:
            continue
        i, j = block
        # rotation block [[s, w], [-w, s]]
        spins = abs(A[i, j] + A[j, i]) <= _SAME * abs(A[i, j]) and A[i, j] * A[j, i] < 0
        if spins and abs(A[i, i] - A[j, j]) <= _SAME * abs(A[i, j]) and A[i, i] and A[j, j]:
            rotating.append((i, j))
        # oscillator block [[0, 1], [-k, -c]]
        elif (i, j) in owned or (j, i) in owned:
            oscillators.append((i, j) if (i, j) in owned else (j, i))
    # oscillators are modes only if inputs and outputs share them
    if not _share_signal(linear.B.T, oscillators) or not _share_signal(linear.C, oscillators):
        oscillators = []
    return [_mode(linear, i, j) for i, j in sorted([*rotating, *oscillators])]


def _share_signal(rows: Array, blocks: Sequence[tuple[int, int]]) -> bool:
    """Return whether one signal belongs to several of the blocks."""
    size = np.abs(rows) > 1e-9 * np.abs(rows).max(axis=1, keepdims=True, initial=0.0)
    return any(sum(bool(row[[i, j]].any()) for i, j in blocks) > 1 for row in size)


def _mode(linear: LinearModel, i: int, j: int) -> Element:
    pair = [i, j]
    A, B = linear.A[np.ix_(pair, pair)], linear.B[pair]
    # direction in which the inputs drive the pair
    drive = np.linalg.svd(B)[0][:, 0] if B.any() else np.array([0.0, 1.0])
    across = np.array([drive[1], -drive[0]])  # displacement: the input drives it only through its rate
    across *= np.sign(across[np.argmax(np.abs(across))])
    # displacement across that direction; its rate is the velocity
    rate = across @ A
    act = -drive / float(rate @ drive)
    # squared frequency: determinant; 2 zeta omega: minus the trace
    square, twice = float(np.linalg.det(A)), -float(np.trace(A))
    frequency, labels = np.sqrt(square), linear.state_labels
    port = port_at(
        linear,
        labels[i],
        f"mode of {frequency:.4g} rad/s, damping ratio {twice / 2 / frequency:.3g}, states {labels[i]} "
        f"and {labels[j]}; forces are per modal mass",
        row_of(linear.n_states, dict(zip(pair, act, strict=True))),
        dict(zip(pair, rate, strict=True)),
        dict(zip(pair, across, strict=True)),
        velocity_input=np.where(np.abs(across @ B) > 1e-12 * np.abs(B).max(initial=0.0), across @ B, 0.0),
        modal=True,
    )
    return Element(port, square, twice, (i, j))
