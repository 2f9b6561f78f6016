"""Covariances of estimates and tests of columns: closed forms, statsmodels, and their own scatter."""

from __future__ import annotations

import numpy as np
import pytest
import statsmodels.api as sm
from inner import Whitener, f_test, project, rank_basis
from scipy import stats
from scipy.linalg import solve_triangular
from scipy.optimize import minimize_scalar
from scipy.signal import lfilter

from rcorefine.inference import covariance as cov


def test_white_residuals_give_the_covariance_of_statsmodels(rng):
    X = rng.standard_normal((300, 3)) * [1.0, 1e-2, 1e2]
    y = X @ [1.0, 2e2, 3e-2] + 0.3 * rng.standard_normal(300)
    theirs = sm.OLS(y, X).fit()
    found = theirs.scale * cov.covariance(X.T @ X)
    assert found == pytest.approx(theirs.cov_params(), rel=1e-9)
    restriction = theirs.wald_test(np.eye(3), use_f=False, scalar=True)
    assert cov.wald(theirs.params, found) == pytest.approx(restriction.pvalue, rel=1e-6, abs=1e-300)
    close = theirs.params - [1.0, 2e2, 3e-2]
    constraint = (np.eye(3), np.array([1.0, 2e2, 3e-2]))
    assert cov.wald(close, found) == pytest.approx(
        theirs.wald_test(constraint, use_f=False, scalar=True).pvalue, rel=1e-6
    )


def test_estimates_under_colored_noise_scatter_as_promised(rng):
    """A sum of squares that takes AR noise for white: its sandwich holds, the plain covariance does not."""
    n, runs = 600, 250
    slow = np.cos(0.02 * np.arange(n))[:, None]
    found, promised, plain = [], [], []
    for _ in range(runs):
        e = lfilter([1.0], [1.0, -0.9], rng.standard_normal(n + 200))[200:]
        theta = np.linalg.lstsq(slow, e, rcond=None)[0]
        r = slow @ theta - e
        unsure = cov.parameter_uncertainty([r[None]], [slow[None]], np.zeros(1))
        found.append(float(theta[0]))
        promised.append(float(unsure.covariance[0, 0]))
        plain.append(float(r.var() * cov.covariance(slow.T @ slow)[0, 0]))
    ratio = np.var(found) / np.mean(promised)
    assert stats.chi2.ppf(5e-4, runs) / runs < ratio < 1.06 * stats.chi2.ppf(1 - 5e-4, runs) / runs
    assert np.var(found) / np.mean(plain) > 5


def test_the_sandwich_is_that_of_the_errors_and_not_of_what_the_fit_left(rng):
    """The whole covariance matrix at the maximum of the restricted likelihood, which scipy finds."""
    n, X = 60, np.polynomial.legendre.legvander(np.linspace(-1, 1, 60), 5)
    e = lfilter([1.0], [1.0, -0.5], rng.standard_normal(n + 100))[100:]
    r = project(e, rank_basis(X))
    normal, middle = cov.colored([r[None]], [X[None]], np.zeros(6), order=1)

    def restricted(phi: float, level: bool = False) -> float:
        white, seen = r[1:] - phi * r[:-1], X[1:] - phi * X[:-1]
        left = float(np.sum(project(white, rank_basis(seen)) ** 2))
        if level:
            return left / (n - 1 - 6)
        return (n - 1 - 6) * np.log(left) + np.linalg.slogdet(seen.T @ seen)[1]

    phi = minimize_scalar(restricted, bounds=(-0.99, 0.99), method="bounded").x
    assert phi < 0.9
    lower = solve_triangular(np.eye(n) - phi * np.eye(n, k=-1), np.eye(n), lower=True)
    assert normal == pytest.approx(X.T @ X)
    oracle = restricted(phi, level=True) * X.T @ lower @ lower.T @ X
    assert np.linalg.norm(middle - oracle) < 0.03 * np.linalg.norm(oracle)


def test_intervals_of_sixty_samples_hold_beside_slow_noise():
    """A parabola beside AR noise: 95 % of the 2 sd intervals hold the truth, by their own scatter."""
    n, runs, X = 60, 400, np.polynomial.legendre.legvander(np.linspace(-1, 1, 60), 2)
    rng, inside = np.random.default_rng(51), 0
    for _ in range(runs):
        e = lfilter([1.0], [1.0, -0.5], rng.standard_normal(n + 100))[100:]
        theta = np.linalg.lstsq(X, e, rcond=None)[0]
        unsure = cov.parameter_uncertainty([(X @ theta - e)[None]], [X[None]], np.zeros(3))
        inside += int(np.sum(np.abs(theta) < 2.0 * cov.standard_deviations(unsure.covariance)))
    assert inside > 0.9 * 3 * runs


