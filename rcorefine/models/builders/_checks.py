"""Argument checks that all builders share.

A value out of range raises `ModelError`.
"""

from __future__ import annotations

import numbers
from collections.abc import Sequence
from typing import Any

import control as ct
import numpy as np

from ... import arguments
from ...exceptions import ModelError
from ...systems.linear import Array


def as_number(value: Any, name: str, *, positive: bool = True) -> float:
    """Return one finite number that is positive, or at least not negative.

    Zero is allowed if `positive` is False.
    """
    return float(as_vector(value, name, 1, positive=positive)[0])


def as_vector(value: Any, name: str, size: int | None = None, *, positive: bool = True) -> Array:
    """Finite numbers that are positive, or at least not negative."""
    bound = {"above": 0.0} if positive else {"least": 0.0}
    return arguments.as_vector(value, name, size, **bound, error=ModelError)


def as_matrix(value: Any, name: str, size: int, *, symmetric: bool) -> Array:
    """Square matrix of finite numbers."""
    matrix = np.atleast_2d(arguments.as_array(value, name, error=ModelError))
    if matrix.shape != (size, size):
        raise ct.ControlDimension(f"{name} has shape {matrix.shape}, expected {(size, size)}")
    if symmetric and not np.allclose(matrix, matrix.T, rtol=1e-8, atol=1e-10 * np.abs(matrix).max()):
        row, column = np.unravel_index(np.argmax(np.abs(matrix - matrix.T)), matrix.shape)
        raise ModelError(
            f"{name} is not symmetric: {name}[{row}, {column}] = {matrix[row, column]:g}, but "
            f"{name}[{column}, {row}] = {matrix[column, row]:g}; by action and reaction they are equal"
        )
    return matrix


def as_labels(value: Any, name: str, default: Sequence[str]) -> tuple[str, ...]:
    """Labels of signals: those given if they fit, otherwise the default ones."""
    return arguments.as_labels(value, name, default, error=ModelError)


def as_index(value: Any, name: str, size: int) -> int:
    """Number of a mass, node or tank, counted from 1; returned counted from 0."""
    number = arguments.as_whole(value, name, error=ModelError)
    if not 1 <= number <= size:
        raise ModelError(f"{name} = {number} does not exist: there are 1 to {size}")
    return number - 1


def as_several(value: Any, name: str, of: str) -> list[Any]:
    """One entry or a list of them, as a list."""
    single = isinstance(value, numbers.Number | np.bool_ | str | bytes)
    return [value] if single else arguments.as_list(value, name, of)


def as_sensors(value: Any, choices: Sequence[str]) -> list[str]:
    """Names of sensors out of those that a model can have, each once."""
    asked = list(arguments.as_texts(value, "sensors"))
    if not asked:
        raise ModelError(f"sensors is empty; give at least one of {', '.join(choices)}")
    for sensor in asked:
        arguments.as_choice(sensor, "a sensor", choices)
        if asked.count(sensor) > 1:
            raise ModelError(f"sensor {sensor} is asked for more than once; name each sensor once")
    return asked
