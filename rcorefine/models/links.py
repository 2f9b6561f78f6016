"""Links between displacements, and bodies that move together."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from itertools import combinations
from typing import NamedTuple

import numpy as np

from ..systems.linear import Array
from .incidence import Incidence, Mask, connected
from .ports import Element, port_at

_ROUNDING = 1e-3  # share of the diagonal that is rounding in entries of four digits
_MOST_GROUPED = 7  # most displacements for which all groupings into bodies are tried
_MOST_MERGED = 6  # most pairs of displacements that may be one body
_ANGLES = frozenset("th theta phi psi alpha beta gamma pitch roll yaw angle rotation".split())
_SMALL = 1e-12
_UNEXPLAINED = 0.01  # share of a damping coupling that links of springs must leave to count

Groups = list[list[int]]
Found = tuple[list[Array], Groups]  # directions of links, and bodies that stay open

#: What is said of places whose links stay open.
OPEN = "are links in more than one way: declare them by physical(system, links=...)"


def find_links(found: Incidence) -> tuple[list[Element], dict[int, str]]:
    """Find the links in the stiffness and damping matrices.

    The second value describes, by their state, the displacements whose links stay open.
    """
    q, v, scale = found.bodies
    labels = [found.linear.state_labels[i] for i in q]
    K, C = _forces(found)
    # declared links as directions
    given = {
        name: np.array([weights.get(label, 0.0) for label in labels]) * scale
        for name, weights in found.declared.links.items()
        if set(weights) <= set(labels)
    }
    # directions of the links, then their springs and dampers
    alike = _same_units(labels, found.declared.units)
    # damping of the modes (Rayleigh's): K M^-1 C is symmetric; it does not tell where the springs are
    product = K @ found.masses.inverse[np.ix_(v, v)] @ C
    tells = bool(np.linalg.norm(product - product.T) > _ROUNDING * np.linalg.norm(product))
    directions, open_ = _directions(K, C, alike, list(given.values()), tells)
    springs, dampers = strengths(K, directions, open_), strengths(C, directions, open_)
    words = "the couplings of {} to each other and to the ground " + OPEN
    said = {tuple(body): [words.format(", ".join(labels[j] for j in body))] for body in open_}
    links = []
    for g, k, c in zip(directions, springs, dampers, strict=True):
        name = next((name for name, own in given.items() if own is g), "")
        links.append(_link(found, labels, name, g, k, c, said.get(tuple(np.flatnonzero(g)), [])))
    return links, {q[i]: text for body, (text,) in said.items() for i in body}


def _forces(found: Incidence) -> list[Array]:
    """Return the stiffness and the damping matrix of linked masses.

    They are accelerations times masses, symmetric by action and reaction.
    """
    (q, v, scale), A, masses = found.bodies, found.A, found.masses
    own = np.ix_(v, v)
    linked = masses.linked[own] | np.eye(len(v), dtype=bool)
    # scale of each pair, the geometric mean of both masses
    heft = np.sqrt(np.outer(masses.mass[v], masses.mass[v]))
    forces = []
    for accelerations in (A[np.ix_(v, q)] * scale, A[own]):
        X = -np.linalg.solve(masses.inverse[own], accelerations)
        if masses.shared:  # entries smaller than the asymmetry are rounding
            rounding = ((2.0 * np.abs(X - X.T) + _SMALL * np.abs(X)) / heft).max()
            X[np.abs(X) <= rounding * heft] = 0.0
        # symmetric part within linked pairs
        forces.append(np.where(linked, 0.5 * (X + X.T), 0.0))
    return forces


def _link(
    found: Incidence, labels: Sequence[str], name: str, g: Array, k: float, c: float, still: Sequence[str]
) -> Element:
    """Return a link of this direction as a port with spring and damper.

    It is in the unit of the displacement with weight one. Declared links have a name; `still` says what
    stays open.
    """
    masses, (q, v, scale) = found.masses, found.bodies
    size = float(scale[np.argmin(np.abs(np.abs(g / scale if name else g) - 1.0))])
    if name:
        g, k, c = g / size, size**2 * k, size**2 * c
    ends = np.flatnonzero(g).tolist()
    what = weighted({labels[i]: float(g[i]) for i in ends})
    joined = " and ".join(labels[i] for i in ends)
    words = [f"{'between' if len(ends) > 1 else 'at'} {joined}, d = {what}"]
    # A_ij / A_ji is the ratio of the masses
    if len(ends) == 2:
        one, two = masses.mass[[v[i] for i in ends]]
        words.append(f"mass ratio {two / one:.4g} from the symmetry of A")
    port = port_at(
        found.linear,
        name or what,
        "; ".join([*words, *dict.fromkeys(masses.origin[v[i]] for i in ends), *still]),
        masses.act({v[i]: g[i] for i in ends}),
        {v[i]: size * g[i] for i in ends},
        {q[i]: size * g[i] / scale[i] for i in ends},
    )
    return Element(port, float(k) / size, float(c) / size)


def _directions(K: Array, C: Array, alike: Mask, given: Sequence[Array], tells: bool) -> Found:
    """Return the directions of all links, and the bodies that stay open.

    Links are declared, or found in the rest of stiffness and damping. `tells` is true where one of the
    two decides what the other one leaves open.
    """
    # links in the stiffness matrix, then in what they leave of stiffness and of damping
    found, open_ = factors(K, tells * C, alike)
    new = _others(given, found)
    # a declared link replaces links found between its ends
    found = [g for g in found if not any(set(np.flatnonzero(g)) <= set(np.flatnonzero(h)) for h in given)]
    # declared links come first
    found += given
    open_ = [body for body in open_ if not any(g[body].any() for g in new)]
    for X, Y, share in ((K, C, _UNEXPLAINED if new else 1.0), (C, K, _UNEXPLAINED)):
        more, also = factors(_left_over(X, found, open_, share), tells * Y, alike)
        found += _others(more, found)
        open_ = [*open_, *also]
    return sorted(found, key=lambda g: np.flatnonzero(g).tolist()), open_


def _left_over(X: Array, directions: Sequence[Array], bodies: Groups, share: float) -> Array:
    """Return what the links leave of a matrix, without the open bodies.

    Couplings of which no more than a share is left are explained.
    """
    rest = _subtract(X, directions, bodies)
    rest[~np.eye(len(X), dtype=bool) & (np.abs(rest) <= share * np.abs(X))] = 0.0
    for body in bodies:
        rest[np.ix_(body, body)] *= np.eye(len(body))
    return rest


def _subtract(X: Array, directions: Sequence[Array], bodies: Groups) -> Array:
    """X minus the sum of k g g' over the directions."""
    G = np.reshape(directions, (len(directions), len(X)))
    return X - (G.T * strengths(X, directions, bodies)) @ G


