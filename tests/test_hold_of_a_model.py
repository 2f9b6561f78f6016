"""A hold that was found goes with the model: whatever simulates it takes the inputs as it was fitted."""

from __future__ import annotations

from dataclasses import replace

import control as ct
import numpy as np
import pytest
from cases import sweep
from scipy.linalg import expm

import rcorefine as rco

DT = 0.11
A = np.array([[0.0, 1.0], [-70.0, -0.5]])
B = np.array([[0.0], [1.0]])


def plant() -> rco.PhysicalModel:
    """One mass, seven samples to a period: the hold matters."""
    return rco.mass_spring_damper([1.0], [0.5], [70.0], sensors="displacement")


def record(seed: int, n: int = 2500, spring: float = 0.0, noise: float = 0.02) -> rco.Measurement:
    """Inputs that run in straight lines, the record declares steps; exact by the matrix exponential."""
    rng = np.random.default_rng(seed)
    w = rng.standard_normal(n)
    whole = np.zeros((4, 4))  # x, w, slope of w
    whole[:2, :2], whole[:2, 2:3], whole[2, 3] = A - np.array([[0, 0], [spring, 0]]), B, 1.0
    step = expm(whole * DT)
    x, seen = np.zeros(2), np.empty(n)
    for k in range(n):
        seen[k] = x[0]
        slope = (w[min(k + 1, n - 1)] - w[k]) / DT
        x = (step @ np.concatenate([x, [w[k], slope]]))[:2]
    return rco.Measurement(w, seen + noise * seen.std() * rng.standard_normal(n), dt=DT, hold="zoh")


def test_the_ledgers_last_figure_is_that_of_compare() -> None:
    """The record says steps, the truth is straight lines, and a spring is softer: all in one ladder."""
    data, test = record(21, spring=-6.0), record(22, n=1200, spring=-6.0)
    laws = [rco.Effect(kind, "link1") for kind in ("stiffness", "damping", "cubic_stiffness")]
    ladder = rco.improve(plant(), data, validation=test, candidates=laws)
    assert ladder.refinement.hold == "foh"
    assert [effect.kind for effect in ladder.effects] == ["stiffness"]
    after = rco.compare(ladder.refinement, test)
    assert after.rmse == pytest.approx(ladder.steps[-1].validation_rmse, rel=1e-9)
    assert after.rmse[0] == pytest.approx(0.02 * test.outputs.std(), rel=0.1)
    assert any("hold='foh'" in note and "'zoh'" in note for note in after.notes)
    assert "hold='foh'" in str(ladder.refinement)
    # what goes on from the model keeps to it
    assert rco.diagnose(ladder.refinement, data, candidates=laws[1:]).verdict == "adequate"
    again = rco.refine(ladder.refinement, data)
    assert again.hold == "foh"
    assert again.rmse == pytest.approx(ladder.refinement.rmse, rel=0.05)


@pytest.mark.parametrize("declared", ["zoh", "foh", "bandlimited"])
def test_a_model_with_a_hold_is_simulated_by_it(declared: str) -> None:
    """Whatever the record declares; and the plain model by what the record declares."""
    data = record(5, n=400).with_hold(declared)
    own = replace(plant(), hold="foh")
    run = rco.compare([own, plant()], data, x0="zero")
    alike = rco.compare(plant(), data.with_hold("foh"), x0="zero")
    assert np.array_equal(run.residual[0], alike.residual)
    assert np.array_equal(run.residual[0], run.residual[1]) == (declared == "foh")
    assert run.holds == ("foh", declared)
    assert run.seen_by(0).hold == "foh"


def test_a_hold_that_does_not_exist_or_does_not_fit_a_stream_is_refused() -> None:
    """And a stream that is held otherwise than the model was found to be."""
    with pytest.raises(ct.ControlArgument, match="hold"):
        replace(plant(), hold="soh")
    own = replace(plant(), hold="foh")
    with pytest.raises(rco.ModelError, match="hold='foh'"):
        rco.Monitor(own, dt=DT)
    with pytest.raises(rco.ModelError, match="hold='foh'"):
        rco.RCORefiner(own, dt=DT, effects=[rco.Effect("stiffness", "link1")])
    rco.Monitor(own, dt=DT, hold="foh")


def two_masses(k1: float = 1500.0, k2: float = 900.0, m1: float = 2.0) -> tuple[np.ndarray, np.ndarray]:
    mass = np.array([m1, 1.2])[:, None]
    spring = np.array([[k1 + k2, -k2], [-k2, k2]]) / mass
    damper = np.array([[4.5, -1.5], [-1.5, 1.5]]) / mass
    return np.block([[np.zeros((2, 2)), np.eye(2)], [-spring, -damper]]), np.array([[0], [0], [1 / m1], [0]])


OFF = {"k1": 1515.0, "k2": 891.0, "m1": 1.98}


@pytest.mark.parametrize(
    ("off", "lines", "seed"),
    sweep([({}, True, 0), (OFF, True, 0)], ({}, OFF), (True, False), range(2)),
)
def test_a_wrong_hold_comes_before_numbers_that_are_off(
    off: dict[str, float], lines: bool, seed: int
) -> None:
    """A smooth input runs half a step late under the wrong hold: six numbers can make up for that."""
    n, dt, rng = 2500, 0.025, np.random.default_rng(seed)
    w = np.convolve(rng.standard_normal(n + 30), np.hanning(17), "same")[15:-15]
    whole = np.zeros((6, 6))
    whole[:4, :4], whole[:4, 4:5] = two_masses(**off)
    whole[4, 5] = 1.0
    step, x, seen = expm(whole * dt), np.zeros(4), np.empty(n)
    for k in range(n):
        seen[k] = x[1]
        slope = (w[min(k + 1, n - 1)] - w[k]) / dt if lines else 0.0
        x = (step @ np.concatenate([x, [w[k], slope]]))[:4]
    data = rco.Measurement(w, seen + 0.02 * seen.std() * rng.standard_normal(n), dt=dt, hold="zoh")
    found = rco.diagnose(ct.ss(*two_masses(), [[0, 1, 0, 0]], 0, states=["q1", "q2", "v1", "v2"]), data)
    assert (found.verdict == "adequate") == (not off)
    assert found.base.hold == ("foh" if lines else None)
