"""Damped Gauss-Newton steps inside bounds, also with unknowns per record.

This is the only optimizer of the package besides scipy's trust region.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from .systems.linear import Array

_UNSEEN = 1e-14  # eigenvalue of the unit-column normal matrix, relative, below which a direction is not seen
_NO_STEP = 1e-12  # size of a column, times that of its unknown and relative, below which it is not felt


class Rows(NamedTuple):
    """Residual at a point and its derivatives.

    `more` holds what else the caller needs from that point.
    """

    residual: Array  #: (N,); not finite where there is none
    jacobian: Any  #: (N, p), or their normal equations by records: `Bordered`
    more: Any = None


class Minimum(NamedTuple):
    """Result of a minimization."""

    point: Array
    cost: float  #: half the sum of squares; inf where there is no residual at the start
    rows: Rows
    converged: bool  #: whether the last step promised too little to count


def gauss_newton(
    evaluate: Callable[[Array], Rows],
    start: Array,
    *,
    lower: Array | float = -np.inf,
    upper: Array | float = np.inf,
    sizes: Array | float | Callable[[Array], Array] = 1.0,
    evaluations: int = 20,
    tolerance: float = 1e-6,
    settled: Callable[[float, float], bool] | None = None,
    damping: float = 1e-6,
) -> Minimum:
    """Lower half the sum of squares by damped Gauss-Newton steps.

    Parameters
    ----------
    evaluate : callable
        Residual and derivatives at a point; priors are rows like any other.
    start : ndarray, shape (p,)
        Start; moved into the bounds.
    lower, upper : ndarray, shape (p,), or float
        Bounds. An unknown that is pressed against one is left out of the step.
    sizes : ndarray, shape (p,), or float, or callable
        Natural sizes of the unknowns, or their function of a point: with them, what is felt does not
        depend on units.
    evaluations : int
        Calls of `evaluate` at most.
    tolerance : float
        A step that promises to lower the cost by a smaller share is the last one; by a hundredth
        of that, it is not even taken.
    settled : callable, optional
        ``settled(cost, gain)``, in place of the tolerance.
    damping : float
        Of the first step, relative to the square of each column; 0 solves a linear problem at once.

    Returns
    -------
    Minimum

    Examples
    --------
    >>> def rosenbrock(x):
    ...     return Rows(np.array([10 * (x[1] - x[0] ** 2), 1 - x[0]]), np.array([[-20 * x[0], 10], [-1, 0]]))
    >>> print(gauss_newton(rosenbrock, np.array([-1.2, 1.0]), evaluations=50).point.round(6))
    [1. 1.]
    """
    done = settled or (lambda cost, gain: gain <= tolerance * max(cost, 1e-300))
    x = np.clip(start, lower, upper)
    rows = evaluate(x)
    cost, converged, least = _cost(rows), False, min(damping, 1e-9)
    if not np.isfinite(cost):
        return Minimum(x, cost, rows, False)
    for _ in range(evaluations - 1):
        slope = _slope(rows)
        step = _step(rows, damping, ~_pressed(x, lower, upper, slope), sizes(x) if callable(sizes) else sizes)
        gain = -float(slope @ step) - 0.5 * _square(rows.jacobian, step)
        if done(cost, gain) and damping <= 1e-3:
            converged = True
            if done(cost, 100.0 * gain):
                break
        trial = np.clip(x + step, lower, upper)
        new = evaluate(trial)
        if (reached := _cost(new)) < cost:
            x, cost, rows = trial, reached, new
            damping = max(0.1 * damping, least)
        else:
            damping = max(30.0 * damping, 1e-3)
        if converged:
            break
    return Minimum(x, cost, rows, converged)


def own_sizes(reached: Array, jacobian: Array) -> Array:
    """Natural sizes of unknown initial values, whatever their units.

    Parameters
    ----------
    reached : ndarray, shape (p,)
        The largest that each becomes on its way from zero.
    jacobian : ndarray, shape (N, p)
        Derivatives of what is judged: of an unknown that nothing drives they tell what counts as one.
    """
    felt = np.linalg.norm(jacobian, axis=0)
    driven = np.isfinite(reached) & (reached > 0)
    return np.where(driven, reached, 1.0 / np.where(np.isfinite(felt) & (felt > 0), felt, 1.0))


def promised(
    rows: Rows, point: Array, lower: Array | float, upper: Array | float, sizes: Array | float = 1.0
) -> float:
    """Return the cost reduction that the next full step predicts.

    It is half g' H^-1 g, and small only at a minimum.
    """
    near, slope = 1e-12 * np.abs(point), _slope(rows)
    active = ~_pressed(point, lower + near, upper - near, slope)
    return float(-0.5 * slope @ _step(rows, 1e-9, active, sizes))


def _pressed(x: Array, lower: Array | float, upper: Array | float, slope: Array) -> NDArray[np.bool_]:
    return np.asarray(((x <= lower) & (slope > 0)) | ((x >= upper) & (slope < 0)))


def _slope(rows: Rows) -> Array:
    J = rows.jacobian
    return J.gradient if isinstance(J, Bordered) else np.asarray(J.T @ rows.residual)


def _square(J: Array | Bordered, step: Array) -> float:
    return J.square(step) if isinstance(J, Bordered) else float(np.sum((J @ step) ** 2))


def _step(rows: Rows, damping: float, active: NDArray[np.bool_], sizes: Array | float) -> Array:
    J = rows.jacobian
    size = J.norms if isinstance(J, Bordered) else np.linalg.norm(J, axis=0)
    felt = size * sizes
    keep = active & (felt > _NO_STEP * felt.max(initial=0.0))
    step = np.zeros(size.size)
    if not keep.any():
        return step
    if isinstance(J, Bordered):
        return J.step(keep, damping)
    unit = J[:, keep] / size[keep]
    values, vectors = np.linalg.eigh(unit.T @ unit)
    seen = values > _UNSEEN * values[-1]
    along = vectors[:, seen].T @ (unit.T @ rows.residual)
    step[keep] = -(vectors[:, seen] @ (along / (values[seen] + damping))) / size[keep]
    return step


def _cost(rows: Rows) -> float:
    if not np.isfinite(rows.residual).all():
        return np.inf
    with np.errstate(over="ignore"):  # a square beyond all numbers is no better than none
        return 0.5 * float(rows.residual @ rows.residual)


@dataclass(frozen=True, eq=False)
class Bordered:
    """J'J and J'r by blocks: time and room grow with the number of records.

    Attributes
    ----------
    common : ndarray, shape (p, p)
        Of the unknowns that all records share; they come first.
    cross : ndarray, shape (R, p, n)
        Of these with what each record feels alone.
    own : ndarray, shape (R, n, n)
        Of what each record feels alone.
    gradient : ndarray, shape (p + R n,)
        J'r.
    """

    common: Array
    cross: Array
    own: Array
    gradient: Array

    @classmethod
    def of(cls, blocks: Sequence[Array], residuals: Sequence[Array], p: int) -> Bordered:
        """Assemble the normal equations from all records.

        `blocks` holds the derivatives (rows, p + n) of each record, `residuals` its residual (rows,).
        """
        normal = np.array([block.T @ block for block in blocks])
        slope = np.array([block.T @ r for block, r in zip(blocks, residuals, strict=True)])
        gradient = np.concatenate([slope[:, :p].sum(axis=0), slope[:, p:].ravel()])
        return cls(normal[:, :p, :p].sum(axis=0), normal[:, :p, p:], normal[:, p:, p:], gradient)

    @property
    def norms(self) -> Array:
        """Norm of each column of J."""
        own = np.diagonal(self.own, axis1=1, axis2=2).ravel()
        return np.asarray(np.sqrt(np.concatenate([np.diag(self.common), own])))

    def _split(self, values: Array) -> tuple[Array, Array]:
        p = len(self.common)
        return values[:p], values[p:].reshape(self.own.shape[:2])

    def square(self, step: Array) -> float:
        """Sum of squares of J times a step."""
        first, own = self._split(step)
        return float(
            first @ self.common @ first
            + 2.0 * np.einsum("i,rij,rj", first, self.cross, own)
            + np.einsum("ri,rij,rj", own, self.own, own)
        )

    def step(self, keep: NDArray[np.bool_], damping: float) -> Array:
        """Return the damped least-squares step in some unknowns.

        The damping is relative to the square of each column.

        Directions that the rows do not determine stay where they are.
        """
        norms = self.norms
        scale = np.where(keep, 1.0 / np.where(norms > 0, norms, 1.0), 0.0)
        first, own = self._split(scale)
        g, h = self._split(self.gradient * scale)
        common = self.common * np.outer(first, first) + np.diag((first == 0).astype(float))
        cross = self.cross * first[:, None] * own[:, None, :]
        inner = self.own * own[:, :, None] * own[:, None, :]
        inner = inner + np.eye(own.shape[1]) * (own == 0)[:, None, :]
        values, vectors = np.linalg.eigh(inner)
        top = max(float(values.max(initial=0.0)), float(np.linalg.eigvalsh(common)[-1]) if g.size else 0.0)
        seen = values > _UNSEEN * top
        turned, pushed = cross @ vectors, np.einsum("rij,ri->rj", vectors, h)
        inverse, plain = (
            np.where(seen, 1.0 / np.where(seen, values + by, 1.0), 0.0) for by in (damping, 0.0)
        )
        # what the records leave of the common unknowns once their own follow
        left = common - _through(turned, plain)
        level, along = np.linalg.eigh(left)
        along = along[:, level > _UNSEEN * top]
        damped = common + damping * np.eye(g.size)
        damped -= _through(turned, inverse)
        push = along.T @ (g - np.einsum("rik,rk->i", turned, inverse * pushed))
        moved = -along @ np.linalg.solve(along.T @ damped @ along, push)
        follow = -np.einsum("rij,rj->ri", vectors, inverse * (pushed + np.einsum("rij,i->rj", turned, moved)))
        return np.concatenate([moved, follow.ravel()]) * scale

    def condensed(self) -> Array:
        """Return the normal matrix (p, p) of the common unknowns.

        The unknowns of the single records are eliminated.
        """
        norms = self.norms
        _, own = self._split(np.where(norms > 0, 1.0 / np.where(norms > 0, norms, 1.0), 0.0))
        values, vectors = np.linalg.eigh(self.own * own[:, :, None] * own[:, None, :])
        seen = values > _UNSEEN * values.max(initial=0.0)
        turned = (self.cross * own[:, None, :]) @ vectors
        inverse = np.where(seen, 1.0 / np.where(seen, values, 1.0), 0.0)
        return np.asarray(self.common - _through(turned, inverse))


def _through(turned: Array, inverse: Array) -> Array:
    """Sum over the records of T diag(d) T', of T (R, p, n) and d (R, n)."""
    return np.asarray(np.tensordot(turned * inverse[:, None, :], turned, axes=((0, 2), (0, 2))))
