"""Entries of B, C and D that are zero in a model, and states that it does not lack."""

from __future__ import annotations

import control as ct
import numpy as np
import pytest
from cases import named, slow
from scipy.signal import cont2discrete, dlsim

import rcorefine as rco
from rcorefine.models.library import zero_entries

ROOMS, HEATER = [[-0.02, 0.01], [0.005, -0.012]], [[0.02], [0.0]]


def record(A, B, C, dt, hold, seed, size=2000, noise=0.02):
    rng = np.random.default_rng(seed)
    w = np.repeat(rng.choice([-1.0, 1.0], size // hold), hold)
    system = [np.array(part, dtype=float) for part in (A, B, C, [[0.0]])]
    y = dlsim(cont2discrete(system, dt), w)[1][:, 0]
    return rco.Measurement(w, y + noise * y.std() * rng.standard_normal(y.size), dt=dt)


def converter(r, choke=1e-3, store=2e-4, load=5.0):
    """Return A, B, C of a converter whose capacitor has a resistance in series."""
    s = 1.0 + r / load  # y = (vC + r iL) / s
    A = [[-r / (choke * s), -1 / (choke * s)], [(1 - r / (load * s)) / store, -1 / (load * s * store)]]
    return A, [[1 / choke], [0.0]], [[r / s, 1 / s]]


def ideal():
    return ct.ss(*converter(0.0), 0, states=["iL", "vC"], inputs=["vin"], outputs=["v"])


def rooms():
    return ct.ss(ROOMS, HEATER, [[1, 0]], 0, states=["T1", "T2"], inputs=["P"], outputs=["T"])


@pytest.mark.parametrize(("r", "seed"), [(0.4, 0), *slow((0.4, 1), (0.1, 0), (0.1, 1))])
def test_a_resistance_in_series_with_the_capacitor_is_no_hidden_storage(r, seed):
    found = rco.diagnose(ideal(), record(*converter(r), 2e-5, 10, seed))
    resistance = rco.Effect("coefficient", "C[0,0]")
    # one input and one output: current into the capacitor has the same response
    assert {e.place for e in found.ambiguous} <= {"C[0,0]", "B[1,0]"}
    named(found, resistance, r / (1 + r / 5.0))
    rows = [name for row in found.ranking for name in (row, *row.same)]
    (row,) = (row for row in rows if row.effect == resistance)
    assert 3 * next(iter(row.std.values())) < 0.5 * r


def test_a_hidden_state_is_not_named_where_a_black_box_without_it_suffices():
    stores = [rco.Effect("hidden_store", place) for place in ("iL", "vC")]
    found = rco.diagnose(ideal(), record(*converter(0.4), 2e-5, 10, 0), candidates=stores)
    assert found.verdict == "unexplained"
    said = " ".join(str(found).split())
    assert "not named: a black box without the states that it adds reaches the same error." in said


def test_a_hidden_store_and_a_hidden_mode_keep_their_names():
    A = np.zeros((3, 3))
    A[:2, :2] = ROOMS
    A[0, 0], A[0, 2], A[2] = A[0, 0] - 0.015, 0.015, [0.004, 0.0, -0.004]
    found = rco.diagnose(rooms(), record(A, [*HEATER, [0.0]], [[1, 0, 0]], 2.0, 40, 5))
    assert (found.verdict, found.effects) == ("effect", (rco.Effect("hidden_store", "T1"),))
    m, k, c = 0.05, 7.5, 0.05
    A = [[0, 0, 1, 0], [0, 0, 0, 1], [-100 - k, k, -0.8 - c, c], [k / m, -k / m, c / m, -c / m]]
    bare = ct.ss([[0, 1], [-100, -0.8]], [[0], [1]], [[1, 0]], 0, states=["x", "v"])
    found = rco.diagnose(bare, record(A, [[0], [0], [1], [0]], [[1, 0, 0, 0]], 0.02, 4, 4))
    assert (found.verdict, found.effects) == ("effect", (rco.Effect("hidden_mode", "x"),))


@pytest.mark.parametrize(("B", "C"), [(HEATER, [[1, 0.25]]), *slow(([[0.02], [0.005]], [[1, 0]]))])
def test_a_sensor_of_two_stores_and_an_input_of_two(B, C):
    found = rco.diagnose(rooms(), record(ROOMS, B, C, 2.0, 40, 3))
    assert found.verdict == "effect"
    rows = (found.best, *found.best.same)
    values = {row.effect.place: sum(row.coefficients.values()) for row in rows}
    # of y = T1 + c T2, or d P acts on T2: the numerator is 0.02 (s + 0.012) + 0.02 * 0.005 c + 0.01 d
    assert values.keys() == {"C[0,1]", "B[1,0]"}
    zero = 0.02 * 0.005 * C[0][1] + B[1][0] * 0.01
    assert values["C[0,1]"] == pytest.approx(zero / (0.02 * 0.005), rel=0.05)
    assert values["B[1,0]"] == pytest.approx(zero / 0.01, rel=0.05)


@pytest.mark.parametrize("seed", [0, *slow(1, 2)])
def test_nothing_is_named_where_nothing_is_missing(seed):
    assert rco.diagnose(rooms(), record(ROOMS, HEATER, [[1, 0]], 2.0, 40, 20 + seed)).verdict == "adequate"
    assert rco.diagnose(ideal(), record(*converter(0.0), 2e-5, 10, seed)).verdict == "adequate"


def test_what_is_offered():
    def places(model):
        return {effect.place for effect in zero_entries(rco.physical(model))}

    assert places(ideal()) == {"C[0,0]", "D[0,0]", "B[1,0]"}
    assert places(ct.ss([[-2, -10], [100, 0]], [[10], [0]], [[0, 1]], 0, states=["iL", "vC"])) == places(
        ideal()
    )
    assert not places(
        rco.dc_motor(gain=1.0, time_constant=0.1)
    )  # sensors of masses sit where they are mounted
    assert not places(
        rco.mass_spring_damper([1.0, 1.0], [1.0, 1.0], [1.0, 1.0], sensors=[("displacement", 1)])
    )
