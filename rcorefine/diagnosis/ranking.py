"""Rows of the ranking, and smallest detectable coefficients."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy import stats

from ..comparison.compare import compare
from ..data.measurement import Measurement
from ..effects.effect import Effect
from ..inference.basis import project
from ..inference.levels import Levels
from ..inference.refinement import EstimatedParameter, Refinement
from ..inference.sensitivities import Candidate
from .case import Case
from .hypothesis import Trial, unphysical
from .residual_tests import TestedResidual
from .result import Detectable, RankedEffect

__all__ = ["detectable", "estimates", "ranking", "undetermined"]


def ranking(
    trials: Sequence[Trial],
    probabilities: Sequence[float],
    alike: Sequence[bool],
    scores: dict[Effect, float],
    nothing: float,
    case: Case,
    validation: Measurement | None,
) -> tuple[RankedEffect, ...]:
    """Return a row of the ranking for each trial, in the given order.

    Parameters
    ----------
    trials : sequence of Trial
        One for each set of effects.
    probabilities : sequence of float
        Probability of each set.
    alike : sequence of bool
        Whether the data cannot distinguish the set from the best one.
    scores : dict
        p-value of the score test of each effect.
    nothing : float
        Log evidence without any effect.
    case : Case
        Fitted model, records and settings.
    validation : Measurement or None
        Validation data for the fits; used for the first eight rows only.

    Returns
    -------
    tuple of RankedEffect
    """
    horizon, rows = case.settings["horizon"], []
    before = _validated(case.base, validation, horizon)
    for i, (trial, probability) in enumerate(zip(trials, probabilities, strict=True)):
        refinement = trial.model.refinement
        order = sorted(range(len(trial.effects)), key=lambda k: -trial.surest[k])
        first, *more = (trial.effects[k] for k in order)
        own = estimates(refinement, first)
        rows.append(
            RankedEffect(
                effect=first,
                coefficients={name: row.coefficient for name, row in own.items()},
                std={name: row.std for name, row in own.items()},
                fit_before=before,
                fit_after=_validated(refinement, validation if i < 8 else None, horizon),
                p_value=min(scores.get(effect, 1.0) for effect in trial.effects),
                probability=float(probability),
                log_likelihood_gain=trial.total - nothing,
                refinement=refinement,
                beside=tuple(more),
                alike=alike[i],
            )
        )
    return tuple(rows)


def estimates(refinement: Refinement, effect: Effect) -> dict[str, EstimatedParameter]:
    """Return the estimates of the free coefficients of an effect, by name.

    Empty if the model does not hold the effect.
    """
    name = (effect.kind, effect.place, "effect")
    rows = [row for row in refinement.parameters if (row.kind, row.place, row.role) == name]
    return dict(zip(effect.free, rows, strict=True)) if rows else {}


def undetermined(refinement: Refinement, effect: Effect, levels: Levels) -> list[EstimatedParameter]:
    """Return the estimates that keep an effect from being named or kept.

    Parameters
    ----------
    refinement : Refinement
        Model with the effect.
    effect : Effect
        Effect. Coefficients held by its `fixed` are not tested.
    levels : Levels
        Levels; `moved` is the least number of standard deviations.

    Returns
    -------
    list of EstimatedParameter
        All sizes of the effect, if none is more than `Levels.moved` standard deviations from zero or if their
        sign contradicts physics. Otherwise the insignificant ones among the essential coefficients and the
        shaping coefficients with a finite lower bound. Insignificant coefficients without a finite standard
        deviation are included, too. Empty if the data determine the effect.
    """
    rows, law = estimates(refinement, effect), effect.spec
    values = {name: row.coefficient for name, row in rows.items()}
    loose = {name: row for name, row in rows.items() if not abs(row.coefficient) > levels.moved * row.std}
    sizes = [name for name in rows if name not in law.shaping] or list(rows)
    if loose.keys() >= set(sizes) or unphysical(effect, values, refinement.physical_model):
        return [rows[name] for name in sizes]
    asked = {*law.essential, *(name for name in law.shaping if np.isfinite(effect.bounds(name)[0]))}
    return [row for name, row in loose.items() if name in asked or not np.isfinite(row.std)]


def _validated(refinement: Refinement, validation: Measurement | None, horizon: float | None) -> float:
    """Return the mean fit on validation data, or else on the fitted record."""
    if validation is None:
        return float(np.mean(refinement.fit))
    return float(np.mean(compare(refinement, validation, horizon=horizon).fit))


def detectable(
    tested: TestedResidual, scored: Sequence[Candidate], tests: int, significance: float, levels: Levels
) -> tuple[Detectable, ...]:
    """Return the smallest detectable coefficient of each simple candidate.

    Candidates with several coefficients or starts are left out. The power is 95 % by default
    (`Levels.power`), at the level `significance` shared by all tests and candidates.
    """
    level = stats.norm.isf(significance / (2 * tests * max(len(scored), 1))) + levels.power
    found = []
    for candidate in scored:
        if len(candidate.effect.free) != 1 or len(candidate.starts) != 1:
            continue
        white = tested.whiten(candidate.columns[tested.ratio])
        column = project(white[:, 0], tested.basis)
        size = float(np.linalg.norm(column))
        if size > 1e-9 * max(float(np.linalg.norm(white[:, :1])), 1e-300):
            parameter = candidate.problem.structure.parameters[-1]
            unit = candidate.problem.structure.unit(parameter)
            # larger if the column is large on samples that are noisier than the rest
            spread = max(1.0, float(np.linalg.norm(column * tested.left)) / size)
            found.append(Detectable(candidate.effect, parameter.name, level * spread / size, unit))
    return tuple(found)
