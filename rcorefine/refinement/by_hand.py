"""Models to which effects are added by hand.

All coefficients are held. The constant offset of the record and the initial states are estimated: that is a
fraction of a `refine`, so that a picture can follow a slider.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
from scipy.linalg import block_diag, expm

from ..arguments import as_instance
from ..comparison.failure_map.search import Failure
from ..comparison.failure_map.state import ResidualForce, residual_force
from ..comparison.result import Comparison
from ..data.measurement import Measurement
from ..data.records import as_record
from ..data.signals import difference
from ..effects.effect import Effect, unit_forces
from ..engine.amplitude_response import engine_on
from ..engine.controlled import checked_horizon
from ..engine.structure import Structure
from ..exceptions import DivergenceError, own_arithmetic
from ..inference.assembly import windows
from ..inference.outcome import fit_of, output_weights
from ..inference.problem import Problem, descend, natural_sizes
from ..inference.refinement import Refinement
from ..inference.starts import Motion, estimated_motion, law_widths, shape_starts
from ..models.conversion import as_model, as_physical
from ..models.library import candidates_of
from ..models.operating_point import ordered_record
from ..systems.linear import Array, LinearModel
from .refine import base_fit

_SUBSTEPS = 4  # of a sample, where a law is not linear
_MOST = 10  # evaluations to settle offset and initial state
_EDGE = 50  # part of a record at each end where a force is only half known


@dataclass(frozen=True, slots=True, eq=False)
class Addition:
    """An effect that could be added.

    Attributes
    ----------
    effect : Effect
        Kind and place.
    coefficients : dict
        Where to begin: from the force, where the law lies over one, else where it is absent or small.
    share : float
        Part of the lacking force that it explains, 0 to 1; NaN where it is no force along the motion.
    curve : ndarray, shape (N,), or None
        Its force along the motion.
    """

    effect: Effect
    coefficients: dict[str, float]
    share: float = np.nan
    curve: Array | None = None


class ByHand:
    """A model and a record, and the fits with coefficients set by hand.

    Parameters
    ----------
    model : StateSpace, PhysicalModel or Refinement
        Initial model, continuous time.
    data : Measurement
        Record.
    horizon : float, optional
        Length in s of the free runs, as in `refine`.

    Attributes
    ----------
    model : StateSpace, PhysicalModel or Refinement
        Initial model.
    physical : PhysicalModel
        The same with its places.
    record : Measurement
        The record in the order of the model's channels, above its operating point.
    note : str
        Why the record is cut into windows; empty where it is not.
    """

    def __init__(self, model: Any, data: Measurement, horizon: float | None) -> None:
        self.model, self.horizon = as_model(model), checked_horizon(horizon)
        self.physical = as_physical(self.model)
        self._data = as_record(data)
        self.record: Measurement = ordered_record(self.physical, data)
        self._pieces, self.note = windows(self.physical, [self.record], horizon)

    # ------------------------------------------------------------------ fits
    @own_arithmetic()
    def start(self) -> Refinement:
        """Return the initial model, with offset and initial states estimated."""
        return base_fit(
            self.model, [self._data], free=(), tolerance=0.0, offset=True, noise=None, horizon=self.horizon
        )

    def run(self, model: Refinement) -> Array:
        """Return the outputs (n_y, N) over the windows of the record.

        Raises
        ------
        DivergenceError
            If the model leaves all bounds.
        """
        structure, theta, substeps = model.simulation_structure()
        found = [
            engine_on(structure, piece, substeps=substeps).run(theta, start, sensitivity=False, check=False)
            for piece, start in zip(self._pieces, model.initial_states, strict=True)
        ]
        runs = np.concatenate([run.outputs for run in found], axis=1)
        if any(run.blew_up >= 0 for run in found) or not np.isfinite(runs).all():
            raise DivergenceError("with these coefficients the model leaves all bounds; move them back")
        return runs

    @own_arithmetic()
    def settled(self, model: Refinement, effect: Effect, values: Mapping[str, float]) -> Refinement:
        """Return a model with one effect changed or added, all others held.

        Parameters
        ----------
        model : Refinement
            Present model.
        effect : Effect
            What is moved or added.
        values : mapping of str to float
            All its coefficients.

        Returns
        -------
        Refinement
            Offsets and initial states are estimated.
        """
        model = self._with_held(model, effect, values)
        self.run(model)  # a divergence is said before anything is estimated
        structure, theta, substeps = model.simulation_structure()
        weights = output_weights(self._pieces, None)
        problem = Problem(structure, self._pieces, weights, substeps=substeps, hold_brief=False)
        point = descend(problem, problem.pack(theta, model.initial_states), evaluations=_MOST).point
        theta, starts = problem.unpack(point)
        rows = [
            replace(row, value=row.initial + value, coefficient=value)
            for row, value in zip(model.parameters, theta.tolist(), strict=True)
        ]
        model = replace(model, theta=theta, initial_states=starts, parameters=tuple(rows))
        fit, rmse = fit_of(self._pieces, [self.run(model) - np.hstack([p.outputs for p in self._pieces])])
        return replace(model, fit=fit, rmse=rmse)

    @own_arithmetic()
    def preview(self, model: Refinement, effect: Effect, values: Mapping[str, float]) -> tuple[Array, Array]:
        """Return the run of a changed model and its fit, without a search.

        Offset and initial states are those that suit the linear part of the model: a constant input adds a
        constant to each output, and a free motion.
        """
        model = self._with_held(model, effect, values)
        runs, pieces = self.run(model), self._pieces
        if not model.led:
            # columns of the initial states of each window, and of the offsets
            linear = LinearModel.from_statespace(model.system)
            motion, step = linear.C[None], expm(linear.A * pieces[0].dt)
            while motion.shape[0] < max(piece.n_samples for piece in pieces):
                motion, step = np.concatenate([motion, motion @ step]), step @ step
            free = [motion[: piece.n_samples].reshape(-1, linear.n_states) for piece in pieces]
            offsets = np.eye(linear.n_outputs) if "offset" in model.roles else np.zeros((linear.n_outputs, 0))
            columns = np.hstack([block_diag(*free), np.tile(offsets, (runs.shape[1], 1))])
            # least squares with the weights of the outputs
            weights = np.tile(output_weights(pieces, None), runs.shape[1])
            error = -weights * difference(runs, self.record.outputs).T.ravel()
            rows = np.where(np.isnan(self.record.outputs.T.ravel()), 0.0, weights)[:, None] * columns
            added = columns @ np.linalg.lstsq(rows.T @ rows, rows.T @ error, rcond=1e-10)[0]
            runs = runs + added.reshape(-1, linear.n_outputs).T
        return runs, fit_of([self.record], [runs - self.record.outputs])[0]

    def _with_held(self, model: Refinement, effect: Effect, values: Mapping[str, float]) -> Refinement:
        """Return a model with one effect changed or added, not yet settled."""
        before, theta, substeps = model.simulation_structure()
        effects = [
            each if role == "offset" else _held(each, values_of(model, i))
            for i, (each, role) in enumerate(zip(model.effects, model.roles, strict=True))
        ]
        keys = [each.key for each in effects]
        at = keys.index(effect.key) if effect.key in keys else len(effects)
        effects[at : at + 1] = [_held(effect, values)]
        widths = law_widths(Structure(model.physical_model, effects), self._motion) | model.constants
        structure = Structure(model.physical_model, effects, constants=widths)
        # offsets stay; an added effect begins without a state of its own
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

    # ------------------------------------------------------------------ what could be missing
    @cached_property
    def _motion(self) -> Motion:
        return estimated_motion(Structure(self.physical), np.zeros(0), self.record)

    def ranges(self, effect: Effect) -> dict[str, tuple[float, float, float, str]]:
        """Return bounds, natural size and unit of each coefficient."""
        structure = Structure(self.physical, [effect.replace(fixed={}, start={}, prior={})])
        sizes = natural_sizes(structure, [self.record]).tolist()
        rows = zip(structure.parameters, sizes, strict=True)
        return {q.name: (q.lower, q.upper, size, structure.unit(q)) for q, size in rows}

    def force(self, comparison: Comparison, row: Failure | None) -> ResidualForce | None:
        """Return the force that a model lacks at a failure; None at a channel."""
        place = None if row is None else as_instance(row, Failure, "row").values.get("place")
        return None if _at_channel(row) else residual_force(comparison, 0, place)

    def candidates(
        self, held: Sequence[Effect], row: Failure | None, force: ResidualForce | None
    ) -> list[Addition]:
        """Return the effects beside those held that could explain a failure."""
        taken = [effect.key for effect in held]
        library = [effect for effect in candidates_of(self.physical) if effect.key not in taken]
        if row is not None and _at_channel(as_instance(row, Failure, "row")):
            library = [effect for effect in library if effect.spec.at_channel]
        elif force is not None:
            place = as_instance(force, ResidualForce, "force").place
            library = [effect for effect in library if effect.place == place]
        return [self.addition(effect, force) for effect in library]

    def addition(self, effect: Effect, force: ResidualForce | None = None) -> Addition:
        """Return values to begin with, fitted to a force at the effect's place."""
        structure = Structure(self.physical, [effect])
        # shapes that the motion suggests
        starts = [
            {q.name: float(value) for q, value in zip(structure.parameters, theta, strict=True)}
            for theta in shape_starts(structure, structure.start(), self._motion)
        ]
        best = Addition(effect, _ordered(effect, dict(starts[0])))
        if force is None or force.place != effect.place:
            return best
        # levels by least squares for each shape, inside their bounds
        levels = [q for q in structure.parameters if q.name not in effect.spec.shaping]
        bounds = np.array([(q.lower, q.upper) for q in levels]).reshape(-1, 2).T
        edge = force.force.size // _EDGE
        inner = slice(edge, force.force.size - edge)
        wanted = force.force[inner] - force.force[inner].mean()
        power = max(float(np.sum(wanted**2)), 1e-300)
        for start in starts:
            F = _columns(effect, start, force, self.record.inputs, len(levels))
            if F is None:
                continue
            about = F[inner] - F[inner].mean(axis=0)
            values = np.clip(np.linalg.lstsq(about, wanted, rcond=1e-10)[0], *bounds)
            fitted = {q.name: float(value) for q, value in zip(levels, values, strict=True)}
            named = _ordered(effect, start | fitted)
            values = np.array([named[q.name] for q in levels])
            share = 1.0 - float(np.sum((wanted - about @ values) ** 2)) / power
            if not share <= best.share:  # NaN is the first
                best = Addition(effect, named, share, F @ values)
        return best


