"""Arrays of numbers: whole ones, vectors, states, noise levels."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import control as ct
import numpy as np
from numpy.typing import NDArray

from ..exceptions import DataError
from .numbers import as_number
from .quoting import shown

__all__ = ["as_array", "as_noise", "as_state", "as_vector"]

Array = NDArray[np.float64]


def as_array(
    values: Any,
    name: str,
    *,
    finite: bool = True,
    flags: bool = False,
    error: type[Exception] = DataError,
) -> Array:
    """Independent array of real numbers, of any shape.

    Raises
    ------
    control.ControlArgument
        If the values are complex, text, dates, objects, or (unless `flags`) True and False.
    control.ControlDimension
        If rows have unequal lengths.
    error
        If a value is masked or (unless `finite` is False) not finite.
    """
    if np.ma.isMaskedArray(values) and np.ma.getmaskarray(values).any():
        place = tuple(int(i) for i in np.argwhere(np.ma.getmaskarray(values))[0])
        raise error(f"{name} is masked at index {place}; repair or leave out the gap")
    if isinstance(values, bytes | bytearray | memoryview):
        raise ct.ControlArgument(f"{name} must hold real numbers, not {shown(values)}")
    try:
        array = np.array(values, subok=False)
    except (ValueError, TypeError, RecursionError) as reason:
        if isinstance(values, list | tuple):
            raise ct.ControlDimension(f"{name} holds rows of unequal lengths; give all the same") from reason
        raise ct.ControlArgument(f"{name} must hold real numbers, not {shown(values)}") from reason
    if array.dtype.kind == "c":
        raise ct.ControlArgument(f"{name} is complex; give real numbers")
    if array.dtype.kind not in ("fiub" if flags else "fiu") and array.size:
        raise ct.ControlArgument(
            f"{name} must hold real numbers, not {array.dtype} such as {shown(array.flat[0])}; "
            "convert it first"
        )
    if array.dtype.kind not in "fiub":  # an empty list of anything
        array = np.zeros(array.shape)
    if finite and not np.isfinite(array).all():
        index = tuple(int(i) for i in np.argwhere(~np.isfinite(array))[0])
        where = f"{name}[{', '.join(map(str, index))}]" if index else name
        raise error(f"{where} is not finite ({array[index]}); give finite numbers")
    return array.astype(np.float64)


def as_vector(
    values: Any,
    name: str,
    size: int | None = None,
    *,
    above: float = -math.inf,
    least: float = -math.inf,
    error: type[Exception] = DataError,
) -> Array:
    """Finite numbers in a row, from one or a list of them.

    Raises
    ------
    control.ControlArgument
        If they are no real numbers.
    control.ControlDimension
        If there are not `size` of them, or more dimensions.
    error
        If there is none, or one is not finite or out of range.
    """
    array = np.atleast_1d(as_array(values, name, finite=False, error=error))
    if array.size == 0:
        raise error(f"{name} is empty; give at least one {'positive ' if above == 0 else ''}number")
    if array.ndim != 1:
        raise ct.ControlDimension(f"{name} must be a list of numbers, not an array of shape {array.shape}")
    if size is not None and array.size != size:
        raise ct.ControlDimension(f"{name} has {array.size} entries, expected {size}")
    for index, number in enumerate(array.tolist()):
        where = name if array.size == 1 else f"{name}[{index}]"
        as_number(number, where, above=above, least=least, error=error)
    return array


def as_state(value: Any, size: int | None = None) -> Array | None:
    """Return the initial state of a simulation.

    It is None for "estimate", zeros for "zero", or the given state.

    Raises
    ------
    control.ControlArgument
        If it is neither of the words nor an array of numbers.
    control.ControlDimension
        If there are not `size` numbers.
    DataError
        If one is not finite.
    """
    if isinstance(value, str) and value in ("estimate", "zero"):
        return None if value == "estimate" else np.zeros(size or 0)
    if value is None or isinstance(value, str | bool | np.bool_ | Mapping):
        raise ct.ControlArgument(f"x0 must be 'estimate', 'zero' or an array, not {shown(value)}")
    state = as_array(value, "x0")
    if state.ndim != 1 or state.size != (state.size if size is None else size):
        raise ct.ControlDimension(f"x0 has shape {state.shape}; the model has {size or 'other'} states")
    return state


def as_noise(value: Any, n_outputs: int) -> Array | None:
    """Return the standard deviations of the sensor noise, one per output.

    The result is None where they are not known.
    """
    if value is None:
        return None
    level = as_vector(value, "noise (standard deviations)", above=0.0, error=ct.ControlArgument)
    if level.size not in (1, n_outputs):
        raise ct.ControlDimension(
            f"noise has {level.size} entries; give one standard deviation, or one for each of the "
            f"{n_outputs} outputs"
        )
    return np.broadcast_to(level, (n_outputs,))
