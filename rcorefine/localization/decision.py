"""Which candidates are needed: elimination with refits, then what else could explain the record."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.stats import norm

from ..inference.covariance import pseudo_inverse, standard_deviations
from ..inference.levels import levels
from ..systems.linear import Array
from .candidates import Candidate
from .collinearity import collinear_groups, similar_sign, similarity
from .estimate import Joint

__all__ = ["Decision", "decide", "two_sided"]

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
    """Joint estimate, backward elimination with refits, then additions and swaps.

    A candidate is dropped as long as the least significant one fails Holm's level
    ``significance / (m - r + 1)`` (r left of m), so the survivors are significant with
    multiplicity allowed for, and each is needed beside the others.

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
    m = len(candidates)
    where = np.array([c.column for c in candidates], dtype=np.int64)
    floor = np.array([c.floor for c in candidates])
    tolerated = np.array([c.tolerated for c in candidates])
    active = np.ones(joint.structure.n_parameters, dtype=bool)
    joint.fit(active, reweigh=True)
    dense = joint.point.copy()
    kept = _eliminate(joint, where, active, floor, tolerated, significance)
    elsewhere = False
    level = joint.problem.cost(joint.point)
    if len(kept) > 1 and joint.sparser(active, len(kept)) is not None:
        # the same response with fewer changes: decide there
        reached = joint.problem.cost(joint.point)
        elsewhere = 2.0 * (level - reached) < levels().rival * 2.0 * reached / joint.problem.n_points
        active[:] = True
        joint.fit(active, reweigh=True)
        dense = joint.point.copy()
        kept = _eliminate(joint, where, active, floor, tolerated, significance)
    _improve(joint, where, active, kept, floor, tolerated, significance)
    joint.fit(active, reweigh=True)
    rivals = _swap(joint, where, active, kept)
    joint.fit(active, reweigh=True)

    final = joint.point
    everything = np.ones_like(active)
    joint.point = dense
    joint.fit(everything)
    estimate, spread, covariance = _estimates(joint, where, everything)
    size = np.array([abs(c.nominal) for c in candidates])
    groups = collinear_groups(joint, where, spread > levels().blurred * size)
    joint.point = final
    joint.fit(active)

    change, std = np.zeros(m), np.zeros(m)
    for i in range(m):
        if i in kept:
            values, spreads, _ = _estimates(joint, where[[i]], active)
            change[i], std[i] = values[0], spreads[0]
        else:
            change[i], std[i] = _beside(joint, where[i], active)
    return Decision(
        tuple(sorted(kept)),
        {i: tuple(others) for i, others in rivals.items() if others},
        estimate,
        spread,
        covariance,
        change,
        std,
        two_sided(_deviate(change, std, tolerated)),
        groups,
        elsewhere,
    )


def _eliminate(
    joint: Joint,
    where: NDArray[np.int64],
    active: NDArray[np.bool_],
    floor: Array,
    tolerated: Array,
    significance: float,
) -> list[int]:
    """Drop the least significant candidate as long as it fails Holm's level."""
    m = where.size
    kept = list(range(m))
    while kept:
        value, std, _ = _estimates(joint, where[kept], active)
        p = two_sided(_deviate(value, std, tolerated[kept]))
        p = np.where(np.abs(value) < floor[kept], np.maximum(p, 0.5), p)
        # where none is seen on its own, the smallest share goes first
        order = np.lexsort((np.abs(value) / np.maximum(floor[kept], 1e-300), -p))
        weakest = int(order[0])
        if p[weakest] <= significance / (m - len(kept) + 1):
            break
        _hold(joint, where[kept.pop(weakest)], active)
    return kept


def _deviate(value: Array, std: Array, tolerated: Array) -> Array:
    total = np.sqrt(std**2 + tolerated**2)
    with np.errstate(invalid="ignore", divide="ignore"):
        z = np.where(np.isfinite(total), value / np.where(total > 0, total, 1e-300), 0.0)
    return np.asarray(z)


