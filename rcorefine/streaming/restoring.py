"""Checks of a file of state against a fresh object.

A file may hold what a fresh object of the same settings holds, grown where growth is allowed.

Kernels trust shapes and counters, so nothing from a file reaches one before it was held against its
counterpart.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import fields, is_dataclass
from types import MappingProxyType, UnionType
from typing import Any, Union, get_args, get_origin

import numpy as np

from ..exceptions import DataError

__all__ = ["check_course", "check_like", "check_range", "fits", "parts_of"]

_WORDS = {int: "a whole number", bool: "true or false", str: "a text", type(None): "nothing"}
_MOST = 2**53  # of any count: beyond it floats skip whole numbers
_NOTHING: Mapping[str, str] = MappingProxyType({})


def parts_of(value: Any) -> dict[str, Any]:
    """Fields of a dataclass or named tuple by name."""
    names = value._fields if hasattr(value, "_fields") else [field.name for field in fields(value)]
    return {name: getattr(value, name) for name in names}


def check_like(found: Any, fresh: Any, where: str, grown: Mapping[str, str] = _NOTHING) -> None:
    """Hold what a file held against what a fresh object holds in its place.

    Types, names, dtypes and shapes must be the same, whole numbers not negative, and floats finite
    where the fresh ones are.

    Parameters
    ----------
    found : object
        From the file.
    fresh : object
        Its counterpart: a tree of dataclasses, named tuples, mappings, tuples, arrays, numbers and texts.
    where : str
        Name of the part, for the message.
    grown : mapping, optional
        Arrays, by the name of their field, that may have more rows than fresh ones, and a word: those
        with the same word have as many rows as each other.

    Raises
    ------
    DataError
        Where they differ.

    Examples
    --------
    >>> check_like({"x": np.ones(3)}, {"x": np.zeros(3)}, "state")
    >>> check_like({"x": np.ones(4)}, {"x": np.zeros(3)}, "state")
    Traceback (most recent call last):
    rcorefine.exceptions.DataError: state.x has shape (4,) and must have (3,): the file is damaged
    """
    if isinstance(fresh, np.ndarray):
        _check_array(found, fresh, where, where.rpartition(".")[2] in grown)
    elif isinstance(fresh, Mapping):
        same = isinstance(found, Mapping) and set(found) == set(fresh)
        _require(same, where, found, f"of {', '.join(map(str, fresh))}")
        _check_parts(found, fresh, where, grown)
    elif is_dataclass(fresh) or hasattr(fresh, "_fields"):
        _require(type(found) is type(fresh), where, found, f"a {type(fresh).__name__}")
        _check_parts(parts_of(found), parts_of(fresh), where, grown)
    elif isinstance(fresh, tuple):
        _require(isinstance(found, tuple) and len(found) == len(fresh), where, found, f"{len(fresh)} parts")
        for index, (part, other) in enumerate(zip(found, fresh, strict=True)):
            check_like(part, other, f"{where}[{index}]", grown)
    elif isinstance(fresh, float):
        _require(type(found) in (float, int), where, found, "a number")
        _require(math.isfinite(found) or not math.isfinite(fresh), where, found, "finite")
    else:
        _require(type(found) is type(fresh), where, found, _WORDS.get(type(fresh), type(fresh).__name__))
        if type(fresh) is int:
            check_range(found, min(0, fresh), _MOST, where)


def check_course(found: Any, rows: Any, n_outputs: int) -> None:
    """Check the history of a file.

    It is compared with an empty record, and the shape of its outputs is checked.

    Parameters
    ----------
    found : list of (record, ndarray)
        From the file.
    rows : object
        A record of no sample.
    n_outputs : int
        Outputs.

    Raises
    ------
    DataError
        Where they differ.
    """
    unknown = {name: np.full(part.shape[1:], np.nan)[None] for name, part in parts_of(rows).items()}
    unknown["outputs"] = np.full((1, n_outputs), np.nan)
    _require(isinstance(found, list), "history", found, "a list")
    for index, (record, outputs) in enumerate(found):
        where = f"history[{index}]"
        _require(type(record) is type(rows), where, record, f"a {type(rows).__name__}")
        block = {**parts_of(record), "outputs": outputs}
        check_like(block, unknown, where, dict.fromkeys(unknown, "samples"))


def fits(value: Any, hint: Any) -> bool:
    """Return whether a value from a file has the declared type.

    Only the types that are named under `hint` are checked.

    Parameters
    ----------
    value : object
        From the file.
    hint : type
        Declared type; of others than texts, numbers, arrays and tuples or unions of them anything passes.

    Returns
    -------
    bool

    Examples
    --------
    >>> fits(("N", "m"), tuple[str, ...]), fits(("N", 3), tuple[str, ...]), fits(None, str | None)
    (True, False, True)
    """
    origin, arguments = get_origin(hint), get_args(hint)
    if origin in (Union, UnionType):
        return any(fits(value, one) for one in arguments)
    if origin is np.ndarray:
        return isinstance(value, np.ndarray) and value.dtype.kind in "fiu"
    if origin is tuple:
        if not isinstance(value, tuple):
            return False
        each = arguments[:1] * len(value) if arguments[-1:] == (...,) else arguments
        return len(each) == len(value) and all(map(fits, value, each))
    if hint is float:
        return type(value) in (float, int)
    return type(value) is hint if hint in (str, int, bool, type(None)) else True


def check_range(values: Any, low: Any, high: Any, where: str) -> None:
    """Refuse values of a file outside of the allowed range.

    A kernel or a loop must not receive other values.

    Parameters
    ----------
    values : array_like
        Numbers.
    low, high : array_like
        Least and largest.
    where : str
        Name of the part, for the message.

    Raises
    ------
    DataError
        If one lies outside, or is not a number.
    """
    given = np.asarray(values)
    inside = (given >= low) & (given <= high)
    if not inside.all():
        raise DataError(
            f"{where} holds {np.broadcast_to(given, inside.shape)[~inside].flat[0]}, which must lie between "
            f"{np.broadcast_to(low, inside.shape)[~inside].flat[0]} and "
            f"{np.broadcast_to(high, inside.shape)[~inside].flat[0]}: the file is damaged"
        )


def _check_parts(
    found: Mapping[str, Any], fresh: Mapping[str, Any], where: str, grown: Mapping[str, str]
) -> None:
    rows: dict[str, int] = {}
    for name, value in fresh.items():
        check_like(found[name], value, f"{where}.{name}", grown)
        if name not in grown or not isinstance(value, np.ndarray):
            continue
        count = rows.setdefault(grown[name], len(found[name]))
        _require(len(found[name]) == count, f"{where}.{name}", found[name], f"of {count} rows")


def _check_array(found: Any, fresh: np.ndarray[Any, Any], where: str, grown: bool) -> None:
    _require(isinstance(found, np.ndarray), where, found, "an array")
    if found.dtype != fresh.dtype:
        raise DataError(f"{where} is of type {found.dtype} and must be {fresh.dtype}: the file is damaged")
    if found.ndim != fresh.ndim or found.shape[grown:] != fresh.shape[grown:]:
        wanted = f"(any, {', '.join(map(str, fresh.shape[1:]))})" if grown else str(fresh.shape)
        raise DataError(f"{where} has shape {found.shape} and must have {wanted}: the file is damaged")
    if found.dtype.kind == "f" and np.isfinite(fresh).all() and not np.isfinite(found).all():
        raise DataError(f"{where} holds what is not finite: the file is damaged")
    if found.dtype.kind in "iu":
        check_range(found, min(0, int(fresh.min(initial=0))), _MOST, where)


def _require(fits: bool, where: str, found: Any, wanted: str) -> None:
    if not fits:
        shown = f"of shape {found.shape}" if isinstance(found, np.ndarray) else f"{found!r:.60}"
        raise DataError(f"{where} is {shown} and must be {wanted}: the file is damaged")
