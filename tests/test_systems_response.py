"""Batched frequency response and the Bode error."""

import control as ct
import numpy as np
import pytest

from rcorefine.exceptions import ModelError
from rcorefine.systems import LinearModel, bode_error, default_omega, frequency_response, response


@pytest.mark.parametrize("dt", [0, 0.1, True, None])
def test_agrees_with_python_control(rng, dt):
    a = rng.standard_normal((4, 4))
    a /= 1.1 * np.abs(np.linalg.eigvals(a)).max()
    plant = ct.ss(
        a, rng.standard_normal((4, 2)), rng.standard_normal((3, 4)), rng.standard_normal((3, 2)), dt
    )
    omega = np.geomspace(0.01, 3, 40)
    mine = frequency_response(LinearModel.from_statespace(plant), omega)
    assert mine.shape == (3, 2, 40)
    np.testing.assert_allclose(mine, ct.frequency_response(plant, omega).frdata, rtol=1e-10)


def test_batches_do_not_change_the_result(rng, monkeypatch):
    model = LinearModel.from_statespace(ct.ss([[0, 1], [-4, -0.1]], [[0], [1]], [[1, 0]], 0))
    omega = np.linspace(0.1, 10, 57)
    whole = frequency_response(model, omega)
    monkeypatch.setattr(response, "_BATCH", 40)
    np.testing.assert_array_equal(frequency_response(model, omega), whole)


def test_pole_on_the_point_is_infinite_and_spoils_no_other():
    integrator = LinearModel.from_statespace(ct.ss([[0.0]], [[1.0]], [[1.0]], 0))
    values = frequency_response(integrator, [0.0, 1.0, 2.0])[0, 0]
    assert np.isinf(values[0].real)
    np.testing.assert_allclose(values[1:], [-1j, -0.5j])


def test_static_gain():
    model = LinearModel.from_statespace(ct.ss([], [], [], [[2.0, 3.0]]))
    np.testing.assert_array_equal(frequency_response(model, [1.0, 2.0])[0, 1], [3.0, 3.0])


def test_default_frequencies_end_at_nyquist():
    omega = default_omega(0.01)
    assert omega.size == 200
    assert (omega[0], omega[-1]) == (pytest.approx(0.1), pytest.approx(100 * np.pi))
    np.testing.assert_allclose(np.diff(np.log(omega)), np.log(1000 * np.pi) / 199, rtol=1e-10)
    # A plant sampled every minute has no 0.1 rad/s.
    slow = default_omega(60.0)
    assert slow[0] < slow[-1] / 100


def test_bode_error_of_a_scaled_response():
    plant = ct.ss([[0.5]], [[1.0]], [[1.0]], 0, 0.1)
    assert bode_error(plant, 1.25 * plant) == pytest.approx(0.25)
    assert bode_error(plant, plant) == 0.0
    assert bode_error(plant, 0 * plant) == pytest.approx(1.0)


def test_bode_error_compares_across_timebases():
    lag = ct.ss([[-1.0]], [[1.0]], [[1.0]], 0)
    sampled = lag.sample(0.01)
    # A hold delays by half a sample: |1 - e^{-j w T/2}|, small in the pass band.
    assert bode_error(lag, sampled, np.array([1.0])) == pytest.approx(0.005, rel=1e-2)
    assert bode_error(lag, lag, dt=0.01) == 0.0


def test_bode_error_needs_a_range_and_a_true_response():
    lag = ct.ss([[-1.0]], [[1.0]], [[1.0]], 0)
    with pytest.raises(ModelError, match="give dt="):
        bode_error(lag, lag)
    with pytest.raises(ModelError, match="is zero"):
        bode_error(0 * lag, lag, dt=0.1)
    with pytest.raises(ct.ControlDimension, match="same channels"):
        bode_error(lag, ct.ss([[-1.0]], [[1.0, 1.0]], [[1.0]], 0), dt=0.1)
    with pytest.raises(ct.ControlDimension, match="one-dimensional"):
        bode_error(lag, lag, [[1.0]])
    with pytest.raises(ModelError, match=r"omega\[1\]"):
        bode_error(lag, lag, [1.0, np.nan])
