"""Changes that may explain a record: candidates, and damage scenarios.

By default, every stiffness is a candidate. A change in percent is relative to the nominal value. Scenarios
are fitted one by one and ranked.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import control as ct
import numpy as np

from ..arguments import as_list, as_mapping
from ..data.measurement import Measurement
from ..effects.dampers import Damping
from ..effects.effect import Effect
from ..effects.springs import Stiffness
from ..engine.structure import Structure
from ..exceptions import ModelError
from ..inference.fit import Fit
from ..inference.refinement import Refinement
from ..inference.starts import Motion, law_widths
from ..inference.whitening import Whitener
from ..models.physical_model import PhysicalModel
from ..systems.linear import Array
from .damage_map import HypothesisRow
from .damping import RatioStructure
from .estimate import Joint, best_fit


@dataclass(frozen=True, slots=True)
class DamageCandidate:
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
    # values as built; a refinement replaces those it estimated
    nominal = {(q.kind, q.place): q.value for q in physical.parameters}
    if isinstance(model, Refinement):
        nominal.update({(row.kind, row.place): row.value for row in model.parameters if row.initial != 0})
    return nominal


def default_rule(physical: PhysicalModel, nominal: Mapping[tuple[str, str], float]) -> str:
    """Return the damping rule that suits the model: "links" or "ratio".

    With dampers in the model, each damped link has its own damping. Otherwise one factor scales all modal
    damping ratios.
    """
    # dampers in the model: each may change on its own
    if any(kind == Damping.name and value != 0 for (kind, _), value in nominal.items()):
        return "links"
    # one factor for all modal damping ratios, where these are defined
    try:
        RatioStructure(physical)
    except ModelError:
        return "links"
    return "ratio"


def candidate_effects(physical: PhysicalModel, given: Sequence[Any] | None, rule: str) -> list[Effect]:
    """Return the candidate changes: those given, or every stiffness.

    With the rule "links", every damper is a candidate, too.
    """
    effects = _model_elements(physical, rule) if given is None else _given_elements(physical, given)
    if not effects:
        raise ModelError(
            f"model {physical.name!r} has no stiffness at any link: use a builder such as "
            "mass_spring_damper, states in displacements and velocities, or candidates="
        )
    return effects


def _model_elements(physical: PhysicalModel, rule: str) -> list[Effect]:
    """Return every spring, and with the rule "links" every damper.

    Without any damper there is one at each spring.
    """
    springs, dampers = (
        [q.place for q in physical.parameters if q.kind == kind and q.value != 0]
        for kind in (Stiffness.name, Damping.name)
    )
    damped = (dampers or springs) if rule == "links" else []
    return [Effect(Stiffness.name, p) for p in springs] + [Effect(Damping.name, p) for p in damped]


def _given_elements(physical: PhysicalModel, given: Any) -> list[Effect]:
    """Check candidates; the name of a place means its stiffness."""
    single = isinstance(given, str | Effect)
    entries = [given] if single else as_list(given, "candidates", "effects or places")
    effects = [Effect(Stiffness.name, entry) if isinstance(entry, str) else entry for entry in entries]
    for effect in effects:
        if not isinstance(effect, Effect) or not effect.spec.is_element:
            raise ct.ControlArgument(
                f"candidates are stiffness, damping or mass effects or places, not {effect!r}; "
                "other kinds belong to hypotheses="
            )
        physical.check(effect)
    if len(set(effects)) < len(effects):
        raise ct.ControlArgument("candidates holds an effect twice; give each once")
    return effects


def as_candidates(
    structure: Structure,
    effects: Sequence[Effect],
    nominal: Mapping[tuple[str, str], float],
    tolerance: float,
    least: float,
) -> list[DamageCandidate]:
    """The effects with their columns, and the sizes that count as 100 percent."""
    names = {(q.kind, q.place): q.name for q in structure.model.parameters}
    # one column of the problem each; changes count relative to the nominal value
    found = []
    for index, effect in enumerate(effects):
        key, column = (effect.kind, effect.place), structure.position(index, effect.coefficients[0])
        if column < 0:
            raise ModelError(f"{effect.label} is fixed, so it cannot be a candidate")
        size, unit = nominal.get(key, 0.0), structure.unit(structure.parameters[column])
        limits = tolerance * abs(size), least / 100.0 * abs(size)
        found.append(DamageCandidate(column, *key, names.get(key, effect.label), size, unit, *limits))
    return found


UNDAMAGED = "no damage"


@dataclass(frozen=True, slots=True, eq=False)
class SharedSetting:
    """Model, records and nuisance parameters that all hypotheses share."""

    physical: PhysicalModel
    base: tuple[Effect, ...]
    nuisances: tuple[tuple[Effect, str], ...]
    tolerance: float
    ratio: bool
    segments: tuple[Measurement, ...]
    noise: Any
    initial: Array | None
    motion: Motion
    nominal: Mapping[tuple[str, str], float]

    def structure(self, effects: Sequence[Effect]) -> Structure:
        """Model with some effects and all nuisances."""
        # changes first, then nuisances, then effects of the refinement
        everything = [*effects, *(e for e, _ in self.nuisances), *self.base]
        made: type[Structure] = RatioStructure if self.ratio else Structure
        # widths of smoothed laws follow from the motion
        plain = made(self.physical, everything)
        return made(self.physical, everything, constants=law_widths(plain, self.motion))

    def joint(self, effects: Sequence[Effect]) -> Joint:
        """Estimate some effects with all nuisances."""
        structure = self.structure(effects)
        roles = ["change"] * len(effects) + [role for _, role in self.nuisances]
        roles += ["effect"] * (len(structure.effects) - len(roles))

        # Gauss-Newton from the nominal model, or from the spectrum where that does not converge
        def fit() -> Fit:
            return Fit(structure, roles, self.segments, self.noise, self.initial, self.tolerance)

        return Joint(best_fit(fit, self.motion))


def named_hypotheses(hypotheses: Any) -> dict[str, tuple[Effect, ...]]:
    """Scenarios by name, in whatever form they were given.

    Parameters
    ----------
    hypotheses : mapping or sequence
        ``{name: effects}``, or a sequence of effects lists; an effect may be given
        as the name of a place, which means a changed stiffness there.

    Returns
    -------
    dict
        ``{name: effects}``, the undamaged structure included.

    Raises
    ------
    control.ControlArgument
        If an entry is not an effect or a place.
    """
    if isinstance(hypotheses, str | Effect):
        hypotheses = [hypotheses]
    pairs: list[tuple[str | None, Any]]
    if isinstance(hypotheses, Mapping):
        pairs = list(as_mapping(hypotheses, "hypotheses", "effects").items())
    else:
        pairs = [(None, entry) for entry in as_list(hypotheses, "hypotheses", "effects or lists of them")]
    found: dict[str, tuple[Effect, ...]] = {}
    for name, entry in pairs:
        single = isinstance(entry, str | Effect)
        entries = [entry] if single else as_list(entry, "a hypothesis", "effects or places")
        effects = tuple(_as_effect(e) for e in entries)
        key = " + ".join(e.label for e in effects) or UNDAMAGED if name is None else str(name)
        if key in found:
            raise ct.ControlArgument(f"hypotheses holds {key!r} twice; give each scenario once")
        found[key] = effects
    # no damage is always among the scenarios
    if not any(len(effects) == 0 for effects in found.values()):
        found[UNDAMAGED] = ()
    return found


def _as_effect(entry: Any) -> Effect:
    if isinstance(entry, Effect):
        return entry
    if isinstance(entry, str):
        return Effect(Stiffness.name, entry)
    raise ct.ControlArgument(
        f"a hypothesis holds Effect objects or names of places, not {type(entry).__name__}"
    )


def rank_hypotheses(setting: SharedSetting, hypotheses: Any) -> tuple[HypothesisRow, ...]:
    """Fit every scenario and rank them by likelihood, parameters paid for.

    Parameters
    ----------
    setting : SharedSetting
        Model, records, nuisances.
    hypotheses : mapping or sequence
        As for `named_hypotheses`.

    Returns
    -------
    tuple of HypothesisRow
        The most probable first.
    """
    scenarios = named_hypotheses(hypotheses)
    # what a scenario blames is no nuisance, or "no damage" would explain it as well
    blamed = {e.key for effects in scenarios.values() for e in effects}
    rest = tuple((e, role) for e, role in setting.nuisances if e.key not in blamed)
    setting = replace(setting, nuisances=rest)
    # each scenario is fitted with the same nuisances
    rows = [_fit_scenario(setting, name, effects) for name, effects in scenarios.items()]
    # Bayesian information criterion; weights exp(-BIC / 2) as probabilities
    criterion = np.array([row.bic for row in rows])
    weight = np.exp(-0.5 * (criterion - criterion.min()))
    weight /= weight.sum()
    ranked = [replace(row, probability=float(share)) for row, share in zip(rows, weight, strict=True)]
    return tuple(sorted(ranked, key=lambda row: row.bic))


def _fit_scenario(setting: SharedSetting, name: str, effects: tuple[Effect, ...]) -> HypothesisRow:
    joint = setting.joint(effects)
    # likelihood of the residual whitened by an autoregressive model
    structure, whitener = joint.structure, Whitener.fit([joint.residual], floor=1e-150)
    value = whitener.log_likelihood([joint.residual])
    spread = joint.spread(np.ones(structure.n_parameters, dtype=bool))
    changes, std, percent = {}, {}, {}
    # changes with deviations, absolute and in percent of the nominal value
    for i, parameter in enumerate(structure.parameters):
        if parameter.effect < len(effects):
            effect, change = effects[parameter.effect], float(joint.theta[i])
            changes[parameter.label], std[parameter.label] = change, float(spread[i])
            size = setting.nominal.get((effect.kind, effect.place), 0.0)
            if size:
                percent[parameter.label] = 100.0 * change / size
    # BIC: parameters and coefficients of the noise model count
    bic = float(
        -2.0 * value + (structure.n_parameters + sum(whitener.orders)) * np.log(joint.problem.n_points)
    )
    fit_percent = tuple(map(float, joint.fit_percent))
    return HypothesisRow(name, effects, changes, std, percent, fit_percent, value, bic, 0.0)