def test_a_prior_is_one_more_measurement(rng):
    J, r = rng.standard_normal((1, 50, 2)), rng.standard_normal((1, 50))
    wide = cov.parameter_uncertainty([r], [J], np.zeros(2)).covariance
    tight = cov.parameter_uncertainty([r], [J], np.array([1e12, 0.0])).covariance
    assert tight[0, 0] == pytest.approx(1e-12, rel=1e-6)
    alone = cov.parameter_uncertainty([r], [J[:, :, 1:]], np.zeros(1)).covariance
    assert tight[1, 1] == pytest.approx(alone[0, 0], rel=0.05)
    assert wide[0, 0] > 1e-3


def test_what_is_not_seen_is_infinite_and_named(rng):
    x = rng.standard_normal((80, 1))
    J = np.hstack([x, 3.0 * x, np.zeros((80, 1)), rng.standard_normal((80, 1))])
    sd = cov.standard_deviations(cov.covariance(J.T @ J))
    assert np.isinf(sd[:3]).all()
    assert np.isfinite(sd[3])
    _, lost, _ = cov.pseudo_inverse(J.T @ J)
    assert lost.shape == (2, 4)
    assert J @ lost.T == pytest.approx(0.0, abs=1e-6)
    assert cov.wald(np.array([1e9, 1e9, 1e9, 0.0]), cov.covariance(J.T @ J)) == 1.0


@pytest.mark.parametrize("unit", [1e-60, 1e-9, 1e9, 1e60])
def test_units_carry_through(rng, unit):
    J = rng.standard_normal((60, 3))
    D = np.diag([unit, 1.0, 1.0])
    assert cov.covariance(D @ J.T @ J @ D) * np.outer(np.diag(D), np.diag(D)) == pytest.approx(
        cov.covariance(J.T @ J), rel=1e-9
    )
    assert cov.pseudo_inverse(D @ J.T @ J @ D)[2] == pytest.approx(cov.pseudo_inverse(J.T @ J)[2], rel=1e-9)


# ---------------------------------------------------------------------- F-tests
def test_the_f_test_is_that_of_statsmodels(rng):
    X, Z = rng.standard_normal((200, 3)), rng.standard_normal((200, 2))
    y = X @ [1.0, 2.0, 3.0] + 0.1 * Z[:, 0] + rng.standard_normal(200)
    large, small = sm.OLS(y, np.hstack([X, Z])).fit(), sm.OLS(y, X).fit()
    value, p, dof = large.compare_f_test(small)
    basis = rank_basis(X)
    test = f_test("", project(y, basis), 1e-7 * Z, basis)
    assert (test.statistic, test.p_equal, test.dof) == pytest.approx((value, p, dof))
    assert test.gain == pytest.approx(small.ssr - large.ssr)


def test_columns_that_were_fitted_already_test_nothing(rng):
    basis = rank_basis(rng.standard_normal((100, 3)))
    inside = basis @ rng.standard_normal((3, 2))
    assert f_test("", project(rng.standard_normal(100), basis), inside, basis).p_value == 1.0
    twice = np.repeat(rng.standard_normal((100, 1)), 2, axis=1)
    assert f_test("", rng.standard_normal(100), twice, basis[:, :0]).dof == 1


def test_p_values_are_uniform_under_ar_noise_that_was_whitened(rng):
    p = []
    for _ in range(300):
        e = lfilter([1.0], [1.0, -1.5, 0.8], rng.standard_normal(1200))[200:]
        whitener = Whitener.fit([e[None]])
        r, X = whitener.apply([e[None]]), whitener.apply([rng.standard_normal((1, 1000, 3))])
        p.append(f_test("", r, X, X[:, :0]).p_equal)
    assert stats.kstest(p, "uniform").pvalue > 1e-3


@pytest.mark.parametrize("level", [1e-3, 0.3])
def test_power_is_that_of_the_noncentral_distribution(rng, level):
    n, k, runs = 200, 2, 300
    X = rank_basis(rng.standard_normal((n, k)))
    shift = 3.0 * X[:, 0]
    rejected = np.mean(
        [f_test("", shift + rng.standard_normal(n), X, X[:, :0]).p_equal < level for _ in range(runs)]
    )
    power = stats.ncf.sf(stats.f.isf(level, k, n - k), k, n - k, 9.0)
    assert abs(rejected - power) < 4 * np.sqrt(power * (1 - power) / runs)
