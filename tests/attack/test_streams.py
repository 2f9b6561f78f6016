"""Streams that say nothing for long, run beyond any count, lose sensors, or have units out of this world."""

from __future__ import annotations

import json
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
    path, n = tmp_path / "state.npz", 2211
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
