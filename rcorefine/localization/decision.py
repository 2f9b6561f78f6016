"""Decision on which candidates are needed to explain the record.

Backward elimination with refits comes first, then a search for other explanations.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import product

import numpy as np
from numpy.typing import NDArray
from scipy.stats import norm

from ..inference.covariance import pseudo_inverse, standard_deviations
from ..inference.levels import levels
from ..systems.linear import Array
from .candidates import Candidate
from .estimate import Joint

__all__ = ["Decision", "collinear_groups", "decide", "two_sided"]

_APART = 15.0  # deviates by which a swap would worsen the fit, to first order, above which it is not tried


@dataclass(frozen=True, slots=True, eq=False)
class Decision:
    """Outcome of the elimination.

    Attributes
    ----------
    named : tuple of int
        Candidates that are significant and needed.
    rivals : dict
        For a named candidate those that explain the record about as well in its place.
    joint, joint_std : ndarray, shape (m,)
        Estimates with every candidate free.
    joint_covariance : ndarray, shape (m, m)
        Their covariance.
    change, std : ndarray, shape (m,)
        Estimates of the named ones, and of each other one beside them.
    p_value : ndarray, shape (m,)
        Two-sided, of `change`, not corrected for multiplicity.
    groups : tuple of tuple of int
        Candidates whose sensitivities are nearly collinear.
    other_valley : bool
        Whether more changes, elsewhere, would explain the record as well.
    """

    named: tuple[int, ...]
    rivals: dict[int, tuple[int, ...]]
    joint: Array
    joint_std: Array
    joint_covariance: Array
    change: Array
    std: Array
    p_value: Array
    groups: tuple[tuple[int, ...], ...]
    other_valley: bool


def two_sided(z: Array) -> Array:
    """Two-sided p-value of a normal deviate."""
    return np.asarray(2.0 * norm.sf(np.abs(z)))


def decide(joint: Joint, candidates: list[Candidate], significance: float) -> Decision:
    """Estimate all changes jointly and keep the candidates that are needed.

    Backward elimination with refits is followed by additions and swaps. A candidate is dropped as long as the
    least significant one fails Holm's level ``significance / (m - r + 1)`` (r left of m), so the survivors
    are significant with multiplicity allowed for, and each is needed in addition to the others.

    Parameters
    ----------
    joint : Joint
        Started estimate.
    candidates : list of Candidate
        What may be named.
    significance : float
        Probability of naming anything where nothing has changed.

    Returns
    -------
    Decision
    """
    chosen = _Selection(joint, candidates, significance)
    joint.fit(chosen.active, reweigh=True)
    dense = joint.point.copy()
    chosen.eliminate()
    elsewhere, level = False, joint.problem.cost(joint.point)
    if len(chosen.kept) > 1 and joint.sparser(chosen.active, len(chosen.kept)) is not None:
        # the same response with fewer changes: decide there
        reached = joint.problem.cost(joint.point)
        elsewhere = 2.0 * (level - reached) < levels().rival * 2.0 * reached / joint.problem.n_points
        chosen = _Selection(joint, candidates, significance)
        joint.fit(chosen.active, reweigh=True)
        dense = joint.point.copy()
        chosen.eliminate()
    chosen.take_back()
    joint.fit(chosen.active, reweigh=True)
    rivals = chosen.swap()
    joint.fit(chosen.active, reweigh=True)

    final, everything = joint.point, _Selection(joint, candidates, significance)
    joint.point = dense
    joint.fit(everything.active)
    estimate, spread, covariance = everything.estimates()
    size = np.array([abs(c.nominal) for c in candidates])
    groups = collinear_groups(joint, chosen.where, spread > levels().blurred * size)
    joint.point = final
    joint.fit(chosen.active)

    found = [chosen.estimate(i) if i in chosen.kept else chosen.beside(i) for i in range(len(candidates))]
    change, std = np.array(found).reshape(-1, 2).T
    return Decision(
        tuple(sorted(chosen.kept)),
        {i: tuple(others) for i, others in rivals.items() if others},
        estimate,
        spread,
        covariance,
        change,
        std,
        two_sided(_deviate(change, std, chosen.tolerated)),
        groups,
        elsewhere,
    )


class _Selection:
    """Kept candidates; the others are held at zero.

    To begin with, all candidates are kept.
    """

    def __init__(self, joint: Joint, candidates: list[Candidate], significance: float) -> None:
        self.joint, self.significance = joint, significance
        self.where = np.array([c.column for c in candidates], dtype=np.int64)
        self.floor = np.array([c.floor for c in candidates])
        self.tolerated = np.array([c.tolerated for c in candidates])
        self.active = np.ones(joint.structure.n_parameters, dtype=bool)
        self.kept = list(range(len(candidates)))

    def eliminate(self) -> None:
        """Drop the least significant candidate as long as it fails Holm's level."""
        while self.kept:
            value, std, _ = self.estimates()
            floor = self.floor[self.kept]
            p = two_sided(_deviate(value, std, self.tolerated[self.kept]))
            p = np.where(np.abs(value) < floor, np.maximum(p, 0.5), p)
            # where none is seen on its own, the smallest share goes first
            order = np.lexsort((np.abs(value) / np.maximum(floor, 1e-300), -p))
            weakest = int(order[0])
            if p[weakest] <= self.significance / (self.where.size - len(self.kept) + 1):
                break
            self._hold(self.where[self.kept.pop(weakest)])

    def estimates(self) -> tuple[Array, Array, Array]:
        """Value, standard deviation and covariance of those that are kept."""
        where, columns = self.where[self.kept], self.joint.columns(self.active)
        covariance = self.joint.information().covariance(columns)
        rows = np.array([int(np.flatnonzero(columns == c)[0]) for c in where], dtype=np.int64)
        part = covariance[np.ix_(rows, rows)]
        return self.joint.theta[where], standard_deviations(part), part

    def estimate(self, i: int) -> tuple[float, float]:
        """Value and standard deviation of one that is kept."""
        values, spreads, _ = self.estimates()
        return values[self.kept.index(i)], spreads[self.kept.index(i)]

    def beside(self, i: int) -> tuple[float, float]:
        """Estimate one more candidate in addition to those that are kept.

        The value and its standard deviation come from one Gauss-Newton step.
        """
        wider = self.active.copy()
        wider[self.where[i]] = True
        columns = self.joint.columns(wider)
        row = int(np.flatnonzero(columns == self.where[i])[0])
        information = self.joint.information()
        variance = information.covariance(columns)[row, row]
        if not np.isfinite(variance):
            return 0.0, np.inf
        return float(information.step(columns)[row]), float(np.sqrt(variance))

    def _hold(self, column: int) -> None:
        """Put one candidate back to zero and fit the others."""
        joint, point, plain = self.joint, self.joint.point.copy(), self.joint.point.copy()
        step = -point[column]
        # the others move along first, as their correlation says
        self.active[column] = False
        columns = joint.columns(self.active)
        normal = joint.information().normal
        inverse, _, _ = pseudo_inverse(normal[np.ix_(columns, columns)])
        point[columns] -= inverse @ normal[columns, column] * step
        point[column] = plain[column] = 0.0
        guesses = [joint.problem.inside(guess) for guess in (point, plain)]
        joint.point = min(guesses, key=joint.problem.cost)
        joint.fit(self.active)

    def take_back(self) -> None:
        """Take back what turns out to be significant beside the survivors."""
        for _ in range(self.where.size):
            left = [i for i in range(self.where.size) if i not in self.kept]
            if not left:
                return
            value, std = np.array([self.beside(i) for i in left]).T
            p = two_sided(_deviate(value, std, self.tolerated[left]))
            p = np.where(np.abs(value) < self.floor[left], 1.0, p)
            best = int(np.argmin(p))
            if p[best] > self.significance / len(left):
                return
            self.kept.append(left[best])
            self.active[self.where[left[best]]] = True
            self.joint.fit(self.active)

    def swap(self) -> dict[int, list[int]]:
        """Try each similar candidate in the place of a named one.

        A better candidate replaces the named one. An equally good one is listed as its alternative.
        """
        joint, where, kept = self.joint, self.where, self.kept
        rivals: dict[int, list[int]] = {}
        for _ in range(where.size):
            similar = np.abs(_projected(joint, where))
            value, std, _ = self.estimates()
            apart = dict(zip(kept, np.abs(_deviate(value, std, np.zeros(len(kept)))), strict=True))
            rivals = {i: [] for i in kept}
            level = joint.fit(self.active)
            scale = 2.0 * level / joint.problem.n_points
            reference, better = joint.point.copy(), None
            for i, j in product(kept, range(where.size)):
                if j in kept or apart[i] * np.sqrt(max(1 - similar[i, j] ** 2, 0.0)) > _APART:
                    continue
                cost = self._exchanged(i, j)
                gain = 2.0 * (level - cost) / scale
                if gain > -levels().rival:
                    rivals[i].append(j)
                if gain > 1e-6 and (better is None or gain > better[0]):
                    better = (gain, i, j, joint.point.copy())
                joint.point = reference.copy()
                joint.information()
            joint.point = reference
            joint.fit(self.active)
            if better is None:
                return rivals
            _, i, j, joint.point = better
            self.active[where[i]], self.active[where[j]] = False, True
            kept.remove(i)
            kept.append(j)
        return rivals

    def _exchanged(self, i: int, j: int) -> float:
        """Cost with one candidate in the place of another."""
        joint, (a, b), trial = self.joint, self.where[[i, j]], self.active.copy()
        trial[a], trial[b] = False, True
        normal = joint.information().normal
        ratio = np.sqrt(normal[a, a] / max(normal[b, b], 1e-300))
        point = joint.point.copy()
        point[b], point[a] = point[a] * ratio * np.sign(normal[a, b]), 0.0
        joint.point = point
        return joint.fit(trial)


