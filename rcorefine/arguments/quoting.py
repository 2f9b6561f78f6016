"""A bad value as a message quotes it."""

from __future__ import annotations

from typing import Any

__all__ = ["shown"]

_SHOWN = 80  # characters of a bad value in a message


def shown(value: Any) -> str:
    """A value as a message quotes it: whole where it is short."""
    if isinstance(value, int) and not isinstance(value, bool) and value.bit_length() > 256:
        return f"a whole number of {value.bit_length()} bits"  # Python refuses to write out the longest
    text = " ".join(repr(value).split())
    return text if len(text) <= _SHOWN else f"{text[: _SHOWN - 3]}..."
