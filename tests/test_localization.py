"""Damage localization on structures whose damage is known, against Cramer-Rao bounds worked out here."""

from __future__ import annotations

import pickle
from dataclasses import replace

import control as ct
import matplotlib.pyplot as plt
import numpy as np
import pytest
from cases import slow
from scipy import linalg
from scipy.signal import cont2discrete, dlsim
from scipy.stats import binom

import rcorefine as rco
from rcorefine.localization.damping import square_root

MASSES = np.array([3452.4, 2652.4, 2652.4, 1809.9])
STIFFNESS = np.full(4, 67.9e6)


def shear_matrix(stiffness):
    n = len(stiffness)
    G = np.eye(n) - np.eye(n, k=-1)
    return G.T @ np.diag(stiffness) @ G


def modal_damping(masses, stiffness, ratio):
    """M Phi diag(2 zeta omega) Phi' M, by scipy's eigenvectors."""
    M, K = np.diag(masses), shear_matrix(stiffness)
    values, modes = linalg.eigh(K, M)
    return M @ modes @ np.diag(2 * ratio * np.sqrt(values)) @ modes.T @ M


def shear_frame(masses, stiffness, C, sensors):
    return rco.mechanical(masses, C=C, K=shear_matrix(stiffness), sensors=sensors, force_map=len(masses))


def record_of(true, inputs, dt, noise, rng):
    blank = rco.Measurement(inputs, np.zeros((true.linear.n_outputs, inputs.shape[-1])), dt=dt)
    clean = rco.simulate(true, blank, "zero").outputs
    noisy = clean + noise * clean.std(axis=1, keepdims=True) * rng.standard_normal(clean.shape)
    return rco.Measurement(inputs, noisy, dt=dt)


def places(found):
    return {row.place for row in found.named}


# --------------------------------------------------------------- the IASC-ASCE frame, 4 storeys
LOSSES = {
    "storey 1, 71 %": [0.7103, 0, 0, 0],
    "storeys 1 and 3, 71 %": [0.7103, 0, 0.7103, 0],
    "storey 1, 18 %": [0.1776, 0, 0, 0],
    "storey 1, 6 %": [0.0592, 0, 0, 0],
}


@pytest.mark.slow
@pytest.mark.parametrize("follows", [True, False], ids=["own damping", "undamaged damping"])
@pytest.mark.parametrize("sensors", ["acceleration", ("acceleration", 4)], ids=["all", "roof"])
@pytest.mark.parametrize("loss", LOSSES.values(), ids=LOSSES)
def test_benchmark_frame(loss, sensors, follows, rng):
    """The record of the benchmark: 40 s at 1 ms, 10 % noise, 1 % damping, ratio free."""
    loss = np.array(loss)
    links = {f"storey{i + 1}": (i + 1, i) for i in range(4)}
    nominal = rco.mechanical(
        MASSES, K=shear_matrix(STIFFNESS), damping_ratio=0.01, links=links, sensors=sensors, force_map=4
    )
    dt, n = 1e-3, 40_000
    inputs = 1e3 * rng.standard_normal(n)
    ny = nominal.linear.n_outputs

    def outputs(p, factor):
        k = STIFFNESS * (1 - p)
        C = factor * modal_damping(MASSES, k if follows else STIFFNESS, 0.01)
        true = shear_frame(MASSES, k, C, sensors)
        return rco.simulate(true, rco.Measurement(inputs, np.zeros((ny, n)), dt=dt), "zero").outputs

    clean = outputs(loss, 1.0)
    sigma = 0.1 * clean.std(axis=1, keepdims=True)
    data = rco.Measurement(inputs, clean + sigma * rng.standard_normal(clean.shape), dt=dt)
    found = rco.localize_damage(nominal, data)

    damaged = np.flatnonzero(loss)
    assert found.damping == "ratio"
    assert places(found) == {f"storey{i + 1}" for i in damaged}
    # Cramer-Rao: the damaged stiffnesses and the damping ratio unknown
    step, columns = 1e-5, []
    for i in damaged:
        up, down = loss.copy(), loss.copy()
        up[i], down[i] = loss[i] + step, loss[i] - step
        columns.append((outputs(up, 1.0) - outputs(down, 1.0)) / (2 * step))
    columns.append((outputs(loss, 1 + step) - outputs(loss, 1 - step)) / (2 * step))
    J = np.array([(column / sigma).ravel() for column in columns])
    bound = 100 * np.sqrt(np.diag(np.linalg.inv(J @ J.T)))[:-1]
    for i, sd in zip(damaged, bound, strict=True):
        row = found.rows[i]
        assert row.percent == pytest.approx(-100 * loss[i], abs=0.2)
        assert abs(row.percent + 100 * loss[i]) < 5 * sd
        assert row.percent_std <= 1.3 * sd


