"""improve: the ladder on records with hidden effects whose number and kind are known."""

from __future__ import annotations

import pickle

import control as ct
import numpy as np
import pytest
from cases import slow
from hidden.generator import Law, held_motion

import rcorefine as rco
from rcorefine.diagnosis.case import excerpt

DT = 0.01


def chain():
    return rco.mass_spring_damper(
        [1.0, 1.2], [0.3, 0.2, 0.2], [200.0, 150.0, 120.0], force=1, sensors=[("velocity", 1)]
    )


ACTS = {"link1": [-1.0, 0.0], "link2": [1.0, -1.0], "link3": [0.0, -1.0]}
STRETCH = {"link1": [1.0, 0.0], "link2": [-1.0, 1.0], "link3": [0.0, 1.0]}


def record(effects, seed, noise=0.03, n=4000):
    """Truth on matrices written out here, by the integrator of tests/hidden."""
    rng = np.random.default_rng(seed)
    w = 10 * rng.standard_normal(n)
    inverse = np.linalg.inv(np.diag([1.0, 1.2]))
    C, K = np.array([[0.5, -0.2], [-0.2, 0.4]]), np.array([[350.0, -150], [-150, 270]])
    A = np.block([[np.zeros((2, 2)), np.eye(2)], [-inverse @ K, -inverse @ C]])
    nothing, laws = np.zeros(2), []
    for kind, link, value in effects:
        push, sense = inverse @ ACTS[link], STRETCH[link]
        rows = (np.r_[nothing, push], np.r_[sense, nothing], np.r_[nothing, sense])
        laws.append((Law(kind, np.array([value, 0.0, 0.0])), *rows))
    y = held_motion(A, np.outer(w, np.r_[nothing, inverse[0]]), DT, laws)[:, 2]
    return rco.Measurement(w, y + noise * y.std() * rng.standard_normal(n), dt=DT)


LAWS = [
    rco.Effect(kind, f"link{i}")
    for i in (1, 2, 3)
    for kind in ("stiffness", "damping", "cubic_stiffness", "quadratic_damping", "coulomb_friction")
]


@pytest.mark.slow
def test_two_effects_are_found_and_the_held_out_error_falls_to_the_noise():
    hidden = [("cubic_stiffness", "link2", 400.0), ("quadratic_damping", "link1", 0.4)]
    data = record(hidden, seed=1)
    ladder = rco.improve(chain(), data, candidates=LAWS)
    assert {(e.kind, e.place) for e in ladder.effects} == {(k, p) for k, p, _ in hidden}
    assert ladder.verdict == "adequate"
    assert ladder.diagnosis.verdict == "effect"
    noise = 0.03 * np.std(data.outputs)
    assert ladder.steps[-1].validation_rmse[0] == pytest.approx(noise, rel=0.1)
    assert ladder.steps[0].validation_rmse[0] > 2 * noise
    for kind, place, value in hidden:
        row = ladder.refinement.parameter(kind, place)
        assert abs(row.coefficient - value) < 4 * row.std
    text = str(ladder)
    assert max(map(len, text.splitlines())) <= 80
    assert "held out" in text
    again = pickle.loads(pickle.dumps(ladder))
    assert again.effects == ladder.effects


def test_no_step_where_nothing_is_missing():
    ladder = rco.improve(chain(), record([], seed=2, n=1500), candidates=LAWS)
    assert len(ladder.steps) == 1
    assert ladder.verdict == "adequate"
    assert ladder.steps[0].effect is None


def test_validation_record_judges_and_max_effects_stops():
    data = record([("stiffness", "link2", -30.0)], seed=3, n=1500)
    other = record([("stiffness", "link2", -30.0)], seed=4, n=1000)
    ladder = rco.improve(chain(), data, validation=other, candidates=LAWS)
    assert [(e.kind, e.place) for e in ladder.effects] == [("stiffness", "link2")]
    assert ladder.steps[-1].validation_rmse[0] < ladder.steps[0].validation_rmse[0]
    stopped = rco.improve(chain(), data, candidates=LAWS, max_effects=0)
    assert len(stopped.steps) == 1
    assert stopped.verdict != "adequate"


def test_bad_input():
    data = record([], seed=5, n=50)
    with pytest.raises(rco.DataError, match="too short"):
        rco.improve(chain(), data)
    with pytest.raises(ct.ControlArgument, match="max_effects"):
        rco.improve(chain(), data, max_effects=-1)
    with pytest.raises(TypeError):
        rco.improve(chain(), data, nonsense=1)


@pytest.mark.parametrize(("count", "samples"), [(1, 50_000), (2, 9_000), (12, 1_000), (40, 600)])
def test_a_long_record_is_climbed_on_in_pieces_of_all_of_it(count: int, samples: int) -> None:
    """Pieces long enough to test, of records spread over all, and never more than the limit."""
    records = [
        rco.Measurement(np.full(samples, 1.0 + i), np.full(samples, float(i)), dt=0.1) for i in range(count)
    ]
    pieces = excerpt(records)
    assert sum(piece.n_samples for piece in pieces) <= 8000
    assert min(piece.n_samples for piece in pieces) >= 500
    levels = {float(piece.outputs[0, 0]) for piece in pieces}
    assert {0.0, count - 1.0} <= levels
    assert len(levels) == min(count, 16)


