"""Trends of coefficients over time, as a straight line per machine."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy import stats

from ..systems.linear import Array

__all__ = ["LEAST", "Course", "slopes"]

#: Records of one machine from which on a line through them leaves something over.
LEAST = 3

#: Times, estimates and their variances, one each per record of a machine.
Course = tuple[Array, Array, Array]


def slopes(courses: Sequence[Course]) -> tuple[Array, Array, Array]:
    """Return the slope of one coefficient over time for each machine.

    The line through the records of a machine is fitted by weighted least squares.

    Parameters
    ----------
    courses : sequence of (times, values, variances)
        One per machine, three records or more at different times each.

    Returns
    -------
    slope, std, p_value : ndarray, shape (number of machines,)
        The p-value is two-sided, for this machine alone. How far the records scatter beyond their errors
        is one factor for all machines (1 at least), estimated from what the lines leave over, with
        as many degrees of freedom: the analysis of covariance.
    """
    slope, std, left, dof = [], [], 0.0, 0
    for times, values, variances in courses:
        weights = 1.0 / variances
        t = times - np.average(times, weights=weights)
        y = values - np.average(values, weights=weights)
        square = float(weights @ t**2)
        slope.append(float(weights @ (t * y)) / square)
        std.append(square**-0.5)
        left += float(weights @ (y - slope[-1] * t) ** 2)
        dof += times.size - 2
    factor = np.sqrt(max(1.0, left / dof)) if dof else 1.0
    found, error = np.array(slope), factor * np.array(std)
    return found, error, np.asarray(2 * stats.t.sf(np.abs(found) / error, max(dof, 1)))
