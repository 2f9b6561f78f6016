"""A collection of hypothesized damage scenarios: each fitted, all ranked."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import control as ct
import numpy as np

from ..arguments import as_list, as_mapping
from ..data.measurement import Measurement
from ..effects.effect import Effect
from ..effects.springs import Stiffness
from ..engine.structure import Structure
from ..inference.covariance import standard_deviations
from ..inference.fit import Fit
from ..inference.outcome import output_weights
from ..inference.problem import Problem
from ..inference.starts import Motion, law_widths
from ..models.physical_model import PhysicalModel
from ..systems.linear import Array
from .damage_map import HypothesisRow
from .damping import RatioStructure
from .estimate import Joint, log_likelihood

__all__ = ["Setting", "named_hypotheses", "rank_hypotheses"]

UNDAMAGED = "no damage"


@dataclass(frozen=True, slots=True, eq=False)
class Setting:
    """Model, records and nuisance parameters that all hypotheses share."""

    physical: PhysicalModel
    base: tuple[Effect, ...]
    nuisances: tuple[Effect, ...]
    nuisance_sd: tuple[float, ...]
    ratio: bool
    segments: tuple[Measurement, ...]
    noise: Any
    initial: Array | None
    substeps: int
    motion: Motion
    nominal: Mapping[tuple[str, str], float]

    def structure(self, effects: Sequence[Effect]) -> Structure:
        """Model with some effects and all nuisances."""
        everything = [*effects, *self.nuisances, *self.base]
        made: type[Structure] = RatioStructure if self.ratio else Structure
        plain = made(self.physical, everything)
        return made(self.physical, everything, constants=law_widths(plain, self.motion))

    def priors(self, structure: Structure, effects: Sequence[Effect]) -> tuple[Array, Array]:
        """Gaussian priors of all coefficients."""
        mean = np.zeros(structure.n_parameters)
        sd = np.full(structure.n_parameters, np.inf)
        for i, parameter in enumerate(structure.parameters):
            if parameter.effect < len(effects):
                effect = effects[parameter.effect]
                if parameter.name in effect.prior:
                    sd[i] = effect.prior[parameter.name]
                    mean[i] = effect.start.get(parameter.name, 0.0)
            elif parameter.effect < len(effects) + len(self.nuisances):
                sd[i] = self.nuisance_sd[parameter.effect - len(effects)]
        if isinstance(structure, RatioStructure):
            mean[structure.ratio_columns[1]], sd[structure.ratio_columns[1]] = 0.5, 0.5
        return mean, sd

    def joint(self, effects: Sequence[Effect]) -> Joint:
        """Estimate of some effects with all nuisances, not started yet."""
        structure = self.structure(effects)
        mean, sd = self.priors(structure, effects)
        problem = Problem(
            structure, self.segments, output_weights(list(self.segments), self.noise), prior_mean=mean,
            prior_sd=sd, substeps=self.substeps, hold_brief=False,
            initial=None if self.initial is None else self._start(structure),
        )  # fmt: skip
        return Joint(problem, self.noise, n_changes=len(effects))

    def _start(self, structure: Structure) -> Array:
        assert self.initial is not None
        full = np.zeros(structure.n_states)
        full[: self.initial.size] = self.initial
        return full


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


def rank_hypotheses(setting: Setting, hypotheses: Any) -> tuple[HypothesisRow, ...]:
    """Fit every scenario and rank them by likelihood, parameters paid for.

    Parameters
    ----------
    setting : Setting
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
    blamed = {(e.kind, e.place) for effects in scenarios.values() for e in effects}
    rest = [
        (e, sd)
        for e, sd in zip(setting.nuisances, setting.nuisance_sd, strict=True)
        if (e.kind, e.place) not in blamed
    ]
    setting = replace(setting, nuisances=tuple(e for e, _ in rest), nuisance_sd=tuple(sd for _, sd in rest))
    rows = [_fitted(setting, name, effects) for name, effects in scenarios.items()]
    criterion = np.array([row.bic for row in rows])
    weight = np.exp(-0.5 * (criterion - criterion.min()))
    weight /= weight.sum()
    ranked = []
    for i in np.argsort(criterion, kind="stable"):
        ranked.append(replace(rows[int(i)], probability=float(weight[i])))
    return tuple(ranked)


def _fitted(setting: Setting, name: str, effects: tuple[Effect, ...]) -> HypothesisRow:
    joint = setting.joint(effects)
    structure = joint.structure
    if structure.is_linear:
        joint.start()
        joint.fit(np.ones(structure.n_parameters, dtype=bool), reweigh=True)
    else:
        fit = Fit(structure, ["effect"] * len(structure.effects), setting.segments, setting.noise, None, 0.0)
        fit.initial, fit.mean, fit.sd = (
            joint.problem.initial,
            joint.problem.prior_mean,
            joint.problem.prior_sd,
        )
        fit.run(setting.motion, None)
        joint.problem, joint.point = fit.problem, fit.result.x
    residual = joint.residual
    value, colours = log_likelihood(residual)
    columns = joint.columns(np.ones(structure.n_parameters, dtype=bool))
    spread = standard_deviations(joint.information().covariance(columns))
    changes, std, percent = {}, {}, {}
    theta = joint.theta
    for i, parameter in enumerate(structure.parameters):
        if parameter.effect >= len(effects):
            continue
        effect = effects[parameter.effect]
        changes[parameter.label], std[parameter.label] = float(theta[i]), float(spread[i])
        size = setting.nominal.get((effect.kind, effect.place), 0.0)
        if size:
            percent[parameter.label] = 100.0 * float(theta[i]) / size
    count = joint.problem.n_points
    measured = np.concatenate([r.outputs for r in setting.segments], axis=1)
    size = np.linalg.norm(measured - measured.mean(axis=1, keepdims=True), axis=1)
    fit_percent = 100.0 * (1.0 - np.linalg.norm(residual, axis=1) / np.where(size > 0, size, np.nan))
    return HypothesisRow(
        name,
        effects,
        changes,
        std,
        percent,
        tuple(float(v) for v in fit_percent),
        value,
        float(-2.0 * value + (structure.n_parameters + colours) * np.log(count)),
        0.0,
    )
