"""The paper's examples: parameters, interpretation (the Bode errors pin it), records."""

import pickle

import control as ct
import numpy as np
import pytest
from inner import LinearModel, bode_error, to_discrete

import rcorefine as rco
from rcorefine import examples

ALL = [examples.rlc, examples.one_dof, examples.two_dof]


def sampled(model, dt):
    return to_discrete(LinearModel.from_statespace(model), dt)


@pytest.mark.parametrize("form", ["given", "observable"])
@pytest.mark.parametrize(
    "make, dt, figure",
    [(examples.one_dof, 0.01, 0.605), (examples.two_dof, 0.001, 0.742), (examples.two_dof, 0.005, 0.735)],
)
def test_initial_bode_error_is_that_of_the_design(make, dt, figure, form):
    example = make(form=form, dt=dt)
    assert bode_error(sampled(example.true, dt), sampled(example.initial, dt)) == pytest.approx(
        figure, abs=5e-4
    )


@pytest.mark.parametrize("make", ALL)
def test_forms_have_the_same_transfer_function(make):
    given, observable = make(), make(form="observable")
    s = 1j * np.geomspace(0.1, 1e4, 20)
    for which in ("initial", "true"):
        np.testing.assert_allclose(getattr(given, which)(s), getattr(observable, which)(s), rtol=1e-8)
    np.testing.assert_array_equal(observable.true.C, np.eye(1, observable.true.nstates))


@pytest.mark.parametrize("form", ["given", "observable"])
def test_rlc_parameters_can_be_read_back(form):
    example = examples.rlc(form=form)
    for which in ("initial", "true"):
        found = examples.rlc_parameters(getattr(example, which))
        assert found == pytest.approx(getattr(example, f"{which}_parameters"), rel=1e-12)


def test_rlc_is_a_band_pass_with_gain_one_at_resonance():
    omega = 1 / np.sqrt(55e-3 * 23.5e-6)
    assert abs(examples.rlc().true(1j * omega)) == pytest.approx(1.0, rel=1e-12)


def test_one_dof_is_the_transmissibility_in_closed_form():
    # (C s + K) / (M s^2 + C s + K), 6.9 is any frequency.
    s = 6.9j
    for which in ("initial", "true"):
        p = getattr(examples.one_dof(), f"{which}_parameters")
        m, k, c = p["mass"], p["stiffness"], p["damping"]
        value = getattr(examples.one_dof(), which)(s)
        assert value == pytest.approx((c * s + k) / (m * s**2 + c * s + k), rel=1e-12)


def test_two_dof_statics_and_high_frequency():
    example = examples.two_dof()
    p = example.true_parameters
    assert (p["k2"], p["k3"]) == (1500.0, 2000.0)
    # Statically, q1 = f / (k1 + k2 k3 / (k2 + k3)); far above resonance v1 = f / (m1 s); 1 in is 1000 N.
    position = ct.ss(example.true.A, example.true.B, [[1, 0, 0, 0]], 0)
    expected = 1000 / (p["k1"] + p["k2"] * p["k3"] / (p["k2"] + p["k3"]))
    assert position(0).real == pytest.approx(expected, rel=1e-12)
    assert example.true(1e7j) == pytest.approx(1000 / (p["m1"] * 1e7j), rel=1e-4)


def test_settings_are_the_papers():
    keys = ("order", "window", "markov", "learning_rate", "static_learning_rate")
    expected = {
        "rlc": (5, 100, 1, 100, 1),
        "one_dof": (30, 100, 1, 1000, 1000),
        "two_dof": (5, 100, 1, 100, 1000),
    }
    for make in ALL:
        settings = dict(make().settings)
        assert settings.pop("static_average", 1) == 1  # the paper reads off the last coefficients
        assert settings == dict(zip(keys, expected[make.__name__], strict=True))
    assert [make().dt for make in ALL] == [1e-4, 1e-2, 1e-3]


