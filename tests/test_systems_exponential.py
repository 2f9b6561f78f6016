"""The stacked matrix exponential against scipy's."""

import numpy as np
import pytest
from scipy.linalg import expm

from rcorefine.systems.exponential import exponential


@pytest.mark.parametrize("scale", [1e-9, 0.3, 3.0, 40.0])
def test_equals_scipy(rng, scale):
    real = rng.standard_normal((5, 7, 7)) * scale
    for stack in (real, real + 1j * rng.standard_normal((5, 7, 7)) * scale):
        oracle = np.array([expm(each) for each in stack])
        error = np.abs(exponential(stack) - oracle).max(axis=(1, 2)) / np.abs(oracle).max(axis=(1, 2))
        assert error.max() < 1e-11 * max(1.0, scale)


def test_stiff_pole_of_the_rlc_start():
    A = np.array([[0.0, 1.0], [-1 / 2e-6, -250 / 2e-6]]) * 1e-4
    slow = np.max(np.roots([1.0, 250 / 2e-6 * 1e-4, 1 / 2e-6 * 1e-8]).real)
    values = np.linalg.eigvals(exponential(A[None])[0])
    assert values.real.max() == pytest.approx(np.exp(slow), rel=1e-9)


def test_overflow_is_not_finite():
    assert not np.isfinite(exponential(np.array([[[1e5]]]))).all()


def test_companion_matrix_of_a_fast_filter_stays_stable():
    poles = -np.array([4.9e3, 6e3 + 2e4j, 6e3 - 2e4j, 9e3 + 3e4j, 9e3 - 3e4j])
    A = np.vstack([-np.poly(poles).real[1:], np.eye(5)[:-1]])  # entries up to 1e21
    steps = np.array([2e-5, 1e-5])
    found = np.linalg.eigvals(exponential(A * steps[:, None, None]))
    for values, step in zip(found, steps, strict=True):
        np.testing.assert_allclose(np.sort_complex(values), np.sort_complex(np.exp(poles * step)), rtol=1e-6)
