"""Displacements that move together as bodies, and the links between them."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from ..systems.linear import Array

__all__ = ["ROUNDING", "Groups", "between_bodies", "connected", "couplings", "parallel", "strengths", "unit"]

ROUNDING = 1e-3  # of the diagonal: what rounding to four digits leaves of a zero
_MOST_GROUPED = 7  # displacements whose every grouping into bodies is tried
_MOST_MERGED = 6  # pairs that may be one body, all choices of which are tried

Groups = list[list[int]]


def strengths(K: Array, directions: Sequence[Array], bodies: Sequence[Sequence[int]] = ()) -> Array:
    """Coefficients k of K = sum of k g g' + diagonal.

    Parameters
    ----------
    K : ndarray, shape (n, n)
        Stiffness or damping.
    directions : sequence of ndarray, shape (n,)
        Directions g.
    bodies : sequence of sequence of int
        Displacements between which other links act as well: these couplings tell nothing.

    Returns
    -------
    ndarray, shape (number of directions,)
    """
    if not len(directions):
        return np.zeros(0)
    G = np.array(directions)
    size = np.sqrt(np.abs(np.diag(K)))
    size[size == 0] = 1.0
    seen = ~np.eye(len(K), dtype=bool)
    for body in bodies:
        seen[np.ix_(body, body)] = False
    rows, columns = np.nonzero(np.triu(seen))
    weight = 1.0 / (size[rows] * size[columns])
    outer, target = (weight * G[:, rows] * G[:, columns]).T, weight * K[rows, columns]
    known = outer / (np.linalg.norm(outer, axis=0) + 1e-300)
    values, vectors = np.linalg.eigh(known.T @ known)
    mixed = np.abs(vectors[:, values < 1e-9]).max(axis=1, initial=0.0) > 1e-6
    if mixed.any():  # two to the ground at one body: what is left on its diagonal is theirs
        corner = np.flatnonzero(G[mixed].any(axis=0))
        outer = np.vstack([outer, (G[:, corner] ** 2 / size[corner] ** 2).T])
        target = np.append(target, K[corner, corner] / size[corner] ** 2)
    k = np.asarray(np.linalg.lstsq(outer, target, rcond=1e-9)[0])
    return np.where(np.abs(k) > 1e-7 * np.abs(k).max(initial=0.0), k, 0.0)


def couplings(K: Array) -> NDArray[np.bool_]:
    """Which displacements are coupled."""
    size = np.sqrt(np.abs(np.diag(K)))
    coupled = np.abs(K) > 1e-9 * np.outer(size, size)
    np.fill_diagonal(coupled, False)
    return coupled


def connected(linked: NDArray[np.bool_]) -> Groups:
    """Connected components, each in ascending order."""
    left, groups = set(range(len(linked))), []
    while left:
        group, front = set(), {min(left)}
        while front:
            group |= front
            front = {int(j) for i in front for j in np.flatnonzero(linked[i])} - group
        left -= group
        groups.append(sorted(group))
    return groups


def unit(g: Array) -> Array:
    """Scale a direction so that one component has size one.

    That component has a size that occurs twice, if there is one. Otherwise it is the largest component.
    """
    g = np.where(np.abs(g) > ROUNDING * np.abs(g).max(), g, 0.0)
    size = np.abs(g)
    entries = np.flatnonzero(size > 1e-9 * size.max())
    twice = [size[i] for i, j in combinations(entries, 2) if abs(size[i] / size[j] - 1.0) < ROUNDING]
    scaled = g / (max(twice) if twice else size.max()) * np.sign(g[entries[0]])
    return np.asarray(np.where(np.abs(np.abs(scaled) - 1.0) < ROUNDING, np.sign(scaled), scaled))


def between_bodies(K: Array, C: Array, alike: NDArray[np.bool_]) -> tuple[list[Array], Groups]:
    """Return the links between bodies and to the ground, and open bodies.

    Of all groupings of the displacements into bodies, the one that needs the fewest links is used.
    """
    best: list[tuple[int, list[Array], Groups]] = []
    for groups in _groupings(K):
        found = _between(K, C, groups, alike)
        if found is not None and (not best or found[0] <= best[0][0]):
            best = [found, *(old for old in best if old[0] == found[0])]
    if not best or (len(best) > 1 and not all(_same(best[0][1], other[1]) for other in best[1:])):
        return [], [list(range(len(K)))]
    return best[0][1], best[0][2]


def _same(one: Sequence[Array], two: Sequence[Array]) -> bool:
    return len(one) == len(two) and all(any(parallel(g, h, ROUNDING) for h in two) for g in one)


def parallel(g: Array, h: Array, tolerance: float = 1e-6) -> bool:
    """Return whether two directions are parallel."""
    return bool(abs(g @ h) >= (1.0 - tolerance) * np.linalg.norm(g) * np.linalg.norm(h))


def _groupings(K: Array) -> Iterator[Groups]:
    """Ways to put displacements together as bodies."""
    n = len(K)
    if n <= _MOST_GROUPED:
        yield from _partitions(list(range(n)))
        return
    coupled = couplings(K)
    joined = np.zeros((n, n), dtype=bool)
    pairs = list(combinations(range(n), 2))
    for a, b in pairs:
        # a bar between nodes (a, b) and (c, d): four couplings, of rank one
        both = np.flatnonzero(coupled[a] & coupled[b])
        ratio = K[a, both] / K[b, both]
        same = np.abs(1.0 - ratio[:, None] / ratio) <= ROUNDING
        np.fill_diagonal(same, False)
        joined[np.ix_(both, both)] |= same
        joined[a, b] |= same.any()
        joined[b, a] |= same.any()
    single = {group[0] for group in connected(joined) if len(group) == 1}
    maybe = [(a, b) for a, b in pairs if a in single and b in single and coupled[a, b]][:_MOST_MERGED]
    for count in range(len(maybe) + 1):
        for chosen in combinations(maybe, count):
            more = joined.copy()
            for a, b in chosen:
                more[a, b] = more[b, a] = True
            yield connected(more)


def _partitions(items: list[int]) -> Iterator[Groups]:
    if not items:
        yield []
        return
    for rest in _partitions(items[1:]):
        yield [[items[0]], *rest]
        for k, group in enumerate(rest):
            yield [*rest[:k], [items[0], *group], *rest[k + 1 :]]


def _between(
    K: Array, C: Array, groups: Groups, alike: NDArray[np.bool_]
) -> tuple[int, list[Array], Groups] | None:
    """Return cost, links and open bodies of one grouping, or None.

    None means that the grouping does not explain K.
    """
    ends: list[tuple[int, int, Array, Array, float]] = []
    for a, b in combinations(range(len(groups)), 2):
        block = K[np.ix_(groups[a], groups[b])]
        if not block.any():
            continue
        U, s, V = np.linalg.svd(block)
        if s.size > 1 and s[1] > ROUNDING * s[0]:
            return None
        ends.append((a, b, U[:, 0], V[0], float(s[0])))
    share = _shares(K, groups, ends, alike)
    if share is None:
        return None
    links, left = [], {a: K[np.ix_(group, group)].copy() for a, group in enumerate(groups)}
    for (a, b, u, w, k), t in zip(ends, share, strict=True):
        g = np.zeros(len(K))
        g[groups[a]], g[groups[b]] = np.sqrt(t) * u, w / np.sqrt(t)
        links.append(_normed(g, groups[a], groups[b]))
        left[a] -= k * t * np.outer(u, u)
        left[b] -= k / t * np.outer(w, w)
    price = len(links)
    open_: Groups = []
    damped = strengths(C, links, groups)
    rest = C - sum((c * np.outer(g, g) for c, g in zip(damped, links, strict=True)), 0.0 * C)
    for a, group in enumerate(groups):
        size = np.abs(K[group, group]).max()
        part = np.ix_(group, group)
        own = _to_ground(left[a], rest[part], size, paired=len(K) > 2 or not alike[part].all())
        if own is None:
            return None
        price += own[0]
        open_ += [group] if own[2] else []
        for direction in own[1]:
            g = np.zeros(len(K))
            g[group] = direction
            if np.count_nonzero(np.abs(g) > ROUNDING * np.abs(g).max()) > 1:  # else its own displacement
                links.append(_normed(g, group, group) if len(groups) > 1 and alike[part].all() else unit(g))
    return price, links, open_


def _normed(g: Array, one: Sequence[int], two: Sequence[int]) -> Array:
    """Scale both ends of a link to length one if they are equally long.

    A bar is an example. Otherwise the direction is scaled by `unit`.
    """
    g = np.where(np.abs(g) > ROUNDING * np.abs(g).max(), g, 0.0)
    length = float(np.linalg.norm(g[one]))
    if len(one) == len(two) and abs(np.linalg.norm(g[two]) / length - 1.0) < ROUNDING:
        return np.asarray(g / length * np.sign(g[np.flatnonzero(g)[0]]))
    return unit(g)


def _shares(
    K: Array,
    groups: Groups,
    ends: Sequence[tuple[int, int, Array, Array, float]],
    alike: NDArray[np.bool_],
) -> list[float] | None:
    """Return the squared length ratio of the two ends of each link.

    Bodies with equally many displacements of the same unit are linked by differences: their ratio is one.
    Otherwise the couplings inside the larger body determine the ratio.
    """
    share: list[float | None] = [
        1.0 if len(groups[a]) == len(groups[b]) and alike[groups[a][0], groups[b][0]] else None
        for a, b, *_ in ends
    ]
    for a, group in enumerate(groups):
        mine = [
            e
            for e, end in enumerate(ends)
            if share[e] is None
            and a in end[:2]
            and len(group) >= len(groups[end[1] if end[0] == a else end[0]])
        ]
        if not mine:
            continue
        rest = K[np.ix_(group, group)].copy()
        for e, (one, two, u, w, s) in enumerate(ends):
            known = share[e]
            if known is not None and a in (one, two):
                rest -= s * (known * np.outer(u, u) if a == one else np.outer(w, w) / known)
        vectors = [ends[e][2] if ends[e][0] == a else ends[e][3] for e in mine]
        columns = [ends[e][4] * np.outer(v, v) for e, v in zip(mine, vectors, strict=True)]
        outer = np.array([column.ravel() for column in columns]).T
        if len(mine) >= len(group) * (len(group) + 1) // 2 or np.linalg.matrix_rank(outer, 1e-6) < len(mine):
            return None  # nothing that could refute it
        parts = np.linalg.lstsq(outer, rest.ravel(), rcond=None)[0]
        if (parts <= 0).any() or np.abs(outer @ parts - rest.ravel()).max() > ROUNDING * np.abs(
            K[group, group]
        ).max():
            return None
        for e, t in zip(mine, parts, strict=True):
            share[e] = float(t if ends[e][0] == a else 1.0 / t)
    return None if any(t is None for t in share) else [t for t in share if t is not None]


def _to_ground(K: Array, C: Array, size: float, *, paired: bool) -> tuple[int, list[Array], bool] | None:
    """Return cost, directions to the ground, and whether they stay open.

    The result is None if springs cannot produce K.
    """
    values, vectors = np.linalg.eigh(K)
    if values[0] < -ROUNDING * size:
        return None
    rank = int(np.sum(values > ROUNDING * size))
    if np.abs(K - np.diag(np.diag(K))).max() <= 2 * ROUNDING * size:
        return rank, [], False
    if rank == 1:
        return 1, [vectors[:, -1]], False
    if rank == 2 and len(K) == 2 and paired and np.abs(C).max() > 0:
        # two springs with dampers beside them: the vectors that make both diagonal
        ratios, modes = np.linalg.eig(np.linalg.solve(K, C))
        if np.isreal(ratios).all() and np.ptp(ratios.real) > 0.05 * np.abs(ratios).max():
            return 2, list(np.linalg.inv(modes.real)), False
    return rank * (rank + 1) // 2 + 1, [], True
