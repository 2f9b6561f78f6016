"""Tests of a residual whose samples are not equally noisy: against statsmodels, chance, and whole records."""

from __future__ import annotations

import control as ct
import numpy as np
import pytest
import statsmodels.api as sm
from cases import slow, sweep
from hidden.generator import disturbed, fed_back, hidden_record
from inner import f_test, project, rank_basis
from scipy import stats
from scipy.signal import lfilter

import rcorefine as rco
from rcorefine.inference.f_tests import unequal_variances


def motion_of(rng, n, bursts):
    """Columns that a fault might show, and what was fitted."""
    w = lfilter([1.0], [1.0, -0.6], rng.standard_normal(n))
    if bursts:
        w = w * (np.arange(n) % (n // 5) < n // 25)
    y = lfilter([1.0], [1.0, -1.8, 0.9], w)
    y = y / y.std()
    columns = np.column_stack([y**3, y * np.abs(y), np.clip(y, -0.2, 0.2), np.abs(y), y**5, y**2])
    fitted = np.column_stack([y, np.gradient(y), np.ones(n), 0.95 ** np.arange(n)])
    return y, columns, rank_basis(fitted)


def test_box_on_the_jackknife_residuals_of_statsmodels():
    rng = np.random.default_rng(3)
    y, columns, basis = motion_of(rng, 400, bursts=True)
    e = (0.1 + np.abs(y)) * rng.standard_normal(400)
    influence = sm.OLS(e, np.hstack([basis, columns])).fit().get_influence()
    u = influence.resid / (1.0 - influence.hat_matrix_diag)
    q = np.linalg.qr(columns - basis @ (basis.T @ columns))[0]
    values = np.linalg.eigvalsh(sum(u[k] ** 2 * np.outer(q[k], q[k]) for k in range(400)))
    share = np.sum(q**2, axis=1)
    expected = stats.f.sf(
        np.sum((q.T @ e) ** 2) / values.sum(),
        values.sum() ** 2 / np.sum(values**2),
        share.sum() ** 2 / np.sum(share**2),
    )
    left = project(e, basis)
    assert unequal_variances(float(np.sum((q.T @ left) ** 2)), q, left, basis) == pytest.approx(expected)
    assert f_test("x", left, columns, basis).p_value == pytest.approx(expected)  # the F-test gives less


def test_one_column_is_the_hc3_test_of_statsmodels():
    rng = np.random.default_rng(4)
    x = rng.standard_normal((500, 1))
    e = np.abs(x[:, 0]) * rng.standard_normal(500) + 0.2 * x[:, 0]
    q = x / np.linalg.norm(x)
    found = unequal_variances(float(q[:, 0] @ e) ** 2, q, e, x[:, :0])
    t = sm.OLS(e, x).fit(cov_type="HC3").tvalues[0]
    assert found == pytest.approx(stats.f.sf(t**2, 1, np.sum(x**2) ** 2 / np.sum(x**4)))


@pytest.mark.parametrize("noise", ["reading", "spikes", "white", "t3"])
@pytest.mark.parametrize("bursts", [False, True])
def test_chance_fails_no_more_often_than_the_level(noise, bursts):
    rng = np.random.default_rng([11, bursts, len(noise)])
    failed = 0
    for _ in range(100):
        y, columns, basis = motion_of(rng, 600, bursts)
        left = project(disturbed(rng, noise, y[None], 0.05)[0] - y, basis)
        failed += f_test("x", left, columns, basis).p_value < 0.05
    assert failed <= stats.binom.ppf(0.999, 100, 0.05)


def test_a_fault_shows_in_unequal_noise():
    rng = np.random.default_rng(12)
    y, columns, basis = motion_of(rng, 1000, bursts=True)
    e = (0.02 + 0.05 * np.abs(y)) * rng.standard_normal(1000)
    assert f_test("x", project(e, basis), columns, basis).p_value > 1e-3
    for size in (0.05, 1.0, 1e3):  # also where it acts on few samples and is all that they show
        assert f_test("x", project(e + size * y**3, basis), columns, basis).p_value < 1e-6


UNEQUAL = (
    {"noise": 0.05, "noise_kind": "reading", "drive": "bursts"},
    {"noise": 0.05, "noise_kind": "reading"},
    {"noise_kind": "spikes", "plant": "quarter car"},
    {"noise_kind": "hum"},
    {"drive": "hammer", "plant": "RLC"},
)


@pytest.mark.parametrize(
    ("record", "seed"),
    sweep([(UNEQUAL[0], 301), (UNEQUAL[2], 301), (UNEQUAL[4], 302)], UNEQUAL, (301, 302)),
    ids=str,
)
def test_unequal_noise_is_nobodys_fault(record, seed):
    hidden = hidden_record(seed, effect=None, samples=1500, **record)
    assert rco.diagnose(hidden.plant.model, hidden.data).verdict == "adequate"


def held_loop(n=1500, feedthrough=0.0):
    """A held input u(k) = r(k) - y(k) / 2 on a lag, y with white noise."""
    rng = np.random.default_rng(21)
    model = ct.ss([[-1.0]], [[1.0]], [[1.0]], [[feedthrough]])
    plant = ct.c2d(model, 0.1)
    r, e = rng.standard_normal((2, n))
    u, y, x = np.zeros(n), np.zeros(n), 0.0
    for k in range(n):
        y[k] = (x + feedthrough * r[k] + 0.5 * e[k]) / (1.0 + 0.5 * feedthrough)
        u[k] = r[k] - 0.5 * y[k]
        x = plant.A[0, 0] * x + plant.B[0, 0] * u[k]
    return model, rco.Measurement(u, y, dt=0.1)


def test_under_direct_feedback_the_input_holds_the_noise_of_its_own_sample():
    model, data = held_loop()
    tests = {test.name: test for test in rco.diagnose(model, data).tests}
    assert tests["input"].dof == 40  # lags 1 to 40
    assert tests["input"].p_value > 1e-3


def test_what_can_act_at_once_is_tested_at_once():
    rng = np.random.default_rng(5)
    w = rng.standard_normal(1000)
    for hold, feedthrough, lags in (("zoh", 0.0, 40), ("zoh", 0.3, 41), ("foh", 0.0, 41)):
        model = ct.ss([[-1.0]], [[1.0]], [[1.0]], [[feedthrough]])
        blank = rco.Measurement(w, np.zeros(1000), dt=0.1, hold=hold)
        y = rco.simulate(model, blank, "zero").outputs[0] + 0.01 * rng.standard_normal(1000)
        found = rco.diagnose(model, rco.Measurement(w, y, dt=0.1, hold=hold))
        assert {test.name: test for test in found.tests}["input"].dof == lags


@pytest.mark.parametrize("seed", [401, *slow(402)])
def test_a_regulator_in_the_loop_is_no_effect(seed):
    hidden = fed_back(seed, unmeasured=0.0, samples=1500)
    assert rco.diagnose(hidden.plant.model, hidden.data).verdict == "adequate"
