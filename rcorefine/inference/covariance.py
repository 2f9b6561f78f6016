"""Covariance of an estimate with colored residuals.

The module also finds the directions that the data do not determine.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import stats
from scipy.signal import lfilter

from ..data.signals import measured, over_time
from ..systems.linear import Array
from .whitening import RESOLUTION, autoregression, readings, stable_model, white_part

_UNSEEN = 1e-7  # singular value of the Jacobian with unit columns below which a direction is not determined
_AWAY = 2.0  # increase of the power of a residual that only an error of the model explains
_ROUNDS, _ALIKE = 30, 0.03  # most iterations of a noise model; change in standard errors that ends them


@dataclass(frozen=True, slots=True, eq=False)
class Uncertainty:
    """Covariance of all unknowns and what was found on the way.

    Attributes
    ----------
    covariance : ndarray, shape (p, p)
        Covariance; infinite variance where the data see nothing.
    noise : ndarray, shape (n_y,)
        Residual standard deviation of each output.
    condition : float
        Condition number of the Jacobian with unit columns.
    unseen : ndarray, shape (r, p)
        Directions (unit-column coordinates) that the data cannot see.
    """

    covariance: Array
    noise: Array
    condition: float
    unseen: Array


def pseudo_inverse(normal: Array, size: Array | None = None) -> tuple[Array, Array, float]:
    """Inverse of an information matrix on what the data see.

    Parameters
    ----------
    normal : ndarray, shape (p, p)
        J'J with the priors; unknowns in any units.
    size : ndarray, shape (p,), optional
        Norms of the columns; by default those that the matrix tells.

    Returns
    -------
    inverse : ndarray, shape (p, p)
        Zero along what is not seen.
    lost : ndarray, shape (r, p)
        Directions that are not seen, for unknowns in units of their own; an entry is zero where
        the unknown takes no part.
    condition : float
        Condition number of the Jacobian with unit columns.

    Examples
    --------
    Two coefficients of which the data see only the sum:

    >>> inverse, lost, _ = pseudo_inverse(np.ones((2, 2)))
    >>> print(inverse.round(2), np.abs(lost).round(2))
    [[0.25 0.25]
     [0.25 0.25]] [[0.71 0.71]]
    """
    values, vectors, seen, size = _directions(normal, size)
    top = values.max(initial=0.0)
    # inverse on the span that the data see, in the original units
    inverse = (vectors[:, seen] / values[seen]) @ vectors[:, seen].T / np.outer(size, size)
    lost = vectors[:, ~seen].T
    lost = np.where(np.abs(lost) > 1e-3, lost, 0.0)  # rounding errors become zero
    return inverse, lost / size, float(np.sqrt(top / max(values.min(initial=top), 1e-300)))


def unmoved(normal: Array, point: Array, home: Array) -> Array:
    """A point with what the data do not see as it is at another one.

    Parameters
    ----------
    normal : ndarray, shape (p, p)
        J'J with the priors.
    point, home : ndarray, shape (p,)
        Where a fit ended, and where it would be without data.

    Examples
    --------
    Two coefficients of which the data see only the sum:

    >>> print(unmoved(np.ones((2, 2)), np.array([1e6 + 1, -1e6]), np.zeros(2)).round(6))
    [0.5 0.5]
    """
    _, vectors, seen, size = _directions(normal)
    # along unseen directions back to the prior point
    lost = vectors[:, ~seen]
    return np.asarray(point - lost @ (lost.T @ ((point - home) * size)) / size)


def _directions(normal: Array, size: Array | None = None) -> tuple[Array, Array, NDArray[np.bool_], Array]:
    """Return the eigenvalues and eigenvectors for columns of unit norm.

    Also return which of them the data determine, and the norms of the columns.
    """
    # columns of unit norm, so that units do not matter
    size = np.sqrt(np.diag(normal)) if size is None else size
    size = np.where(size <= 1e-100 * size.max(initial=0.0), 1.0, size)  # a column that is zero
    values, vectors = np.linalg.eigh(normal / np.outer(size, size))
    return values, vectors, values > _UNSEEN**2 * values.max(initial=0.0), size


def covariance(normal: Array, middle: Array | None = None, size: Array | None = None) -> Array:
    """Covariance of a least-squares estimate.

    Parameters
    ----------
    normal : ndarray, shape (p, p)
        J'J with the priors.
    middle : ndarray, shape (p, p), optional
        Covariance of the gradient J'r; by default `normal`, right for white residuals of unit variance.
    size : ndarray, shape (p,), optional
        As of `pseudo_inverse`.

    Returns
    -------
    ndarray, shape (p, p)
        ``B^-1 M B^-1`` with B = normal and M = middle; infinite variance where the data see nothing.
    """
    inverse, lost, _ = pseudo_inverse(normal, size)
    # sandwich estimate B^-1 M B^-1
    found = inverse if middle is None else inverse @ middle @ inverse
    blind = np.flatnonzero(np.any(lost, axis=0))
    found[blind, blind] = np.inf
    return np.asarray(found)


def standard_deviations(covariance: Array) -> Array:
    """Of each unknown, shape (p,)."""
    return np.sqrt(np.maximum(np.diag(covariance), 0.0))


def wald(difference: Array, covariance: Array) -> float:
    """Return the p-value of a difference (Wald test).

    Entries that the data do not determine are left out.

    Parameters
    ----------
    difference : ndarray, shape (p,)
        Of two estimates, or of one from what it should be.
    covariance : ndarray, shape (p, p)
        Its covariance.
    """
    seen = np.isfinite(np.diag(covariance)) & np.isfinite(difference)
    d, C = difference[seen], covariance[np.ix_(seen, seen)]
    inverse, _, _ = pseudo_inverse(C)
    # d' C^-1 d is chi-squared distributed
    return float(stats.chi2.sf(d @ inverse @ d, d.size)) if d.size else 1.0


def colored(
    residuals: Sequence[Array],
    jacobians: Sequence[Array],
    precision: Array,
    order: int | None = None,
    columns: Sequence[Any] | None = None,
) -> tuple[Array, Array]:
    """Return the information matrix and the covariance of the gradient.

    They belong to a plain sum of squares of colored residuals.

    Parameters
    ----------
    residuals : sequence of ndarray, each of shape (n_y, N)
        Residuals per record, in units of the noise.
    jacobians : sequence of ndarray, each of shape (n_y, N, p)
        Jacobians of the same.
    precision : ndarray, shape (p,)
        One over the prior variance (0 for none).
    order : int, optional
        Of the model of the residuals, as of `autoregression`.
    columns : sequence of ndarray of int, optional
        Unknowns that each record's Jacobian is by, where it is not by all of them.

    Returns
    -------
    normal, middle : ndarray, shape (p, p)
        J'J and J'RJ with the priors, R the covariance of the residual as an autoregressive model
        per output sees it.
    """
    normal, middle = np.diag(precision.astype(float)), np.diag(precision.astype(float))
    residuals, jacobians = _readings(residuals, jacobians)
    at = [np.arange(precision.size)] * len(jacobians) if columns is None else columns
    for i, (a, variance) in enumerate(_noise_models(residuals, jacobians, precision, order, at)):
        a, variance = stable_model(a, variance)
        for jacobian, own in zip(jacobians, at, strict=True):
            J = np.nan_to_num(jacobian[i])
            # J' R J: filter the columns backward in time by 1 / A(z), then square
            backwards = J if a.size == 1 else lfilter([1.0], a, J[::-1], axis=0)
            normal[np.ix_(own, own)] += J.T @ J
            middle[np.ix_(own, own)] += variance * (backwards.T @ backwards)
    return normal, middle


def _noise_models(
    residuals: Sequence[Array],
    jacobians: Sequence[Array],
    precision: Array,
    order: int | None,
    at: Sequence[Any],
) -> list[tuple[Array, float]]:
    """Return the autoregressive model of the errors of each output.

    A fit takes a part of the errors, above all of slow ones, so its residual is smaller and whiter.
    Restricted maximum likelihood allows for that, by expectation maximization with the unknowns as missing
    data (Laird and Ware, Biometrics 38 (1982) 963). The orders are those of the residuals.
    """
    joined, count = list(map(np.concatenate, zip(*residuals, strict=True))), measured(residuals)
    # degrees of freedom that the fit has used
    correction = count / max(count - precision.size, 1)
    models = [autoregression(row, order=order) for row in joined]
    joined = [row - np.nanmean(row) for row in joined]
    # start: models of the residuals as they are
    models = [(a, variance * correction) for a, variance in models]
    # least variance of an output whose residual is not rounding
    least = RESOLUTION**2 * max(variance for _, variance in models)
    noisy = {i: model for i, model in enumerate(models) if model[1] > least}
    for _ in range(_ROUNDS * bool(noisy)):
        # expectation: change of the unknowns, and the residual that it leaves
        shift, roots = _shift_unknowns(noisy, residuals, jacobians, precision, at)
        left = {i: joined[i] - _moved(i, jacobians, shift, at) for i in noisy}
        if any(np.nansum(row**2) > _AWAY * np.nansum(joined[i] ** 2) for i, row in left.items()):
            break
        # maximization: the noise model of each output
        before, change = dict(noisy), 0.0
        for i, (a, variance) in before.items():
            unsure = np.concatenate([J[i] @ root for J, root in zip(jacobians, roots, strict=True)])
            noisy[i] = autoregression(left[i], order=a.size - 1, unsure=unsure)
            change = max(change, float(np.abs(noisy[i][0] - a).max()), abs(noisy[i][1] / variance - 1.0))
        if change * np.sqrt(max(map(len, joined))) < _ALIKE:
            break
    return [noisy.get(i, model) for i, model in enumerate(models)]


def _moved(output: int, jacobians: Sequence[Any], shift: Array, at: Sequence[Any]) -> Array:
    """Return how a change of the unknowns changes the residual of an output."""
    return np.concatenate([J[output] @ shift[own] for J, own in zip(jacobians, at, strict=True)])


def _shift_unknowns(
    models: dict[int, tuple[Array, float]],
    residuals: Sequence[Array],
    jacobians: Sequence[Array],
    precision: Array,
    at: Sequence[Any],
) -> tuple[Array, list[Array]]:
    """Return how far generalized least squares moves the unknowns.

    Roots of the covariance of the unknowns that each record feels come with it. `models` holds those of
    outputs.
    """
    normal, slope = np.diag(precision.astype(float)), np.zeros(precision.size)
    for i, (a, variance) in models.items():
        for r, J, own in zip(residuals, jacobians, at, strict=True):
            # whiten residual and Jacobian by A(z) of the output
            left, white = (white_part(a, x[i]) for x in (r, J))
            normal[np.ix_(own, own)] += white.T @ white / variance
            slope[own] += white.T @ left / variance
    inverse, _, _ = pseudo_inverse(normal)
    size, roots = np.sqrt(np.maximum(np.diag(inverse), 1e-300)), []
    for own in at:
        # root of the covariance of the record's own unknowns, by eigenvalues in units of their own
        values, vectors = np.linalg.eigh(inverse[np.ix_(own, own)] / np.outer(size[own], size[own]))
        roots.append(size[own, None] * vectors * np.sqrt(np.maximum(values, 0.0)))
    return inverse @ slope, roots


def parameter_uncertainty(
    residuals: Sequence[Array],
    jacobians: Sequence[Array],
    precision: Array,
    order: int | None = None,
    columns: Sequence[Any] | None = None,
) -> Uncertainty:
    """Return the covariance of a plain least-squares estimate.

    The residual may be colored. If it is white, this is the Cramer-Rao bound ``sigma^2 (J'J)^-1``.
    The parameters are those of `colored`.
    """
    joined, count = np.concatenate(residuals, axis=1), measured(residuals)
    normal, middle = colored(residuals, jacobians, precision, order, columns)
    _, lost, condition = pseudo_inverse(normal)
    # standard deviation with the degrees of freedom of the fit
    noise = np.sqrt(over_time(np.mean, joined**2) * count / max(count - precision.size, 1))
    return Uncertainty(covariance(normal, middle), noise, condition, lost)


def _readings(residuals: Sequence[Any], jacobians: Sequence[Any]) -> tuple[Sequence[Any], Sequence[Any]]:
    """Return residuals and Jacobians at the readings of slow sensors."""
    _, steps = readings(residuals)
    if steps is None:
        return residuals, jacobians
    phases = [[int(np.isnan(row).argmin()) for row in block] for block in residuals]
    return tuple(
        [
            [row[first::step] for row, first, step in zip(block, firsts, steps, strict=True)]
            for block, firsts in zip(blocks, phases, strict=True)
        ]
        for blocks in (residuals, jacobians)
    )  # type: ignore[return-value]


def unseen_combinations(
    uncertainty: Uncertainty,
    theta: Array,
    names: Sequence[str],
    spread: Array,
    settled: NDArray[np.bool_] | None = None,
) -> list[str]:
    """Return sentences on combinations that the record does not determine.

    Parameters
    ----------
    uncertainty : Uncertainty
        Of the estimate.
    theta : ndarray, shape (p,)
        Coefficients.
    names : sequence of str
        Their names.
    spread : ndarray, shape (p,)
        Their standard deviations.
    settled : ndarray of bool, shape (p,), optional
        Nuisances that have priors: which of them it is settles nothing else.

    Returns
    -------
    list of str
        One sentence per combination, empty where the record sees everything.
    """
    p = theta.size
    found = []
    for part in uncertainty.unseen[:, :p]:
        if not part.any():
            continue
        largest = int(np.argmax(np.abs(part)))
        part = part / part[largest]
        terms = [f"{part[i]:+.3g} x {names[int(i)]}" for i in np.flatnonzero(np.abs(part) > 1e-3)]
        found.append(
            f"the record contains no information about {names[largest]}"
            if len(terms) == 1
            else f"the record does not determine the combination {' '.join(terms)}, only the rest"
        )
    # pairs of uncertain coefficients with a correlation near one
    C = uncertainty.covariance[:p, :p]
    sd = standard_deviations(C)
    loose = np.isfinite(sd) & (sd > 0) & (np.abs(theta) < 2 * spread)
    held = np.zeros(p, dtype=bool) if settled is None else settled[:p]
    for i, j in np.argwhere(np.tri(p, k=-1)).tolist():
        if not (loose[i] and loose[j]) or (held[i] and held[j]):
            continue
        rho, slope = C[i, j] / (sd[i] * sd[j]), C[i, j] / C[j, j]
        if abs(rho) > 0.995:
            found.append(
                f"{names[j]} and {names[i]} cannot be distinguished (correlation {rho:+.4f}): the record "
                f"determines {names[i]} {'-' if slope > 0 else '+'} {abs(slope):.3g} x {names[j]}"
            )
    return found
