"""Nuisances of a hypothesis; each gives another base for the effects."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, Protocol, cast

import numpy as np

from ..data import HOLDS
from ..data.measurement import Measurement
from ..data.signals import over_time
from ..effects.bodies import Mass
from ..effects.effect import Effect
from ..engine.controlled import integrates
from ..exceptions import IdentifiabilityWarning, unheard
from ..inference.assembly import offsets_everywhere
from ..inference.fitted import FittedModel, fitted_from
from ..inference.levels import Levels, levels
from ..inference.parameters import nominal_size
from ..inference.refinement import Refinement
from ..models.library import effect_library
from ..models.operating_point import ordered_record
from ..refinement.refine import base_fit, refine, refit
from ..systems.linear import Array
from .residual_tests import TestedResidual

if TYPE_CHECKING:
    from .case import Case
    from .hypothesis import Trial
    from .search import Search


_STRONG = 75.0  # fit in percent below which the parameters are searched for in a wide range
_SEEN = 0.5  # least relative reduction of the prior variance of a determined combination
_SAME = 0.1  # relative change of the priors at which the iteration ends
_LEFT = 2.0  # prior standard deviations beyond which a parameter gets a prior of its own
_ROUNDS = 3
_SIZES = (0.002, 0.004, 0.008, 0.016, 0.032, 0.064, 0.128)  # ratios of the unmeasured to the measured force
_AT = ("everywhere", "inputs")
_STEP, _STEPS, _EXACT = 6.0, 0.35, 1e-6  # least step in standard deviations, most steps (share), least noise
_WHITE, _APART = 0.3, 3.0  # most autocorrelation of noise; least distance of two levels (std)
_LASTS = 3  # least samples of a level


class Nuisance(Protocol):
    """Protocol of a nuisance: a prior probability and a fitted base."""

    @property
    def log_prior(self) -> float:
        """Return the log of its prior odds over its absence."""

    def base(self, case: Case, fitted: FittedModel) -> FittedModel:
        """Fit the base with this nuisance."""


@dataclass(frozen=True)
class Parameters:
    """Re-estimated parameters of the model, each with a prior.

    Attributes
    ----------
    spread : float
        Prior standard deviation of each parameter, relative to its nominal size.
    """

    spread: float
    log_prior: float = 0.0

    def base(self, case: Case, fitted: FittedModel) -> FittedModel:
        """Fit the model with its parameters; return it unchanged if it has none."""
        numbers = parameters_of(case)
        if not numbers:
            return fitted
        loose = [e.replace(prior={e.coefficients[0]: self.spread * size}) for e, size in numbers]
        with unheard(IdentifiabilityWarning):
            refined = base_fit(fitted.refinement, case.records, free=loose, **case.options)
        return _on_records(case, fitted, refined)


@dataclass(frozen=True)
class Hold:
    """Another hold: inputs between the samples differ from the declared ones."""

    hold: str
    log_prior: float = -float(np.log(len(HOLDS)))

    def base(self, case: Case, fitted: FittedModel) -> FittedModel:
        """Fit the model with this hold."""
        old = fitted.refinement.with_hold(self.hold)
        return _on_records(case, fitted, base_fit(old, case.records, free=(), **case.options))


@dataclass(frozen=True)
class UnmeasuredForce:
    """A persistent unmeasured force (process noise).

    Attributes
    ----------
    at : str
        "everywhere" or "inputs".
    ratio : float
        Ratio of its size to that of the measured force.
    """

    at: str
    ratio: float
    log_prior: float = -float(np.log(len(_SIZES) * len(_AT)))

    def base(self, case: Case, fitted: FittedModel) -> FittedModel:
        """Return the model with a Kalman predictor that allows for the force."""
        base = fitted.forced(self.at)
        return replace(base) if base is fitted else base


@dataclass(frozen=True)
class NoisyInputs:
    """Noise in the record of stepwise inputs; it did not act on the plant."""

    log_prior: float = -float(np.log(2.0))

    def base(self, case: Case, fitted: FittedModel) -> FittedModel:
        """Return the model on records with inputs constant between steps."""
        records = [replace(r, inputs=between_steps(r.inputs)) for r in fitted.problem.records]
        problem = fitted.problem.like(records=records)
        return replace(fitted, problem=problem, _blocks={}, _gains={}, _states={})


def likely_forces(trial: Trial, least: float, levels: Levels) -> list[TestedResidual]:
    """Return residuals with likely unmeasured forces, the best first.

    The force acts at the inputs or everywhere, with one of several sizes.

    Parameters
    ----------
    trial : Trial
        Fit without such a force.
    least : float
        Least gain in log-likelihood.
    levels : Levels
        Levels; within `force_size` of the best log-likelihood, a size is likely.

    Returns
    -------
    list of TestedResidual
        Residuals of the Kalman predictor; empty if no force gains more than `least`.
    """
    found: list[TestedResidual] = []
    for at in _AT:
        top = -np.inf
        for ratio in _SIZES:
            # Kalman predictor with this ratio of forces
            try:
                led = TestedResidual(trial.model.forced(at), ratio)
            except (np.linalg.LinAlgError, ValueError):
                continue
            if np.isfinite(led.log_likelihood):
                found.append(led)
                top = max(top, led.log_likelihood)
            if not led.log_likelihood >= top - 3 * levels.force_size:
                break  # larger forces are still less likely
    found.sort(key=lambda led: -led.log_likelihood)
    if not found or found[0].log_likelihood <= trial.tested.log_likelihood + least:
        return []
    return [led for led in found if led.log_likelihood >= found[0].log_likelihood - levels.force_size]


def between_steps(inputs: Array) -> Array:
    """Return inputs (n_w, N) replaced by their means between steps.

    Inputs that are not steps with white noise stay unchanged. Means that do not differ significantly are
    pooled to one level.
    """
    found = inputs.copy()
    for row in found:
        # steps: jumps beyond the noise of the differences
        jumps = np.diff(row)
        noise = 1.4826 * float(np.median(np.abs(jumps - np.median(jumps))))
        ends = np.flatnonzero(np.abs(jumps) > _STEP * noise) + 1
        if not (noise > _EXACT * np.ptp(row) and 0 < ends.size < _STEPS * row.size):
            continue
        parts = np.split(row, ends)
        sizes, means = np.array([part.size for part in parts]), np.array([part.mean() for part in parts])
        long = np.flatnonzero(sizes >= _LASTS)
        order = long[np.argsort(means[long])]
        # levels that differ by less than their standard error are one
        apart = noise / np.sqrt(2) * np.sqrt(1 / sizes[order][1:] + 1 / sizes[order][:-1])
        groups = np.split(order, np.flatnonzero(np.diff(means[order]) > _APART * apart) + 1)
        for group in groups:  # means of one level
            means[group] = np.average(means[group], weights=sizes[group])
        level = np.repeat(means, sizes)
        left = row - level
        # what remains must be white, or it was part of the input
        if abs(left[1:] @ left[:-1]) < _WHITE * float(left @ left):
            row[:] = level
    return found


def _on_records(case: Case, fitted: FittedModel, refined: Any) -> FittedModel:
    """Return a refinement on the records, and in the units, of another fit."""
    problem, tolerance = fitted.problem, case.options["tolerance"]
    return fitted_from(refined, problem.records, tolerance=tolerance, noise=1.0 / problem.weights)


def with_fitting_priors(case: Case, trial: Trial) -> Refinement:
    """Return the parameters of a trial, estimated with adapted prior widths.

    The data determine some combinations of the parameters. If these differ from nominal by more than the
    prior expects, the undetermined ones may differ as much. All priors are then widened by one factor, which
    makes the mean square of the determined combinations as expected. A parameter more than two prior standard
    deviations from nominal gets a prior as wide as its change.
    """
    numbers, near, by = parameters_of(case), case.levels.off, cast(Any, base_fit)
    sizes = near * np.array([size for _, size in numbers])
    wide, base = sizes, case.base
    for hold in (one.hold for one in trial.hypothesis.nuisances if isinstance(one, Hold)):
        base = base.with_hold(hold)
    gains = [effect.replace() for effect in trial.effects]
    if float(np.min(trial.model.refinement.fit)) < _STRONG:  # resonances moved: another minimum
        wide, by = sizes / near, refine

    def fit(wide: Array) -> Refinement:
        loose = [
            e.replace(prior={e.coefficients[0]: float(sd)}) for (e, _), sd in zip(numbers, wide, strict=True)
        ]
        with case.progress.step("parameters"), unheard(IdentifiabilityWarning):  # `determined` reports it
            refined: Refinement = by(base, case.records, free=[*loose, *gains], **case.options)
        return refined

    refined = fit(wide)
    # scale the priors until the determined combinations are as large as expected
    for _ in range(_ROUNDS):
        rows = [(row.kind, row.place) for row in refined.parameters]
        at = [rows.index((e.kind, e.place)) for e, _ in numbers]
        moved = refined.theta[at]
        C = np.nan_to_num(refined.covariance[np.ix_(at, at)] / np.outer(wide, wide), posinf=1.0)
        # eigenvectors: combinations of parameters that the data determine
        told, turn = np.linalg.eigh(np.eye(len(at)) - C)  # relative reduction of the prior variance
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
    """Return the parameters that may be wrong, each with its nominal size.

    These are the declared parameters and the masses that the model does not hold as effects.
    """
    physical, structure = case.base.physical_model, case.fitted.structure
    declared = [Effect(q.kind, q.place) for q in physical.parameters]
    masses = [e for e in effect_library(physical) if e.kind == Mass.name]
    held = {(e.kind, e.place) for e in case.base.effects}
    every = {(e.kind, e.place): e for e in [*masses, *declared] if (e.kind, e.place) not in held}
    sized = [(e, nominal_size(structure, e)) for e in every.values()]
    return [(e, size) for e, size in sized if 0.0 < size < np.inf]


def with_offsets(base: Refinement, records: Sequence[Measurement], options: dict[str, Any]) -> Refinement:
    """Return the model refitted with an offset at every input and output.

    A linear model cannot distinguish an offset of a sensor from an offset of an input or an initial state. A
    nonlinear effect depends on the zero of its signal and is not recognized at a wrong zero. The model is
    returned unchanged if it has no offset, if it integrates, or if the means of the outputs are small. The
    same holds for frequency responses.
    """
    if "offset" not in base.roles:
        return base
    ordered = [ordered_record(base.physical_model, record) for record in records]
    if not ordered[0].in_time or integrates(base.physical_model.linear, ordered[0]):
        return base
    y = np.concatenate([record.outputs for record in ordered], axis=1)
    if not np.any(np.abs(over_time(np.mean, y)) > levels().zero * over_time(np.std, y)):
        return base  # so small an offset does not hide an effect
    everywhere = offsets_everywhere(base.physical_model, ordered)
    return refit(base, records, offsets=everywhere, elsewhere=False, **options)


def about_hold(trial: Trial, search: Search) -> list[str]:
    """Return notes on another hold that fits better than the declared one."""
    model, records = search.case.base.physical_model, search.case.records
    said = "the record declares" if model.hold is None else "the model was fitted with"
    return [
        f"The hold matters more than most effects: {said} hold={model.hold or records[0].hold!r}, "
        f"hold={one.hold!r} fits better."
        for one in trial.hypothesis.nuisances
        if isinstance(one, Hold)
    ]
