"""Correlograms against statsmodels and the published bound; bands of the model error against the truth."""

from __future__ import annotations

import control as ct
import numpy as np
import pytest
from scipy import stats
from scipy.signal import lfilter
from statsmodels.tsa.stattools import ccf

import rcorefine as rco
from rcorefine import comparison


def test_cross_correlation_equals_statsmodels_and_the_published_bound():
    rng = np.random.default_rng(2)
    u, e = rng.standard_normal((2, 400))
    found = comparison.correlogram(u, e, 20, probability=0.99)
    np.testing.assert_allclose(found.correlation[20:], ccf(e, u, adjusted=False)[:21], atol=1e-10)
    np.testing.assert_allclose(found.correlation[:21][::-1], ccf(u, e, adjusted=False)[:21], atol=1e-10)
    # white against white: 2.58 / sqrt(N), MATLAB's 99 % region
    assert found.bound[0] == pytest.approx(stats.norm.isf(0.005) / 20, rel=0.15)


def test_bound_widens_for_colored_signals():
    rng = np.random.default_rng(3)
    u, e = (lfilter([1.0], [1.0, -0.9], rng.standard_normal(20_000)) for _ in range(2))
    # sum over lags of 0.9^(2|k|) = (1 + 0.81) / (1 - 0.81)
    expected = stats.norm.isf(0.005) * np.sqrt((1.81 / 0.19) / 20_000)
    assert comparison.correlogram(u, e).bound[0] == pytest.approx(expected, rel=0.1)


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
        found = comparison.model_error(rco.compare(wrong, data, x0="zero"), segment_length=512)
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
