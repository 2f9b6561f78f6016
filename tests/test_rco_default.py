"""RCORefiner(model, dt=...) with no other setting: plants of a control course, from wrong parameters."""

from __future__ import annotations

import itertools
import os
import pickle
import re
import signal
import threading
import time
import warnings

import control as ct
import numpy as np
import pytest
from cases import slow
from inner import BlockFilter
from scipy.linalg import expm
from scipy.signal import cont2discrete, dlsim
from scipy.stats import binom

import rcorefine as rco
from rcorefine import RCORefiner


def system(A, B, C, D=None):
    A, C = np.atleast_2d(A).astype(float), np.atleast_2d(C).astype(float)
    B = np.asarray(B, float).reshape(len(A), -1)
    return ct.ss(A, B, C, np.zeros((len(C), B.shape[1])) if D is None else np.atleast_2d(D))


def sampled(plant, dt):
    n, n_w = plant.B.shape
    block = np.zeros((n + n_w, n + n_w))
    block[:n] = np.hstack([plant.A, plant.B])
    step = expm(block * dt)
    return step[:n, :n], step[:n, n:]


def simulated(plant, dt, w, x0=None, gain=None):
    """Samples of a plant under a held input, by scipy's expm; with `gain` under state feedback as well."""
    A, B = sampled(plant, dt)
    x = np.zeros(len(A)) if x0 is None else np.array(x0, float)
    w, y = w.copy(), np.empty((plant.C.shape[0], w.shape[1]))
    for k in range(w.shape[1]):
        if gain is not None:
            w[:, k] -= gain @ x
        y[:, k] = plant.C @ x + plant.D @ w[:, k]
        x = A @ x + B @ w[:, k]
    return w, y


