"""From the minimum to a `Refinement`: parameters, uncertainty, words."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from ..arguments import as_noise
from ..data.measurement import Measurement
from ..data.signals import over_time, spreads
from ..engine.amplitude_response import engine_on
from ..engine.engine import Engine
from ..engine.initial_state import estimate_initial_state
from ..engine.structure import Structure
from ..exceptions import IdentifiabilityWarning, warn
from ..models.physical_model import PhysicalModel
from ..systems.linear import Array
from .covariance import parameter_uncertainty, standard_deviations, unmoved, unseen_combinations
from .doubts import stands_still
from .parameters import estimated, weak_priors
from .problem import Problem
from .refinement import Refinement

_FLAT = 1e-9  # relative increase of the cost that is rounding


def output_weights(
    records: Sequence[Measurement], noise: Any, problem: Problem | None = None, point: Array | None = None
) -> Array:
    """One over the noise of each output: declared, or from the residual."""
    ny = records[0].outputs.shape[0]
    declared = as_noise(noise, ny)
    if all(record.known for record in records):  # they stand in its units
        declared = np.ones(ny)
    if declared is not None:
        return 1.0 / declared
    # before a fit: standard deviation of each output
    spread = spreads(np.concatenate([record.outputs for record in records], axis=1))
    if problem is None or point is None:
        return 1.0 / spread
    # after a fit: rms of the residual, but no less than rounding
    residuals = np.concatenate([r for r, _, _ in problem.own_blocks(point)], axis=1)
    level = np.sqrt(over_time(np.mean, (residuals / problem.weights[:, None]) ** 2))
    return 1.0 / np.maximum(level, 1e-12 * spread)


def package(fit: Any, physical: PhysicalModel, note: str, records: Sequence[Any]) -> Refinement:
    """The `Refinement` of a finished fit, with the records that it keeps."""
    structure, problem, result = fit.structure, fit.problem, fit.result
    point = _at_prior(problem, result.point)
    theta, starts = problem.unpack(point)
    # residual and Jacobian of each record, without the weak priors
    residuals, slopes, columns = zip(*problem.own_blocks(point), strict=True)
    precision = problem.precision
    precision[: problem.n_theta][weak_priors(fit.table)] = 0.0
    # order of the residual's model; noise of a response is white over frequency
    order = 0 if problem.color == 0 else None
    unsure = parameter_uncertainty(residuals, slopes, precision, order, columns)
    p = structure.n_parameters
    covariance = unsure.covariance[:p, :p]
    spread = standard_deviations(covariance)
    # offsets with a prior, which a record need not distinguish
    offsets = np.array([row.role == "offset" for row in fit.table], dtype=bool)
    settled = np.isfinite(problem.prior_sd) & offsets
    names = [q.label for q in structure.parameters]
    found = tuple(unseen_combinations(unsure, theta, names, spread, settled))
    for sentence in found:
        warn(sentence, IdentifiabilityWarning)
    # fit in percent and rms error, in units of the outputs
    fit_percent, rmse = fit_of(problem.records, [r / problem.weights[:, None] for r in residuals])
    message = "Converged."
    if not result.converged:
        message = "Stopped at the largest number of evaluations, perhaps before the minimum."
    # coefficients that ended on a bound
    at_bound = problem.at_bound(point, problem.evaluate(point).normal()[0])
    if at_bound:
        message += f" At its bound: {', '.join(at_bound)}."
    return Refinement(
        physical_model=physical,
        effects=structure.effects,
        roles=fit.roles,
        constants=dict(structure.constants),
        theta=np.array(theta),
        parameters=estimated(fit.table, theta, spread),
        covariance=covariance,
        fit=fit_percent,
        rmse=rmse,
        initial_fit=_initial_fit(Structure(physical), problem.records),
        initial_states=starts,
        substeps=fit.steps,
        residual_orders=problem.whitener(residuals).orders,
        led=any(engine.lead is not None for engine in problem.engines),
        success=result.converged,
        message=f"{message} {note}".strip(),
        warnings=found,
        of_responses=not problem.in_time,
        records=tuple(records),
    )


def _at_prior(problem: Problem, point: Array) -> Array:
    """Return a minimum with undetermined directions at their prior means.

    A flat valley leads anywhere. The point stays as it is if the cost would increase.
    """
    evaluation = problem.evaluate(point)
    normal, _ = evaluation.normal()
    if not (evaluation.finite and np.isfinite(normal).all()):
        return point
    # prior mean of the coefficients, zero initial states
    home = problem.pack(problem.prior_mean, np.zeros((len(problem.records), problem.n_states)))
    found = unmoved(normal, point, home)
    if np.array_equal(found, point):
        return point
    # take it only if the cost does not increase
    found = problem.inside(found)
    flat = problem.cost(found) <= problem.cost(point) * (1.0 + _FLAT)
    return found if flat else point


def _fit(measured: Array, error: Array) -> Array:
    # normalized root mean square error, 100 (1 - |y - yh| / |y - mean y|)
    about_mean = over_time(np.linalg.norm, measured - over_time(np.mean, measured)[:, None])
    about_mean = np.where(stands_still(measured) | (about_mean == 0), np.nan, about_mean)
    return np.asarray(100.0 * (1.0 - over_time(np.linalg.norm, error) / about_mean))


def fit_of(records: Sequence[Any], errors: Sequence[Array]) -> tuple[Array, Array]:
    """Return the fit in percent and the RMS error of each output.

    The RMS error has the unit of the output; `errors` are those of the rows.

    For frequency responses, they are those of the complex points about their mean.
    """
    if records[0].in_time:
        error = np.concatenate(errors, axis=1)
        measured = np.concatenate([r.outputs for r in records], axis=1)
        return _fit(measured, error), np.sqrt(over_time(np.mean, error**2))
    # frequency responses: complex points, about their mean over frequency
    left = [record.points(e) for record, e in zip(records, errors, strict=True)]
    points = [record.points(record.outputs) for record in records]
    about = [p - p.mean(axis=2, keepdims=True) for p in points]
    off, spread = (
        np.sqrt(sum(np.sum(np.abs(p) ** 2, axis=(1, 2)) for p in parts)) for parts in (left, about)
    )
    count = sum(p.shape[1] * p.shape[2] for p in points)
    return 100.0 * (1.0 - off / np.where(spread > 0, spread, np.nan)), off / np.sqrt(count)


def _initial_fit(structure: Structure, records: Sequence[Any]) -> Array:
    """Fit of the initial model, initial state estimated (and nothing else)."""
    # free run of the initial model on each record
    errors = []
    for record in records:
        engine = engine_on(structure, record)
        start = estimate_initial_state(engine, np.zeros(0)) if isinstance(engine, Engine) else None
        errors.append(engine.run(np.zeros(0), start, sensitivity=False, check=False).outputs - record.outputs)
    return fit_of(records, errors)[0]
