"""Gauss-Newton descents of an estimation problem, in the metric of an observer and a whitening filter."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from ..gauss_newton import Rows, gauss_newton, promised
from ..systems.linear import Array
from .problem import Problem
from .whitening import Whitener

__all__ = ["Descent", "descend", "remeasured"]


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

    def rows(box: Array) -> Rows:  # where every constraint is a bound
        problem.gain, problem._cache = gain, None
        try:
            evaluation = problem.evaluate(here := problem.coordinates.point(box))
        finally:
            problem.gain, problem._cache = None, None
        r, J = evaluation.residual, problem.coordinates.columns(evaluation.jacobian, here)
        if not evaluation.finite:
            return Rows(np.full(1, np.inf), J, evaluation)
        if whitener is not None:
            r, J = _whitened(problem, r, J, whitener)
        return Rows(r, J, evaluation)

    run = gauss_newton(
        rows,
        problem.coordinates.of(point),
        lower=low,
        upper=high,
        sizes=problem.sizes,
        evaluations=evaluations,
        tolerance=tolerance,
    )
    lack = promised(run.rows, run.point, low, high, problem.sizes) if np.isfinite(run.cost) else np.inf
    plain = run.rows.more
    return Descent(
        problem.coordinates.point(run.point), run.cost, plain.residual, plain.jacobian, run.converged, lack
    )


def remeasured(problem: Problem, run: Descent, whitener: Whitener) -> Descent:
    """A run as it is, with its cost and what it lacks (log-likelihood) in the metric of a filter."""
    r, J = _whitened(problem, run.residual, problem.coordinates.columns(run.slopes, run.point), whitener)
    lack = promised(Rows(r, J), problem.coordinates.of(run.point), *problem.box(), problem.sizes)
    return replace(run, cost=0.5 * float(r @ r), lack=lack)


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
