"""What may be open beside the effects: each nuisance makes another base for them, one class each."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, Protocol, cast

import numpy as np

from ..data.measurement import HOLDS
from ..effects.bodies import Mass
from ..effects.effect import Effect
from ..exceptions import IdentifiabilityWarning, unheard
from ..inference.assembly import nominal_size
from ..inference.fitted import FittedModel, fitted_from
from ..inference.refinement import Refinement
from ..models.library import effect_library
from ..refinement.base_fit import base_fit
from ..refinement.refine import refine
from ..systems.linear import Array

if TYPE_CHECKING:
    from .case import Case
    from .hypothesis import Trial

__all__ = [
    "Hold",
    "NoisyInputs",
    "Nuisance",
    "Parameters",
    "UnmeasuredForce",
    "between_steps",
    "parameters_of",
    "with_fitting_priors",
]

_FORCES = 14  # sizes and places of an unmeasured force, all as likely
_STRONG = 75.0  # fit in percent below which parameters are sought from afar
_SEEN = 0.5  # share of its prior variance that the data take from a combination which they determine
_SAME = 0.1  # relative change of a prior that is none
_LEFT = 2.0  # standard deviations of a prior beyond which a parameter has left it
_ROUNDS = 3
_STEP, _STEPS, _EXACT = 6.0, 0.35, 1e-6  # a step in standard deviations, share of steps, noise that is none
_WHITE, _APART = 0.3, 3.0  # autocorrelation of noise; standard deviations between two levels
_LASTS = 3  # samples of a level


class Nuisance(Protocol):
    """A nuisance: a prior probability, and the base that has it open."""

    @property
    def log_prior(self) -> float:
        """Log of its prior probability over that of its absence."""

    def base(self, case: Case, fitted: FittedModel) -> FittedModel:
        """Fit a base with it open."""


@dataclass(frozen=True)
class Parameters:
    """All parameters of the model are open, each with a prior.

    Attributes
    ----------
    spread : float
        Relative standard deviation under which they are fitted.
    """

    spread: float
    log_prior: float = 0.0

    def base(self, case: Case, fitted: FittedModel) -> FittedModel:
        """Fit the model with its parameters; as it is where it has none."""
        numbers = parameters_of(case)
        if not numbers:
            return fitted
        loose = [e.replace(prior={e.coefficients[0]: self.spread * size}) for e, size in numbers]
        with unheard(IdentifiabilityWarning):
            refined = base_fit(fitted.refinement, case.records, free=loose, **case.options)
        return _on_records(case, fitted, refined)


@dataclass(frozen=True)
class Hold:
    """The inputs run otherwise between the samples than declared."""

    hold: str
    log_prior: float = -float(np.log(len(HOLDS)))

    def base(self, case: Case, fitted: FittedModel) -> FittedModel:
        """Fit the model under that hold."""
        old = fitted.refinement.with_hold(self.hold)
        return _on_records(case, fitted, base_fit(old, case.records, free=(), **case.options))


@dataclass(frozen=True)
class UnmeasuredForce:
    """A force that nobody measured acts all the time.

    Attributes
    ----------
    at : str
        "everywhere" or "inputs".
    ratio : float
        Its size over that of the measured force.
    """

    at: str
    ratio: float
    log_prior: float = -float(np.log(_FORCES))

    def base(self, case: Case, fitted: FittedModel) -> FittedModel:
        """The same model; its predictor allows for the force."""
        base = fitted.forced(self.at)
        return replace(base) if base is fitted else base


@dataclass(frozen=True)
class NoisyInputs:
    """The inputs move in steps, and what was recorded of them has noise that the plant never felt."""

    log_prior: float = -float(np.log(2.0))

    def base(self, case: Case, fitted: FittedModel) -> FittedModel:
        """The model on records whose inputs are constant between their steps."""
        records = [replace(r, inputs=between_steps(r.inputs)) for r in fitted.problem.records]
        problem = fitted.problem.like(records=records)
        return replace(fitted, problem=problem, _blocks={}, _gains={}, _states={})


def between_steps(inputs: Array) -> Array:
    """Return inputs (n_w, N) with their means between steps, those that are no noisy steps as they are."""
    found = inputs.copy()
    for row in found:
        jumps = np.diff(row)
        noise = 1.4826 * float(np.median(np.abs(jumps - np.median(jumps))))
        ends = np.flatnonzero(np.abs(jumps) > _STEP * noise) + 1
        if not (noise > _EXACT * np.ptp(row) and 0 < ends.size < _STEPS * row.size):
            continue
        parts = np.split(row, ends)
        sizes, means = np.array([part.size for part in parts]), np.array([part.mean() for part in parts])
        long = np.flatnonzero(sizes >= _LASTS)
        order = long[np.argsort(means[long])]
        apart = noise / np.sqrt(2) * np.sqrt(1 / sizes[order][1:] + 1 / sizes[order][:-1])
        groups = np.split(order, np.flatnonzero(np.diff(means[order]) > _APART * apart) + 1)
        for group in groups:  # the same level again
            means[group] = np.average(means[group], weights=sizes[group])
        level = np.repeat(means, sizes)
        left = row - level
        if abs(left[1:] @ left[:-1]) < _WHITE * float(left @ left):
            row[:] = level
    return found


def _on_records(case: Case, fitted: FittedModel, refined: Any) -> FittedModel:
    """A refinement on the records of another fit, in the units of its noise."""
    problem, tolerance = fitted.problem, case.options["tolerance"]
    return fitted_from(refined, problem.records, tolerance=tolerance, noise=1.0 / problem.weights)


def with_fitting_priors(case: Case, trial: Trial) -> Refinement:
    """The parameters of a trial, estimated under priors as wide as they turn out to be off.

    Where the combinations that the data determine are further off than the prior says, those that they do
    not determine may be as far off: all priors grow by one factor, so that the mean square of the former
    is as expected, and that of a parameter which is further off still grows to what it is off by.
    """
    numbers, near, by = parameters_of(case), case.levels.off, cast(Any, base_fit)
    sizes = near * np.array([size for _, size in numbers])
    wide, base = sizes, case.base
    for hold in (one.hold for one in trial.hypothesis.nuisances if isinstance(one, Hold)):
        base = base.with_hold(hold)
    gains = [effect.replace() for effect in trial.effects]
    if float(np.min(trial.model.refinement.fit)) < _STRONG:  # resonances moved: another valley
        wide, by = sizes / near, refine

    def fit(wide: Array) -> Refinement:
        loose = [
            e.replace(prior={e.coefficients[0]: float(sd)}) for (e, _), sd in zip(numbers, wide, strict=True)
        ]
        with case.progress.step("parameters"), unheard(IdentifiabilityWarning):  # `determined` says it
            refined: Refinement = by(base, case.records, free=[*loose, *gains], **case.options)
        return refined

    refined = fit(wide)
    for _ in range(_ROUNDS):
        rows = [(row.kind, row.place) for row in refined.parameters]
        at = [rows.index((e.kind, e.place)) for e, _ in numbers]
        moved = refined.theta[at]
        C = np.nan_to_num(refined.covariance[np.ix_(at, at)] / np.outer(wide, wide), posinf=1.0)
        told, turn = np.linalg.eigh(np.eye(len(at)) - C)  # share of the prior variance that data took away
        seen = told > _SEEN
        off = (turn.T @ (moved / wide))[seen] ** 2 / told[seen]
        wider = np.maximum(sizes, wide * np.sqrt(np.mean(off) if off.size else 0.0))
        wider = np.where(np.abs(moved) > _LEFT * wider, np.abs(moved), wider)
        if np.allclose(wider, wide, rtol=_SAME):
            break
        wide = wider
        refined = fit(wide)
    return refined


def parameters_of(case: Case) -> list[tuple[Effect, float]]:
    """Return every parameter that may be off, with its nominal size: declared ones and masses."""
    physical, structure = case.base.physical_model, case.fitted.structure
    declared = [Effect(q.kind, q.place) for q in physical.parameters]
    masses = [e for e in effect_library(physical) if e.kind == Mass.name]
    held = {(e.kind, e.place) for e in case.base.effects}
    every = {(e.kind, e.place): e for e in [*masses, *declared] if (e.kind, e.place) not in held}
    sized = [(e, nominal_size(structure, e)) for e in every.values()]
    return [(e, size) for e, size in sized if 0.0 < size < np.inf]
