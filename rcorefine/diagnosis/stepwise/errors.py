"""The error by which the steps of a ladder are judged."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from ...comparison.compare import compare
from ...data.channels import match_channels, record_for
from ...data.measurement import Measurement
from ...data.response_record import in_frequency
from ...engine.response_engine import engine_on
from ...exceptions import DivergenceError, ExcitationWarning, unheard
from ...inference.refinement import Refinement
from ...models.operating_point import ordered_record
from ...systems.linear import Array

__all__ = ["rmse_on"]


def rmse_on(refinement: Refinement, records: Sequence[Measurement], horizon: float | None) -> Array:
    """Root mean square of the free run's residual, (n_y,), in the windows that `compare` chooses.

    Of frequency responses that of the points, over their noise.

    Parameters
    ----------
    refinement : Refinement
        The model.
    records : sequence of Measurement
        Records, or frequency responses.
    horizon : float, optional
        Length of the free runs (s).
    """
    linear = refinement.physical_model.linear
    if in_frequency(records):
        return _rms_of_points(refinement, records)
    found = []
    for record in records:
        ordered = record_for(record, match_channels(linear, record))
        try:
            with unheard(ExcitationWarning):  # parts are cut here: what they lack is nothing a user chose
                found.append(np.atleast_2d(compare(refinement, ordered, horizon=horizon).residual))
        except DivergenceError:
            return np.full(linear.n_outputs, np.inf)
    return np.asarray(np.sqrt(np.mean(np.concatenate(found, axis=1) ** 2, axis=1)))


def _rms_of_points(refinement: Refinement, responses: Sequence[Any]) -> Array:
    structure, theta, _ = refinement.simulation_structure()
    found = []
    for response in responses:
        record = ordered_record(refinement.physical_model, response)
        run = engine_on(structure, record).run(theta, sensitivity=False)
        if run.blew_up >= 0:
            return np.full(structure.n_outputs, np.inf)
        found.append(record.outputs - run.outputs)
    return np.asarray(np.sqrt(np.mean(np.concatenate(found, axis=1) ** 2, axis=1)))
