"""The sliding window against closed forms, and the two bodies of each pass against one another."""

from __future__ import annotations

import importlib
import os
import tempfile

import numpy as np
import pytest
from inner import NUMBA

from rcorefine import jit
from rcorefine.streaming import paper

Array = np.ndarray


def step_by_least_squares(rows: Array, offsets: Array, theta: Array, alpha: float) -> Array:
    """Minimizer of |f + Phi t|^2 + alpha |t - theta|^2 by an orthogonal factorization."""
    stacked = np.vstack([rows, np.sqrt(alpha) * np.eye(theta.size)])
    right = np.concatenate([-offsets, np.sqrt(alpha) * theta])
    return np.asarray(np.linalg.lstsq(stacked, right, rcond=None)[0])


def begin(n_y: int, m: int, window: int, alpha: float) -> paper.Stage:
    """A stage with one correction and the one Markov parameter 1 at every output."""
    return paper.Stage(
        np.ones((1, n_y, 1)), np.zeros((1, m)), np.zeros((1, m)), np.zeros((1, 1)),
        np.zeros((window, n_y, m)), np.zeros((window, n_y)), np.eye(m) / alpha, np.zeros(0),
        np.zeros(1, dtype=np.int64),
    )  # fmt: skip


def slide_through(
    rows: Array, offsets: Array, window: int, alpha: float, n_y: int = 1
) -> tuple[Array, Array]:
    """theta after every sample, from the kernel and in closed form; rows of shape (N, n_y, m)."""
    m = rows.shape[2]
    stage = begin(n_y, m, window, alpha)
    ours, theirs = np.zeros((rows.shape[0], m)), np.zeros((rows.shape[0], m))
    theta = np.zeros(m)
    for k in range(rows.shape[0]):
        stage.psi[0] = rows[k, 0]
        for r in range(n_y):  # H = 1: each output has the same row; other rows by other Markov parameters
            stage.H[0, r, 0] = 1.0 + r
        paper._learn(stage, offsets[k], alpha, 0)
        first = max(0, k - window + 1)
        weights = 1.0 + np.arange(n_y)
        Phi = (weights[None, :, None] * rows[first : k + 1, :1]).reshape(-1, m)
        theta = step_by_least_squares(Phi, offsets[first : k + 1].ravel(), theta, alpha)
        ours[k], theirs[k] = stage.theta[0], theta
    return ours, theirs


def stream(rng: np.random.Generator, n: int, n_y: int, m: int) -> tuple[Array, Array]:
    rows = rng.standard_normal((n, n_y, m))
    return rows, -rows @ rng.standard_normal(m) + 0.1 * rng.standard_normal((n, n_y))


@pytest.mark.parametrize("n_y", [1, 3])
@pytest.mark.parametrize("window, m", [(1, 3), (7, 5), (40, 13)])
@pytest.mark.parametrize("alpha", [1e3, 1.0, 1e-3])
def test_window_slides_as_if_solved_anew(
    rng: np.random.Generator, n_y: int, window: int, m: int, alpha: float
) -> None:
    rows, offsets = stream(rng, 600, n_y, m)
    ours, theirs = slide_through(rows, offsets, window, alpha, n_y)
    np.testing.assert_allclose(ours, theirs, atol=1e-8 * np.abs(theirs).max())


def test_digits_do_not_drain_over_a_long_stream(rng: np.random.Generator) -> None:
    """20 000 samples, window energy 1e6 times alpha: the textbook recursion loses 4 digits more."""
    rows, offsets = stream(rng, 20_000, 1, 8)
    stage, theta = begin(1, 8, 50, 1e-3), np.zeros(8)
    for k in range(rows.shape[0]):
        stage.psi[0] = rows[k, 0]
        paper._learn(stage, offsets[k], 1e-3, 0)
        if k >= rows.shape[0] - 400:  # older steps are forgotten: theta contracts to the window's solution
            theta = step_by_least_squares(rows[k - 49 : k + 1, 0], offsets[k - 49 : k + 1, 0], theta, 1e-3)
    np.testing.assert_allclose(stage.theta[0], theta, rtol=1e-9)


