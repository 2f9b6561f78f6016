"""Coefficients of a fleet: pooled as statsmodels pools them, false claims at their level, truths found."""

from __future__ import annotations

import numpy as np
import pytest
import statsmodels.api as sm
from cases import sweep
from scipy import stats
from statsmodels.stats.meta_analysis import combine_effects

import rcorefine as rco
from rcorefine.fleet import comparison, pooling

KIND, PLACE = "coulomb_friction", "link1"


@pytest.mark.parametrize("spread", [0.0, 0.5])
def test_pooling_is_that_of_a_meta_analysis(rng, spread):
    """DerSimonian and Laird's variance, Hartung and Knapp's error, Cochran's Q: statsmodels has them too."""
    variances = rng.uniform(0.05, 0.3, 9)
    values = 1.0 + spread * rng.standard_normal(9) + np.sqrt(variances) * rng.standard_normal(9)
    found = pooling.pool(values, variances)
    with np.errstate(invalid="ignore"):  # it takes the root of a negative variance
        oracle = combine_effects(values, variances, method_re="dl", use_t=True)
    assert found.spread**2 == pytest.approx(max(oracle.tau2, 0.0), abs=1e-12)
    if found.spread:
        assert found.mean == pytest.approx(oracle.mean_effect_re)
        plain, corrected = oracle.sd_eff_w_re, oracle.sd_eff_w_re_hksj
        assert found.std == pytest.approx(max(plain, corrected))
    assert found.p_alike == pytest.approx(stats.chi2.sf(oracle.q, 8))
    assert found.p_value == pytest.approx(2 * stats.t.sf(abs(found.mean) / found.std, 8))


def test_partial_pooling_in_closed_form():
    """Of equal errors, each machine keeps the share spread^2 / (spread^2 + error^2) of its difference."""
    values, variances = np.array([0.0, 1.0, 2.0, 5.0]), np.full(4, 0.25)
    common = pooling.pool(values, variances)
    assert common.spread**2 == pytest.approx(np.var(values, ddof=1) - 0.25)
    drawn, _ = pooling.shrunk(values, variances, common)
    share = common.spread**2 / (common.spread**2 + 0.25)
    np.testing.assert_allclose(drawn, 2.0 + share * (values - 2.0))
    alike = pooling.pool(np.array([1.0, 1.1, 0.9, 1.0]), variances)
    np.testing.assert_allclose(pooling.shrunk(values, variances, alike)[0], alike.mean)


def test_a_machine_against_the_others_is_a_studentized_residual(rng):
    """Without errors of its own, the deviation is the externally studentized residual of the mean."""
    values = rng.standard_normal(8)
    away, p_values = pooling.deviations(values, np.full(8, 1e-12), np.ones(8, dtype=bool))
    influence = sm.OLS(values, np.ones(8)).fit().get_influence()
    np.testing.assert_allclose(away, influence.resid_studentized_external, rtol=1e-5)
    np.testing.assert_allclose(p_values, 2 * stats.t.sf(np.abs(away), 6), rtol=1e-5)


@pytest.mark.parametrize(
    ("spread", "count"), sweep([(0.0, 4), (30.0, 6), (1.0, 12)], (0.0, 1.0, 30.0), (4, 6, 12, 40))
)
def test_nobody_stands_out_in_a_normal_fleet(rng, count, spread):
    """The rate of fleets in which any does, at 5 %, stays below its bound (99.9 %)."""
    runs, hits = 600, 0
    for _ in range(runs):
        variances = rng.uniform(0.5, 1.5, count) ** 2
        values = spread * rng.standard_normal(count) + np.sqrt(variances) * rng.standard_normal(count)
        hits += pooling.standing_out(values, variances, 0.05).any()
    assert hits <= stats.binom.ppf(0.999, runs, 0.05)


def test_two_that_stand_out_do_not_hide_each_other(rng):
    for _ in range(50):
        variances = np.full(12, 0.1**2)
        values = 1.0 + 0.1 * rng.standard_normal(12) + 0.1 * rng.standard_normal(12)
        values[[2, 7]] += 3.0
        assert np.flatnonzero(pooling.standing_out(values, variances, 0.01)).tolist() == [2, 7]


