"""Confirmation of a model on further records.

They are best taken at another amplitude.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import control as ct
import numpy as np

from ..arguments import as_mapping, as_number, as_share, as_vector
from ..data.measurement import Measurement
from ..data.records import amplitude, as_records
from ..effects.effect import Effect, as_effects
from ..engine.observer import observer_gain
from ..engine.simulation import check_channels
from ..exceptions import DataError
from ..inference.assembly import check_settings, priors
from ..inference.covariance import standard_deviations, wald
from ..inference.descent import descend
from ..inference.f_tests import FTest
from ..inference.fitted import FittedModel, coefficient_covariance, evaluated
from ..inference.outcome import output_weights
from ..inference.problem import Problem
from ..inference.refinement import Refinement
from ..inference.search import starting_states, sufficient_steps
from ..inference.sensitivities import candidate_columns
from ..inference.starts import Motion
from ..inference.windows import windows
from ..models.library import effect_library
from ..models.operating_point import ordered_record
from ..systems.linear import Array
from ..words import chance
from .beside import Beside
from .confirmation import Confirmation, RecordEstimate
from .residual_tests import TestedResidual, run_tests

__all__ = ["confirm"]

_FINER = 5  # refinements of the substep at most
_ROUNDS = 3  # descents, each under the whitening of the one before


def confirm(
    model: Refinement,
    data: Sequence[Measurement],
    *,
    candidates: Sequence[Effect] | None = None,
    tolerance: float = 0.0,
    noise: float | Sequence[float] | None = None,
    force_ratio: float = 0.0,
    significance: float = 0.005,
    scales_with: Mapping[str, str | Sequence[float]] | None = None,
) -> Confirmation:
    """Test a refined model on further records.

    They are best taken at another amplitude. The model is fitted to each record alone. An effect that only
    mimics the true one on one record needs other coefficients on another, or leaves a residual there.

    Parameters
    ----------
    model : Refinement
        Model with the effects in question: of `refine`, or `RankedEffect.refinement`.
    data : sequence of Measurement
        The record that taught them first, then the others; two at least.
    candidates : sequence of Effect, optional
        What else the residual is tested for, default `effect_library(model)`.
    tolerance : float
        Relative prior sd of the linear parameters, as in `refine`.
    noise : float or sequence of float, optional
        Known sensor noise (standard deviation per output).
    force_ratio : float
        Unmeasured force over the measured one in the first record that is allowed for, as
        `Diagnosis.force_ratio` says it; taken to be as large in the other records.
    significance : float
        Level below which the effects are refuted.
    scales_with : mapping, optional
        Effects whose size changes in proportion to a condition, by ``"kind@place"``: a number per record, or
        the name of a signal of the records (its mean counts). For example
        ``{"coulomb_friction@shaft": "load"}``. All other coefficients must keep their values.

    Returns
    -------
    Confirmation
        Verdict, and the coefficients from every record.

    Raises
    ------
    control.ControlArgument
        If the model has no effect that was asked for, there is only one record, or `scales_with` names an
        effect or a signal that does not exist.
    DataError
        If a condition is zero or changes its sign between records.

    Notes
    -----
    Wald test ``(t1 - t2)' (C1 + C2)^-1 (t1 - t2)`` of the effects' coefficients with the
    covariances of generalized least squares, and the residual tests of `diagnose` on each
    further residual. Offsets and linear parameters that float may differ between records. With
    `scales_with`, t1 is multiplied by the ratio of the conditions, and C1 by its square.

    Examples
    --------
    >>> import numpy as np, rcorefine as rco
    >>> model = rco.mass_spring_damper([1.0], [0.4], [100.0], sensors="displacement")
    >>> true = rco.mass_spring_damper([1.0], [0.4], [80.0], sensors="displacement")
    >>> rng = np.random.default_rng(0)
    >>> records = []
    >>> for size in (10.0, 20.0):
    ...     force = size * rng.standard_normal(1500)
    ...     y = rco.simulate(true, rco.Measurement(force, np.zeros(1500), dt=0.02), "zero").outputs[0]
    ...     records.append(rco.Measurement(force, y + 0.02 * rng.standard_normal(1500), dt=0.02))
    >>> softer = rco.refine(model, records[0], [rco.Effect("stiffness", "link1")])
    >>> rco.confirm(softer, records).verdict
    'confirmed'
    """
    if not isinstance(model, Refinement):
        raise ct.ControlArgument(f"model must be a Refinement, not {type(model).__name__}; call refine first")
    force_ratio = as_number(force_ratio, "force_ratio", least=0.0)
    significance = as_share(significance, "significance")
    check_settings(model.physical_model, tolerance=tolerance, noise=noise)
    records = as_records(data)
    if len(records) < 2:
        raise ct.ControlArgument("data holds one record; give the one that taught the effects and another")
    linear = model.physical_model.linear
    ordered = [ordered_record(model.physical_model, r) for r in records]
    for record in ordered:
        check_channels(linear, record)
    own = [i for i, row in enumerate(model.parameters) if row.role == "effect"]
    if not own:
        raise ct.ControlArgument("the model holds no effect that was asked for, so nothing can be confirmed")
    conditions = _conditions(model, records, {} if scales_with is None else scales_with)
    factors = _factors(model, own, conditions, len(records))
    estimates = _estimates(
        model, records, ordered, own, _others(model, candidates), (tolerance, noise), force_ratio, factors
    )
    further = estimates[1:]
    p_value = min(1.0, len(further) * min(min(e.agreement, e.residual) for e in further))
    names = tuple(model.parameters[i].name for i in own)
    labels = [f"{row.kind} at {row.place}" for row in (model.parameters[i] for i in own)]
    verdict = "confirmed" if p_value >= significance else "refuted"
    units = tuple(model.parameters[i].unit for i in own)
    message = _message(verdict, list(dict.fromkeys(labels)), estimates, p_value, significance, scales_with)
    return Confirmation(verdict, p_value, names, units, tuple(estimates), significance, message, conditions)


def _others(model: Refinement, candidates: Sequence[Effect] | None) -> list[Effect]:
    """Effects besides the model's own that a residual is tested for."""
    if candidates is None:
        library = effect_library(model.physical_model)
    else:
        library = as_effects(candidates, "candidates")
    held = {(effect.kind, effect.place) for effect in model.effects}
    return [effect for effect in library if (effect.kind, effect.place) not in held]


