"""Gauss-Newton minimization of an estimation problem.

An observer and a whitening filter may define the residual that is minimized.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from ..gauss_newton import Rows, gauss_newton, promised
from ..systems.linear import Array
from .problem import Evaluation, Problem
from .whitening import Whitener


@dataclass(frozen=True, slots=True, eq=False)
class Descent:
    """Result of a minimization.

    Attributes
    ----------
    point : ndarray
        Best point.
    cost : float
        Half the sum of squares there, inf where the simulation blows up.
    evaluation : Evaluation
        Plain weighted residual there, and its derivatives.
    converged : bool
        Whether the last step changed the cost by less than the tolerance.
    lack : float
        How much the next full step would lower the cost (half g' H^-1 g): small only at a minimum.
    problem, gain
        What was descended.
    """

    point: Array
    cost: float
    evaluation: Evaluation
    converged: bool
    lack: float = np.inf
    problem: Problem | None = None
    gain: Array | None = None

    def known(self, problem: Problem, gain: Array | None) -> Evaluation | None:
        """Its evaluation, if it is one of this problem led by this gain."""
        if self.problem is not problem or (self.gain is None) != (gain is None):
            return None
        same = self.gain is None or gain is None or np.array_equal(self.gain, gain)
        return self.evaluation if same else None

    def blocks(self, problem: Problem) -> list[tuple[Array, Array]]:
        """Return the residual and the Jacobian of each record.

        The shapes are (n_y, N) and (n_y, N, .); the Jacobian has a column for each unknown that affects the
        record.
        """
        return [(r, j) for r, j, _ in problem.split(self.evaluation)]

    def at_bound(self, problem: Problem) -> list[str]:
        """Labels of the coefficients that stand on a bound there."""
        return problem.at_bound(self.point, self.evaluation.coefficients(problem.n_theta))


def descend(
    problem: Problem,
    point: Array,
    *,
    gain: Array | None = None,
    whitener: Whitener | None = None,
    evaluations: int = 6,
    tolerance: float = 1e-4,
    known: Evaluation | None = None,
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
    known : Evaluation, optional
        What is known at the start.

    Returns
    -------
    Descent
    """
    low, high = problem.box()

    def rows(box: Array) -> Rows:  # where every constraint is a bound
        here = problem.coordinates.point(box)
        if known is not None and np.array_equal(here, point):
            return _rows(problem, known, here, whitener)
        problem.gain, problem._cache = gain, None
        try:
            evaluation = problem.evaluate(here)
        finally:
            problem.gain, problem._cache = None, None
        return _rows(problem, evaluation, here, whitener)

    run = gauss_newton(
        rows,
        problem.coordinates.of(point),
        lower=low,
        upper=high,
        sizes=problem.sizes_at,
        evaluations=evaluations,
        tolerance=tolerance,
    )
    sizes = problem.sizes_at(run.point)
    lack = promised(run.rows, run.point, low, high, sizes) if np.isfinite(run.cost) else np.inf
    place = problem.coordinates.point(run.point)
    return Descent(place, run.cost, run.rows.more, run.converged, lack, problem, gain)


def remeasured(problem: Problem, run: Descent, whitener: Whitener) -> Descent:
    """Return a descent with its cost and lack for a whitening filter.

    The point does not change; cost and lack are log-likelihoods.
    """
    rows = _rows(problem, run.evaluation, run.point, whitener)
    at = problem.coordinates.of(run.point)
    lack = promised(rows, at, *problem.box(), problem.sizes_at(at))
    return replace(run, cost=0.5 * float(rows.residual @ rows.residual), lack=lack)


def _rows(problem: Problem, evaluation: Evaluation, point: Array, whitener: Whitener | None) -> Rows:
    """Return the whitened residual of an evaluation and its derivatives.

    The rows of the priors are not filtered.
    """
    if not evaluation.finite:
        return Rows(np.full(1, np.inf), evaluation.prior, evaluation)
    parts = problem.split(evaluation)
    residuals = [r if whitener is None else whitener.apply([r]) for r, _, _ in parts]
    residual = np.concatenate([*(r.ravel() for r in residuals), evaluation.residual[problem.n_points :]])
    turn = problem.coordinates.columns
    if len(parts) == 1:
        J = evaluation.jacobian
        if whitener is not None:
            J = np.concatenate([whitener.apply([parts[0][1]]), evaluation.prior])
        return Rows(residual, turn(J, point), evaluation)
    normal = evaluation.bordered(problem.n_theta, whitener, lambda J: turn(J, point))
    return Rows(residual, normal, evaluation)
