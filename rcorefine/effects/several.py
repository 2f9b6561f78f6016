"""Several effects as a list."""

from __future__ import annotations

from typing import Any

import control as ct

from ..arguments import as_list, shown
from .effect import Effect

__all__ = ["as_effects"]


def as_effects(values: Any, name: str) -> list[Effect]:
    """Effects from one or a list of them.

    Raises
    ------
    control.ControlArgument
        If an entry is something else.
    """
    effects = [values] if isinstance(values, Effect) else as_list(values, name, "Effect objects")
    for effect in effects:
        if not isinstance(effect, Effect):
            raise ct.ControlArgument(f"{name} must hold Effect objects, not {shown(effect)}")
    return effects
