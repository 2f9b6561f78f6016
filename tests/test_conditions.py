"""Two conditions and one law, and what a record can show of the user's own effects."""

import control as ct
import numpy as np
import pytest

import rcorefine as rco

MOTOR = ct.ss([[-2.0]], [[3.0]], [[1.0]], 0, states=["speed"], inputs=["volt"], outputs=["speed"])
FRICTION = rco.Effect("coulomb_friction", "speed")


def record(load, seed, force=0.4, n=800):
    """Euler in steps of 1 ms of a motor with dry friction in proportion to its load."""
    rng = np.random.default_rng(seed)
    u, x, y = np.repeat(3 * rng.standard_normal(n // 20), 20), 0.0, []
    for k in range(n):
        y.append(x)
        for _ in range(20):
            x += 1e-3 * (-2 * x + 3 * u[k] - force * load * np.tanh(x / 1e-3))
    signals = np.vstack([u, np.full(n, load)])
    noisy = np.array(y) + 0.005 * rng.standard_normal(n)
    return rco.Measurement(signals, noisy, dt=0.02, input_labels=["volt", "load"], output_labels="speed")


@pytest.fixture(scope="module")
def taught():
    records = [record(1.0, 1), record(2.5, 2)]
    return rco.refine(MOTOR, records[0], [FRICTION]), records


@pytest.mark.parametrize("condition", ["load", [1.0, 2.5], [4.0, 10.0]])
def test_friction_in_proportion_to_a_condition_is_confirmed(taught, condition):
    better, records = taught
    assert rco.confirm(better, records).verdict == "refuted"
    found = rco.confirm(better, records, scales_with={"coulomb_friction@speed": condition})
    np.testing.assert_allclose(found.estimates[1].factors, [2.5], rtol=1e-12)
    assert found.estimates[1].agreement > 0.005
    assert "in proportion to" in found.message
    assert (
        found.conditions["coulomb_friction@speed"][1] == 2.5 * found.conditions["coulomb_friction@speed"][0]
    )
    assert "in proportion" in found.plot().axes[0, 0].get_legend_handles_labels()[1]


def test_a_wrong_condition_is_refuted(taught):
    found = rco.confirm(*taught, scales_with={"coulomb_friction@speed": [1.0, 2.0]})
    assert found.verdict == "refuted"


@pytest.mark.parametrize(
    ("given", "error", "said"),
    [
        (
            {"damping@speed": "load"},
            ct.ControlArgument,
            "the effects of the model are coulomb_friction@speed",
        ),
        ({"coulomb_friction@speed": "laod"}, ct.ControlArgument, "has volt, load, speed"),
        ({"coulomb_friction@speed": [1.0, 0.0]}, rco.DataError, "nonzero and of one sign"),
        ({"coulomb_friction@speed": [1.0]}, ct.ControlDimension, "scales_with"),
        ("load", ct.ControlArgument, "scales_with"),
    ],
)
def test_a_condition_that_is_none_is_refused(taught, given, error, said):
    with pytest.raises(error, match=said):
        rco.confirm(*taught, scales_with=given)


def test_check_compares_the_users_own_effects_with_what_the_record_shows(taught):
    data = taught[1][0]
    tiny = rco.Effect("coulomb_friction", "speed", start={"force": 1e-13})
    strong = rco.Effect("damping", "speed", fixed={"damping": 0.5})
    found = rco.check(MOTOR, data, effects=[tiny, strong])
    rows = {row.figure: row for row in found.rows if row.where == "speed" and row.what == "information"}
    assert rows["coulomb_friction: too small to show"].status == "look"
    assert "Your model has 1e-13" in rows["coulomb_friction: too small to show"].sentence
    assert rows["damping: shows"].status == "ok"


def test_what_check_calls_the_smallest_size_is_shown_by_nineteen_records_of_twenty():
    """A test finds it, even if it does not matter; at most 4 misses of 20 (binomial, p = 0.002)."""
    clean = record(1.0, 0, force=0.0)
    row = next(
        row for row in rco.check(MOTOR, clean, effects=[FRICTION]).rows if row.figure.startswith("coulomb")
    )
    least = float(row.figure.split("from ")[1])
    # in the model's units a force of the port acts on the state directly or by the gain of its input
    per_unit = rco.refine(MOTOR, record(1.0, 1), [FRICTION]).parameters[0].value / 0.4
    seen = 0
    for seed in range(20):
        data = record(1.0, 100 + seed, force=least / per_unit)
        found = rco.diagnose(MOTOR, data, candidates=[FRICTION])
        seen += found.verdict != "adequate" or np.isfinite(found.adequate_to)
    assert seen >= 16


def test_an_effect_with_several_free_coefficients_has_no_smallest_size(taught):
    with pytest.raises(ct.ControlArgument, match=r"fix the others \(static_force, velocity\)"):
        rco.check(MOTOR, taught[1][0], effects=[rco.Effect("stribeck_friction", "speed")])
