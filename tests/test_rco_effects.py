"""Physical effects on a stream: known truths, Cramer-Rao bounds, gaps, bounds, bad input."""

from __future__ import annotations

import warnings

import control as ct
import numpy as np
import pytest
from scipy.linalg import expm
from scipy.signal import lfilter
from scipy.stats import binom

import rcorefine as rco
from rcorefine import Effect, RCORefiner

STIFFNESS = [Effect("stiffness", f"link{i}") for i in (1, 2, 3)]
DAMPING = [0.2, 0.16, 0.12]  # 0.02 K


def chain(k=(10.0, 8.0, 6.0), sensors=("displacement", (1, 3))):
    return rco.mass_spring_damper([1, 1, 1], DAMPING, list(k), sensors=sensors, force=3)


def held(model, w, dt):
    """Samples of a continuous model under a held input: scipy's expm, one step after the other."""
    system = model.system
    n, n_w = system.B.shape
    block = np.zeros((n + n_w, n + n_w))
    block[:n] = np.hstack([system.A, system.B])
    step = expm(block * dt)
    x, y = np.zeros(n), np.empty((system.C.shape[0], w.shape[1]))
    for k in range(w.shape[1]):
        y[:, k] = system.C @ x + system.D @ w[:, k]
        x = step[:n, :n] @ x + step[:n, n:] @ w[:, k]
    return y


def sampled(model, dt, n_samples, noise, seed, size=1.0):
    rng = np.random.default_rng(seed)
    w = size * rng.standard_normal((1, n_samples))
    y = held(model, w, dt)
    level = noise * y.std(axis=1)
    return w, y + level[:, None] * rng.standard_normal(y.shape), level


def only_effects(model, dt, effects, **settings):
    return RCORefiner(model, dt=dt, effects=effects, use_estimated_states=False, **settings)


def estimates(refiner):
    rows = refiner.parameters
    return np.array([r.coefficient for r in rows]), np.array([r.std for r in rows])


def bound(build, start, index, w, dt, level):
    """Cramer-Rao standard deviations of an output-error fit: central differences of scipy's simulation."""
    columns = []
    for i in index:
        step = 1e-5 * start[i]
        up, down = list(start), list(start)
        up[i] += step
        down[i] -= step
        columns.append(
            ((held(build(up), w, dt) - held(build(down), w, dt)) / (2 * step) / level[:, None]).ravel()
        )
    J = np.column_stack(columns)
    return np.sqrt(np.diag(np.linalg.inv(J.T @ J)))


@pytest.mark.parametrize("dt", [0.02, 0.05])
@pytest.mark.parametrize("loss", [0.1, 0.3, 0.5])
def test_loss_in_one_spring_is_found_exactly_without_noise(loss, dt):
    w, y, _ = sampled(chain((10, 8 * (1 - loss), 6)), dt, 4000, 0.0, 1)
    refiner = only_effects(chain(), dt, STIFFNESS)
    refiner.update(w, y)
    found = [row.value / row.initial for row in refiner.parameters]
    np.testing.assert_allclose(found[1], 1 - loss, atol=0.01 * loss)  # within 1 % of its value
    assert max(abs(found[0] - 1), abs(found[2] - 1)) < 0.005
    np.testing.assert_allclose(found, [1, 1 - loss, 1], atol=1e-5)  # and in fact exact, at both dt


@pytest.mark.slow
def test_intervals_hold_the_truth_with_noise():
    inside, runs = 0, 40
    for seed in range(runs):
        loss = (0.1, 0.3, 0.5)[seed % 3]
        w, y, _ = sampled(chain((10, 8 * (1 - loss), 6)), 0.02, 3000, 0.05, seed)
        refiner = only_effects(chain(), 0.02, STIFFNESS)
        refiner.update(w, y)
        low, high = refiner.parameters[1].interval
        inside += low <= 8 * (1 - loss) <= high
    assert inside >= 0.9 * runs


