"""Records without trend, filtered, renamed and joined."""

import numpy as np
import pytest

import rcorefine as rco


def record(seed=0, n=3000, dt=0.02, noise=0.02):
    model = rco.mass_spring_damper([1.0], [0.4], [100.0], sensors="displacement")
    rng = np.random.default_rng(seed)
    force = 10 * rng.standard_normal(n)
    blank = rco.Measurement(force, np.zeros(n), dt=dt, input_labels="F", output_labels="q")
    y = rco.simulate(model, blank, "zero").outputs[0]
    return rco.Measurement(
        force, y + noise * y.std() * rng.standard_normal(n), dt=dt, input_labels="F", output_labels="q"
    )


def test_a_trend_is_the_straight_line_of_least_squares():
    data = record()
    line = 3.0 - 0.1 * data.timepts
    drifting = rco.Measurement(data.inputs, data.outputs + line, dt=data.dt)
    np.testing.assert_allclose(drifting.detrend().outputs, data.detrend().outputs, atol=1e-9)
    slope = np.polyfit(data.timepts, drifting.detrend().outputs[0], 1)
    np.testing.assert_allclose(slope, 0.0, atol=1e-9)


@pytest.mark.parametrize(
    ("edges", "gains"),
    [({"high": 30.0}, (1, 1, 0)), ({"low": 3.0}, (0, 1, 1)), ({"low": 3.0, "high": 30.0}, (0, 1, 0))],
)
def test_sines_in_and_outside_the_passband(edges, gains):
    t = np.arange(6000) * 0.01
    for omega, gain in zip((0.3, 10.0, 150.0), gains, strict=True):
        data = rco.Measurement(np.sin(omega * t), np.cos(omega * t), dt=0.01).filter(**edges)
        at = data.timepts
        assert np.abs(data.outputs[0] - gain * np.cos(omega * at)).max() < 0.02
        assert np.abs(data.inputs[0] - gain * np.sin(omega * at)).max() < 0.02


def test_a_filter_of_all_signals_leaves_the_parameters_unchanged():
    model = rco.mass_spring_damper([1.0], [0.4], [80.0], sensors="displacement")
    data = record(noise=0.0).rename({"F": "force", "q": "q1"}).filter(low=2.0, high=40.0)
    better = rco.refine(model, data, free="linear")
    assert better.fit[0] > 99.9
    assert "bandpass filter of order 4" in data.notes[-1]


def test_edges_that_cannot_be():
    data = record(n=300)
    for edges in ({}, {"high": 1000.0}, {"low": 30.0, "high": 3.0}):
        with pytest.raises(rco.DataError, match="Nyquist"):
            data.filter(**edges)
    with pytest.raises(rco.DataError, match="low"):
        data.filter(low=-1.0)
    with pytest.raises(rco.DataError, match="samples"):
        data.segment(0.0, 0.1).filter(high=3.0)


def test_signals_are_renamed_and_joined():
    data, more = record(), record(seed=1).rename({"F": "wind", "q": "q2"}, name="second")
    assert (more.input_labels, more.output_labels, more.name) == (("wind",), ("q2",), "second")
    both = data.join(more)
    assert (both.input_labels, both.output_labels) == (("F", "wind"), ("q", "q2"))
    np.testing.assert_array_equal(both.inputs, np.vstack([data.inputs, more.inputs]))
    np.testing.assert_array_equal(both.outputs, np.vstack([data.outputs, more.outputs]))
    with pytest.raises(rco.DataError, match="'G'.* its signals are F, q"):
        data.rename({"G": "H"})
    with pytest.raises(rco.DataError, match="same times"):
        data.join(more.segment(1.0, None))
    with pytest.raises(rco.DataError, match="with_hold"):
        data.join(more.with_hold("foh"))
    with pytest.raises(rco.DataError, match="F"):
        data.join(record(seed=1).rename({"q": "q2"}))


def test_the_samples_that_a_filter_leaves_out_are_told():
    t = np.arange(5000) * 0.01
    data = rco.Measurement(np.sin(2 * t), np.cos(2 * t), dt=0.01).filter(low=2.0)
    cut = (5000 - data.n_samples) // 2
    assert cut > 0
    assert f"{cut} of 5000 samples left out at either end" in data.notes[-1]
    assert "left out" in str(data)
