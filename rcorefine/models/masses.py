"""Masses from the symmetry of the stiffness matrix and from the inputs."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from ..systems.balance import balance
from ..systems.linear import Array, LinearModel
from .displacements import Displacement, is_companion, significant

__all__ = ["MassScale", "coupled_inverse", "exchanging", "relative_masses"]

_LEFT = (1e-7, 2e-3)  # relative size of what is left of an equation: by arithmetic, by entries of four digits
_SINGULAR = 1e-6  # smallest eigenvalue of a mass matrix with ones on its diagonal


def coupled_inverse(K: Array, C: Array, B: Array, without: int) -> tuple[Array, int, int] | None:
    """Return the inverse W of a mass matrix that couples coordinates.

    Examples are a cart with its pendulum, and a beam.

    Parameters
    ----------
    K, C : ndarray of shape (n, n)
        Accelerations by displacements and by velocities, W times minus stiffness and damping.
    B : ndarray of shape (n, n_w)
        Accelerations by inputs.
    without : int
        Numbers that the model consists of where no inertia is shared.

    Returns
    -------
    inverse : ndarray of shape (n, n)
        Symmetric and positive definite; if an input acts at a single coordinate, that column of `inverse`
        is the input's column of `B`, otherwise the first entry is one.
    coordinate, column : int
        Of that input; -1 if there is none.
    None
        If no such matrix makes stiffness and damping symmetric, if more than one does with as few numbers,
        or if it saves none.

    Notes
    -----
    K W and C W are symmetric exactly if W^-1 K and W^-1 C are: linear equations in W. What they leave open
    (an undamped structure: all W p(K')) an input settles that is a force at one of the coordinates.
    Neither proves a mass matrix, for as many free numbers would fit as well: fewer do.
    """
    n = len(K)
    if n < 2:
        return None
    # units of the coordinates in which the couplings are of one size
    d = balance(np.abs(K) + np.sqrt(np.abs(K).max(initial=0.0)) * np.abs(C))
    K, C, B = K * d / d[:, None], C * d / d[:, None], B / d[:, None]
    basis = np.array([_unit(n, i, j) for i in range(n) for j in range(i, n)])
    rows = np.vstack([_asymmetries(X, basis) for X in (K, C)])
    for tolerance in _LEFT:
        open_ = np.tensordot(_null(rows, tolerance).T, basis, axes=1)
        found = _candidates(open_, B, tolerance if len(open_) > 1 else _LEFT[-1])
        if not found and len(open_) == 1 and (W := _definite(open_[0])) is not None:
            found = [(W, -1, -1)]
        if found:
            break
    counts = [_numbers(K, C, B, W) for W, *_ in found]
    fewest = min(counts, default=(without, 1))
    found = [item for item, count in zip(found, counts, strict=True) if count == fewest]
    one = all(np.abs(other[0] - found[0][0]).max() <= 10 * tolerance for other in found)
    if not one or fewest >= (without, 1):
        return None
    W, i, j = found[0]
    size = B[i, j] / (W[i, i] * d[i]) if i >= 0 else 1.0 / (W[0, 0] * d[0] ** 2)
    return abs(size) * W * d * d[:, None], i, j


def _candidates(open_: Array, B: Array, tolerance: float) -> list[tuple[Array, int, int]]:
    """Return possible inverse mass matrices, each with an input.

    They belong to the family `open_`, and the input acts at a single coordinate, which is returned as
    well.
    """
    found = []
    for j, b in enumerate(B.T):
        size = np.linalg.norm(b)
        for i in range(len(b)) if size else ():
            across = np.eye(len(b)) - np.outer(b, b) / size**2
            left = _null(across @ open_[:, :, i].T, tolerance)
            W = _definite(np.tensordot(left[:, 0], open_, axes=1)) if left.shape[1] == 1 else None
            if W is not None:
                found.append((W, i, j))
    return found


def _null(rows: Array, tolerance: float) -> Array:
    """Directions that rows of size one say nothing about."""
    _, s, right = np.linalg.svd(rows)
    rank = int(np.count_nonzero(s > tolerance))
    return np.asarray(right[rank:].T)


def _unit(n: int, i: int, j: int) -> Array:
    W = np.zeros((n, n))
    W[i, j] = W[j, i] = 1.0
    return W


def _asymmetries(X: Array, basis: Array) -> Array:
    """Return the equations that make X W symmetric.

    There is one equation per pair of coordinates. Empty equations are left out.
    """
    products = X @ basis
    upper = np.triu_indices(len(X), 1)
    rows = (products - products.transpose(0, 2, 1))[:, upper[0], upper[1]].T
    size = np.linalg.norm(rows, axis=1)
    told = size > 1e-9 * size.max(initial=0.0)
    return np.asarray(rows[told] / size[told, None])


def _numbers(K: Array, C: Array, B: Array, W: Array) -> tuple[int, int]:
    """Count the numbers in masses, stiffness, damping and inputs.

    The second value is 1 if stiffness or damping couples coordinates.
    """
    M: Array = np.asarray(np.linalg.inv(W), dtype=np.float64)
    size = np.sqrt(np.diag(M))

    def told(X: Array, across: Array | float) -> NDArray[np.bool_]:
        X = np.asarray(np.abs(X) / size[:, None] / across)
        return np.asarray(X > _LEFT[-1] * X.max(initial=1e-300))

    mass, spring, damper, force = told(M, size), told(M @ K, size), told(M @ C, size), told(M @ B, 1.0)
    count = sum(np.count_nonzero(np.triu(X)) for X in (mass, spring, damper)) + np.count_nonzero(force)
    return int(count) - 1, int(np.triu(spring | damper, 1).any())  # one is the unit of the masses


def _definite(W: Array) -> Array | None:
    """A matrix of unit size that is positive definite, else None."""
    W = W * np.sign(np.trace(W)) / np.abs(W).max()
    if (np.diag(W) <= _SINGULAR**2).any():
        return None
    size = np.sqrt(np.diag(W))
    if np.linalg.eigvalsh(W / size / size[:, None])[0] < _SINGULAR:
        return None
    return np.asarray(W)


_ASYMMETRY = 0.05  # ratios that differ by more are not those of one set of masses


@dataclass(frozen=True, slots=True, eq=False)
class MassScale:
    """Masses of the velocity states, as far as the matrices tell them.

    Parameters
    ----------
    inverse : ndarray of shape (n, n)
        Inverse of the mass matrix: the rates of the states by forces on them. Diagonal, with 1 where
        nothing is known, unless coordinates share inertia.
    origin : tuple of str
        Where each comes from, in words.
    links : frozenset of tuple of int
        Pairs of velocity states (lower index first) with a two-sided link.
    base_acceleration : ndarray of shape (n_w,)
        1 for the input that is the acceleration of the base, otherwise 0.
    """

    inverse: Array
    origin: tuple[str, ...]
    links: frozenset[tuple[int, int]]
    base_acceleration: Array

    @property
    def mass(self) -> Array:
        """Effective mass for a force on one state alone, of shape (n,)."""
        return np.asarray(1.0 / np.diag(self.inverse))

    @property
    def shared(self) -> bool:
        """Return whether coordinates share inertia."""
        return bool(np.count_nonzero(self.inverse) > len(self.inverse))

    def linked(self, one: int, two: int) -> bool:
        """Return whether a two-sided link joins two velocity states."""
        return (min(one, two), max(one, two)) in self.links


def relative_masses(
    linear: LinearModel,
    displacements: Sequence[Displacement],
    tolerance: float,
    declared: Mapping[int, float] | None = None,
) -> MassScale:
    """Return the masses that make the couplings in A symmetric.

    An input scales them if it determines a mass.

    Parameters
    ----------
    linear : LinearModel
        Continuous-time model.
    displacements : sequence of Displacement
        Its displacement states.
    tolerance : float
        Relative size below which an entry counts as zero.
    declared : mapping of int to float, optional
        Masses of states that are known.

    Returns
    -------
    MassScale
        Masses, links and the base input.
    """
    n, labels = linear.n_states, linear.state_labels
    ratios = _ratios(linear.A, displacements, tolerance)
    velocities = {s for item in displacements for s in (item.moving, item.other) if s is not None}
    stores = [i for i in range(n) if i not in velocities | {item.state for item in displacements}]
    for i, j in exchanging(linear.A, stores, tolerance):
        if linear.A[i, j] > 0:  # both ways: capacities, like masses, make it symmetric
            ratios[i, j] = float(np.log(linear.A[i, j] / linear.A[j, i]))
    states = sorted(velocities) + stores
    logs, kept, group = _solve(states, ratios)
    base = _base_acceleration(linear, sorted(velocities))
    mass = np.ones(n)
    origin = [f"forces are per unit mass of {label}" for label in labels]
    anchors = {
        state: (size, j, f"the input {linear.input_labels[j]}")
        for state, (size, j) in _anchors(linear, base, tolerance).items()
    }
    anchors |= {state: (size, -1, "what was declared") for state, size in (declared or {}).items()}
    for members in group:
        known = [state for state in members if state in anchors]
        anchor = min(known, key=lambda state: anchors[state][1]) if known else members[0]
        size = anchors[anchor][0] if known else 1.0
        for state in members:
            mass[state] = size * np.exp(logs[state] - logs[anchor])
            if known:
                origin[state] = f"mass {mass[state]:.4g} from {anchors[anchor][2]}"
                if state != anchor:
                    origin[state] += " and the symmetry of A"
            else:
                origin[state] = f"forces are per unit mass of {labels[anchor]}"
    inverse = np.diag(1.0 / mass)
    moving = [item.moving for item in displacements if item.absolute and item.moving is not None]
    if len(moving) == len(displacements) and not (set(moving) & set(declared or {})):
        _share_inertia(linear, displacements, inverse, origin, kept, tolerance)
    return MassScale(inverse, tuple(origin), frozenset(kept), base)


def _share_inertia(
    linear: LinearModel,
    displacements: Sequence[Displacement],
    inverse: Array,
    origin: list[str],
    kept: set[tuple[int, int]],
    tolerance: float,
) -> None:
    """Enter a coupled mass matrix where separate masses do not suffice.

    Separate masses do not suffice if they leave couplings one-sided.
    """
    A, labels = significant(linear.A, tolerance), linear.state_labels
    q, scale = [item.state for item in displacements], np.array([item.scale for item in displacements])
    v = [item.moving for item in displacements if item.moving is not None]
    K, C = A[np.ix_(v, q)] * scale, A[np.ix_(v, v)]
    B = significant(linear.B, tolerance)[v]
    linked = np.array([[(min(i, j), max(i, j)) in kept for j in v] for i in v], dtype=bool)
    mass = 1.0 / np.diag(inverse)[v][:, None]
    told, explained = 0, np.ones((len(v), len(v)), dtype=bool)
    for X in (K, C):
        force = mass * X
        link = linked & (np.abs(force - force.T) <= _ASYMMETRY * np.abs(force))
        explained &= link | (X == 0) | np.eye(len(v), dtype=bool)
        told += int(np.count_nonzero(X)) - int(np.count_nonzero(np.triu(link & (X != 0), 1)))
    if explained.all():
        return
    told += int(np.count_nonzero(B)) + len(v) - len(_groups(v, dict.fromkeys(kept, 0.0)))
    found = coupled_inverse(K, C, linear.B[v], told)
    if found is None:
        return
    W, i, j = found
    inverse[np.ix_(v, v)] = W
    kept |= set(combinations(sorted(v), 2))
    words = "the symmetry of stiffness and damping, which share inertia"
    for k in v:
        anchor = f"the input {linear.input_labels[j]} and {words}" if i >= 0 else words
        origin[k] = f"masses from {anchor}" + ("" if i >= 0 else f"; forces are relative to {labels[v[0]]}")


def exchanging(A: Array, states: Sequence[int], tolerance: float) -> list[tuple[int, int]]:
    """Return the pairs of stores between which something flows.

    It flows in both directions, or from the first to the second.

    Parameters
    ----------
    A : ndarray of shape (n, n)
        State matrix.
    states : sequence of int
        States that are neither displacements nor velocities.
    tolerance : float
        Relative size below which an entry counts as zero.

    Returns
    -------
    list of tuple of int
        Source and sink; for an exchange both ways the lower index first.
    """
    if is_companion(A, tolerance):
        return []
    A = significant(A, tolerance)
    # what flows in comes from others, what is there only flows out
    stores = [i for i in states if A[i, i] < 0 and all(A[i, j] >= 0 for j in states if j != i)]
    found = []
    for i, j in combinations(stores, 2):
        if A[i, j] > 0 and A[j, i] > 0:
            if A[i, j] <= -A[i, i] * (1 + 1e-6) and A[j, i] <= -A[j, j] * (1 + 1e-6):
                found.append((i, j))
        elif A[j, i] > 0:
            found.append((i, j))
        elif A[i, j] > 0:
            found.append((j, i))
    return found


def _ratios(
    A: Array, displacements: Sequence[Displacement], tolerance: float
) -> dict[tuple[int, int], float]:
    """Return log(m_j / m_i) of velocity states coupled in both directions."""
    found: dict[tuple[int, int], float] = {}
    absolute = [(item.state, item.moving, item.scale) for item in displacements if item.moving is not None]
    absolute = [(q, v, s) for q, v, s in absolute if any(i.state == q and i.absolute for i in displacements)]
    largest = {v: max(abs(A[v, q]) for q, _, _ in absolute) for _, v, _ in absolute}
    for (q1, v1, s1), (q2, v2, s2) in combinations(absolute, 2):
        sprung = abs(A[v1, q2]) > tolerance * largest[v1], abs(A[v2, q1]) > tolerance * largest[v2]
        if all(sprung):
            forth, back = A[v1, q2] * s2, A[v2, q1] * s1
        elif any(sprung):
            continue  # one-way coupling is not a link
        else:  # no spring between them: a damper tells the same ratio
            forth, back = A[v1, v2], A[v2, v1]
        if forth * back > 0:
            ratio = float(np.log(forth / back))
            found[min(v1, v2), max(v1, v2)] = ratio if v1 < v2 else -ratio
    for item in displacements:
        if not item.absolute and item.moving is not None and item.other is not None:
            pair = (min(item.moving, item.other), max(item.moving, item.other))
            ratio = float(np.log(-item.ratio * A[item.moving, item.state] / A[item.other, item.state]))
            found.setdefault(pair, ratio if pair[0] == item.moving else -ratio)
    return found


def _solve(
    states: list[int], ratios: dict[tuple[int, int], float]
) -> tuple[dict[int, float], set[tuple[int, int]], list[list[int]]]:
    """Return log masses that fit all ratios, the kept pairs, and groups.

    Pairs that do not fit are dropped, the worst first.
    """
    kept = dict(ratios)
    index = {state: k for k, state in enumerate(states)}
    while True:
        logs = np.zeros(len(states))
        if kept:
            rows = np.zeros((len(kept), len(states)))
            for k, (one, two) in enumerate(kept):
                rows[k, index[one]], rows[k, index[two]] = -1.0, 1.0
            target = np.array(list(kept.values()))
            logs = np.linalg.lstsq(rows, target, rcond=None)[0]
            misfit = np.abs(rows @ logs - target)
            worst = float(misfit.max())
            if worst > _ASYMMETRY:
                # a single loop cannot tell which of its links is at fault: equals go together
                limit = worst * (1.0 - 1e-6 if len(kept) <= 200 else 0.9)
                kept = {pair: kept[pair] for pair, off in zip(kept, misfit, strict=True) if off < limit}
                continue
        return {state: float(logs[index[state]]) for state in states}, set(kept), _groups(states, kept)


def _groups(states: list[int], pairs: dict[tuple[int, int], float]) -> list[list[int]]:
    """Connected components, in the order of the states."""
    root = {state: state for state in states}
    for one, two in pairs:
        old, new = max(root[one], root[two]), min(root[one], root[two])
        root = {state: new if top == old else top for state, top in root.items()}
    return [[s for s in states if root[s] == top] for top in sorted(set(root.values()))]


def _base_acceleration(linear: LinearModel, states: list[int]) -> Array:
    """1 for an input with -1 on every velocity state and 0 elsewhere."""
    base = np.zeros(linear.n_inputs)
    if states:
        pattern = np.zeros(linear.n_states)
        pattern[states] = -1.0
        for j in range(linear.n_inputs):
            base[j] = float(np.allclose(linear.B[:, j], pattern, rtol=0, atol=1e-9))
    return base


def _anchors(linear: LinearModel, base: Array, tolerance: float) -> dict[int, tuple[float, int]]:
    """Return mass 1/|B| and input of each state with an input of its own.

    Exactly one input drives such a state, and that input drives no other state.
    """
    B = np.abs(linear.B)
    B = np.where(B > tolerance * B.max(axis=0, initial=0.0, keepdims=True), B, 0.0)
    found: dict[int, tuple[float, int]] = {}
    for i in range(linear.n_states):
        inputs = np.flatnonzero(B[i])
        if inputs.size == 1:
            j = int(inputs[0])
            if np.count_nonzero(B[:, j]) == 1 and not base[j]:
                found[i] = (float(1.0 / B[i, j]), j)
    return found