# --------------------------------------------------------------- six storeys, one sensor
FLOORS = np.full(6, 1e5)
STOREYS = 2e8 * np.array([1.2, 1.2, 1.0, 1.0, 0.8, 0.8])
SIX = np.array([0, 0.1, 0, 0, 0.2, 0])


@pytest.mark.slow
@pytest.mark.parametrize("excitation, seeds", [("force", 6), ("base", 3)])
def test_six_storeys_one_accelerometer(excitation, seeds):
    """60 s at 200 Hz, 3 % noise: under base motion many structures share the response of the roof."""
    right = 0
    for seed in range(seeds):
        rng = np.random.default_rng(seed)
        kwargs = {"sensors": ("acceleration", 6)}
        links = {f"storey{i + 1}": (i + 1, i) for i in range(6)}
        force = {"force_map": 6} if excitation == "force" else {"excitation": "base"}

        def building(k, links=links, force=force, kwargs=kwargs):
            return rco.mechanical(
                FLOORS, K=shear_matrix(k), damping_ratio=0.02, links=links, **force, **kwargs
            )

        inputs = rng.standard_normal(12_000) * (1e5 if excitation == "force" else 1.0)
        data = record_of(building(STOREYS * (1 - SIX)), inputs, 5e-3, 0.03, rng)
        found = rco.localize_damage(building(STOREYS), data)
        right += places(found) == {"storey2", "storey5"}
        assert found.row("storey2").percent == pytest.approx(-10, abs=0.5)
        assert found.row("storey5").percent == pytest.approx(-20, abs=0.5)
    assert right >= binom.ppf(0.01, seeds, 0.95)


# --------------------------------------------------------------- small chains
def chain(k, sensors=("displacement", (1, 3)), c=(0.2, 0.16, 0.12)):
    return rco.mass_spring_damper([1, 1, 1], c, k, force=3, sensors=sensors)


def chain_record(k, noise, seed, n=1500, dt=0.02, **kwargs):
    rng = np.random.default_rng(seed)
    return record_of(chain(k, **kwargs), rng.standard_normal(n), dt, noise, rng)


@pytest.mark.parametrize(
    ("loss", "dt"), [(0.1, 0.05), (0.5, 0.02), *slow((0.1, 0.02), (0.3, 0.02), (0.3, 0.05), (0.5, 0.05))]
)
def test_chain_without_noise(loss, dt):
    """No bias that grows with the sampling time: the correction is in continuous time."""
    data = chain_record([10, 8 * (1 - loss), 6], 0.0, 1, dt=dt)
    found = rco.localize_damage(chain([10, 8, 6]), data)
    assert places(found) == {"link2"}
    assert found.success
    assert found.row("link2").percent == pytest.approx(-100 * loss, rel=1e-5)
    others = [abs(row.joint / row.nominal) for row in found.rows if not row.named]
    assert max(others) < 0.005


@pytest.mark.slow
def test_chain_intervals_hold():
    """5 % noise: the truth lies in its 95 % interval in at least 90 % of 40 seeds."""
    inside = named = 0
    for seed in range(40):
        found = rco.localize_damage(chain([10, 8, 6]), chain_record([10, 5.6, 6], 0.05, seed, n=1500))
        row = found.row("link2")
        inside += row.interval[0] <= -30 <= row.interval[1]
        named += places(found) == {"link2"}
    assert inside >= 36
    assert named >= 36


@pytest.mark.slow
def test_nothing_is_named_where_nothing_changed():
    """At significance 0.05 at most 5 % of the records name anything; 40 records, 99.9 % bound."""
    alarms = 0
    for seed in range(40):
        data = chain_record([10, 8, 6], 0.05, seed, n=800)
        alarms += bool(rco.localize_damage(chain([10, 8, 6]), data, significance=0.05, least=0.0).named)
    assert alarms <= binom.ppf(0.999, 40, 0.05)


