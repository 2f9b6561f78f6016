"""Checks of settings and samples: what was wrong, where, and what to do."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import control as ct
import numpy as np

from ..arguments import as_array, as_number, as_whole
from ..data.signals import SMALLEST, check_sizes
from ..exceptions import DataError, ModelError
from ..systems.linear import Array, LinearModel

__all__ = ["as_block", "as_matrix", "as_rate", "as_samples", "as_size", "check_samples"]


def as_size(value: Any, name: str, least: int, meaning: str) -> int:
    """Whole number that is not below `least`."""
    return as_whole(value, f"{name} ({meaning})", least=least, error=ModelError)


def as_rate(value: Any, name: str) -> float:
    """Learning rate: a positive, finite number; larger is slower."""
    return as_number(value, f"{name} (alpha)", above=0.0, error=ModelError)


def as_matrix(value: Any, name: str, rows: int, columns: int | None, rows_are: str) -> Array:
    """Finite matrix with these rows; a vector is one column."""
    array = as_array(value, name, error=ModelError)
    if array.ndim == 1:
        array = array[:, None]
    if array.ndim != 2 or array.shape[0] != rows or array.shape[1] == 0:
        raise ct.ControlDimension(
            f"{name} has shape {np.shape(value)}; give ({rows}, l_u), one row per {rows_are}"
        )
    if columns is not None and array.shape[1] != columns:
        raise ct.ControlDimension(f"{name} has {array.shape[1]} column(s) for {columns} correction(s)")
    return array


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
    array = as_array(values, what, finite=False, flags=True)
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
    return array


def as_block(model: LinearModel, w: Any, y: Any) -> tuple[Array, Array]:
    """Return inputs (n_w, N) and outputs (n_y, N) at the same samples.

    Errors are raised as in `as_samples`.
    """
    inputs, outputs = as_samples(w, "inputs", model.n_inputs), as_samples(y, "outputs", model.n_outputs)
    if inputs.shape[1] != outputs.shape[1]:
        raise ct.ControlDimension(
            f"inputs have {inputs.shape[1]} sample(s) and outputs {outputs.shape[1]}; "
            "give both at the same samples"
        )
    # what is too small to have a square counts as nothing
    inputs, outputs = (np.where(np.abs(one) < SMALLEST, 0.0, one) for one in (inputs, outputs))
    return inputs, outputs


def check_samples(signals: Array, labels: Sequence[str], what: str, first: int, dt: float | None) -> None:
    """Refuse NaN, Inf and values whose square overflows.

    Samples are counted from the start of the stream.
    """
    bad = ~np.isfinite(signals)
    if not bad.any():
        check_sizes(signals, labels, what, smallest=0.0)  # a sample may be as small as it likes
        return
    sample = int(np.argmax(bad.any(axis=0)))
    row = int(np.argmax(bad[:, sample]))
    value = "NaN" if np.isnan(signals[row, sample]) else "Inf"
    when = "" if dt is None else f" (t = {(first + sample) * dt:.6g} s)"
    raise DataError(
        f"{what} {labels[row]!r} is {value} at sample {first + sample}{when}, {sample} in this call; "
        "nothing of the call was used. Repair the sample or leave it out"
    )
