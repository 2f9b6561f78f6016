"""Streams that say nothing for long, run beyond any count, lose sensors, or have units out of this world."""

from __future__ import annotations

import json
import pickle
import warnings

import numpy as np
import pytest
import test_state_files as states

import rcorefine as rco

MODEL = rco.mass_spring_damper([1.0, 0.8], [0.4, 0.3], [100.0, 60.0], sensors="displacement")
TRUE = rco.mass_spring_damper([1.0, 0.8], [0.4, 0.3], [100.0, 45.0], sensors="displacement")
LOST = rco.Effect("stiffness", "link2")


def signals(n, seed=0):
    rng = np.random.default_rng(seed)
    w = rng.standard_normal(n)
    y = rco.simulate(TRUE, rco.Measurement(w, np.zeros((2, n)), dt=0.02), "zero").outputs
    return w, y + 0.01 * y.std() * rng.standard_normal(y.shape)


@pytest.mark.numba
@pytest.mark.parametrize("settings", [{"effects": [LOST]}, {"effects": [LOST], "forgetting": 0.99}, {}])
def test_silence_winds_nothing_up(settings, tally):
    """What was learned before is known behind it, and learned on."""
    silent = tally.cases(10_000)
    refiner = rco.RCORefiner(MODEL, dt=0.02, **settings)
    w, y = signals(2000)
    refiner.update(w, y)
    refiner.update(np.zeros(silent), np.zeros((2, silent)))
    refiner.update(*signals(2000, 1))
    k = -refiner.system.A[3, 1] * 0.8
    assert abs(k - 45.0) < 1.5
    tally["streams, silent samples"] += silent


@pytest.mark.parametrize("scale", [1e-310, 1e-200, 1e-120, 1e120, 1e200])
def test_signals_without_a_square(scale):
    """They ended in a ValueError of numpy, in warnings of it, or in a standard deviation of Inf."""
    w, y = signals(300)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        with pytest.raises(rco.DataError, match="whose square is no number; give it in another unit"):
            rco.Measurement(scale * w, y, dt=0.02)
        with pytest.raises(rco.DataError, match="another unit"):
            rco.Measurement(w, scale * y, dt=0.02)
        if scale > 1.0:
            for effects in ([LOST], None):
                with pytest.raises(rco.DataError, match="another unit"):
                    rco.RCORefiner(MODEL, dt=0.02, effects=effects).update(scale * w, scale * y)
        else:
            refiner = rco.RCORefiner(MODEL, dt=0.02, effects=[LOST])
            refiner.update(scale * w, scale * y)  # counts as nothing
            assert refiner.parameters[0].coefficient == 0.0


# ------------------------------------------------------------------ long streams, and what comes and goes
FAR = 2**32 * 75 * 7 * 11 * 13 * 17  # a multiple of every ring and refresh, beyond 2**53 / 2


def moved_on(path, samples, by):
    """A saved object whose counts of samples stand `by` further: what a stream of that length leaves."""
    with np.load(path) as stored:
        arrays = dict(stored)
    meta, found = json.loads(str(arrays["meta"])), 0
    for place, value in states.leaves(meta):
        if type(value) is int and value == samples:
            meta, found = states.changed_tree(meta, place, value + by), found + 1
    for key, array in arrays.items():
        count = 4 if array.size == 5 else 0  # of a stage's five (the second is the age of its window)
        if array.dtype.kind == "i" and array.size and array.flat[count] == samples:
            arrays[key] = array.copy()
            arrays[key].flat[count] += by
            found += 1
    np.savez(path, **{**arrays, "meta": np.array(json.dumps(meta))})
    return found


@pytest.mark.parametrize(
    "settings", [{"order": 2, "window": 40}, {}, {"effects": [LOST], "use_estimated_states": False}]
)
def test_counters_beyond_any_length_of_a_stream(settings, tmp_path):
    """Half a year at 1 GHz later the same samples teach the same, to the last bit."""
    path, n = tmp_path / "state.npz", 2240  # whole blocks
    states.refiner(n, **settings).save(path)
    near = rco.RCORefiner.load(path)
    assert moved_on(path, n, FAR)
    far = rco.RCORefiner.load(path)
    w, y = states.signals(300, 48.0, seed=2)
    for one in (near, far):
        one.update(w, y)
    assert (near.n_samples, far.n_samples) == (n + 300, n + 300 + FAR)
    np.testing.assert_array_equal(near.discrete_system.A, far.discrete_system.A)
    far.save(path)
    assert rco.RCORefiner.load(path).n_samples == n + 300 + FAR


@pytest.mark.numba
@pytest.mark.parametrize("settings", [{"effects": [LOST]}, {}])
def test_sensors_that_come_and_go(settings, tally):
    """One sensor is away for a third of the time, then the other, then both, and a quarter at random."""
    w, y = signals(6000)
    away = np.zeros(y.shape, dtype=bool)
    away[0, 1000:3000] = away[1, 2500:4000] = True
    away |= np.random.default_rng(8).random(y.shape) < 0.25
    refiner = rco.RCORefiner(MODEL, dt=0.02, missing="hold-out", **settings)
    refiner.update(w, np.where(away, np.nan, y))
    k = -refiner.system.A[3, 1] * 0.8
    assert abs(k - 45.0) < 1.5
    tally["streams, samples that were away"] += int(away.sum())


