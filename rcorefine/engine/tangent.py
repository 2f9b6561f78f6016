"""How an error of the state grows along the motion of a nonlinear model."""

from __future__ import annotations

import numpy as np

from ..data.measurement import Measurement
from ..models.physical_model import PhysicalModel
from ..systems.exponential import exponential
from ..systems.linear import Array

__all__ = ["growth"]

_LARGEST = 30.0  # beyond, nothing more is learned


def growth(model: PhysicalModel, states: Array, record: Measurement) -> float:
    """Log by which an error of the state grows at most from one sample to a later one, along given states.

    Parameters
    ----------
    model : PhysicalModel
        With a field.
    states : ndarray, shape (n, N)
        Motion, above the operating point.
    record : Measurement
        Inputs, above it as well.
    """
    point, n = model.operating_point, model.linear.n_states
    assert point is not None
    assert point.field is not None
    field = point.field
    along = np.vstack([states[:n], record.inputs]).T
    slopes = np.array([field.slopes(field.nominal, z)[:n, :n] for z in along])
    error, total, least, most = np.eye(n), 0.0, 0.0, 0.0
    for step in exponential((model.linear.A + np.nan_to_num(slopes)) * record.dt):
        error = step @ error
        size = float(np.linalg.norm(error, 2))
        if not 0.0 < size < np.inf:
            break
        error, total = error / size, total + float(np.log(size))
        least = min(least, total)
        most = max(most, total - least)
        if most > _LARGEST:
            break
    return most
