"""Delays in records that begin in motion or at rest: what was before the first sample is not known."""

from __future__ import annotations

import control as ct
import numpy as np
import pytest
from cases import named, slow, sweep
from inner import Engine, Problem, Structure
from scipy.signal import cont2discrete, lfilter

import rcorefine as rco

PLANTS = {
    "heater": (np.array([[-0.9]]), np.array([[0.5]]), np.array([[1.0]]), 0.08),
    "tanks": (np.array([[-0.8, 0], [0.8, -1.7]]), np.array([[1.0], [0]]), np.eye(2)[1:], 0.1),
    "mass": (np.array([[0, 1.0], [-60.0, -1.1]]), np.array([[0], [1.0]]), np.eye(2)[:1], 0.04),
}  # fmt: skip


def delayed(seed, plant, samples, *, at_output=False, before=200, noise=0.005, n=900):
    """A record that was cut out of a longer one; with before=0 it begins at rest with a step."""
    rng = np.random.default_rng([seed, 17])
    A, B, C, dt = PLANTS[plant]
    w = lfilter([1.0], [1.0, -0.5], rng.standard_normal((1, n + before)))
    past = np.zeros((1, samples))
    w = w + (2.0 if before == 0 else 0.0)
    drive = w if at_output else np.hstack([past, w])[:, : w.shape[1]]
    Ad, Bd, *_ = cont2discrete((A, B, C, np.zeros((1, 1))), dt, "zoh")
    x, y = np.zeros((len(A), 1)), np.zeros_like(w)
    for k in range(w.shape[1]):
        y[:, k] = (C @ x)[:, 0]
        x = Ad @ x + Bd @ drive[:, k : k + 1]
    if at_output:
        y = np.hstack([past, y])[:, : w.shape[1]]
    y = y + noise * y.std() * rng.standard_normal(y.shape)
    model = ct.ss(A, B, C, np.zeros((1, 1)), inputs=["u"], outputs=["y"])
    data = rco.Measurement(w[:, before:], y[:, before:], dt=dt, input_labels="u", output_labels="y")
    effect = rco.Effect("output_delay", "y") if at_output else rco.Effect("input_delay", "u")
    return model, data, effect


def estimate(refined):
    row = next(p for p in refined.parameters if p.kind.endswith("_delay"))
    return row.value, row.std


#: Delay of each plant in samples.
SAMPLES = {"heater": 6, "tanks": 5, "mass": 9}


@pytest.mark.parametrize(
    ("plant", "at_output", "before"),
    sweep(
        [("heater", False, 200), ("tanks", True, 0), ("mass", True, 200), ("mass", False, 0)],
        SAMPLES,
        (False, True),
        (200, 0),
    ),
)
def test_delay_is_found_and_then_nothing_is_missing(plant, at_output, before):
    samples = SAMPLES[plant]
    model, data, effect = delayed(3, plant, samples, at_output=at_output, before=before)
    refined = rco.refine(model, data, [effect])
    value, std = estimate(refined)
    assert abs(value - samples * data.dt) < 4 * std
    assert std < 0.01 * data.dt
    assert rco.diagnose(refined, data).verdict == "adequate"
    compared = rco.compare(refined, data)
    assert compared.data.n_samples == data.n_samples - samples
    assert compared.fit[0] == pytest.approx(99.5, abs=0.15)  # 0.5 % noise
    assert np.abs(compared.residual[:, :20]).max() < 6 * compared.rmse[0]
    assert f"first {samples} sample(s) are not compared" in str(compared)


def test_diagnose_says_delay_and_no_more():
    model, data, effect = delayed(4, "heater", 7)
    found = rco.diagnose(model, data)
    named(found, effect, 7 * data.dt)
    assert {e.kind for e in found.ambiguous} <= {"input_delay", "output_delay"}


@pytest.mark.parametrize("at_output", [False, True])
def test_windows_that_start_anew_each_lose_one_delay(at_output):
    model, data, effect = delayed(5, "heater", 6, at_output=at_output)
    refined = rco.refine(model, data, [effect], horizon=6.0)
    value, std = estimate(refined)
    assert abs(value - 6 * data.dt) < 4 * std
    compared = rco.compare(refined, data, horizon=6.0)
    assert len(compared.starts) == 12
    assert compared.fit[0] == pytest.approx(99.5, abs=0.15)


