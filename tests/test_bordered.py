"""Normal equations by records against all rows and columns at once."""

from __future__ import annotations

import numpy as np
import pytest
from inner import Rows, gauss_newton, promised

from rcorefine.gauss_newton import Bordered


def records(rng, p=3, n=2, rows=(20, 30, 25)):
    """Derivatives and residuals of records, and the matrix of all of them."""
    blocks = [rng.standard_normal((k, p + n)) * 10.0 ** rng.uniform(-3, 3, p + n) for k in rows]
    residuals = [rng.standard_normal(k) for k in rows]
    whole = np.zeros((sum(rows), p + n * len(rows)))
    for i, (at, block) in enumerate(zip(np.cumsum((0, *rows)), blocks, strict=False)):
        whole[at : at + len(block), :p] = block[:, :p]
        whole[at : at + len(block), p + i * n : p + (i + 1) * n] = block[:, p:]
    return blocks, residuals, whole


def test_squares_and_gradient_are_those_of_all_rows(rng):
    blocks, residuals, J = records(rng)
    found, r, step = Bordered.of(blocks, residuals, 3), np.concatenate(residuals), rng.standard_normal(9)
    assert found.gradient == pytest.approx(J.T @ r)
    assert found.norms == pytest.approx(np.linalg.norm(J, axis=0))
    assert found.square(step) == pytest.approx(np.sum((J @ step) ** 2))


@pytest.mark.parametrize("damping", [0.0, 1e-3, 10.0])
def test_a_step_is_that_of_damped_least_squares(rng, damping):
    blocks, residuals, J = records(rng)
    keep = np.ones(9, dtype=bool)
    keep[[1, 6]] = False  # one of all records, one of the second alone
    size = np.linalg.norm(J, axis=0)[keep]
    below = np.vstack([J[:, keep] / size, np.sqrt(damping) * np.eye(7)])
    r = np.concatenate([*residuals, np.zeros(7)])
    expected = np.zeros(9)
    expected[keep] = -np.linalg.lstsq(below, r, rcond=None)[0] / size
    assert Bordered.of(blocks, residuals, 3).step(keep, damping) == pytest.approx(expected, rel=1e-8)


def test_what_no_record_sees_stays(rng):
    blocks, residuals, _ = records(rng)
    for block in blocks:
        block[:, 1] = 2.0 * block[:, 0]  # only the sum is seen
    blocks[1][:, 4] = -block[:1, 3] * blocks[1][:, 3]  # and one state of the second record
    found = Bordered.of(blocks, residuals, 3)
    step = found.step(np.ones(9, dtype=bool), 0.0)
    assert found.gradient + push(found, step) == pytest.approx(
        np.zeros(9), abs=1e-8 * np.abs(found.gradient).max()
    )
    assert np.abs(step * found.norms).max() < 1e3


def push(found, step):
    """J'J times a step."""
    first, own = step[:3], step[3:].reshape(3, 2)
    down = np.einsum("rij,i->rj", found.cross, first) + np.einsum("rij,rj->ri", found.own, own)
    return np.concatenate([found.common @ first + np.einsum("rij,rj->i", found.cross, own), down.ravel()])


def test_the_information_of_the_common_is_the_inverse_of_their_covariance(rng):
    blocks, residuals, J = records(rng)
    expected = np.linalg.inv(np.linalg.inv(J.T @ J)[:3, :3])
    size = np.linalg.norm(J[:, :3], axis=0)
    scale = np.outer(size, size)
    assert Bordered.of(blocks, residuals, 3).condensed() / scale == pytest.approx(expected / scale, rel=1e-6)


def test_a_descent_by_records_ends_where_that_on_all_rows_does(rng):
    t = np.linspace(0.0, 3.0, 40)
    data = [np.exp(-0.7 * t) * a + 0.01 * rng.standard_normal(40) for a in (1.0, -2.0, 0.5)]

    def parts(x):
        fade = np.exp(-x[0] * t)
        return [
            (np.column_stack([-t * fade * a, fade]), fade * a - y) for a, y in zip(x[1:], data, strict=True)
        ]

    def by_records(x):
        blocks, residuals = zip(*parts(x), strict=True)
        return Rows(np.concatenate(residuals), Bordered.of(blocks, residuals, 1))

    def at_once(x):
        J = np.zeros((120, 4))
        for i, (block, _) in enumerate(parts(x)):
            J[40 * i : 40 * i + 40, [0, 1 + i]] = block
        return Rows(np.concatenate([r for _, r in parts(x)]), J)

    start = np.array([0.2, 0.5, -1.0, 1.0])
    one, other = (
        gauss_newton(rows, start, tolerance=1e-12, evaluations=40) for rows in (by_records, at_once)
    )
    assert one.point == pytest.approx(other.point, rel=1e-9)
    assert one.cost == pytest.approx(other.cost, rel=1e-12)
    away = np.array([0.5, 0.9, -1.8, 0.6])
    assert promised(by_records(away), away, -np.inf, np.inf) == pytest.approx(
        promised(at_once(away), away, -np.inf, np.inf), rel=1e-6
    )
