"""Masses from the symmetry of the stiffness matrix and from the inputs."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from ..systems.linear import Array, LinearModel, balance
from .displacements import Displacement, connected, is_companion, of_masses, significant
from .ports import row_of

_LEFT = (1e-7, 2e-3)  # relative residual of an equation: rounding, entries of four digits
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
    # units of the coordinates that balance the couplings
    d = balance(np.abs(K) + np.sqrt(np.abs(K).max(initial=0.0)) * np.abs(C))
    K, C, B = K * d / d[:, None], C * d / d[:, None], B / d[:, None]
    # basis of the symmetric matrices W
    one, two = np.triu_indices(n)
    basis = np.zeros((one.size, n, n))
    basis[np.arange(one.size), one, two] = basis[np.arange(one.size), two, one] = 1.0
    # linear equations: K W and C W are symmetric
    rows = np.vstack([_asymmetries(X, basis) for X in (K, C)])
    for tolerance in _LEFT:
        # matrices W that satisfy them; an input selects one of several
        open_ = np.tensordot(_null(rows, tolerance).T, basis, axes=1)
        found = _candidates(open_, B, tolerance if len(open_) > 1 else _LEFT[-1])
        if not found and len(open_) == 1 and (W := _definite(open_[0])) is not None:
            found = [(W, -1, -1)]
        if found:
            break
    # of all candidates, the ones with the fewest numbers in the model
    counts = [_numbers(K, C, B, W) for W, *_ in found]
    fewest = min(counts, default=(without, 1))
    found = [item for item, count in zip(found, counts, strict=True) if count == fewest]
    # they must agree, and save numbers over separate masses
    unique = all(np.abs(other[0] - found[0][0]).max() <= 10 * tolerance for other in found)
    if not unique or fewest >= (without, 1):
        return None
    W, i, j = found[0]
    # scale: the input is a force of unit size at its coordinate
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
            # the column of W at coordinate i must be parallel to that of the input
            across = np.eye(len(b)) - np.outer(b, b) / size**2
            left = _null(across @ open_[:, :, i].T, tolerance)
            W = _definite(np.tensordot(left[:, 0], open_, axes=1)) if left.shape[1] == 1 else None
            if W is not None:
                found.append((W, i, j))
    return found


def _null(rows: Array, tolerance: float) -> Array:
    """Directions that rows of size one say nothing about."""
    # null space by singular values
    _, s, right = np.linalg.svd(rows)
    rank = int(np.count_nonzero(s > tolerance))
    return np.asarray(right[rank:].T)


def _asymmetries(X: Array, basis: Array) -> Array:
    """Return the equations that make X W symmetric.

    There is one equation per pair of coordinates. Empty equations are left out.
    """
    # (X W - W' X') above the diagonal
    products = X @ basis
    upper = np.triu_indices(len(X), 1)
    rows = (products - products.transpose(0, 2, 1))[:, upper[0], upper[1]].T
    size = np.linalg.norm(rows, axis=1)
    nonzero = size > 1e-9 * size.max(initial=0.0)
    return np.asarray(rows[nonzero] / size[nonzero, None])


def _numbers(K: Array, C: Array, B: Array, W: Array) -> tuple[int, int]:
    """Count the numbers in masses, stiffness, damping and inputs.

    The second value is 1 if stiffness or damping couples coordinates.
    """
    # mass matrix, and units in which its diagonal is one
    M: Array = np.asarray(np.linalg.inv(W), dtype=np.float64)
    size = np.sqrt(np.diag(M))

    def large(X: Array, across: Array | float) -> NDArray[np.bool_]:
        X = np.asarray(np.abs(X) / size[:, None] / across)
        return np.asarray(X > _LEFT[-1] * X.max(initial=1e-300))

    # entries that count in M, stiffness, damping and force
    mass, spring, damper, force = large(M, size), large(M @ K, size), large(M @ C, size), large(M @ B, 1.0)
    count = sum(np.count_nonzero(np.triu(X)) for X in (mass, spring, damper)) + np.count_nonzero(force)
    return int(count) - 1, int(np.triu(spring | damper, 1).any())  # one less for the unit of the masses


def _definite(W: Array) -> Array | None:
    """A matrix of unit size that is positive definite, else None."""
    # positive trace, largest entry one
    W = W * np.sign(np.trace(W)) / np.abs(W).max()
    if (np.diag(W) <= _SINGULAR**2).any():
        return None
    # positive definite with a unit diagonal
    size = np.sqrt(np.diag(W))
    if np.linalg.eigvalsh(W / size / size[:, None])[0] < _SINGULAR:
        return None
    return np.asarray(W)


_ASYMMETRY = 0.05  # misfit of log mass ratios up to which one set of masses explains them


@dataclass(frozen=True, slots=True, eq=False)
class MassScale:
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
    linked: NDArray[np.bool_]
    base_acceleration: Array

    @property
    def mass(self) -> Array:
        """Effective mass for a force on one state alone, of shape (n,)."""
        return np.asarray(1.0 / np.diag(self.inverse))

    @property
    def shared(self) -> bool:
        """Return whether coordinates share inertia."""
        return bool(np.count_nonzero(self.inverse) > len(self.inverse))

    def act(self, ends: Mapping[int, float]) -> Array:
        """Rates of the states by a unit resisting force with these ends."""
        return np.asarray(-self.inverse @ row_of(len(self.inverse), ends))


def relative_masses(
    linear: LinearModel,
    displacements: Sequence[Displacement],
    tolerance: float,
    declared: Mapping[int, float],
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
    declared : mapping of int to float
        Masses of states that are known.

    Returns
    -------
    MassScale
        Masses, links and the base input.
    """
    A, labels = linear.A, linear.state_labels
    # log ratios of the masses of coupled pairs
    ratios = _ratios(A, displacements, tolerance)
    velocities = {state for item in displacements for state in item.ends}
    taken = velocities | {item.state for item in displacements}
    stores = [i for i in range(linear.n_states) if i not in taken]
    # stores that exchange something: capacities in place of masses
    for i, j in exchanging(A, stores, tolerance):
        if A[i, j] > 0:  # exchange in both directions: capacities make it symmetric, like masses
            ratios[i, j] = float(np.log(A[i, j] / A[j, i]))
    # masses of each connected group up to a common factor
    logs, linked = _solve(linear.n_states, ratios)
    base = np.zeros(linear.n_inputs)
    if velocities:  # base excitation: -1 on every velocity state and 0 elsewhere
        pattern = row_of(linear.n_states, dict.fromkeys(velocities, -1.0))[:, None]
        base = np.isclose(linear.B, pattern, rtol=0, atol=1e-9).all(axis=0).astype(float)
    # factor: a declared mass, or an input that drives one velocity alone
    anchors = _anchors(linear, base, tolerance)
    anchors |= {state: (size, -1, "what was declared") for state, size in declared.items()}
    mass, origin = np.ones(linear.n_states), [f"forces are per unit mass of {label}" for label in labels]
    # scale each group by its anchor
    for members in connected(linked):
        known = [state for state in members if state in anchors and (state in velocities or state in stores)]
        anchor = min(known, key=lambda state: anchors[state][1]) if known else members[0]
        size, _, source = anchors[anchor] if known else (1.0, -1, "")
        for state in members:
            mass[state] = size * np.exp(logs[state] - logs[anchor])
            origin[state] = f"forces are per unit mass of {labels[anchor]}"
            if known:
                origin[state] = f"mass {mass[state]:.4g} from {source}"
                origin[state] += " and the symmetry of A" if state != anchor else ""
    scale = MassScale(np.diag(1.0 / mass), origin, linked, base)
    # coordinates may share inertia (cart and pendulum)
    if all(item.absolute and item.moving not in declared for item in displacements):
        _share_inertia(linear, displacements, scale, tolerance)
    return scale


