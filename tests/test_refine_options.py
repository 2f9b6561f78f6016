"""What may be asked of refine, what it returns, and what it says about bad input."""

from __future__ import annotations

import copy
import functools
import pickle
import warnings
from dataclasses import replace

import control as ct
import numpy as np
import pytest
from inner import stable_model
from scipy.integrate import solve_ivp
from scipy.signal import freqz
from test_refine import STEP, chain, held_response

import rcorefine as rco
from rcorefine import DataError, Effect, IdentifiabilityWarning, Measurement, ModelError, refine

N = 800


def spring_lost(loss=5.0, output="v1"):
    """The chain whose spring from mass 2 to mass 1 is softer."""
    A = np.array(chain().A)
    A[2] += loss * np.array([1, -1, 0, 0]) / 1.0
    A[3] += loss * np.array([-1, 1, 0, 0]) / 0.7
    model = chain(output)
    return ct.ss(A, model.B, model.C, model.D)


def record(seed=0, noise=0.01, system=None, x0=None, offset=0.0, n=N, **options):
    rng = np.random.default_rng(seed)
    w = 10 * rng.standard_normal(n)
    y = held_response(spring_lost() if system is None else system, w, STEP, x0) + offset
    return Measurement(w, y + noise * y.std() * rng.standard_normal(y.shape), dt=STEP, **options)


SPRING = Effect("stiffness", "x1-x2")


# --------------------------------------------------------------------- linear parameters
def test_free_linear_floats_everything_the_model_has():
    result = refine(chain(), record(), free="linear")
    rows = {(row.kind, row.place): row for row in result.parameters if row.role == "linear"}
    spring = rows["stiffness", "x1-x2"]
    assert abs(spring.coefficient + 5.0) < 4 * spring.std
    for key, row in rows.items():
        if key != ("stiffness", "x1-x2"):
            assert abs(row.coefficient) < 4 * row.std, key


def test_free_by_name_and_by_effect_agree():
    data = record()
    names = {(q.kind, q.place): q.name for q in rco.refine(chain(), data).physical_model.parameters}
    by_name = refine(chain(), data, free=[names["stiffness", "x1-x2"]])
    by_effect = refine(chain(), data, free=[SPRING])
    as_effect = refine(chain(), data, [SPRING])
    assert [row.role for row in by_name.parameters[:1]] == ["linear"]
    np.testing.assert_allclose(by_name.theta, by_effect.theta, rtol=1e-6, atol=1e-9)
    np.testing.assert_allclose(by_name.theta, as_effect.theta, rtol=1e-5, atol=1e-9)


def test_tolerance_is_a_prior():
    """Declared 2 %: the true error of 20 % is out of reach, and a parameter that is right stays."""
    data = record()
    tight = refine(chain(), data, tolerance=1e-4)
    loose = refine(chain(), data, tolerance=0.2)
    nominal = {(row.kind, row.place): abs(row.initial) for row in tight.parameters}
    for row in tight.parameters:
        if row.role == "linear" and row.kind == "stiffness":
            assert abs(row.coefficient) < 0.02 * nominal[row.kind, row.place]
    found = loose.parameter("stiffness", "x1-x2")
    assert abs(found.coefficient + 5.0) < 4 * found.std
    assert loose.fit[0] > tight.fit[0]


def test_two_percent_tolerance_with_an_effect():
    """Drift of the parameters within what was declared does not spoil the effect."""
    A = np.array(spring_lost(6.0).A)
    A[2, 0] -= 0.8  # ground spring 2 % stiffer
    data = record(system=ct.ss(A, chain().B, chain().C, 0))
    result = refine(chain(), data, [SPRING], tolerance=0.02)
    row = result.parameter("stiffness", "x1-x2")
    assert row.role == "effect"
    assert abs(row.coefficient + 6.0) < 4 * row.std
    ground = result.parameter("stiffness", "x1")
    assert abs(ground.coefficient - 0.8) < 4 * ground.std
    assert all(row.std <= 0.021 * abs(row.initial) for row in result.parameters if row.role == "linear")


def test_prior_of_an_effect_pulls():
    data = record()
    free = refine(chain(), data, [SPRING]).parameters[0]
    expected = free.coefficient + 4 * free.std
    prior = Effect("stiffness", "x1-x2", start={"stiffness": expected}, prior={"stiffness": free.std})
    pulled = refine(chain(), data, [prior]).parameters[0]
    # a prior as sure as the data meets it half way
    np.testing.assert_allclose(pulled.coefficient, free.coefficient + 2 * free.std, atol=0.3 * free.std)
    np.testing.assert_allclose(pulled.std, free.std / np.sqrt(2), rtol=0.1)


