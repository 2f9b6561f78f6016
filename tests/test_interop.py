"""What comes out goes on in python-control: names, timebase, plots, pickle."""

from __future__ import annotations

import copy
import pickle

import control as ct
import numpy as np
import pytest

import rcorefine as rco

N_SAMPLES = 1500


@pytest.fixture(scope="module")
def example():
    return rco.examples.rlc()


@pytest.fixture(scope="module")
def data(example):
    return example.record(N_SAMPLES, noise=0.01, rng=3)


def refiner_for(example, data, model=None):
    model = example.initial if model is None else model
    return rco.RCORefiner.paper(model, dt=example.dt, **example.settings).run(data)


@pytest.fixture(scope="module")
def refiner(example, data):
    return refiner_for(example, data)


@pytest.fixture(scope="module")
def better(refiner):
    return refiner.system


@pytest.fixture(scope="module")
def comparison(example, data, better):
    return rco.compare([example.initial, better], data)


# names and timebase


@pytest.mark.parametrize("sampled", [False, True])
def test_timebase_and_names_are_those_of_the_model(example, data, better, sampled):
    initial = example.initial.sample(example.dt, name="sampled") if sampled else example.initial
    found = refiner_for(example, data, initial).system if sampled else better
    assert isinstance(found, ct.StateSpace)
    assert found.dt == (example.dt if sampled else 0)
    for side in ("input", "output", "state"):
        assert getattr(found, f"{side}_labels") == getattr(initial, f"{side}_labels")


@pytest.mark.parametrize("timebase", [None, True])
def test_loose_timebase_takes_over_the_record_s(example, data, timebase):
    known = example.initial.sample(example.dt)
    labels = {"inputs": known.input_labels, "outputs": known.output_labels, "states": known.state_labels}
    loose = ct.ss(known.A, known.B, known.C, known.D, timebase, **labels)
    found = refiner_for(example, data, loose).system
    reference = refiner_for(example, data, known).system
    np.testing.assert_allclose(found.A, reference.A, rtol=1e-12)
    assert found.dt == example.dt


def test_both_timebases_are_the_same_system(refiner, example):
    """`system` sampled is `discrete_system`: the inverse of the zero-order hold."""
    sampled = refiner.system.sample(example.dt)
    for key in "ABCD":
        theirs = getattr(sampled, key)
        np.testing.assert_allclose(
            theirs, getattr(refiner.discrete_system, key), atol=1e-9 * max(1.0, np.abs(theirs).max())
        )


def test_the_model_handed_over_is_not_touched(example, data):
    initial = example.initial
    before = {key: getattr(initial, key).copy() for key in "ABCD"}
    refiner_for(example, data, initial)
    rco.compare(initial, data)
    for key, value in before.items():
        np.testing.assert_array_equal(getattr(initial, key), value)


def test_a_refined_system_shares_no_memory(refiner):
    first = refiner.system
    first.A[:] = np.nan
    assert np.isfinite(refiner.system.A).all()


# through python-control


def test_plots(example, better):
    assert isinstance(ct.bode_plot([example.initial, better], omega=np.logspace(1, 4, 50)), ct.ControlPlot)
    assert isinstance(ct.nyquist_plot(better), ct.ControlPlot)


def test_feedback_agrees_with_the_closed_form(better):
    loop = ct.feedback(better, 2.0)
    for omega in (10.0, 500.0, 3000.0):
        plant = better(1j * omega)
        assert loop(1j * omega) == pytest.approx(plant / (1 + 2.0 * plant), rel=1e-9)


def test_interconnect_keeps_signal_names(better):
    plant = better.copy(name="circuit")
    gain = ct.ss([], [], [], [[0.5]], inputs="reference", outputs="voltage", name="amplifier", dt=0)
    whole = ct.interconnect([gain, plant], inputs="reference", outputs="resistor_voltage")
    assert whole.state_labels == [f"circuit_{label}" for label in plant.state_labels]
    assert whole(100j) == pytest.approx(0.5 * better(100j), rel=1e-9)


def test_simulation_by_python_control_agrees_with_compare(example, data, better):
    """Discretized with the record's hold, forced_response and `compare` give the same output."""
    comparison = rco.compare(better, data, x0="zero")
    _, y = ct.forced_response(better.sample(example.dt), data.timepts, data.inputs[0])
    residual = data.outputs[0] - y
    expected = 100 * (1 - np.linalg.norm(residual) / np.linalg.norm(data.outputs[0] - data.outputs[0].mean()))
    fit = np.ravel(comparison.fit)[0]
    assert fit == pytest.approx(expected, abs=1e-6)


def test_measured_response_joins_a_list_of_responses(data, better):
    measured = data.frequency_response().frd
    assert isinstance(measured, ct.FrequencyResponseData)
    assert measured.dt == data.dt
    responses = ct.FrequencyResponseList([ct.frequency_response(better, measured.omega), measured])
    cplt = responses.plot(label=["refined", "measured"], wrap_phase=True)
    assert isinstance(cplt, ct.ControlPlot)


def test_d2c_of_sample_is_the_identity(example):
    system = example.true
    back = rco.d2c(system.sample(example.dt, name=system.name))
    assert back.state_labels == system.state_labels
    for omega in (1.0, 100.0, 3000.0):
        assert back(1j * omega) == pytest.approx(system(1j * omega), rel=1e-8)


def test_python_control_s_defaults_decide_nothing(example, data, refiner):
    """squeeze_time_response and default_dt are the user's: our results do not depend on them."""
    with ct.defaults({"control.squeeze_time_response": False, "control.default_dt": None}):
        other = refiner_for(example, data)
        fit = rco.compare(other.system, data).fit
    np.testing.assert_array_equal(other.system.A, refiner.system.A)
    np.testing.assert_array_equal(np.ravel(fit), np.ravel(rco.compare(refiner.system, data).fit))


# copies


@pytest.mark.parametrize(
    "duplicate", [lambda x: pickle.loads(pickle.dumps(x)), copy.deepcopy], ids=["pickle", "deepcopy"]
)
class TestCopies:
    def test_comparison(self, comparison, duplicate):
        other = duplicate(comparison)
        np.testing.assert_array_equal(np.ravel(other.fit), np.ravel(comparison.fit))
        assert str(other) == str(comparison)
        assert isinstance(other.plot(), ct.ControlPlot)

    def test_measured_response(self, data, duplicate):
        response = data.frequency_response()
        other = duplicate(response)
        np.testing.assert_array_equal(other.coherence, response.coherence)
        np.testing.assert_array_equal(other.frd.frdata, response.frd.frdata)

    def test_refiner_goes_on_where_it_was(self, example, data, duplicate):
        """A copy in mid-stream and the original end at the same estimate."""
        first, second = data.split(0.5)
        original = rco.RCORefiner.paper(example.initial, dt=example.dt, **example.settings)
        original.update(first.inputs, first.outputs)
        other = duplicate(original)
        for one in (original, other):
            one.update(second.inputs, second.outputs)
        np.testing.assert_array_equal(other.system.A, original.system.A)
        np.testing.assert_array_equal(other.system.B, original.system.B)

    def test_physical_model(self, example, duplicate):
        model = rco.PhysicalModel.from_statespace(example.initial)
        other = duplicate(model)
        np.testing.assert_array_equal(other.system.A, model.system.A)
        assert [port.name for port in other.ports] == [port.name for port in model.ports]


def test_shallow_copy_of_a_result(comparison):
    assert str(copy.copy(comparison)) == str(comparison)
