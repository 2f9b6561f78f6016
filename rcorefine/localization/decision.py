"""Decision on which candidates are needed to explain the record.

Backward elimination with refits.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import product
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.stats import norm

from ..inference.covariance import pseudo_inverse, standard_deviations
from ..inference.levels import levels
from ..systems.linear import Array
from .candidates import DamageCandidate
from .estimate import Joint

_APART = 15.0  # deviates by which a swap would worsen the fit, to first order, above which it is not tried


class Decision(NamedTuple):
    """Outcome of the elimination, for m candidates."""

    named: tuple[int, ...]  #: candidates that are significant and needed
    rivals: dict[int, tuple[int, ...]]  #: by a named candidate: those that explain the record about as well
    joint: Array  #: estimates with every candidate free, (m,)
    joint_std: Array  #: their standard deviations, (m,)
    joint_covariance: Array  #: their covariance, (m, m)
    change: Array  #: estimates of the named ones, and of each other one beside them, (m,)
    std: Array  #: their standard deviations, (m,)
    p_value: Array  #: two-sided, of `change`, not corrected for multiplicity, (m,)
    groups: tuple[tuple[int, ...], ...]  #: candidates whose sensitivities are nearly collinear


def decide(joint: Joint, candidates: list[DamageCandidate], significance: float) -> Decision:
    """Estimate all changes jointly and keep the candidates that are needed.

    Backward elimination with refits is followed by additions and swaps. A candidate is dropped as long as the
    least significant one fails Holm's level ``significance / (m - r + 1)`` (r left of m), so the survivors
    are significant with multiplicity allowed for, and each is needed in addition to the others.

    Parameters
    ----------
    joint : Joint
        Started estimate.
    candidates : list of DamageCandidate
        What may be named.
    significance : float
        Probability of naming anything where nothing has changed.

    Returns
    -------
    Decision
    """
    # backward elimination, then additions, then swaps
    chosen = _Selection(joint, candidates, significance)
    if len(chosen.kept) > 1 and joint.sparser(chosen.active, chosen.where):
        chosen = _Selection(joint, candidates, significance)  # the same response with fewer changes
    chosen.take_back()
    joint.fit(chosen.active, reweigh=True)
    rivals = chosen.swap()
    joint.fit(chosen.active, reweigh=True)

    # joint estimate with every candidate free, for the table
    final = joint.point
    joint.point = chosen.dense
    every = np.ones_like(chosen.active)
    joint.fit(every)
    estimate, spread, covariance = chosen.estimates(range(len(candidates)), every)
    size = np.array([abs(c.nominal) for c in candidates])
    # collinear: candidates whose joint deviation hides any change
    groups = _collinear_groups(joint, chosen.where, spread > levels().blurred * size)
    joint.point = final
    joint.fit(chosen.active)

    # named ones as fitted; each other one in addition to them
    values, spreads, _ = chosen.estimates(chosen.kept, chosen.active)
    own = dict(zip(chosen.kept, zip(values, spreads, strict=True), strict=True))
    found = [own[i] if i in own else chosen.beside(i) for i in range(len(candidates))]
    change, std = np.array(found).reshape(-1, 2).T
    p_value = chosen.p_values(change, std, range(len(candidates)))
    alternatives = {i: tuple(others) for i, others in rivals.items() if others}
    named = tuple(sorted(chosen.kept))
    return Decision(named, alternatives, estimate, spread, covariance, change, std, p_value, groups)


class _Selection:
    """Kept candidates after backward elimination; the others are held at zero."""

    def __init__(self, joint: Joint, candidates: list[DamageCandidate], significance: float) -> None:
        self.joint, self.significance = joint, significance
        self.where = np.array([c.column for c in candidates], dtype=np.int64)
        self.floor = np.array([c.floor for c in candidates])
        self.tolerated = np.array([c.tolerated for c in candidates])
        self.active = np.ones(joint.structure.n_parameters, dtype=bool)
        self.kept = list(range(len(candidates)))
        joint.fit(self.active, reweigh=True)
        #: point with every candidate free
        self.dense = joint.point.copy()
        while self.kept:  # drop the least significant candidate as long as it fails Holm's level
            value, std, _ = self.estimates(self.kept, self.active)
            floor = self.floor[self.kept]
            p = self.p_values(value, std, self.kept)
            p = np.where(np.abs(value) < floor, np.maximum(p, 0.5), p)
            # where none is seen on its own, the smallest share goes first
            order = np.lexsort((np.abs(value) / np.maximum(floor, 1e-300), -p))
            weakest = int(order[0])
            if p[weakest] <= self.significance / (self.where.size - len(self.kept) + 1):
                break
            self._hold(self.where[self.kept.pop(weakest)])

    def p_values(self, value: Array, std: Array, which: Sequence[int]) -> Array:
        """Return two-sided p-values of changes, with tolerances allowed for."""
        # tolerance of the nominal value adds to the deviation
        total = np.hypot(std, self.tolerated[list(which)])
        return np.asarray(2.0 * norm.sf(np.abs(_deviate(value, total))))

    def estimates(self, which: Sequence[int], active: NDArray[np.bool_]) -> tuple[Array, Array, Array]:
        """Value, standard deviation and covariance of active candidates."""
        # covariance with colored residuals, of the active columns
        where, columns = self.where[list(which)], self.joint.columns(active)
        covariance = self.joint.information().covariance(columns)
        rows = np.searchsorted(columns, where)
        part = covariance[np.ix_(rows, rows)]
        return self.joint.theta[where], standard_deviations(part), part

    def beside(self, i: int) -> tuple[float, float]:
        """Estimate one more candidate in addition to those that are kept.

        The value and its standard deviation come from one Gauss-Newton step.
        """
        # one more column than are fitted
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
        # start from the better of both guesses
        guesses = [joint.problem.inside(guess) for guess in (point, plain)]
        joint.point = min(guesses, key=joint.problem.cost)
        joint.fit(self.active)

    def take_back(self) -> None:
        """Take back what turns out to be significant beside the survivors."""
        for _ in range(self.where.size):
            left = [i for i in range(self.where.size) if i not in self.kept]
            if not left:
                return
            # candidates outside by one Gauss-Newton step each
            value, std = np.array([self.beside(i) for i in left]).T
            p = self.p_values(value, std, left)
            p = np.where(np.abs(value) < self.floor[left], 1.0, p)
            best = int(np.argmin(p))
            # Bonferroni over the candidates outside
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
        # swap until no exchange improves the fit
        for _ in range(where.size):
            # correlation of columns: a swap of dissimilar columns cannot help
            similar = np.abs(_projected_information(joint, where))
            value, std, _ = self.estimates(kept, self.active)
            apart = dict(zip(kept, np.abs(_deviate(value, std)), strict=True))
            rivals = {i: [] for i in kept}
            # cost in units of the noise variance: differences are log-likelihood ratios
            level = joint.fit(self.active)
            scale = 2.0 * level / joint.problem.n_points
            reference, better = joint.point.copy(), None
            for i, j in product(kept, range(where.size)):
                if j in kept or apart[i] * np.sqrt(max(1 - similar[i, j] ** 2, 0.0)) > _APART:
                    continue
                cost = self._swap_cost(i, j)
                gain = 2.0 * (level - cost) / scale
                # alternative: the log-likelihood is less by no more than `rival`
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

    def _swap_cost(self, i: int, j: int) -> float:
        """Cost with one candidate in the place of another."""
        joint, (a, b), trial = self.joint, self.where[[i, j]], self.active.copy()
        trial[a], trial[b] = False, True
        # same effect on the outputs: scale by the ratio of the column norms
        normal = joint.information().normal
        ratio = np.sqrt(normal[a, a] / max(normal[b, b], 1e-300))
        point = joint.point.copy()
        point[b], point[a] = point[a] * ratio * np.sign(normal[a, b]), 0.0
        joint.point = point
        return joint.fit(trial)


def _deviate(value: Array, std: Array) -> Array:
    return np.where(np.isfinite(std), value / np.where(std > 0, std, 1e-300), 0.0)


_MEMBER = 0.3  # share of such a direction above which a candidate belongs to it


def _projected_information(joint: Joint, where: NDArray[np.int64]) -> Array:
    """Return the normalized information matrix of the candidates.

    Offsets, damping ratio and initial states are projected out.
    """
    # Schur complement: information with all other columns projected out
    normal = joint.information().normal
    rest = np.setdiff1d(np.arange(normal.shape[0]), where)
    inner = normal[np.ix_(where, where)]
    if rest.size:
        inverse, _, _ = pseudo_inverse(normal[np.ix_(rest, rest)])
        cross = normal[np.ix_(rest, where)]
        inner = inner - cross.T @ inverse @ cross
    size = np.sqrt(np.maximum(np.diag(inner), 0.0))
    size[size <= 1e-9 * np.sqrt(np.diag(normal)[where])] = np.inf
    # correlation matrix; a column without effect gets a zero row
    unit = inner / np.outer(size, size)
    np.fill_diagonal(unit, np.where(np.isfinite(size), 1.0, 0.0))
    return np.asarray(unit)


def _collinear_groups(
    joint: Joint, where: NDArray[np.int64], blurred: NDArray[np.bool_]
) -> tuple[tuple[int, ...], ...]:
    """Return groups of candidates that the record sees only together.

    Those count that the joint estimate leaves too unsure (`blurred`) to matter on their own.
    """
    unit = _projected_information(joint, where)
    seen = np.flatnonzero(np.diag(unit) > 0)
    # eigenvalues near zero: combinations that the data do not see
    values, vectors = np.linalg.eigh(unit[np.ix_(seen, seen)])
    owner = list(range(where.size))
    for value, vector in zip(values, vectors.T, strict=True):
        if value >= levels().collinear:
            break
        members = seen[(np.abs(vector) > _MEMBER * np.abs(vector).max()) & blurred[seen]]
        if members.size < 2:
            continue
        # join groups that share a member
        merged = {owner[i] for i in members}
        owner = [min(merged) if group in merged else group for group in owner]
    groups = [tuple(i for i, group in enumerate(owner) if group == k) for k in sorted(set(owner))]
    return tuple(group for group in groups if len(group) > 1)
