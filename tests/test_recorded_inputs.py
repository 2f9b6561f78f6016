"""Inputs of the record that the model lacks."""

import control as ct
import numpy as np
import pytest

import rcorefine as rco


def recorded(A, B, C, rng, inputs, states, dt=0.05, n=1200):
    """A record of the true system, with all of its inputs."""
    w = 0.1 * np.cumsum(rng.standard_normal((len(inputs), n)), axis=1)
    w -= w.mean(axis=1, keepdims=True)
    y = ct.forced_response(ct.sample_system(ct.ss(A, B, C, 0), dt), U=w).outputs
    y = np.atleast_2d(y)
    y = y + 0.02 * y.std() * rng.standard_normal(y.shape)
    return rco.Measurement(w, y, dt=dt, input_labels=inputs, output_labels="y")


def test_a_force_that_the_model_lacks_is_found_on_the_mass(rng):
    A = [[0, 1], [-25, -0.4]]
    data = recorded(A, [[0, 0], [1, 0.6]], [[1, 0]], rng, ["force", "wind"], ["x", "v"])
    model = ct.ss(A, [[0], [1]], [[1, 0]], 0, inputs="force", outputs="y", states=["x", "v"])
    found = rco.diagnose(model, data)
    assert (found.verdict, [e.place for e in found.effects]) == ("effect", ["B[1,1]"])
    (value,), (std,) = found.best.coefficients.values(), found.best.std.values()
    assert abs(value - 0.6) < 4 * std
    assert any("wind (column 1 of B)" in note for note in found.notes)
    better = found.refine()
    assert better.system.input_labels == ["force", "wind"]
    assert better.system.B[1, 1] == pytest.approx(0.6, abs=0.01)
    assert rco.compare(better, data).fit[0] > 97.0


def test_heat_that_the_model_lacks_is_found_at_its_store(rng):
    A, B = [[-0.6, 0.2], [0.3, -0.5]], [[1.0, 0.4], [0.0, 0.0]]
    data = recorded(A, B, [[0, 1]], rng, ["heater", "sun"], ["air", "wall"])
    model = ct.ss(A, [[1.0], [0.0]], [[0, 1]], 0, inputs="heater", outputs="y", states=["air", "wall"])
    steps = rco.improve(model, data)
    assert [e.place for e in steps.effects] == ["B[0,1]"]
    assert steps.verdict == "adequate"
    assert any("sun" in note for note in steps.notes)


def test_an_input_that_does_nothing_is_not_blamed(rng):
    A = [[0, 1], [-25, -0.4]]
    data = recorded(A, [[0, 0], [1, 0]], [[1, 0]], rng, ["force", "wind"], ["x", "v"])
    model = ct.ss(A, [[0], [1]], [[1, 0]], 0, inputs="force", outputs="y", states=["x", "v"])
    assert rco.diagnose(model, data).verdict == "adequate"