def _same_units(labels: Sequence[str], units: Mapping[str, str]) -> Mask:
    """Return for each pair of displacements whether the units are the same.

    Declared units decide. Otherwise the names distinguish angles from lengths.
    """
    # names of angles: th, phi, pitch, ...
    angle = np.array([re.split(r"[^a-z]", label.lower())[0] in _ANGLES for label in labels], dtype=bool)
    unit = np.array([units.get(label, "") for label in labels], dtype=object)
    known = unit != ""
    both = known[:, None] & known
    return np.asarray(np.where(both, unit[:, None] == unit, angle[:, None] == angle), dtype=bool)


def weighted(terms: Mapping[str, float]) -> str:
    """A sum in words: ``"0.2*th1-th2"``."""
    text = ""
    for label, size in terms.items():
        factor = "" if abs(abs(size) - 1.0) < 1e-3 else f"{abs(size):.3g}*"
        text += f"{'-' if size < 0 else '+' if text else ''}{factor}{label}"
    return text


def factors(K: Array, C: Array, alike: Mask) -> Found:
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
    found: list[Array] = []
    open_: Groups = []
    # each coupled group of displacements by itself
    for group in connected(couplings(K)):
        if len(group) < 2:
            continue
        part = np.ix_(group, group)
        # differences, or differences with ratios; last, bodies of several displacements
        own = _differences(K[part], alike[part]) or _ratios(K[part])
        own, lost = (own, []) if own else between_bodies(K[part], C[part], alike[part])
        found += [np.eye(len(K))[:, group] @ g for g in own]
        open_ += [[group[i] for i in body] for body in lost]
    return found, open_


def _pairs(K: Array, sizes: Array) -> list[Array]:
    """A link for each coupled pair, d = q_i / size_i -+ q_j / size_j."""
    found = []
    for i, j in np.argwhere(np.triu(couplings(K))):
        g = np.zeros(len(K))
        # opposite signs pull the displacements together
        g[i], g[j] = 1.0 / sizes[i], np.sign(K[i, j]) / sizes[j]
        found.append(unit(g))
    return found


def _comparison(K: Array) -> Array:
    return 2.0 * np.diag(np.diag(K)) - np.abs(K)


