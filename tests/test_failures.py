"""The failure map: defects made here by hand, each found where it was put; nothing found where nothing is."""

from __future__ import annotations

import pickle
import sys
from pathlib import Path

import control as ct
import matplotlib.pyplot as plt
import numpy as np
import pytest
from scipy.signal import lfilter
from scipy.stats import binom

import rcorefine as rco
from rcorefine import comparison

sys.path.insert(0, str(Path(__file__).parents[1] / "benchmarks"))
import failure_map as bench

DT, N = 0.02, 2000
A = np.array([[0, 0, 1, 0], [0, 0, 0, 1], [-500, 200, -0.8, 0.2], [200, -200, 0.2, -0.4]])
B = np.array([[0.0], [0], [1], [0]])
C = np.array([[1.0, 0, 0, 0], [0, 1, 0, 0]])


def model(a=A) -> ct.StateSpace:
    return ct.ss(a, B, C, 0, inputs="f", outputs=["x1", "x2"], states=["x1", "x2", "v1", "v2"], name="chain")


def clean(seed=0, a=A):
    w = np.random.default_rng([seed, 1]).standard_normal(N)
    y = np.array(ct.forced_response(model(a).sample(DT), DT * np.arange(N), w).y).reshape(2, N)
    return w, y


def record(w, y, seed=0, color=(1.0,)):
    e = lfilter([1.0], color, np.random.default_rng([seed, 2]).standard_normal(y.shape))
    y = y + 0.02 * y.std(axis=1, keepdims=True) * e / e.std(axis=1, keepdims=True)
    return rco.Measurement(w, y, dt=DT, input_labels="f", output_labels=["x1", "x2"])


# ---------------------------------------------------------------------- one defect each
@pytest.mark.parametrize("color", [(1.0,), (1.0, -0.9)])
def test_exact_model_has_an_empty_map(color):
    found = rco.compare(model(), record(*clean(), color=color)).failures
    assert isinstance(found, comparison.FailureMap)
    assert len(found) == 0
    assert not found
    assert "No failure" in str(found)


def test_noise_free_exact_model_has_an_empty_map():
    w, y = clean()
    assert len(rco.compare(model(), rco.Measurement(w, y, dt=DT)).failures) == 0


def test_wrong_stiffness_is_named_by_its_modes_and_its_place():
    changed = A.copy()
    changed[2, 0] -= 30.0
    found = rco.compare(model(), record(*clean(a=changed))).failures
    assert found[0].dimension == "frequency"
    old, new = (np.sort(np.abs(np.linalg.eigvals(a)))[::2] for a in (A, changed))
    moved = {row["mode"]: row for row in found[0].values["modes"]}
    assert set(moved) == {1, 2}
    for k in (1, 2):
        assert moved[k]["omega_model"] == pytest.approx(old[k - 1], rel=1e-6)
        assert moved[k]["omega"] == pytest.approx(new[k - 1], rel=2e-3)
    places = [row for row in found if row.dimension == "place"]
    assert places[0].values["place"] == "x1"


def test_dropout_sign_delay_and_clipping():
    w, y = clean()
    lost = y.copy()
    lost[1, 1000:1100] = 0.0
    row = rco.compare(model(), record(w, lost)).failures[0]
    assert (row.dimension, row.measure, row.values["output"]) == ("time", "dropout", "x2")
    assert row.values["start"] == pytest.approx(20.0, abs=0.1)
    assert row.values["stop"] == pytest.approx(22.0, abs=0.1)
    assert row.p_value < 1e-9
    assert row.share > 0.9

    row = rco.compare(model(), record(w, y * [[1], [-1]])).failures[0]
    assert (row.measure, row.values["output"]) == ("sign", "x2")
    assert row.values["factor"] == pytest.approx(-1, abs=0.02)

    row = rco.compare(model(), record(w, np.concatenate([np.zeros((2, 3)), y[:, :-3]], axis=1))).failures[0]
    assert row.measure == "delay"
    assert row.values["samples"] == pytest.approx(3, abs=0.02)
    assert row.values["delay"] == pytest.approx(3 * DT, abs=1e-3)

    limit = float(np.quantile(y[0], 0.93))
    row = rco.compare(model(), record(w, np.minimum(y, [[limit], [np.inf]]))).failures[0]
    assert (row.measure, row.values["side"]) == ("clipping", "above")
    assert row.values["limit"] == pytest.approx(limit, rel=0.03)


