"""Words, names and lists of them."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import control as ct

from ..exceptions import DataError
from .quoting import shown

__all__ = ["as_choice", "as_labels", "as_list", "as_mapping", "as_text", "as_texts"]


def as_text(value: Any, name: str, *, empty: bool = True) -> str:
    """Text; `empty` tells whether it may be."""
    if not isinstance(value, str):
        raise ct.ControlArgument(f"{name} must be a text, not {shown(value)}")
    if not empty and not value.strip():
        raise ct.ControlArgument(f"{name} must not be empty")
    return str(value)


def as_choice(value: Any, name: str, choices: Iterable[str]) -> str:
    """One of a few words."""
    choices = list(choices)
    if not isinstance(value, str) or value not in choices:
        raise ct.ControlArgument(f"{name} must be one of {', '.join(map(repr, choices))}, not {shown(value)}")
    return str(value)


def as_list(values: Any, name: str, of: str) -> list[Any]:
    """Return the entries of a list in their order.

    A tuple, an array or an iterator is accepted as well; `of` describes the entries in the error message.
    """
    listed = isinstance(values, Iterable) and getattr(values, "ndim", 1) == 1
    if not listed or isinstance(values, str | bytes | bytearray | memoryview | Mapping | set | frozenset):
        raise ct.ControlArgument(f"{name} must be a list of {of}, not {shown(values)}")
    return list(values)


def as_texts(values: Any, name: str, count: int | None = None) -> tuple[str, ...]:
    """Texts from one or a list of them.

    Raises
    ------
    control.ControlArgument
        If an entry is no text.
    control.ControlDimension
        If there are not `count` of them.
    """
    texts = [values] if isinstance(values, str) else as_list(values, name, "strings")
    for text in texts:
        if not isinstance(text, str):
            raise ct.ControlArgument(f"{name} must hold strings, not {shown(text)}")
    if count is not None and len(texts) != count:
        raise ct.ControlDimension(f"{name}: {len(texts)} given for {count} signal(s)")
    return tuple(str(text) for text in texts)


def as_labels(
    values: Any, name: str, default: Sequence[str], *, error: type[Exception] = DataError
) -> tuple[str, ...]:
    """Names of signals, each another; the default ones where None is given.

    Raises
    ------
    control.ControlArgument
        If an entry is no text.
    control.ControlDimension
        If the number does not fit.
    error
        If a name is empty or stands there twice.
    """
    if values is None:
        return tuple(default)
    labels = as_texts(values, name)
    if len(labels) != len(default):
        raise ct.ControlDimension(
            f"{name} has {len(labels)} names for {len(default)} signal(s) ({', '.join(default)})"
        )
    for label in labels:
        if not label:
            raise error(f"{name} holds an empty name; name every signal")
        if labels.count(label) > 1:
            raise error(f"{name} must be unique, but names {label!r} twice")
    return labels


def as_mapping(value: Any, name: str, of: str) -> dict[str, Any]:
    """Copy of a mapping whose keys are texts; None is an empty one."""
    if value is None:
        return {}
    if not isinstance(value, Mapping):
        raise ct.ControlArgument(f"{name} must be a mapping from names to {of}, not {shown(value)}")
    for key in value:
        if not isinstance(key, str):
            raise ct.ControlArgument(f"{name} must have names as keys, not {shown(key)}")
    return dict(value)
