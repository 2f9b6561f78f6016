"""Sealed answers, which can be checked but not read."""

from __future__ import annotations

import hashlib
import math
from collections.abc import Iterable

from .hiding import Accepted

__all__ = ["is_sealed", "sealed"]

_ROUNDS = 5_000  # of the key derivation: a millisecond for each comparison
_GRID = 0.01  # of the logarithm of a coefficient


def sealed(accepted: Iterable[Accepted], salt: str) -> frozenset[str]:
    """Return the seals of all accepted answers.

    They cover effects, places, and the coefficients within their tolerance.
    """
    found = set()
    for one in accepted:
        kind, place = one.effect.kind, one.effect.place
        found.add(_seal(salt, "tied" if one.tied else "right", kind, place))
        found.add(_seal(salt, "place", place))
        first, last = (_cell(one.coefficient * (1 + s * one.tolerance)) for s in (-1.0, 1.0))
        found |= {
            _seal(salt, "value", kind, place, str(math.copysign(1, one.coefficient)), str(cell))
            for cell in range(first, last + 1)
        }
    return frozenset(found)


def is_sealed(seals: frozenset[str], salt: str, what: str, *words: str, value: float | None = None) -> bool:
    """Return whether an answer counts in the given way.

    The ways are "right", "tied", "place" and "value".
    """
    if value is not None:
        if not math.isfinite(value) or value == 0.0:
            return False
        words = (*words, str(math.copysign(1, value)), str(_cell(value)))
    return _seal(salt, what, *words) in seals


def _cell(value: float) -> int:
    return math.floor(math.log(abs(value)) / _GRID)


def _seal(salt: str, *words: str) -> str:
    return hashlib.pbkdf2_hmac("sha256", "|".join(words).encode(), salt.encode(), _ROUNDS).hex()[:32]
