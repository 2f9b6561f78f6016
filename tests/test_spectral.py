"""Measured frequency response: H1, coherence, and whether its standard deviation is right."""

from __future__ import annotations

import copy
import pickle

import control as ct
import numpy as np
import pytest
from scipy import signal

from rcorefine import DataError, Measurement
from rcorefine.data.welch import effective_averages

DT = 0.1


def plant(z):
    return 0.5 / (1 - 0.6 / z)


def filtered(w):
    return signal.lfilter([0.5], [1, -0.6], w)


def at(omega):
    return plant(np.exp(1j * omega * DT))


def test_equals_scipy_for_one_input():
    rng = np.random.default_rng(0)
    w = rng.standard_normal(2000)
    y = filtered(w) + 0.2 * rng.standard_normal(2000)
    got = Measurement(w, y, dt=DT).frequency_response(segment_length=256)
    f, cross = signal.csd(w, y, fs=1 / DT, nperseg=256)
    _, power = signal.welch(w, fs=1 / DT, nperseg=256)
    _, coherence = signal.coherence(w, y, fs=1 / DT, nperseg=256)
    np.testing.assert_allclose(got.omega, 2 * np.pi * f[1:-1])
    np.testing.assert_allclose(got.response[0, 0], (cross / power)[1:-1], rtol=1e-12)
    np.testing.assert_allclose(got.coherence[0], coherence[1:-1], rtol=1e-10)


def test_frd_is_named_keeps_dt_and_labels():
    w = np.random.default_rng(0).standard_normal((2, 2000))
    data = Measurement(
        w, [filtered(w[0]), w[1]], dt=DT, name="run 1", input_labels=["f", "g"], output_labels=["x", "v"]
    )
    response = data.frequency_response()
    frd = response.frd
    assert isinstance(frd, ct.FrequencyResponseData)
    assert (frd.dt, frd.name, frd.input_labels, frd.output_labels) == (DT, "run 1", ["f", "g"], ["x", "v"])
    np.testing.assert_array_equal(frd.frdata, response.response)
    assert response.std.shape == (2, 2, response.omega.size)
    assert response.coherence.shape == (
        2,
        response.omega.size,
    )
    for twin in (pickle.loads(pickle.dumps(response)), copy.deepcopy(response)):
        np.testing.assert_array_equal(twin.response, response.response)


def test_periodic_input_gives_the_exact_response():
    # whole periods, no window: the transient is gone after the first period
    rng = np.random.default_rng(1)
    period = 200
    w = np.tile(rng.standard_normal(period), 12)
    data = Measurement(w, filtered(w), dt=DT).segment(start=period * DT)
    got = data.frequency_response(segment_length=period, overlap=0, window="boxcar")
    np.testing.assert_allclose(got.response[0, 0], at(got.omega), rtol=1e-9)
    assert got.coherence.min() > 1 - 1e-9


def test_two_correlated_inputs_are_told_apart():
    rng = np.random.default_rng(2)
    n = 40_000
    w = rng.standard_normal((2, n))
    w[1] += 0.8 * w[0]
    got = Measurement(w, [filtered(w[0]) - 2 * w[1]], dt=DT).frequency_response(segment_length=256)
    np.testing.assert_allclose(got.response[0, 0], at(got.omega), atol=0.02)
    np.testing.assert_allclose(got.response[0, 1], -2, atol=0.02)
    assert got.coherence.min() > 0.995


@pytest.mark.parametrize("overlap", [0.0, 0.5, 0.75])
def test_std_of_the_magnitude_is_right(overlap):
    """Scatter over 400 seeds against the std stated: each point within 15 %, the mean within 4 %."""
    magnitudes, stds = [], []
    for seed in range(400):
        rng = np.random.default_rng([7, seed])
        w = rng.standard_normal(2600)
        y = filtered(w)[40:] + 0.35 * rng.standard_normal(2560)
        got = Measurement(w[40:], y, dt=DT).frequency_response(segment_length=128, overlap=overlap)
        magnitudes.append(got.magnitude[0, 0])
        stds.append(got.std[0, 0])
    ratio = np.sqrt(np.mean(np.square(stds), axis=0)) / np.std(magnitudes, axis=0)
    assert abs(ratio.mean() - 1) < 0.04
    assert ratio.min() > 0.85
    assert ratio.max() < 1.18