def test_dead_zone_of_the_input_is_an_amplitude():
    w, _ = clean()
    dead = np.sign(w) * np.maximum(np.abs(w) - 0.5, 0.0)
    y = np.array(ct.forced_response(model().sample(DT), DT * np.arange(N), dead).y).reshape(2, N)
    row = rco.compare(model(), record(w, y)).failures[0]
    assert (row.dimension, row.measure) == ("amplitude", "dead zone")
    assert row.values["level"] == pytest.approx(0.5, rel=0.1)


@pytest.mark.parametrize("power, word", [(2, "even"), (3, "odd")])
def test_distortion_at_harmonics_that_were_not_sent(power, word):
    t = np.arange(4000)
    w = sum(np.cos(2 * np.pi * k * t / 500 + k**2) for k in (3, 9, 15, 21))
    y = np.array(ct.forced_response(model().sample(DT), DT * t, w).y).reshape(2, -1)
    y[0] += 0.1 * y[0] ** power / y[0].std() ** (power - 1)
    found = rco.compare(model(), record(w, y)).failures
    rows = [row for row in found if row.values.get("parity") == word]
    assert rows, str(found)
    assert rows[0].values["output"] == "x1"
    other = [row for row in found if row.values.get("parity") not in (None, word)]
    assert not other, str(found)


def test_two_failures_are_two_rows():
    changed = A.copy()
    changed[2, 2] = -2.4
    w, y = clean(a=changed)
    y[1, 1200:1300] = 0.0
    found = rco.compare(model(), record(w, y)).failures
    own = {row.measure for row in found if row.role in ("first", "besides")}
    assert "dropout" in own, str(found)
    assert own & {"mode", "modes"}, str(found)


QUICK = [
    "damping 50 % off",
    "gain off in one band",
    "drift",
    "Coulomb friction",
    "hardening above an amplitude",
]


@pytest.mark.parametrize("name", QUICK)
def test_benchmark_defect(name):
    """One seed of each row of the benchmark, whose records are made by exact propagation of their own."""
    planted = bench.DEFECTS[name](40)
    found = rco.compare(planted.structure.model, planted.record()).failures
    assert planted.right(found[0]), str(found)


@pytest.mark.slow
@pytest.mark.parametrize("name", list(bench.DEFECTS))
def test_top_row_names_the_defect(name):
    hits = 0
    for seed in range(500, 540):
        planted = bench.DEFECTS[name](seed)
        found = rco.compare(planted.structure.model, planted.record()).failures
        hits += bool(found) and planted.right(found[0])
    assert hits >= binom.ppf(0.01, 40, 0.95)


@pytest.mark.slow
@pytest.mark.parametrize("name", list(bench.NOTHING))
def test_exact_model_stays_empty_over_seeds(name):
    hits = 0
    for seed in range(500, 600):
        planted = bench.NOTHING[name](seed)
        hits += not rco.compare(planted.structure.model, planted.record()).failures
    assert hits >= binom.ppf(0.01, 100, 0.95)


# ---------------------------------------------------------------------- the container
def test_map_is_searched_once_pickles_and_reads_well():
    changed = A.copy()
    changed[2, 0] -= 30.0
    result = rco.compare([model(), model(changed)], record(*clean(a=changed)))
    first, second = result.failures
    assert result.failures[0] is first
    assert first[0].dimension == "frequency"
    assert len(second) == 0
    twin = pickle.loads(pickle.dumps(result))
    assert str(twin.failures[0]) == str(first)
    assert isinstance(result.select(0).failures, comparison.FailureMap)
    text = str(first)
    assert max(map(len, text.splitlines())) <= 80
    assert "share" in text
    assert all(0 <= row.share <= 1 and 0 <= row.p_value < 0.01 for row in first)


def test_models_without_ports_or_in_discrete_time_are_searched_too():
    w, y = clean()
    late = record(w, np.concatenate([np.zeros((2, 2)), y[:, :-2]], axis=1))
    row = rco.compare(model().sample(DT), late).failures[0]
    assert row.measure == "delay"
    assert row.values["samples"] == pytest.approx(2, abs=0.05)


