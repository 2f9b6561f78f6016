"""Unstable plants under a controller: judged one sample ahead, and named, refined, compared as others are."""

from __future__ import annotations

import control as ct
import numpy as np
import pytest
from cases import slow
from inner import LinearModel, Structure

import rcorefine as rco
from rcorefine.engine.controlled import runs_away
from rcorefine.engine.observer import leading_gain

MASS = np.array([[1.2, 0.1], [0.1, 0.05]])
DAMPING, STIFFNESS = np.diag([0.3, 0.01]), np.diag([0.0, -0.981])
CART = rco.mechanical(MASS, DAMPING, STIFFNESS, inputs="force", outputs=["x", "angle"])
GAINS = ct.lqr(CART.system.A, CART.system.B, np.diag([10, 10, 1, 1]), [[0.1]])[0][0]
LAWS = {
    "nothing": lambda v: 0.0,
    "dry": lambda v: 0.5 * np.tanh(v / 1e-3),
    "drag": lambda v: 2.0 * v * abs(v),
}


def under_control(seed, law, samples=1500, dt=0.01, parts=12):
    """Upright under state feedback from noisy sensors, by Runge and Kutta."""
    rng, force = np.random.default_rng([seed, 15]), LAWS[law]
    A, B, h = CART.system.A, CART.system.B[:, 0], dt / parts
    x, seen, rate = np.zeros(4), np.zeros(2), np.zeros(2)
    wanted = np.repeat(0.3 * rng.standard_normal(samples // 100 + 1), 100)
    u, y = np.zeros(samples), np.zeros((2, samples))

    def slope(x, u):
        return A @ x + B * (u - force(x[2]))

    for k in range(samples):
        y[:, k] = x[:2] + 0.001 * rng.standard_normal(2)
        rate = 0.7 * rate + 0.3 * (y[:, k] - seen) / dt if k else rate
        seen = y[:, k]
        u[k] = -GAINS @ (np.r_[seen, rate] - [wanted[k], 0, 0, 0])
        for _ in range(parts):
            a = slope(x, u[k])
            b = slope(x + h / 2 * a, u[k])
            c = slope(x + h / 2 * b, u[k])
            x = x + h / 6 * (a + 2 * b + 2 * c + slope(x + h * c, u[k]))
    return rco.Measurement(u, y, dt=dt, input_labels="force", output_labels=["x", "angle"])


def test_a_right_model_leaves_the_noise():
    data = under_control(0, "nothing")
    result = rco.compare(CART, data)
    assert result.led
    assert "Predicted one sample ahead" in str(result)
    assert "has no free run" in str(result)
    np.testing.assert_allclose(result.rmse, 0.001, rtol=0.1)
    assert "one-step predictions" in str(rco.check(CART, data, information=False))
    short = rco.compare(CART, data, horizon=0.3)
    assert not short.led
    assert len(short.starts) == 50


def test_what_is_asked_to_run_freely_does():
    with pytest.raises(rco.DivergenceError):
        rco.simulate(CART, under_control(0, "dry", samples=3000), "zero")


@pytest.mark.parametrize(
    ("law", "verdict"), [("nothing", "adequate"), ("dry", "effect"), *slow(("drag", "effect"))]
)
def test_the_verdict(law, verdict):
    found = rco.diagnose(CART, under_control(1, law))
    assert found.verdict == verdict
    if law != "nothing":
        kind = {"dry": "coulomb_friction", "drag": "quadratic_damping"}[law]
        assert found.best.effect == rco.Effect(kind, "mass1")
        assert found.refine().led
        assert "The prediction explains" in str(found.refine())


@pytest.mark.parametrize(
    ("law", "kind", "true"), [("dry", "coulomb_friction", 0.5), ("drag", "quadratic_damping", 2.0)]
)
def test_feedback_leaves_estimates_without_bias(law, kind, true):
    z = []
    for seed in range(6):
        row = rco.refine(CART, under_control(100 + seed, law), [rco.Effect(kind, "mass1")]).parameters[0]
        z.append((row.value - true) / row.std)
    # six independent normal numbers: mean and size at one in a thousand
    assert abs(np.mean(z)) < 3.3 / np.sqrt(6)
    assert np.sum(np.square(z)) < 22.5


def test_the_error_falls_on_a_part_that_took_part_in_nothing():
    laws = [rco.Effect(kind, "mass1") for kind in ("damping", "coulomb_friction", "cubic_damping")]
    ladder = rco.improve(CART, under_control(2, "dry", samples=2500), candidates=laws)
    assert [step.effect.kind for step in ladder.steps[1:]] == ["coulomb_friction"]
    assert (ladder.steps[-1].validation_rmse < 0.5 * ladder.steps[0].validation_rmse).all()


def test_only_what_runs_away_is_led():
    data = under_control(0, "nothing", samples=300)
    slow = LinearModel.from_statespace(ct.ss([[0.5]], [[1.0]], [[1.0]], 0))
    assert not runs_away(slow, data)  # e^1.5 over 3 s
    assert runs_away(slow, under_control(0, "nothing", samples=700))
    assert not runs_away(LinearModel.from_statespace(ct.ss([[0, 1], [0, 0]], [[0], [1]], [[1, 0]], 0)), data)
    stable = rco.mass_spring_damper(1.0, 0.5, 20.0)
    assert leading_gain(Structure(stable), data) is None


def test_the_gain_keeps_the_model_on_the_record():
    data = under_control(0, "nothing", samples=1000)
    gain = leading_gain(Structure(CART), data)
    step = CART.system.sample(data.dt)
    inner = step.A @ (np.eye(4) - gain @ step.C)
    assert np.abs(np.linalg.eigvals(inner)).max() < 1
    assert np.abs(np.linalg.eigvals(step.A)).max() > 1


def test_following_the_record_is_not_called_adequate(tmp_path):
    result = rco.compare(CART, under_control(3, "dry"))
    assert (len(result.failures), result.failures.looked) == (0, ())
    page = result.report(tmp_path / "report.html").read_text()
    assert "does not show that an unstable model is adequate" in page
    assert "No significant failure" not in str(result.failures)
    result.plot("horizon")