def _share_inertia(
    linear: LinearModel, displacements: Sequence[Displacement], masses: MassScale, tolerance: float
) -> None:
    """Enter a coupled mass matrix where separate masses do not suffice.

    Separate masses do not suffice if they leave couplings one-sided.
    """
    A, labels = significant(linear.A, tolerance), linear.state_labels
    q, v, scale = of_masses(displacements)
    # accelerations by displacements and velocities
    K, C = A[np.ix_(v, q)] * scale, A[np.ix_(v, v)]
    linked, mass = masses.linked[np.ix_(v, v)], masses.mass[v][:, None]
    count, explained = 0, np.ones((len(v), len(v)), dtype=bool)
    for X in (K, C):
        # couplings that separate masses make symmetric
        force = mass * X
        link = linked & (np.abs(force - force.T) <= _ASYMMETRY * np.abs(force))
        explained &= link | (X == 0) | np.eye(len(v), dtype=bool)
        count += int(np.count_nonzero(X)) - int(np.count_nonzero(np.triu(link & (X != 0), 1)))
    if explained.all():
        return
    count += int(np.count_nonzero(significant(linear.B, tolerance)[v])) + len(v) - len(connected(linked))
    # else an inverse mass matrix with couplings
    found = coupled_inverse(K, C, linear.B[v], count)
    if found is None:
        return
    W, i, j = found
    masses.inverse[np.ix_(v, v)] = W
    masses.linked[np.ix_(v, v)] = True
    words = "masses from "
    if i >= 0:
        words += f"the input {linear.input_labels[j]} and "
    words += "the symmetry of stiffness and damping, which share inertia"
    for k in v:
        masses.origin[k] = words if i >= 0 else f"{words}; forces are relative to {labels[v[0]]}"


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
    # positive couplings from other stores, a negative rate of its own
    stores = [i for i in states if A[i, i] < 0 and all(A[i, j] >= 0 for j in states if j != i)]
    found = []
    for i, j in combinations(stores, 2):
        if A[i, j] > 0 and A[j, i] > 0:
            # no store gets more than the other one loses
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

    def enter(one: int, two: int, ratio: float) -> None:
        found.setdefault((min(one, two), max(one, two)), float(np.log(ratio)) * (1.0 if one < two else -1.0))

    q, v, scale = of_masses(displacements)
    K, C = A[np.ix_(v, q)], A[np.ix_(v, v)]
    # couplings that count, relative to the row
    sprung = np.abs(K) > tolerance * np.abs(K).max(axis=1, keepdims=True, initial=0.0)
    for i, j in combinations(range(len(v)), 2):
        if sprung[i, j] != sprung[j, i]:
            continue  # one-way coupling is not a link
        # without a spring the damper gives the ratio
        forth, back = (K[i, j] * scale[j], K[j, i] * scale[i]) if sprung[i, j] else (C[i, j], C[j, i])
        # A_ij / A_ji = m_j / m_i
        if forth * back > 0:
            enter(v[i], v[j], forth / back)
    for item in displacements:
        if not item.absolute and item.moving is not None and item.other is not None:
            # elongation as a state: ratio of the reactions at both ends
            ratio = -item.ratio * A[item.moving, item.state] / A[item.other, item.state]
            enter(item.moving, item.other, ratio)
    return found


