"""Rows of the failure map that would mislead: what another row explains is no row of its own."""

from __future__ import annotations

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
