"""One model on its record, in common units, for the failure searches."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from itertools import pairwise
from typing import TYPE_CHECKING, Any

import numpy as np
from scipy.interpolate import CubicSpline
from scipy.signal import lfilter

from ...data.measurement import Measurement
from ...engine.linear import linear_responses
from ...exceptions import RCOError, unheard
from ...systems.conversion import d2c
from ...systems.discretization import discretize
from ...systems.linear import Array, LinearModel
from .likelihood import Explanation, ResidualLikelihood
from .places import Places, found_places

if TYPE_CHECKING:
    from ..result import Comparison

__all__ = ["DIMENSIONS", "Finding", "ModelOnRecord", "model_on_record"]

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
    """One model on its record, outputs over their spread.

    Parameters
    ----------
    data : Measurement
        Record.
    model : LinearModel
        Linear part of the model, channels in the record's order.
    run : ndarray of shape (n_y, N)
        Simulated outputs.
    states : ndarray of shape (n, N)
        Simulated states.
    starts : sequence of int
        First sample of each free run.
    estimated : bool
        Whether the initial state was estimated from the record.
    places : Places or None
        Where forces could act.
    """

    def __init__(
        self,
        data: Measurement,
        model: LinearModel,
        run: Array,
        states: Array,
        starts: Sequence[int],
        *,
        estimated: bool,
        places: Places | None,
    ) -> None:
        self.data, self.model, self.starts, self.places = data, model, tuple(starts), places
        spread = data.outputs.std(axis=1)
        self.scale = np.where(spread > 0, spread, 1.0)[:, None]
        self.run, self.measured = run / self.scale, data.outputs / self.scale
        self.states, self.estimated = states, estimated
        self.dt, self.n_samples = data.dt, data.n_samples
        self.n_outputs = data.n_outputs
        self.reset = np.zeros(self.n_samples, dtype=np.uint8)
        self.reset[list(self.starts)] = 1
        self.hold = "foh" if data.hold == "bandlimited" else data.hold
        if model.is_continuous:
            self._transition, G0, G1 = discretize(model.A, model.B, data.dt, self.hold)
            self._drive = G0, G1
        else:
            self._transition, self._drive = model.A, (model.B, np.zeros_like(model.B))
        initial: Array | None = None
        #: whether the free motion from the initial state is much of the run
        self.begins_moving = False
        self._motions: Array | None = None
        if estimated:
            longest = max(np.diff([*self.starts, self.n_samples]))
            initial = self._free(int(longest)) / self.scale
            start = initial @ states[:, 0]
            self.begins_moving = bool(np.sum(start**2) > 0.02 * np.sum(self.run[:, : start.shape[0]] ** 2))
            self._motions = initial if len(self.starts) == 1 and self.n_outputs > 1 else None
        #: where each mode was found, to begin from when it is looked for again
        self.known: dict[int, Array] = {}
        #: laws at places and what they would do, kept until the residual changes
        self.laws: list[Any] | None = None
        self._late: dict[float, Array] = {}
        self.evidence = ResidualLikelihood(self.measured - self.run, self.starts, initial)

    def _free(self, length: int) -> Array:
        """Outputs from unit initial states, (length, n_y, n)."""
        x, out = np.eye(self.model.n_states), np.empty((length, self.n_outputs, self.model.n_states))
        for k in range(length):
            out[k] = self.model.C @ x
            x = self._transition @ x
        return out

    @property
    def continuous(self) -> LinearModel | None:
        """The model in continuous time; None where it cannot be had."""
        if self.model.is_continuous:
            return self.model
        try:
            with unheard():
                sampled = self.model.with_arrays(dt=self.dt).to_statespace()
                return LinearModel.from_statespace(d2c(sampled))
        except (RCOError, np.linalg.LinAlgError):
            return None

    @property
    def transition(self) -> Array:
        """Transition matrix of one sample."""
        return np.ascontiguousarray(self._transition)

    @property
    def drive(self) -> Array:
        """Change of the state over one sample per unit of each input."""
        return np.asarray(self._drive[0] + self._drive[1])

    def free(self, output: int) -> list[Array]:
        """Return the free motions that one output alone would show.

        The list is empty if free motions are projected off anyway.
        """
        if self._motions is None:
            return []
        columns = np.zeros((self.model.n_states, *self.run.shape))
        columns[:, output] = self._motions[:, output].T
        return list(columns)

    @property
    def residual(self) -> Array:
        """Residual (n_y, N) in units of the outputs' spreads, nuisances taken out."""
        return self.evidence.residual

    def driven(self, changes: Sequence[tuple[int, Array]]) -> list[Array]:
        """Return the output changes (n_y, N) that input changes would cause.

        Parameters
        ----------
        changes : sequence of (int, ndarray)
            Input and what is added to it, (N,).
        """
        if not changes:
            return []
        which = [i for i, _ in changes]
        signals = np.ascontiguousarray(np.array([s for _, s in changes]).T)
        G0, G1 = self._drive
        return self._marched(G0[:, which], G1[:, which], self.model.D[:, which], signals)

    def forced(self, forces: Sequence[tuple[int, Array]]) -> list[Array]:
        """Return the output changes that resisting forces would cause.

        The forces act at places. Each change has shape (n_y, N).

        Parameters
        ----------
        forces : sequence of (int, ndarray)
            Place and force, (N,) or several values per sample, (N k,), of which the
            mean acts over the sample.
        """
        if not forces or self.places is None:
            return []
        used = [self.places.places[i] for i, _ in forces]
        fine = [np.reshape(s, (self.n_samples, -1)) for _, s in forces]
        means = np.ascontiguousarray(np.array([f.mean(axis=1) for f in fine]).T)
        acts = np.array([p.act for p in used]).T
        unique, back = np.unique(acts, axis=1, return_inverse=True)
        Phi, G0, G1 = discretize(self.places.A, unique, self.dt, "zoh")
        back = back.reshape(-1)
        nothing = np.zeros((self.n_outputs, len(used)))
        found = self._marched(G0[:, back], G1[:, back], nothing, means, Phi, self.places.C)
        # accelerometers show the force of the very sample
        return [
            column + np.outer(p.output, f[:, 0]) / self.scale
            for column, p, f in zip(found, used, fine, strict=True)
        ]

    def moved(self, place: int, force: Array) -> Array:
        """Return the state change (n, N) that a resisting force would cause.

        The force acts at a place.
        """
        assert self.places is not None
        act = self.places.places[place].act[:, None]
        Phi, G0, G1 = discretize(self.places.A, act, self.dt, "zoh")
        force = np.reshape(force, (self.n_samples, -1)).mean(axis=1)
        n = Phi.shape[0]
        out = linear_responses(
            Phi, (G0, G1), np.eye(n), np.zeros((n, 1)), force[:, None], restarts=self.reset
        )
        return np.ascontiguousarray(out[:, :, 0].T)

    def _marched(
        self, G0: Array, G1: Array, D: Array, F: Array, Phi: Array | None = None, C: Array | None = None
    ) -> list[Array]:
        Phi, C = self._transition if Phi is None else Phi, self.model.C if C is None else C
        out = linear_responses(Phi, (G0, G1), C, D, F, restarts=self.reset)
        return [np.ascontiguousarray(column) / self.scale for column in np.moveaxis(out, (2, 1), (0, 1))]

    def late(self, delay: float) -> Array:
        """Return the simulated outputs (n_y, N), delayed by some samples.

        A delay that is no whole number of samples is exact, too.
        """
        key = round(delay, 6)
        if key not in self._late:
            if len(self._late) > 60:
                self._late.clear()
            self._late[key] = self._delayed(delay)
        return self._late[key]

    def _delayed(self, delay: float) -> Array:
        whole = int(np.floor(-delay))
        part = -delay - whole
        w, model = self.data.inputs, self.model
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

    def section(self, numerator: Array, denominator: Array, signal: Array) -> Array:
        """Signal through a rational filter, begun anew with each free run."""
        if len(self.starts) == 1:
            return np.asarray(lfilter(numerator, denominator, signal))
        edges = [*self.starts, self.n_samples]
        parts = [lfilter(numerator, denominator, signal[a:b]) for a, b in pairwise(edges)]
        return np.concatenate(parts)

    def time(self, sample: int) -> float:
        """Time of a sample in s; one past the last is the end of the record."""
        if sample >= self.n_samples:
            return float(self.data.timepts[-1] + self.dt)
        return float(self.data.timepts[sample])

    def named(self, output: int) -> str:
        """Name of an output."""
        return self.data.output_labels[output]


def model_on_record(comparison: Comparison, index: int) -> tuple[ModelOnRecord, list[str]]:
    """Return a model of a comparison on its record, and notes.

    The notes list what cannot be searched.
    """
    notes: list[str] = []
    model = comparison.models[index]
    places = comparison.places[index]
    if places is None:
        places = found_places(model, comparison.data.dt)
    if places is None or not places.places:
        places = None
        notes.append("State space and place were not searched: no places were found in this model")
    scene = ModelOnRecord(
        comparison.seen_by(index), model, comparison.runs[index], comparison.states[index], comparison.starts,
        estimated=comparison.x0 == "estimate", places=places,
    )  # fmt: skip
    return scene, notes
