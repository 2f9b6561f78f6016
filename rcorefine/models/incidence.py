"""Incidence of a plain model: the pattern of its entries, and its motion."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from itertools import combinations
from types import MappingProxyType
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.sparse.csgraph import connected_components

from ..systems.linear import Array, LinearModel
from .ports import Element, port_at, row_of

Mask = NDArray[np.bool_]
_SAME = 1e-3  # relative difference of entries that rounding to four digits explains


class Declared(NamedTuple):
    """Known properties of a plain model, by the names of its signals.

    Parameters
    ----------
    links : dict
        ``{name: {state: weight}}``.
    units : dict
        ``{signal: unit}``.
    masses : dict
        ``{displacement: mass}``.
    """

    links: Mapping[str, Mapping[str, float]] = MappingProxyType({})
    units: Mapping[str, str] = MappingProxyType({})
    masses: Mapping[str, float] = MappingProxyType({})


class Displacement(NamedTuple):
    """A state whose derivative is a velocity or a difference of two.

    Parameters
    ----------
    state : int
        Index of the displacement.
    ends : mapping of int to float
        Weights of the velocity states: d' = scale (sum of weight times state) + input part. The first end
        moves with weight 1; the weight of the other is negative, and not -1 behind a gear.
    scale : float
        1 unless displacement and velocity have different units.
    absolute : bool
        Whether the state belongs to one mass (and not to a link, an elongation).
    """

    state: int
    ends: Mapping[int, float]
    scale: float
    absolute: bool = False


class MassScale(NamedTuple):
    """Masses of the velocity states, as far as the matrices tell them.

    Parameters
    ----------
    inverse : ndarray of shape (n, n)
        Inverse of the mass matrix: the rates of the states by forces on them. Diagonal, with 1 where
        nothing is known, unless coordinates share inertia.
    origin : list of str
        Where each comes from, in words.
    linked : ndarray of bool, shape (n, n)
        Pairs of states that a two-sided link joins.
    base_acceleration : ndarray of shape (n_w,)
        1 for the input that is the acceleration of the base, otherwise 0.
    """

    inverse: Array
    origin: list[str]
    linked: Mask
    base_acceleration: Array

    @property
    def mass(self) -> Array:
        """Effective mass for a force on one state alone, of shape (n,)."""
        return 1.0 / np.diag(self.inverse)

    @property
    def shared(self) -> bool:
        """Return whether coordinates share inertia."""
        return bool(np.count_nonzero(self.inverse) > len(self.inverse))

    def act(self, ends: Mapping[int, float]) -> Array:
        """Rates of the states by a unit resisting force with these ends."""
        return -self.inverse @ row_of(len(self.inverse), ends)


@dataclass(eq=False)
class Incidence:
    """Linear model, the pattern of its entries, and what was found in it.

    Each finder takes the whole, and nothing is found twice. `recognize` fills masses and links.

    Parameters
    ----------
    linear : LinearModel
        Continuous-time model.
    tolerance : float
        Relative size below which an entry counts as zero.
    declared : Declared
        Links, units and masses that are known.

    Attributes
    ----------
    masses : MassScale
        Masses that make the couplings symmetric.
    links : list of Element
        Links between displacements.
    ambiguous : dict
        In words, by state: displacements whose links have more than one factorization.
    """

    linear: LinearModel
    tolerance: float
    declared: Declared
    masses: MassScale = field(init=False)
    links: list[Element] = field(init=False)
    ambiguous: dict[int, str] = field(init=False)

    @cached_property
    def A(self) -> Array:
        """State matrix with negligible entries set to zero."""
        return significant(self.linear.A, self.tolerance)

    @cached_property
    def driven(self) -> Mask:
        """Entries of B that count, relative to their column."""
        size = np.abs(self.linear.B)
        return np.asarray(size > self.tolerance * size.max(axis=0, initial=0.0), dtype=bool)

    @cached_property
    def companion(self) -> bool:
        """Return whether A is a companion matrix."""
        return is_companion(self.linear.A, self.tolerance)

    @cached_property
    def displacements(self) -> list[Displacement]:
        """Displacement states, in the order of the states.

        Those of modes are among them. There are none in canonical forms.
        """
        A, B, tolerance = self.linear.A, self.linear.B, self.tolerance
        if self.companion:
            return []
        driven: Mask = np.asarray(self.driven.any(axis=1))
        entries = [np.flatnonzero(np.abs(row) > tolerance * np.abs(row).max()) for row in A]
        # rows with one entry and no input: x_i' = a x_j
        single = {i: int(j[0]) for i, j in enumerate(entries) if j.size == 1 and j[0] != i and not driven[i]}
        # with a = 1, displacement and velocity are in the same unit
        unit = {i: j for i, j in single.items() if abs(A[i, j] - 1.0) <= 10 * tolerance}
        own = _of_masses(A, single, unit, entries)
        taken = {item.state for item in own}
        # elongations: the rate is a difference of velocities
        links = [
            _elongation(A, B[i] if driven[i] else np.zeros(0), i, entries[i], taken)
            for i in range(len(A))
            if i not in taken and i not in unit
        ]
        every = [*own, *(link for link in links if link)]
        # the velocity of one displacement is not a displacement itself
        moving = {state for item in every for state in item.ends}
        return sorted((item for item in every if item.state not in moving), key=lambda item: item.state)

    @cached_property
    def modes(self) -> list[Element]:
        """Modes of a model in modal coordinates.

        They have a displacement, squared frequency and damping each, the modal mass taken as one. There are
        none in physical coordinates.

        Notes
        -----
        Blocks ``[[s, w], [-w, s]]`` are modes. Blocks ``[[0, 1], [-k, -c]]`` may as well be masses on springs
        of their own: they are modes where an input drives, and an output reads, several of them.
        """
        A, linear = self.A, self.linear
        owned = {(item.state, *item.ends) for item in self.displacements if item.absolute}
        # modes are coupled pairs of states
        blocks = [block for block in connected((A != 0) | (A != 0).T) if len(block) == 2]
        rotating = [(i, j) for i, j in blocks if _is_rotation(A, i, j)]
        pairs = {(i, j) if (i, j) in owned else (j, i) for i, j in blocks if (i, j) not in rotating}
        # oscillators are modes only if inputs and outputs share them
        oscillators = sorted(pairs & owned)
        if not _share_signal(linear.B.T, oscillators) or not _share_signal(linear.C, oscillators):
            oscillators = []
        return [_mode(linear, i, j) for i, j in sorted([*rotating, *oscillators])]

    @cached_property
    def modal(self) -> set[int]:
        """States of the modes."""
        return {state for mode in self.modes for state in mode.states}

    @cached_property
    def physical(self) -> list[Displacement]:
        """Displacements that are no mode."""
        return [item for item in self.displacements if item.state not in self.modal]

    @cached_property
    def bodies(self) -> tuple[list[int], list[int], Array]:
        """States, velocities and scales of the displacements of masses."""
        own = [item for item in self.physical if item.absolute]
        velocities = [state for item in own for state in item.ends]
        return [item.state for item in own], velocities, np.array([item.scale for item in own])

    @cached_property
    def velocity(self) -> dict[int, int]:
        """Velocity of each displacement of a mass."""
        return dict(zip(*self.bodies[:2], strict=True))

    @cached_property
    def moving(self) -> set[int]:
        """Velocity states of masses and at the ends of elongations."""
        return {state for item in self.physical for state in item.ends}

    @cached_property
    def stores(self) -> list[int]:
        """States that are neither displacements, nor velocities, nor modes."""
        taken = self.modal | self.moving | {item.state for item in self.physical}
        return [i for i in range(self.linear.n_states) if i not in taken]

    @cached_property
    def exchange(self) -> list[tuple[int, int]]:
        """Pairs of stores between which something flows.

        It flows in both directions (the lower index first), or from the first to the second.
        """
        A = self.A
        # positive couplings from other stores, a negative rate of its own
        stores = [i for i in self.stores if A[i, i] < 0 and all(A[i, j] >= 0 for j in self.stores if j != i)]
        found = []
        for i, j in combinations([] if self.companion else stores, 2):
            if A[i, j] > 0 and A[j, i] > 0:
                # no store gets more than the other one loses
                if A[i, j] <= -A[i, i] * (1 + 1e-6) and A[j, i] <= -A[j, j] * (1 + 1e-6):
                    found.append((i, j))
            elif A[j, i] > 0:
                found.append((i, j))
            elif A[i, j] > 0:
                found.append((j, i))
        return found


def connected(linked: Mask) -> list[list[int]]:
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
    A : ndarray of shape (n, m)
        Matrix.
    tolerance : float
        Relative size below which an entry counts as zero.

    Returns
    -------
    ndarray of shape (n, m)
        Copy of `A`.
    """
    size = np.abs(A)
    limit = tolerance * np.minimum(
        size.max(axis=1, keepdims=True, initial=0.0), size.max(axis=0, keepdims=True, initial=0.0)
    )
    return np.where(size > limit, A, 0.0)


