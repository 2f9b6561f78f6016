"""Candidate changes of a structure, and their nominal values.

By default, every stiffness is a candidate. A change in percent is relative to the nominal value.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import control as ct

from ..arguments import as_list
from ..effects.dampers import Damping
from ..effects.effect import Effect
from ..effects.springs import Stiffness
from ..engine.structure import Structure
from ..exceptions import ModelError
from ..inference.refinement import Refinement
from ..models.physical_model import PhysicalModel
from .damping import RatioStructure

__all__ = ["Candidate", "as_candidates", "candidate_effects", "default_rule", "nominal_values"]


@dataclass(frozen=True, slots=True)
class Candidate:
    """A change that is looked for: its column, and what counts as 100 percent."""

    column: int
    kind: str
    place: str
    name: str
    nominal: float
    unit: str
    tolerated: float
    floor: float

    @property
    def label(self) -> str:
        """Kind and place."""
        return f"{self.kind} at {self.place}"


def nominal_values(model: Any, physical: PhysicalModel) -> dict[tuple[str, str], float]:
    """Values of the parameters by kind and place, as built or as refined."""
    nominal = {(q.kind, q.place): q.value for q in physical.parameters}
    if isinstance(model, Refinement):
        nominal.update({(row.kind, row.place): row.value for row in model.parameters if row.initial != 0})
    return nominal


def default_rule(physical: PhysicalModel, nominal: Mapping[tuple[str, str], float]) -> str:
    """Return the damping rule that suits the model: "links" or "ratio".

    With dampers in the model, each damped link has its own damping. Otherwise one factor scales all modal
    damping ratios.
    """
    if any(kind == Damping.name and value != 0 for (kind, _), value in nominal.items()):
        return "links"
    try:
        RatioStructure(physical)
    except ModelError:
        return "links"
    return "ratio"


def candidate_effects(physical: PhysicalModel, given: Sequence[Any] | None, rule: str) -> list[Effect]:
    """Return the candidate changes: those given, or every stiffness.

    With the rule "links", every damper is a candidate, too.
    """
    if given is not None:
        entries = (
            [given] if isinstance(given, str | Effect) else as_list(given, "candidates", "effects or places")
        )
        effects = [Effect(Stiffness.name, e) if isinstance(e, str) else e for e in entries]
        for effect in effects:
            if not isinstance(effect, Effect) or not effect.spec.is_element:
                raise ct.ControlArgument(
                    f"candidates are stiffness, damping or mass effects or places, not {effect!r}; "
                    "other kinds belong to hypotheses="
                )
            physical.check(effect)
        if len(set(effects)) < len(effects):
            raise ct.ControlArgument("candidates holds an effect twice; give each once")
    else:
        springs = [q.place for q in physical.parameters if q.kind == Stiffness.name and q.value != 0]
        effects = [Effect(Stiffness.name, place) for place in springs]
        if rule == "links":
            dampers = [q.place for q in physical.parameters if q.kind == Damping.name and q.value != 0]
            effects += [Effect(Damping.name, place) for place in dampers or springs]
    if not effects:
        raise ModelError(
            f"model {physical.name!r} has no stiffness at any link: use a builder such as "
            "mass_spring_damper, states in displacements and velocities, or candidates="
        )
    return effects


def as_candidates(
    structure: Structure,
    effects: Sequence[Effect],
    nominal: Mapping[tuple[str, str], float],
    tolerance: float,
    least: float,
) -> list[Candidate]:
    """The effects with their columns, and the sizes that count as 100 percent."""
    names = {(q.kind, q.place): q.name for q in structure.model.parameters}
    found = []
    for index, effect in enumerate(effects):
        column = structure.position(index, effect.coefficients[0])
        if column < 0:
            raise ModelError(f"{effect.label} is fixed, so it cannot be a candidate")
        size = nominal.get((effect.kind, effect.place), 0.0)
        found.append(
            Candidate(
                column,
                effect.kind,
                effect.place,
                names.get((effect.kind, effect.place), effect.label),
                size,
                structure.unit(structure.parameters[column]),
                tolerance * abs(size),
                least / 100.0 * abs(size),
            )
        )
    return found