@pytest.mark.slow
@pytest.mark.parametrize("dt", [0.001, 0.005])
def test_two_dof_is_efficient_and_unbiased(dt):
    def two_dof(k):
        return rco.mass_spring_damper([0.8, 0.5], [100, 200, 120], list(k), sensors=("velocity", 1))

    truth, runs, errors = np.array([1500.0, 2000.0]), 40, []
    for seed in range(runs):
        w, y, level = sampled(two_dof([1000, *truth]), dt, 5000, 0.01, seed, size=1000.0)
        if seed == 0:
            cramer_rao = bound(two_dof, [1000, *truth], (1, 2), w, dt, level)
        refiner = only_effects(
            two_dof([1000, 25000, 25000]), dt, [Effect("stiffness", "link2"), Effect("stiffness", "link3")]
        )
        refiner.update(w, y)
        errors.append([row.value for row in refiner.parameters] - truth)
    errors = np.array(errors)
    assert np.all(errors.std(axis=0, ddof=1) <= 2 * cramer_rao)
    standard_error = errors.std(axis=0, ddof=1) / np.sqrt(runs)
    assert np.all(np.abs(errors.mean(axis=0)) < 3.5 * standard_error)


def test_std_is_the_cramer_rao_bound():
    truth = (10, 5.6, 6)
    w, y, level = sampled(chain(truth), 0.02, 4000, 0.05, 3)
    refiner = only_effects(chain(), 0.02, STIFFNESS, noise=level)
    refiner.update(w, y)
    np.testing.assert_allclose(
        estimates(refiner)[1], bound(chain, truth, (0, 1, 2), w, 0.02, level), rtol=0.1
    )


def test_one_sample_at_a_time_is_the_block():
    w, y, _ = sampled(chain((10, 5.6, 6)), 0.02, 400, 0.05, 3)
    one, block = (RCORefiner(chain(), dt=0.02, effects=STIFFNESS, history=True) for _ in range(2))
    block.update(w, y)
    for k in range(w.shape[1]):
        one.update(w[:, k], y[:, k])
    np.testing.assert_allclose(one.static_theta, block.static_theta, rtol=1e-12)
    np.testing.assert_allclose(one.covariance, block.covariance, rtol=1e-12)
    np.testing.assert_array_equal(one.history.coefficients, block.history.coefficients)


NONLINEAR = {
    "cubic_stiffness": ([Effect("cubic_stiffness", "link2")], lambda d, v: 3 * d**3, [3.0]),
    "quadratic_damping": ([Effect("quadratic_damping", "link2")], lambda d, v: 0.5 * v * abs(v), [0.5]),
    "with a spring": (
        [Effect("cubic_stiffness", "link2"), Effect("stiffness", "link2")],
        lambda d, v: 3 * d**3 - 2 * d,
        [3.0, -2.0],
    ),
}


@pytest.mark.parametrize("case", NONLINEAR)
def test_nonlinear_effects_from_a_runge_kutta_truth(case):
    effects, law, truth = NONLINEAR[case]
    system, dt, n_samples = chain().system, 0.02, 3000
    rng = np.random.default_rng(0)
    w = 3 * rng.standard_normal(n_samples)
    act = np.array([0, 0, 0, 1, -1, 0])  # link 2 pulls mass 1 up and mass 2 down

    def rate(x, u):
        return system.A @ x + system.B[:, 0] * u + act * law(x[1] - x[0], x[4] - x[3])

    x, y, h = np.zeros(6), np.empty((2, n_samples)), dt / 4
    for k in range(n_samples):
        y[:, k] = system.C @ x
        for _ in range(4):
            k1 = rate(x, w[k])
            k2 = rate(x + h / 2 * k1, w[k])
            k3 = rate(x + h / 2 * k2, w[k])
            x = x + h / 6 * (k1 + 2 * k2 + 2 * k3 + rate(x + h * k3, w[k]))
    y += 0.02 * y.std(axis=1, keepdims=True) * rng.standard_normal(y.shape)
    refiner = only_effects(chain(), dt, effects)
    refiner.update(w, y)
    value, std = estimates(refiner)
    np.testing.assert_allclose(value, truth, rtol=0.01)
    assert np.all(np.abs(value - truth) < 4 * std)


def test_sensor_and_actuator_effects_together():
    effects = [Effect("output_gain", "q1"), Effect("output_offset", "q1"), Effect("input_gain", "force")]
    w, y, _ = sampled(chain(), 0.02, 3000, 0.0, 2)
    y = y * 1.2
    y[0] = 1.1 * y[0] + 0.3
    y += 0.01 * y.std(axis=1, keepdims=True) * np.random.default_rng(5).standard_normal(y.shape)
    refiner = only_effects(chain(), 0.02, effects)
    refiner.update(w, y)
    value, std = estimates(refiner)
    assert np.all(np.abs(value - [0.1, 0.3, 0.2]) < 4 * std)
    assert np.all(std < 0.01)


