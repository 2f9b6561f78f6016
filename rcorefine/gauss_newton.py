"""Damped Gauss-Newton steps inside bounds.

This is the only optimizer of the package besides scipy's trust region.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from .bordered import Bordered
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
