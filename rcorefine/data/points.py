"""Checks of the points of a frequency response.

Every error message names the problem, its position and the remedy.
"""

from __future__ import annotations

from typing import Any

import control as ct
import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..arguments import as_array, as_vector
from ..exceptions import DataError
from ..systems.linear import Array

__all__ = ["as_amplitude", "as_coherence", "as_deviation", "as_points"]


def as_points(response: Any) -> NDArray[np.complex128]:
    """Complex response of shape (n_y, n_w, n_omega)."""
    try:
        values = np.array(response, subok=False)
    except (ValueError, TypeError, RecursionError):
        values = np.zeros(0, dtype=object)
    if values.dtype.kind != "c":
        values = as_array(response, "response", finite=False)
    elif np.ma.isMaskedArray(response) and np.ma.getmaskarray(response).any():
        raise DataError("response is masked; leave those points out")
    if values.ndim == 1:
        values = values[None, None]
    if values.ndim != 3 or not values.size:
        raise ct.ControlDimension(
            f"response has shape {np.shape(response)}; give (outputs, inputs, frequencies), or (frequencies,)"
        )
    if not np.isfinite(values).all():
        i, j, k = np.argwhere(~np.isfinite(values))[0]
        raise DataError(f"response[{i}, {j}, {k}] is not finite; leave that frequency out")
    return values.astype(np.complex128)


def as_deviation(values: ArrayLike, shape: tuple[int, ...]) -> Array:
    """Numbers that are not negative, one for all points or one each."""
    array = as_array(values, "std")
    if array.ndim not in (0, 3) and not (array.ndim == 1 and shape[:2] == (1, 1)):
        raise ct.ControlDimension(f"std has shape {array.shape}; the response has {shape}")
    if array.ndim and array.shape not in (shape, shape[2:]):
        raise ct.ControlDimension(f"std has shape {array.shape}; the response has {shape}")
    if array.size and array.min() < 0:
        raise DataError(f"std holds {array.min():g}; it cannot be negative")
    return np.array(np.broadcast_to(array, shape))


def as_coherence(values: ArrayLike, n_y: int, n: int) -> Array:
    """Shares from 0 to 1, of shape (n_y, n)."""
    array = np.atleast_2d(as_array(values, "coherence"))
    if array.shape != (n_y, n):
        raise ct.ControlDimension(f"coherence has shape {array.shape}; expected {(n_y, n)}")
    if array.min() < 0 or array.max() > 1:
        raise DataError(f"coherence runs from {array.min():g} to {array.max():g}; it lies between 0 and 1")
    return array


def as_amplitude(value: Any, n: int, order: NDArray[np.intp]) -> Array | None:
    """Return the input peaks in the order of the sorted frequencies.

    None if they are not known.
    """
    if value is None:
        return None
    peaks = as_vector(value, "amplitude", above=0.0)
    if peaks.size not in (1, n):
        raise ct.ControlDimension(
            f"amplitude has {peaks.size} entries; give one, or one for each of {n} frequencies"
        )
    return np.broadcast_to(peaks, (n,))[order].copy()
