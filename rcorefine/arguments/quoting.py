"""Safe display of text from outside the package.

Examples are a bad value in a message, and a name that holds control characters.
"""

from __future__ import annotations

from typing import Any
from unicodedata import category

__all__ = ["printable", "shown"]

_HIDDEN = ("Cc", "Cs", "Zl", "Zp")  # control characters, surrogates, separators of lines and paragraphs
_TURNING = "\u202a\u202b\u202c\u202d\u202e\u2066\u2067\u2068\u2069"  # the direction of what follows
_SHOWN = 80  # characters of a bad value in a message


def shown(value: Any) -> str:
    """A value as a message quotes it: whole where it is short."""
    if isinstance(value, int) and not isinstance(value, bool) and value.bit_length() > 256:
        return f"a whole number of {value.bit_length()} bits"  # Python refuses to write out the longest
    text = " ".join(repr(value).split())
    return text if len(text) <= _SHOWN else f"{text[: _SHOWN - 3]}..."


def printable(text: str) -> str:
    r"""Return text with its control characters spelled out.

    The name of a signal can then not control a terminal.

    Examples
    --------
    >>> print(printable("red \x1b[31m"))
    red \x1b[31m
    """
    if text.isprintable():
        return text
    return "".join(repr(one)[1:-1] if one in _TURNING or category(one) in _HIDDEN else one for one in text)
