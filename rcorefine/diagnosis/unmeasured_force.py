"""A force that nobody measured, of unknown size, at the inputs or everywhere, as the cause of a residual."""

from __future__ import annotations

import numpy as np

from ..inference.fitted import FittedModel
from ..inference.levels import Levels
from .residual_tests import TestedResidual

__all__ = ["likely_forces"]

_SIZES = (0.002, 0.004, 0.008, 0.016, 0.032, 0.064, 0.128)  # over the measured force
_AT = ("everywhere", "inputs")


def likely_forces(
    fitted: FittedModel, free_run: TestedResidual, least: float, levels: Levels
) -> list[TestedResidual]:
    """The residual led by each unmeasured force that it may speak of, the likeliest first.

    Parameters
    ----------
    fitted : FittedModel
        Model at its minimum.
    free_run : TestedResidual
        Its residual without such a force.
    least : float
        Log-likelihood that the force must earn.
    levels : Levels
        Of the size.

    Returns
    -------
    list of TestedResidual
        Empty where none earns as much.
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
                break  # it only falls from here
    best = max((led.log_likelihood for led in found), default=-np.inf)
    if best <= free_run.log_likelihood + least:
        return []
    near = [led for led in found if led.log_likelihood >= best - levels.force_size]
    return sorted(near, key=lambda led: -led.log_likelihood)
