"""Faults that few samples carry, beside noise that few samples carry."""

from __future__ import annotations

import control as ct
import numpy as np
import pytest
from cases import few_or_all, offered, slow
from hidden.generator import hidden_record
from inner import f_test, project, rank_basis
from scipy.signal import lfilter

import rcorefine as rco
from rcorefine.inference.whitening import huber_weights


def heated_wall(seed: int, limit: float, noise: float, samples: int = 1200) -> tuple[rco.Measurement, float]:
    """A wall that vents into the room above a limit, a sensor with a cap; Euler, 50 steps a sample."""
    rng = np.random.default_rng(seed)
    heat = np.repeat(rng.uniform(0, 4, samples // 15), 15)
    wall = room = 0.0
    y = np.zeros(samples)
    for k in range(samples):
        y[k] = room
        for _ in range(50):
            vent = 2.0 * max(wall - limit, 0.0)
            lost = 0.05 * wall
            wall += 0.02 * (0.1 * heat[k] - lost - vent)
            room += 0.02 * (lost + 0.3 * vent - 0.03 * room)
    size = noise * y.std()
    error = lfilter([1.0], [1.0, -0.9], size * rng.standard_normal(samples))
    return rco.Measurement(heat, np.minimum(y, np.quantile(y, 0.985)) + error, dt=1.0), size / np.sqrt(0.19)


FEW = ("threshold_flow", "quadratic_damping", "output_saturation")


#: Heavy tails of the noise explain what shows in few samples, and a loss at the wall imitates the vent.
IMITATED = pytest.mark.xfail(reason="a set of other laws imitates these two")


@pytest.mark.parametrize(
    "kinds",
    [pytest.param(FEW, marks=IMITATED), pytest.param(None, marks=[pytest.mark.slow, IMITATED])],
    ids=["few", "all"],
)
def test_vent_and_cap_are_found_on_a_room_that_rarely_shows_them(kinds: tuple[str, ...] | None) -> None:
    data, noise = heated_wall(10, 4.5, 0.002)
    model = ct.ss(
        [[-0.05, 0.0], [0.05, -0.03]], [[0.1], [0.0]], [[0.0, 1.0]], 0,
        inputs="heater", outputs="room", states=["wall", "room"],
    )  # fmt: skip
    laws = [law for law in rco.effect_library(model) if kinds is None or law.kind in kinds]
    found = rco.improve(model, data, free="linear", candidates=laws)
    held = set()
    for step in found.steps[1:]:
        change = held.discard if step.action == "drop" else held.add
        change((step.effect.kind, step.effect.place))
    assert held == {("threshold_flow", "wall->room"), ("output_saturation", "room")}
    assert found.steps[-1].validation_rmse[0] < 2.0 * noise  # 25 times less than at the start


@pytest.mark.parametrize("tail", ["spikes", "t2"])
def test_a_small_fault_shows_beside_a_few_large_errors(tail: str) -> None:
    plain, both = [], []
    for seed in range(20):
        rng = np.random.default_rng([5, seed])
        x = lfilter([1.0], [1.0, -0.8], rng.standard_normal(800))[:, None]
        e = rng.standard_normal(800)
        e = e * np.where(rng.random(800) < 0.01, 30.0, 1.0) if tail == "spikes" else rng.standard_t(2, 800)
        basis = rank_basis(np.ones((800, 1)))
        left = project(e + 0.25 * x[:, 0] / x.std(), basis)
        weights = huber_weights(left, np.zeros(800, dtype=int))
        assert weights is not None
        plain.append(f_test("x", left, x, basis).p_value)
        own = rank_basis(weights[:, None] * basis)
        both.append(f_test("x", project(weights * left, own), weights[:, None] * x, own).p_value)
    assert np.median(both) < 0.1 * np.median(plain)


def test_noise_that_is_equal_keeps_its_samples() -> None:
    rng = np.random.default_rng(8)
    weighted = [huber_weights(rng.standard_normal(500), np.zeros(500, dtype=int)) for _ in range(400)]
    assert sum(w is not None for w in weighted) <= 8  # beyond 5 standard deviations; kurtosis has a long tail


def test_each_output_has_a_scale_of_its_own() -> None:
    rng = np.random.default_rng(9)
    residual = np.concatenate([1e-6 * rng.standard_normal(500), 1e3 * rng.standard_t(2, 500)])
    weights = huber_weights(residual, np.repeat([0, 1], 500))
    assert weights is not None
    assert np.mean(weights[:500] < 1) == pytest.approx(0.18, abs=0.06)  # P(|z| > 1.345)


@pytest.mark.parametrize("kinds", few_or_all("stiffness", "damping", "coulomb_friction", "output_saturation"))
@pytest.mark.parametrize("noise_kind", ["spikes", *slow("dropouts", "t3")])
def test_no_step_where_only_noise_stands_out(noise_kind: str, kinds: tuple[str, ...] | None) -> None:
    hidden = hidden_record(82500, effect=None, samples=1500, noise_kind=noise_kind)
    model = hidden.plant.model
    found = rco.improve(model, hidden.data, candidates=offered(model, kinds))
    assert (len(found.steps), found.verdict) == (1, "adequate")
