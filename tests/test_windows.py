"""One rule for the windows in which a model runs free: compare, refine, diagnose and improve agree."""

from __future__ import annotations

import control as ct
import numpy as np
import pytest
from scipy.signal import cont2discrete, dlsim

import rcorefine as rco
from rcorefine import DataError, Effect, Measurement

STEP, N = 0.01, 1500


def servo(inertia=0.02, drag=0.05) -> ct.StateSpace:
    A, B = [[0, 1], [0, -drag / inertia]], [[0], [0.3 / inertia]]
    return ct.ss(
        A, B, [[1, 0]], 0, inputs="voltage", outputs="angle", states=["angle", "speed"], name="servo"
    )


def record(system=None, seed=7, n=N, noise=0.01):
    """A servo in voltage steps, by exact propagation."""
    rng = np.random.default_rng(seed)
    w = np.repeat(rng.uniform(-6, 6, n // 25 + 1), 25)[:n] + 0.3 * rng.standard_normal(n)
    y = ct.forced_response((system or servo()).sample(STEP), U=w, X0=[0.4, 0.0]).outputs
    y = y + noise * y.std() * rng.standard_normal(n)
    return Measurement(w, y, dt=STEP, input_labels="voltage", output_labels="angle", name="run 3")


def test_fits_of_compare_refine_and_diagnose_are_the_same_on_an_integrating_model():
    data, light = record(), servo(drag=0.055)
    shown = rco.compare(light, data)
    bent = rco.refine(light, data, [Effect("damping", "angle")])
    assert len(shown.starts) == bent.initial_states.shape[0] == 10
    np.testing.assert_allclose(shown.fit, bent.initial_fit, atol=1e-6)
    found = rco.diagnose(light, data, candidates=[Effect("damping", "angle")], validation=data)
    np.testing.assert_allclose(rco.compare(found.base, data).fit, found.base.fit, atol=1e-3)
    row = found.best
    assert row is not None
    assert row.fit_before == pytest.approx(rco.compare(found.base, data).fit[0], abs=1e-6)
    assert row.fit_after == pytest.approx(row.refinement.fit[0], abs=1e-3)


def test_a_short_record_of_an_integrating_model_can_be_diagnosed():
    laws = [Effect(kind, "angle") for kind in ("damping", "coulomb_friction", "quadratic_damping")]
    assert rco.diagnose(servo(), record(), candidates=laws).verdict == "adequate"
    found = rco.diagnose(servo(), record(servo(drag=0.07)), candidates=laws)
    assert found.verdict == "effect"
    assert found.best.effect.kind == "damping"
    with pytest.raises(DataError, match="'run 3' of 30 samples.*at least 36"):
        rco.diagnose(servo(), record(n=30))


def test_a_horizon_means_the_same_everywhere():
    data, law = record(servo(drag=0.07)), Effect("damping", "angle")
    with_law = rco.refine(servo(), data, [law], horizon=2.6)
    found = rco.diagnose(servo(), data, candidates=[law], horizon=2.6)
    ladder = rco.improve(servo(), data, candidates=[law], validation=data, horizon=2.6)
    shown = rco.compare(servo(), data, horizon=2.6)
    for windows in (with_law, found.base, found.refine(), ladder.refinement):
        assert windows.initial_states.shape[0] == len(shown.starts) == 6
    np.testing.assert_allclose(rco.compare(with_law, data, horizon=2.6).fit, with_law.fit, atol=1e-3)
    np.testing.assert_allclose(
        rco.compare(ladder.refinement, data, horizon=2.6).rmse, ladder.steps[-1].validation_rmse, rtol=1e-9
    )
    for call in (rco.compare, rco.refine, rco.diagnose, rco.improve):
        with pytest.raises(ct.ControlArgument, match="time in seconds"):
            call(servo(), data, horizon="long")
        with pytest.raises(DataError, match=r"horizon = 0.02 s holds 2 samples"):
            call(servo(), data, horizon=0.02)


def test_a_given_start_and_a_sampled_integrator():
    data, sampled = record(), servo().sample(STEP)
    np.testing.assert_allclose(rco.compare(sampled, data).fit, rco.compare(servo(), data).fit, atol=1e-6)
    assert rco.compare(servo(), data, x0=[0.4, 0.0]).starts == (0,)
    assert rco.compare(servo(), data, x0="zero").starts == (0,)
    with pytest.raises(ct.ControlArgument, match="one start only"):
        rco.compare(servo(), data, x0="zero", horizon=1.0)


def test_windows_may_be_shorter_than_the_lags_of_the_tests():
    found = rco.diagnose(servo(), record(), candidates=[Effect("damping", "angle")], horizon=0.25)
    assert found.verdict == "adequate"


@pytest.mark.parametrize("seed", [0, 2])
def test_a_gain_of_a_triple_integrator_is_not_lost_in_windows(seed):
    """The free initial state of each window takes it up; over the whole record least squares give 1 %."""
    A, B, C = np.diag([1.0, 1.0], 1), np.eye(3)[:, 2:], np.eye(3)[:1]
    rng = np.random.default_rng(seed)
    w, t = rng.standard_normal(2000), 0.05 * np.arange(2000)
    y0 = dlsim((*cont2discrete((A, B, C, np.zeros((1, 1))), 0.05)[:4], 0.05), w)[1][:, 0]
    y = 1.2 * y0 + 0.002 * y0.std() * rng.standard_normal(w.size)
    by = np.column_stack([y0, np.ones(t.size), t, t**2])
    gain = np.linalg.lstsq(by, y, rcond=None)[0][0]
    std = 0.0024 * y0.std() * np.sqrt(np.linalg.inv(by.T @ by)[0, 0])
    assert abs(gain - 1.2) < 4 * std < 0.02
    model = ct.ss(A, B, C, 0, states=["a", "b", "c"], inputs="u", outputs="y")
    data = rco.Measurement(w, y, dt=0.05, input_labels="u", output_labels="y")
    found = rco.diagnose(model, data)
    system = found.refine().system
    product = system.A[0, 1] * system.A[1, 2] * system.B[2, 0] * system.C[0, 0]
    assert abs(product - gain) < 4 * std + 0.002
    said = " ".join(str(rco.check(model, data)).split())
    assert "The record would not show these" not in said
