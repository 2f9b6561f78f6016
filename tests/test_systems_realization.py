"""A transfer function as the initial model: same response, physical states where it has them."""

import re

import control as ct
import numpy as np
import pytest

import rcorefine as rco
from rcorefine.systems.linear import realized

OMEGA = np.geomspace(0.01, 100, 40)


@pytest.mark.parametrize(
    ("num", "den", "states"),
    [
        ([5], [1, 2], ["y"]),
        ([6], [1, 0.4, 9], ["y", "y_rate"]),
        ([-3], [2, 0, 0], ["y", "y_rate"]),
        ([1, 5], [1, 2, 3], ["x[0]", "x[1]"]),
        ([1, 5, 7], [1, 2, 3], ["x[0]", "x[1]"]),
        ([4], [1, 2, 3, 4], ["x[0]", "x[1]", "x[2]"]),
    ],
)
def test_response_and_states(num, den, states):
    transfer = ct.tf(num, den, inputs="u", outputs="y", name="plant")
    said = re.escape(f"the states {', '.join(states)}")
    with pytest.warns(rco.ConversionWarning, match=said):
        system = realized(transfer)
    assert system.state_labels == states
    assert (system.name, system.input_labels, system.output_labels) == ("plant", ["u"], ["y"])
    np.testing.assert_allclose(system(1j * OMEGA), transfer(1j * OMEGA), rtol=1e-9)


def test_the_rate_is_that_of_the_output():
    with pytest.warns(rco.ConversionWarning):
        system = realized(ct.tf([6], [1, 0.4, 9], outputs="y"))
    np.testing.assert_allclose(system.A, [[0, 1], [-9, -0.4]], atol=1e-12)
    np.testing.assert_allclose(system.B, [[0], [6]], atol=1e-12)


def test_sampled_ones_keep_their_time_step():
    with pytest.warns(rco.ConversionWarning):
        assert realized(ct.tf([1], [1, -0.5], 0.1)).dt == 0.1


def test_what_has_no_state_space():
    with pytest.raises(rco.ModelError, match=r"non-proper.*give a control\.StateSpace"):
        realized(ct.tf([1, 2, 3], [1, 2], name="pd"))


def test_an_effect_is_found_at_the_output():
    arm = ct.tf([6.0], [1.0, 0.4, 9.0], inputs="u", outputs="x")
    w = np.random.default_rng(0).standard_normal(1500)
    y = ct.forced_response(ct.tf([6.0], [1.0, 0.4, 8.0]).sample(0.05), np.arange(1500) * 0.05, w).outputs
    y = y + 0.02 * y.std() * np.random.default_rng(1).standard_normal(1500)
    data = rco.Measurement(w, y, dt=0.05, input_labels="u", output_labels="x")
    with pytest.warns(rco.ConversionWarning):
        found = rco.refine(arm, data, [rco.Effect("stiffness", "x")])
    # x'' + .4 x' + 9 x = 6 u is a mass of 1/6 in the input's unit: its spring goes from 9/6 to 8/6
    change = found.parameters[0]
    assert change.coefficient == pytest.approx(-1 / 6, abs=4 * change.std)


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize(
    "num, den",
    [([1e-16, 5e-16], [1, 2, 1, 3]), ([1e-20, 1.0], [1, 2, 1]), ([2, 0, 1], [1, 1, 1]), ([3], [2])],
)
def test_no_coefficient_is_lost(num, den):
    transfer = ct.tf(num, den)
    with pytest.warns(rco.ConversionWarning):
        system = realized(transfer)
    at = 1j * np.array([0.1, 3.0])
    np.testing.assert_allclose(system(at), transfer(at), rtol=1e-9)
    assert system.nstates == len(den) - 1


@pytest.mark.parametrize("question", [rco.compare, rco.check, rco.refine, rco.diagnose, rco.improve])
def test_its_states_are_told_once_a_call(question):
    transfer = ct.tf([2, 3], [1, 0.8, 9], inputs="u", outputs="y")
    w = np.random.default_rng(0).standard_normal(300)
    y = ct.forced_response(transfer.sample(0.05), np.arange(300) * 0.05, w).outputs
    y += 0.02 * y.std() * np.random.default_rng(1).standard_normal(300)
    more = {"free": "linear"} if question is rco.refine else {}
    with pytest.warns(rco.ConversionWarning) as said:
        question(transfer, rco.Measurement(w, y, dt=0.05), **more)
    assert [one.category for one in said] == [rco.ConversionWarning]