@pytest.mark.parametrize("size", [1e3, 1e5, 1e8])
def test_outliers_enter_and_leave(rng: np.random.Generator, size: float) -> None:
    """A huge row passes through the window; afterwards nothing of it is left."""
    rows, offsets = stream(rng, 400, 1, 6)
    rows[[120, 123, 190]] *= size
    offsets[[120, 123, 190]] *= size
    ours, theirs = slide_through(rows, offsets, 30, 1.0)
    np.testing.assert_allclose(ours[300:], theirs[300:], atol=1e-8)
    np.testing.assert_allclose(ours, theirs, atol=1e-4 * np.abs(theirs).max())


@pytest.mark.parametrize("alpha", [1e-30, 1e-9])
def test_a_window_without_digits_in_its_squares_is_solved_directly(
    rng: np.random.Generator, alpha: float
) -> None:
    rows, offsets = stream(rng, 60, 1, 12)
    ours, theirs = slide_through(1e3 * rows, offsets, 40, alpha)
    np.testing.assert_allclose(ours[20:], theirs[20:], rtol=1e-8, atol=1e-10)


@pytest.mark.numba
@pytest.mark.skipif(not NUMBA, reason="numba is not installed or switched off")
def test_a_constant_argument_compiles_no_kernel_anew():
    types = importlib.import_module("numba").types
    kernel = jit.compiled(lambda values, by: values[0] - by)
    for constant in (types.literal(2), types.literal(3), types.int64):
        within = kernel.get_call_template((types.float64[::1], constant), {})[0]
    assert len(within.cases) == 1
    assert not kernel.signatures  # a kernel that kernels call is not made callable from Python, too
    assert kernel(np.array([5.0]), 2) == 3.0
    assert len(kernel.signatures) == 1


@pytest.mark.numba
@pytest.mark.skipif(not NUMBA, reason="numba is not installed or switched off")
def test_a_kernel_is_called_by_its_address_with_its_own_types_only():
    numba = importlib.import_module("numba")

    def checked(values, by):
        if by == 0:
            raise ValueError("by is zero")
        return int(values[0]) // by

    call, address = jit.by_address(jit.compiled(checked), lambda: (np.zeros(1), 0))
    caller = jit.compiled(lambda at, values, by: 1 + call(at, values, by))
    assert caller(address(), np.array([7.0]), 2) == 4
    with pytest.raises(ValueError, match="by is zero"):
        caller(address(), np.array([7.0]), 0)
    with pytest.raises(numba.core.errors.TypingError, match=r"argument 1 is float64, not int64"):
        caller(address(), np.array([7.0]), 2.0)


@pytest.mark.numba
@pytest.mark.skipif(not (NUMBA and hasattr(os, "getuid")), reason="needs numba and users")
def test_kernels_are_kept_where_neither_package_nor_home_can_be_written_to(monkeypatch, tmp_path):
    caching = importlib.import_module("numba.core.caching")
    impl = caching.CompileResultCacheImpl  # as where no other place is left
    given = [one for one in impl._locator_classes if "UserProvided" in one.__name__]
    monkeypatch.setattr(impl, "_locator_classes", given)
    monkeypatch.setattr(caching.config, "CACHE_DIR", "")
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    folder = tmp_path / f"rcorefine-{os.getuid()}"
    for mode, kept in ((0o777, False), (0o700, True)):
        jit._own_folder.cache_clear()
        folder.mkdir(exist_ok=True)
        folder.chmod(mode)
        assert jit.compiled(_twice)(2.0) == 4.0
        assert any(folder.rglob("*.nbi")) == kept  # not where somebody else could lay down what is run
    again = jit.compiled(_twice)
    assert again(3.0) == 6.0
    assert sum(again._cache_hits.values()) == 1
    jit._own_folder.cache_clear()


def _twice(value):
    return 2.0 * value