def _differences(K: Array, alike: Mask) -> list[Array]:
    """Return x_i - x_j for each coupling, or nothing.

    There is nothing if springs to the ground do not explain the rest of K.
    """
    coupled = couplings(K)
    if not alike[coupled].all():
        return []
    # diagonal dominance: springs to the ground are not negative
    size = np.abs(np.diag(K))
    explained = bool((_comparison(K).sum(axis=1) >= -_ROUNDING * size).all())
    if (K[coupled] < 0).all():  # gravity reduces the diagonal
        explained = explained or bool(np.linalg.eigvalsh(K)[0] < -_ROUNDING * size.max())
    else:  # a displacement may have the opposite sense; a single pair may be heave and pitch
        explained = explained and len(K) > 2 and _is_balanced(K)
    return _pairs(K, np.ones(len(K))) if explained else []


def _is_balanced(K: Array) -> bool:
    """Return whether sign changes can make all couplings negative.

    A sign change reverses the sense of a displacement. The signed Laplacian is then singular.
    """
    sign = -np.sign(K) * couplings(K)
    return bool(np.linalg.eigvalsh(np.diag(np.abs(sign).sum(axis=1)) - sign)[0] < 1e-9)


def _ratios(K: Array) -> list[Array]:
    """Return the links whose ratios leave no springs to the ground, if any."""
    size = np.diag(K)
    if (size <= 0).any():
        return []
    # unit diagonal
    scale = 1.0 / np.sqrt(size)
    # M x = 0: the smallest eigenvalue of the comparison matrix is zero and single
    values, vectors = np.linalg.eigh(_comparison(K) * np.outer(scale, scale))
    if abs(values[0]) > _ROUNDING or (len(K) > 2 and values[1] < 10 * _ROUNDING):
        return []
    return _pairs(K, np.abs(vectors[:, 0]) * scale)


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
    # linear equations K_ij = sum of k g_i g_j off the diagonal
    G = np.array(directions)
    size = np.sqrt(np.abs(np.diag(K)))
    size[size == 0] = 1.0
    seen = ~np.eye(len(K), dtype=bool)
    ends = [np.flatnonzero(g).tolist() for g in directions]
    for body in bodies:  # unless oblique springs stand for them
        seen[np.ix_(body, body)] &= body in ends
    rows, columns = np.nonzero(np.triu(seen))
    weight = 1.0 / (size[rows] * size[columns])
    outer, target = (weight * G[:, rows] * G[:, columns]).T, weight * K[rows, columns]
    # directions that the couplings cannot separate
    known = outer / (np.linalg.norm(outer, axis=0) + 1e-300)
    values, vectors = np.linalg.eigh(known.T @ known)
    mixed = np.abs(vectors[:, values < 1e-9]).max(axis=1, initial=0.0) > 1e-6
    if mixed.any():  # several springs to the ground at one body: use its diagonal entries, too
        corner = np.flatnonzero(G[mixed].any(axis=0))
        outer = np.vstack([outer, (G[:, corner] ** 2 / size[corner] ** 2).T])
        target = np.append(target, K[corner, corner] / size[corner] ** 2)
    # least squares
    k = np.linalg.lstsq(outer, target, rcond=1e-9)[0]
    return np.where(np.abs(k) > 1e-7 * np.abs(k).max(initial=0.0), k, 0.0)


def couplings(K: Array) -> Mask:
    """Which displacements are coupled."""
    size = np.sqrt(np.abs(np.diag(K)))
    coupled = np.abs(K) > 1e-9 * np.outer(size, size)
    np.fill_diagonal(coupled, False)
    return coupled


def _round_off(g: Array) -> Array:
    return np.where(np.abs(g) > _ROUNDING * np.abs(g).max(), g, 0.0)


def unit(g: Array) -> Array:
    """Scale a direction so that one component has size one.

    That component has a size that occurs twice, if there is one. Otherwise it is the largest component.
    """
    g = _round_off(g)
    size = np.abs(g)
    entries = np.flatnonzero(size > 1e-9 * size.max())
    # a size that occurs twice is the natural unit of the direction
    twice = [size[i] for i, j in combinations(entries, 2) if abs(size[i] / size[j] - 1.0) < _ROUNDING]
    scaled = g / (max(twice) if twice else size.max()) * np.sign(g[entries[0]])
    return np.asarray(np.where(np.abs(np.abs(scaled) - 1.0) < _ROUNDING, np.sign(scaled), scaled))


