"""Residual tests as plain functions on arrays.

Each test returns a table of statistics and p-values.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import control as ct
import numpy as np
from numpy.typing import ArrayLike
from scipy import stats

from ..inference.autoregression import autoregression
from ..inference.whitening import whitened
from ..results import Result
from ..systems.linear import Array
from .correlation import correlation, lag_count, residual_and_inputs, signal_names, signal_rows, standardized

__all__ = [
    "ResidualTest",
    "TestTable",
    "free_run_tests",
    "input_correlation",
    "portmanteau",
    "whiteness",
]


class ResidualTest(NamedTuple):
    """One test of one residual.

    Attributes
    ----------
    test : str
        What was tested.
    signal : str
        Output, or "input -> output".
    statistic : float
        Statistic, chi-squared with `dof` degrees of freedom if nothing is wrong.
    dof : int
        Degrees of freedom.
    p_value : float
        Probability of such a statistic if nothing is wrong.
    """

    test: str
    signal: str
    statistic: float
    dof: int
    p_value: float


@dataclass(frozen=True, slots=True, eq=False)
class TestTable(Result):
    """Residual tests, one row each.

    Attributes
    ----------
    rows : tuple of ResidualTest
        The tests.
    note : str
        What a failure means.
    """

    __test__ = False  # not a test for pytest

    rows: tuple[ResidualTest, ...]
    note: str

    @property
    def statistic(self) -> Array:
        """Statistics, shape (n_tests,)."""
        return np.array([row.statistic for row in self.rows])

    @property
    def p_value(self) -> Array:
        """Probabilities, shape (n_tests,)."""
        return np.array([row.p_value for row in self.rows])

    def failed(self, significance: float = 0.01) -> tuple[ResidualTest, ...]:
        """Rows that fail, allowing for their number (Holm).

        Parameters
        ----------
        significance : float
            Probability that a correct model fails any row.

        Returns
        -------
        tuple of ResidualTest
        """
        order = np.argsort(self.p_value, kind="stable")
        bad = []
        for rank, index in enumerate(order):
            if self.rows[index].p_value * (len(self.rows) - rank) > significance:
                break
            bad.append(self.rows[index])
        return tuple(bad)


def portmanteau(
    test: str, signal: str, x: Array, y: Array, lags: Sequence[int] | range, *, white: bool = False
) -> ResidualTest:
    """Sum of squared cross-correlations of whitened signals.

    Each lag is measured by the spread of its own products, for the size of one signal
    may go with that of the other where nothing is wrong.
    """
    if np.ptp(x) == 0.0 or np.ptp(y) == 0.0:
        return ResidualTest(test, signal, 0.0, len(lags), 1.0)  # a constant has nothing to correlate
    a, b = (x - x.mean(), y - y.mean()) if white else (whitened(x), whitened(y))
    n, q = min(a.size, b.size), 0.0
    a, b = a[-n:], b[-n:]  # each filter has its own past
    for lag in lags:
        products = a[: n - lag] * b[lag:] if lag >= 0 else a[-lag:] * b[: n + lag]
        q += float(products.sum() ** 2 / np.sum(products**2))
    return ResidualTest(test, signal, q, len(lags), float(stats.chi2.sf(q, len(lags))))


def whiteness(
    residual: ArrayLike, lags: int = 20, *, fitted: int = 0, labels: Sequence[str] | None = None
) -> TestTable:
    """Test whether a residual is white (Ljung and Box).

    For one-step predictions. The residual of a free run carries the color
    of the sensor noise, so there a failure says nothing: see
    `free_run_tests`.

    Parameters
    ----------
    residual : array_like of shape (N,) or (n_y, N)
        Residuals, time last.
    lags : int
        Number of lags.
    fitted : int
        Parameters of the noise model that were fitted to this residual.
    labels : sequence of str, optional
        Names of the residuals.

    Returns
    -------
    TestTable
        One row per output: Q = N (N + 2) sum_k r_k^2 / (N - k), chi-squared
        with lags - fitted degrees of freedom.

    Raises
    ------
    DataError
        If the residual is too short for the lags or not finite.

    References
    ----------
    Ljung, G. M. and Box, G. E. P., Biometrika 65 (1978) 297.

    Examples
    --------
    >>> e = np.random.default_rng(0).standard_normal(1000)
    >>> bool(whiteness(e).p_value[0] > 0.01), bool(whiteness(np.cumsum(e)).p_value[0] < 1e-9)
    (True, True)
    """
    e = signal_rows(residual, "residual")
    count = lag_count(lags, e.shape[1])
    if not 0 <= fitted < count:
        raise ct.ControlArgument(f"fitted = {fitted} must lie between 0 and lags - 1 = {count - 1}")
    n, steps = e.shape[1], np.arange(1, count + 1)
    found = []
    for name, row in zip(signal_names(labels, e.shape[0], "e"), e, strict=True):
        q = float(n * (n + 2) * np.sum(correlation(row, row, steps) ** 2 / (n - steps)))
        dof = count - fitted
        found.append(ResidualTest("whiteness", name, q, dof, float(stats.chi2.sf(q, dof))))
    return TestTable(
        tuple(found),
        "A residual that is not white can be predicted from its past. For one-step predictions this is a "
        "failure; for a simulation it may be colored noise.",
    )


def input_correlation(
    residual: ArrayLike,
    inputs: ArrayLike,
    lags: int = 25,
    *,
    at_once: bool = True,
    labels: Sequence[str] | None = None,
    input_labels: Sequence[str] | None = None,
) -> TestTable:
    """Test the residual for dependence on the inputs, and vice versa.

    Both signals are whitened first, each by its own autoregressive filter.
    That keeps cause and effect in order and makes the correlations
    independent, whatever the color of the noise (Haugh).

    Parameters
    ----------
    residual : array_like of shape (N,) or (n_y, N)
        Residuals, time last.
    inputs : array_like of shape (N,) or (n_w, N)
        Inputs over the same time.
    lags : int
        Largest lag.
    at_once : bool
        Whether the input can act in the sample in which it is applied. It
        cannot where it is held and D = 0; lag 0 is then left to feedback.
    labels, input_labels : sequence of str, optional
        Names.

    Returns
    -------
    TestTable
        Two rows per pair: "input" (lags 0 to `lags`: something that the
        model should have explained) and "feedback" (lags below 0: the
        residual runs ahead of the input, as in a closed loop).

    References
    ----------
    Haugh, L. D., J. Am. Statist. Assoc. 71 (1976) 378.

    Examples
    --------
    >>> rng = np.random.default_rng(1)
    >>> u, noise = rng.standard_normal((2, 2000))
    >>> table = input_correlation(noise + 0.5 * np.roll(u, 2), u)
    >>> [bool(p < 0.01) for p in table.p_value]
    [True, False]
    """
    e, u = residual_and_inputs(residual, inputs)
    count, first = lag_count(lags, e.shape[1] // 2), 0 if at_once else 1
    rows = []
    for out, row in zip(signal_names(labels, e.shape[0], "e"), e, strict=True):
        for source, drive in zip(signal_names(input_labels, u.shape[0], "u"), u, strict=True):
            pair = f"{source} -> {out}"
            rows.append(portmanteau("input", pair, drive, row, range(first, count + 1)))
            rows.append(portmanteau("feedback", f"{out} -> {source}", drive, row, range(-count, first)))
    return TestTable(
        tuple(rows),
        "input: the residual depends on the input, so linear dynamics are missing in the model. feedback: "
        "the input depends on the residual, so the record was taken in closed loop.",
    )


_SHAPES: tuple[tuple[str, Callable[[Array], Array]], ...] = (
    ("input", lambda w: w),
    ("size of the input", np.abs),
    ("input cubed", lambda w: w**3),
)


def free_run_tests(
    residual: ArrayLike,
    inputs: ArrayLike,
    lags: int = 25,
    *,
    at_once: bool = True,
    labels: Sequence[str] | None = None,
    input_labels: Sequence[str] | None = None,
) -> TestTable:
    """Tests that a free-run residual must pass; colored noise passes them.

    Parameters
    ----------
    residual : array_like of shape (N,) or (n_y, N)
        Measured minus simulated, time last.
    inputs : array_like of shape (N,) or (n_w, N)
        Inputs over the same time.
    lags : int
        Largest lag.
    at_once : bool
        Whether the input can act in the sample in which it is applied. It
        cannot where it is held and D = 0; the lags then start at 1.
    labels, input_labels : sequence of str, optional
        Names.

    Returns
    -------
    TestTable
        Rows: "mean" (the residual has an offset), "input", "size of the
        input", "input cubed" (it follows the input, or its powers), and
        "steadiness" (its level changes with time). Whiteness is not among
        them, for a correct model leaves the noise as it is.

    Examples
    --------
    >>> from scipy.signal import lfilter
    >>> rng = np.random.default_rng(0)
    >>> u, e = rng.standard_normal((2, 4000))
    >>> noise = lfilter([1], [1, -0.9], e)
    >>> len(free_run_tests(noise, u).failed()), bool(whiteness(noise).p_value[0] < 1e-9)
    (0, True)
    """
    e, u = residual_and_inputs(residual, inputs)
    every = range(0 if at_once else 1, lag_count(lags, e.shape[1] // 2) + 1)
    rows = []
    for out, row in zip(signal_names(labels, e.shape[0], "e"), e, strict=True):
        if np.ptp(row) == 0.0:
            continue
        rows += [_mean(out, row), _steadiness(out, row)]
        for source, drive in zip(signal_names(input_labels, u.shape[0], "u"), u, strict=True):
            if np.ptp(drive) == 0.0:
                continue
            for name, shape in _SHAPES:
                rows.append(portmanteau(name, f"{source} -> {out}", shape(standardized(drive)), row, every))
    return TestTable(
        tuple(rows),
        "mean: the residual has an offset. input, its size or its cube: the residual depends on the input. "
        "steadiness: the error is larger at some times. Colored noise passes these tests.",
    )


def _mean(name: str, e: Array) -> ResidualTest:
    """Mean against its standard error, the color of the residual allowed for."""
    a, variance = autoregression(e)
    long_run = np.sqrt(variance) / abs(a.sum())
    z = float(e.mean() / (long_run / np.sqrt(e.size)))
    return ResidualTest("mean", name, z**2, 1, float(stats.chi2.sf(z**2, 1)))


def _steadiness(name: str, e: Array) -> ResidualTest:
    """Test whether the innovations have the same level in equal blocks.

    The test is Levene's, about the median.
    """
    blocks = 8
    parts = np.array_split(whitened(e), blocks)
    f, p = stats.levene(*parts, center="median")
    return ResidualTest("steadiness", name, float(f * (blocks - 1)), blocks - 1, float(p))