def _solve(n: int, ratios: dict[tuple[int, int], float]) -> tuple[Array, NDArray[np.bool_]]:
    """Return log masses (n,) that fit all ratios, and the pairs kept (n, n).

    Pairs that do not fit are dropped, the worst first.
    """
    kept = dict(ratios)
    logs, linked = np.zeros(n), np.zeros((n, n), dtype=bool)
    while kept:
        rows, target = np.zeros((len(kept), n)), np.array(list(kept.values()))
        one, two = np.array(list(kept)).T
        each = np.arange(len(kept))
        rows[each, one], rows[each, two] = -1.0, 1.0
        # least squares for the logarithms of the masses
        logs = np.linalg.lstsq(rows, target, rcond=None)[0]
        misfit = np.abs(rows @ logs - target)
        worst = float(misfit.max())
        if worst <= _ASYMMETRY:
            linked[one, two] = linked[two, one] = True
            break
        # drop the worst pairs; equally bad ones of a loop together
        limit = worst * (1.0 - 1e-6 if len(kept) <= 200 else 0.9)
        kept = {pair: kept[pair] for pair, off in zip(kept, misfit, strict=True) if off < limit}
    return logs, linked


def _anchors(linear: LinearModel, base: Array, tolerance: float) -> dict[int, tuple[float, int, str]]:
    """Return mass 1/|B|, input and source of states with their own input.

    Exactly one input drives such a state, and that input drives no other state.
    """
    driven = np.abs(linear.B) > tolerance * np.abs(linear.B).max(axis=0, initial=0.0, keepdims=True)
    # one input, one velocity: 1/m is the entry of B
    own = (driven.sum(axis=1) == 1)[:, None] & (driven.sum(axis=0) == 1) & (base == 0) & driven
    return {
        i: (float(1.0 / abs(linear.B[i, j])), j, f"the input {linear.input_labels[j]}")
        for i, j in np.argwhere(own).tolist()
    }
