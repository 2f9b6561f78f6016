"""Refined models whose coefficients are set by hand.

These coefficients are held; offsets and initial states are estimated.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
from scipy.linalg import expm

from ..data.measurement import Measurement
from ..effects.effect import Effect
from ..engine.response_engine import engine_on
from ..engine.structure import Structure
from ..exceptions import DivergenceError
from ..inference.outcome import fit_of, output_weights
from ..inference.problem import Problem
from ..inference.refinement import Refinement
from ..inference.starts import Motion, law_widths
from ..systems.linear import Array, LinearModel

__all__ = ["free_run", "key", "quickly_settled", "settled", "values_of", "with_held"]

_SUBSTEPS = 4  # of a sample, where a law is not linear
_MOST = 10  # evaluations to settle offset and initial state


def key(effect: Effect) -> tuple[str, str]:
    """Return the kind and place that identify an effect in a model."""
    return effect.kind, effect.place


def values_of(model: Refinement, index: int) -> dict[str, float]:
    """Coefficients of an effect of a model, held or estimated."""
    structure, theta, _ = model.simulation_structure()
    return {name: float(structure.value(theta, index, name)) for name in model.effects[index].coefficients}


def with_held(model: Refinement, motion: Motion, effect: Effect, values: Mapping[str, float]) -> Refinement:
    """Return a model with one effect changed or added, the others held.

    Parameters
    ----------
    model : Refinement
        Present model.
    motion : Motion
        Estimated motion, for the widths of laws.
    effect : Effect
        What is moved or added.
    values : dict
        All its coefficients.

    Returns
    -------
    Refinement
        Offsets are all that is estimated in it; they, the initial states, fit and rmse are those of `model`.
    """
    before, theta, substeps = model.simulation_structure()
    effects = [
        each if role == "offset" else _held(each, values_of(model, i))
        for i, (each, role) in enumerate(zip(model.effects, model.roles, strict=True))
    ]
    keys = [key(each) for each in effects]
    at = keys.index(key(effect)) if key(effect) in keys else len(effects)
    effects[at : at + 1] = [_held(effect, values)]
    widths = law_widths(Structure(model.physical_model, effects), motion) | model.constants
    structure = Structure(model.physical_model, effects, constants=widths)
    kept = [before.position(q.effect, q.name) for q in structure.parameters]
    starts = np.zeros((model.initial_states.shape[0], structure.n_states))
    starts[:, : model.initial_states.shape[1]] = model.initial_states
    roles = (*model.roles, "effect")[: len(effects)]
    held = [each.label for each, role in zip(effects, roles, strict=True) if role != "offset"]
    return replace(
        model,
        effects=tuple(effects),
        roles=roles,
        constants=widths,
        theta=theta[kept],
        parameters=tuple(model.parameters[i] for i in kept),
        covariance=model.covariance[np.ix_(kept, kept)],
        initial_states=starts,
        substeps=max(substeps, 1 if structure.is_linear else _SUBSTEPS),
        message=f"Set by hand and not fitted: {', '.join(held)}.",
        warnings=(),
    )


def _held(effect: Effect, values: Mapping[str, float]) -> Effect:
    return effect.replace(start={}, prior={}, fixed={**effect.fixed, **values})


def free_run(model: Refinement, pieces: Sequence[Measurement]) -> Array:
    """Outputs (n_y, N) over the windows of a record, one after the other.

    Raises
    ------
    DivergenceError
        If the model leaves all bounds.
    """
    structure, theta, substeps = model.simulation_structure()
    found = [
        engine_on(structure, piece, substeps=substeps).run(theta, start, sensitivity=False, check=False)
        for piece, start in zip(pieces, model.initial_states, strict=True)
    ]
    runs = np.concatenate([run.outputs for run in found], axis=1)
    if any(run.blew_up >= 0 for run in found) or not np.isfinite(runs).all():
        raise DivergenceError("with these coefficients the model leaves all bounds; move them back")
    return runs


def settled(model: Refinement, pieces: Sequence[Measurement]) -> Refinement:
    """Estimate offsets and initial states with all coefficients held."""
    free_run(model, pieces)  # a divergence is said before anything is estimated
    structure, theta, substeps = model.simulation_structure()
    weights = output_weights(pieces, None)
    problem = Problem(structure, pieces, weights, substeps=substeps, hold_brief=False)
    point = problem.minimize(problem.pack(theta, model.initial_states), max_nfev=_MOST, tol=1e-8).x
    theta, starts = problem.unpack(point)
    rows = [
        replace(row, value=row.initial + value, coefficient=value)
        for row, value in zip(model.parameters, theta.tolist(), strict=True)
    ]
    model = replace(model, theta=theta, initial_states=starts, parameters=tuple(rows))
    fit, rmse = fit_of(pieces, [free_run(model, pieces) - np.hstack([p.outputs for p in pieces])])
    return replace(model, fit=fit, rmse=rmse)


def quickly_settled(model: Refinement, pieces: Sequence[Measurement]) -> Array:
    """Simulate with offsets and initial states fitted to the linear part.

    The free run has shape (n_y, N).
    A constant input adds a constant to each output, and a free motion.
    """
    runs = free_run(model, pieces)
    if model.led:
        return runs
    linear = LinearModel.from_statespace(model.system)
    motion, step = linear.C[None], expm(linear.A * pieces[0].dt)
    while motion.shape[0] < max(piece.n_samples for piece in pieces):
        motion, step = np.concatenate([motion, motion @ step]), step @ step
    n, ny = linear.n_states, linear.n_outputs
    width = n * len(pieces) + (ny if "offset" in model.roles else 0)
    blocks = []
    for i, piece in enumerate(pieces):
        block = np.zeros((piece.n_samples, ny, width))
        block[:, :, n * len(pieces) :] = np.eye(ny)[:, : width - n * len(pieces)]
        block[:, :, n * i : n * (i + 1)] = motion[: piece.n_samples]
        blocks.append(block)
    columns, weights = np.concatenate(blocks), output_weights(pieces, None)[:, None]
    rows = (weights * columns).reshape(-1, width)
    error = (weights * (np.hstack([piece.outputs for piece in pieces]) - runs)).T.ravel()
    return np.asarray(runs + (columns @ np.linalg.lstsq(rows.T @ rows, rows.T @ error, rcond=1e-10)[0]).T)
