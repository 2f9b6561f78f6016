"""A fitted model on its records, ready to be tested and added to."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property, partial
from typing import Any

import numpy as np

from ..data.measurement import Measurement
from ..data.signals import spreads
from ..effects.effect import Effect
from ..engine.observer import existing_gain
from ..engine.point import linearized
from ..engine.structure import Structure
from ..gauss_newton import Bordered
from ..models.operating_point import ordered_record, sensed
from ..systems.linear import Array
from .covariance import covariance
from .outcome import output_weights
from .parameters import parameter_table, priors
from .problem import Problem
from .refinement import Refinement
from .starts import Motion, law_widths
from .whitening import Whitener

_STRONGER = 1e-3  # relative increase of an observer gain for a difference


@dataclass(eq=False)
class FittedModel:
    """A refinement at its minimum: residual, Jacobian, motion.

    Attributes
    ----------
    refinement : Refinement
        Model with effects at their estimates.
    problem : Problem
        Its estimation problem; weights are one over the noise level.
    point : ndarray
        Minimum.
    tolerance : float
        Declared relative sd of the linear parameters.
    force_at : str
        Where an unmeasured force would act: "everywhere" or "inputs".
    """

    refinement: Refinement
    problem: Problem
    point: Array
    tolerance: float
    force_at: str = "everywhere"
    _blocks: dict[float, list[tuple[Array, Array]]] = field(default_factory=dict)
    _gains: dict[float, Array] = field(default_factory=dict)
    _states: dict[float, list[Array]] = field(default_factory=dict)

    @property
    def structure(self) -> Structure:
        """Model in feedback with its effects."""
        return self.problem.structure

    @property
    def theta(self) -> Array:
        """Coefficients."""
        return self.problem.unpack(self.point)[0]

    def gain(self, ratio: float) -> Array | None:
        """Return the observer gain for an unknown force of a given ratio.

        For ratio 0, return the gain that stabilizes an unstable model, or None.
        """
        if ratio == 0:
            lead: Array | None = self.problem.engines[0].lead
            return lead
        # gain for this ratio, computed once
        if ratio not in self._gains:
            self._gains[ratio] = existing_gain(
                self.structure, self.theta, self.problem.records[0], ratio, at=self.force_at
            )
        return self._gains[ratio]

    def forced(self, at: str) -> FittedModel:
        """Return the model with unmeasured forces at another place."""
        if at == self.force_at:
            return self
        # free runs do not depend on where an unmeasured force acts
        free = {ratio: blocks for ratio, blocks in self._blocks.items() if ratio == 0}
        return replace(self, force_at=at, _blocks=free, _gains={}, _states={})

    def at(self, point: Array) -> FittedModel:
        """Return the model at another point."""
        return replace(self, point=point, _blocks={}, _gains={}, _states={})

    def blocks(self, ratio: float = 0.0) -> list[tuple[Array, Array]]:
        """Return the residual and the Jacobian of each record.

        The shapes are (n_y, N) and (n_y, N, .). Ratio 0 means the simulation, any other ratio an observer.

        The columns of the Jacobian are the coefficients, then the initial state of the record.
        """
        if ratio not in self._blocks:
            self._blocks[ratio] = evaluated(self.problem, self.point, self.gain(ratio))
        return self._blocks[ratio]

    def residuals(self, ratio: float = 0.0) -> list[Array]:
        """Residuals of the records, in units of the noise."""
        return [r for r, _ in self.blocks(ratio)]

    def states(self, ratio: float = 0.0) -> list[Array]:
        """States (n, N) of each record, free run or observer-led.

        Those before the correction by the sample's own measurement: what they say about
        a sample must not contain the noise of that sample.
        """
        if ratio not in self._states:
            theta, starts = self.problem.unpack(self.point)
            gain = self.gain(ratio)
            found = []
            for i, (engine, start) in enumerate(zip(self.problem.engines, starts, strict=True)):
                run = engine.run(theta, start, sensitivity=False, gain=gain, histories=True, check=False)
                states = np.nan_to_num(run.states)
                # the states are corrected, x + K (y - y_model): take the correction back
                if gain is not None:
                    states = states + gain @ np.nan_to_num(
                        self.residuals(ratio)[i] / self.problem.weights[:, None]
                    )
                found.append(states)
            self._states[ratio] = found
        return self._states[ratio]

    @cached_property
    def lead_columns(self) -> list[Array]:
        """Return how a stronger observer gain changes the judged residual.

        Each output has one column; the shape is (n_y, N, k) for each record.

        There are no columns without an observer, or where a known controller stabilizes the run. No observer
        of a nonlinear model is optimal, and the improvement by a better one is no fault of the model.
        """
        # no columns without an observer, or with a known controller
        K, records = self.gain(0.0), self.problem.records
        known = self.structure.model.controller is not None
        columns = [np.zeros((*r.outputs.shape, 0 if K is None or known else len(r.outputs))) for r in records]
        theta, starts = self.problem.unpack(self.point)
        # derivative by the gain of one output: 0.1 % more, difference of the residuals
        for k in range(columns[0].shape[2]):
            stronger = np.array(K)
            stronger[:, k] *= 1.0 + _STRONGER
            for i, (engine, start) in enumerate(zip(self.problem.engines, starts, strict=True)):
                run = engine.run(theta, start, sensitivity=False, gain=stronger, check=False)
                error = self.problem.weights[:, None] * (run.outputs - engine.data.outputs)
                if np.isfinite(run.outputs).all():  # no column if the run diverges
                    columns[i][:, :, k] = error - self.residuals()[i]
        # zero where the samples cannot be compared
        judged = self.problem.judged(theta)
        return [weight[:, :, None] * block for weight, block in zip(judged, columns, strict=True)]

    def port(self, name: str, ratio: float, record: int) -> tuple[Array, Array]:
        """Displacement and velocity (N,) at a port."""
        return sensed(
            self.structure.model, name, self.states(ratio)[record], self.problem.records[record].inputs
        )

    def linearized(self) -> tuple[Array, Array]:
        """Return A and C with nonlinear forces replaced by linear fits.

        Each fit is the best one along the motion.
        """
        theta, starts = self.problem.unpack(self.point)
        run = self.problem.engines[0].run(theta, starts[0], sensitivity=False, histories=True, check=False)
        return linearized(self.structure, theta, run, self.problem.records[0].inputs)

    def extended(self, effects: Sequence[Effect], motion: Motion) -> tuple[Problem, Array]:
        """Return the problem with added effects, and its starting point.

        The added effects are absent at that point; their shape coefficients have their starting values.
        """
        old = self.refinement
        # old effects first, so that their coefficients keep their columns
        base = Structure(old.physical_model, [*old.effects, *effects])
        widths = law_widths(base, motion)
        widths.update(old.constants)
        structure = Structure(old.physical_model, base.effects, constants=widths)
        roles = [*old.roles, *("effect" for _ in effects)]
        held = priors(parameter_table(structure, roles, self.tolerance))
        problem = self.problem.like(structure, priors=held, substeps=old.substeps)
        theta, starts = self.problem.unpack(self.point)
        # added effects are absent, their states zero
        full = np.concatenate([theta, structure.start()[theta.size :]])
        added = structure.n_states - starts.shape[1]
        return problem, problem.pack(full, np.pad(starts, ((0, 0), (0, added))))


def evaluated(problem: Problem, point: Array, gain: Array | None = None) -> list[tuple[Array, Array]]:
    """Return the residual and the Jacobian of each record.

    With a gain, an observer corrects the simulation. The Jacobian has a column for each unknown that affects
    the record.
    """
    return [(r, j) for r, j, _ in problem.own_blocks(point, gain)]


def coefficient_covariance(
    problem: Problem, blocks: Sequence[tuple[Array, Array]], whitener: Whitener
) -> Array:
    """Return the generalized least-squares covariance of the coefficients.

    The shape is (p, p); `blocks` are those of `evaluated`.
    """
    p, white = problem.n_theta, [whitener.apply([j]) for _, j in blocks]
    # one record: information matrix J'J of the whitened Jacobian
    if len(white) == 1:
        return covariance(white[0].T @ white[0] + np.diag(problem.precision))[:p, :p]
    # several records: eliminate the initial state of each (Schur complement)
    found = Bordered.of(white, [np.zeros(len(j)) for j in white], p)
    prior = np.diag(problem.precision[:p])
    return covariance(found.condensed() + prior, size=np.sqrt(np.diag(found.common + prior)))


def fitted_from(
    refinement: Refinement, data: Sequence[Measurement], *, tolerance: float, noise: Any = None
) -> FittedModel:
    """The refinement on its records, at its minimum.

    Parameters
    ----------
    refinement : Refinement
        Result of `refine` on the same records.
    data : sequence of Measurement
        Segments, as many as the refinement has initial states.
    tolerance : float
        Declared relative sd of the linear parameters.
    noise : float or sequence of float, optional
        Declared noise, else the residual's own level.

    Returns
    -------
    FittedModel
    """
    structure, theta, steps = refinement.simulation_structure()
    records = [ordered_record(refinement.physical_model, r) for r in data]
    shape = refinement.rmse.shape
    held = priors(parameter_table(structure, refinement.roles, tolerance))
    made = partial(Problem, structure, records, priors=held, substeps=steps)
    # noise level: declared, of the measured points, or that of the residual
    if noise is not None:
        level = np.broadcast_to(np.asarray(noise, float), shape)
    elif not records[0].in_time:  # in units of the noise of the points
        plain = made(np.ones(shape))
        level = 1.0 / output_weights(records, None, plain, plain.pack(theta, refinement.initial_states))
    else:
        level = refinement.rmse
    # an exact record has a tiny noise level, not none
    spread = spreads(np.concatenate([r.outputs for r in records], axis=1))
    weights = 1.0 / np.maximum(level, 1e-12 * spread)
    # weights are one over the noise level
    problem = made(weights)
    return FittedModel(refinement, problem, problem.pack(theta, refinement.initial_states), tolerance)
