"""Fit of one set of effects to the records.

The fit searches, optimizes, chooses the substeps and estimates the noise levels.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import control as ct
import numpy as np

from ..data.measurement import Measurement
from ..data.signals import measured, over_time
from ..engine.structure import Structure
from ..exceptions import DataError
from ..systems.linear import Array
from .outcome import output_weights
from .parameters import parameter_table, priors, weak_priors
from .problem import Descent, Problem, descend
from .search import search, starting_states, sufficient_steps
from .starts import Motion, shape_starts

_ROUGHLY, _EXACTLY = 1e-2, 1e-9  # tolerance in log-likelihood before and after the substeps are final


class Fit:
    """Fit of one set of effects to the records."""

    def __init__(
        self,
        structure: Structure,
        roles: Sequence[str],
        segments: Sequence[Measurement],
        noise: Any,
        initial: Array | None,
        tolerance: float,
    ) -> None:
        self.structure, self.roles, self.segments, self.noise = structure, tuple(roles), segments, noise
        self.initial = None if initial is None else _pad_state(initial, structure.n_states)
        # table of parameters with their priors; weights of the outputs, one over the noise level
        self.table = parameter_table(structure, roles, tolerance)
        self.priors = priors(self.table)._replace(added=True)
        self.weights = output_weights(segments, noise)
        self.steps = 1
        self.problem: Problem
        self.result: Descent
        values = measured(record.outputs for record in segments)
        unknowns = structure.n_parameters + structure.n_states * len(segments)
        if values <= unknowns:
            raise DataError(
                f"the record has {values} output values for {unknowns} unknown parameters and states; "
                "give a longer record or fewer effects"
            )

    def build(self, segments: Sequence[Measurement], steps: int, unknown_start: bool = False) -> Problem:
        """The problem on some segments at the present noise levels."""
        return Problem(
            self.structure,
            segments,
            self.weights,
            priors=self.priors,
            substeps=steps,
            initial=None if unknown_start else self.initial,
        )

    def run(
        self,
        motion: Motion,
        substeps: int | None,
        near: Fit | None = None,
        starts: Sequence[Array] = (),
    ) -> None:
        """Search, optimize and refine the substep until it no longer matters.

        The search begins at `starts`, by default at the shapes of the laws. With `near`, it is left
        out: the minimum of that fit is the start.
        """
        # start from the minimum of a similar fit
        if near is not None:
            self.steps = near.steps
            self.problem = self.build(self.segments, self.steps)
            point = self.problem.pack(*near.problem.unpack(near.result.point))
        else:
            # first substeps: 1 is exact for linear models, stages give half the substeps
            self.steps = substeps or (1 if self.structure.is_linear else 3 - self.structure.stages)
            # search from several starting values of the shape coefficients
            starts = starts or shape_starts(self.structure, self.structure.start(), motion)
            point, found = search(self.build, self.structure, self.segments, starts, self.steps)
            self.steps = substeps or found
            self.problem = self.build(self.segments, self.steps)
        self._settle(point, substeps)

    def resume(self, steps: int, states: Array) -> None:
        """Optimize from the starting values of the effects.

        The known initial states are used if they fit the records better than estimated ones.
        """
        self.steps = steps
        self.problem = self.build(self.segments, self.steps)
        theta = self.structure.start()
        points = [self.problem.pack(theta, starting_states(self.problem, theta))]
        if states.shape == (len(self.segments), self.structure.n_states):
            points.append(self.problem.pack(theta, states))
        self._settle(min(points, key=self.problem.cost), None)

    def _settle(self, point: Array, substeps: int | None) -> None:
        # coarse fit; noise levels and substeps until they no longer change; then an exact fit
        self._polish(point, _ROUGHLY)
        while True:
            self._reweigh()
            finer = sufficient_steps(self.build, self.segments, self.problem, self.result.point)
            # fixed by the user, or sufficient
            if substeps or finer == self.steps:
                break
            self.steps = finer
            self.problem = self.build(self.segments, self.steps)
            self._polish(self.result.point, _ROUGHLY)
        self._polish(self.result.point, _EXACTLY)

    def _polish(self, point: Array, unnoticed: float) -> None:
        self.result = descend(self.problem, point, evaluations=60, tolerance=0.0, unnoticed=unnoticed)

    def _reweigh(self) -> None:
        """Estimate the noise levels from the residual.

        Optimize once more with these levels if they can move the minimum.
        """
        if self.noise is not None:
            return
        self.weights = output_weights(self.segments, None, self.problem, self.result.point)
        self.problem = self.build(self.segments, self.steps)
        # new weights move the minimum only with several outputs, or against priors
        if self.weights.size > 1 or np.isfinite(self.problem.prior_sd[~weak_priors(self.table)]).any():
            self._polish(self.result.point, _ROUGHLY)

    @property
    def theta(self) -> Array:
        """Coefficients at the minimum."""
        return self.problem.unpack(self.result.point)[0]

    @property
    def cost(self) -> float:
        """Log of the residual power over the outputs: comparable between fits."""
        # concentrated log-likelihood: log of the mean square of each output
        blocks = self.problem.own_blocks(self.result.point)
        residual = np.hstack([r for r, _, _ in blocks]) / self.problem.weights[:, None]
        return float(np.sum(np.log(over_time(np.mean, residual**2) + 1e-300)))


def _pad_state(initial: Array, n: int) -> Array:
    """Known initial state; states that effects add start at rest."""
    # zero for the states of effects
    full = np.zeros(n)
    if initial.ndim != 1 or initial.size > n:
        raise ct.ControlDimension(f"x0 has shape {initial.shape}; the model has {n} states")
    full[: initial.size] = initial
    return full