def _conditions(
    model: Refinement, records: Sequence[Measurement], asked: Mapping[str, Any]
) -> dict[str, tuple[float, ...]]:
    """Return the condition of each effect in each record.

    Only effects that change with a condition are included.
    """
    held = {
        f"{e.kind}@{e.place}" for e, role in zip(model.effects, model.roles, strict=True) if role == "effect"
    }
    found = {}
    for key, given in as_mapping(asked, "scales_with", "conditions").items():
        if key not in held:
            raise ct.ControlArgument(
                f"scales_with names {key!r}; the effects of the model are {', '.join(sorted(held))}"
            )
        if isinstance(given, str):
            values = np.array([_mean_of(record, given) for record in records])
        else:
            values = as_vector(given, f"scales_with[{key!r}]", len(records))
        if not (np.all(values > 0) or np.all(values < 0)):
            raise DataError(
                f"scales_with[{key!r}] is {', '.join(f'{v:.4g}' for v in values)}: a condition must be "
                "nonzero and of one sign in all records"
            )
        found[key] = tuple(map(float, values))
    return found


def _mean_of(record: Measurement, label: str) -> float:
    """Return the mean of a signal of a record, by its name."""
    labels = [*record.input_labels, *record.output_labels]
    if label not in labels:
        raise ct.ControlArgument(
            f"scales_with names the signal {label!r}; record {record.name!r} has {', '.join(labels)}"
        )
    return float(np.concatenate([record.inputs, record.outputs])[labels.index(label)].mean())


def _factors(
    model: Refinement, own: Sequence[int], conditions: Mapping[str, Sequence[float]], count: int
) -> Array:
    """Return the factor of each coefficient in each record.

    It is relative to the first record. Rows are records, columns are coefficients.
    """
    factors = np.ones((count, len(own)))
    structure = model.simulation_structure()[0]
    for k, i in enumerate(own):
        parameter = structure.parameters[i]
        effect = structure.effects[parameter.effect]
        values = conditions.get(f"{effect.kind}@{effect.place}")
        if values is not None and parameter.name not in effect.spec.shaping:
            factors[:, k] = np.array(values) / values[0]
    return factors