def steps(seed, n_samples, channels=1, every=15):
    rng = np.random.default_rng(seed)
    return np.repeat(rng.uniform(-1, 1, (channels, n_samples // every + 1)), every, axis=1)[:, :n_samples]


def noisy(y, level, seed):
    return y + level * y.std(axis=1, keepdims=True) * np.random.default_rng(seed + 1000).standard_normal(
        y.shape
    )


def free_run(plant, dt, w, y):
    """Fit in %, worst output, from the initial state that fits best: an oracle of its own."""
    n = plant.A.shape[0]
    _, forced = simulated(plant, dt, w)
    free = np.array([simulated(plant, dt, 0 * w, x0)[1] for x0 in np.eye(n)])
    size = y.std(axis=1, keepdims=True)
    columns = (free / size).reshape(n, -1).T
    x0 = np.linalg.lstsq(columns, ((y - forced) / size).ravel(), rcond=None)[0]
    e = y - forced - np.tensordot(x0, free, axes=1)
    return float(
        np.min(
            100 * (1 - np.linalg.norm(e, axis=1) / np.linalg.norm(y - y.mean(axis=1, keepdims=True), axis=1))
        )
    )


def motor(J=0.02, b=0.15, K=0.2, R=1.5, L=0.4):
    return system([[-b / J, K / J], [-K / L, -R / L]], [0, 1 / L], [1, 0])


def positioner(J=0.02, b=0.08, gain=0.3):
    return system([[0, 1], [0, -b / J]], [0, gain / J], [1, 0])


def two_masses(m1=1.0, m2=0.8, c1=0.08, c2=0.1, k1=25.0, k2=18.0):
    A = np.zeros((4, 4))
    A[0, 2] = A[1, 3] = 1
    A[2] = [-(k1 + k2) / m1, k2 / m1, -(c1 + c2) / m1, c2 / m1]
    A[3] = [k2 / m2, -k2 / m2, c2 / m2, -c2 / m2]
    return system(A, [0, 0, 1 / m1, 0], [0, 1, 0, 0])


def accelerometer(m=2.0, c=1.5, k=70.0):
    rate = [-k / m, -c / m]
    return system([[0, 1], rate], [0, 1 / m], rate, [[1 / m]])


def on_a_base(m=2.0, c=1.5, k=70.0):
    """Absolute acceleration of a mass on a base whose acceleration is the input."""
    rate = [-k / m, -c / m]
    return system([[0, 1], rate], [0, -1], rate)


def magnet(m=0.1, kx=16.0, ki=4.0):
    return system([[0, 1], [kx / m, 0]], [0, ki / m], [1, 0])


OFF = {
    "motor": (motor(), motor(0.028, 0.1, 0.15, 2.1, 0.55), 0.02),
    "integrator": (positioner(), positioner(0.026, 0.05, 0.36), 0.02),
    "two masses, one sensor": (two_masses(), two_masses(1.3, 0.65, 0.11, 0.06, 19.0, 24.0), 0.04),
    "acceleration sensor": (accelerometer(), accelerometer(2.7, 0.9, 50.0), 0.02),
    "base motion": (on_a_base(), on_a_base(2.6, 2.2, 52.0), 0.02),
}


@pytest.mark.parametrize("seed", [0, *slow(1, 2)])
@pytest.mark.parametrize("name", OFF)
def test_as_good_as_the_true_model_on_what_follows(name, seed):
    truth, start, dt = OFF[name]
    w, y = simulated(truth, dt, steps(seed, 5000))
    y = noisy(y, 0.02, seed)
    refiner = RCORefiner(start, dt=dt)
    refiner.update(w[:, :3500], y[:, :3500])
    rest = w[:, 3500:], y[:, 3500:]
    found = free_run(refiner.system, dt, *rest)
    assert free_run(start, dt, *rest) < 90, "the start leaves nothing to do"
    assert found > free_run(truth, dt, *rest) - 1
    assert refiner.form in ("nonzero", "discrete")
    assert refiner.system.isctime()


def test_the_model_can_be_read_after_every_sample():
    """Reading it raised once a pole had come to lie on the negative real axis."""
    truth, start, dt = OFF["motor"]
    w, y = simulated(truth, dt, steps(5, 400))
    y = noisy(y, 0.02, 5)
    default, paper = (
        RCORefiner(start, dt=dt),
        RCORefiner.paper(start, dt=dt, window=100, markov=1, learning_rate=100.0),
    )
    moved = 0
    for k in range(400):
        for refiner in (default, paper):
            refiner.update(w[:, k], y[:, k])
            with warnings.catch_warnings(record=True) as caught:
                warnings.simplefilter("always")
                found = refiner.system
            moved += len(caught)
            assert found.nstates == 2
            assert found.isctime()
            assert np.isfinite(found.A).all()
    assert moved > 0, "no pole had to be moved, so this record tests nothing"


@pytest.mark.parametrize("seed", [0, *slow(1, 2, 3)])
def test_unstable_plant_under_a_controller(seed):
    truth, start, dt = magnet(), magnet(0.13, 21.0, 3.1), 0.01
    A, B = sampled(truth, dt)
    gain = np.asarray(ct.dlqr(A, B, np.eye(2), np.eye(1))[0])
    w, y = simulated(truth, dt, steps(seed, 5000, every=8), gain=gain)
    refiner = RCORefiner(start, dt=dt)
    refiner.update(w, noisy(y, 0.02, seed))
    omega = np.geomspace(0.1, np.pi / dt, 200)
    found, true = (ct.frequency_response(s, omega).frdata for s in (refiner.system, truth))
    assert np.linalg.norm(found - true) <= 0.01 * np.linalg.norm(true)


def test_a_wrong_structure_is_not_made_worse():
    """Half of the records behind a sensor with a lag, half with unknown forces."""
    dt, start = 0.03, system([[0, 1], [-36.0, -1.2]], [0, 1.4], [1, 0])
    lagging = system([[0, 1, 0], [-28.0, -0.9, 0], [5.0, 0, -5.0]], [0, 1, 0], [0, 0, 1])
    pushed = system([[0, 1], [-28.0, -0.9]], [[0, 0], [1, 1]], [1, 0])
    for seed in range(6):
        w = steps(seed, 4000)
        if seed % 2:
            force = 0.3 * np.random.default_rng(seed).standard_normal((1, 4000))
            y = simulated(pushed, dt, np.vstack([w, force]))[1]
        else:
            y = simulated(lagging, dt, w)[1]
        y = noisy(y, 0.02, seed)
        refiner = RCORefiner(start, dt=dt)
        refiner.update(w[:, :3000], y[:, :3000])
        rest = w[:, 3000:], y[:, 3000:]
        assert free_run(refiner.system, dt, *rest) > free_run(start, dt, *rest) - 1


def test_the_initial_model_stays_where_nothing_predicts_better():
    truth, _, dt = OFF["motor"]
    w, y = simulated(truth, dt, steps(1, 3000))
    noise = np.random.default_rng(1).standard_normal(y.shape)
    refiner = RCORefiner(truth, dt=dt)
    refiner.update(w, noise)  # the outputs tell nothing
    assert free_run(refiner.system, dt, w, noise) > free_run(truth, dt, w, noise) - 1


def test_a_motor_that_rests_in_its_dead_zone_is_learned_once_it_turns():
    """For 2000 samples the outputs say that the input has no effect, and say it with certainty."""
    truth, start, dt = OFF["motor"]
    w = np.hstack([0.3 * steps(7, 2000), 0.6 + steps(8, 3000)])
    y = np.hstack([0.0 * w[:, :2000], simulated(truth, dt, w[:, 2000:])[1]])
    y = y + 0.01 * y.std() * np.random.default_rng(7).standard_normal(y.shape)
    refiner = RCORefiner(start, dt=dt)
    refiner.update(w, y)
    rest = w[:, 3500:], y[:, 3500:]
    assert free_run(refiner.system, dt, *rest) > free_run(truth, dt, *rest) - 1


@pytest.mark.parametrize("name", ["motor", "acceleration sensor", "base motion"])
def test_a_bump_moves_the_state_and_not_the_coefficients(name):
    """For three samples an unmeasured force of twenty times the input acts."""
    truth, start, dt = OFF[name]
    w, y = simulated(truth, dt, steps(1, 5000))
    bump = np.zeros_like(w)
    bump[:, 3000:3003] = 20.0
    y = noisy(y, 0.02, 1) + simulated(truth, dt, bump)[1]
    refiner = RCORefiner(start, dt=dt)
    refiner.update(w[:, :3500], y[:, :3500])
    rest = w[:, 3500:], y[:, 3500:]
    assert free_run(refiner.system, dt, *rest) > free_run(truth, dt, *rest) - 1


def test_a_few_outliers_do_not_make_the_filter_begin_anew():
    truth, start, dt = OFF["motor"]
    w, y = simulated(truth, dt, steps(3, 4000))
    y = noisy(y, 0.02, 3)
    y[0, [1500, 1510, 2500, 3000]] += 100.0 * y.std()
    refiner = RCORefiner(start, dt=dt)
    refiner.update(w, y)
    np.testing.assert_allclose(refiner.system.dcgain(), truth.dcgain(), rtol=0.05)


def test_stability_is_kept():
    truth = system([[0, 1], [-40.0, -0.001]], [0, 1], [1, 0])
    start = system([[0, 1], [-55.0, -0.01]], [0, 1.3], [1, 0])
    for seed in range(5):
        w, y = simulated(truth, 0.03, steps(seed, 600))
        refiner = RCORefiner(start, dt=0.03)
        refiner.update(w, noisy(y, 0.1, seed))
        assert np.linalg.eigvals(refiner.system.A).real.max() < 0


# -- the stream ------------------------------------------------------------------------------------


def stream(n_samples=1200, seed=3):
    truth, start, dt = OFF["two masses, one sensor"]
    w, y = simulated(truth, dt, steps(seed, n_samples))
    return start, dt, w, noisy(y, 0.02, seed)


def same(one, other):
    assert str(one) == str(other)
    np.testing.assert_array_equal(one.static_theta, other.static_theta)
    np.testing.assert_array_equal(one.covariance, other.covariance)
    np.testing.assert_array_equal(one.system.A, other.system.A)
    assert one.scores == other.scores


def test_samples_blocks_and_the_record_are_the_same():
    start, dt, w, y = stream()
    block, single, parts = (RCORefiner(start, dt=dt, history=True) for _ in range(3))
    block.update(w, y)
    for k in range(w.shape[1]):
        single.update(w[:, k], y[:, k])
    for part in np.split(np.arange(w.shape[1]), [1, 2, 40, 41, 300, 777]):
        parts.update(w[:, part], y[:, part])
    same(single, block)
    same(parts, block)
    np.testing.assert_array_equal(single.history.coefficients, block.history.coefficients)
    record = RCORefiner(start, dt=dt).run(rco.Measurement(w, y, dt=dt))
    same(record, block)


@pytest.mark.parametrize("cut", [20, 333, 1100])
def test_a_saved_and_a_pickled_race_go_on_as_if_nothing_had_been(cut, tmp_path):
    start, dt, w, y = stream()
    whole = RCORefiner(start, dt=dt, history=True)
    whole.update(w, y)
    part = RCORefiner(start, dt=dt, history=True)
    for k in range(cut):
        part.update(w[:, k], y[:, k])
    part.save(tmp_path / "state.npz")
    for again in (RCORefiner.load(tmp_path / "state.npz"), pickle.loads(pickle.dumps(part))):
        again.update(w[:, cut:], y[:, cut:])
        same(again, whole)
        np.testing.assert_array_equal(again.history.z2, whole.history.z2)


def test_gaps_are_bridged():
    start, dt, w, y = stream(3000)
    y = y.copy()
    y[0, np.random.default_rng(0).random(y.shape[1]) < 0.2] = np.nan
    w = w.copy()
    w[0, 1500:1503] = np.nan
    refiner = RCORefiner(start, dt=dt, missing="hold-out", history=True)
    refiner.update(w, y)
    assert np.abs(np.linalg.eigvals(refiner.system.A) - np.linalg.eigvals(two_masses().A)).max() < 0.1
    assert np.isnan(refiner.history.z2).sum() > 500


SIZES = {"inputs": 1.0, "outputs": 1.0}


@pytest.mark.parametrize(
    "make",
    [
        RCORefiner,
        lambda model, dt: RCORefiner.paper(model, dt=dt, window=60, markov=1, scale=SIZES),
        lambda model, dt: RCORefiner(model, dt=dt, effects=["A[1,0]"]),
    ],
)
def test_threads_lose_no_sample(make):
    """Four threads on one refiner: every sample is taken once, in whatever order."""
    start, dt = motor(0.03), 0.02  # shuffled samples must not make the paper's stages diverge
    w, y = simulated(motor(), dt, 0.01 * steps(0, 400))
    refiner = make(start, dt=dt)
    refiner.update(w[:, :1], y[:, :1])
    begin = threading.Barrier(4)

    def feed(part):
        begin.wait()
        for k in part:
            refiner.update(w[:, k], y[:, k])
            _ = refiner.n_samples

    threads = [threading.Thread(target=feed, args=(range(1 + i, 400, 4),)) for i in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert refiner.n_samples == 400


@pytest.mark.skipif(not hasattr(os, "fork"), reason="no fork on this system")
def test_a_fork_amid_an_update_gets_a_refiner_that_works(monkeypatch):
    """The child has the samples of before or after the update, as the parent, and can go on."""
    start, dt, w, y = stream(200)
    refiner = RCORefiner(start, dt=dt)
    inside, take = threading.Event(), type(refiner._estimator).take

    def slow(self, block, **how):
        take(self, block.part(0, 50), **how)
        inside.set()
        time.sleep(0.2)
        take(self, block.part(50, 100), **how)

    monkeypatch.setattr(type(refiner._estimator), "take", slow)
    thread = threading.Thread(target=refiner.update, args=(w[:, :100], y[:, :100]))
    thread.start()
    inside.wait()
    child = os.fork()
    if child == 0:
        signal.alarm(20)  # a child that hangs dies of it
        monkeypatch.undo()
        code = 1
        try:
            first = refiner.n_samples
            refiner.update(w[:, 100:], y[:, 100:])
            code = 0 if (first, refiner.n_samples) == (100, 200) else 2
        finally:
            os._exit(code)
    thread.join()
    assert os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == 0
    refiner.n_samples  # noqa: B018  the parent's lock is free, too


def test_stage_one_in_gaps_does_not_depend_on_blocks():
    """While the forms take turns in the lead within a stretch: the last whole one says who stands in."""
    for seed in range(3):
        rng = np.random.default_rng(seed)
        plant = rco.mass_spring_damper([1.0, 1.0], [0.4, 0.4], [90.0, 90.0], sensors="displacement")
        start = rco.mass_spring_damper([1.0, 1.0], [0.3, 0.3], [100.0, 100.0], sensors="displacement")
        w = rng.standard_normal((plant.linear.n_inputs, 700))
        still = rco.Measurement(w, np.zeros((plant.linear.n_outputs, 700)), dt=0.02)
        y = rco.simulate(plant, still, "zero").outputs
        y = y + 0.05 * y.std() * rng.standard_normal(y.shape)
        y[rng.random(y.shape) < 0.05] = np.nan
        found = []
        for size in (700, 37, 1):
            refiner = RCORefiner(start, dt=0.02, missing="hold-out")
            for k in range(0, 700, size):
                refiner.update(w[:, k : k + size], y[:, k : k + size])
            found.append(refiner.theta)
        np.testing.assert_array_equal(found[1], found[0])
        np.testing.assert_array_equal(found[2], found[0])


def test_a_member_that_diverges_leaves_the_others_running(monkeypatch):
    start, dt, w, y = stream()
    step = BlockFilter.step

    def failing(self, state, block, **how):
        if state.n_samples >= 300 and len(self.family.labels) == 20:  # all entries of a discrete 4 + 1
            raise rco.DivergenceError("the static stage diverged; nothing helps")
        return step(self, state, block, **how)

    monkeypatch.setattr(BlockFilter, "step", failing)
    refiner = RCORefiner(start, dt=dt)
    refiner.update(w, y)
    assert "discrete diverged" in " ".join(str(refiner).split())
    assert refiner.n_samples == w.shape[1]
    assert refiner.form == "nonzero"
    assert refiner.scores["nonzero"] > 90


def test_what_was_chosen_and_why_is_said():
    start, dt, w, y = stream()
    refiner = RCORefiner(start, dt=dt)
    assert refiner.form == "initial"
    np.testing.assert_array_equal(refiner.system.A, start.A)
    refiner.update(w, y)
    text = " ".join(str(refiner).split())
    assert f"form {refiner.form!r}" in text
    assert "held-out samples" in text
    for name in ("nonzero", "discrete", "initial"):
        assert f"{name} " in text
        assert name in refiner.scores
    assert max(map(len, str(refiner).splitlines())) <= 80


# -- forms -----------------------------------------------------------------------------------------


def test_entries_by_name_and_their_error_bars():
    """Two entries of a servo, true and estimated, over seeds: 95 % intervals."""
    truth, dt, inside = positioner(), 0.02, 0
    start = positioner(0.02, 0.05, 0.36)
    for seed in range(20):
        w, y = simulated(truth, dt, steps(seed, 1500))
        refiner = RCORefiner(start, dt=dt, effects=["A[1,1]", "B[1,0]"], use_estimated_states=False)
        refiner.update(w, noisy(y, 0.02, seed))
        for row, true in zip(refiner.parameters, (truth.A[1, 1], truth.B[1, 0]), strict=True):
            low, high = row.interval
            inside += low <= true <= high
        np.testing.assert_allclose(refiner.standard_deviations[0], [row.std for row in refiner.parameters])
    assert [row.name for row in refiner.parameters] == ["A[1,1]", "B[1,0]"]
    assert inside >= 33  # 1e-3 quantile of a binomial of 40 with 0.95


@pytest.mark.parametrize("form", ["nonzero", "discrete"])
def test_each_form_alone(form):
    truth, start, dt = OFF["motor"]
    w, y = simulated(truth, dt, steps(2, 3000))
    refiner = RCORefiner(start, dt=dt, form=form)
    refiner.update(w, noisy(y, 0.01, 2))
    assert refiner.form == form
    np.testing.assert_allclose(refiner.system.dcgain(), truth.dcgain(), rtol=0.02)
    np.testing.assert_allclose(np.sort(refiner.system.poles().real), np.sort(truth.poles().real), rtol=0.05)


def test_discrete_models_are_refined_too():
    truth, start, dt = (one.sample(0.02) if isinstance(one, ct.StateSpace) else one for one in OFF["motor"])
    w, y = simulated(OFF["motor"][0], dt, steps(2, 3000))
    refiner = RCORefiner(start)
    refiner.update(w, noisy(y, 0.01, 2))
    assert refiner.system.dt == dt
    np.testing.assert_allclose(np.sort(refiner.system.poles().real), np.sort(truth.poles().real), rtol=0.02)


def test_an_input_that_runs_linearly_between_samples():
    truth, start, dt = OFF["motor"]
    fine = 50
    w = np.random.default_rng(0).uniform(-1, 1, (1, 1501))
    grid = np.arange(1500 * fine) / fine
    _, y = simulated(truth, dt / fine, np.interp(grid + 0.5 / fine, np.arange(1501), w[0])[None])
    data = rco.Measurement(w[:, :1500], noisy(y[:, ::fine], 0.005, 0), dt=dt, hold="foh")
    refiner = RCORefiner(start, dt=dt, hold="foh").run(data)
    np.testing.assert_allclose(np.sort(refiner.system.poles().real), np.sort(truth.poles().real), rtol=0.03)
    with pytest.raises(rco.DataError, match="hold"):
        RCORefiner(start, dt=dt).run(data)


@pytest.mark.parametrize(
    ("settings", "error", "match"),
    [
        ({"form": "best"}, ct.ControlArgument, "'auto'"),
        ({"effects": ["E[0,0]"]}, ct.ControlArgument, r"A\[1,0\]"),
        ({"effects": ["A[7,0]"]}, rco.ModelError, "shape"),
        ({"effects": ["A[1,0]", "A[1,0]"]}, rco.ModelError, "twice"),
        ({"effects": []}, rco.ModelError, "empty"),
        ({"static": "nonzero", "static_window": 5}, ct.ControlArgument, "static_window"),
        ({"static": "input"}, ct.ControlArgument, "is gone"),
        ({"form": "nonzero", "effects": [rco.Effect("damping", "q1")]}, ct.ControlArgument, "one of them"),
        ({"form": "discrete", "hold": "foh"}, rco.ModelError, "held"),
        ({"substeps": 3}, ct.ControlArgument, "nonlinear"),
        ({"noise": [0.1, 0.2]}, ct.ControlDimension, "one for each"),
    ],
)
def test_bad_settings_are_explained(settings, error, match):
    with pytest.raises(error, match=match):
        RCORefiner(two_masses(), dt=0.04, **settings)


def test_keywords_of_version_0_2_go_on_with_a_warning():
    start, dt, w, y = stream(300)
    for old, new in (
        ({"static": "nonzero"}, lambda: RCORefiner(start, dt=dt, form="nonzero")),
        ({"static": ["A[2,0]"]}, lambda: RCORefiner(start, dt=dt, effects=["A[2,0]"])),
        ({"window": 100}, lambda: RCORefiner.paper(start, dt=dt, window=100)),
        ({"markov": 20}, lambda: RCORefiner.paper(start, dt=dt, static_average=800)),
    ):
        with pytest.warns(FutureWarning, match="RCORefiner"):
            before = RCORefiner(start, dt=dt, **old)
        after = new()
        for one in (before, after):
            one.update(w[:, :140], y[:, :140])
        np.testing.assert_array_equal(before.static_theta, after.static_theta)
        assert str(before) == str(after)


def test_a_default_that_is_given_changes_nothing():
    start, dt, w, y = stream(300)
    plain = RCORefiner(start, dt=dt)
    given = RCORefiner(
        start, dt=dt, effects=None, form="auto", history=False, missing="raise", noise=None, hold="zoh",
        disturbance=0.0, forgetting=1.0, substeps=None, order=5, learning_rate=1e5, use_estimated_states=True,
    )  # fmt: skip
    for one in (plain, given):
        one.update(rco.Measurement(w, y, dt=dt))
    same(plain, given)
    np.testing.assert_array_equal(plain.theta, given.theta)


@pytest.mark.parametrize(("forgetting", "oldest"), [(1.0, 64), (0.99, 12)])
def test_the_model_is_never_older_than_it_says(forgetting, oldest):
    start, dt, w, y = stream(300)
    refiner = RCORefiner(start, dt=dt, form="nonzero", forgetting=forgetting)
    for k in range(w.shape[1]):
        refiner.update(w[:, k], y[:, k])
        assert refiner.age <= (oldest if k >= 64 else 32)
    assert f"the model is that of {refiner.age} samples ago" in " ".join(str(refiner).split())


# -- odd models ------------------------------------------------------------------------------------


def test_models_that_give_the_stages_nothing_to_work_with():
    rng = np.random.default_rng(0)
    w = rng.standard_normal((1, 300))
    gain = RCORefiner(ct.ss([], [], [], [[2.0]]), dt=0.1)
    gain.update(w, 3.0 * w)
    assert gain.system.D[0, 0] == pytest.approx(3.0, rel=1e-3)
    blind = RCORefiner(system([[-1.0, 0], [0, -2.0]], [1, 0], [0, 1]), dt=0.1)  # the input reaches no output
    blind.update(w, rng.standard_normal((1, 300)))
    assert "Stage 1 does not run" in " ".join(str(blind).split())
    wild = RCORefiner(ct.ss([[60.0]], [[1.0]], [[1.0]], [[0.0]]), dt=0.1)
    wild.update(w, w)
    assert np.isfinite(wild.system.A).all()
    still = RCORefiner(motor(), dt=0.02)
    still.update(0 * w, 0 * w)
    np.testing.assert_array_equal(still.system.A, motor().A)


@pytest.mark.parametrize("scale", [1e-12, 1e12])
def test_units_of_the_signals_do_not_matter(scale):
    start, dt, w, y = stream(800)
    plain = RCORefiner(start, dt=dt)
    plain.update(w, y)
    other = RCORefiner(ct.ss(start.A, start.B * scale, start.C / scale, start.D), dt=dt)
    other.update(w, y)
    np.testing.assert_allclose(np.sort(other.system.poles()), np.sort(plain.system.poles()), rtol=1e-4)


def test_the_nearest_continuous_model():
    from inner import LinearModel

    from rcorefine.systems.conversion import nearest_continuous

    good = motor().sample(0.02)
    np.testing.assert_allclose(nearest_continuous(LinearModel.from_statespace(good)).A, motor().A, rtol=1e-9)
    rng = np.random.default_rng(0)
    for poles in ([-0.9, 0.5], [0.0, 0.0, 0.7], [-0.4, -0.4, 0.9], [0.0, 0.3, -0.2], [-1.2, 0.8]):
        T = rng.standard_normal((len(poles), len(poles)))
        A = T @ (np.diag(poles) + np.diag(np.ones(len(poles) - 1), 1)) @ np.linalg.inv(T)
        odd = ct.ss(
            A, rng.standard_normal((len(poles), 1)), rng.standard_normal((1, len(poles))), [[0.5]], 0.1
        )
        with pytest.warns(rco.ConversionWarning, match="z = 0.02"):
            near = nearest_continuous(LinearModel.from_statespace(odd)).to_statespace()
        assert near.isctime()
        np.testing.assert_allclose(near.dcgain(), odd.dcgain(), rtol=1e-6)
        kept = sorted(p for p in poles if p > 0)
        moved = np.sort(near.sample(0.1).poles().real)
        np.testing.assert_allclose(moved, [*[0.02] * (len(poles) - len(kept)), *kept], rtol=1e-5)


# -- pictures and error bars -----------------------------------------------------------------------


def test_the_band_about_the_refined_response_holds_the_true_one():
    truth, start, dt = OFF["integrator"]
    omega, inside = np.geomspace(0.2, 60.0, 5), 0
    true = ct.frequency_response(truth, omega).frdata[0, 0]
    for seed in range(20):
        w, y = simulated(truth, dt, steps(seed, 1500))
        refiner = RCORefiner(start, dt=dt, use_estimated_states=False)
        refiner.update(w, noisy(y, 0.05, seed))
        spread = refiner._estimator.deviation()(omega)[0, 0]
        found = ct.frequency_response(refiner.system, omega).frdata[0, 0]
        assert np.all(spread < 0.2 * np.abs(true)), "a band that holds everything says nothing"
        inside += int(np.sum(np.abs(found - true) <= 2.45 * spread))  # 95 % of a round complex normal
    assert inside >= 82  # of 100, five of which go together


def test_both_stages_are_seen_in_the_history():
    truth, start, dt = OFF["motor"]
    w, y = simulated(truth, dt, steps(4, 1500))
    refiner = RCORefiner(start, dt=dt, history=True)
    refiner.update(w, noisy(y, 0.01, 4))
    h = refiner.history
    assert h.poles.shape == (2, 200)
    assert h.pole_timepts[-1] == h.timepts[-1]
    np.testing.assert_allclose(np.sort(h.poles[:, 0].real), np.sort(start.poles().real), rtol=1e-9)
    np.testing.assert_allclose(np.sort(h.poles[:, -1].real), np.sort(truth.poles().real), rtol=0.05)
    late = slice(1000, None)
    assert np.sqrt(np.mean(h.z1[0, late] ** 2)) < 0.2 * y.std(), "stage 1 follows"
    assert np.sqrt(np.mean(h.z2[0, late] ** 2)) < 0.03 * y.std(), "and so does the static stage"
    plot = h.plot()
    assert plot.axes.shape == (3, 1)
    assert len(plot.lines[0, 0]) == 2
    assert refiner.bode_plot(rco.Measurement(w, y, dt=dt)).axes.shape == (3, 1)
    paper = RCORefiner.paper(start, dt=dt, history=True, window=100).run(rco.Measurement(w, y, dt=dt))
    assert paper.history.poles.shape[0] == 2
    assert paper.history.plot().axes.shape == (3, 1)
    assert np.isfinite(paper.standard_deviations).all()


def circuit_of(f):
    R, L, C = 2.0 * f[0], 0.5 * f[1], 0.02 * f[2]
    return [[-R / L, -1 / L], [1 / C, 0.0]], [[1 / L], [0.0]], [[0.0, 1.0]], 0.02


def motor_of(f):
    inertia, drag, torque = 0.01 * f[0], 0.1 * f[1], 0.2 * f[2]
    return [[-drag / inertia, torque / inertia], [-torque / 0.05, -20.0]], [[0.0], [20.0]], [[1.0, 0.0]], 0.01


def oscillator_of(f):
    return [[0.0, 1.0], [-40.0 * f[0], -0.8 * f[1]]], [[0.0], [f[2]]], [[1.0, 0.0]], 0.02


def test_intervals_of_entries_hold_the_true_ones():
    """Of 95 percent, also where one sensor determines the entries only together."""
    inside = count = 0
    for plant, seed in itertools.product((circuit_of, motor_of, oscillator_of), range(4)):
        rng = np.random.default_rng([seed, 17])
        *true, dt = plant(1.0 + 0.15 * rng.standard_normal(3))
        *nominal, _ = plant(np.ones(3))
        w = np.repeat(rng.standard_normal(300), 5)
        D = np.zeros((1, 1))
        y = dlsim((*cont2discrete([*map(np.array, true), D], dt)[:4], dt), w)[1][:, 0]
        refiner = RCORefiner(ct.ss(*nominal, 0), dt=dt)
        refiner.update(w, y + 0.02 * y.std() * rng.standard_normal(y.size))
        for row in refiner.parameters:
            matrix, i, j = true["ABC".index(row.name[0])], *map(int, row.name[2:-1].split(","))
            inside += abs(row.value - matrix[i][j]) < 1.96 * row.std
            count += 1
        if plant is circuit_of:
            assert "Determined only together: A[0,1], B[0,0], A[1,0]." in " ".join(str(refiner).split())
    assert count > 40
    assert binom.cdf(inside, count, 0.95) > 0.001


def test_rows_are_entries_of_the_model_that_was_given():
    """Continuous for a continuous model, whichever form won, with errors by scipy's exponential."""
    rng, dt, n = np.random.default_rng(4), 0.05, 2
    plant, start = (
        ct.ss([[0, 1], [-k, -c]], [[0], [1]], [[1, 0]], 0) for k, c in ((110.0, 0.5), (100.0, 0.4))
    )
    u = rng.standard_normal(1000)
    y = ct.forced_response(plant.sample(dt), inputs=u).outputs
    y = y + 0.02 * y.std() * rng.standard_normal(1000)
    continuous = rco.RCORefiner(start, dt=dt, form="discrete")
    discrete = rco.RCORefiner(start.sample(dt), form="discrete")
    for refiner in (continuous, discrete):
        refiner.update(u, y)
        model = refiner.system
        for row in refiner.parameters:
            matrix, i, j = row.name[0], *map(int, re.findall(r"\d+", row.name))
            assert row.value == pytest.approx(getattr(model, matrix)[i, j], rel=1e-9, abs=1e-9)
            if refiner is continuous:
                assert row.initial == getattr(start, matrix)[i, j]

    def entries(values):
        """Of the discrete model: the exponential of the zero-order hold."""
        whole = np.zeros((n + 1, n + 1))
        whole[:n, :n], whole[:n, n:] = values[: n * n].reshape(n, n), values[n * n :].reshape(n, 1)
        found = expm(whole * dt)
        return np.concatenate([found[:n, :n].ravel(), found[:n, n]])

    center = np.array([row.value for row in continuous.parameters])
    steps = 1e-5 * np.eye(center.size)
    slope = np.linalg.inv(np.array([(entries(center + e) - entries(center - e)) / 2e-5 for e in steps]).T)
    np.testing.assert_allclose(
        continuous.standard_deviations[0], np.sqrt(np.diag(slope @ discrete.covariance @ slope.T)), rtol=0.02
    )
    np.testing.assert_allclose(continuous.static_theta[0], [r.coefficient for r in continuous.parameters])