def test_rest_means_that_nothing_acted_before():
    model, data, effect = delayed(6, "tanks", 8, before=0)
    refined = rco.refine(model, data, [effect], x0="zero")
    value, std = estimate(refined)
    assert abs(value - 8 * data.dt) < 4 * std
    compared = rco.compare(refined, data, x0="zero")
    assert compared.data.n_samples == data.n_samples
    assert compared.fit[0] == pytest.approx(99.5, abs=0.15)


@pytest.mark.parametrize("hold", ["zoh", "foh"])
def test_delayed_step_from_rest_in_closed_form(hold):
    model = ct.ss([[-2.0]], [[2.0]], [[1.0]], [[0.0]], inputs=["u"], outputs=["y"])
    data = rco.Measurement(np.ones(100), np.zeros(100), dt=0.05, hold=hold, input_labels="u")
    structure = Structure(model, [rco.Effect("input_delay", "u")])
    y = Engine(structure, data, initial=np.zeros(1)).run(np.array([0.35]), sensitivity=False).outputs[0]
    t = data.timepts - 0.35
    exact = np.where(t > 0, 1 - np.exp(-2 * t), 0.0)
    if hold == "foh":  # a straight line from zero over the sample before
        s = t + 0.05
        ramp = (s - (1 - np.exp(-2 * s)) / 2) / 0.05
        exact = np.where(
            t > 0, 1 - np.exp(-2 * t) * (1 - ramp[np.argmin(np.abs(t))]), np.maximum(ramp, 0) * (s > 0)
        )
    np.testing.assert_allclose(y, exact, atol=1e-12)


def test_a_delay_gains_nothing_by_what_it_hides():
    rng = np.random.default_rng(7)
    model = ct.ss([[-1.0]], [[1.0]], [[1.0]], [[0.0]], inputs=["u"], outputs=["y"])
    data = rco.Measurement(1e-9 * rng.standard_normal(400), np.sign(rng.standard_normal(400)), dt=0.1)
    structure = Structure(model, [rco.Effect("input_delay", "u")])
    problem = Problem(structure, [data], np.ones(1))
    costs = [problem.cost(problem.pack(np.array([d]), np.zeros((1, 1)))) for d in (0.0, 1.0, 10.0, 90.0)]
    np.testing.assert_allclose(costs, 200.0, rtol=1e-6)


@pytest.mark.parametrize(("late", "tau"), [(30, 12.0), (0.55, 5.0), *slow((3, 12.0))])
def test_a_dead_time_of_one_path_is_found_under_both_names(rng, late, tau):
    """Through one input and one output of a linear plant it acts alike at either end."""
    n, before = 240, 200
    u = np.repeat(rng.uniform(-1, 1, (n + before) // 8), 8)
    y, whole, part = np.zeros(u.size), int(late), late % 1.0
    kept, rest = np.exp(-1 / tau), np.exp(-(1 - part) / tau)  # in a sample, and after its edge
    for k in range(1, u.size):
        before_edge, after = u[max(k - 2 - whole, 0)], u[max(k - 1 - whole, 0)]
        y[k] = kept * y[k - 1] + 2.0 * ((rest - kept) * before_edge + (1 - rest) * after)
    y, u = y[before:], u[before:]
    model = ct.ss([[-1 / tau]], [[2 / tau]], [[1]], 0, inputs="heat", outputs="T", states="T")
    noisy = y + 0.02 * y.std() * rng.standard_normal(n)
    found = rco.diagnose(model, rco.Measurement(u, noisy, dt=1.0, input_labels="heat", output_labels="T"))
    assert found.verdict == "effect"
    assert {row.effect.kind for row in (found.best, *found.best.same)} == {"input_delay", "output_delay"}
    assert {e.kind for e in found.ambiguous} == {"input_delay", "output_delay"}
    assert abs(found.best.coefficients["delay"] - late) < 4 * found.best.std["delay"] + 1e-3
