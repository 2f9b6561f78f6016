"""How well a refined model is known: the spread of its frequency response."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ..systems.linear import Array, LinearModel
from ..systems.response import frequency_response
from .coefficients.estimator import CoefficientFilter

__all__ = ["response_deviation", "variants"]

# Of a standard deviation: to first order, for directions that no sensor sees (a change of
# coordinates) have deviations that are large, and would bend the response.
_SHARE = 1e-4


def variants(part: CoefficientFilter) -> list[LinearModel]:
    """Models a little away, along each independent direction of the coefficients."""
    setup, memory = part.setup, part.memory
    covariance = part.covariance
    if memory.rounds == 0 or not covariance.size:
        return []
    # correlation first: coefficients of unlike size would hide one another
    size = np.sqrt(np.maximum(np.diag(covariance), 0.0))
    scale = np.where(size > 0, size, 1.0)
    values, directions = np.linalg.eigh(covariance / np.outer(scale, scale))
    steps = (directions * np.sqrt(np.maximum(values, 0.0))).T * scale
    return [
        setup.system(part.theta + _SHARE * step, memory.widths, "variant") for step in steps if step.any()
    ]


def response_deviation(center: LinearModel, around: Sequence[LinearModel], omega: Array) -> Array:
    """Standard deviation of the frequency response, shape (n_y, n_w, K), NaN beyond its Nyquist frequency.

    Parameters
    ----------
    center : LinearModel
        Estimated model.
    around : sequence of LinearModel
        What `variants` gives.
    omega : ndarray of shape (K,)
        Frequencies in rad/s.
    """
    seen = np.ones(omega.size, dtype=bool)
    if not center.is_continuous and center.dt is not None and center.dt is not True:
        seen = omega <= np.pi / float(center.dt)
    total = np.full((center.n_outputs, center.n_inputs, omega.size), np.nan)
    reference = frequency_response(center, omega[seen])
    total[:, :, seen] = 0.0
    for model in around:
        total[:, :, seen] += np.abs(frequency_response(model, omega[seen]) - reference) ** 2
    return np.asarray(np.sqrt(total) / _SHARE)