def test_input_delay_of_a_fraction_of_a_sample():
    dt, fine = 0.02, 10
    rng = np.random.default_rng(0)
    w = rng.standard_normal((1, 3000))
    late = np.repeat(w, fine, axis=1)
    delay = 23  # fine samples: 2.3 samples
    late = np.hstack([np.full((1, delay), w[0, 0]), late[:, :-delay]])
    y = held(chain(), late, dt / fine)[:, ::fine]
    y += 0.01 * y.std(axis=1, keepdims=True) * rng.standard_normal(y.shape)
    refiner = only_effects(chain(), dt, [Effect("input_delay", "force")])
    refiner.update(w, y)
    value, std = estimates(refiner)
    assert abs(value[0] - 2.3 * dt) < 4 * std[0] + 1e-4
    assert std[0] < 0.02 * dt


@pytest.mark.parametrize("times", [(0, 2000, 6000), (0, 3000, 3001)])
def test_damage_that_grows_or_jumps_is_followed_with_forgetting(times):
    dt, n_samples = 0.02, 8000
    rng = np.random.default_rng(0)
    w = rng.standard_normal((1, n_samples))
    course = np.interp(np.arange(n_samples), times, [8.0, 8.0, 6.0])
    x, y = np.zeros(6), np.empty((2, n_samples))
    for i in range(n_samples):
        y[:, i] = x[[0, 2]]
        if i % 50 == 0:  # the spring weakens in small steps
            s = chain((10, course[i], 6)).system
            step = expm(np.block([[s.A, s.B], [np.zeros((1, 7))]]) * dt)[:6]
        x = step @ np.append(x, w[0, i])
    y += 0.02 * y.std(axis=1, keepdims=True) * rng.standard_normal(y.shape)
    follows = only_effects(chain(), dt, STIFFNESS, forgetting=0.998, history=True)
    follows.update(w, y)
    found = follows.history.coefficients
    lag = 2.0 / 4000 / (1 - 0.998)  # what a memory of 500 samples may lag behind the ramp
    np.testing.assert_allclose(found[1, 5000], course[5000] - 8, atol=2 * lag)
    np.testing.assert_allclose(found[:, -1], [0, -2, 0], atol=0.1)


def test_without_excitation_nothing_is_forgotten():
    w, y, level = sampled(chain((10, 5.6, 6)), 0.02, 3000, 0.02, 0)
    refiner = only_effects(chain(), 0.02, STIFFNESS, forgetting=0.995)
    refiner.update(w, y)
    before = estimates(refiner)
    rest = np.zeros((1, 20000))
    fading = refiner.predict(rest)
    refiner.update(rest, fading + level[:, None] * np.random.default_rng(1).standard_normal(fading.shape))
    after = estimates(refiner)
    assert np.all(np.isfinite(after[1]))
    assert np.all(after[1] < 10 * before[1])  # what still rang could be learned from; then it stays
    np.testing.assert_allclose(after[0], before[0], atol=10 * before[1].max())


@pytest.mark.slow
def test_ten_percent_missing_keeps_the_interval():
    truth, inside, runs = np.array([0.0, -2.4, 0.0]), 0, 20
    for seed in range(runs):
        w, y, _ = sampled(chain((10, 5.6, 6)), 0.02, 3000, 0.05, seed)
        clean = only_effects(chain(), 0.02, STIFFNESS)
        clean.update(w, y)
        gaps = y.copy()
        gaps[np.random.default_rng(seed).random(y.shape) < 0.1] = np.nan
        holed = only_effects(chain(), 0.02, STIFFNESS, missing="hold-out")
        holed.update(w, gaps)
        inside += int(np.sum(np.abs(estimates(holed)[0] - truth) < 1.2 * 1.96 * estimates(clean)[1]))
    # 1.2 x 1.96 standard deviations of a normal estimate with 10 % fewer samples: 97.4 % of the time
    assert inside >= binom.ppf(1e-3, 3 * runs, 0.974)
    ratio = estimates(holed)[1] / estimates(clean)[1]
    np.testing.assert_allclose(ratio, 1 / np.sqrt(0.9), rtol=0.1)


def test_a_sensor_that_drops_out_for_good():
    w, y, _ = sampled(chain((10, 5.6, 6)), 0.02, 5000, 0.02, 4)
    masked = np.ma.masked_array(y, mask=False)
    masked[0, 2500:] = np.ma.masked
    refiner = only_effects(chain(), 0.02, STIFFNESS, missing="hold-out")
    refiner.update(w, masked)
    value, std = estimates(refiner)
    assert np.all(np.abs(value - [0, -2.4, 0]) < 4 * std)