# ----------------------------------------------------------- states, records, noise, horizon
def test_initial_state_is_estimated_given_or_zero():
    x0 = np.array([0.5, -0.4, 1.0, 2.0])
    data = record(x0=x0)
    estimated = refine(chain(), data, [SPRING])
    given = refine(chain(), data, [SPRING], x0=x0)
    np.testing.assert_allclose(estimated.initial_states[0], x0, atol=0.3)
    for result in (estimated, given):
        assert abs(result.parameters[0].coefficient + 5) < 3.5 * result.parameters[0].std
    zero = refine(chain(), data, [SPRING], x0="zero")
    assert zero.fit[0] < given.fit[0]
    rest = record()
    np.testing.assert_array_equal(refine(chain(), rest, [SPRING], x0="zero").initial_states, np.zeros((1, 4)))


def test_several_records_share_coefficients():
    one = [record(seed=seed, x0=[0.1 * seed, 0, 0, 0]) for seed in range(4)]
    single = refine(chain(), one[0], [SPRING])
    joint = refine(chain(), one, [SPRING])
    assert joint.initial_states.shape == (4, 4)
    row = joint.parameters[0]
    assert abs(row.coefficient + 5) < 3.5 * row.std
    np.testing.assert_allclose(row.std, single.parameters[0].std / 2, rtol=0.25)


def test_known_noise_gives_the_same_estimate_and_its_own_error_bar():
    data = record()
    level = 0.01 * data.outputs.std()
    plain = refine(chain(), data, [SPRING])
    known = refine(chain(), data, [SPRING], noise=level)
    np.testing.assert_allclose(known.theta, plain.theta, rtol=1e-5, atol=1e-8)
    np.testing.assert_allclose(known.parameters[0].std, plain.parameters[0].std, rtol=0.02)


def test_offset_is_estimated_or_not():
    data = record(offset=0.3)
    with_offset = refine(chain(), data, [SPRING])
    row = with_offset.parameter("output_offset")
    assert row.role == "offset"
    assert abs(row.value - 0.3) < 4 * row.std
    assert refine(chain(), data, [SPRING], offset=False).fit[0] < with_offset.fit[0] - 1


def test_horizon_cuts_into_windows_and_integrators_do_by_themselves():
    data = record()
    result = refine(chain(), data, [SPRING], horizon=4.0)
    assert result.initial_states.shape == (10, 4)  # 800 samples of 0.05 s
    assert abs(result.parameters[0].coefficient + 5) < 4 * result.parameters[0].std
    cart = ct.ss([[0, 1], [0, -0.5]], [[0], [1]], [[1, 0]], 0, inputs="f", outputs="q", states=["q", "v"])
    heavier = ct.ss([[0, 1], [0, -0.4]], [[0], [1]], [[1, 0]], 0)
    result = refine(cart, record(system=heavier), [Effect("damping", "q")])
    assert result.initial_states.shape == (10, 2)
    assert "windows" in result.message
    assert abs(result.parameters[0].coefficient + 0.1) < 4 * result.parameters[0].std


def test_same_estimate_for_every_hold_that_made_the_record():
    times = np.arange(N) * STEP
    w = np.random.default_rng(5).standard_normal(N)
    response = ct.forced_response(spring_lost(), times, w)  # linear between the samples
    result = refine(chain(), Measurement(w, response.outputs, dt=STEP, hold="foh"), [SPRING])
    np.testing.assert_allclose(result.theta[0], -5.0, rtol=1e-6)
    tone = lambda t: np.sin(2.1 * t) + np.sin(5.3 * t + 1) + np.sin(9.7 * t + 2)  # noqa: E731
    fine = np.arange(40 * N) * STEP / 40
    smooth = ct.forced_response(spring_lost(), fine, tone(fine))
    data = Measurement(tone(times), smooth.outputs[::40], dt=STEP, hold="bandlimited")
    np.testing.assert_allclose(
        refine(chain(), data, [SPRING]).theta[0], -5.0, rtol=5e-3
    )  # ends of the record


def test_silent_output_does_no_harm():
    """A sensor that reads zero throughout has no noise level; nothing overflows."""
    model = ct.ss(
        chain().A, chain().B, np.vstack([chain().C, np.zeros((1, 4))]), 0,
        inputs="f", outputs=["v1", "dead"], states=["x1", "x2", "v1", "v2"],
    )  # fmt: skip
    data = record()
    both = Measurement(data.inputs, np.vstack([data.outputs, np.zeros((1, N))]), dt=STEP)
    result = refine(model, both, [SPRING])
    assert abs(result.parameters[0].coefficient + 5) < 3.5 * result.parameters[0].std
    assert np.isfinite(result.covariance[0, 0])
    assert np.isnan(result.fit[1])  # nothing to explain