@pytest.mark.slow
def test_detection_limit_is_kept():
    """A loss of the detection limit is shown with about the stated probability (0.8 here)."""
    limit = rco.localize_damage(chain([10, 8, 6]), chain_record([10, 8, 6], 0.1, 99, n=800), power=0.8).row(
        "link1"
    )
    shown = 0
    for seed in range(40):
        k = [10 - limit.limit, 8, 6]
        shown += "link1" in places(rco.localize_damage(chain([10, 8, 6]), chain_record(k, 0.1, seed, n=800)))
    assert binom.ppf(0.001, 40, 0.8) <= shown <= binom.ppf(0.999, 40, 0.8) + 2


def test_gain_and_lost_damping_are_told_apart():
    true = chain([12, 8, 6], c=(0.2, 0.16, 0.04))
    rng = np.random.default_rng(3)
    found = rco.localize_damage(
        chain([10, 8, 6]), record_of(true, rng.standard_normal(2500), 0.05, 0.02, rng)
    )
    changes = {(row.kind, row.place): row.change for row in found.named}
    assert set(changes) == {("stiffness", "link1"), ("damping", "link3")}
    assert changes["stiffness", "link1"] == pytest.approx(2.0, abs=0.1)
    assert changes["damping", "link3"] == pytest.approx(-0.08, abs=0.02)


def test_papers_two_dof():
    """Section VI: k2 and k3 from 25000 to 1500 and 2000 N/m, one velocity, 1 % noise."""

    def structure(k2, k3):
        return rco.mass_spring_damper(
            [0.8, 0.5],
            [100, 200, 120],
            [1000, k2, k3],
            sensors=("velocity", 1),
            force=np.array([[1e3], [0.0]]),
        )

    rng = np.random.default_rng(0)
    data = record_of(structure(1500, 2000), rng.standard_normal(5000), 1e-3, 0.01, rng)
    found = rco.localize_damage(structure(25000, 25000), data)
    assert {row.label for row in found.named} == {"stiffness at link2", "stiffness at link3"}
    for name, true in (("k2", 1500), ("k3", 2000)):
        row = found.row(name)
        assert row.nominal + row.change == pytest.approx(true, abs=4 * row.std)
        assert row.std < 50


def test_plain_statespace():
    example = rco.examples.two_dof()
    data = example.record(n_samples=2500, noise=0.01, rng=1)
    found = rco.localize_damage(example.initial, data)
    assert {row.label for row in found.named} == {"stiffness at q1-q2", "stiffness at q2"}
    assert isinstance(found.system, ct.StateSpace)


def test_parallel_springs_are_one_group():
    """Two links between the same ends: only their sum acts."""
    links = {"left": (1, 0), "middle": (2, 1), "right": np.array([1.0, 0.0])}
    K = np.array([[18.0, -8.0], [-8.0, 8.0]])
    model = rco.mechanical([1.0, 1.0], C=0.02 * K, K=K, links=links, sensors="displacement", force_map=2)
    true = rco.mechanical(
        [1.0, 1.0], C=0.02 * K, K=K - np.diag([3.0, 0]), links=links, sensors="displacement", force_map=2
    )
    rng = np.random.default_rng(0)
    data = record_of(true, rng.standard_normal(3000), 0.05, 0.02, rng)
    candidates = ["left", "middle", "right"]
    with pytest.warns(rco.IdentifiabilityWarning, match="left, stiffness at right"):
        found = rco.localize_damage(model, data, candidates=candidates, damping="fixed")
    assert found.groups == (("stiffness at left", "stiffness at right"),)
    assert len(found.named) == 1
    assert found.named[0].rivals
    assert found.named[0].change == pytest.approx(-3.0, abs=0.1)


def test_scenarios_are_ranked(found):
    best = found.ranking[0]
    assert best.name == "spring <2>"
    assert best.probability > 0.99
    assert sum(row.probability for row in found.ranking) == pytest.approx(1.0)
    assert best.percent["stiffness at link2"] == pytest.approx(-30, abs=1)
    assert {row.name for row in found.ranking} == {*SCENARIOS, "no damage"}
    data = chain_record([10, 5.6, 6], 0.03, 5)
    listed = rco.localize_damage(chain([10, 8, 6]), data, hypotheses=[["link1"], ["link2"]]).ranking
    assert listed[0].name == "stiffness at link2"