def values_of(model: Refinement, index: int) -> dict[str, float]:
    """Coefficients of an effect of a model, held or estimated."""
    structure, theta, _ = model.simulation_structure()
    return {name: float(structure.value(theta, index, name)) for name in model.effects[index].coefficients}


def _held(effect: Effect, values: Mapping[str, float]) -> Effect:
    return effect.replace(start={}, prior={}, fixed={**effect.fixed, **values})


def _at_channel(row: Failure | None) -> bool:
    """Return whether a failure lies at an input or an output.

    No force acts there.
    """
    return row is not None and (row.dimension == "time" or "input" in row.values)


def _columns(
    effect: Effect, start: Mapping[str, float], force: ResidualForce, inputs: Array, count: int
) -> Array | None:
    """Return the force per coefficient (N, count) along a motion, or None."""
    shape = {name: value for name, value in start.items() if name in effect.spec.shaping}
    columns = unit_forces(effect, force.position, force.velocity, [shape], inputs)
    if columns is None or len(columns) != count or not np.isfinite(columns).all():
        return None
    return np.array(columns).T


def _ordered(effect: Effect, values: dict[str, float]) -> dict[str, float]:
    """Coefficients of which one is never below another, kept so."""
    for larger, smaller in effect.spec.order:
        values[larger] = max(values[larger], values[smaller])
    return values
