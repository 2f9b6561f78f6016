"""Effects that are others by another name: no record tells them apart."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from ...effects.effect import Effect
from .improvement import Step
from .selection import same

__all__ = ["with_other_names"]


def with_other_names(steps: Sequence[Step]) -> tuple[list[Step], list[str]]:
    """The steps, each effect tied with the one that it is by another name, and a sentence for each.

    Parameters
    ----------
    steps : sequence of Step
        Of a ladder.

    Returns
    -------
    steps : list of Step
    sentences : list of str
    """
    named, sentences = [], []
    for step in steps:
        other = _other_name(step)
        if step.effect is not None and other is not None:
            sentences.append(
                f"{step.effect.label} with the constant offset is {other.label} by another name: "
                "the record cannot tell them apart."
            )
        named.append(step if other is None else replace(step, rivals=(*step.rivals, other)))
    return named, sentences


def _other_name(step: Step) -> Effect | None:
    """The law that this one is by another name, where a constant offset acts at the same place."""
    effect, held = step.effect, step.refinement
    if effect is None or not effect.spec.with_offset or step.action == "drop":
        return None
    linear = held.physical_model.linear
    act = held.physical_model.port(effect.place).act
    for offset, role in zip(held.effects, held.roles, strict=True):
        if role != "offset":
            continue
        port = next((p for p in held.physical_model.ports if p.name == offset.place), None)
        push = offset.spec.push(linear, offset.place, None if port is None else port.act)
        if push is not None and abs(push @ act) > (1 - 1e-9) * np.linalg.norm(push) * np.linalg.norm(act):
            other = Effect(effect.spec.with_offset, effect.place)
            return None if any(same(other, e) for e in (*held.effects, *step.rivals)) else other
    return None
