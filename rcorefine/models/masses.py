"""Masses from the symmetry of the stiffness matrix and from the inputs."""

from __future__ import annotations

from itertools import combinations

import numpy as np

from ..systems.linear import Array, balance
from .incidence import Incidence, Mask, MassScale, connected, significant
from .ports import row_of

Inertia = tuple[Array, int, int]  # inverse mass matrix, coordinate and column of an input
Anchors = dict[int, tuple[float, int, str]]  # by state: mass, input, source
_LEFT = (1e-7, 2e-3)  # relative residual of an equation: rounding, entries of four digits
_SINGULAR = 1e-6  # smallest eigenvalue of a mass matrix with ones on its diagonal


def coupled_inverse(K: Array, C: Array, B: Array, without: int) -> Inertia | None:
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
    found, tolerance = _inverses(K, C, B)
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


def _inverses(K: Array, C: Array, B: Array) -> tuple[list[Inertia], float]:
    """Return possible inverse mass matrices, and the tolerance they need.

    Each has the coordinate and the column of an input, or -1 where there is none.
    """
    # basis of the symmetric matrices W
    n = len(K)
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
    return found, tolerance


def _candidates(open_: Array, B: Array, tolerance: float) -> list[Inertia]:
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
    return right[rank:].T


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

    def large(X: Array, across: Array | float) -> Mask:
        X = np.abs(X) / size[:, None] / across
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
    return W


_ASYMMETRY = 0.05  # misfit of log mass ratios up to which one set of masses explains them


def find_masses(found: Incidence) -> MassScale:
    """Return the masses that make the couplings in A symmetric.

    An input scales them if it determines a mass.
    """
    linear, n = found.linear, found.linear.n_states
    # masses of each connected group up to a common factor
    logs, linked = _solve(n, _ratios(found))
    base = np.zeros(linear.n_inputs)
    if found.moving:  # base excitation: -1 on every velocity state and 0 elsewhere
        pattern = row_of(n, dict.fromkeys(found.moving, -1.0))[:, None]
        base = np.isclose(linear.B, pattern, rtol=0, atol=1e-9).all(axis=0).astype(float)
    # factor: a declared mass, or an input that drives one velocity alone
    declared = {
        found.velocity.get(i, i): (found.declared.masses[label], -1, "what was declared")
        for i, label in enumerate(linear.state_labels)
        if label in found.declared.masses
    }
    masses, origin = _scale_groups(found, logs, linked, _anchors(found, base) | declared)
    scale = MassScale(np.diag(1.0 / masses), origin, linked, base)
    # coordinates may share inertia (cart and pendulum)
    if all(item.absolute and not declared.keys() & item.ends.keys() for item in found.physical):
        _share_inertia(found, scale)
    return scale


def _scale_groups(found: Incidence, logs: Array, linked: Mask, anchors: Anchors) -> tuple[Array, list[str]]:
    """Return the masses and their origin in words.

    The first anchor of each group of linked masses is its scale; without one it is a mass of one.
    """
    labels, anchored = found.linear.state_labels, anchors.keys() & {*found.moving, *found.stores}
    mass, origin = np.ones(len(labels)), [f"forces are per unit mass of {label}" for label in labels]
    for members in connected(linked):
        known = [state for state in members if state in anchored]
        anchor = min(known, key=lambda state: anchors[state][1]) if known else members[0]
        size, _, source = anchors[anchor] if known else (1.0, -1, "")
        for state in members:
            mass[state] = size * np.exp(logs[state] - logs[anchor])
            origin[state] = f"forces are per unit mass of {labels[anchor]}"
            if known:
                origin[state] = f"mass {mass[state]:.4g} from {source}"
                origin[state] += " and the symmetry of A" if state != anchor else ""
    return mass, origin


def _share_inertia(found: Incidence, masses: MassScale) -> None:
    """Enter a coupled mass matrix where separate masses do not suffice.

    Separate masses do not suffice if they leave couplings one-sided.
    """
    linear, A, (q, v, scale) = found.linear, found.A, found.bodies
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
    count += (
        int(np.count_nonzero(significant(linear.B, found.tolerance)[v])) + len(v) - len(connected(linked))
    )
    # else an inverse mass matrix with couplings
    inertia = coupled_inverse(K, C, linear.B[v], count)
    if inertia is None:
        return
    W, i, j = inertia
    masses.inverse[np.ix_(v, v)] = W
    masses.linked[np.ix_(v, v)] = True
    words = "masses from "
    if i >= 0:
        words += f"the input {linear.input_labels[j]} and "
    words += "the symmetry of stiffness and damping, which share inertia"
    for k in v:
        masses.origin[k] = words if i >= 0 else f"{words}; forces are relative to {linear.state_labels[v[0]]}"


def _ratios(found: Incidence) -> dict[tuple[int, int], float]:
    """Return log(m_j / m_i) of states coupled in both directions.

    They are velocities, or stores: capacities make an exchange symmetric, as masses do.
    """
    A, (q, v, scale) = found.linear.A, found.bodies
    ratios: dict[tuple[int, int], float] = {}

    def enter(one: int, two: int, ratio: float) -> None:
        ratios.setdefault((min(one, two), max(one, two)), float(np.log(ratio)) * (1.0 if one < two else -1.0))

    K, C = A[np.ix_(v, q)], A[np.ix_(v, v)]
    # couplings that count, relative to the row
    sprung = np.abs(K) > found.tolerance * np.abs(K).max(axis=1, keepdims=True, initial=0.0)
    for i, j in combinations(range(len(v)), 2):
        if sprung[i, j] != sprung[j, i]:
            continue  # one-way coupling is not a link
        # without a spring the damper gives the ratio
        forth, back = (K[i, j] * scale[j], K[j, i] * scale[i]) if sprung[i, j] else (C[i, j], C[j, i])
        # A_ij / A_ji = m_j / m_i
        if forth * back > 0:
            enter(v[i], v[j], forth / back)
    for item in found.physical:
        if not item.absolute and len(item.ends) == 2:
            # elongation as a state: ratio of the reactions at both ends
            one, two = item.ends
            enter(one, two, item.ends[two] * A[one, item.state] / A[two, item.state])
    # stores that exchange something in both directions
    for i, j in found.exchange:
        if A[i, j] > 0:
            ratios[i, j] = float(np.log(A[i, j] / A[j, i]))
    return ratios


def _solve(n: int, ratios: dict[tuple[int, int], float]) -> tuple[Array, Mask]:
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


def _anchors(found: Incidence, base: Array) -> Anchors:
    """Return mass 1/|B|, input and source of states with their own input.

    Exactly one input drives such a state, and that input drives no other state.
    """
    linear, driven = found.linear, found.driven
    # one input, one velocity: 1/m is the entry of B
    own = (driven.sum(axis=1) == 1)[:, None] & (driven.sum(axis=0) == 1) & (base == 0) & driven
    return {
        i: (float(1.0 / abs(linear.B[i, j])), j, f"the input {linear.input_labels[j]}")
        for i, j in np.argwhere(own).tolist()
    }
