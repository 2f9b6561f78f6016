"""Rows of the failure map that would mislead: what another row explains is no row of its own."""

from __future__ import annotations

import warnings

import control as ct
import numpy as np
import pytest
from hidden.generator import Law, held_motion

import rcorefine as rco
from rcorefine import Measurement

STEP, N = 0.02, 2400
INERTIA, DRAG, GAIN = 0.4, 0.3, 1.7


def axis(measured=1) -> ct.StateSpace:
    """An axis with the position (0) or the speed (1) measured."""
    C = np.eye(2)[[measured]]
    A, B = [[0, 1], [0, -DRAG / INERTIA]], [[0], [GAIN / INERTIA]]
    return ct.ss(A, B, C, 0, inputs="current", outputs="y", states=["position", "speed"], name="axis")


def record(measured=1, friction=0.0, factor=1.0, zero=0.0, seed=3, noise=0.01):
    """The axis in steps of current, integrated here; the sensor shows factor * y + zero."""
    rng = np.random.default_rng(seed)
    w = np.repeat(rng.uniform(-4, 4, N // 40 + 1), 40)[:N] + 0.2 * rng.standard_normal(N)
    law = Law("coulomb_friction", np.array([friction, 0.003, 0.0]))
    motion = held_motion(
        [[0, 1], [0, -DRAG / INERTIA]], np.outer(w, [0, GAIN / INERTIA]), STEP,
        [(law, [0, -1 / INERTIA], [1, 0], [0, 1])],
    )  # fmt: skip
    y = factor * motion[:, measured] + zero
    y = y + noise * y.std() * rng.standard_normal(N)
    return Measurement(w, y, dt=STEP, input_labels="current", output_labels="y")


@pytest.mark.parametrize("factor", [300.0, 60 / (2 * np.pi), -1.0, 0.4])
def test_a_wrong_scale_is_no_dead_zone(factor):
    found = rco.compare(axis(), record(factor=factor)).failures
    assert found[0].measure == ("sign" if factor == -1 else "gain")
    assert found[0].values["factor"] == pytest.approx(factor, rel=0.02)
    assert {row.dimension for row in found[1:]} <= {"frequency", "place"}
    assert {row.measure for row in found[1:]} <= {"band", "linear force", "hidden force"}


def test_a_dead_zone_is_still_one():
    data = record()
    w = data.inputs[0]
    acts = np.sign(w) * np.maximum(np.abs(w) - 1.2, 0.0)
    y = ct.forced_response(axis().sample(STEP), U=acts).outputs
    y = y + 0.01 * y.std() * np.random.default_rng(0).standard_normal(N)
    found = rco.compare(axis(), Measurement(w, y, dt=STEP)).failures
    assert found[0].measure == "dead zone"
    assert found[0].values["level"] == pytest.approx(1.2, rel=0.1)


@pytest.mark.parametrize("zero", [0.3, 8.0])
def test_share_of_an_offset_is_that_of_the_error(zero):
    data = record(zero=zero)
    result = rco.compare(axis(), data)
    row = next(row for row in result.failures if row.measure == "offset")
    assert row.values["offset"] == pytest.approx(zero, rel=0.05)
    without = rco.compare(axis(), Measurement(data.inputs, data.outputs - zero, dt=STEP))
    assert row.share == pytest.approx(1 - (without.rmse[0] / result.rmse[0]) ** 2, abs=0.01)
    assert row.share >= result.residual[0].mean() ** 2 / result.rmse[0] ** 2


def test_an_offset_beside_a_wrong_scale_is_said():
    data = record(factor=20.0, zero=200.0)
    found = rco.compare(axis(), data).failures
    rows = {row.measure: row for row in found if row.role != "instead"}
    assert {"gain", "offset"} <= set(rows)
    assert rows["offset"].share + rows["gain"].share == pytest.approx(1.0, abs=0.1)


@pytest.mark.parametrize("measured", [0, 1])
@pytest.mark.parametrize("seed", [3, 4])
def test_plain_dry_friction_is_the_same_to_both_sides_and_nothing_hangs(measured, seed):
    found = rco.compare(axis(measured), record(measured, friction=1.0, seed=seed)).failures
    laws = {row.values.get("law") for row in found if row.dimension == "state"}
    assert "dry" in laws
    assert "dry by direction" not in laws
    assert not any(row.measure == "dropout" for row in found)  # it stands still where friction holds it


STEPS = np.repeat(np.random.default_rng(0).standard_normal(400), 5)  # an input
SPRING = ct.ss([[0, 1], [-40, -2]], [[0], [40]], [[1, 0]], [[0]], inputs="u", outputs="y", name="spring")


def response(w=STEPS, noise=0.02, bent=lambda y: y):
    y = bent(ct.forced_response(SPRING.sample(STEP), U=w).outputs)
    y = y + noise * y.std() * np.random.default_rng(1).standard_normal(y.size)
    return Measurement(w, y, dt=STEP, input_labels="u", output_labels="y")


@pytest.mark.parametrize("pole", [1.003, 1.01])
def test_a_run_that_leaves_the_record_is_no_limit_of_the_sensor(pole):
    """The record goes from -3 to 3 and the run of this model to 1e2 or 1e6: no sensor is cut off there."""
    model = ct.ss([[pole]], [[1.0]], [[1.0]], [[0.0]], STEP, inputs="u", outputs="y")
    found = rco.compare(model, response(), x0="zero").failures
    assert len(found) > 0
    assert not [row for row in found if row.measure == "clipping"]


@pytest.mark.parametrize("side", [1, -1])
def test_an_output_that_goes_on_is_not_cut_off(side):
    """A sensor of another gain on one side: the record goes far beyond zero on both."""
    data = response(bent=lambda y: np.where(side * y > 0, 3 * y, y))
    found = rco.compare(SPRING, data).failures
    assert len(found) > 0
    assert not [row for row in found if row.measure == "clipping"]


def test_a_cut_off_output_is_said_with_the_record_s_own_limits():
    high, low = 0.9, -0.6
    data = response(bent=lambda y: np.clip(y, low, high))
    rows = [row for row in rco.compare(SPRING, data).failures if row.measure == "clipping"]
    assert rows
    limits = {"above": high, "below": low}
    for row in rows:
        if row.values["side"] in limits:
            assert row.values["limit"] == pytest.approx(limits[row.values["side"]], rel=0.03)


@pytest.mark.parametrize("power", [1.0, 1.5])
def test_an_input_of_one_sign_has_no_sides(power):
    w = np.abs(STEPS) + 0.2
    made = response(1.3 * w**power)
    found = rco.compare(SPRING, Measurement(w, made.outputs, dt=STEP)).failures
    said = " ".join(row.sentence for row in found)
    assert "positive and negative" not in said
    assert "both signs" not in said
    assert "both sides" not in said
    assert found[0].measure == ("gain" if power == 1.0 else "curvature")


@pytest.mark.parametrize("order", [1, 2])
def test_poles_at_zero_are_no_modes_and_warn_of_nothing(order):
    model = ct.ss(np.eye(order, k=1), np.eye(order)[:, [-1]], np.eye(order)[[0]], 0, name="integrator")
    w = STEPS
    y = ct.forced_response(ct.tf([1], [1, 0.4]).sample(STEP, "zoh"), U=w).outputs
    with warnings.catch_warnings():
        warnings.simplefilter("error", RuntimeWarning)
        found = rco.compare(model, Measurement(w, y, dt=STEP)).failures
    assert not [row for row in found if row.measure in ("mode", "modes", "corner")]


def test_a_free_decay_has_no_gain():
    """What an input of 1e-17 drives is rounding beside the initial state, and no gain is 1e17."""
    y = ct.forced_response(SPRING.sample(STEP), U=0 * STEPS, X0=[1.0, 0.0]).outputs
    y = y + 0.02 * y.std() * np.random.default_rng(1).standard_normal(y.size)
    found = rco.compare(SPRING, Measurement(1e-17 * STEPS, y, dt=STEP)).failures
    assert len(found) == 0


def test_how_much_louder_a_stretch_is_has_an_end():
    w = STEPS.copy()
    y = ct.forced_response(SPRING.sample(STEP), U=w).outputs
    y[900:1000] += np.sin(np.arange(100))
    y += 1e-9 * np.random.default_rng(2).standard_normal(y.size)
    found = rco.compare(SPRING, Measurement(w, y, dt=STEP)).failures
    (row,) = [row for row in found if row.measure == "error level"]
    assert "more than 1000 times" in row.sentence


# ---------------------------------------------------------------------- what a row says
STIFF = ct.ss([[0, 1], [-40, -0.6]], [[0], [40]], [[1, 0]], 0, inputs="u", outputs="y", states=["x", "v"])


def released(law, seed=0):
    """A decay from 1.2, by small Euler steps, beside a tiny known force."""
    rng = np.random.default_rng(seed)
    w, x, v, run = 1e-3 * rng.standard_normal(N), 1.2, 0.0, []
    for force in w:
        run.append(x)
        for _ in range(20):
            v += STEP / 20 * (40 * force - 40 * x - 0.6 * v - law(x, v))
            x += STEP / 20 * v
    y = np.array(run)
    y = y + 0.005 * y.std() * rng.standard_normal(N)
    return Measurement(w, y, dt=STEP, input_labels="u", output_labels="y")


@pytest.mark.parametrize(
    ("law", "said"),
    [
        (lambda x, v: 40 * (np.sin(x) - x), "weakens the restoring force"),  # a pendulum
        (lambda x, v: -25 * np.sign(x) * max(abs(x) - 0.6, 0), "weakens the restoring force"),
        (lambda x, v: 8 * x**3, "grows more than proportionally to displacement, like a hardening spring"),
        (lambda x, v: 0.1 * v * abs(v), "grows more than proportionally to speed, like drag"),
        (lambda x, v: -0.05 * v * abs(v), "grows less than proportionally"),
        (lambda x, v: -0.7 * np.tanh(100 * v), "acts along it, unlike friction"),
    ],
)
def test_a_force_is_named_with_its_sign(law, said):
    found = rco.compare(STIFF, released(law)).failures
    row = next(row for row in found if row.dimension == "state")
    assert said in row.sentence
    assert ("hardening" in row.sentence) == ("hardening" in said)


@pytest.mark.parametrize(("bend", "said"), [(0.8, "more effect"), (-0.8, "less effect")])
def test_a_bent_input_is_named_with_its_sign(bend, said):
    data = record()
    w = data.inputs[0]
    acts = w + bend * (w - np.clip(w, -2.0, 2.0))
    y = ct.forced_response(axis().sample(STEP), U=acts).outputs
    y = y + 0.01 * y.std() * np.random.default_rng(0).standard_normal(N)
    rows = rco.compare(axis(), Measurement(w, y, dt=STEP)).failures
    row = next(row for row in rows if row.dimension == "amplitude")
    assert row.values["level"] == pytest.approx(2.0, rel=0.1)
    assert said in row.sentence


@pytest.mark.parametrize(("late", "said"), [(3, "a delay in the signal path"), (-3, "different clocks")])
def test_what_comes_early_has_no_delay(late, said):
    w = np.random.default_rng(0).standard_normal(N)
    y = np.roll(ct.forced_response(STIFF.sample(STEP), U=w).outputs, late)
    y = y + 0.02 * y.std() * np.random.default_rng(1).standard_normal(N)
    row = rco.compare(STIFF, Measurement(w, y, dt=STEP)).failures[0]
    assert row.values["samples"] == pytest.approx(late, abs=0.05)
    assert said in row.sentence


def test_no_failure_is_denied_where_none_was_searched():
    """A closed loop, an unstable model and a short record."""
    rng, plant = np.random.default_rng(0), ct.ss([[-1.0]], [[1.0]], [[1.0]], 0, inputs="u", outputs="y")
    wanted, d, y = rng.standard_normal(N), plant.sample(STEP), np.zeros(N)
    for k in range(N - 1):
        y[k + 1] = d.A[0, 0] * y[k] + d.B[0, 0] * 2.0 * (wanted[k] - y[k])
    u, sensed = 2.0 * (wanted - y), y + 0.01 * y.std() * rng.standard_normal(N)
    data = Measurement(u, sensed, dt=STEP, input_labels="u", output_labels="y")
    gain = ct.ss([], [], [], [[-2.0]], inputs="y", outputs="u")
    away = ct.ss([[1.0]], [[1.0]], [[1.0]], 0, inputs="u", outputs="y")
    looped, short = rco.compare(plant, data, controller=gain), rco.compare(plant, data.segment(0, 1.0))
    for result in (looped, short, rco.compare(away, data)):
        found = result.failures
        assert found.looked == ()
        assert "were not searched" in str(found)
        assert "No failure" not in str(found)
        result.plot("map")


def house(resistance=1.0, mass=1.0):
    """Air and walls: time constants of about 1 and 110 h."""
    Ra, Rm, Ca, Cm = 5.0 * resistance, 0.6, 1.5, 20.0 * mass
    A = [[-(1 / Ra + 1 / Rm) / Ca, 1 / (Rm * Ca)], [1 / (Rm * Cm), -1 / (Rm * Cm)]]
    B = [[1 / (Ra * Ca), 1 / Ca], [0, 0]]
    return ct.ss(A, B, [[1, 0]], 0, inputs=["outside", "heat"], outputs=["T"], states=["air", "walls"])


@pytest.mark.parametrize("samples", [384, 960])
def test_a_constant_that_the_initial_state_takes_up_is_not_the_difference(samples):
    """The sensor is exact, and the mean error is that of the comparison."""
    rng, t = np.random.default_rng(2), 0.25 * np.arange(samples)
    outside = 5 + 4 * np.sin(2 * np.pi * t / 24) + np.cumsum(rng.standard_normal(samples)) * 0.1
    heat = 2 * ((t % 24 > 6) & (t % 24 < 22)) * (1 + 0.3 * rng.standard_normal(samples))
    sun = np.maximum(np.sin(2 * np.pi * (t - 6) / 24), 0)
    w = np.array([outside, heat])
    y = ct.forced_response(house().sample(0.25), U=w + [[0], [1]] * sun, X0=[16, 16]).outputs[0]
    y = y + 0.05 * rng.standard_normal(samples)
    labels = {"input_labels": ["outside", "heat"], "output_labels": "T", "output_units": "degC"}
    found = rco.compare(house(1.15, 0.8), Measurement(w, y, dt=0.25, **labels))
    mean = found.residual[0].mean()
    for row in found.failures:
        if row.measure == "offset":
            assert row.sentence.startswith("With another initial state")
            assert f"its mean error is {mean:+.3g} degC" in row.sentence