# --------------------------------------------------------------------------- laws
@functools.cache
def cubic_record(coefficient=40.0, seed=2, n=1000):
    model, times = chain(), np.arange(n) * STEP
    rng = np.random.default_rng(seed)
    w = 10 * rng.standard_normal(n)
    A, B, act = np.asarray(model.A), np.asarray(model.B)[:, 0], np.array([0, 0, -1.0, 1 / 0.7])

    def rhs(t, x):
        return A @ x + B * np.interp(t, times, w) + act * coefficient * (x[0] - x[1]) ** 3

    x = solve_ivp(rhs, (0, times[-1]), np.zeros(4), t_eval=times, rtol=1e-8, atol=1e-10, max_step=STEP).y
    y = np.asarray(model.C) @ x
    return Measurement(w, y + 0.01 * y.std() * rng.standard_normal(y.shape), dt=STEP, hold="foh")


def cube(d, v):
    return d**3


def cube_and_drag(d, v, hardening, drag):
    return hardening * d**3 + drag * v


@pytest.mark.slow
def test_custom_laws_are_estimated():
    data = cubic_record(n=300)
    built_in = refine(chain(), data, [Effect("cubic_stiffness", "x1-x2")], substeps=4)
    own = refine(chain(), data, [Effect("custom", "x1-x2", law=cube)], substeps=4)
    np.testing.assert_allclose(own.theta[0], built_in.theta[0], rtol=1e-4)
    np.testing.assert_allclose(own.parameters[0].std, built_in.parameters[0].std, rtol=1e-2)
    law = Effect("custom", "x1-x2", law=cube_and_drag, start={"hardening": 10.0, "drag": 0.0})
    both = refine(chain(), data, [law], substeps=4)
    hardening, drag = both.parameters[:2]
    assert (hardening.name, drag.name) == ("hardening", "drag")
    assert abs(hardening.value - 40) < 4 * hardening.std
    assert abs(drag.value) < 4 * drag.std
    assert pickle.loads(pickle.dumps(both)).theta[0] == both.theta[0]


def test_coefficients_partly_fixed():
    data = cubic_record()
    held = Effect("asymmetric_damping", "x1", fixed={"damping_plus": 0.0})
    result = refine(chain(), data, [Effect("cubic_stiffness", "x1-x2"), held])
    assert [row.name for row in result.parameters[:2]] == ["cubic_stiffness", "damping_minus"]
    assert abs(result.parameters[0].value - 40) < 4 * result.parameters[0].std
    assert abs(result.parameters[1].value) < 4 * result.parameters[1].std
    gap = Effect("clearance", "x1", fixed={"gap": 0.2})
    assert [row.name for row in refine(chain(), data, [gap]).parameters if row.role == "effect"] == [
        "stiffness"
    ]


def test_width_of_a_friction_force_is_the_users():
    wide = Effect("coulomb_friction", "x1", fixed={"width": 0.07})
    data = record(n=300)
    result = refine(chain(), data, [wide])
    assert list(result.constants.values()) == [0.07]
    by_default = refine(chain(), data, [Effect("coulomb_friction", "x1")])
    assert 0 < by_default.constants[0] < 0.07


# ------------------------------------------------------------------- the result as a model
def test_refinement_is_a_model():
    data = cubic_record()
    linear = refine(chain(), data, [SPRING])
    both = refine(linear, data, [Effect("cubic_stiffness", "x1-x2")])
    assert [(e.kind, e.place) for e in both.effects if e.kind.endswith("stiffness")] == [
        ("stiffness", "x1-x2"),
        ("cubic_stiffness", "x1-x2"),
    ]
    assert (
        abs(both.parameter("stiffness", "x1-x2").coefficient) < 4 * both.parameter("stiffness", "x1-x2").std
    )
    at_once = refine(chain(), data, [SPRING, Effect("cubic_stiffness", "x1-x2")])
    for kind in ("stiffness", "cubic_stiffness"):
        one, other = both.parameter(kind, "x1-x2"), at_once.parameter(kind, "x1-x2")
        assert abs(one.coefficient - other.coefficient) < 0.1 * one.std
    comparison = rco.compare([chain(), linear, both], data)
    fit = comparison.fit[:, 0]
    assert fit[0] < fit[1] < fit[2]
    np.testing.assert_allclose(fit[2], both.fit[0], atol=0.01)
    again = rco.simulate(both, data)
    np.testing.assert_allclose(both.simulate(data).outputs, again.outputs)


