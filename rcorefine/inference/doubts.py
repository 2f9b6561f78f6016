"""Checks for estimates that are worthless although the fit converged.

Such an estimate is reported as unsuccessful, with the reason.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from scipy.linalg import eig

from ..data.measurement import Measurement
from ..data.signals import over_time
from ..engine.simulation import simulated
from ..exceptions import IdentifiabilityWarning, warn
from ..results import frequency_text
from ..systems.linear import Array, LinearModel
from .covariance import pseudo_inverse
from .levels import levels
from .refinement import Refinement

_STILL = 1e-12  # range over size of an output, below which it is constant
_POOR, _GOOD = 50.0, 90.0  # fit in percent: below it a reversed sign is tried; above it a fit is good
_WITH = 0.2  # correlation with the initial model above which a sign is not in doubt
_WIDE = 0.01  # standard deviation over the nominal value, below which the cost is quadratic
_AWAY, _BENT = 2.0, 4.0  # distance in standard deviations, and factor by which the cost may deviate there


def stands_still(outputs: Array) -> Array:
    """Which rows of (n_y, N) do not move."""
    return np.asarray(over_time(np.ptp, outputs) <= _STILL * over_time(np.max, np.abs(outputs)))


def explains_nothing(fit: Array, n_samples: int, unknowns: int) -> bool:
    """Return whether a constant explains the record as well as the fit.

    Compare the log-likelihood gain of the simulation with what as many parameters gain from noise.
    """
    # error power over that of a constant; the log-likelihood gain is -N log of it
    left = np.clip((1.0 - np.asarray(fit) / 100.0) ** 2, 1e-300, 1.0)
    gain = -n_samples * float(np.sum(np.log(np.where(np.isfinite(left), left, 1.0))))
    return gain < 5.0 * unknowns + 20.0


def doubted(found: Refinement, fit: Any, again: Callable[[list[Measurement]], Any]) -> Refinement:
    """The result, with a warning for each reason to doubt it.

    Parameters
    ----------
    found : Refinement
        Result of the fit.
    fit : Fit
        The fit at its minimum.
    again : callable
        Makes the same fit on other segments.

    Returns
    -------
    Refinement
        The reasons stand in `warnings`; where the estimate means nothing for them, `success` is
        False and `message` begins with them.
    """
    outputs = np.concatenate([record.outputs for record in fit.segments], axis=1)
    labels = found.physical_model.linear.output_labels
    still = stands_still(outputs)
    reasons, worthless = [], False
    # reasons in turn: no motion, a wrong sign, a useless fit, aliasing, undetermined parameters
    if still.all():
        reasons.append(f"{', '.join(labels)} does not move in this record, so it determines no parameter")
        worthless = True
    elif found.parameters:
        idle = explains_nothing(found.fit, fit.problem.n_points // len(outputs), fit.problem.size)
        reasons += _check_sign(found, fit, again, labels)
        if idle and not reasons:
            reasons.append(
                "the simulation (free run) explains nothing of the record "
                f"(fit {np.nanmax(found.fit):.2g} %): a constant would fit as well"
            )
        worthless |= idle or bool(reasons)
        if (fast := _check_aliasing(found, fit, idle)) and not (worthless and not idle):
            reasons.append(fast)
            worthless |= bool(np.nanmin(found.fit) < _GOOD)
        if not worthless and (bent := _check_curvature(found, fit)):
            reasons.append(bent)
            worthless = True
    if not reasons:
        return found
    for sentence in reasons:
        warn(sentence, IdentifiabilityWarning)
    if worthless:
        message = f"Not to be trusted: {'; '.join(reasons)}. {found.message}"
        found = replace(found, success=False, message=message)
    return replace(found, warnings=(*found.warnings, *reasons))


def _check_sign(
    found: Refinement, fit: Any, again: Callable[[list[Measurement]], Any], labels: Sequence[str]
) -> list[str]:
    """Return a hint if reversing the sign of an output improves the fit.

    The hint is returned only if the same fit comes much closer with the reversed output.
    """
    if np.nanmin(found.fit) >= _POOR:
        return []
    against = _opposed_outputs(found, fit.segments)
    for which in [against] if against.sum() == 1 else [against, *np.eye(len(labels))[against]]:
        if not which.any():
            break
        # fit again with the sign of the suspected outputs reversed
        sign = (1.0 - 2.0 * which)[:, None]
        other = again([record._changed(outputs=sign * record.outputs) for record in fit.segments])
        # cost: sum of the logarithms of the residual power over the outputs
        if other.cost < fit.cost + 2.0 * np.log(levels().turned_over):
            names = ", ".join(label for label, one in zip(labels, which, strict=True) if one)
            return [
                f"with the sign of {names} reversed the model fits much better: check the wiring "
                "or the sign convention of the model"
            ]
    return []


def _opposed_outputs(found: Refinement, segments: Sequence[Measurement]) -> Array:
    """Outputs that do not go with the free run of the initial model."""
    runs = [simulated(found.physical_model, record, "estimate", led=True).outputs for record in segments]
    measured = [record.outputs for record in segments]
    # correlation of simulation and measurement, without their means
    one, two = (np.concatenate(rows, axis=1) for rows in (runs, measured))
    one[np.isnan(two)] = np.nan
    one, two = (rows - over_time(np.mean, rows)[:, None] for rows in (one, two))
    size = over_time(np.linalg.norm, one) * over_time(np.linalg.norm, two)
    return np.asarray(over_time(np.sum, one * two) < _WITH * size)


def _check_aliasing(found: Refinement, fit: Any, idle: bool) -> str:
    """Modes above half the sampling frequency that the outputs show.

    A fit that explains nothing may end anywhere: then only the initial model counts.
    """
    limit = np.pi / max(record.dt for record in fit.segments)
    models = [found.physical_model.linear]
    models += [] if idle else [LinearModel.from_statespace(found.system)]
    fast = {
        float(f"{pole.imag:.4g}") for m in models for pole in np.linalg.eigvals(m.A) if pole.imag >= limit
    }
    if not fast or max(_fast_share(model, fit, limit) for model in models) < levels().aliased:
        return ""
    named, half = frequency_text(*sorted(fast)[:4]), frequency_text(limit)
    return (
        f"modes at {named} are above half the sampling frequency ({half}) and contribute to the outputs: "
        "they depend on the input between the samples; sample faster"
    )


def _fast_share(model: LinearModel, fit: Any, limit: float) -> float:
    """Return the largest share of fast modes in the power of an output.

    Fast modes oscillate at the frequency `limit` or above.
    """
    poles, left, right = eig(model.A, left=True, right=True)
    fast = np.flatnonzero(np.abs(poles.imag) >= limit)
    # projector on the fast modes, from right and left eigenvectors
    part = np.zeros_like(model.A)
    for k in fast:
        along = left[:, k].conj()
        part = part + np.real(np.outer(right[:, k], along) / (along @ right[:, k]))
    theta, starts = fit.problem.unpack(fit.result.point)
    n, own, whole = model.n_states, [], []
    for engine, start in zip(fit.problem.engines, starts, strict=True):
        run = engine.run(theta, start, sensitivity=False, histories=True, check=False)
        own.append(model.C @ part @ np.nan_to_num(run.states[:n]))
        whole.append(run.outputs)
    # power of the fast part over that of the output
    power = np.var(np.concatenate(whole, axis=1), axis=1)
    return float(np.max(np.var(np.concatenate(own, axis=1), axis=1) / np.maximum(power, 1e-300)))


def _check_curvature(found: Refinement, fit: Any) -> str:
    """Return a warning that names the undetermined linear parameters.

    Around these, the error does not grow as the standard deviation predicts.

    Moving one parameter by s standard deviations, the others along with it, should raise
    twice the log-likelihood by s squared. Where it does not, the valley is bent within the
    error bars: neither the value nor its std means anything.
    """
    problem, point = fit.problem, fit.result.point
    if not fit.structure.is_linear:
        return ""
    # quadratic model of the cost at the minimum
    normal, _ = problem.evaluate(point).normal()
    bounds = problem.at_bound(point, normal)
    inverse, _, _ = pseudo_inverse(normal)
    noise = 2.0 * problem.cost(point) / problem.n_points
    least = problem.cost(point)
    bent = []
    for i, row in enumerate(found.parameters):
        label = fit.structure.parameters[i].label
        # a parameter without a nominal value has no scale
        wide = 0 < _WIDE * abs(row.initial) < row.std < np.inf
        if row.role == "offset" or not wide or label in bounds or inverse[i, i] <= 0:
            continue
        # step of two standard deviations along one parameter, the others following
        step = _AWAY * np.sqrt(noise / inverse[i, i]) * inverse[:, i]
        # rise of twice the log-likelihood on both sides; 4 if the standard deviations hold
        rise = [2.0 * (problem.cost(point + side * step) - least) / noise for side in (-1.0, 1.0)]
        if max(rise) > _BENT * _AWAY**2 or min(rise) < _AWAY**2 / _BENT:
            bent.append(label)
    if not bent:
        return ""
    return (
        f"the record does not determine {', '.join(bent)} (two standard deviations away the error differs "
        "severalfold from its prediction, so the standard deviations are not valid)"
    )
