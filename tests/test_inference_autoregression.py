"""The one autoregressive model: against known processes, statsmodels, and signals that break others."""

from __future__ import annotations

import numpy as np
import pytest
from inner import Whitener, stable_model
from scipy import stats
from scipy.linalg import solve_toeplitz
from scipy.signal import lfilter, lfiltic

from rcorefine.inference import whitening

PEAK = np.poly([0.99 * np.exp(0.3j), 0.99 * np.exp(-0.3j)]).real
THIRD = np.array([1.0, -1.2, 0.7, -0.2])


def process(a, n, rng):
    return lfilter([1.0], a, rng.standard_normal(n + 1000))[1000:]


def test_least_squares_is_that_of_statsmodels(rng):
    tsa = pytest.importorskip("statsmodels.tsa.ar_model")
    x = process(THIRD, 1500, rng)
    ours, variance = whitening.autoregression(x, order=3)
    theirs = tsa.AutoReg(x - x.mean(), lags=3, trend="n").fit()
    assert ours[1:] == pytest.approx(-theirs.params, rel=1e-9)
    assert variance == pytest.approx(theirs.sigma2, rel=1e-9)


def test_order_is_that_of_statsmodels(rng):
    selection = pytest.importorskip("statsmodels.tsa.ar_model").ar_select_order
    for n in (400, 900, 3000):
        x = process(THIRD, n, rng)
        chosen = selection(x - x.mean(), whitening.highest_order(n), ic="aic", trend="n").ar_lags
        assert whitening.autoregression(x)[0].size - 1 == (max(chosen) if chosen else 0)


def test_estimates_scatter_as_theory_says(rng):
    """For AR(p) the covariance of the estimate is sigma^2 / N times the inverse autocovariance."""
    n, runs = 1000, 200
    found = np.array([whitening.autoregression(process(THIRD, n, rng), order=3)[0][1:] for _ in range(runs)])
    impulse = lfilter([1.0], THIRD, np.eye(1, 400)[0])
    autocovariance = np.array([impulse[: 400 - k] @ impulse[k:] for k in range(3)])
    covariance = np.linalg.inv(autocovariance[np.abs(np.subtract.outer(range(3), range(3)))]) / n
    distance = np.einsum("ki,ij,kj->k", found - THIRD[1:], np.linalg.inv(covariance), found - THIRD[1:])
    assert stats.kstest(distance, stats.chi2(3).cdf).pvalue > 1e-3


def test_white_noise_stays_white_in_three_of_four_records(rng):
    """Akaike's criterion takes a lag too many in about 29 % of long records (Shibata 1976)."""
    orders = [whitening.autoregression(rng.standard_normal(2000))[0].size - 1 for _ in range(300)]
    zero = np.mean(np.array(orders) == 0)
    # probability that no partial sum of (chi2_1 - 2) is positive, over 20 lags
    walk = np.cumsum(rng.chisquare(1, (20000, whitening.MAX_ORDER)) - 2, axis=1)
    expected = np.mean(walk.max(axis=1) < 0)
    assert abs(zero - expected) < 4 * np.sqrt(expected * (1 - expected) / 300)


def test_a_sharp_peak_is_not_smeared(rng):
    """Yule and Walker's sample covariances leave several times its innovation in a short record."""
    errors, smeared = [], []
    for _ in range(30):
        x = process(PEAK, 300, rng)
        errors.append(whitening.autoregression(x, order=2)[1])
        covariance = np.array([x[: 300 - k] @ x[k:] / 300 for k in range(3)])
        smeared.append(covariance[0] - covariance[1:] @ solve_toeplitz(covariance[:2], covariance[1:]))
    assert abs(np.mean(errors) - 1) < 4 * np.sqrt(2 / 300 / 30) + 0.02
    assert np.mean(smeared) > 1.5


def test_missing_samples_count_for_nothing(rng):
    x = process(THIRD, 4000, rng)
    known = np.ones(4000, dtype=bool)
    known[500:700] = known[2000:2010] = False
    wild = np.where(known, x, 1e6)
    hole = np.where(known, x, 0.0)
    a, variance = whitening.autoregression(wild, order=3, known=known)
    assert a == pytest.approx(whitening.autoregression(hole, order=3, known=known)[0], abs=1e-9)
    assert a == pytest.approx(THIRD, abs=5 / np.sqrt(3700))
    assert variance == pytest.approx(1.0, abs=5 * np.sqrt(2 / 3700))


@pytest.mark.parametrize("scale", [1e-120, 1e-9, 1.0, 1e12, 1e120])
def test_units_do_not_matter(rng, scale):
    x = process(THIRD, 800, rng)
    a, variance = whitening.autoregression(x)
    scaled, power = whitening.autoregression(scale * x)
    assert scaled == pytest.approx(a, rel=1e-9)
    assert power / scale / scale == pytest.approx(variance, rel=1e-9)