def test_unknown_inputs_are_bridged():
    w, y, _ = sampled(chain((10, 5.6, 6)), 0.02, 5000, 0.02, 4)
    w[0, 2600:2605] = np.nan
    refiner = only_effects(chain(), 0.02, STIFFNESS, missing="hold-out")
    refiner.update(w, y)
    value, std = estimates(refiner)
    assert np.all(np.abs(value - [0, -2.4, 0]) < 4 * std)


def test_without_effects_gaps_are_carried_over():
    example = rco.examples.rlc()
    data = example.record()
    outputs = data.outputs.copy()
    outputs[0, np.random.default_rng(0).random(data.n_samples) < 0.1] = np.nan
    outputs[0, 0] = data.outputs[0, 0]
    refiner = RCORefiner.paper(example.initial, dt=example.dt, **example.settings, missing="hold-out")
    refiner.update(data.inputs, outputs)
    assert rco.examples.rlc_parameters(refiner.system)["inductance"] == pytest.approx(0.055, rel=0.02)


def test_stage_one_runs_beside():
    w, y, _ = sampled(chain((10, 5.6, 6)), 0.02, 500, 0.05, 4)
    refiner = RCORefiner(chain(), dt=0.02, effects=STIFFNESS, history=True)
    refiner.update(w, y)
    alone = RCORefiner.paper(chain(), dt=0.02, window=100, history=True)
    with pytest.raises(rco.DivergenceError, match="sample 309 "):  # the paper's stage 1 on such a chain
        alone.run(rco.Measurement(w, y, dt=0.02))
    np.testing.assert_array_equal(refiner.history.x_D[:, :309], alone.history.x)
    assert "Stage 1 stopped: stage 1 diverged at sample 309" in " ".join(str(refiner).split())
    assert refiner.history.coefficients.shape == (3, 500)
    refiner.history.plot()


def test_stage_one_that_follows_single_samples_is_that_of_the_block():
    """It learns from several at once: as from a block, wherever it is read, in gaps and where it diverges."""
    w, y, _ = sampled(chain((10, 5.6, 6)), 0.02, 500, 0.05, 4)
    y[:, 207] = np.nan
    one, block = (RCORefiner(chain(), dt=0.02, effects=STIFFNESS, missing="hold-out") for _ in range(2))
    for k in range(w.shape[1]):
        one.update(w[:, k], y[:, k])
        if k in (40, 90, 250):
            block.update(w[:, block.n_samples : k + 1], y[:, block.n_samples : k + 1])
            np.testing.assert_array_equal(one.theta, block.theta)
    block.update(w[:, 251:], y[:, 251:])
    assert "Stage 1 stopped: stage 1 diverged at sample" in " ".join(str(block).split())
    assert str(one) == str(block)


def test_results_are_there_before_and_after():
    w, y, _ = sampled(chain((10, 5.6, 6)), 0.02, 600, 0.01, 4)
    refiner = only_effects(chain(), 0.02, STIFFNESS)
    assert np.isinf(refiner.parameters[0].std)
    refiner.update(w[:, 0], y[:, 0])
    np.testing.assert_array_equal(refiner.system.A, chain().system.A)
    refiner.update(w[:, 1:500], y[:, 1:500])
    np.testing.assert_allclose(refiner.system.A, chain((10, 5.6, 6)).system.A, atol=0.2)
    assert refiner.discrete_system.dt == 0.02
    ahead = refiner.predict(w[:, 500:])
    assert np.linalg.norm(ahead - y[:, 500:]) < 0.1 * np.linalg.norm(y[:, 500:])
    text = str(refiner)
    assert "k2" in text
    assert max(map(len, text.splitlines())) <= 80
    refiner.bode_plot()
    refiner.reset()
    assert refiner.n_samples == 0


def test_the_wrong_place_is_said():
    w, y, level = sampled(chain((10, 4.0, 6)), 0.02, 3000, 0.02, 4)
    refiner = only_effects(chain(), 0.02, [Effect("stiffness", "link1")], noise=level)
    refiner.update(w, y)
    assert "Not explained" in str(refiner)


