"""Static curves of inputs and outputs: a table that is given, and one that is found."""

import pickle

import control as ct
import numpy as np
import pytest

import rcorefine as rco

KNOTS = np.linspace(-6.0, 6.0, 121)


def curve(x):
    """An actuator that saturates softly."""
    return x / (1.0 + np.abs(x) / 4.0)


def record(at_output, seed=1, noise=0.01, n=2000, dt=0.05):
    """A first-order lag, exact between samples, whose input or output is bent."""
    rng = np.random.default_rng(seed)
    u = np.repeat(rng.uniform(-5, 5, n // 8), 8)
    driven = u if at_output else curve(u)
    keep, y = np.exp(-2.0 * dt), np.zeros(n)
    for k in range(1, n):
        y[k] = keep * y[k - 1] + 1.5 * (1 - keep) * driven[k - 1]
    y = curve(y) if at_output else y
    y = y + noise * y.std() * rng.standard_normal(n)
    return rco.Measurement(u, y, dt=dt, input_labels="u", output_labels="y")


def model():
    return ct.ss([[-2.0]], [[3.0]], [[1.0]], 0, inputs="u", outputs="y", states="v")


@pytest.mark.parametrize(("kind", "place"), [("input_curve", "u"), ("output_curve", "y")])
def test_a_measured_curve_explains_the_record(kind, place):
    effect = rco.Effect(kind, place, law=rco.Table(KNOTS, force=curve(KNOTS)))
    assert pickle.loads(pickle.dumps(effect)) == effect
    better = rco.refine(model(), record(place == "y"), [effect])
    row = better.parameter("scale")
    assert abs(row.value - 1.0) < 4 * row.std
    assert row.std < 0.01
    assert rco.diagnose(better, record(place == "y", seed=2)).verdict == "adequate"
    short = effect.replace(law=rco.Table([-1.0, 1.0], force=[-0.5, 0.5]))
    data = record(place == "y")
    assert "leaves the table" in " ".join(str(rco.compare(rco.refine(model(), data, [short]), data)).split())
    exact = rco.refine(model(), record(place == "y", noise=0.0), [effect.replace(fixed={"scale": 1.0})])
    assert exact.rmse[0] < 1e-3  # of the chords between the knots


@pytest.mark.parametrize("place", ["u", "y"])
def test_an_unknown_curve_is_tabulated(place):
    """No candidate bends like this: the verdict names the channel, and law() holds its curve."""
    data = record(place == "y")
    places = {"input_gain": "u", "input_deadzone": "u", "coulomb_friction": "v"}  # none acts on the sensor
    found = rco.diagnose(model(), data, candidates=[rco.Effect(k, p) for k, p in places.items()])
    assert (found.verdict, found.place) == ("unexplained", place)
    law = found.law()
    assert law.kind == {"u": "input_curve", "y": "output_curve"}[place]
    x = np.array([-3.0, -2.0, -1.0, 1.0, 2.0, 3.0]) * (1.0 if place == "u" else 0.8)
    assert np.abs(law.law(x, 0.0 * x) / curve(x) - 1.0).max() < 0.05
    assert rco.refine(model(), data, [law]).fit[0] > 97.0
    assert f"the unknown curve of {place} " in " ".join(str(found).split())
    found.plot()


@pytest.mark.parametrize("law", [3.0, rco.Table(v=[0.0, 1.0], force=[0.0, 1.0])])
def test_what_is_no_curve_is_refused(law):
    with pytest.raises(ct.ControlArgument, match="input_curve .* needs .*Table"):
        rco.Effect("input_curve", "u", law=law)
