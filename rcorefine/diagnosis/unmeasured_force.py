"""Unmeasured force (process noise) as the cause of a residual."""

from __future__ import annotations

import numpy as np

from ..inference.fitted import FittedModel
from ..inference.levels import Levels
from .residual_tests import TestedResidual

__all__ = ["likely_forces"]

_SIZES = (0.002, 0.004, 0.008, 0.016, 0.032, 0.064, 0.128)  # ratios of the unmeasured to the measured force
_AT = ("everywhere", "inputs")


def likely_forces(
    fitted: FittedModel, free_run: TestedResidual, least: float, levels: Levels
) -> list[TestedResidual]:
    """Return the residuals with likely unmeasured forces, the best first.

    The force acts at the inputs or everywhere, with one of several sizes.

    Parameters
    ----------
    fitted : FittedModel
        Model at its minimum.
    free_run : TestedResidual
        Residual of its free run, without such a force.
    least : float
        Least gain in log-likelihood.
    levels : Levels
        Levels; within `force_size` of the best log-likelihood, a size is likely.

    Returns
    -------
    list of TestedResidual
        Residuals of the Kalman predictor; empty if no force gains more than `least`.
    """
    found: list[TestedResidual] = []
    for at in _AT:
        top = -np.inf
        for ratio in _SIZES:
            try:
                led = TestedResidual(fitted.forced(at), ratio)
            except (np.linalg.LinAlgError, ValueError):
                continue
            if np.isfinite(led.log_likelihood):
                found.append(led)
                top = max(top, led.log_likelihood)
            if not led.log_likelihood >= top - 3 * levels.force_size:
                break  # larger forces are still less likely
    best = max((led.log_likelihood for led in found), default=-np.inf)
    if best <= free_run.log_likelihood + least:
        return []
    near = [led for led in found if led.log_likelihood >= best - levels.force_size]
    return sorted(near, key=lambda led: -led.log_likelihood)
