"""Dead time and limits of an actuator inside of a loop, beside a servo that is simulated here."""

from __future__ import annotations

import control as ct
import numpy as np
import pytest
from cases import named

import rcorefine as rco

DT, PARTS, NOISE = 0.02, 20, 0.005
GAIN, DELAY, LIMITS = 4.0, 0.05, (-1.5, 1.5)
TRUE = rco.Controller(GAIN, DELAY, LIMITS)
SERVO = ct.ss(
    [[0, 1], [0, -2.0]], [[0], [4.0]], [[1, 0]], 0, states=["q", "v"], inputs=["u"], outputs=["y"],
    name="servo",
)  # fmt: skip


def servo(seed, n=1500, noise=NOISE, gain=GAIN, delay=DELAY, limits=LIMITS, smooth=False, parts=PARTS):
    """Reference, command and output: Runge-Kutta in fine steps, a queue of commands, a clip."""
    rng = np.random.default_rng([seed, 7])
    levels, tones = rng.uniform(-1, 1, n // 60 + 1), ((1.1, 0.0), (2.7, 1.0), (4.3, 2.0))
    step, x, y, u, r = DT / parts, np.zeros(2), np.zeros(n), np.zeros(n), np.zeros(n)

    def wanted(k, part):
        t = k * DT + part * step
        return sum(0.4 * np.sin(w * t + p) for w, p in tones) if smooth else levels[k // 60]

    def rate(x, w):
        return np.array([x[1], 4.0 * w - 2.0 * x[1]])

    queue = [0.0] * round(delay / step)
    for k in range(n):
        y[k], r[k] = x[0] + noise * rng.standard_normal(), wanted(k, 0)
        u[k] = gain * (r[k] - y[k])
        for part in range(parts):
            queue.append(gain * (wanted(k, part + 0.5) - x[0] - x[1] * step / 2) if smooth else u[k])
            w = np.clip(queue.pop(0), *limits)
            a = rate(x, w)
            b = rate(x + step / 2 * a, w)
            c = rate(x + step / 2 * b, w)
            x = x + step / 6 * (a + 2 * b + 2 * c + rate(x + step * c, w))
    return r, u, y


def record(r, y, hold="zoh", name="r"):
    return rco.Measurement(r, y, dt=DT, hold=hold, input_labels=name, output_labels="y")


@pytest.fixture(scope="module")
def train():
    r, _, y = servo(3, n=600)
    return record(r, y)


@pytest.fixture(scope="module")
def test():
    r, _, y = servo(4, n=400)
    return record(r, y)


@pytest.mark.parametrize(
    ("delay", "limits", "close"),
    [(0.05, (-1.5, 1.5), 1e-9), (0.0, (-1.5, 0.8), 1e-9), (0.033, (-1.5, 1.0), 1e-4), (0.1, None, 1e-9)],
)
def test_the_loop_is_that_of_the_actuator(delay, limits, close):
    gain = 1.5 if limits is None else GAIN
    r, _, clean = servo(1, n=600, noise=0.0, gain=gain, delay=delay, limits=limits or (-np.inf, np.inf))
    loop = rco.Controller(gain, delay, limits)
    run = rco.simulate(SERVO, record(r, 0 * clean), "zero", controller=loop)
    np.testing.assert_allclose(run.outputs[0], clean, atol=close)


@pytest.mark.parametrize("known", ["reference", "command"])
def test_with_true_values_the_noise_is_left(known):
    """That of the sensor, and the motion that it causes: the controller feeds it back."""
    (r, u, y), floor = servo(2), np.std(servo(2)[2] - servo(2, noise=0.0)[2])
    data = record(r, y) if known == "reference" else record(u, y, name="u")
    assert rco.compare(SERVO, data, controller=TRUE).rmse[0] < 1.02 * floor < 2 * NOISE
    for less in (rco.Controller(GAIN, 0.0, LIMITS), rco.Controller(GAIN, DELAY)):
        assert rco.compare(SERVO, data, controller=less).rmse[0] > 5 * floor


def test_a_continuous_controller_answers_between_the_samples():
    r, _, clean = servo(1, n=500, noise=0.0, smooth=True, parts=80)
    law = ct.ss([], [], [], [[GAIN, -GAIN]], 0, inputs=["r", "y"], outputs=["u"])
    run = rco.simulate(SERVO, record(r, clean, "foh"), "zero", controller=rco.Controller(law, DELAY, LIMITS))
    assert np.abs(run.outputs[0] - clean).max() < 0.01 * np.abs(clean).max()


def test_refine_estimates_what_is_left_out(train, test):
    floor = rco.compare(SERVO, test, controller=TRUE).rmse[0]
    for missing, true, known in (
        (rco.Effect("input_delay", "u"), DELAY, rco.Controller(GAIN, 0.0, LIMITS)),
        (rco.Effect("input_saturation", "u"), LIMITS[1], rco.Controller(GAIN, DELAY)),
    ):
        better = rco.refine(SERVO, train, [missing], controller=known)
        (row,) = (one for one in better.parameters if one.kind == missing.kind)
        assert abs(row.value - true) < 3 * row.std < 0.03 * true
        assert rco.compare(better, test).rmse[0] < 1.1 * floor
        assert [role for role in better.roles if role == "known"] == ["known"]
        # the controller of another rig takes the place of the first one
        np.testing.assert_allclose(
            rco.compare(better, test, controller=known).rmse, rco.compare(better, test).rmse
        )


KINDS = ("input_gain", "input_delay", "input_lag", "input_deadzone", "input_saturation")
LIBRARY = [rco.Effect(kind, "u") for kind in KINDS] + [rco.Effect("damping", "q")]


@pytest.mark.parametrize(
    ("known", "kind", "true"),
    [
        (rco.Controller(GAIN, 0.0, LIMITS), "input_delay", DELAY),
        (rco.Controller(GAIN, DELAY), "input_saturation", LIMITS[1]),
    ],
)
def test_what_is_missing_in_the_loop_is_named(train, test, known, kind, true):
    better = rco.improve(SERVO, train, validation=test, candidates=LIBRARY, controller=known)
    found = better.diagnosis
    row = next(one for one in found.ranking if one.effect.kind == kind)
    named(found, row.effect, true)
    ((value,), (std,)) = (row.coefficients.values(), row.std.values())
    assert abs(value - true) < 3 * std
    floor = rco.compare(SERVO, test, controller=TRUE).rmse[0]
    assert rco.compare(better.refinement, test).rmse[0] < 1.1 * floor


def test_nothing_is_missing_in_the_true_loop(train):
    assert rco.diagnose(SERVO, train, controller=TRUE).verdict == "adequate"


def test_a_system_is_the_same_with_and_without_the_class(train):
    law = ct.ss([], [], [], [[GAIN, -GAIN]], inputs=["r", "y"], outputs=["u"])
    runs = [
        rco.simulate(SERVO, train, controller=c).outputs
        for c in (law, rco.Controller(law), rco.Controller(GAIN))
    ]
    np.testing.assert_array_equal(runs[0], runs[1])
    np.testing.assert_array_equal(runs[0], runs[2])


def test_a_sensor_with_a_memory_keeps_it_from_sample_to_sample():
    r, _, _ = servo(1, n=300)
    slow = [rco.Effect("output_smoothing", "y", fixed={"kept": 0.8}), rco.Effect("input_gain", "u")]
    calm = rco.Controller(0.5, 0.0, (-0.3, 0.3))
    made = rco.refine(SERVO, record(r, servo(1, n=300)[2]), slow, controller=calm, offset=False)
    run = made.simulate(record(r, np.zeros(300)), "zero")
    y, x, seen, gain = np.zeros(300), np.zeros(2), 0.0, made.parameter("input_gain").value
    for k in range(300):
        seen = y[k] = 0.8 * seen + 0.2 * x[0] if k else x[0]
        w = gain * np.clip(0.5 * (r[k] - y[k]), -0.3, 0.3)
        fade = np.exp(-2.0 * DT)
        x = np.array([x[0] + (x[1] - 2 * w) * (1 - fade) / 2 + 2 * w * DT, 2 * w + (x[1] - 2 * w) * fade])
    np.testing.assert_allclose(run.outputs[0], y, atol=1e-9)


@pytest.mark.parametrize(
    ("given", "error", "words"),
    [
        (("fast",), ct.ControlArgument, "system must be a gain"),
        ((np.ones((1, 1, 1)),), ct.ControlDimension, "a gain is a number"),
        ((1.0, -0.1), ct.ControlArgument, "delay = -0.1 must not be negative"),
        ((1.0, 0.0, (1.0, -1.0)), ct.ControlArgument, "each low must be below its high"),
        ((1.0, 0.0, 1.0), ct.ControlDimension, r"give \(low, high\)"),
    ],
)
def test_what_is_no_controller_is_said(given, error, words):
    with pytest.raises(error, match=words):
        rco.Controller(*given)


def test_what_does_not_fit_a_record_is_said(train):
    for loop, words in (
        (rco.Controller([[1.0, 2.0]]), "the gain of the controller has the shape"),
        (rco.Controller(GAIN, 0.0, [(-1, 1), (-1, 1)]), "limits has 2 pairs for 1 input"),
    ):
        with pytest.raises(ct.ControlDimension, match=words):
            rco.compare(SERVO, train, controller=loop)
    two = rco.Measurement([train.inputs[0], train.inputs[0]], train.outputs, dt=DT, input_labels=["a", "b"],
                          output_labels="y")  # fmt: skip
    with pytest.raises(ct.ControlDimension, match="one reference for each of y"):
        rco.compare(SERVO, two, controller=TRUE)
    with pytest.raises(rco.ModelError, match="named twice"):
        rco.refine(SERVO, train, [rco.Effect("input_delay", "u")], controller=TRUE)
    better = rco.refine(
        SERVO, train, [rco.Effect("input_delay", "u")], controller=rco.Controller(GAIN, 0.0, LIMITS)
    )
    with pytest.raises(
        rco.ModelError, match="input_delay at u is an effect of the model and of the controller"
    ):
        rco.compare(better, train, controller=TRUE)
    response = rco.FrequencyResponse(np.ones(20), np.linspace(1, 9, 20))
    with pytest.raises(ct.ControlArgument, match="controller belongs to records in time"):
        rco.compare(SERVO, response, controller=TRUE)