def _of_masses(
    A: Array, single: dict[int, int], unit: dict[int, int], entries: list[NDArray[np.intp]]
) -> list[Displacement]:
    """Displacements of masses, one for each velocity."""
    pairs = _unit_pairs(unit, entries)
    velocities = set(pairs.values())
    for i, j in single.items():
        # displacement in another unit (or an LC pair): only if a spring acts back
        chained = i in single.values() and single.get(j) != i
        if i in unit or i in velocities or j in pairs or chained or single.get(j, i) != i:
            continue
        if A[i, j] > 0 and A[j, i] < 0:
            pairs[i] = j
    # a second displacement of one velocity is an integral of it
    own: dict[int, Displacement] = {}
    for i in sorted(pairs, key=lambda i: (A[pairs[i], i] >= 0, i)):
        own.setdefault(pairs[i], Displacement(i, {pairs[i]: 1.0}, float(A[i, pairs[i]]), True))
    return list(own.values())


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
    # one velocity state: the other end is moved by an input
    if entries.size == 1:
        ends, size = {one: float(np.sign(A[i, one]))}, float(abs(A[i, one]))
        return Displacement(i, ends, size) if _from_input(A, driven, i, one) else None
    if driven.size:
        return None
    end = int(entries[entries != one][0])
    # ratio of a gear between both ends
    ratio = float(-A[i, end] / A[i, one])
    if abs(ratio - 1.0) <= 1e-6:
        ratio = 1.0
    return Displacement(i, {one: 1.0, end: -ratio}, float(A[i, one]))


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


def _is_rotation(A: Array, i: int, j: int) -> bool:
    """Return whether two states are a block ``[[s, w], [-w, s]]``."""
    limit = _SAME * abs(A[i, j])
    spins = abs(A[i, j] + A[j, i]) <= limit and A[i, j] * A[j, i] < 0
    return bool(spins and abs(A[i, i] - A[j, j]) <= limit and A[i, i] and A[j, j])


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
