"""Check of kinds of effects, with suggestions for unknown names."""

from __future__ import annotations

from difflib import get_close_matches
from typing import Any

import control as ct

from .law import KINDS

__all__ = ["check_kind"]


def check_kind(kind: Any) -> None:
    """Refuse what is no kind of effect.

    Parameters
    ----------
    kind : str
        Name of a law.

    Raises
    ------
    control.ControlArgument
        If there is none of that name; those that are written alike come first.

    Examples
    --------
    >>> check_kind("friction")
    Traceback (most recent call last):
    ...
    control.exception.ControlArgument: unknown kind of effect 'friction'; near it: coulomb_friction, ...
    """
    if isinstance(kind, str) and kind in KINDS:
        return
    said = f"unknown kind of effect {kind!r}"
    if isinstance(kind, str) and kind:
        near = [known for known in KINDS if kind in known] or get_close_matches(kind, KINDS)
        said += f"; near it: {', '.join(near)}" if near else ""
    raise ct.ControlArgument(f"{said}; the kinds are {', '.join(KINDS)}")
