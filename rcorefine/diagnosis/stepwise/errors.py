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

__all__ = ["Errors"]


class Errors:
    """Root mean squares of the free run's residual, in the windows that `compare` chooses.

    Of frequency responses those of the points, over their noise. Every rival is held against the present
    model, and each stage asks again: what a record left of a model is worked out once.

    Parameters
    ----------
    horizon : float or None
        Length of the free runs (s).
    """

    def __init__(self, horizon: float | None) -> None:
        self.horizon = horizon
        # beside it what has these numbers, so that nothing else gets them
        self._known: dict[tuple[int, int], tuple[Array | None, Refinement, Measurement]] = {}

    def __call__(self, refinement: Refinement, records: Sequence[Measurement]) -> Array:
        """Error of a model on records, (n_y,); inf where it diverges."""
        if in_frequency(records):
            return _rms_of_points(refinement, records)
        found = []
        for record in records:
            left = self._left(refinement, record)
            if left is None:
                return np.full(refinement.physical_model.linear.n_outputs, np.inf)
            found.append(left)
        return np.asarray(np.sqrt(np.mean(np.concatenate(found, axis=1) ** 2, axis=1)))

    def _left(self, refinement: Refinement, record: Measurement) -> Array | None:
        """Residual of a record, None where the model diverges."""
        key = id(refinement), id(record)
        if key not in self._known:
            ordered = record_for(record, match_channels(refinement.physical_model.linear, record))
            try:
                with unheard(ExcitationWarning):  # parts are cut here: what they lack is nothing a user chose
                    left = np.atleast_2d(compare(refinement, ordered, horizon=self.horizon).residual)
            except DivergenceError:
                left = None
            self._known[key] = left, refinement, record
        return self._known[key][0]


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
