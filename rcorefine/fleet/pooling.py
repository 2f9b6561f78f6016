"""Pooling of one coefficient over many machines, and its trends over time.

It gives the mean, the spread between machines, and the machines that stand out. The model is that of a
meta-analysis with random effects: machine i has the coefficient mu + b_i, b_i of variance tau^2, and its
estimate has an error of known variance v_i besides. tau^2 is that of DerSimonian and Laird (Controlled
Clinical Trials 7, 1986, 177-188), the error of mu that of Hartung and Knapp (Statistics in Medicine 20, 2001,
3875-3889), never smaller than the plain one.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import stats

from ..arguments import Array

#: Machines from which on one can be told from the others: three that it is compared with.
LEAST = 4
#: Records of one machine from which on a line through them leaves something over.
LEAST_TIMES = 3
#: Times, estimates and their variances, one each per record of a machine.
Course = tuple[Array, Array, Array]
_TOGETHER = 20  # machines that hide each other, at most


@dataclass(frozen=True, slots=True)
class Pooled:
    """Mean and spread of several estimates of one coefficient.

    Attributes
    ----------
    mean, std : float
        Mean over the machines, and its standard error.
    spread : float
        Standard deviation between machines, beyond the errors of the estimates.
    p_value : float
        Of a mean of zero.
    p_alike : float
        Of estimates as different as these where all machines have the same coefficient
        (Cochran's Q); 1 for a single one.
    """

    mean: float
    std: float
    spread: float
    p_value: float
    p_alike: float


def pool(values: Array, variances: Array) -> Pooled:
    """Pool estimates of one coefficient.

    Parameters
    ----------
    values, variances : ndarray, shape (k,)
        Estimates and their variances, positive.

    Returns
    -------
    Pooled

    Examples
    --------
    >>> import numpy as np
    >>> found = pool(np.array([1.0, 3.0]), np.array([0.5, 0.5]))
    >>> found.mean, round(found.spread**2, 12)
    (2.0, 1.5)
    """
    weights = 1.0 / variances
    dof = values.size - 1
    if dof == 0:
        std = float(np.sqrt(variances[0]))
        return Pooled(float(values[0]), std, 0.0, float(2 * stats.norm.sf(abs(values[0]) / std)), 1.0)
    fixed = np.average(values, weights=weights)
    q = float(weights @ (values - fixed) ** 2)
    # sum of w less sum of w^2 over it, by pairs: no difference where one estimate is exact beside the others
    pairs = weights @ (1.0 - np.eye(dof + 1)) @ weights
    between = max(0.0, (q - dof) * weights.sum() / pairs)
    weights = 1.0 / (variances + between)
    mean = float(np.average(values, weights=weights))
    factor = max(1.0, float(weights @ (values - mean) ** 2) / dof)
    std = float(np.sqrt(factor / weights.sum()))
    p_value = float(2 * stats.t.sf(abs(mean) / std, dof))
    return Pooled(mean, std, float(np.sqrt(between)), p_value, float(stats.chi2.sf(q, dof)))


def shrunk(values: Array, variances: Array, common: Pooled) -> tuple[Array, Array]:
    """Return estimates shrunk toward the mean by partial pooling.

    The larger the error of an estimate, the more it is shrunk.

    Parameters
    ----------
    values, variances : ndarray, shape (k,)
        As in `pool`.
    common : Pooled
        Their mean and spread.

    Returns
    -------
    values, std : ndarray, shape (k,)
        Best linear predictions of each machine's coefficient, and their standard deviations.
    """
    own = common.spread**2 / (common.spread**2 + variances)
    found = own * values + (1.0 - own) * common.mean
    return found, np.sqrt(own * variances + (1.0 - own) ** 2 * common.std**2)


def deviations(values: Array, variances: Array, core: NDArray[np.bool_]) -> tuple[Array, Array]:
    """Return the standardized deviation of each machine from the others.

    Parameters
    ----------
    values, variances : ndarray, shape (k,)
        As in `pool`.
    core : ndarray of bool, shape (k,)
        Machines that are the others; each is left out where it is compared itself. Three at least.

    Returns
    -------
    deviation : ndarray, shape (k,)
        Difference to the mean of the others, over the root of the variances of the estimate, between
        machines, and of that mean.
    p_value : ndarray, shape (k,)
        Two-sided, by Student's t with as many degrees of freedom as there are others, less one.
    """
    values = values - np.average(values[core], weights=1.0 / variances[core])  # sums below lose no digits
    weights = np.where(core, 1.0 / variances, 0.0)
    others = core.sum() - core

    def left(terms: Array) -> Array:
        return np.asarray(terms.sum() - terms)

    total, squares = left(weights), left(weights**2)
    q = left(weights * values**2) - left(weights * values) ** 2 / total
    between = np.maximum(0.0, (q - (others - 1)) / (total - squares / total))
    # the mean takes one spread for all: leaving a machine out changes the weights of the rest hardly
    spread = pool(values[core], variances[core]).spread
    weights = np.where(core, 1.0 / (variances + spread**2), 0.0)
    total = left(weights)
    mean = left(weights * values) / total
    of_mean = (left(weights**2 * variances) + between * left(weights**2)) / total**2
    found = (values - mean) / np.sqrt(variances + between + of_mean)
    return found, np.asarray(2 * stats.t.sf(np.abs(found), others - 1))


def standing_out(values: Array, variances: Array, level: float) -> NDArray[np.bool_]:
    """Machines whose coefficient is another than that of the rest.

    The one that is farthest from the others goes first, then the next, as long as chance does not explain
    it (Bonferroni over the machines). Where none does, several may hide each other: then the
    2, 3, ... that are farthest from the median are compared with the rest (Bonferroni over all such sets).

    Parameters
    ----------
    values, variances : ndarray, shape (k,)
        As in `pool`.
    level : float
        Probability that any stands out where all are drawn from one normal distribution.

    Returns
    -------
    ndarray of bool, shape (k,)
        Less than half of them, and three or more remain; none of fewer than four machines.
    """
    count = values.size
    core = np.ones(count, dtype=bool)
    most = min((count - 1) // 2, count - LEAST + 1)
    _take_out(values, variances, core, level / 2, most)
    if core.all() and most > 1:
        away = np.abs(values - np.median(values))
        robust = max(0.0, (1.4826 * float(np.median(away))) ** 2 - float(np.median(variances)))
        order = np.argsort(-away / np.sqrt(variances + robust), kind="stable")
        for r in range(2, min(most, _TOGETHER) + 1):
            rest = core.copy()
            rest[order[:r]] = False
            _, p_values = deviations(values, variances, rest)
            if p_values[order[:r]].max() * math.comb(count, r) <= level / 2**r:
                _take_out(values, variances, rest, level / 2, most)
                return ~rest
    return ~core


def _take_out(values: Array, variances: Array, core: NDArray[np.bool_], level: float, most: int) -> None:
    """Remove machines from the core that the others do not explain.

    They are removed one after the other, the most significant first.
    """
    while core.size - core.sum() < most:
        _, p_values = deviations(values, variances, core)
        first = int(np.argmin(np.where(core, p_values, np.inf)))
        if p_values[first] * core.sum() > level:
            return
        core[first] = False


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
