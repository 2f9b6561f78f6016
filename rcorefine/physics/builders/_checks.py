"""Checks that all builders share."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import control as ct
import numpy as np

from ...exceptions import ModelError
from ...systems.linear import Array


def as_number(name: str, value: Any, *, positive: bool = True) -> float:
    """One finite number, positive unless `positive` is False (then not negative)."""
    return float(as_vector(name, value, 1, positive=positive)[0])


def as_vector(name: str, value: Any, size: int | None = None, *, positive: bool = True) -> Array:
    """Finite numbers that are positive, or at least not negative."""
    try:
        array = np.atleast_1d(np.asarray(value, dtype=float))
    except (TypeError, ValueError):
        raise ct.ControlArgument(f"{name} must be a number or a list of numbers, not {value!r}") from None
    if array.ndim != 1 or array.size == 0:
        raise ct.ControlDimension(f"{name} must be a list of numbers, not an array of shape {array.shape}")
    if size is not None and array.size != size:
        raise ct.ControlDimension(f"{name} has {array.size} entries, expected {size}")
    for index, number in enumerate(array):
        where = name if array.size == 1 else f"{name}[{index}]"
        if not np.isfinite(number):
            raise ModelError(f"{where} = {number} must be finite")
        if positive and number <= 0:
            raise ModelError(f"{where} = {number:g} must be positive")
        if number < 0:
            raise ModelError(f"{where} = {number:g} must not be negative")
    return array


def as_matrix(name: str, value: Any, size: int, *, symmetric: bool) -> Array:
    """Square matrix of finite numbers."""
    try:
        matrix = np.atleast_2d(np.asarray(value, dtype=float))
    except (TypeError, ValueError):
        raise ct.ControlArgument(f"{name} must be a matrix of numbers") from None
    if matrix.shape != (size, size):
        raise ct.ControlDimension(f"{name} has shape {matrix.shape}, expected {(size, size)}")
    if not np.isfinite(matrix).all():
        row, column = np.argwhere(~np.isfinite(matrix))[0]
        raise ModelError(f"{name}[{row}, {column}] must be finite")
    if symmetric and not np.allclose(matrix, matrix.T, rtol=1e-8, atol=1e-10 * np.abs(matrix).max()):
        row, column = np.unravel_index(np.argmax(np.abs(matrix - matrix.T)), matrix.shape)
        raise ModelError(
            f"{name} is not symmetric: {name}[{row}, {column}] = {matrix[row, column]:g}, but "
            f"{name}[{column}, {row}] = {matrix[column, row]:g}; by action and reaction they are equal"
        )
    return matrix


def as_labels(what: str, given: Any, default: Sequence[str]) -> tuple[str, ...]:
    """Labels of signals: those given if they fit, otherwise the default ones."""
    if given is None:
        return tuple(default)
    labels = (given,) if isinstance(given, str) else tuple(given)
    if not all(isinstance(label, str) and label for label in labels):
        raise ct.ControlArgument(f"{what} must be names, not {given!r}")
    if len(labels) != len(default):
        raise ct.ControlDimension(
            f"{what} has {len(labels)} names for {len(default)} signals ({', '.join(default)})"
        )
    if len(set(labels)) != len(labels):
        raise ModelError(f"{what} must be unique, not {', '.join(labels)}")
    return labels


def as_index(what: str, value: Any, size: int) -> int:
    """Number of a mass, node or tank, counted from 1; returned counted from 0."""
    if isinstance(value, (bool, np.bool_)) or not isinstance(value, (int, np.integer)):
        raise ct.ControlArgument(f"{what} must be a whole number from 1 to {size}, not {value!r}")
    if not 1 <= value <= size:
        raise ModelError(f"{what} = {value} does not exist: there are 1 to {size}")
    return int(value) - 1


def as_choice(what: str, value: Any, choices: Sequence[str]) -> str:
    """One of a few words."""
    if value not in choices:
        raise ct.ControlArgument(f"{what} must be one of {', '.join(map(repr, choices))}, not {value!r}")
    return str(value)


def unique_outputs(labels: Sequence[str]) -> None:
    """Refuse the same sensor twice."""
    twice = sorted({label for label in labels if list(labels).count(label) > 1})
    if twice:
        raise ModelError(f"sensor {twice[0]} is asked for more than once; name each sensor once")
