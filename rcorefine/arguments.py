"""Checks of arguments that many functions share."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import control as ct
import numpy as np

__all__ = ["as_flag", "as_mapper"]


def as_flag(value: Any, name: str) -> bool:
    """True or False, nothing else: "no" would count as true.

    Raises
    ------
    control.ControlArgument
        If it is anything else.
    """
    if not isinstance(value, bool | np.bool_):
        raise ct.ControlArgument(f"{name} must be True or False, not {value!r}")
    return bool(value)


def as_mapper(executor: Any) -> Callable[..., Any]:
    """`map` of an executor, of a dask client's executor, or the built-in one for None.

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
    if mapper is not None and callable(mapper):
        return mapper
    raise ct.ControlArgument(
        "executor must be a concurrent.futures.Executor such as ProcessPoolExecutor(4), or a "
        f"dask.distributed.Client, not {executor!r}"
    )