def _estimates(
    joint: Joint, where: NDArray[np.int64], active: NDArray[np.bool_]
) -> tuple[Array, Array, Array]:
    """Value, standard deviation and covariance of some active columns."""
    columns = joint.columns(active)
    covariance = joint.information().covariance(columns)
    rows = np.array([int(np.flatnonzero(columns == c)[0]) for c in where], dtype=np.int64)
    part = covariance[np.ix_(rows, rows)]
    return joint.theta[where], standard_deviations(part), part


def _beside(joint: Joint, column: int, active: NDArray[np.bool_]) -> tuple[float, float]:
    """What one more candidate would come to beside the active ones: one Gauss-Newton step."""
    wider = active.copy()
    wider[column] = True
    columns = joint.columns(wider)
    row = int(np.flatnonzero(columns == column)[0])
    information = joint.information()
    variance = information.covariance(columns)[row, row]
    if not np.isfinite(variance):
        return 0.0, np.inf
    return float(information.step(columns)[row]), float(np.sqrt(variance))


def _hold(joint: Joint, column: int, active: NDArray[np.bool_]) -> float:
    """Put one candidate back to zero and fit the others."""
    point = joint.point.copy()
    step = -point[column]
    # the others move along first, as their correlation says
    active[column] = False
    columns = joint.columns(active)
    normal = joint.information().normal
    block = normal[np.ix_(columns, columns)]
    inverse, _, _ = pseudo_inverse(block)
    point[columns] -= inverse @ normal[columns, column] * step
    point[column] = 0.0
    plain = joint.point.copy()
    plain[column] = 0.0
    guesses = [joint.problem.inside(guess) for guess in (point, plain)]
    joint.point = min(guesses, key=joint.problem.cost)
    return joint.fit(active)


def _improve(
    joint: Joint,
    where: NDArray[np.int64],
    active: NDArray[np.bool_],
    kept: list[int],
    floor: Array,
    tolerated: Array,
    significance: float,
) -> None:
    """Take back what turns out to be significant beside the survivors."""
    m = where.size
    for _ in range(m):
        left = [i for i in range(m) if i not in kept]
        if not left:
            return
        found = np.array([_beside(joint, where[i], active) for i in left])
        p = two_sided(_deviate(found[:, 0], found[:, 1], tolerated[left]))
        p = np.where(np.abs(found[:, 0]) < floor[left], 1.0, p)
        best = int(np.argmin(p))
        if p[best] > significance / len(left):
            return
        kept.append(left[best])
        active[where[left[best]]] = True
        joint.fit(active)


def _swap(
    joint: Joint, where: NDArray[np.int64], active: NDArray[np.bool_], kept: list[int]
) -> dict[int, list[int]]:
    """Put each similar candidate in the place of a named one: better takes over, equal is a rival."""
    rivals: dict[int, list[int]] = {}
    for _ in range(where.size):
        similar = similarity(joint, where)
        value, std, _ = _estimates(joint, where[kept], active)
        apart = dict(zip(kept, np.abs(_deviate(value, std, np.zeros(len(kept)))), strict=True))
        rivals = {i: [] for i in kept}
        level = joint.fit(active)
        scale = 2.0 * level / joint.problem.n_points
        reference, better = joint.point.copy(), None
        for i in kept:
            for j in range(where.size):
                if j in kept or apart[i] * np.sqrt(max(1 - similar[i, j] ** 2, 0.0)) > _APART:
                    continue
                trial = active.copy()
                trial[where[i]], trial[where[j]] = False, True
                ratio = np.sqrt(
                    joint.information().normal[where[i], where[i]]
                    / max(joint.information().normal[where[j], where[j]], 1e-300)
                )
                joint.point = reference.copy()
                joint.point[where[j]] = (
                    joint.point[where[i]] * ratio * np.sign(similar_sign(joint, where, i, j))
                )
                joint.point[where[i]] = 0.0
                cost = joint.fit(trial)
                gain = 2.0 * (level - cost) / scale
                if gain > -levels().rival:
                    rivals[i].append(j)
                if gain > 1e-6 and (better is None or gain > better[0]):
                    better = (gain, i, j, joint.point.copy())
                joint.point = reference.copy()
                joint.information()
        joint.point = reference
        joint.fit(active)
        if better is None:
            return rivals
        _, i, j, joint.point = better
        active[where[i]], active[where[j]] = False, True
        kept.remove(i)
        kept.append(j)
    return rivals
