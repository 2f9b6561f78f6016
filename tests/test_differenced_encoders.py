"""Speeds that are differences of an angle over a sample."""

from __future__ import annotations

import control as ct
import numpy as np
import pytest
from cases import slow
from inner import Engine, Structure
from scipy.signal import cont2discrete, dlsim

import rcorefine as rco
from rcorefine.models.library import reads_rate

SECOND = ([[-2.0, 40.0], [-2.0, -50.0]], [[0.0], [60.0]])
CART = ([[0.0, 1.0], [-60.0, -1.5]], [[0.0], [1.0]])


def held(A, B, row, dt, w):
    """Return an output of a plant at rest whose input is held."""
    system = [np.atleast_2d(np.array(part, dtype=float)) for part in (A, B, row, [[0.0]])]
    return dlsim(cont2discrete(system, dt), w)[1][:, 0]


def angle(A, B, speed, dt, w):
    """Return the integral of a state of the plant."""
    n = len(A)
    whole = np.zeros((n + 1, n + 1))
    whole[:n, :n], whole[n, speed] = A, 1.0
    return held(whole, np.vstack([B, [[0.0]]]), np.eye(1, n + 1, n), dt, w)


def steps(hold, seed=7):
    return np.repeat(np.random.default_rng(seed).uniform(-6.0, 6.0, 2400 // hold), hold)


def encoder(A, B, speed, dt, hold, line):
    w = steps(hold)
    counts = np.round(angle(A, B, speed, dt, w) / line)
    return rco.Measurement(w[1:], np.diff(counts) * line / dt, dt=dt)


def motor():
    return rco.dc_motor(gain=12.0, time_constant=0.08, inputs="volt")


BENCHES = {
    "motor": (([[-12.5]], [[150.0]]), 0, 0.005, 6, 2 * np.pi / 4096, motor()),
    "motor with current": (SECOND, 0, 0.005, 6, 6e-5, ct.ss(*SECOND, [[1, 0]], 0, outputs="speed")),
    "cart": (CART, 1, 0.02, 5, 1e-3, ct.ss(*CART, [[0, 1]], 0)),
}


@pytest.mark.parametrize("name", [next(iter(BENCHES)), *slow(*list(BENCHES)[1:])])
def test_the_mean_over_a_sample_is_named(name):
    (A, B), speed, dt, hold, line, model = BENCHES[name]
    found = rco.diagnose(model, encoder(A, B, speed, dt, hold, line))
    label = rco.physical(model).linear.output_labels[0]
    assert (found.verdict, found.effects[0].kind, len(found.effects)) == ("effect", "output_average", 1)
    assert found.best.coefficients["window"] == pytest.approx(dt, rel=2e-3)
    assert f"{label} is the mean over a sample: a differenced encoder." in " ".join(str(found).split())


def test_a_tachometer_draws_no_such_remark():
    w = steps(6, 2)
    y = held(-12.5, 150.0, 1.0, 0.005, w)
    noise = 0.01 * y.std() * np.random.default_rng(3).standard_normal(y.size)
    assert rco.diagnose(motor(), rco.Measurement(w, y + noise, dt=0.005)).verdict == "adequate"


@pytest.mark.parametrize("name", BENCHES)
@pytest.mark.parametrize("kind", ["output_average", "output_delay"])
def test_means_and_delays_of_outputs_keep_the_corners_of_held_inputs(name, kind):
    (A, B), speed, dt, hold, _, model = BENCHES[name]
    w, model = steps(hold), rco.physical(model)
    if kind == "output_average":
        value, exact = dt, np.diff(angle(A, B, speed, dt, w), prepend=0.0) / dt
    else:  # by half a sample: the plant in steps of half a sample
        fine = held(A, B, np.eye(1, len(A), speed), dt / 2, np.repeat(w, 2))
        value, exact = dt / 2, np.concatenate([[0.0], fine[1:-1:2]])
    structure = Structure(model, [rco.Effect(kind, model.linear.output_labels[0])])
    engine = Engine(structure, rco.Measurement(w, exact, dt=dt), initial=np.zeros(structure.n_states))
    run = engine.run(np.array([value]))
    np.testing.assert_allclose(run.outputs[0], exact, atol=1e-4 * exact.std())
    near = [engine.run(np.array([q * value]), sensitivity=False).outputs[0] for q in (1 - 1e-6, 1 + 1e-6)]
    slope = (near[1] - near[0]) / (2e-6 * value)
    np.testing.assert_allclose(run.sensitivity[0, :, 0], slope, atol=1e-4 * np.abs(slope).max())


def test_derivatives_of_a_mean_by_other_coefficients_keep_the_corners():
    data = encoder(*CART, 1, 0.02, 5, 1e-3)
    model = rco.physical(BENCHES["cart"][-1])
    effects = [
        rco.Effect("stiffness", "x[0]"),
        rco.Effect("input_gain", "u[0]"),
        rco.Effect("output_average", "y[0]"),
    ]
    engine = Engine(Structure(model, effects), data, initial=np.zeros(2))
    theta = np.array([1.0, 0.1, 0.02])
    run = engine.run(theta)
    for k, step in enumerate((1e-4, 1e-6)):
        ahead, behind = (
            engine.run(theta + s * np.eye(3)[k], sensitivity=False).outputs for s in (step, -step)
        )
        np.testing.assert_allclose(
            run.sensitivity[..., k], (ahead - behind) / (2 * step), rtol=1e-5, atol=1e-8
        )


def test_which_outputs_are_rates():
    model = rco.physical(ct.ss(*CART, np.eye(2), 0, outputs=["x", "y[1]"]))
    assert reads_rate(model) == [False, True]
    assert reads_rate(rco.physical(ct.ss(-1, 1, 1, 0, outputs="speed"))) == [True]
    assert reads_rate(rco.physical(ct.ss(-1, 1, 1, 0, outputs="level"))) == [False]
    assert reads_rate(motor().__class__.from_statespace(motor().linear.to_statespace())) == [True]