def test_denormal_signals_are_silence():
    """1e-310 beside 1: they slow no kernel down and teach nothing."""
    w, y = signals(2000)
    refiner = rco.RCORefiner(MODEL, dt=0.02, effects=[LOST])
    refiner.update(w, y)
    before = refiner.parameters[0].coefficient
    for _ in range(20):
        refiner.update(np.full(500, 5e-324), np.full((2, 500), 1e-310))
    assert np.isfinite(refiner.system.A).all()
    assert abs(refiner.parameters[0].coefficient - before) < 1.0
    found = []
    for tiny in (0.0, 1e-310):  # one sample by itself
        refiner = rco.RCORefiner(MODEL, dt=0.02, effects=[LOST])
        refiner.update(w, y)
        for _ in range(5):
            refiner.update(np.full(1, tiny), np.full(2, tiny))
        found.append(refiner.parameters[0].coefficient)
    assert found[0] == found[1]


# ------------------------------------------------------------------ the monitor
LINKS = [rco.Effect(kind, f"link{i}") for i in (1, 2) for kind in ("stiffness", "damping")]


class Plant:
    """Two masses that move on from where they stand, whatever their second link becomes."""

    def __init__(self, seed):
        self.rng, self.x = np.random.default_rng(seed), np.zeros(4)

    def run(self, samples, stiffness=60.0, noise=1e-3, force=1.0):
        true = rco.mass_spring_damper([1.0, 0.8], [0.4, 0.3], [100.0, stiffness], sensors="displacement")
        sampled = true.system.sample(0.02)
        w = force * self.rng.standard_normal(samples)
        y = np.empty((2, samples))
        for k in range(samples):
            y[:, k] = sampled.C @ self.x
            self.x = sampled.A @ self.x + sampled.B[:, 0] * w[k]
        return w, y + noise * self.rng.standard_normal(y.shape)


@pytest.mark.numba
@pytest.mark.parametrize("noise", [0.0, 1e-4, 1e-3], ids=["nothing at all", "less noise", "as much noise"])
def test_silence_leaves_a_monitor_awake(noise, tally):
    """No alarm in it or behind it, memory as before; then what changes is named where it is."""
    silent = tally.cases(10_000)
    plant, monitor = Plant(3), rco.Monitor(MODEL, LINKS, dt=0.02, learn=1500)
    monitor.update(*plant.run(3000))
    room = {
        key: value.nbytes
        for key, value in monitor.__getstate__()["state"]._asdict().items()
        if key not in ("blocks", "lost")
    }
    monitor.update(*plant.run(3000, noise=noise, force=0.0))  # it swings out
    rng = np.random.default_rng(4)
    for left in range(silent, 0, -50_000):
        n = min(left, 50_000)
        monitor.update(np.zeros(n), noise * rng.standard_normal((2, n)))
    assert (monitor.alarm, monitor.past_alarms) == (None, ())
    plant.x[:] = 0.0
    monitor.update(*plant.run(3000))
    assert (monitor.alarm, monitor.past_alarms) == (None, ())
    begins = monitor.n_samples
    monitor.update(*plant.run(3000, 45.0))
    found = monitor.alarm
    assert found is not None
    assert found.effect.label == "stiffness at link2"
    assert abs(found.coefficients["stiffness"] + 15.0) < 4 * found.std["stiffness"] + 0.75
    assert abs(found.since_sample - begins) < 100
    assert {key: getattr(monitor.__getstate__()["state"], key).nbytes for key in room} == room
    tally["streams, silent samples of a monitor"] += silent


@pytest.mark.numba
@pytest.mark.parametrize("settings", [{"effects": [LOST]}, {"effects": [LOST], "forgetting": 0.999}])
def test_silence_leaves_a_covariance_that_is_one(settings, tally):
    """Symmetric, positive definite, and within what was known before; the state file does not grow."""
    silent = tally.cases(10_000)
    refiner = rco.RCORefiner(MODEL, dt=0.02, **settings)
    refiner.update(*signals(2000))
    size = len(str(refiner.__getstate__()))
    for left in range(silent, 0, -50_000):
        n = min(left, 50_000)
        refiner.update(np.zeros(n), np.zeros((2, n)))
        P = refiner.covariance
        np.testing.assert_allclose(P, P.T, rtol=1e-12)
        np.linalg.cholesky(P)
    assert abs(len(str(refiner.__getstate__())) - size) < 0.05 * size
    refiner.update(*signals(2000, 1))
    assert np.linalg.eigvalsh(refiner.covariance)[0] > 0


def moved_monitor(monitor, by):
    """The monitor as saved, its counts `by` further."""
    state = pickle.loads(pickle.dumps(monitor.__getstate__()))
    state["count"] += by
    state["course"]["samples"] += by
    moved = state["state"].blocks + by // monitor._memory.watched.block
    state["state"] = state["state"]._replace(blocks=moved)
    found = rco.Monitor.__new__(rco.Monitor)
    found.__setstate__(state)
    return found


def test_a_monitor_beyond_any_length_of_a_stream():
    """A hundred thousand million samples on, the same samples ring the same alarm, and are numbered right."""
    plant, near = Plant(3), rco.Monitor(MODEL, LINKS, dt=0.02, learn=1500)
    near.update(*plant.run(3000))
    by = near.__getstate__()["course"]["stride"] * 2**32
    far = moved_monitor(near, by)
    for part in (plant.run(500), plant.run(2500, 45.0)):
        for one in (near, far):
            one.update(*part)
    assert near.alarm.effect.label == "stiffness at link2"
    assert far.alarm.effect == near.alarm.effect
    assert far.n_samples == 6000 + by
    for name in ("sample", "since_sample"):
        assert getattr(far.alarm, name) - getattr(near.alarm, name) == by
    assert far.alarm.time == far.alarm.sample * 0.02
    assert far.alarm.since == far.alarm.since_sample * 0.02
    np.testing.assert_allclose(far.timepts, (np.rint(near.timepts / 0.02) + by) * 0.02, rtol=1e-15)
    assert far.alarm.coefficients == near.alarm.coefficients
    np.testing.assert_array_equal(far.probability, near.probability)
