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
