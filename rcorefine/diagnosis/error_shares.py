"""Share of the measured motion that a model leaves."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ..inference.f_tests import FTest
from ..results import Row
from ..systems.linear import Array
from .noise import rounding_step
from .residual_tests import TestedResidual


@dataclass(frozen=True, slots=True)
class ErrorShare(Row):
    """Error of a model at one output, as shares of its spread.

    Attributes
    ----------
    output : str
        Output.
    share : float
        Root mean square error of the free run.
    model : float
        At most this much of it is an error of the model: the part that the past of the residual predicts,
        and what the residual tests find. Colored noise of a sensor counts, too.
    step : float
        Rounding step of the sensor, 0 if the record is not rounded.
    """

    output: str
    share: float
    model: float
    step: float


def matter(rows: Sequence[ErrorShare], least: float) -> bool:
    """Return whether an error of a model is too large at some output.

    Too large is what exceeds a share of the spread and the step of the sensor.
    """
    return any(row.model > max(least, row.step) for row in rows)


def in_percent(share: float) -> str:
    """Write a share in percent with two digits."""
    return f"{float(f'{100.0 * share:.2g}'):g} %"


def error_shares(
    tested: TestedResidual, tests: Sequence[FTest], significance: float
) -> tuple[ErrorShare, ...]:
    """Return what a model leaves of each output of its records.

    Parameters
    ----------
    tested : TestedResidual
        Residual of the model in free run.
    tests : sequence of FTest
        Its residual tests.
    significance : float
        Level of one test, below which what it finds is an error of the model.

    Returns
    -------
    tuple of ErrorShare
        Empty for frequency responses.

    Notes
    -----
    The residual r has variance s^2 and its autoregressive model the innovation variance s_e^2 [1]_. A model
    error that is slow against the samples is predictable, s^2 - s_e^2; one that is not is found by the
    tests: of N innovations with the sum of squares N, the columns of a test take away its gain. With both,
    ``s^2 - s_e^2 (1 - sum of gains / N)`` bounds the power of the error, where the noise is white.

    References
    ----------
    .. [1] L. Ljung, System Identification, 2nd ed., Prentice Hall, 1999, chapter 16.
    """
    fitted = tested.fitted
    problem = fitted.problem
    # a frequency response has no motion of its own
    if not problem.in_time:
        return ()
    weights = problem.weights[:, None]
    left = [block / weights for block in fitted.residuals(tested.ratio)]
    outputs = [record.outputs for record in problem.records]
    # innovations in the units of the outputs
    innovations = tested.whitener.scales / problem.weights
    labels = fitted.refinement.physical_model.linear.output_labels
    return error_shares_of(labels, left, outputs, innovations, found_share(tested, tests, significance))


def found_share(tested: TestedResidual, tests: Sequence[FTest], significance: float) -> float:
    """Return the share of the innovations' power that the tests find.

    Parameters
    ----------
    tested, tests, significance
        As for `error_shares`.
    """
    # what the tests explain beyond chance: gain minus its degrees of freedom
    gains = sum(max(test.gain - test.dof, 0.0) for test in tests if test.p_value < significance)
    return min(gains / max(tested.residual.size, 1), 1.0)


def error_shares_of(
    labels: Sequence[str], left: Sequence[Array], outputs: Sequence[Array], innovations: Array, found: float
) -> tuple[ErrorShare, ...]:
    """Return what is left of each output.

    Parameters
    ----------
    labels : sequence of str
        Names of the outputs.
    left : sequence of ndarray, shape (n_y, N)
        Residuals of each record, in units of the outputs.
    outputs : sequence of ndarray, shape (n_y, N)
        Measured outputs that have the spread, of the same records or of more.
    innovations : ndarray, shape (n_y,)
        Standard deviations of the innovations of the residuals.
    found : float
        Share of the power of the innovations that is no noise.

    Returns
    -------
    tuple of ErrorShare
    """
    # power of the residual without the innovations, plus what the tests find in these
    residual, measured = np.hstack(left), np.hstack(outputs)
    power, white = np.mean(residual**2, axis=1), innovations**2
    model = np.maximum(power - white, 0.0) + white * found
    # relative to the spread of the output
    spread = measured.std(axis=1)
    size = np.where(spread > 0, spread, np.inf)
    shares = np.sqrt(np.array([power, np.minimum(model, power)])) / size
    steps = np.array([rounding_step(row) for row in measured]) / size
    rows = zip(labels, *shares, steps, strict=True)
    return tuple(ErrorShare(name, float(a), float(b), float(c)) for name, a, b, c in rows)