def test_short_records_are_climbed_on_whole() -> None:
    """What fits is not cut."""
    records = [rco.Measurement(np.ones(3000), np.ones(3000), dt=0.1)] * 2
    assert excerpt(records) is records


def test_coulomb_friction_with_an_offset_is_tied_with_asymmetric_friction() -> None:
    """F+ and F- are one force and one constant: no record tells them apart."""
    rng = np.random.default_rng(3)
    push = 10 * rng.standard_normal(1500)
    friction = Law("coulomb_friction", np.array([1.5, 1e-3, 0.0]))
    rows = (np.array([-1.0]), np.array([0.0]), np.array([1.0]))
    y = held_motion([[-2.0]], push[:, None] + 0.7, 0.05, [(friction, *rows)])[:, 0]
    data = rco.Measurement(push, y + 0.01 * y.std() * rng.standard_normal(y.size), dt=0.05, hold="zoh")
    model = rco.dc_motor(gain=0.5, time_constant=0.5)
    laws = [rco.Effect(kind, "shaft") for kind in ("coulomb_friction", "damping")]
    ladder = rco.improve(model, data, candidates=laws)
    step = ladder.steps[1]
    assert step.effect.kind == "coulomb_friction"
    assert [effect.kind for effect in step.rivals] == ["asymmetric_friction"]
    assert any("by another name" in note for note in ladder.notes)


def hardening(size, samples, seed):
    """A mass on a spring 100 d + 60 d^3 by Runge and Kutta, the force straight between samples."""
    rng, dt, x = np.random.default_rng(seed), 0.02, np.zeros(2)
    force, found = size * rng.standard_normal(samples), np.zeros(samples)

    def rate(x, u):
        return np.array([x[1], u - 0.4 * x[1] - 100 * x[0] - 60 * x[0] ** 3])

    for k in range(samples - 1):
        for j in range(4):
            h, u = dt / 4, [force[k] + (force[k + 1] - force[k]) * (j + s) / 4 for s in (0, 0.5, 1)]
            a = rate(x, u[0])
            b = rate(x + h / 2 * a, u[1])
            c = rate(x + h / 2 * b, u[1])
            x = x + h / 6 * (a + 2 * b + 2 * c + rate(x + h * c, u[2]))
        found[k + 1] = x[0]
    noisy = found + 0.02 * found.std() * rng.standard_normal(samples)
    return rco.Measurement(force, noisy, dt=dt, hold="foh")


@pytest.mark.parametrize("seed", [0, *slow(1, 2)])
def test_ties_are_those_that_a_diagnosis_of_the_same_record_lists(seed):
    """What three fifths of a record cannot tell apart, all of it may."""
    one = rco.mass_spring_damper([1.0], [0.4], [100.0], sensors="displacement")
    laws = rco.effect_library(one, kinds=["cubic_stiffness", "clearance", "end_stop", "stiffness", "damping"])
    data = hardening(4.0, 1000, seed)
    found = rco.diagnose(one, data, candidates=laws)
    ladder = rco.improve(one, data, validation=hardening(4.0, 400, seed + 10), candidates=laws)
    assert [step.effect.label for step in ladder.steps[1:]] == [found.best.effect.label]
    tied = {effect.label for effect in (ladder.steps[1].effect, *ladder.steps[1].rivals)}
    assert tied == {effect.label for effect in found.ambiguous}
    assert ladder.diagnosis.verdict == found.verdict
    assert set(ladder.effects) == set(found.effects)


def test_a_record_in_which_nothing_was_excited_is_refused():
    """Nothing moves: neither 'adequate' nor a set may be said of it."""
    still = rco.Measurement(np.zeros(900), 0.01 * np.random.default_rng(0).standard_normal(900), dt=DT)
    with pytest.warns(rco.ExcitationWarning), pytest.raises(rco.DataError, match="nothing was excited"):
        rco.improve(chain(), still, candidates=LAWS)


def test_a_sensor_that_is_dead_is_left_out_of_the_path():
    """The second output stays at zero in the record and in the held-out one."""
    one = rco.mass_spring_damper([1.0], [0.4], [100.0], sensors="displacement")
    linear = one.linear
    model = ct.ss(
        linear.A, linear.B, np.vstack([linear.C, [[0.0, 1.0]]]), np.zeros((2, 1)),
        states=["x", "v"], inputs=["force"], outputs=["place", "speed"],
    )  # fmt: skip
    records = []
    for seed, samples in ((0, 1000), (1, 400)):
        record = hardening(40.0, samples, seed)
        both = np.vstack([record.outputs, np.zeros((1, samples))])
        records.append(rco.Measurement(record.inputs, both, dt=record.dt, hold="foh"))
    laws = [rco.Effect(kind, "x") for kind in ("cubic_stiffness", "stiffness", "damping")]
    found = rco.improve(model, records[0], validation=records[1], candidates=laws)
    assert [effect.kind for effect in found.effects] == ["cubic_stiffness"]
    assert found.steps[-1].validation_rmse.shape == (1,)
    assert found.steps[-1].validation_rmse[0] < 0.3 * found.steps[0].validation_rmse[0]
