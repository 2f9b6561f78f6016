"""Effects by their names, and several effects as a list."""

from __future__ import annotations

from typing import Any

import control as ct

from ..arguments import as_list, shown
from .effect import Effect

__all__ = ["as_effects", "effect_named"]


def as_effects(values: Any, name: str) -> list[Effect]:
    """Return effects from one or a list of them, or of their names.

    A name is a key ``"coulomb_friction@link2"``, or what is printed: ``"series resistance at winding"``.

    Raises
    ------
    control.ControlArgument
        If an entry is something else, or names no effect.
    """
    given = [values] if isinstance(values, Effect | str) else as_list(values, name, "Effect objects")
    effects = [effect_named(each, name) if isinstance(each, str) else each for each in given]
    for effect in effects:
        if not isinstance(effect, Effect):
            raise ct.ControlArgument(f"{name} must hold Effect objects, not {shown(effect)}")
    return effects


def effect_named(text: str, name: str) -> Effect:
    """Return the effect of a name ``"kind@place"`` or ``"kind at place"``."""
    kind, at, place = (part.strip() for part in text.partition("@" if "@" in text else " at "))
    if not (kind and at and place):
        raise ct.ControlArgument(f"{name} must hold Effect objects, or names as 'kind@place', not {text!r}")
    return Effect(kind, place)
