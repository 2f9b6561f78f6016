"""Residual tests of frequency responses that need no candidates.

The residual must show no pattern along the frequency.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from scipy import stats

from ..data.response_record import ResponseRecord, coded
from ..engine.response_engine import ResponseEngine
from ..inference.f_tests import FTest
from ..inference.free_form import Curve
from ..systems.linear import Array

if TYPE_CHECKING:
    from .residual_tests import TestedResidual

__all__ = ["in_rows", "over_frequency", "response_tests"]

_LAGS = 21
_NEIGHBORS = 3
_VALUES_PER_COLUMN = 5  # fewer say nothing about that many columns


def response_tests(tested: TestedResidual) -> list[FTest]:
    """Test the residual of frequency responses for any other pattern.

    Each test has its own p-value.

    Parameters
    ----------
    tested : TestedResidual
        Residual under test.

    Returns
    -------
    list of FTest
        ``smooth error`` (a factor of any smooth form on each response), ``short response`` (anything
        that dies out within a few samples), ``neighbors`` (points beside each other that err alike).
    """
    tests = [tested.test("smooth error", _smooth(tested)), tested.test("short response", _short(tested))]
    return [*tests, _neighbors(tested)]


def over_frequency(record: ResponseRecord) -> Array:
    """Return piecewise linear functions of the logarithm of frequency.

    They have the shape (n_omega, k), and neighboring values are similar.
    """
    along = np.log(record.omega)
    curve = Curve.along("", along, np.zeros(along.size))
    return np.asarray(curve.columns(along, np.zeros(along.size)) @ curve.root)


def in_rows(record: ResponseRecord, points: Array) -> Array:
    """Convert complex columns to real columns in the rows of a record.

    The shape changes from (n_y, n_w, n_omega, k) to (n_y, N, k).
    """
    return np.stack([coded(column) / record.noise for column in np.moveaxis(points, -1, 0)], axis=-1)


def _records(tested: TestedResidual) -> list[tuple[ResponseEngine, ResponseRecord]]:
    engines = tested.fitted.problem.engines
    return [(engine, engine.data) for engine in engines if isinstance(engine, ResponseEngine)]


def _smooth(tested: TestedResidual) -> list[Array]:
    """Smooth complex factors on the response from each input to each output."""
    weights, blocks = tested.fitted.problem.weights, []
    for engine, record in _records(tested):
        model, shapes = engine.response(tested.fitted.theta, derivatives=False)[0], over_frequency(record)
        most = max(record.omega.size // _VALUES_PER_COLUMN, 1)
        shapes = shapes @ np.linalg.svd(shapes, full_matrices=False)[2].T[:, :most]
        columns = []
        for i, j in np.ndindex(model.shape[:2]):
            one = np.zeros(model.shape, complex)
            one[i, j] = model[i, j]
            columns += [one[..., None] * shapes, 1j * one[..., None] * shapes]
        blocks.append(weights[:, None, None] * in_rows(record, np.concatenate(columns, axis=-1)))
    return blocks


def _short(tested: TestedResidual) -> list[Array]:
    """Responses of a few samples from each input to each output."""
    weights, blocks = tested.fitted.problem.weights, []
    for _, record in _records(tested):
        lags = np.arange(min(_LAGS, max(record.omega.size // _VALUES_PER_COLUMN, 1)))
        turns = np.exp(-1j * record.omega[:, None] * record.dt * lags)
        columns = []
        for i, j in np.ndindex(record.n_outputs, record.n_inputs):
            one = np.zeros((record.n_outputs, record.n_inputs, *turns.shape), complex)
            one[i, j] = turns
            columns.append(one)
        blocks.append(weights[:, None, None] * in_rows(record, np.concatenate(columns, axis=-1)))
    return blocks


def _neighbors(tested: TestedResidual) -> FTest:
    """Test whether errors at neighboring frequencies are correlated.

    The statistic is the sum of the products of neighbors, relative to their size. The test is one-sided,
    because a missing effect makes neighboring errors similar.
    """
    products = []
    first = 0
    for _, record in _records(tested):
        rows = tested.left[first : first + record.noise.size].reshape(-1, record.omega.size)
        first += record.noise.size
        products += [(rows[:, lag:] * rows[:, :-lag]).ravel() for lag in range(1, _NEIGHBORS + 1)]
    all_ = np.concatenate(products)
    size = float(np.sqrt(all_ @ all_))
    statistic = float(all_.sum()) / size if size > 0 else 0.0
    p_value = float(stats.norm.sf(statistic))
    return FTest("neighbors", statistic, 1, p_value, max(statistic, 0.0) ** 2, p_value)