def test_record_is_the_held_input_through_the_true_model():
    example = examples.two_dof()
    data = example.record(n_samples=500, rng=3)
    discrete = example.true.sample(example.dt)
    response = ct.forced_response(discrete, data.timepts, data.inputs)
    np.testing.assert_allclose(data.outputs[0], response.y[0], rtol=1e-9, atol=1e-12)
    assert (data.hold, data.dt, data.input_labels, data.output_labels) == ("zoh", 1e-3, ("force",), ("v1",))
    assert data.input_units == ("kN",)
    simulated = example.simulate(data.inputs)
    np.testing.assert_array_equal(simulated.y[0], data.outputs[0])
    np.testing.assert_array_equal(simulated.x[2], data.outputs[0])
    initial = example.simulate(data.inputs[0], model="initial")
    np.testing.assert_allclose(
        initial.y[0],
        ct.forced_response(example.initial.sample(1e-3), data.timepts, data.inputs).y[0],
        atol=1e-12,
    )


def test_noise_is_relative_to_the_output_and_leaves_the_input():
    example = examples.rlc()
    clean = example.record(n_samples=20000, rng=np.random.default_rng(5))
    noisy = example.record(n_samples=20000, rng=np.random.default_rng(5), noise=0.1)
    np.testing.assert_array_equal(noisy.inputs, clean.inputs)
    ratio = np.std(noisy.outputs - clean.outputs) / np.std(clean.outputs)
    assert ratio == pytest.approx(0.1, abs=4 * 0.1 / np.sqrt(2 * 20000))
    # White Gaussian: mean and correlation within 4 standard errors.
    w = clean.inputs[0]
    assert abs(w.mean()) < 4 / np.sqrt(w.size)
    assert abs(w[1:] @ w[:-1] / (w @ w)) < 4 / np.sqrt(w.size)


def test_record_is_reproducible_and_scales():
    example = examples.one_dof()
    np.testing.assert_array_equal(example.record(50).outputs, example.record(50).outputs)
    np.testing.assert_allclose(
        example.record(50, amplitude=3.0).outputs, 3 * example.record(50).outputs, rtol=1e-12
    )
    assert not np.array_equal(example.record(50, rng=1).inputs, example.record(50, rng=2).inputs)


@pytest.mark.parametrize("make", ALL)
def test_examples_pickle_and_print(make):
    example = make(form="observable")
    again = pickle.loads(pickle.dumps(example))
    np.testing.assert_array_equal(again.true.A, example.true.A)
    text = str(example)
    assert example.name in text
    assert max(map(len, text.splitlines())) <= 90
    for key in example.true_parameters:
        assert key in text


def test_bad_arguments_are_named():
    with pytest.raises(ct.ControlArgument, match="'canonical'"):
        examples.rlc(form="canonical")
    with pytest.raises(rco.ModelError, match="positive"):
        examples.two_dof(dt=0)
    with pytest.raises(rco.DataError, match="n_samples"):
        examples.rlc().record(1)
    with pytest.raises(rco.DataError, match="noise"):
        examples.rlc().record(10, noise=-0.1)
    with pytest.raises(rco.DataError, match="amplitude"):
        examples.rlc().record(10, amplitude=0.0)
    with pytest.raises(ct.ControlArgument, match="'truth'"):
        examples.rlc().simulate([0.0, 1.0], model="truth")
    with pytest.raises(ct.ControlDimension, match="shape"):
        examples.rlc().simulate(np.zeros((2, 5)))
    with pytest.raises(TypeError, match="unexpected keyword"):
        examples.rlc(sampling=0.1)


def test_rlc_parameters_refuse_what_is_no_circuit():
    example = examples.rlc()
    with pytest.raises(rco.ModelError, match="not continuous"):
        examples.rlc_parameters(example.true.sample(1e-4))
    with pytest.raises(rco.ModelError, match="4 states"):
        examples.rlc_parameters(examples.two_dof().true)
    with pytest.raises(rco.ModelError, match="det A"):
        examples.rlc_parameters(ct.ss([[0, 1], [0, -1]], [[0], [1]], [[0, 1]], 0))
    with pytest.raises(rco.ModelError, match="C B"):
        examples.rlc_parameters(ct.ss([[0, 1], [-1, -1]], [[0], [1]], [[1, 0]], 0))