def between_bodies(K: Array, C: Array, alike: Mask) -> Found:
    """Return the links between bodies and to the ground, and open bodies.

    Of all groupings of the displacements into bodies, the one that needs the fewest links is used.
    """
    # the grouping with the fewest links; several of the same price must agree
    found = [one for groups in _groupings(K) if (one := _link_bodies(K, C, groups, alike))]
    price = min((one[0] for one in found), default=0)
    best = [one[1:] for one in found if one[0] == price]
    if not best or any(
        len(links) != len(best[0][0]) or _others(links, best[0][0], _ROUNDING) for links, _ in best
    ):
        return [], [list(range(len(K)))]
    return best[0]


def _others(directions: Sequence[Array], known: Sequence[Array], tolerance: float = 1e-6) -> list[Array]:
    """Return the directions that are parallel to no known one."""
    size = np.linalg.norm
    return [
        g for g in directions
        if not any(abs(g @ h) >= (1.0 - tolerance) * size(g) * size(h) for h in known)
    ]  # fmt: skip


def _groupings(K: Array) -> Iterator[Groups]:
    """Ways to put displacements together as bodies."""
    n = len(K)
    if n <= _MOST_GROUPED:
        yield from _partitions(list(range(n)))
        return
    # few displacements: all partitions; many: bodies by proportional rows of K
    coupled = couplings(K)
    pairs = [(a, b) for a, b in combinations(range(n), 2) if coupled[a, b]]
    for tolerance in (_SMALL**0.5, _ROUNDING):  # of exact entries, no ratio is equal by chance
        joined = np.zeros((n, n), dtype=bool)
        for a, b in combinations(range(n), 2):
            # a bar between nodes (a, b) and (c, d): four couplings, of rank one
            both = np.flatnonzero(coupled[a] & coupled[b])
            ratio = K[a, both] / K[b, both]
            joined[np.ix_(both, both)] |= np.abs(1.0 - ratio[:, None] / ratio) <= tolerance
        single = {group[0] for group in connected(joined) if len(group) == 1}
        maybe = [(a, b) for a, b in pairs if {a, b} <= single][:_MOST_MERGED]
        for count in range(len(maybe) + 1):
            for chosen in combinations(maybe, count):
                more = joined.copy()
                for pair in chosen:
                    more[pair] = True
                yield connected(more)


def _partitions(items: list[int]) -> Iterator[Groups]:
    if not items:
        yield []
        return
    for rest in _partitions(items[1:]):
        yield [[items[0]], *rest]
        for k, group in enumerate(rest):
            yield [*rest[:k], [items[0], *group], *rest[k + 1 :]]


class _Coupling(NamedTuple):
    """Coupling of rank one between two bodies, size * outer(u, w)."""

    one: int
    two: int
    u: Array
    w: Array
    size: float

    def block(self, body: int, t: float) -> Array:
        """Stiffness of a body by a link of squared length ratio t of the ends."""
        one = body == self.one
        return self.size * t * np.outer(self.u, self.u) if one else self.size / t * np.outer(self.w, self.w)


def _coupled_bodies(K: Array, groups: Groups) -> list[_Coupling] | None:
    """Return the couplings between bodies, None if one is no single link."""
    found = []
    for a, b in combinations(range(len(groups)), 2):
        block = K[np.ix_(groups[a], groups[b])]
        if not block.any():
            continue
        # between two bodies the coupling has rank one: one link
        U, s, V = np.linalg.svd(block)
        if s.size > 1 and s[1] > _ROUNDING * s[0]:
            return None
        found.append(_Coupling(a, b, U[:, 0], V[0], float(s[0])))
    return found


def _link_bodies(K: Array, C: Array, groups: Groups, alike: Mask) -> tuple[int, list[Array], Groups] | None:
    """Return cost, links and open bodies of one grouping, or None.

    None means that the grouping does not explain K.
    """
    ends = _coupled_bodies(K, groups)
    share = None if ends is None else _shares(K, groups, ends, alike)
    if ends is None or share is None:
        return None
    # subtract the links: the blocks of the bodies are left
    links, left = [], K.copy()
    for end, t in zip(ends, share, strict=True):
        g, (a, b) = np.zeros(len(K)), end[:2]
        g[groups[a]], g[groups[b]] = np.sqrt(t) * end.u, end.w / np.sqrt(t)
        links.append(_scale(g, groups[a], groups[b]))
        left -= end.size * np.outer(g, g)
    price = len(links)
    open_: Groups = []
    # damping that these links do not explain
    rest = _subtract(C, links, groups)
    for group in groups:
        size, part = np.abs(K[group, group]).max(), np.ix_(group, group)
        # springs of each body to the ground
        own = _ground_springs(left[part], rest[part], size, paired=len(K) > 2 or not alike[part].all())
        if own is None:
            return None
        price += own[0]
        open_ += [group] if own[2] else []
        # a single body that stays open has no oblique springs
        joint = len(groups) > 1 and alike[part].all()
        for direction in own[1] if joint or not own[2] else []:
            g = np.eye(len(K))[:, group] @ direction
            # a single displacement has a port of its own
            if np.count_nonzero(_round_off(g)) > 1:
                links.append(_scale(g, group, group) if joint else unit(g))
    return price, links, open_