def test_refinement_is_a_baseline():
    """A model calibrated on the healthy structure is the undamaged one; what it found stays."""
    healthy = rco.refine(
        chain([10, 8, 6]), chain_record([10, 8, 7], 0.01, 0), [rco.Effect("stiffness", "link3")]
    )
    found = rco.localize_damage(healthy, chain_record([10, 6.4, 7], 0.01, 1))
    assert places(found) == {"link2"}
    assert found.row("link3").nominal == pytest.approx(7.0, abs=0.05)
    assert found.row("link2").percent == pytest.approx(-20, abs=0.5)


def test_tolerance_hides_small_changes():
    """A model that is known to 5 % cannot show a loss of 3 %."""
    data = chain_record([9.7, 8, 6], 0.01, 0)
    assert places(rco.localize_damage(chain([10, 8, 6]), data)) == {"link1"}
    assert not rco.localize_damage(chain([10, 8, 6]), data, tolerance=0.05).named


def test_several_records_and_known_start():
    parts = [chain_record([10, 5.6, 6], 0.03, seed, n=1000) for seed in (0, 1)]
    both = rco.localize_damage(chain([10, 8, 6]), parts).row("link2")
    one = rco.localize_damage(chain([10, 8, 6]), parts[0]).row("link2")
    assert both.std == pytest.approx(one.std / np.sqrt(2), rel=0.25)
    assert rco.localize_damage(chain([10, 8, 6]), parts, x0="zero").named[0].place == "link2"


# --------------------------------------------------------------- the result
SCENARIOS = {
    "spring 1": ["link1"],
    "spring <2>": rco.Effect("stiffness", "link2"),
    "springs 1 and 3": ["link1", "link3"],
    "crack in spring 2": [rco.Effect("bilinear_stiffness", "link2")],
}


@pytest.fixture(scope="module")
def found():
    data = chain_record([10, 5.6, 6], 0.03, 5)
    return rco.localize_damage(chain([10, 8, 6]), data, hypotheses=SCENARIOS)


def test_text_html_pickle(found):
    text = str(found)
    assert max(len(line) for line in text.splitlines()) <= 80
    assert "LOST" in text
    assert "link2 lost" in text
    assert "&lt;2&gt;" in found._repr_html_()
    again = pickle.loads(pickle.dumps(found))
    assert str(again) == text
    assert found.effects[0].label == "stiffness at link2"
    np.testing.assert_allclose(
        found.system.A, chain([10, 8 + found.row("k2").change, 6]).system.A, atol=1e-12
    )


def test_plot(found):
    cplt = found.plot(label=["a", "b", "c"], title="x")
    assert cplt.axes.shape == (2, 1)
    heights = [patch.get_height() for patch in cplt.axes[0, 0].patches]
    assert min(heights) == pytest.approx(found.row("link2").percent)
    _, ax = plt.subplots()
    assert found.plot(kind="damping", ax=ax, show_legend=False).legend is None
    with pytest.raises(rco.ModelError, match="kind"):
        found.plot(kind="mass")


def test_row_by_name(found):
    assert found.row("k2") is found.row("link2")
    with pytest.raises(rco.ModelError, match="candidates"):
        found.row("link9")


# --------------------------------------------------------------- arguments
@pytest.mark.parametrize(
    "kwargs, error, match",
    [
        ({"damping": "modal"}, ct.ControlArgument, "damping"),
        ({"significance": 2}, ct.ControlArgument, "significance"),
        ({"power": 0}, ct.ControlArgument, "power"),
        ({"least": -1}, ct.ControlArgument, "least"),
        ({"x0": "rest"}, ct.ControlArgument, "x0"),
        ({"candidates": ["link7"]}, rco.ModelError, "link7"),
        ({"candidates": [rco.Effect("coulomb_friction", "link1")]}, ct.ControlArgument, "hypotheses"),
        ({"hypotheses": [3]}, ct.ControlArgument, "list of effects or places"),
        ({"hypotheses": {"a": [3]}}, ct.ControlArgument, "int"),
        ({"nonsense": 1}, TypeError, "nonsense"),
    ],
)
def test_bad_arguments(kwargs, error, match):
    with pytest.raises(error, match=match):
        rco.localize_damage(chain([10, 8, 6]), chain_record([10, 8, 6], 0.05, 0, n=300), **kwargs)