def test_short_records_say_so():
    w, y = clean()
    data = rco.Measurement(w[:40], y[:, :40], dt=DT)
    found = rco.compare(model(), data).failures
    assert len(found) == 0
    assert "too few" in str(found)


# ---------------------------------------------------------------------- force, horizon, pictures, responses
def test_residual_force_follows_the_missing_spring():
    changed = A.copy()
    changed[2, 0] -= 30.0  # mass 1: the model lacks a spring of 30 on x1
    found = comparison.residual_force(rco.compare(model(), record(*clean(a=changed))), 0, "x1")
    slope = np.polyfit(found.position, found.force, 1)[0]
    assert slope == pytest.approx(30, rel=0.15)


def test_horizon_is_flat_for_the_true_model_and_ends_in_the_free_run():
    changed = A.copy()
    changed[2, 0] -= 30.0
    data = record(*clean())
    found = comparison.horizon_error(rco.compare([model(), model(changed)], data), [1, 5, 50, 400])
    noise = 0.02 * data.outputs.std(axis=1)
    np.testing.assert_allclose(found.rmse[0] / noise[:, None], 1.0, atol=0.12)
    assert (found.rmse[1, :, 0] < 0.5 * found.free_run[1]).all()
    np.testing.assert_allclose(found.rmse[1, :, -1], found.free_run[1], rtol=0.25)
    with pytest.raises(rco.DataError, match="whole numbers"):
        comparison.horizon_error(rco.compare(model(), data), [0])


@pytest.fixture(scope="module")
def two():
    """The true model and one with a spring more, on one record."""
    changed = A.copy()
    changed[2, 0] -= 30.0
    return rco.compare([model(), model(changed)], record(*clean()))


@pytest.mark.parametrize(
    "kind, shape",
    [("time", (4, 1)), ("residual", (2, 2)), ("horizon", (2, 1)), ("map", (4, 2)), ("bode", (6, 1))],
)
def test_pictures(two, kind, shape):
    cplt = two.plot(kind, label=["a $", "b"], title="T", legend_loc="upper left", rcParams={"font.size": 8})
    assert cplt.axes.shape == shape
    assert cplt.figure.get_suptitle() == "T"
    cplt.figure.canvas.draw()
    again = two.plot(kind, ax=cplt.axes, show_legend=False)
    assert again.figure is cplt.figure
    plt.close("all")
    with pytest.raises(ct.ControlDimension):
        two.plot(kind, label=["only one"])
    with pytest.raises(ct.ControlArgument, match="kind"):
        two.plot("bodé")


def test_measured_response_is_compared_directly():
    omega = np.geomspace(1, 60, 60)
    wrong = model(A * np.array([[1], [1], [1.1], [1]]))
    G = np.array([C @ np.linalg.solve(1j * o * np.eye(4) - A, B) for o in omega]).transpose(1, 2, 0)
    data = ct.frd(G, omega, name="analyzer", inputs=["f"], outputs=["x1", "x2"])
    result = rco.compare([model(), wrong], data)
    assert isinstance(result, comparison.FrequencyComparison)
    assert result.fit.shape == (2, 2, 1)
    np.testing.assert_allclose(result.fit[0], 100, atol=1e-8)
    Gw = np.array([C @ np.linalg.solve(1j * o * np.eye(4) - np.array(wrong.A), B) for o in omega]).transpose(
        1, 2, 0
    )
    expected = 100 * (
        1 - np.linalg.norm(G - Gw, axis=2) / np.linalg.norm(G - G.mean(axis=2, keepdims=True), axis=2)
    )
    np.testing.assert_allclose(result.fit[1], expected, rtol=1e-9)
    assert max(map(len, str(result).splitlines())) <= 80
    assert result.plot().axes.shape == (6, 1)
    one = rco.compare(model(), data)
    assert one.fit.shape == (2, 1)
    with pytest.raises(ct.ControlArgument, match="horizon belongs to records in time"):
        rco.compare(model(), data, horizon=1.0)
    with pytest.raises(ct.ControlDimension, match="response"):
        rco.compare(ct.ss(-1, 1, 1, 0), data)
