"""Residual tests against statsmodels, published definitions, hand-computed cases, and their false alarms."""

from __future__ import annotations

import control as ct
import numpy as np
import pytest
from scipy import stats
from scipy.signal import lfilter
from statsmodels.stats.diagnostic import acorr_ljungbox
from statsmodels.tsa.stattools import ccf

import rcorefine as rco
from rcorefine.comparison import (
    correlogram,
    free_run_tests,
    higher_order_correlation,
    input_correlation,
    model_error,
    whiteness,
)


@pytest.mark.parametrize("lags, fitted", [(1, 0), (10, 0), (25, 3)])
def test_whiteness_equals_statsmodels(lags, fitted):
    e = lfilter([1.0], [1.0, -0.3], np.random.default_rng(4).standard_normal(500))
    table = whiteness(e, lags, fitted=fitted)
    oracle = acorr_ljungbox(e, lags=[lags], model_df=fitted)
    assert table.statistic[0] == pytest.approx(float(oracle.lb_stat.iloc[0]), rel=1e-10)
    assert table.p_value[0] == pytest.approx(float(oracle.lb_pvalue.iloc[0]), rel=1e-10)


def test_whiteness_by_hand():
    # mean 0, r_1 = (-1 - 1 - 1)/4: Q = 4 * 6 * (9/16) / 3
    table = whiteness(np.array([1.0, -1.0, 1.0, -1.0] * 4), 1)
    r = -15 / 16
    assert table.statistic[0] == pytest.approx(16 * 18 * r**2 / 15)


def test_cross_correlation_equals_statsmodels_and_the_published_bound():
    rng = np.random.default_rng(2)
    u, e = rng.standard_normal((2, 400))
    found = correlogram(u, e, 20, probability=0.99)
    np.testing.assert_allclose(found.correlation[20:], ccf(e, u, adjusted=False)[:21], atol=1e-10)
    np.testing.assert_allclose(found.correlation[:21][::-1], ccf(u, e, adjusted=False)[:21], atol=1e-10)
    # white against white: 2.58 / sqrt(N), MATLAB's 99 % region
    assert found.bound[0] == pytest.approx(stats.norm.isf(0.005) / 20, rel=0.15)


def test_bound_widens_for_colored_signals():
    rng = np.random.default_rng(3)
    u, e = (lfilter([1.0], [1.0, -0.9], rng.standard_normal(20_000)) for _ in range(2))
    # sum over lags of 0.9^(2|k|) = (1 + 0.81) / (1 - 0.81)
    expected = stats.norm.isf(0.005) * np.sqrt((1.81 / 0.19) / 20_000)
    assert correlogram(u, e).bound[0] == pytest.approx(expected, rel=0.1)


def test_dynamics_and_feedback_are_told_apart():
    rng = np.random.default_rng(5)
    u, noise = rng.standard_normal((2, 3000))
    e = lfilter([1.0], [1.0, -0.8], noise)
    late = e + 0.3 * np.concatenate([np.zeros(4), u[:-4]])
    forward = input_correlation(late, u)
    assert [row.test for row in forward.failed()] == ["input"]
    follows = u + 0.3 * np.concatenate([np.zeros(3), e[:-3]])
    assert [row.test for row in input_correlation(e, follows).failed()] == ["feedback"]


@pytest.mark.parametrize(
    "make, hit",
    [
        (lambda u, y, e: e + 0.2 * (u**2 - 1), "u^2, e"),
        (lambda u, y, e: e * (1 + 0.5 * np.abs(u)), "u^2, e^2"),
        (lambda u, y, e: e * np.sqrt(0.2 + 0.8 * np.append(0.0, e[:-1] ** 2)), "|e|, |e|"),
    ],
)
def test_higher_orders_see_what_linear_correlations_do_not(make, hit):
    rng = np.random.default_rng(6)
    u, e = rng.standard_normal((2, 4000))
    residual = make(u, None, e)
    table = higher_order_correlation(residual, u)
    assert hit in [row.test for row in table.failed()]
    assert not input_correlation(residual, u).failed(1e-4)