def test_model_without_stiffness():
    data = rco.Measurement(np.random.default_rng(0).standard_normal(50), np.zeros(50), dt=0.1)
    with pytest.raises(rco.ModelError, match="no stiffness"):
        rco.localize_damage(ct.ss([[-1.0]], [[1.0]], [[1.0]], 0), data)


# --------------------------------------------------------------- pieces
def test_square_root_is_analytic():
    """Against scipy, and its derivative against a central difference."""
    rng = np.random.default_rng(0)
    X = np.diag(1 / MASSES) @ shear_matrix(STIFFNESS)
    np.testing.assert_allclose(square_root(X), linalg.sqrtm(X), rtol=1e-9)
    np.testing.assert_allclose(square_root(X.astype(complex)), linalg.sqrtm(X), rtol=1e-9)
    direction = X * rng.standard_normal(X.shape)
    slope = square_root(X + 1e-30j * direction).imag / 1e-30
    step = 1e-5
    central = (linalg.sqrtm(X + step * direction) - linalg.sqrtm(X - step * direction)) / (2 * step)
    np.testing.assert_allclose(slope, central, rtol=1e-5, atol=1e-6 * np.abs(central).max())


# --------------------------------------------------------------- sensors and residual
def three_masses(k, gains, seed, sensors="velocity", offsets=(0.0, 0.0), n=1500, delay=0):
    """Model and record of a chain that `mass_spring_damper` builds, its sensors not as declared."""

    def build(springs):
        return rco.mass_spring_damper(
            [1.2, 0.9, 1.1], [0.25, 0.2, 0.15], springs, force=2, sensors=(sensors, (1, 3))
        )

    rng = np.random.default_rng([seed, 3])
    w = rng.standard_normal(n)
    blank = rco.Measurement(np.roll(w, delay), np.zeros((2, n)), dt=0.02)
    y = rco.simulate(build(k), blank, "zero").outputs
    size = y.std(axis=1, keepdims=True)
    shown = np.array(gains)[:, None] * y + np.array(offsets)[:, None] * size
    noisy = shown + 0.02 * size * rng.standard_normal(y.shape)
    return build([110.0, 85.0, 70.0]), rco.Measurement(w, noisy, dt=0.02)


@pytest.mark.parametrize(
    "sensors, gains, offsets",
    [("velocity", (0.97, 1.03), (0.2, 0.0)), *slow(("displacement", (1.3, 1.0), (0.0, -0.5)))],
)
def test_gains_and_offsets_of_sensors_are_no_damage(sensors, gains, offsets):
    model, data = three_masses([110.0, 85.0, 70.0], gains, 4, sensors, offsets)
    found = rco.localize_damage(model, data)
    assert found.named == ()
    assert found.explained
    shown = {row.name: row for row in found.nuisances}
    for label, gain in zip(model.linear.output_labels, gains, strict=True):
        row = shown[f"output_gain at {label}"]
        assert abs(row.value - (gain - 1)) < 4 * row.std


def test_damage_is_found_through_wrong_gains():
    model, data = three_masses([110.0, 85.0, 56.0], (1.04, 0.95), 5)
    found = rco.localize_damage(model, data)
    (row,) = found.named
    assert row.label == "stiffness at link3"
    assert abs(row.change + 14.0) < 4 * row.std
    assert found.explained
    assert found.message == "Converged."


def test_what_no_change_explains_is_said():
    model, data = three_masses([110.0, 85.0, 70.0], (1.0, 1.0), 6, delay=2)
    found = rco.localize_damage(model, data)
    assert not found.explained
    assert "do not explain the record" in str(found)
    assert min(test.p_value for test in found.tests) < 1e-10
    short = data.segment(0, 3)
    assert "too short to test" in rco.localize_damage(model, short).message


def test_a_sensor_that_a_scenario_blames_is_no_nuisance():
    model, data = three_masses([110.0, 85.0, 70.0], (1.1, 1.0), 7)
    label = model.linear.output_labels[0]
    found = rco.localize_damage(
        model, data, hypotheses={"sensor": rco.Effect("output_gain", label), "spring": "link2"}
    )
    assert found.ranking[0].name == "sensor"
    assert found.ranking[0].probability > 0.99


