"""Batched frequency response, Bode error, and the canonical form of (10), (11)."""

import control as ct
import numpy as np
import pytest
from inner import LinearModel, bode_error

import rcorefine as rco
from rcorefine import systems


@pytest.mark.parametrize("dt", [0, 0.1, True, None])
def test_agrees_with_python_control(rng, dt):
    a = rng.standard_normal((4, 4))
    a /= 1.1 * np.abs(np.linalg.eigvals(a)).max()
    plant = ct.ss(
        a, rng.standard_normal((4, 2)), rng.standard_normal((3, 4)), rng.standard_normal((3, 2)), dt
    )
    omega = np.geomspace(0.01, 3, 40)
    mine = systems.frequency_response(LinearModel.from_statespace(plant), omega)
    assert mine.shape == (3, 2, 40)
    np.testing.assert_allclose(mine, ct.frequency_response(plant, omega).frdata, rtol=1e-10)


def test_batches_do_not_change_the_result(rng, monkeypatch):
    model = LinearModel.from_statespace(ct.ss([[0, 1], [-4, -0.1]], [[0], [1]], [[1, 0]], 0))
    omega = np.linspace(0.1, 10, 57)
    whole = systems.frequency_response(model, omega)
    monkeypatch.setattr(systems.response, "_BATCH", 40)
    np.testing.assert_array_equal(systems.frequency_response(model, omega), whole)


def test_pole_on_the_point_is_infinite_and_spoils_no_other():
    integrator = LinearModel.from_statespace(ct.ss([[0.0]], [[1.0]], [[1.0]], 0))
    values = systems.frequency_response(integrator, [0.0, 1.0, 2.0])[0, 0]
    assert np.isinf(values[0].real)
    np.testing.assert_allclose(values[1:], [-1j, -0.5j])


def test_static_gain():
    model = LinearModel.from_statespace(ct.ss([], [], [], [[2.0, 3.0]]))
    np.testing.assert_array_equal(systems.frequency_response(model, [1.0, 2.0])[0, 1], [3.0, 3.0])


def test_default_frequencies_end_at_nyquist():
    omega = systems.default_omega(0.01)
    assert omega.size == 200
    assert (omega[0], omega[-1]) == (pytest.approx(0.1), pytest.approx(100 * np.pi))
    np.testing.assert_allclose(np.diff(np.log(omega)), np.log(1000 * np.pi) / 199, rtol=1e-10)
    # A plant sampled every minute has no 0.1 rad/s.
    slow = systems.default_omega(60.0)
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


LAG = ct.ss([[-1.0]], [[1.0]], [[1.0]], 0)
WIDE = ct.ss([[-1.0]], [[1.0, 1.0]], [[1.0]], 0)


@pytest.mark.parametrize(
    ("true", "estimate", "omega", "dt", "error", "words"),
    [
        (LAG, LAG, None, None, rco.ModelError, "give dt="),
        (0 * LAG, LAG, None, 0.1, rco.ModelError, "is zero"),
        (LAG, WIDE, None, 0.1, ct.ControlDimension, "same channels"),
        (LAG, LAG, [[1.0]], None, ct.ControlDimension, "one-dimensional"),
        (LAG, LAG, [1.0, np.nan], None, rco.ModelError, r"omega\[1\]"),
    ],
)
def test_bode_error_needs_a_range_and_a_true_response(true, estimate, omega, dt, error, words):
    with pytest.raises(error, match=words):
        bode_error(true, estimate, omega, dt=dt)


def siso(rng, n, dt=0.0):
    A, B, C = (
        rng.standard_normal((n, n)) - np.eye(n),
        rng.standard_normal((n, 1)),
        rng.standard_normal((1, n)),
    )
    return LinearModel.from_statespace(ct.ss(A, B, C, [[0.4]], dt, inputs="w", outputs="y", name="plant"))


@pytest.mark.parametrize("dt", [0.0, 0.1])
def test_form_and_transfer_function(rng, dt):
    for n in range(1, 7):
        model = siso(rng, n, dt)
        canonical, transformation = systems.observable_form(model)
        np.testing.assert_array_equal(canonical.A[:, 1:], np.eye(n, k=1)[:, 1:])
        np.testing.assert_allclose(-canonical.A[:, 0], np.poly(model.A)[1:], rtol=1e-9, atol=1e-10)
        np.testing.assert_array_equal(canonical.C, np.eye(1, n))
        np.testing.assert_allclose(transformation @ model.A, canonical.A @ transformation, atol=1e-9)
        np.testing.assert_allclose(canonical.C @ transformation, model.C, atol=1e-12)
        omega = np.geomspace(0.1, 20, 30)
        np.testing.assert_allclose(
            systems.frequency_response(canonical, omega), systems.frequency_response(model, omega), rtol=1e-8
        )
        assert (canonical.dt, canonical.input_labels, canonical.name) == (dt, ("w",), "plant")
        assert canonical.state_labels == tuple(f"o[{i}]" for i in range(n))


def test_input_map_holds_the_numerator():
    # (s + 7) / (s^2 + 3 s + 2), paper (3), (10): B = [beta_1, beta_2].
    model = LinearModel.from_statespace(ct.ss([[0, 1], [-2, -3]], [[0], [1]], [[7, 1]], 0))
    canonical, _ = systems.observable_form(model)
    np.testing.assert_allclose(canonical.B.ravel(), [1, 7], atol=1e-14)


def test_slow_pole_of_a_stiff_model_survives():
    # RLC start of the paper: s^2 + 1.25e8 s + 5e5; the eigenvalues would give 5e5 to six digits only.
    model = LinearModel.from_statespace(ct.ss([[0, 1], [-5e5, -1.25e8]], [[0], [5e5]], [[0, 250]], 0))
    np.testing.assert_allclose(systems.characteristic_polynomial(model.A), [1, 1.25e8, 5e5], rtol=1e-14)
    canonical, _ = systems.observable_form(model)
    np.testing.assert_allclose(canonical.B.ravel(), [1.25e8, 0], rtol=1e-14, atol=1e-6)


def test_polynomial_against_the_eigenvalues(rng):
    for n in range(8):
        a = rng.standard_normal((n, n))
        np.testing.assert_allclose(
            systems.characteristic_polynomial(a), np.atleast_1d(np.poly(a)) if n else [1.0], atol=1e-10
        )


def test_static_gain_has_nothing_to_transform():
    canonical, transformation = systems.observable_form(
        LinearModel.from_statespace(ct.ss([], [], [], [[2.0]]))
    )
    assert canonical.n_states == 0
    assert transformation.shape == (0, 0)


@pytest.mark.parametrize("scale", [1e-6, 1.0, 1e6])
def test_unobservable_mode_is_named(scale):
    model = ct.ss([[-1.0, 0], [0, -2.0]], [[1], [1]], [[scale, 0]], 0, name="pair")
    with pytest.raises(rco.ModelError, match=r"'pair' is not observable.*mode at -2"):
        systems.observable_form(LinearModel.from_statespace(model))


def test_mimo_is_refused():
    model = ct.ss([[-1.0]], [[1, 1]], [[1]], [[0, 0]])
    with pytest.raises(ct.ControlDimension, match="2 and 1"):
        systems.observable_form(LinearModel.from_statespace(model))