def test_std_of_two_inputs_is_right_and_the_truth_lies_in_the_band():
    errors, stds = [], []
    for seed in range(300):
        rng = np.random.default_rng([8, seed])
        w = rng.standard_normal((2, 2600))
        y = (filtered(w[0]) + 0.7 * w[1])[40:] + 0.5 * rng.standard_normal(2560)
        got = Measurement(w[:, 40:], y, dt=DT).frequency_response(segment_length=128)
        truth = np.array([at(got.omega), np.full(got.omega.size, 0.7)])
        errors.append(got.response[0] - truth)
        stds.append(got.std[0])
    error, std = np.array(errors), np.array(stds)
    ratio = np.sqrt(np.mean(std**2)) / np.sqrt(np.mean(np.abs(error) ** 2) / 2)
    assert abs(ratio - 1) < 0.04
    # two standard deviations of the magnitude: 95.4 % for a normal error
    inside = np.abs(np.abs(error + truth) - np.abs(truth)) < 2 * std
    assert 0.93 < inside.mean() < 0.97
    assert inside.mean(axis=0).min() > 0.88


def test_phase_std_is_right():
    phases, stds = [], []
    for seed in range(400):
        rng = np.random.default_rng([9, seed])
        w = rng.standard_normal(2600)
        got = Measurement(
            w[40:], filtered(w)[40:] + 0.2 * rng.standard_normal(2560), dt=DT
        ).frequency_response(segment_length=128)
        phases.append(got.phase[0, 0])
        stds.append(got.phase_std[0, 0])
    ratio = np.sqrt(np.mean(np.square(stds), axis=0)) / np.std(phases, axis=0)
    assert abs(ratio.mean() - 1) < 0.05
    assert ratio.min() > 0.83
    assert ratio.max() < 1.2


def test_effective_averages_in_closed_form():
    assert effective_averages(1000, np.ones(100), 0) == 10
    # boxcar, half overlap, K segments: rho_1 = 1/4
    assert effective_averages(1000, np.ones(100), 50) == pytest.approx(19 / (1 + 2 * 18 / 19 / 4))
    # Hann, half overlap: rho_1 = 1/36
    taper = signal.get_window("hann", 4000)
    assert effective_averages(40_000, taper, 2000) == pytest.approx(19 / (1 + 2 * 18 / 19 / 36), rel=1e-6)


def test_unexcited_frequencies_are_left_out_and_counted():
    k = np.arange(4096)
    w = sum(np.cos(2 * np.pi * line * k / 256 + line) for line in (3, 10, 40))
    got = Measurement(w, 2 * w, dt=1).frequency_response(segment_length=256, overlap=0, window="boxcar")
    np.testing.assert_allclose(got.omega * 256 / 2 / np.pi, [3, 10, 40])
    np.testing.assert_allclose(got.response[0, 0], 2, rtol=1e-9)
    assert got.n_omitted == 124
    assert "124 frequencies are left out" in str(got)


@pytest.mark.parametrize(
    "inputs, options, message",
    [
        (np.ones(400), {}, "input 'u\\[0\\]' is constant"),
        (np.arange(20.0), {}, "too few"),
        (np.sin(np.arange(400.0)), {"segment_length": 400}, "effective segments"),
        (np.sin(np.arange(400.0)), {"segment_length": 500}, "between 4 and"),
        (np.sin(np.arange(400.0)), {"overlap": 1.0}, "overlap"),
    ],
)
def test_refusals(inputs, options, message):
    with pytest.raises(DataError, match=message):
        Measurement(inputs, np.cos(np.arange(inputs.size)), dt=1).frequency_response(**options)


def test_inputs_that_run_together_are_named():
    w = np.random.default_rng(0).standard_normal(2000)
    with pytest.raises(DataError, match="'a' and 'b' run together"):
        Measurement([w, -3 * w], w, dt=1, input_labels=["a", "b"]).frequency_response()
    v = np.random.default_rng(1).standard_normal(2000)
    with pytest.raises(DataError, match="combinations of one another"):
        Measurement([w, v, w + v], w, dt=1).frequency_response()
    with pytest.raises(ct.ControlArgument, match="whole number"):
        Measurement(w, v, dt=1).frequency_response(segment_length=12.5)
    with pytest.raises(TypeError):
        Measurement(w, v, dt=1).frequency_response(nperseg=12)


def test_table_and_plot():
    w = np.random.default_rng(0).standard_normal((2, 2000))
    got = Measurement(w, [filtered(w[0]), w[1]], dt=DT, name="<run>").frequency_response()
    assert all(len(line) <= 80 for line in str(got).splitlines())
    assert "&lt;run&gt;" in got._repr_html_()
    cplt = got.plot()
    assert cplt.axes.shape == (6, 2)
    assert cplt.axes[1, 0].get_ylim() == pytest.approx((-198, 198))