def _estimates(
    model: Refinement,
    records: Sequence[Measurement],
    ordered: Sequence[Measurement],
    own: Sequence[int],
    rest: Sequence[Effect],
    options: tuple[float, Any],
    force_ratio: float,
    factors: Array,
) -> list[RecordEstimate]:
    """The model on each record alone, against the first one."""
    levels = [amplitude(record) or 1.0 for record in ordered]
    ratios = [force_ratio * levels[0] / level for level in levels]
    alone = [_alone(model, record, *options, ratio) for record, ratio in zip(ordered, ratios, strict=True)]
    block = np.ix_(own, own)
    estimates = []
    for i, (fitted, C) in enumerate(alone):
        tests = _tested(fitted, rest, ratios[i])
        valid = [t.p_value for t in tests if t.dof]
        agreement = 1.0
        if i:
            f = factors[i]
            difference = fitted.theta[own] - f * alone[0][0].theta[own]
            agreement = wald(difference, f[:, None] * alone[0][1][block] * f + C[block])
        name = records[i].name if len({r.name for r in records}) > 1 else f"record {i + 1}"
        residual = min(1.0, min(valid, default=1.0) * len(valid))
        estimates.append(
            RecordEstimate(
                name, levels[i] / levels[0], fitted.theta[own], standard_deviations(C)[own], agreement,
                tuple(tests), residual, factors[i],
            )
        )  # fmt: skip
    return estimates


def _message(
    verdict: str,
    labels: list[str],
    estimates: Sequence[RecordEstimate],
    p_value: float,
    level: float,
    scaled: Mapping[str, Any] | None = None,
) -> str:
    first, *further = estimates
    scaled = {
        key: value if isinstance(value, str) else "the condition" for key, value in (scaled or {}).items()
    }
    keys = [label.replace(" at ", "@", 1) for label in labels]
    ways = [f" in proportion to {scaled[key]}" if key in scaled else "" for key in keys]
    what = " with ".join(label + way for label, way in zip(labels, ways, strict=True))
    if verdict == "confirmed":
        other = any(abs(np.log(e.level)) > 0.25 for e in further)
        caution = "" if other else " The amplitudes are similar, so a similar effect could pass, too."
        return f"The same {what} explains every record ({chance(p_value, 'p')}).{caution}"
    worst = min(further, key=lambda e: min(e.agreement, e.residual))
    why = "other coefficients" if worst.agreement <= worst.residual else "something more"
    verdict = f"{what} is refuted: {worst.name} needs {why} ({chance(p_value, 'p')})."
    if first.residual < level:
        return f"{verdict} It does not explain the first record either ({chance(first.residual, 'p')})."
    return f"{verdict} It only mimics what is missing."


def _alone(
    model: Refinement, record: Measurement, tolerance: float, noise: Any, ratio: float
) -> tuple[FittedModel, Array]:
    """Fit the model to one record alone.

    Return the fitted model and the covariance of its coefficients.
    """
    structure, theta, steps = model.simulation_structure()
    segments, _ = windows(model.physical_model, [record], None)
    mean, sd = priors(structure, model.roles, tolerance)

    weights = output_weights(segments, noise) if noise is not None else 1.0 / model.rmse

    def problem(pieces: Sequence[Measurement], steps: int, _unknown_start: bool = True) -> Problem:
        return Problem(structure, pieces, weights, prior_mean=mean, prior_sd=sd, substeps=steps)

    made = problem(segments, steps)
    point = made.pack(theta, starting_states(made, theta))
    point = descend(made, point, evaluations=15, tolerance=1e-6).point
    for _ in range(_FINER):  # a larger amplitude asks for finer substeps
        if noise is None:
            weights = output_weights(segments, None, made, point)
        finer = sufficient_steps(problem, segments, problem(segments, made.substeps), point)
        done = finer == made.substeps
        made = problem(segments, finer)
        if done:
            break
        point = descend(made, point, evaluations=15, tolerance=1e-6).point
    gain = observer_gain(structure, theta, segments[0], ratio) if ratio > 0 else None
    for _ in range(_ROUNDS):
        whitener = made.whitener([r for r, _ in evaluated(made, point, gain)])
        point = descend(made, point, gain=gain, whitener=whitener, evaluations=10, tolerance=1e-8).point
    blocks = evaluated(made, point, gain)
    whitener = made.whitener([r for r, _ in blocks])
    C = coefficient_covariance(made, blocks, whitener)
    fitted = FittedModel(replace(model, substeps=made.substeps), made, point, tolerance)
    if gain is not None:
        fitted._gains[ratio] = gain
    return fitted, C


def _tested(fitted: FittedModel, rest: Sequence[Effect], ratio: float) -> list[FTest]:
    motions = [Motion(fitted.structure, fitted.theta, record) for record in fitted.problem.records]
    scored = candidate_columns(fitted, rest, motions[0], (ratio,))
    tested = TestedResidual(fitted, ratio)
    roles = fitted.refinement.roles
    places = [e.place for e, role in zip(fitted.structure.effects, roles, strict=True) if role == "effect"]
    # none of these: a law that only mimics leaves a force of its own behind
    free = [test for place in dict.fromkeys(places) for test in Beside(tested, place).tests()]
    return [*run_tests(tested, scored, motions), *free]
