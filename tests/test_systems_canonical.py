"""Observable canonical form: the shape of (10), (11), the same transfer function."""

import control as ct
import numpy as np
import pytest

from rcorefine.exceptions import ModelError
from rcorefine.systems import LinearModel, characteristic_polynomial, frequency_response, observable_form


def siso(rng, n, dt=0.0):
    return LinearModel.from_statespace(
        ct.ss(
            rng.standard_normal((n, n)) - np.eye(n),
            rng.standard_normal((n, 1)),
            rng.standard_normal((1, n)),
            [[0.4]],
            dt,
            inputs="w",
            outputs="y",
            name="plant",
        )
    )


@pytest.mark.parametrize("dt", [0.0, 0.1])
def test_form_and_transfer_function(rng, dt):
    for n in range(1, 7):
        model = siso(rng, n, dt)
        canonical, transformation = observable_form(model)
        np.testing.assert_array_equal(canonical.A[:, 1:], np.eye(n, k=1)[:, 1:])
        np.testing.assert_allclose(-canonical.A[:, 0], np.poly(model.A)[1:], rtol=1e-9, atol=1e-10)
        np.testing.assert_array_equal(canonical.C, np.eye(1, n))
        np.testing.assert_allclose(transformation @ model.A, canonical.A @ transformation, atol=1e-9)
        np.testing.assert_allclose(canonical.C @ transformation, model.C, atol=1e-12)
        omega = np.geomspace(0.1, 20, 30)
        np.testing.assert_allclose(
            frequency_response(canonical, omega), frequency_response(model, omega), rtol=1e-8
        )
        assert (canonical.dt, canonical.input_labels, canonical.name) == (dt, ("w",), "plant")
        assert canonical.state_labels == tuple(f"o[{i}]" for i in range(n))


def test_input_map_holds_the_numerator():
    # (s + 7) / (s^2 + 3 s + 2), paper (3), (10): B = [beta_1, beta_2].
    model = LinearModel.from_statespace(ct.ss([[0, 1], [-2, -3]], [[0], [1]], [[7, 1]], 0))
    canonical, _ = observable_form(model)
    np.testing.assert_allclose(canonical.B.ravel(), [1, 7], atol=1e-14)


def test_slow_pole_of_a_stiff_model_survives():
    # RLC start of the paper: s^2 + 1.25e8 s + 5e5; the eigenvalues would give 5e5 to six digits only.
    model = LinearModel.from_statespace(ct.ss([[0, 1], [-5e5, -1.25e8]], [[0], [5e5]], [[0, 250]], 0))
    np.testing.assert_allclose(characteristic_polynomial(model.A), [1, 1.25e8, 5e5], rtol=1e-14)
    canonical, _ = observable_form(model)
    np.testing.assert_allclose(canonical.B.ravel(), [1.25e8, 0], rtol=1e-14, atol=1e-6)


def test_polynomial_against_the_eigenvalues(rng):
    for n in range(8):
        a = rng.standard_normal((n, n))
        np.testing.assert_allclose(
            characteristic_polynomial(a), np.atleast_1d(np.poly(a)) if n else [1.0], atol=1e-10
        )


def test_static_gain_has_nothing_to_transform():
    canonical, transformation = observable_form(LinearModel.from_statespace(ct.ss([], [], [], [[2.0]])))
    assert canonical.n_states == 0
    assert transformation.shape == (0, 0)


@pytest.mark.parametrize("scale", [1e-6, 1.0, 1e6])
def test_unobservable_mode_is_named(scale):
    model = ct.ss([[-1.0, 0], [0, -2.0]], [[1], [1]], [[scale, 0]], 0, name="pair")
    with pytest.raises(ModelError, match=r"'pair' is not observable.*mode at -2"):
        observable_form(LinearModel.from_statespace(model))


def test_mimo_is_refused():
    model = ct.ss([[-1.0]], [[1, 1]], [[1]], [[0, 0]])
    with pytest.raises(ct.ControlDimension, match="2 and 1"):
        observable_form(LinearModel.from_statespace(model))
