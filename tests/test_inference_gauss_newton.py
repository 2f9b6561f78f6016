"""The one Gauss-Newton: against scipy, closed forms, bounds, units, and residuals that blow up."""

from __future__ import annotations

import numpy as np
import pytest
from inner import Rows, gauss_newton, promised
from scipy.optimize import least_squares, lsq_linear


def linear(A, b):
    return lambda x: Rows(A @ x - b, A)


def decay(t, y):
    """a exp(-b t) + c, a nonlinear regression with a known Jacobian."""

    def rows(x):
        a, b, c = x
        with np.errstate(over="ignore", invalid="ignore"):
            e = np.exp(-b * t)
            return Rows(a * e + c - y, np.column_stack([e, -a * t * e, np.ones(t.size)]))

    return rows


@pytest.fixture
def problem(rng):
    t = np.linspace(0, 5, 80)
    return decay(t, 3 * np.exp(-1.3 * t) + 0.5 + 0.05 * rng.standard_normal(80))


def test_a_linear_problem_takes_one_step(rng):
    A, b = rng.standard_normal((40, 4)), rng.standard_normal(40)
    calls = []
    run = gauss_newton(lambda x: calls.append(0) or Rows(A @ x - b, A), np.zeros(4), damping=0.0)
    assert run.point == pytest.approx(np.linalg.lstsq(A, b, rcond=None)[0], rel=1e-9)
    assert run.converged
    assert len(calls) == 2


def test_a_regression_ends_where_scipy_ends(problem):
    run = gauss_newton(problem, np.array([1.0, 0.3, 0.0]), evaluations=50, tolerance=1e-12)
    theirs = least_squares(
        lambda x: problem(x).residual, [1.0, 0.3, 0.0], jac=lambda x: problem(x).jacobian, xtol=1e-12
    )
    assert run.point == pytest.approx(theirs.x, rel=1e-5)
    assert run.cost == pytest.approx(theirs.cost, rel=1e-9)
    assert promised(run.rows, run.point, -np.inf, np.inf) < 1e-9 * run.cost


@pytest.mark.parametrize("seed", range(8))
def test_bounds_hold_as_in_scipy(seed):
    rng = np.random.default_rng([seed, 77])
    A, b = rng.standard_normal((30, 5)), 3 * rng.standard_normal(30)
    lower, upper = -0.2 * rng.random(5), 0.2 * rng.random(5)
    run = gauss_newton(linear(A, b), np.zeros(5), lower=lower, upper=upper, evaluations=200, tolerance=1e-13)
    theirs = lsq_linear(A, b, (lower, upper), tol=1e-14)
    assert np.all((run.point >= lower) & (run.point <= upper))
    assert run.cost == pytest.approx(theirs.cost, rel=1e-6)


@pytest.mark.parametrize("unit", [1e-9, 1e9])
def test_units_do_not_change_the_way(problem, unit):
    scale = np.array([unit, 1.0, 1 / unit])
    start = np.array([1.0, 0.3, 0.0])

    def scaled(x):
        r, J, _ = problem(x / scale)
        return Rows(r, J / scale)

    plain, other = gauss_newton(problem, start), gauss_newton(scaled, start * scale, sizes=scale)
    assert other.point / scale == pytest.approx(plain.point, rel=1e-6)


def test_a_prior_is_a_row(rng):
    A, b, mean, sd = rng.standard_normal((20, 2)), rng.standard_normal(20), np.array([1.0, -1.0]), 0.1
    held = np.vstack([A, np.eye(2) / sd])
    run = gauss_newton(linear(held, np.append(b, mean / sd)), np.zeros(2), damping=0.0)
    precision = np.eye(2) / sd**2
    assert run.point == pytest.approx(np.linalg.solve(A.T @ A + precision, A.T @ b + precision @ mean))


def test_what_blows_up_is_stepped_back_from(problem):
    run = gauss_newton(problem, np.array([1.0, -140.0, 0.0]), evaluations=5)
    assert run.cost == np.inf or np.isfinite(run.point).all()

    def cliff(x):  # no residual beyond 2, where the first full step goes
        return Rows(np.array([np.inf]) if x[0] > 2 else np.arctan(x - 1.9), 1 / (1 + (x[:, None] - 1.9) ** 2))

    run = gauss_newton(cliff, np.array([0.3]), evaluations=60, tolerance=1e-12)
    assert run.point == pytest.approx([1.9], abs=1e-4)
    nowhere = gauss_newton(cliff, np.array([3.0]))
    assert nowhere.cost == np.inf
    assert not nowhere.converged


def test_an_unseen_unknown_stays(rng):
    A = np.column_stack([rng.standard_normal(20), np.zeros(20)])
    run = gauss_newton(linear(A, rng.standard_normal(20)), np.array([0.0, 7.0]))
    assert run.point[1] == 7.0
    empty = gauss_newton(lambda x: Rows(np.ones(3), np.zeros((3, 0))), np.zeros(0))
    assert empty.converged
    assert empty.cost == 1.5


def test_the_cost_never_rises_and_calls_are_counted(problem):
    costs = []

    def watched(x):
        rows = problem(x)
        costs.append(0.5 * float(rows.residual @ rows.residual))
        return rows

    run = gauss_newton(watched, np.array([-5.0, 3.0, 4.0]), evaluations=9)
    assert len(costs) <= 9
    assert run.cost == min(costs)
    assert run.cost <= costs[0]


def test_promised_is_the_decrease_of_a_linear_problem(rng):
    A, b = rng.standard_normal((30, 3)), rng.standard_normal(30)
    start = Rows(-b, A)
    best = np.linalg.lstsq(A, b, rcond=None)
    gained = 0.5 * float(b @ b) - 0.5 * float(best[1][0])
    assert promised(start, np.zeros(3), -np.inf, np.inf) == pytest.approx(gained, rel=1e-6)
    toward = np.sign(best[0])
    walls = np.where(toward < 0, 0.0, -np.inf), np.where(toward > 0, 0.0, np.inf)
    slope = A.T @ -b
    pressed = ((walls[0] == 0) & (slope > 0)) | ((walls[1] == 0) & (slope < 0))
    free = A[:, ~pressed]
    left = (
        0.0
        if not free.size
        else 0.5 * float(b @ b) - 0.5 * float(np.linalg.lstsq(free, b, rcond=None)[1].sum())
    )
    assert promised(start, np.zeros(3), *walls) == pytest.approx(left, abs=1e-9)
