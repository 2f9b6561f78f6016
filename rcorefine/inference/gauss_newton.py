"""A short damped Gauss-Newton descent, for the laps of the race."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..systems.linear import Array
from .problem import Problem
from .whitening import Whitener

__all__ = ["Descent", "descend", "lacking"]

_FULL = 1e-9  # damping of a step that is as good as none


@dataclass(frozen=True, slots=True, eq=False)
class Descent:
    """Where a descent ended.

    Attributes
    ----------
    point : ndarray
        Best point.
    cost : float
        Half the sum of squares there, inf where the simulation blows up.
    residual : ndarray
        Plain weighted residual there, priors included.
    slopes : ndarray
        Its derivatives.
    converged : bool
        Whether the last step changed the cost by less than the tolerance.
    lack : float
        How much the next full step would lower the cost (half g' H^-1 g): small only at a minimum.
    """

    point: Array
    cost: float
    residual: Array
    slopes: Array
    converged: bool
    lack: float = np.inf

    def blocks(self, problem: Problem) -> list[tuple[Array, Array]]:
        """Residual (n_y, N) and Jacobian (n_y, N, p) of each record."""
        return _split(problem, self.residual, self.slopes)


def descend(
    problem: Problem,
    point: Array,
    *,
    gain: Array | None = None,
    whitener: Whitener | None = None,
    evaluations: int = 6,
    tolerance: float = 1e-4,
) -> Descent:
    """Lower the cost from a point by damped Gauss-Newton steps.

    Parameters
    ----------
    problem : Problem
        Estimation problem.
    point : ndarray
        Start; moved inside the bounds.
    gain : ndarray, shape (n, n_y), optional
        Observer gain; the free run without it.
    whitener : Whitener, optional
        Metric: generalized least squares with this filter.
    evaluations : int
        Simulations at most.
    tolerance : float
        Relative decrease of the cost below which the descent ends.

    Returns
    -------
    Descent
    """
    low, high = problem.box()
    x = np.clip(problem.to_box(point), low, high)  # where every constraint is a bound
    cost, r, J, plain = _rows(problem, x, gain, whitener)
    damping, converged = 1e-6, False
    if not np.isfinite(cost):
        return Descent(problem.from_box(x), cost, *plain, False)
    for _ in range(evaluations - 1):
        slope = J.T @ r
        pressed = ((x <= low) & (slope > 0)) | ((x >= high) & (slope < 0))
        step = _step(J, r, damping, ~pressed, problem.sizes)
        predicted = float(-(slope @ step) - 0.5 * np.sum((J @ step) ** 2))
        if predicted <= tolerance * max(cost, 1e-300) and damping <= 1e-3:
            converged = True
            if predicted <= 0.01 * tolerance * max(cost, 1e-300):
                break
        trial = np.clip(x + step, low, high)
        new_cost, new_r, new_J, new_plain = _rows(problem, trial, gain, whitener)
        if new_cost < cost:
            x, cost, r, J, plain = trial, new_cost, new_r, new_J, new_plain
            damping = max(0.1 * damping, 1e-9)
            if converged:
                break
        else:
            if converged:
                break
            damping = max(30 * damping, 1e-3)
    return Descent(problem.from_box(x), cost, *plain, converged, _lack(problem, x, r, J))


def lacking(problem: Problem, run: Descent, whitener: Whitener) -> float:
    """What a run lacks in the metric of a filter: the log-likelihood that the next full step would gain."""
    box = problem.to_box(run.point)
    r, J = _whitened(problem, run.residual, problem.columns_in_box(run.slopes), whitener)
    return _lack(problem, box, r, J)


def _lack(problem: Problem, box: Array, r: Array, J: Array) -> float:
    low, high = problem.box()
    near = 1e-12 * np.abs(box)
    slope = J.T @ r
    pressed = ((box <= low + near) & (slope > 0)) | ((box >= high - near) & (slope < 0))
    return float(-0.5 * slope @ _step(J, r, _FULL, ~pressed, problem.sizes))


def _step(J: Array, r: Array, damping: float, active: NDArray[np.bool_], sizes: Array) -> Array:
    size = np.linalg.norm(J, axis=0)
    felt = size * sizes  # whatever the units of a coefficient
    keep = active & (felt > 1e-12 * felt.max(initial=0.0))
    step = np.zeros(J.shape[1])
    if not keep.any():
        return step
    unit = J[:, keep] / size[keep]
    values, vectors = np.linalg.eigh(unit.T @ unit)
    seen = values > 1e-12 * values[-1]
    along = vectors[:, seen].T @ (unit.T @ r)
    step[keep] = -(vectors[:, seen] @ (along / (values[seen] + damping))) / size[keep]
    return step


def _rows(
    problem: Problem, x: Array, gain: Array | None, whitener: Whitener | None
) -> tuple[float, Array, Array, tuple[Array, Array]]:
    problem.gain, problem._cache = gain, None
    try:
        evaluation = problem.evaluate(problem.from_box(x))
    finally:
        problem.gain, problem._cache = None, None
    r, J = evaluation.residual, problem.columns_in_box(evaluation.jacobian)
    plain = r, evaluation.jacobian
    if not evaluation.finite or not np.isfinite(r).all():
        return np.inf, r, J, plain
    if whitener is not None:
        r, J = _whitened(problem, r, J, whitener)
    return 0.5 * float(r @ r), r, J, plain


def _whitened(problem: Problem, r: Array, J: Array, whitener: Whitener) -> tuple[Array, Array]:
    """Residual and derivatives in the metric of a filter, the rows of the priors as they are."""
    blocks, row = _split(problem, r, J), problem.n_points
    return (
        np.concatenate([whitener.apply([b for b, _ in blocks]), r[row:]]),
        np.concatenate([whitener.apply([b for _, b in blocks]), J[row:]]),
    )


def _split(problem: Problem, r: Array, J: Array) -> list[tuple[Array, Array]]:
    blocks, row = [], 0
    for record in problem.records:
        count, shape = record.outputs.size, record.outputs.shape
        part = slice(row, row + count)
        blocks.append((r[part].reshape(shape), J[part].reshape(*shape, -1)))
        row += count
    return blocks
