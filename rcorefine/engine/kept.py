"""What was made lately, by its key."""

from __future__ import annotations

from collections.abc import Callable, Hashable
from typing import Any, TypeVar

__all__ = ["Kept"]

_Made = TypeVar("_Made")


class Kept:
    """The last few things that were made, for who asks again.

    Parameters
    ----------
    most : int
        How many are kept.
    """

    def __init__(self, most: int) -> None:
        self._most = most
        self._made: dict[Hashable, Any] = {}

    def __call__(self, key: Hashable, make: Callable[[], _Made]) -> _Made:
        """What was made under a key; made now, if it is not here."""
        found: _Made | None = self._made.get(key)
        if found is None:
            found = make()
            for oldest in list(self._made)[: 1 - self._most]:
                self._made.pop(oldest, None)
            self._made[key] = found
        return found
