"""Whether a record can show anything at all; asked before anything is ranked."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ..data.measurement import Measurement
from ..inference.doubts import explains_nothing
from ..inference.refinement import Refinement

__all__ = ["no_motion", "not_excited"]

_FEW_LEVELS = 3  # distinct values of an output that does not move but for its last digit


def no_motion(records: Sequence[Measurement]) -> str:
    """Why nothing can be told from these records, empty where they show motion.

    Parameters
    ----------
    records : sequence of Measurement
        Records.

    Returns
    -------
    str
    """
    labels = records[0].output_labels
    still = []
    for i, label in enumerate(labels):
        y = np.concatenate([record.outputs[i] for record in records])
        moving = np.abs(np.diff(y)) > 1e-9 * max(float(np.abs(y).max()), 1e-300)
        levels = np.unique(np.round(y / (1e-9 * max(float(np.abs(y).max()), 1e-300)))).size
        if not moving.any() or (levels <= _FEW_LEVELS and moving.mean() < 0.05):
            still.append(label)
    if len(still) < len(labels):
        return ""
    return (
        f"Cannot tell: {', '.join(still)} does not move in this record, so every effect that holds it still "
        "explains it alike. Give a record with motion."
    )


def not_excited(base: Refinement, records: Sequence[Measurement]) -> str:
    """Why nothing was excited, empty where an input moves or the outputs settle as the model does.

    Parameters
    ----------
    base : Refinement
        The model fitted to the records.
    records : sequence of Measurement
        Records.

    Returns
    -------
    str
    """
    if any(np.ptp(record.inputs, axis=1).any() for record in records):
        return ""
    samples = sum(record.n_samples for record in records)
    if not explains_nothing(base.fit, samples, base.theta.size + base.initial_states.size):
        return ""
    return (
        f"Cannot tell: nothing was excited. {', '.join(records[0].input_labels)} is constant, and the "
        "outputs show no free motion of the model. Give a record in which the inputs move."
    )
