"""One model on its record, in common units, with the places of forces."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property, lru_cache
from typing import TYPE_CHECKING, Any

import numpy as np
from scipy.interpolate import CubicSpline

from ...data.channels import Channels
from ...data.signals import spreads
from ...engine.linear import linear_responses, unit_responses
from ...exceptions import RCOError, unheard
from ...models.physical_model import PhysicalModel
from ...models.ports import Port, felt
from ...systems.discretization import discretize
from ...systems.linear import Array, LinearModel
from .likelihood import Explanation, ResidualLikelihood

if TYPE_CHECKING:
    from ..result import Comparison


@dataclass(frozen=True, slots=True, eq=False)
class Places:
    """The continuous model that forces act on, and the places.

    Attributes
    ----------
    A, C : ndarray
        State matrix in continuous time and output matrix of the compared outputs.
    places : tuple of Port
        Of that model; `output` is all that a unit of force does to the compared outputs at once.
    """

    A: Array
    C: Array
    places: tuple[Port, ...]


def given_places(
    model: Any, linear: LinearModel, channels: Channels, n_inputs: int, outputs: Sequence[int]
) -> Places | None:
    """Places of a `PhysicalModel` or `Refinement`; None for a plain system.

    Parameters
    ----------
    model : PhysicalModel, Refinement or StateSpace
        What was compared.
    linear : LinearModel
        Its linear part, aligned with the record.
    channels : Channels
        Places of the model's channels in the record.
    n_inputs : int
        Inputs of the record.
    outputs : sequence of int
        Rows of the record's outputs that are compared.

    Returns
    -------
    Places or None
    """
    # only a physical model names the places where forces act
    physical = model if isinstance(model, PhysicalModel) else getattr(model, "physical_model", None)
    if not isinstance(physical, PhysicalModel) or not linear.is_continuous:
        return None
    rows = [channels.outputs.index(place) for place in outputs]
    return _places(physical, linear, list(channels.inputs), n_inputs, rows)


def _places(
    physical: PhysicalModel, linear: LinearModel, columns: list[int], n_inputs: int, rows: list[int]
) -> Places:
    def states(row: Array) -> Array:  # a refinement may have states that the initial model has not
        return np.pad(row, (0, linear.n_states - row.size))

    def inputs(row: Array) -> Array:
        placed = np.zeros(n_inputs)
        placed[columns] = row
        return placed

    # row vectors padded to the states, inputs in the order of the record
    places = tuple(
        replace(
            port, act=states(port.act), position=states(port.position), velocity=states(port.velocity),
            position_input=inputs(port.position_input), velocity_input=inputs(port.velocity_input),
            acceleration_input=inputs(port.acceleration_input), output=felt(port, physical.output_rate)[rows],
        )
        for port in physical.ports
    )  # fmt: skip
    return Places(linear.A, linear.C, places)


#: In the order in which a tie is settled.
DIMENSIONS = ("time", "frequency", "amplitude", "state", "place")


@dataclass(frozen=True, slots=True, eq=False)
class Finding:
    """Failure that a search proposes, before the comparison with others.

    Attributes
    ----------
    dimension : str
        One of `DIMENSIONS`.
    where : str
        Region in words.
    measure : str
        What was measured.
    explanation : Explanation
        The part of the residual that it explains.
    dof : int
        Numbers that were fitted.
    tried : int
        Regions among which this one was chosen.
    sentence : str
        What it means.
    values : dict
        The region and what was found, as numbers.
    """

    dimension: str
    where: str
    measure: str
    explanation: Explanation
    dof: int
    tried: int
    sentence: str
    values: dict[str, Any] = field(default_factory=dict)

    def net(self, scene: ModelOnRecord) -> float:
        """Worth less what the numbers fitted cost (Schwarz)."""
        return self.explanation.gain - self.dof * float(np.log(scene.n_samples))


class ModelOnRecord:
    """One model of a comparison on its record, outputs over their spread.

    Parameters
    ----------
    comparison : Comparison
        Models on a record.
    index : int
        Which of the models.
    searched : bool
        Whether its failures are searched: initial states that the comparison estimated are then removed
        from the residual.
    """

    def __init__(self, comparison: Comparison, index: int, *, searched: bool = True) -> None:
        self.data = data = comparison.seen_by(index)
        self.model = model = comparison.models[index]
        self.states, self.starts = comparison.states[index], comparison.starts
        self._given = comparison.places[index]
        self.dt, self.n_samples, self.n_outputs = data.dt, data.n_samples, data.n_outputs
        # outputs relative to their standard deviation
        self.scale = spreads(data.outputs)[:, None]
        self.run, self.measured = comparison.runs[index] / self.scale, data.outputs / self.scale
        self.reset = np.zeros(self.n_samples, dtype=np.uint8)
        self.reset[list(self.starts)] = 1
        # a band-limited input is taken as linear between samples
        self.hold = "foh" if data.hold == "bandlimited" else data.hold
        self.transition, G0, G1 = model.A, model.B, np.zeros_like(model.B)
        if model.is_continuous:
            self.transition, G0, G1 = discretize(model.A, model.B, data.dt, self.hold)
        self._drives = G0, G1
        initial: Array | None = None
        #: whether the free motion from the initial state is much of the run
        self.begins_moving = False
        self._motions: Array | None = None
        # free motions, where the initial state was estimated
        if searched and comparison.x0 == "estimate":
            longest = max(np.diff([*self.starts, self.n_samples]))
            initial = unit_responses(self.transition, model.C, int(longest)) / self.scale
            start = initial @ self.states[:, 0]
            self.begins_moving = bool(np.sum(start**2) > 0.02 * np.sum(self.run[:, : start.shape[0]] ** 2))
            self._motions = initial if len(self.starts) == 1 and self.n_outputs > 1 else None
        #: where each mode was found, to begin from when it is looked for again
        self.known: dict[int, Array] = {}
        #: laws at places and what they would do, kept until the residual changes
        self.laws: list[Any] | None = None
        #: simulated outputs (n_y, N) at a delay in samples, which need not be a whole number
        self.late: Callable[[float], Array] = lru_cache(maxsize=60)(self._with_delay)
        self.evidence = ResidualLikelihood(self.measured - self.run, self.starts, initial)

    @cached_property
    def places(self) -> Places | None:
        """Places where forces could act; None where the matrices show none."""
        found, model = self._given, self.model
        # a plain state-space model: recognize displacements and velocities
        if found is None:
            try:
                with unheard():
                    physical = PhysicalModel.from_statespace(model.to_statespace(), dt=self.dt)
            except (RCOError, np.linalg.LinAlgError):
                return None
            every = list(range(model.n_inputs))
            found = _places(physical, physical.linear, every, len(every), list(range(model.n_outputs)))
        return found if found.places else None

    @property
    def drive(self) -> Array:
        """Change of the state over one sample per unit of each input."""
        return np.asarray(self._drives[0] + self._drives[1])

    @property
    def residual(self) -> Array:
        """Residual (n_y, N) in units of the outputs' spreads, nuisances taken out."""
        return self.evidence.residual

    def only(self, output: int, signal: Array) -> Array:
        """Return outputs (n_y, N) that are zero but one."""
        column: Array = np.zeros_like(self.run)
        column[output] = signal
        return column

    def free(self, output: int) -> list[Array]:
        """Return the free motions that one output alone would show.

        The list is empty if free motions are projected off anyway.
        """
        return [] if self._motions is None else [self.only(output, row) for row in self._motions[:, output].T]

    def driven(self, changes: Sequence[tuple[int, Array]]) -> list[Array]:
        """Return the output changes (n_y, N) that input changes would cause.

        Parameters
        ----------
        changes : sequence of (int, ndarray)
            Input and what is added to it, (N,).
        """
        # linear response to the added inputs, from rest
        which = [i for i, _ in changes]
        signals, model = np.array([s for _, s in changes]).T, self.model
        drives = self._drives[0][:, which], self._drives[1][:, which]
        return self._linear_response(self.transition, drives, model.C, model.D[:, which], signals)

    def forced(self, forces: Sequence[tuple[int, Array]]) -> list[Array]:
        """Return the output changes that resisting forces would cause.

        The forces act at places. Each change has shape (n_y, N).

        Parameters
        ----------
        forces : sequence of (int, ndarray)
            Place and force, (N,) or several values per sample, (N k,), of which the
            mean acts over the sample.
        """
        # forces at the places: mean over the sample, held
        assert self.places is not None
        used = [self.places.places[i] for i, _ in forces]
        fine = [np.reshape(s, (self.n_samples, -1)) for _, s in forces]
        means = np.array([f.mean(axis=1) for f in fine]).T
        acts, back = np.unique(np.array([p.act for p in used]), axis=0, return_inverse=True)
        Phi, G0, G1 = discretize(self.places.A, acts.T, self.dt, "zoh")
        drives = G0[:, back.ravel()], G1[:, back.ravel()]
        nothing = np.zeros((self.n_outputs, len(used)))
        found = self._linear_response(Phi, drives, self.places.C, nothing, means)
        # accelerometers show the force of the very sample
        return [
            column + np.outer(p.output, f[:, 0]) / self.scale
            for column, p, f in zip(found, used, fine, strict=True)
        ]

    def _linear_response(
        self, Phi: Array, drives: tuple[Array, Array], C: Array, D: Array, signals: Array
    ) -> list[Array]:
        out = linear_responses(Phi, drives, C, D, signals, restarts=self.reset)
        return [np.ascontiguousarray(column) / self.scale for column in np.moveaxis(out, (2, 1), (0, 1))]

    def _with_delay(self, delay: float) -> Array:
        """Return the simulated outputs (n_y, N), delayed by some samples."""
        # whole samples by a shift, the rest by running the model on from each sample
        whole = int(np.floor(-delay))
        part = -delay - whole
        w, model = self.data.inputs, self.model
        # discrete models: interpolate the simulated outputs
        if not model.is_continuous:
            grid = np.arange(self.n_samples, dtype=float)
            return np.asarray(CubicSpline(grid, self.run, axis=1)(np.clip(grid - delay, 0.0, grid[-1])))
        if part < 1e-9:
            between = self.run
        else:
            Phi, G0, G1 = discretize(model.A, model.B, part * self.dt, self.hold)
            after = np.concatenate([w[:, 1:], w[:, -1:]], axis=1)
            end = w + part * (after - w) if self.hold == "foh" else w
            x = Phi @ self.states + G0 @ w + G1 @ end
            linear = model.C @ self.states + model.D @ w
            # what the model has beside its linear part is taken as it stands at the sample
            between = (model.C @ x + model.D @ end - linear) / self.scale + self.run
        index = np.clip(np.arange(self.n_samples) + whole, 0, self.n_samples - 1)
        return np.asarray(between[:, index])

    def time(self, sample: int) -> float:
        """Time of a sample in s; one past the last is the end of the record."""
        if sample >= self.n_samples:
            return float(self.data.timepts[-1] + self.dt)
        return float(self.data.timepts[sample])

    def named(self, output: int) -> str:
        """Name of an output."""
        return self.data.output_labels[output]

    def unit(self, output: int) -> str:
        """Return a blank and the unit of an output, or nothing."""
        unit = self.data.output_units[output]
        return f" {unit}" if unit else ""
