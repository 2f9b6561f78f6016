"""Ports of the links between displacements: found, and declared."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from ..systems.linear import Array, LinearModel
from .bodies import ROUNDING, Groups, between_bodies, connected, couplings, parallel, strengths, unit
from .displacements import Displacement, significant
from .masses import MassScale
from .ports import Port

__all__ = ["Declared", "Link", "factors", "find_links", "row_of", "weighted"]


def factors(K: Array, C: Array, alike: NDArray[np.bool_]) -> tuple[list[Array], Groups]:
    """Return the directions g of the links in a stiffness or damping matrix.

    The matrix is K = sum of k g g' + (springs to the ground).

    Parameters
    ----------
    K : ndarray, shape (n, n)
        Symmetric, stiffness or damping.
    C : ndarray, shape (n, n)
        The other one of the same structure; it decides where K alone leaves two factors open.
    alike : ndarray of bool, shape (n, n)
        Whether two displacements have, as far as is known, the same unit and sense.

    Returns
    -------
    directions : list of ndarray, shape (n,)
        One per link.
    open_ : list of list of int
        Displacements whose coupling to each other or to the ground has more than one factorization.

    Notes
    -----
    A sum of terms on two displacements each exists if and only if the comparison matrix M (diagonal
    of K, minus the sizes of the rest) is positive semidefinite [1]_. Differences x_i - x_j are one such
    sum where the rows of M have no negative sum. Where M is singular, the sum is unique: M x = 0 gives
    d = q_i / x_i - q_j / x_j. Otherwise displacements move together as bodies (the
    two of a node, heave and pitch), between which the coupling has rank one.

    References
    ----------
    .. [1] E. G. Boman, D. Chen, O. Parekh, S. Toledo, "On factor width and symmetric H-matrices",
       Linear Algebra and its Applications 405 (2005), 239-248.
    """
    n = len(K)
    found: list[Array] = []
    open_: Groups = []
    for group in connected(couplings(K)):
        if len(group) < 2:
            continue
        part = np.ix_(group, group)
        own = _differences(K[part], alike[part])
        if own is None:
            own = _ratios(K[part])
        lost: Groups = []
        if own is None:
            own, lost = between_bodies(K[part], C[part], alike[part])
        for g in own:
            full = np.zeros(n)
            full[group] = g
            found.append(full)
        open_ += [[group[i] for i in body] for body in lost]
    return found, open_


def _pairs(K: Array, sizes: Array) -> list[Array]:
    """A link for each coupled pair, d = q_i / size_i -+ q_j / size_j."""
    found = []
    for i, j in np.argwhere(np.triu(couplings(K))):
        g = np.zeros(len(K))
        g[i], g[j] = 1.0 / sizes[i], np.sign(K[i, j]) / sizes[j]
        found.append(unit(g))
    return found


def _comparison(K: Array) -> Array:
    return np.asarray(2.0 * np.diag(np.diag(K)) - np.abs(K))


def _differences(K: Array, alike: NDArray[np.bool_]) -> list[Array] | None:
    """Return x_i - x_j for each coupling, or None.

    None means that springs to the ground do not explain the rest of K.
    """
    coupled = couplings(K)
    if not alike[coupled].all():
        return None
    size = np.abs(np.diag(K))
    left = _comparison(K).sum(axis=1)
    unstable = bool(np.linalg.eigvalsh(K)[0] < -ROUNDING * size.max())  # gravity takes from the diagonal
    if (K[coupled] < 0).all() and (unstable or (left >= -ROUNDING * size).all()):
        return _pairs(K, np.ones(len(K)))
    # a displacement may be counted the other way; two alone may as well be heave and pitch
    balanced = len(K) > 2 and bool((left >= -ROUNDING * size).all()) and _balanced(K)
    return _pairs(K, np.ones(len(K))) if balanced else None


def _balanced(K: Array) -> bool:
    """Return whether sign changes can make all couplings negative.

    A sign change reverses the sense of a displacement.
    """
    sign, front = {0: 1.0}, [0]
    while front:
        i = front.pop()
        for j in np.flatnonzero(couplings(K)[i]):
            wanted = -sign[i] * float(np.sign(K[i, j]))
            if j not in sign:
                sign[int(j)] = wanted
                front.append(int(j))
            elif sign[int(j)] != wanted:
                return False
    return True


def _ratios(K: Array) -> list[Array] | None:
    """Return the links whose ratios leave no springs to the ground, or None."""
    size = np.diag(K)
    if (size <= 0).any():
        return None
    scale = 1.0 / np.sqrt(size)
    values, vectors = np.linalg.eigh(_comparison(K) * np.outer(scale, scale))
    if abs(values[0]) > ROUNDING or (len(K) > 2 and values[1] < 10 * ROUNDING):
        return None
    return _pairs(K, np.abs(vectors[:, 0]) * scale)


_ANGLES = frozenset("th theta phi psi alpha beta gamma pitch roll yaw angle rotation".split())
_SMALL = 1e-12
_UNEXPLAINED = 0.01  # of a damping coupling: more than rounding leaves of what the springs' links explain


@dataclass(frozen=True, slots=True)
class Declared:
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

    links: Mapping[str, Mapping[str, float]] = field(default_factory=dict)
    units: Mapping[str, str] = field(default_factory=dict)
    masses: Mapping[str, float] = field(default_factory=dict)


@dataclass(frozen=True, slots=True, eq=False)
class Link:
    """A port between displacements, with its spring and damper."""

    port: Port
    stiffness: float
    damping: float


def find_links(
    linear: LinearModel,
    displacements: Sequence[Displacement],
    masses: MassScale,
    tolerance: float,
    declared: Declared,
) -> tuple[list[Link], dict[Displacement, str]]:
    """Find the links in the stiffness and damping matrices.

    The second value describes the displacements whose links stay open.
    """
    absolute = [item for item in displacements if item.absolute and item.moving is not None]
    v = [item.moving for item in absolute if item.moving is not None]
    q, scale = [item.state for item in absolute], np.array([item.scale for item in absolute])
    n, A = len(absolute), significant(linear.A, tolerance)
    linked = np.array([[i == j or masses.linked(i, j) for j in v] for i in v], dtype=bool).reshape(n, n)
    heft = np.sqrt(np.outer(masses.mass[v], masses.mass[v]))

    def force(X: Array) -> Array:  # the symmetric part, where masses make it symmetric
        X = np.asarray(-np.linalg.solve(masses.inverse[np.ix_(v, v)], X), dtype=np.float64)
        if masses.shared:  # what is no larger than the asymmetry is rounding, too
            rounding = ((2.0 * np.abs(X - X.T) + _SMALL * np.abs(X)) / heft).max()
            X[np.abs(X) <= rounding * heft] = 0.0
        return np.where(linked, 0.5 * (X + X.T), 0.0)

    K, C = force(A[np.ix_(v, q)] * scale), force(A[np.ix_(v, v)])
    labels = [linear.state_labels[i] for i in q]
    alike = _alike(labels, [declared.units.get(label, "") for label in labels])
    given = {
        name: np.array([weights.get(label, 0.0) for label in labels]) * scale
        for name, weights in declared.links.items()
        if set(weights) <= set(labels)
    }
    directions, open_ = _directions(K, C, alike, list(given.values()))
    springs, dampers = strengths(K, directions, open_), strengths(C, directions, open_)
    links = []
    for g, k, c in zip(directions, springs, dampers, strict=True):
        name = next((name for name, own in given.items() if own is g), "")
        whole = int(np.argmin(np.abs(np.abs(g / scale if name else g) - 1.0)))
        size = float(scale[whole])  # unit of the displacement that counts whole
        if name:
            g, k, c = g / size, size**2 * k, size**2 * c
        port = _link_port(linear, absolute, g, masses, size, name)
        links.append(Link(port, float(k) / size, float(c) / size))
    return links, _open_words(linear, absolute, open_)


def _directions(
    K: Array, C: Array, alike: NDArray[np.bool_], given: Sequence[Array]
) -> tuple[list[Array], Groups]:
    """Return the directions of all links, and the bodies that stay open.

    Links are declared, or found in the rest of stiffness and damping.
    """
    found, open_ = factors(K, C, alike)
    new = [g for g in given if not any(parallel(g, other) for other in found)]
    # a found link inside the ends of a declared one is another reading of the same coupling
    found = [g for g in found if not any(set(np.flatnonzero(g)) <= set(np.flatnonzero(h)) for h in given)]
    found += given
    open_ = [body for body in open_ if not any(set(np.flatnonzero(g)) & set(body) for g in new)]
    for X, Y, share in ((K, C, _UNEXPLAINED if new else 1.0), (C, K, _UNEXPLAINED)):
        parts = zip(strengths(X, found, open_), found, strict=True)
        rest = X - sum((k * np.outer(g, g) for k, g in parts), 0.0 * X)
        rest[~np.eye(len(X), dtype=bool) & (np.abs(rest) <= share * np.abs(X))] = 0.0
        for body in open_:
            rest[np.ix_(body, body)] *= np.eye(len(body))
        more, also = factors(rest, Y, alike)
        found += [g for g in more if not any(parallel(g, other) for other in found)]
        open_ = [*open_, *also]
    return sorted(found, key=lambda g: np.flatnonzero(g).tolist()), open_


def _alike(labels: Sequence[str], units: Sequence[str]) -> NDArray[np.bool_]:
    """Return for each pair of displacements whether the units are the same.

    Declared units decide. Otherwise the names distinguish angles from lengths.
    """

    def angle(label: str) -> bool:
        return re.split(r"[^a-z]", label.lower())[0] in _ANGLES

    pairs = list(zip(labels, units, strict=True))
    return np.array(
        [[a == b if a and b else angle(x) == angle(y) for y, b in pairs] for x, a in pairs], dtype=bool
    ).reshape(len(pairs), len(pairs))


def _open_words(
    linear: LinearModel, absolute: Sequence[Displacement], open_: Groups
) -> dict[Displacement, str]:
    """Describe what is unknown about the links of some displacements."""
    found = {}
    for body in open_:
        names = ", ".join(linear.state_labels[absolute[i].state] for i in body)
        words = (
            f"the couplings of {names} to each other and to the ground are links in more than one way: "
            "declare them by physical(system, links=...)"
        )
        found.update({absolute[i]: words for i in body})
    return found


def row_of(size: int, entries: Mapping[int, float]) -> Array:
    """Row of zeros but for the given entries."""
    row = np.zeros(size)
    for index, value in entries.items():
        row[index] = value
    return row


def _link_port(
    linear: LinearModel,
    absolute: Sequence[Displacement],
    g: Array,
    masses: MassScale,
    unit: float = 1.0,
    name: str = "",
) -> Port:
    """Port of a link.

    Parameters
    ----------
    linear : LinearModel
        Continuous-time model.
    absolute : sequence of Displacement
        Displacements of masses.
    g : ndarray, shape (number of displacements,)
        Direction: how much of each displacement, brought to one unit, is in d.
    masses : MassScale
        Masses of the velocity states.
    unit : float, optional
        That unit, as displacement over the integral of a velocity.
    name : str, optional
        Name, by default the sum in words.

    Returns
    -------
    Port
    """
    n, labels = linear.n_states, linear.state_labels
    ends = [
        (item, item.moving, float(g[i]))
        for i, item in enumerate(absolute)
        if g[i] and item.moving is not None
    ]
    v = [moving for _, moving, _ in ends]
    nothing = np.zeros(linear.n_inputs)
    what = weighted({labels[item.state]: size for item, _, size in ends})
    sources = "; ".join(dict.fromkeys(masses.origin[j] for j in v))
    two = len(v) == 2
    ratio = f"mass ratio {masses.mass[v[1]] / masses.mass[v[0]]:.4g} from the symmetry of A; " if two else ""
    where = " and ".join(labels[item.state] for item, *_ in ends)
    return Port(
        name or what,
        "mechanical",
        act=-masses.inverse @ row_of(n, {j: size for _, j, size in ends}),
        position=row_of(n, {item.state: unit * size / item.scale for item, _, size in ends}),
        position_input=nothing,
        velocity=row_of(n, {j: unit * size for _, j, size in ends}),
        description=f"{'between' if len(v) > 1 else 'at'} {where}, d = {what}; {ratio}{sources}",
    )


def weighted(terms: Mapping[str, float]) -> str:
    """A sum in words: ``"0.2*th1-th2"``."""
    text = ""
    for label, size in terms.items():
        factor = "" if abs(abs(size) - 1.0) < 1e-3 else f"{abs(size):.3g}*"
        text += f"{'-' if size < 0 else '+' if text else ''}{factor}{label}"
    return text