def test_free_run_tests_see_offset_dynamics_nonlinearity_and_change():
    rng = np.random.default_rng(7)
    u, e = rng.standard_normal((2, 4000))
    noise = lfilter([1.0], [1.0, -0.9], e)
    assert not free_run_tests(noise, u).failed(0.001)
    cases = {
        "mean": noise + 5.0,
        "input": noise + 0.3 * lfilter([1.0], [1.0, -0.5], u),
        "size of the input": noise + 0.5 * np.abs(u),
        "steadiness": noise * np.where(np.arange(4000) > 3000, 2.0, 1.0),
    }
    for name, residual in cases.items():
        assert name in [row.test for row in free_run_tests(residual, u).failed()], name


def test_false_alarms_of_the_free_run_tests_stay_at_their_level():
    fails = 0
    for seed in range(60):
        rng = np.random.default_rng([seed, 11])
        u = lfilter([1.0], [1.0, -0.7], rng.standard_normal(1000))
        e = lfilter([1.0], [[1.0, -0.9], [1.0, -1.85, 0.95], [1.0]][seed % 3], rng.standard_normal(1000))
        fails += bool(free_run_tests(e, u).failed(0.05))
    assert fails <= stats.binom.ppf(0.999, 60, 0.05)


def test_bad_input():
    with pytest.raises(ct.ControlDimension, match="time last"):
        whiteness(np.ones((100, 2)))
    with pytest.raises(rco.DataError, match="not finite at sample 3"):
        whiteness(np.array([0, 1, 2, np.nan] * 20))
    with pytest.raises(rco.DataError, match="too few"):
        whiteness(np.arange(10.0), 20)
    with pytest.raises(ct.ControlDimension, match="over the same time"):
        input_correlation(np.ones(100), np.ones(90))
    with pytest.raises(ct.ControlArgument, match="fitted"):
        whiteness(np.random.default_rng(0).standard_normal(100), 5, fitted=5)


def test_table_reads_well():
    text = str(free_run_tests(np.random.default_rng(0).standard_normal(500), np.arange(500.0) % 7))
    assert max(map(len, text.splitlines())) <= 80
    assert "No test is significant" in text
    assert "<table>" in whiteness(np.random.default_rng(0).standard_normal(500))._repr_html_()


@pytest.mark.slow
def test_bands_cover_the_truth():
    """Measured response and model error model: 93 to 97 % of the points, over 200 seeds."""
    dt, n = 0.05, 8192
    true = ct.ss([[0, 1], [-20.0, -1.5]], [[0], [1.0]], [[1, 0]], 0, name="true")
    wrong = ct.ss([[0, 1], [-22.0, -1.2]], [[0], [1.0]], [[1, 0]], 0, name="wrong")
    covered = {"measured": [], "error": []}
    for seed in range(200):
        rng = np.random.default_rng([seed, 5])
        w = rng.standard_normal(n)
        y = rco.simulate(true, rco.Measurement(w, w, dt=dt), "zero").outputs
        e = lfilter([1.0], [1.0, -0.6], rng.standard_normal(n))
        data = rco.Measurement(w, y + 0.1 * y.std() * e / e.std(), dt=dt)
        found = model_error(rco.compare(wrong, data, x0="zero"), segment_length=512)
        z = np.exp(1j * found.omega * dt)
        sampled = [s.sample(dt) for s in (true, wrong)]
        G = [
            np.array([(s.C @ np.linalg.solve(p * np.eye(2) - s.A, s.B) + s.D)[0, 0] for p in z])
            for s in sampled
        ]
        inside = (found.omega > 0.5) & (found.omega < 55)
        covered["error"].append(
            np.mean((np.abs(found.error[0, 0] - (G[0] - G[1])) <= found.band[0, 0])[inside])
        )
        measured = data.frequency_response(segment_length=512)
        free = 2 * (measured.n_averages - 1)
        radius = measured.std[0, 0] * np.sqrt(2 * stats.f.ppf(0.95, 2, free))
        covered["measured"].append(np.mean((np.abs(measured.response[0, 0] - G[0]) <= radius)[inside]))
    for name, shares in covered.items():
        assert 0.93 <= np.mean(shares) <= 0.97, (name, np.mean(shares))
