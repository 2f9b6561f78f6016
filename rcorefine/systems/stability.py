"""A model as near as may be whose modes do not grow faster than allowed."""

from __future__ import annotations

import numpy as np
from scipy import linalg

from .balance import balance
from .linear import LinearModel

__all__ = ["growth", "stabilized"]


def growth(model: LinearModel) -> float:
    """Return the largest growth rate of the modes.

    It is the largest real part of the poles. For a discrete model it is the largest logarithm of their
    magnitude.
    """
    if model.n_states == 0:
        return -np.inf
    poles = linalg.eigvals(model.A)
    if model.is_continuous:
        return float(poles.real.max())
    with np.errstate(divide="ignore"):
        return float(np.log(np.abs(poles).max()))


def stabilized(model: LinearModel, limit: float) -> LinearModel:
    """Return a model whose modes grow no faster than `limit`.

    Modes that grow faster are slowed down by the same amount, the fastest one to the limit. The others stay,
    unless rounding errors hide on which side of the limit a mode is. Then all slow down.

    Parameters
    ----------
    model : LinearModel
        Continuous or discrete model.
    limit : float
        Largest growth, as of `growth`.

    Returns
    -------
    LinearModel
        The same model where nothing grows faster.

    Examples
    --------
    >>> import control as ct
    >>> from rcorefine.systems.linear import LinearModel
    >>> wild = ct.ss([[0.1, 1.0], [0.0, -2.0]], [[0.0], [1.0]], [[1.0, 0.0]], [[0.0]])
    >>> wild = LinearModel.from_statespace(wild)
    >>> linalg.eigvals(stabilized(wild, -0.5).A).real
    array([-0.5, -2. ])
    """
    if growth(model) <= limit:
        return model
    continuous = model.is_continuous
    bound = limit if continuous else float(np.exp(limit))

    def wild(real: float, imaginary: float) -> bool:
        return (real if continuous else abs(complex(real, imaginary))) > bound

    units = balance(model.A)  # those of the user may be far apart
    A = model.A * units / units[:, None]
    try:
        triangle, basis, count = linalg.schur(A, output="real", sort=wild)
    except linalg.LinAlgError:  # modes that rounding moves across the bound: all are slowed down
        triangle, basis, count = A.copy(), np.eye(len(A)), len(A)
    block = triangle[:count, :count]
    if continuous:
        block -= (growth(model) - limit) * np.eye(count)
    else:
        block *= bound / np.exp(growth(model))
    return model.with_arrays(A=(basis @ triangle @ basis.T) * units[:, None] / units)
