"""Several effects: as a list, as a table."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import control as ct

from ..arguments import as_list, shown
from .effect import Effect

__all__ = ["as_effects", "describe_effects"]


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


def describe_effects(effects: Sequence[Effect]) -> str:
    """Effects as a table of at most 80 columns.

    Parameters
    ----------
    effects : sequence of Effect
        For example what `effect_library` returns.

    Returns
    -------
    str
        One effect per line with its law, grouped by place.

    Examples
    --------
    >>> print(describe_effects([Effect("damping", "link1"), Effect("input_gain", "force")]))
    link1
      damping               f = t v
    force
      input_gain            w -> (1 + t) w
    """
    effects = as_effects(effects, "effects")
    lines: list[str] = []
    for place in dict.fromkeys(effect.place for effect in effects):
        lines.append(place[:80])
        for effect in effects:
            if effect.place == place:
                name = effect.name or effect.kind
                lines.append(f"  {name[:26]:<21} {effect.spec.formula}"[:80].rstrip())
    return "\n".join(lines)
