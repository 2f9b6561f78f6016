"""Kinds of effects by their key or by the name that is printed."""

from __future__ import annotations

from difflib import get_close_matches
from functools import cache
from typing import Any

import control as ct

from .domains import DOMAINS, worded
from .law import KINDS

__all__ = ["kind_named"]


def kind_named(name: Any) -> str:
    """Return the kind of effect of a key or of a printed name.

    Parameters
    ----------
    name : str
        Key of `KINDS`, or the name in the words of a domain; upper case and spaces do not matter.

    Returns
    -------
    str
        Key of `KINDS`.

    Raises
    ------
    control.ControlArgument
        If there is no such kind; the three most similar names come first.

    Examples
    --------
    >>> kind_named("Coulomb friction"), kind_named("series resistance"), kind_named("quadratic outflow")
    ('coulomb_friction', 'damping', 'quadratic_damping')
    >>> kind_named("friction")
    Traceback (most recent call last):
    ...
    control.exception.ControlArgument: unknown kind of effect 'friction'; near it: coulomb_friction, ...
    """
    if isinstance(name, str) and name in KINDS:
        return name
    said = f"unknown kind of effect {name!r}"
    if isinstance(name, str) and name.strip():
        words, known = _plain(name), _known()
        if words in known:
            return known[words]
        near = [each for each in known if words in each] or get_close_matches(words, known)
        near = list(dict.fromkeys(known[each] for each in near))[:3]
        said += f"; near it: {', '.join(near)}" if near else ""
    raise ct.ControlArgument(f"{said}; the kinds are {', '.join(KINDS)}")


@cache
def _known() -> dict[str, str]:
    """Return the kind of each key and of each name in the words of a domain."""
    known = {_plain(kind): kind for kind in KINDS}
    for kind, law in KINDS.items():
        printed = (_plain(worded(law.words[0], domain)) for domain in DOMAINS)
        known |= {text: kind for text in printed if text and text not in known}
    return known


def _plain(name: str) -> str:
    """Return a name in lower case, with single spaces between its words."""
    return " ".join(name.lower().replace("_", " ").split())