def _deviate(value: Array, std: Array, tolerated: Array) -> Array:
    total = np.sqrt(std**2 + tolerated**2)
    with np.errstate(invalid="ignore", divide="ignore"):
        z = np.where(np.isfinite(total), value / np.where(total > 0, total, 1e-300), 0.0)
    return np.asarray(z)


_MEMBER = 0.3  # share of such a direction above which a candidate belongs to it


def _projected(joint: Joint, where: NDArray[np.int64]) -> Array:
    """Return the normalized information matrix of the candidates.

    Offsets, damping ratio and initial states are projected out.
    """
    normal = joint.information().normal
    rest = np.setdiff1d(np.arange(normal.shape[0]), where)
    inner = normal[np.ix_(where, where)]
    if rest.size:
        inverse, _, _ = pseudo_inverse(normal[np.ix_(rest, rest)])
        cross = normal[np.ix_(rest, where)]
        inner = inner - cross.T @ inverse @ cross
    size = np.sqrt(np.maximum(np.diag(inner), 0.0))
    size[size <= 1e-9 * np.sqrt(np.diag(normal)[where])] = np.inf
    unit = inner / np.outer(size, size)
    np.fill_diagonal(unit, np.where(np.isfinite(size), 1.0, 0.0))
    return np.asarray(unit)


