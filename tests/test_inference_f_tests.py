"""Bases by record and tests by output against the same on all columns at once."""

from __future__ import annotations

import numpy as np
import pytest
from inner import project, rank_basis
from scipy import stats
from scipy.linalg import block_diag

from rcorefine.inference import f_tests


def by_hand(residual, columns, fitted):
    """F, its p-value and Box's, from QR of the fitted columns and of all of them."""
    q_fitted = np.linalg.qr(fitted)[0]
    left = columns - q_fitted @ (q_fitted.T @ columns)
    q = np.linalg.qr(left)[0]
    e = residual - q_fitted @ (q_fitted.T @ residual)
    gain = np.sum((q.T @ e) ** 2)
    free = e.size - fitted.shape[1] - q.shape[1]
    statistic = gain / q.shape[1] / ((e @ e - gain) / free)
    p_equal = stats.f.sf(statistic, q.shape[1], free)
    leverage = np.sum(q**2, axis=1)
    own = (e - q @ (q.T @ e)) / (1.0 - leverage - np.sum(q_fitted**2, axis=1))
    M = (q * own[:, None]).T @ (q * own[:, None])
    dof = np.trace(M) ** 2 / np.trace(M @ M)
    p_box = stats.f.sf(gain / np.trace(M), dof, np.sum(leverage) ** 2 / np.sum(leverage**2))
    return statistic, p_equal, max(p_equal, p_box)


@pytest.mark.parametrize("level", [np.ones(3), np.array([0.3, 1.0, 3.0])])
def test_columns_of_one_output_each_are_tested_as_on_all_rows(rng, level):
    n, counts = 150, (4, 3, 5)
    blocks = [rng.standard_normal((n, k)) for k in counts]
    fitted = rng.standard_normal((3 * n, 6))
    residual = np.repeat(level, n) * rng.standard_normal(3 * n) + block_diag(*blocks) @ np.full(12, 0.05)
    basis = f_tests.Basis(rank_basis(fitted))
    parts = [(np.arange(i * n, (i + 1) * n), block) for i, block in enumerate(blocks)]
    found = f_tests.apart_test("", project(residual, basis), parts, basis)
    statistic, p_equal, p_value = by_hand(residual, block_diag(*blocks), fitted)
    assert found.dof == 12
    assert found.statistic == pytest.approx(statistic, rel=1e-10)
    assert (found.p_equal, found.p_value) == pytest.approx((p_equal, p_value), rel=1e-8)


def test_directions_that_were_fitted_do_not_count_twice(rng):
    n, fitted = 100, rng.standard_normal((200, 2))
    fitted[n:] = 0.0  # of the first output alone
    blocks = [np.column_stack([fitted[:n], rng.standard_normal((n, 3))]), rng.standard_normal((n, 3))]
    blocks[1] = np.column_stack([blocks[1], blocks[1] @ [1.0, -2.0, 0.5]])  # one too many
    residual, basis = rng.standard_normal(200), f_tests.Basis(rank_basis(fitted))
    parts = [(np.arange(n), blocks[0]), (np.arange(n, 200), blocks[1])]
    found = f_tests.apart_test("", project(residual, basis), parts, basis)
    own = block_diag(blocks[0][:, 2:], blocks[1][:, :3])
    statistic, p_equal, p_value = by_hand(residual, own, fitted)
    assert found.dof == 6
    assert (found.statistic, found.p_equal, found.p_value) == pytest.approx((statistic, p_equal, p_value))


def test_a_basis_by_record_projects_off_as_all_columns_at_once(rng):
    rows, common = (40, 60, 50), rng.standard_normal((150, 3))
    own = [rng.standard_normal((k, 2)) for k in rows]
    own[1][:, 1] = 3.0 * own[1][:, 0]  # the record sees one direction only
    ends = np.cumsum(rows)[:-1]
    common[:40, 2], common[40:, 2] = own[0] @ [1.0, 2.0], 0.0  # no more than the first start can do
    basis = f_tests.Basis.of(np.split(common, ends), own)
    values, all_ = rng.standard_normal((150, 4)), np.hstack([common, block_diag(*own)])
    expected = values - all_ @ np.linalg.lstsq(all_, values, rcond=None)[0]
    assert project(values, basis) == pytest.approx(expected, abs=1e-10)
    assert basis.rank == np.linalg.matrix_rank(all_) == 7
    u = np.linalg.svd(all_, full_matrices=False)[0][:, :7]
    assert basis.leverage == pytest.approx(np.sum(u**2, axis=1))
    weights = rng.uniform(0.5, 2.0, 150)
    heavy = basis.weighted(weights, np.ones((150, 1)))
    all_ = weights[:, None] * np.column_stack([all_, np.ones(150)])
    expected = values - all_ @ np.linalg.lstsq(all_, values, rcond=None)[0]
    assert project(values, heavy) == pytest.approx(expected, abs=1e-10)


def test_nearly_dependent_columns_give_an_orthonormal_basis(rng):
    x = rng.standard_normal((300, 4))
    x[:, 3] = x[:, 0] + 1e-6 * x[:, 3]
    q = rank_basis(x)
    assert q.T @ q == pytest.approx(np.eye(4), abs=1e-9)
    assert f_tests.lengths(project(x, q)).max() < 1e-9