def test_pickle_and_copy():
    data = record()
    result = refine(chain(), data, [SPRING, Effect("coulomb_friction", "x1")])
    for twin in (pickle.loads(pickle.dumps(result)), copy.deepcopy(result)):
        np.testing.assert_array_equal(twin.theta, result.theta)
        np.testing.assert_array_equal(rco.simulate(twin, data).outputs, rco.simulate(result, data).outputs)
        assert str(twin) == str(result)


def test_tables_and_pictures():
    data = record()
    result = refine(chain(), data, [SPRING])
    text = str(result)
    assert all(len(line) <= 80 for line in text.splitlines())
    assert "std is the standard deviation" in text
    assert "stiffness" in result._repr_html_()
    assert result.bode_plot().axes.shape == (2, 1)
    assert result.bode_plot(data, title="springs").axes.shape == (3, 1)
    low, high = result.parameters[0].interval
    assert low < result.parameters[0].value < high
    with pytest.raises(ModelError, match="parameters match"):
        result.parameter("nothing")
    with pytest.raises(AttributeError):
        result.theta = 0
    response = result.simulate(data)
    assert isinstance(response, ct.TimeResponseData)


# ---------------------------------------------------------------- what the data cannot see
def test_warning_names_the_combination():
    """Gains of actuator and sensor: only their product is seen, and the spring all the same."""
    mass = rco.mechanical([[1.0]], [[0.3]], [[50.0]])
    place = next(q.place for q in mass.parameters if q.kind == "stiffness")
    softer = ct.ss([[0, 1], [-45, -0.3]], [[0], [1]], mass.system.C, 0)
    w = np.random.default_rng(0).standard_normal((1, 600))
    y = held_response(softer, w, STEP)
    y = y + 0.01 * y.std() * np.random.default_rng(1).standard_normal(y.shape)
    linear = mass.linear
    effects = [
        Effect("stiffness", place),
        Effect("input_gain", linear.input_labels[0]),
        Effect("output_gain", linear.output_labels[0]),
    ]
    with pytest.warns(IdentifiabilityWarning, match=r"input_gain.*output_gain|output_gain.*input_gain"):
        result = refine(mass, Measurement(w, y, dt=STEP), effects)
    row = result.parameter("stiffness", place)
    assert abs(row.coefficient + 5) < 4 * row.std  # what is seen is estimated all the same
    assert np.isinf(result.parameter("input_gain").std)
    assert result.warnings
    assert any("input_gain" in line for line in str(result).replace("\n", " ").split("."))


def test_warning_where_an_effect_is_not_seen_at_all():
    A = [[0, 1, 0, 0], [-9, -0.3, 0, 0], [0, 0, 0, 1], [0, 0, -4, -0.2]]
    two = ct.ss(
        A, [[0], [1], [0], [0]], [[1, 0, 0, 0]], 0, inputs="f", outputs="y", states=["a", "va", "b", "vb"]
    )
    data = record(system=ct.ss(two.A, two.B, two.C, 0))
    with pytest.warns(IdentifiabilityWarning, match="no information about stiffness at b"):
        refine(two, data, [Effect("stiffness", "b")])


def test_a_state_that_nobody_sees_makes_no_parameter_unseen():
    """Velocity of a cart: the position is lost, the friction is not."""
    cart = ct.ss([[0, 1], [0, -2.0]], [[0], [1]], [[0, 1]], 0, inputs="f", outputs="v", states=["x", "v"])
    data = record(system=ct.ss([[0, 1], [0, -1.5]], [[0], [1]], [[0, 1]], 0))
    with warnings.catch_warnings():
        warnings.simplefilter("error", IdentifiabilityWarning)
        result = refine(cart, data, [Effect("damping", "x"), Effect("quadratic_damping", "x")], offset=False)
    assert abs(result.parameters[0].value - 1.5) < 4 * result.parameters[0].std
    assert result.warnings == ()


def test_no_warning_where_everything_is_seen():
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert refine(chain(), record(), [SPRING]).warnings == ()