def _scale(g: Array, one: Sequence[int], two: Sequence[int]) -> Array:
    """Scale both ends of a link to length one if they are equally long.

    A bar is an example. Otherwise the direction is scaled by `unit`.
    """
    g = _round_off(g)
    length = float(np.linalg.norm(g[one]))
    if len(one) == len(two) and abs(np.linalg.norm(g[two]) / length - 1.0) < _ROUNDING:
        return np.asarray(g / length * np.sign(g[np.flatnonzero(g)[0]]))
    return unit(g)


def _shares(K: Array, groups: Groups, ends: Sequence[_Coupling], alike: Mask) -> list[float] | None:
    """Return the squared length ratio of the two ends of each link.

    Bodies with equally many displacements of the same unit are linked by differences: their ratio is one.
    Otherwise the couplings inside the larger body determine the ratio.
    """
    share: dict[int, float] = {}
    for e, end in enumerate(ends):
        one, two = groups[end.one], groups[end.two]
        if len(one) == len(two) and alike[one[0], two[0]]:
            share[e] = 1.0
    for body, group in enumerate(groups):
        more = _body_shares(body, K[np.ix_(group, group)], groups, ends, share)
        if more is None:
            return None
        share |= more
    return [share[e] for e in range(len(ends))] if len(share) == len(ends) else None


def _body_shares(
    body: int, block: Array, groups: Groups, ends: Sequence[_Coupling], share: Mapping[int, float]
) -> dict[int, float] | None:
    """Return the ratios that the block of a body determines.

    The result is None if they do not explain it, or if it has too few entries to test that.
    """
    # links to bodies that are not larger; the other end of one is one + two - body
    mine = [
        e
        for e, end in enumerate(ends)
        if e not in share and body in end[:2] and len(groups[body]) >= len(groups[end.one + end.two - body])
    ]
    if not mine:
        return {}
    # what known links leave of the block
    rest, n = block.copy(), len(block)
    for e in sorted(share):
        if body in ends[e][:2]:
            rest -= ends[e].block(body, share[e])
    outer = np.array([ends[e].block(body, 1.0).ravel() for e in mine]).T
    if len(mine) >= n * (n + 1) // 2 or np.linalg.matrix_rank(outer, 1e-6) < len(mine):
        return None
    # the others by least squares; they must be positive and fit
    parts = np.linalg.lstsq(outer, rest.ravel(), rcond=None)[0]
    misfit = np.abs(outer @ parts - rest.ravel()).max()
    if (parts <= 0).any() or misfit > _ROUNDING * np.abs(np.diag(block)).max():
        return None
    return {e: float(t if ends[e].one == body else 1.0 / t) for e, t in zip(mine, parts, strict=True)}


def _ground_springs(K: Array, C: Array, size: float, *, paired: bool) -> tuple[int, list[Array], bool] | None:
    """Return cost, directions to the ground, and whether they stay open.

    The result is None if springs cannot produce K.
    """
    # stiffness to the ground has no negative eigenvalue
    values, vectors = np.linalg.eigh(K)
    if values[0] < -_ROUNDING * size:
        return None
    # rank: number of springs to the ground
    rank = int(np.sum(values > _ROUNDING * size))
    # diagonal: one spring at each displacement, in no other direction
    if np.abs(K - np.diag(np.diag(K))).max() <= 2 * _ROUNDING * size:
        return rank, [], False
    if rank == 1:
        return 1, [vectors[:, -1]], False
    if rank == 2 and len(K) == 2 and paired and np.abs(C).max() > 0:
        # two springs with parallel dampers: vectors that diagonalize K and C
        ratios, modes = np.linalg.eig(np.linalg.solve(K, C))
        if np.isreal(ratios).all() and np.ptp(ratios.real) > 0.05 * np.abs(ratios).max():
            return 2, list(np.linalg.inv(modes.real)), False
    # several factorizations: high price, the directions stay open. At a joint, three equal springs 60 degrees
    # apart where K is the identity span every change; a member may lose two thirds before one is negative
    oblique = (vectors * np.sqrt(values) @ [[1, 0.5, -0.5], [0, 0.866, 0.866]]).T if len(K) == 2 else ()
    return rank * (rank + 1) // 2 + 1, [*oblique], True