def collinear_groups(
    joint: Joint, where: NDArray[np.int64], blurred: NDArray[np.bool_]
) -> tuple[tuple[int, ...], ...]:
    """Candidates that the record sees only together.

    Parameters
    ----------
    joint : Joint
        Estimate.
    where : ndarray of int
        Columns of the candidates.
    blurred : ndarray of bool
        Candidates that the joint estimate leaves too unsure to matter on their own.

    Returns
    -------
    tuple of tuple of int
        Groups of two or more.
    """
    unit = _projected(joint, where)
    seen = np.flatnonzero(np.diag(unit) > 0)
    values, vectors = np.linalg.eigh(unit[np.ix_(seen, seen)])
    owner = list(range(where.size))
    for value, vector in zip(values, vectors.T, strict=True):
        if value >= levels().collinear:
            break
        members = [int(seen[k]) for k in np.flatnonzero(np.abs(vector) > _MEMBER * np.abs(vector).max())]
        members = [i for i in members if blurred[i]]
        if len(members) < 2:
            continue
        target = min(owner[i] for i in members)
        merged = {owner[i] for i in members}
        owner = [target if group in merged else group for group in owner]
    groups = [tuple(i for i in range(where.size) if owner[i] == k) for k in sorted(set(owner))]
    return tuple(group for group in groups if len(group) > 1)
