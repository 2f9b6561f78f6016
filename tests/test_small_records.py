"""Records of 36 to 140 samples: what they show, and that little is claimed of them."""

from __future__ import annotations

import control as ct
import numpy as np
import pytest
from cases import named, slow
from inner import candidate_columns, estimated_motion, fitted_from, residual_tests
from scipy.signal import lfilter

import rcorefine as rco

HOUSE = ct.ss(
    [[-0.324, 0.216], [0.108, -0.108]], [[1.0], [0.0]], [[1.0, 0.0]], 0,
    inputs="heat", outputs="room", states=["room", "wall"],
)  # fmt: skip
MASS = ct.ss([[0, 1], [-100, -1.5]], [[0], [1]], [[1, 0]], 0, inputs="force", outputs="x", states=["x", "v"])


def mass_record(
    n: int, seed: int, cubic: float = 0.0, gain: float = 1.0, slow: float = 0.0
) -> rco.Measurement:
    """A mass on a spring with ``cubic x^3``, by the midpoint rule, 50 steps a sample; 1 % noise."""
    rng, h = np.random.default_rng([51, seed]), 0.05 / 50
    u, x, v, y = rng.standard_normal(n), 0.0, 0.0, np.zeros(n)
    for k in range(n):
        y[k] = x
        for _ in range(50):
            a = gain * u[k] - 100 * x - 1.5 * v - cubic * x**3
            m, w = x + h / 2 * v, v + h / 2 * a
            x, v = x + h * w, v + h * (gain * u[k] - 100 * m - 1.5 * w - cubic * m**3)
    noise = np.sqrt(1 - slow**2) * lfilter([1.0], [1.0, -slow], rng.standard_normal(n + 50))[50:]
    return rco.Measurement(u, y + 0.01 * y.std() * noise, dt=0.05, input_labels="force", output_labels="x")


@pytest.mark.parametrize("n", [60, *slow(140)])
def test_a_short_record_names_what_is_missing_and_nothing_else(n: int) -> None:
    found = rco.diagnose(MASS, mass_record(n, 0, cubic=6000.0))
    named(found, rco.Effect("cubic_stiffness", "x"), 6000.0)
    assert rco.diagnose(MASS, mass_record(n, 1)).verdict == "adequate"


def test_sixty_samples_can_be_improved_and_fewer_say_what_is_needed() -> None:
    data = mass_record(60, 2, gain=1.3)
    found = rco.improve(MASS, data, candidates=[rco.Effect("input_gain", "force")])
    assert [e.kind for e in found.effects] == ["input_gain"]
    with pytest.raises(rco.DataError, match="give at least 60"):
        rco.improve(MASS, data.segment(0, 2.0))
    with pytest.raises(rco.DataError, match="give at least 36"):
        rco.diagnose(MASS, data.segment(0, 1.5))


def test_intervals_of_refine_hold_on_sixty_samples_beside_slow_noise() -> None:
    """Two standard deviations hold the truth in 95 %: 2 of 3 coefficients in 20 records miss by chance."""
    inside, truth = 0, (100.0, 1.5, 1.0)
    for seed in range(20):
        found = rco.refine(MASS, mass_record(60, 100 + seed, slow=0.5), free="linear", offset=False)
        rows = [row for row in found.parameters if np.isfinite(row.std)]
        inside += sum(abs(row.value - value) < 2 * row.std for row, value in zip(rows, truth, strict=True))
    assert inside >= 52  # of 60: 1 in 100 by chance at 95 %


def test_coefficients_of_the_noise_count_as_degrees_of_freedom() -> None:
    data = mass_record(60, 3, slow=0.9)
    base = rco.refine(MASS, data, offset=True)
    tested = residual_tests.TestedResidual(fitted_from(base, [data], tolerance=0.0))
    (order,) = tested.whitener.orders
    assert order > 0
    assert tested.basis.rank == 3 + order  # two initial states and an offset


def test_as_many_lags_are_tested_as_a_record_bears() -> None:
    """A column per five samples, and all lags of a long record."""
    for n, lags in ((60, 11), (140, 27), (400, 40)):
        found = rco.diagnose(MASS, mass_record(n, 4), candidates=[rco.Effect("input_gain", "force")])
        assert {test.name: test.dof for test in found.tests}["input"] == lags


def test_check_promises_what_a_short_record_shows() -> None:
    """A gain of the smallest size that is promised fails the tests in 95 of 100 records."""
    seen = 0
    for seed in range(20):
        shown = rco.check(MASS, mass_record(60, 200 + seed)).detectable
        least = next(d.smallest for d in shown if d.effect.kind == "input_gain")
        data = mass_record(60, 200 + seed, gain=1.0 + least)
        base = rco.refine(MASS, data)
        tested = residual_tests.TestedResidual(fitted_from(base, [data], tolerance=0.0))
        motion = estimated_motion(tested.fitted.structure, base.theta, data)
        scored = candidate_columns(tested.fitted, rco.effect_library(MASS), motion, (0.0,))
        seen += residual_tests.overall(residual_tests.run_tests(tested, scored, [motion])) < 0.01
    assert seen >= 16  # fewer in 1 of 400 such runs


def house_record(n: int, noise: float) -> rco.Measurement:
    rng = np.random.default_rng(7)
    heat, sun = np.repeat(rng.uniform(-2, 2, (2, n // 5)), 5, axis=1)
    y = ct.forced_response(ct.sample_system(HOUSE, 0.5), U=heat).outputs
    y = y + noise * y.std() * rng.standard_normal(n)
    return rco.Measurement([heat, sun], y, dt=0.5, input_labels=["heat", "sun"], output_labels="room")


def test_check_says_which_length_is_enough_for_a_parameter() -> None:
    """The smallest size falls with the root of the length at least."""
    found = rco.check(HOUSE, house_record(60, 0.05))
    (row,) = [r for r in found.rows if r.what == "information" and r.status == "look"]
    value = {"coefficient at A[0,1]": 0.216, "coefficient at A[1,0]": 0.108}
    sizes = {d.effect.label: d.smallest for d in found.detectable}
    label = next(name for name in value if value[name] < sizes[name] < 100 * value[name])
    needed = float(f"{60 * (sizes[label] / value[label]) ** 2:.1g}")
    assert f"{label} (about {needed:.0f} samples are enough)" in row.sentence
    assert "too few to test" in str(rco.check(HOUSE, house_record(30, 0.4)))


def test_check_names_an_input_that_acts_on_nothing() -> None:
    (row,) = [r for r in rco.check(HOUSE, house_record(140, 0.02)).rows if r.what == "inputs"]
    assert row.sentence == (
        "sun acts on nothing in the model: its column of B and D is zero. Its entries are candidates of "
        "diagnose."
    )
    own = ct.ss(
        HOUSE.A, np.hstack([HOUSE.B, 0 * HOUSE.B]), HOUSE.C, 0, inputs=["heat", "sun"], outputs="room"
    )
    assert "sun acts on nothing" in str(rco.check(own, house_record(140, 0.02)))
    fed = ct.ss(HOUSE.A, np.hstack([HOUSE.B, HOUSE.B]), HOUSE.C, 0, inputs=["heat", "sun"], outputs="room")
    assert "acts on nothing" not in str(rco.check(fed, house_record(140, 0.02)))