def test_slopes_are_those_of_an_analysis_of_covariance(rng):
    """A line of its own for each machine and one scale for all: weighted least squares of statsmodels."""
    courses, design, y, weights = [], [], [], []
    for k, count in enumerate((4, 6, 5)):
        times, variances = np.arange(count) + rng.uniform(0, 0.5, count), rng.uniform(0.01, 0.02, count)
        values = 1.0 + 0.3 * k * times + 0.4 * rng.standard_normal(count)
        courses.append((times, values, variances))
        for t, value, v in zip(times, values, variances, strict=True):
            row = np.zeros(6)
            row[2 * k : 2 * k + 2] = 1.0, t
            design.append(row)
            y.append(value)
            weights.append(1 / v)
    fit = sm.WLS(y, np.array(design), weights=weights).fit()
    assert fit.scale > 1
    slope, std, p_values = pooling.slopes(courses)
    np.testing.assert_allclose(slope, fit.params[1::2])
    np.testing.assert_allclose(std, fit.bse[1::2])
    np.testing.assert_allclose(p_values, fit.pvalues[1::2])


def rows_of(values, std=0.1, starts=None, kind=KIND):
    """Rows of a fleet from (machine, record) estimates."""
    return [
        comparison.SurveyRow(
            f"m{i}", f"r{j}", j, 0.0 if starts is None else starts[j], "effect", kind, PLACE, value, std, "N",
            estimates=(comparison.Estimate(kind, PLACE, "force", float(value), std, "N"),),
            effects=(rco.Effect(kind, PLACE),),
        )
        for i, mine in enumerate(values)
        for j, value in enumerate(mine)
    ]  # fmt: skip


def test_what_grows_and_nothing_else(rng):
    """One machine of eight whose coefficient grows by half its error a record, over ten records."""
    found = 0
    for _ in range(100):
        values = 1.0 + 0.2 * rng.standard_normal((8, 1)) + 0.1 * rng.standard_normal((8, 10))
        values[3] += 0.05 * np.arange(10)
        grows = [trend.machine for trend in comparison.trends(rows_of(values), 0.01) if trend.grows]
        found += grows == ["m3"]
    # the slope is known to 0.1 / sqrt(82.5): 4.5 standard deviations, and 8 tests at 0.01 need 3.4
    assert found >= stats.binom.ppf(0.001, 100, stats.norm.sf(3.4 - 4.5) - 0.01)


def test_nothing_grows_where_nothing_does(rng):
    """Also where records scatter more than their errors say."""
    hits = 0
    for k in range(400):
        values = 1.0 + (0.1 + 0.2 * (k % 2)) * rng.standard_normal((6, 4))
        hits += any(trend.grows for trend in comparison.trends(rows_of(values), 0.05))
    assert hits <= stats.binom.ppf(0.999, 400, 0.05)


def test_common_own_and_unclear(rng):
    everywhere = rows_of(2.0 + 0.1 * rng.standard_normal((8, 2)))
    nowhere = rows_of(0.1 * rng.standard_normal((8, 2)), kind="quadratic_damping")
    one = 0.1 * rng.standard_normal((8, 2))
    one[5] += 4.0
    rows = [*everywhere, *nowhere, *rows_of(one, kind="stiffness")]
    found = {effect.kind: effect for effect in comparison.fleet_effects(rows, 0.01)}
    assert {kind: effect.sort for kind, effect in found.items()} == {
        KIND: "common", "stiffness": "own", "quadratic_damping": "unclear",
    }  # fmt: skip
    assert [machine.machine for machine in found["stiffness"].standing_out] == ["m5"]
    assert found["stiffness"].mean == pytest.approx(0.0, abs=0.15)
    assert found[KIND].mean == pytest.approx(2.0, abs=4 * found[KIND].std)


def test_three_machines_cannot_tell_who_stands_out():
    """Nobody is named, and no deviation is given."""
    [effect] = comparison.fleet_effects(rows_of([[1.0], [1.0], [9.0]]), 0.01)
    assert not effect.standing_out
    assert [machine.deviation for machine in effect.machines] == [None] * 3


def test_time_is_that_of_the_records_where_they_have_one():
    """Records that begin at 0, 10, 30 s have slopes per second; those that all begin at 0 per record."""
    values = [[1.0, 2.0, 4.0]]
    [clock] = comparison.trends(rows_of(values, starts=[0.0, 10.0, 30.0]), 0.01)
    assert (clock.per, clock.slope) == ("s", pytest.approx(0.1))
    [counted] = comparison.trends(rows_of(values), 0.01)
    assert counted.per == "record"
