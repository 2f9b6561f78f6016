"""How sure the estimate is: covariance under coloured residuals, and what the data cannot see."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.signal import lfilter

from ..systems.linear import Array
from .autoregression import autoregression, stable_model

__all__ = ["Uncertainty", "parameter_uncertainty", "unseen_combinations"]

_UNSEEN = 1e-7  # singular value of the unit-column Jacobian below which a direction is not seen


@dataclass(frozen=True, slots=True, eq=False)
class Uncertainty:
    """Covariance of all unknowns and what was found on the way.

    Attributes
    ----------
    covariance : ndarray, shape (p, p)
        Covariance; infinite variance where the data see nothing.
    orders : tuple of int
        Order of the autoregressive model of the residual of each output (0: white).
    noise : ndarray, shape (n_y,)
        Residual standard deviation of each output.
    condition : float
        Condition number of the Jacobian with unit columns.
    unseen : ndarray, shape (r, p)
        Directions (unit-column coordinates) that the data cannot see.
    """

    covariance: Array
    orders: tuple[int, ...]
    noise: Array
    condition: float
    unseen: Array


def parameter_uncertainty(
    residuals: Sequence[Array], jacobians: Sequence[Array], prior_precision: Array
) -> Uncertainty:
    """Covariance of a least-squares estimate whose residual may be coloured.

    The estimate minimizes the plain sum of squares; its covariance is
    ``B^-1 (J' R J) B^-1`` with ``B = J'J`` and R the covariance of the residual as an
    autoregressive model per output sees it. For white residuals it is the Cramer-Rao
    bound ``sigma^2 (J'J)^-1``.

    Parameters
    ----------
    residuals : sequence of ndarray, each of shape (n_y, N)
        Residuals per record, in units of the noise.
    jacobians : sequence of ndarray, each of shape (n_y, N, p)
        Jacobians of the same.
    prior_precision : ndarray, shape (p,)
        One over the prior variance (0 for none).

    Returns
    -------
    Uncertainty
    """
    p = jacobians[0].shape[2]
    outputs = residuals[0].shape[0]
    joined = [np.concatenate([r[i] for r in residuals]) for i in range(outputs)]
    filters = [stable_model(*autoregression(joined[i])) for i in range(outputs)]
    n_points = sum(r.size for r in residuals)
    correction = n_points / max(n_points - p, 1)
    B = np.diag(prior_precision.astype(float))
    middle = np.diag(prior_precision.astype(float))
    for jacobian in jacobians:
        for i in range(outputs):
            a, variance = filters[i]
            J = jacobian[i]
            B += J.T @ J
            if a.size == 1:
                middle += variance * correction * (J.T @ J)
            else:
                coloured = lfilter([1.0], a, J[::-1], axis=0)
                middle += variance * correction * (coloured.T @ coloured)
    size = np.sqrt(np.diag(B))
    size[size <= 1e-100 * size.max(initial=0.0)] = 1.0  # not felt at all: its squares would overflow
    values, vectors = np.linalg.eigh(B / np.outer(size, size))
    seen = values > _UNSEEN**2 * values[-1]
    inverse = (vectors[:, seen] / values[seen]) @ vectors[:, seen].T
    covariance = inverse @ (middle / np.outer(size, size)) @ inverse / np.outer(size, size)
    lost = vectors[:, ~seen].T
    lost = np.where(np.abs(lost) > 1e-3, lost, 0.0)  # no rounding beside what is truly lost
    for i in range(p):
        if np.any(lost[:, i]):
            covariance[i, i] = np.inf
    condition = float(np.sqrt(values[-1] / max(values[0], 1e-300)))
    noise = np.array([np.sqrt(np.mean(r**2) * correction) for r in joined])
    return Uncertainty(covariance, tuple(a.size - 1 for a, _ in filters), noise, condition, lost / size)


def unseen_combinations(
    uncertainty: Uncertainty, theta: Array, names: Sequence[str], spread: Array
) -> list[str]:
    """Sentences that name what the record cannot tell apart.

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

    Returns
    -------
    list of str
        One sentence per combination, empty where the record sees everything.
    """
    p = theta.size
    found = []
    for direction in uncertainty.unseen:
        part = direction[:p]
        if np.abs(part).max(initial=0) == 0:
            continue
        largest = int(np.argmax(np.abs(part)))
        part = part / part[largest]
        terms = [f"{part[i]:+.3g} x {names[int(i)]}" for i in np.flatnonzero(np.abs(part) > 1e-3)]
        if len(terms) == 1:
            found.append(f"the record does not see {names[largest]} at all")
        elif terms:
            found.append(
                f"the record does not see the combination {' '.join(terms)}: only the rest is determined"
            )
    covariance = uncertainty.covariance[:p, :p]
    sd = np.sqrt(np.maximum(np.diag(covariance), 0.0))
    for i in range(p):
        for j in range(i):
            if not (np.isfinite(sd[i]) and np.isfinite(sd[j]) and sd[i] > 0 and sd[j] > 0):
                continue
            rho = covariance[i, j] / (sd[i] * sd[j])
            loose = abs(theta[i]) < 2 * spread[i] and abs(theta[j]) < 2 * spread[j]
            if abs(rho) > 0.995 and loose:
                slope = covariance[i, j] / covariance[j, j]
                found.append(
                    f"{names[j]} and {names[i]} cannot be told apart (correlation {rho:+.4f}): the record "
                    f"determines {names[i]} {-slope:+.3g} x {names[j]}"
                )
    return found