@pytest.mark.parametrize("bias", [0.0, 1.0])
@pytest.mark.parametrize("offset", [0.3, 3.0, 40.0])  # of the rms of the output
def test_a_sensor_offset_that_no_effect_takes_is_said_with_its_remedy(offset, bias):
    w = np.random.default_rng(1).standard_normal((1, 1000)) + bias
    y = held(rco.mass_spring_damper(1, 0.4, 32), w, 0.02)
    y += y.std() * (offset + 0.02 * np.random.default_rng(2).standard_normal(y.shape))
    model, spring = rco.mass_spring_damper(1, 0.4, 40), Effect("stiffness", "link1")
    with pytest.warns(rco.IdentifiabilityWarning, match=r"rco.Effect\('output_offset', 'q1'\)"):
        only_effects(model, 0.02, [spring]).update(w, y)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        refiner = only_effects(model, 0.02, [spring, Effect("output_offset", "q1")])
        refiner.update(w, y)
    value, std = estimates(refiner)
    assert abs(value[0] + 8.0) < 4.0 * std[0] < 0.4


@pytest.mark.parametrize("color", [0.0, 0.9])
def test_streams_without_an_offset_are_not_suspected_of_one(color):
    model, true = chain(), chain((10, 6.4, 6))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        for seed in range(100, 110):
            rng = np.random.default_rng(seed)
            w = rng.standard_normal((1, 500)) + seed % 2
            y = held(true, w, 0.05)
            noise = lfilter([np.sqrt(1.0 - color**2)], [1.0, -color], rng.standard_normal((2, 700)))[:, 200:]
            effects = STIFFNESS if seed % 3 else STIFFNESS[:1]  # a wrong place leaves much, and no constant
            only_effects(model, 0.05, effects).update(w, y + 0.05 * y.std(axis=1, keepdims=True) * noise)


def test_what_is_not_excited_is_said():
    model = rco.mass_spring_damper([1, 1, 1], DAMPING, [10, 8, 6], force=(1, 3))
    w = np.vstack([np.random.default_rng(0).standard_normal(500), np.zeros(500)])
    refiner = only_effects(model, 0.02, [Effect("input_gain", label) for label in model.system.input_labels])
    refiner.update(w, held(model, w, 0.02))
    assert (
        f"Not excited: the samples hardly determine input_gain at {model.system.input_labels[1]}"
        in " ".join(str(refiner).split())
    )


@pytest.mark.parametrize(
    ("change", "error", "match"),
    [
        ({"effects": []}, rco.ModelError, "empty"),
        ({"effects": ["stiffness"]}, ct.ControlArgument, "Effect objects"),
        ({"effects": [Effect("stiffness", "link9")]}, Exception, "link9"),
        ({"effects": [Effect("output_delay", "q1")]}, rco.ModelError, "future"),
        ({"effects": STIFFNESS * 2}, rco.ModelError, "twice"),
        ({"noise": -1.0}, ct.ControlArgument, "positive"),
        ({"forgetting": 2.0}, rco.ModelError, "forgetting"),
        ({"disturbance": -1.0}, rco.ModelError, "disturbance"),
        ({"hold": "bandlimited"}, ct.ControlArgument, "refine"),
        ({"missing": "skip"}, ct.ControlArgument, "hold-out"),
        ({"effects": None, "window": 50, "noise": 1.0}, ct.ControlArgument, "noise"),
        ({"effects": [Effect("stiffness", "link1", fixed={"stiffness": 1.0})]}, rco.ModelError, "fixed"),
    ],
)
def test_bad_settings_are_explained(change, error, match):
    with pytest.raises(error, match=match):
        RCORefiner(chain(), dt=0.02, **{"effects": STIFFNESS, **change})


def test_discrete_models_and_parameters_without_effects_are_explained():
    with pytest.raises(rco.ModelError, match="d2c"):
        RCORefiner(chain().system.sample(0.02), effects=STIFFNESS)
    with pytest.raises(rco.RCOError, match="effects"):
        _ = RCORefiner.paper(chain(), dt=0.02, window=100).parameters


def test_intervals_are_calibrated():
    """Standard errors against the chi-square of the estimates, over seeds."""
    inside, count = 0, 0
    for seed in range(20):
        w, y, _ = sampled(chain((10, 5.6, 6)), 0.05, 1500, 0.05, seed)
        refiner = only_effects(chain(), 0.05, STIFFNESS)
        refiner.update(w, y)
        value, std = estimates(refiner)
        inside += int(np.sum(np.abs(value - [0, -2.4, 0]) < 1.96 * std))
        count += 3
    assert inside >= binom.ppf(1e-3, count, 0.93)
