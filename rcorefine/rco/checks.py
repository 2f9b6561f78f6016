"""Checks of settings and samples: what was wrong, where, and what to do."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import control as ct
import numpy as np

from ..arguments import as_flag
from ..exceptions import DataError, ModelError
from ..systems.linear import Array

__all__ = ["as_flag", "as_matrix", "as_rate", "as_samples", "as_size", "check_samples"]


def as_size(value: Any, name: str, least: int, meaning: str) -> int:
    """Whole number that is not below `least`."""
    if isinstance(value, bool | np.bool_) or not isinstance(value, int | np.integer):
        raise ct.ControlArgument(f"{name} ({meaning}) must be a whole number, not {value!r}")
    if value < least:
        raise ModelError(f"{name} ({meaning}) must be at least {least}, not {value}")
    return int(value)


def as_rate(value: Any, name: str) -> float:
    """Learning rate: a positive, finite number."""
    if isinstance(value, bool | np.bool_) or not isinstance(value, int | float | np.integer | np.floating):
        raise ct.ControlArgument(f"{name} (alpha) must be a number, not {value!r}")
    if not (np.isfinite(value) and value > 0):
        raise ModelError(f"{name} (alpha) must be positive and finite, not {value!r}; larger is slower")
    return float(value)


def as_matrix(value: Any, name: str, rows: int, columns: int | None, rows_are: str) -> Array:
    """Finite matrix with these rows; a vector is one column."""
    array = np.asarray(value)
    if array.dtype.kind not in "fiu":
        raise ct.ControlArgument(f"{name} must hold real numbers, not {array.dtype}")
    if array.ndim == 1:
        array = array[:, None]
    if array.ndim != 2 or array.shape[0] != rows or array.shape[1] == 0:
        raise ct.ControlDimension(
            f"{name} has shape {np.shape(value)}; give ({rows}, l_u), one row per {rows_are}"
        )
    if columns is not None and array.shape[1] != columns:
        raise ct.ControlDimension(f"{name} has {array.shape[1]} column(s) for {columns} correction(s)")
    if not np.isfinite(array).all():
        row, column = np.argwhere(~np.isfinite(array))[0]
        raise ModelError(f"{name} is not finite at [{row}, {column}]")
    return np.array(array, dtype=np.float64)


def as_samples(values: Any, what: str, n_signals: int) -> Array:
    """One sample or a block of `n_signals` signals as (n_signals, N).

    Raises
    ------
    control.ControlArgument
        If the values are complex, text or objects.
    control.ControlDimension
        If the number of signals does not fit, or the array is transposed.
    DataError
        If there is no sample, or a value is masked.
    """
    if np.ma.isMaskedArray(values) and np.ma.getmaskarray(values).any():
        place = tuple(int(i) for i in np.argwhere(np.ma.getmaskarray(values))[0])
        raise DataError(f"{what} is masked at index {place}; leave the sample out or repair it")
    try:
        array = np.asarray(values)
    except ValueError as error:
        raise ct.ControlDimension(f"{what} holds signals of unequal lengths; give all the same") from error
    if array.dtype.kind == "c":
        raise ct.ControlArgument(f"{what} is complex; measured signals are real")
    if array.dtype.kind not in "fiub":
        raise ct.ControlArgument(f"{what} must hold real numbers, not {array.dtype}")
    if array.size == 0:
        raise DataError(f"{what} is empty (shape {array.shape}); give at least one sample")
    if array.ndim == 1:
        array = array[None, :] if n_signals == 1 else array[:, None]
    elif array.ndim == 0:
        array = array[None, None]
    if array.ndim != 2:
        raise ct.ControlDimension(f"{what} has shape {array.shape}; give one sample (n,) or a block (n, N)")
    if array.shape[0] != n_signals:
        if array.shape[1] == n_signals and np.ndim(values) == 2:
            raise ct.ControlDimension(
                f"{what} has shape {array.shape}: it looks transposed. Signals come first and time last; "
                f"pass {what}.T"
            )
        raise ct.ControlDimension(
            f"{what} has shape {np.shape(values)}, but the model has {n_signals} {what}; "
            f"give one sample ({n_signals},) or a block ({n_signals}, N)"
        )
    return np.array(array, dtype=np.float64)


def check_samples(signals: Array, labels: Sequence[str], what: str, first: int, dt: float | None) -> None:
    """Refuse NaN and Inf; samples are counted from the start of the stream."""
    bad = ~np.isfinite(signals)
    if not bad.any():
        return
    sample = int(np.argmax(bad.any(axis=0)))
    row = int(np.argmax(bad[:, sample]))
    value = "NaN" if np.isnan(signals[row, sample]) else "Inf"
    when = "" if dt is None else f" (t = {(first + sample) * dt:.6g} s)"
    raise DataError(
        f"{what} {labels[row]!r} is {value} at sample {first + sample}{when}, {sample} in this call; "
        "nothing of the call was used. Repair the sample or leave it out"
    )
