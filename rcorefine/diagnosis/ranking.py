"""The figures of a diagnosis: a row for each candidate, and what an adequate model would have shown."""

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
    """A row for each trial, in their order.

    Parameters
    ----------
    trials : sequence of Trial
        One for each set of effects.
    probabilities : sequence of float
        Of the sets.
    alike : sequence of bool
        Whether the records do not tell them from the first.
    scores : dict
        p-value of the score of each effect.
    nothing : float
        Log evidence without any effect.
    case : Case
        What is asked.
    validation : Measurement or None
        Record on which the fits are judged.
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
    """Rows of the free coefficients of an effect, by their names; none where the model does not hold it."""
    name = (effect.kind, effect.place, "effect")
    rows = [row for row in refinement.parameters if (row.kind, row.place, row.role) == name]
    return dict(zip(effect.free, rows, strict=True)) if rows else {}


def undetermined(refinement: Refinement, effect: Effect, levels: Levels) -> list[EstimatedParameter]:
    """Return the estimates because of which an effect is neither named nor kept.

    Parameters
    ----------
    refinement : Refinement
        Model with the effect.
    effect : Effect
        Effect; what its `fixed` holds is not asked for.
    levels : Levels
        Of the standard deviations.

    Returns
    -------
    list of EstimatedParameter
        Its sizes, where none is more than `Levels.moved` standard deviations from zero, or their sign
        contradicts physics; else those of its essential coefficients, and of its shapes that are positive,
        which are not, and whatever has no standard deviation. Empty where the records determine the effect.
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
    """Mean fit on the validation record, or on the fitted one where there is none."""
    if validation is None:
        return float(np.mean(refinement.fit))
    return float(np.mean(compare(refinement, validation, horizon=horizon).fit))


def detectable(
    battery: TestedResidual, scored: Sequence[Candidate], tests: int, significance: float, levels: Levels
) -> tuple[Detectable, ...]:
    """Smallest coefficient of each one-coefficient candidate that one of so many tests would have shown."""
    level = stats.norm.isf(significance / (2 * tests * max(len(scored), 1))) + levels.power
    found = []
    for candidate in scored:
        if len(candidate.effect.coefficients) != 1 or len(candidate.starts) != 1:
            continue
        white = battery.whiten(candidate.columns[battery.ratio])
        column = project(white[:, 0], battery.basis)
        size = float(np.linalg.norm(column))
        if size > 1e-9 * max(float(np.linalg.norm(white[:, :1])), 1e-300):
            parameter = candidate.problem.structure.parameters[-1]
            unit = candidate.problem.structure.unit(parameter)
            # more where the column is large on samples that are noisier than the rest
            spread = max(1.0, float(np.linalg.norm(column * battery.left)) / size)
            found.append(Detectable(candidate.effect, parameter.name, level * spread / size, unit))
    return tuple(found)
