"""The black-box yardstick: as good as the noise permits, with the poles of the truth."""

import control as ct
import numpy as np
import pytest
from scipy.signal import dlsim

import rcorefine as rco


def record(rng, noise, n=3000, dt=0.05, offset=0.0):
    """Two inputs, two outputs of different order, started in motion."""
    A = np.array([[0, 1.0, 0], [-9.0, -0.5, 0], [0, 0, -2.0]])
    B, C = np.array([[0, 0], [9.0, 2.0], [0.0, 2.0]]), np.array([[1.0, 0, 0], [0, 0, 1.0]])
    truth = ct.c2d(ct.ss(A, B, C, 0), dt)
    u = rng.standard_normal((2, n))
    y = dlsim((truth.A, truth.B, truth.C, truth.D, dt), u.T, x0=[1.0, -1.0, 0.5])[1].T
    y = y + noise * y.std(axis=1, keepdims=True) * rng.standard_normal(y.shape) + offset
    return truth, rco.Measurement(u, y, dt=dt, output_labels=("q", "v"))


@pytest.mark.parametrize("noise", [0.05, 0.3])
def test_the_fit_is_what_the_noise_leaves(noise):
    truth, data = record(np.random.default_rng(0), noise)
    box = rco.black_box(data, order=2)
    limit = 100 * (1 - noise / np.sqrt(1 + noise**2))
    np.testing.assert_allclose(rco.compare(box, data).fit, limit, atol=0.6)
    omega = np.array([0.5, 2.0, 3.0, 5.0])
    exact, found = truth(np.exp(1j * omega * data.dt)), box(np.exp(1j * omega * data.dt))
    assert np.abs(found - exact).max() < 0.15 * noise * np.abs(exact).max()


def test_without_noise_it_is_exact_and_knows_offsets():
    truth, data = record(np.random.default_rng(1), 0.0, offset=5.0)
    box = rco.black_box(data, order=2)
    z = np.exp(1j * np.array([0.1, 1.0, 3.0]) * data.dt)
    np.testing.assert_allclose(box(z), truth(z), atol=1e-6)
    assert box.dt == data.dt
    assert (box.input_labels, box.output_labels) == (list(data.input_labels), ["q", "v"])


def test_too_short_a_record_and_none_without_inputs():
    _, data = record(np.random.default_rng(2), 0.1, n=60)
    with pytest.raises(
        rco.DataError, match="order 4 has 19 coefficients .* 95 samples, the record has 2 and 60"
    ):
        rco.black_box(data)
    with pytest.raises(rco.DataError, match="needs an input"):
        rco.black_box(rco.Measurement.free_decay(data.outputs, dt=0.05))
    for still in (data.inputs, 0.0 * data.outputs), (1.0 + 0.0 * data.inputs, data.outputs):
        with pytest.raises(rco.DataError, match=r"(u\[0\]|y\[0\]) never changes"):
            rco.black_box(rco.Measurement(*still, dt=0.05), order=1)
    with pytest.raises(ct.ControlArgument, match="order"):
        rco.black_box(data, order=0)