def test_drift_and_a_deterministic_signal_leave_little(rng):
    e = rng.standard_normal(4000)
    assert whitening.autoregression(1e3 * np.cumsum(np.cumsum(e)) + e)[1] == pytest.approx(1e6, rel=0.06)
    assert whitening.autoregression(np.sin(0.1 * np.arange(4000)))[1] < 1e-11


@pytest.mark.parametrize("signal", [np.zeros(100), np.full(100, 3.0), np.ones(1), np.arange(5.0)])
def test_what_has_no_color_is_white(signal):
    a, variance = whitening.autoregression(signal)
    assert a == pytest.approx([1.0])
    assert variance == pytest.approx(np.var(signal), abs=1e-20)


def test_a_stable_model_has_the_same_spectrum():
    a = np.poly([1.25, 0.5, 1.1 * np.exp(0.4j), 1.1 * np.exp(-0.4j)]).real
    b, variance = stable_model(a, 2.0)
    assert np.abs(np.roots(b)).max() < 1
    z = np.exp(1j * np.linspace(0.1, 3.0, 20))
    assert variance / np.abs(np.polyval(b, z)) ** 2 == pytest.approx(2.0 / np.abs(np.polyval(a, z)) ** 2)
    assert stable_model(THIRD, 2.0)[0] is THIRD


# -------------------------------------------------------------------- whitening
def test_a_filter_undoes_the_process(rng):
    e = rng.standard_normal(500)
    x = lfilter([1.0], THIRD, e)
    assert whitening.innovations(THIRD, x) == pytest.approx(e)
    both = np.column_stack([x, 2 * x])
    assert whitening.innovations(THIRD, both)[:, 1] == pytest.approx(2 * e)
    later, _ = lfilter(THIRD, [1.0], x[100:], zi=lfiltic(THIRD, [1.0], [], x[99::-1]))
    assert whitening.innovations(THIRD, x)[100:] == pytest.approx(later)


def test_whitened_residuals_are_white_and_of_unit_variance(rng):
    white = []
    for _ in range(40):
        x = process(PEAK, 1000, rng)
        r = Whitener.fit([x[None]]).apply([x[None]])
        white.append(
            [r.std() - 1, *(np.sqrt(r.size) * np.corrcoef(r[lag:], r[:-lag])[0, 1] for lag in (1, 2, 7))]
        )
        a, variance = whitening.autoregression(x)
        e = whitening.innovations(a, x - x.mean())[a.size - 1 :]
        assert e.std() == pytest.approx(np.sqrt(variance), rel=0.02)
    white = np.array(white)
    assert np.abs(white[:, 0]).max() < 0.02
    assert np.all(np.abs(white[:, 1:].mean(axis=0)) < 4 / np.sqrt(40))
    assert np.all(white[:, 1:].std(axis=0) < 1.3)


def test_generalized_least_squares_is_that_of_the_noise_covariance(rng):
    """Rows whitened by the true filter give the estimate of Aitken's theorem, but for the first samples."""
    n = 60
    a = np.array([1.0, -0.6])
    impulse = lfilter([1.0], a, np.eye(1, n)[0])
    L = np.array([np.concatenate([np.zeros(k), impulse[: n - k]]) for k in range(n)]).T
    columns = rng.standard_normal((n, 2))
    columns[0] = 0.0
    y = columns @ [1.0, 2.0] + L @ np.append(0.0, rng.standard_normal(n - 1))
    whitener = Whitener((a,), np.ones(1))
    ours = np.linalg.lstsq(whitener.apply([columns[None]]), whitener.apply([y[None]]), rcond=None)[0]
    inverse = np.linalg.inv(L @ L.T)
    theirs = np.linalg.solve(columns.T @ inverse @ columns, columns.T @ inverse @ y)
    assert ours == pytest.approx(theirs, rel=1e-9)


def test_each_output_and_record_keeps_its_rows(rng):
    whitener = Whitener((np.array([1.0, -0.5]), np.array([1.0, 0.0, 0.25])), np.array([2.0, 4.0]))
    blocks = [rng.standard_normal((2, 30)), rng.standard_normal((2, 20))]
    rows = whitener.apply(blocks)
    outputs = whitener.outputs(blocks)
    assert rows.size == outputs.size == 29 + 28 + 19 + 18
    assert rows[0] == pytest.approx((blocks[0][0, 1] - 0.5 * blocks[0][0, 0]) / 2)
    last = blocks[1][1]
    assert rows[-1] == pytest.approx((last[-1] + 0.25 * last[-3]) / 4)
    assert whitener.orders == (1, 2)
    assert whitener.log_likelihood(blocks) == pytest.approx(-50 * np.log(8))
