"""Checks of objects: files, random generators, executors, classes."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar

import control as ct
import numpy as np

from .numbers import as_whole
from .quoting import shown

__all__ = ["as_generator", "as_instance", "as_mapper", "as_path"]

T = TypeVar("T")


def as_instance(value: Any, kind: type[T], name: str) -> T:
    """An object of one class.

    Raises
    ------
    control.ControlArgument
        If it is of another.
    """
    if not isinstance(value, kind):
        raise ct.ControlArgument(f"{name} must be of class {kind.__name__}, not {shown(value)}")
    return value


def as_path(value: Any, name: str = "path") -> Path:
    """Path of a file, as it was given.

    Raises
    ------
    control.ControlArgument
        If it is no text or path, or one that no file can have.
    """
    if not isinstance(value, str | os.PathLike):
        raise ct.ControlArgument(f"{name} must be the path of a file, not {shown(value)}")
    text = os.fspath(value)
    try:
        usable = isinstance(text, str) and bool(text) and b"\0" not in os.fsencode(text)
    except UnicodeEncodeError:
        usable = False
    if not usable:
        raise ct.ControlArgument(
            f"{name} must be the path of a file; no file can have the name {shown(value)}"
        )
    return Path(text)


def as_generator(value: Any) -> np.random.Generator:
    """Generator of random numbers, or a new one from a seed."""
    if isinstance(value, np.random.Generator):
        return value
    try:
        return np.random.default_rng(as_whole(value, "rng"))
    except ct.ControlArgument as reason:
        said = f"rng must be a numpy.random.Generator or a seed from 0, not {shown(value)}"
        raise ct.ControlArgument(said) from reason


def as_mapper(executor: Any) -> Callable[..., Any]:
    """Return the `map` of an executor, or the built-in one for None.

    For a dask client, it is the `map` of its executor.

    Raises
    ------
    control.ControlArgument
        If it is anything else.
    """
    if executor is None:
        return map
    if callable(getattr(executor, "get_executor", None)):  # a Client's own map returns futures
        executor = executor.get_executor()
    mapper: Callable[..., Any] | None = getattr(executor, "map", None)
    if mapper is not None and callable(mapper) and not isinstance(executor, type):
        return mapper
    raise ct.ControlArgument(
        "executor must be a concurrent.futures.Executor such as ProcessPoolExecutor(4), or a "
        f"dask.distributed.Client, not {shown(executor)}"
    )