@pytest.mark.parametrize("x0", [None, float("nan"), True, [0.0, np.nan, 0, 0, 0, 0], np.zeros(9), "rest"])
def test_initial_states_that_mean_nothing_are_refused(x0):
    with pytest.raises((rco.DataError, ct.ControlArgument, ct.ControlDimension), match="x0"):
        rco.localize_damage(chain([10, 8, 6]), chain_record([10, 8, 6], 0.05, 0, n=300), x0=x0)


def test_dead_sensors_are_left_out_or_refused_with_a_word():
    model = rco.mass_spring_damper([1, 1], [0.2, 0.16], [10, 8], force=2, sensors=("displacement", (1, 2)))
    true = rco.mass_spring_damper([1, 1], [0.2, 0.16], [10, 6.4], force=2, sensors=("displacement", (1, 2)))
    rng = np.random.default_rng(5)
    w = rng.standard_normal(1500)
    y = rco.simulate(true, rco.Measurement(w, np.zeros((2, 1500)), dt=0.05), "zero").outputs
    y = y + 0.02 * y.std() * rng.standard_normal(y.shape)
    for stuck in (0.0, 3.0):
        y[1] = stuck
        with pytest.warns(rco.ExcitationWarning, match="left out: it never changes"):
            found = rco.localize_damage(model, rco.Measurement(w, y, dt=0.05))
        assert [row.label for row in found.named] == ["stiffness at link2"]
        assert abs(found.named[0].percent + 20) < 4 * found.named[0].percent_std + 0.1
        assert "left out" in str(found)
    dead = rco.Measurement(w, np.full((2, 1500), 3.0), dt=0.05)
    for question in (rco.localize_damage, rco.diagnose):
        with pytest.raises(rco.DataError, match="no output ever changes"):
            question(model, dead)


def test_a_fit_that_diverges_is_no_number(rng):
    """An initial model without a free run has no fit; a fit below zero is of no use."""
    model, force = rco.mass_spring_damper(1.0, 0.8, 100.0), 10.0 * rng.standard_normal(400)
    y = rco.simulate(model, rco.Measurement(force, np.zeros(400), dt=0.02), "zero").outputs[0]
    data = rco.Measurement(force, y + 0.01 * y.std() * rng.standard_normal(400), dt=0.02)
    found = rco.localize_damage(model, data)
    assert "do not use" not in str(found)
    text = " ".join(str(replace(found, initial_fit=np.array([np.nan]), fit=np.array([-2302.0]))).split())
    assert "diverges -> -2302 %." in text
    assert "worse than a constant: do not use them" in text
    assert "nan" not in text


@pytest.mark.parametrize(("link", "loss"), [(3, 0.6), *slow((2, 0.2))])
def test_one_sensor_names_the_one_change(link, loss):
    """Above its modes the response of the far end is noise: it gives no starting values.

    With one sensor seven changes at four places fit as well as the one that is there.
    """
    k, c = np.array([900.0, 800.0, 700.0, 600.0]), np.array([0.4, 0.3, 0.3, 0.3])
    model = rco.mass_spring_damper([1.0] * 4, list(c), list(k), force=1, sensors=[("displacement", 4)])
    rng = np.random.default_rng([0, 4, 91])
    force, ends = rng.standard_normal(3000), np.eye(4) - np.eye(4, k=-1)
    k[link - 1] *= 1.0 - loss
    A = np.block([[np.zeros((4, 4)), np.eye(4)], [-ends.T @ np.diag(k) @ ends, -ends.T @ np.diag(c) @ ends]])
    plant = A, np.eye(8)[:, 4:5], np.eye(8)[3:4], np.zeros((1, 1))
    y = dlsim((*cont2discrete(plant, 0.01)[:4], 0.01), force)[1][:, 0]
    found = rco.localize_damage(
        model, rco.Measurement(force, y + 0.03 * y.std() * rng.standard_normal(3000), dt=0.01)
    )
    (row,) = found.named
    assert row.label == f"stiffness at link{link}"
    assert abs(row.percent + 100 * loss) < 3.3 * row.percent_std