# ------------------------------------------------------------------------------ bad input
@pytest.mark.parametrize(
    ("arguments", "options", "error", "match"),
    [
        (([SPRING, SPRING],), {}, ModelError, "named twice"),
        (([Effect("stiffness", "x9")],), {}, ModelError, "x9"),
        (([Effect("input_gain", "nowhere")],), {}, ModelError, "nowhere"),
        ((["stiffness"],), {}, ct.ControlArgument, "Effect objects"),
        (((),), {"free": "everything"}, ct.ControlArgument, "'linear' or a list"),
        (((),), {"free": ["k99"]}, ct.ControlArgument, "k99"),
        (((),), {"free": [3.0]}, ct.ControlArgument, "3.0"),
        (((),), {"free": 3.0}, ct.ControlArgument, "list of names or effects"),
        (((),), {"tolerance": -0.1}, ct.ControlArgument, "not be negative"),
        (((),), {"tolerance": np.nan}, ct.ControlArgument, "finite"),
        (((),), {"tolerance": "2 %"}, ct.ControlArgument, "number"),
        (((),), {"noise": np.nan}, ct.ControlArgument, "positive"),
        (((),), {"noise": -1.0}, ct.ControlArgument, "positive"),
        (((),), {"noise": "loud"}, ct.ControlArgument, "standard deviations"),
        (((),), {"noise": [0.1, 0.1]}, ct.ControlDimension, "one for each"),
        (((),), {"x0": "rest"}, ct.ControlArgument, "x0 must be"),
        (((),), {"x0": np.zeros(7)}, ct.ControlDimension, "4 states"),
        (((),), {"x0": [np.nan, 0, 0, 0]}, DataError, "finite"),
        (((),), {"x0": "zero", "horizon": 2.0}, ct.ControlArgument, "leave horizon or x0 out"),
        (((),), {"horizon": -1.0}, ct.ControlArgument, "positive"),
        (((),), {"horizon": "1 s"}, ct.ControlArgument, "time in seconds"),
        (((),), {"substeps": 0}, ct.ControlArgument, "at least 1"),
        (((),), {"substeps": 2.5}, ct.ControlArgument, "whole number"),
    ],
)  # fmt: skip
def test_bad_argument_is_named(arguments, options, error, match):
    with pytest.raises(error, match=match):
        refine(chain(), record(n=60), *arguments, **options)


def test_bad_data_is_named():
    data = record(n=60)
    with pytest.raises(TypeError, match="no_such_keyword"):
        refine(chain(), data, no_such_keyword=1)
    with pytest.raises(ct.ControlArgument, match="Measurement"):
        refine(chain(), data.outputs)
    with pytest.raises(DataError, match="empty"):
        refine(chain(), [])
    with pytest.raises(DataError, match="longer record"):
        refine(chain(), record(n=5), [SPRING])
    with pytest.raises((ct.ControlDimension, DataError), match="input"):
        refine(chain(), Measurement(np.ones((2, 60)), data.outputs, dt=STEP), [SPRING])
    with pytest.raises((ct.ControlArgument, ModelError), match="StateSpace"):
        refine("a model", data)


def test_a_noise_model_with_a_pole_outside_becomes_stable_with_the_same_spectrum():
    a = np.real(np.poly([1.2, 0.5 + 0.9j, 0.5 - 0.9j, 0.3]))
    stable, variance = stable_model(a, 2.0)
    assert np.abs(np.roots(stable)).max() < 1
    omega, before = freqz([1.0], a)
    _, after = freqz([1.0], stable, worN=omega)
    np.testing.assert_allclose(variance * np.abs(after) ** 2, 2.0 * np.abs(before) ** 2, rtol=1e-10)


def test_forces_that_overflow_are_no_warning():
    """From a start that no record can mean; as plain Python the loop is as silent about it as compiled."""
    one = rco.mass_spring_damper([1.3], [0.6], [70.0], sensors="displacement")
    rng = np.random.default_rng(31)
    w = rng.standard_normal(300)
    y = held_response(one.system, w, STEP)
    data = Measurement(w, y + 0.01 * y.std() * rng.standard_normal(y.shape), dt=STEP)
    far = Effect("cubic_stiffness", "link1", start={"cubic_stiffness": -1e100})
    with pytest.warns(IdentifiabilityWarning):
        assert not refine(one, data, [far]).success


def test_a_fit_that_is_no_number_is_told(rng):
    """A constant output has no fit; an initial model that diverges has none."""
    model = rco.mass_spring_damper([1.0, 0.5], [0.4, 0.2], [100.0, 80.0], sensors="displacement")
    force = rng.standard_normal(300)
    y = rco.simulate(model, rco.Measurement(force, np.zeros((2, 300)), dt=0.02), "zero").outputs
    y[1] = 0.0
    found = rco.refine(model, rco.Measurement(force, y, dt=0.02), [])
    assert "% / - (constant) of the record" in " ".join(str(found).split())
    diverged = replace(found, fit=np.array([90.0, 80.0]), initial_fit=np.array([np.nan, 70.0]))
    assert "explains 90 % / 80 % of the record (initial model diverges / 70 %)" in " ".join(
        str(diverged).split()
    )
