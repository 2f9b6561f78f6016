"""Entries of a linear model as coefficients, and forms of a correction.

The matrices are [A B; C D] plus patterns times coefficients.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import control as ct
import numpy as np

from ...effects.bodies import Entry
from ...engine.linear import state_power
from ...exceptions import ConversionWarning, ModelError, unheard
from ...inference.covariance import standard_deviations
from ...systems.conversion import nearest_continuous, to_discrete
from ...systems.discretization import exponential
from ...systems.linear import Array, LinearModel
from .kernel import Kernel, Layout
from .setup import DOUBT, NEVER, CoefficientMemory, CoefficientSetup, FilterSettings, advanced, signal_sizes

# Samples at which the first ones are gone over: a wrong start spoils what was learned from them.
MILESTONES = (32, 64, 128, 256, 512, 1024, 2048)
_TINY_STEP = 1e-30
_SHARE = 0.3  # of its standard deviation that an entry may move before the model is discretized anew
_SMALL = 1e-4  # of a standard deviation, for derivatives of the continuous entries
_SURPRISE = 9.0  # mean square of about 32 innovations over their variance: what was learned does not hold
_UNSEEN = 1e-7  # of the largest change of the response: a direction that changes it less changes nothing
_LEAST = 0.1  # prior of an entry that is zero, over what would move its row as much as all else does


@dataclass(frozen=True, eq=False)
class EntriesSetup(CoefficientSetup):
    """Linear model whose matrices depend linearly on coefficients.

    It keeps its own timebase.

    Parameters
    ----------
    model : LinearModel
        Initial model, as it was given.
    base : LinearModel
        The model that the patterns change: the initial one, or the same discretized.
    patterns : ndarray of shape (p, n + n_y, n + n_w)
        Change of [A B; C D] by a unit of each coefficient.
    labels : tuple of str
        Names of the coefficients.
    nominal : ndarray of shape (p,)
        Size of what each coefficient changes, in its unit; 0 where that is zero.
    value : ndarray of shape (p,)
        Entry of the initial model as it was given, 0 where a coefficient is no single entry.
    share_of_rate : float
        Prior standard deviation of a coefficient over what would move its row as much as all else does.
    settings : FilterSettings
        Sampling, noise, memory.
    one_to_one : bool
        Hold the coefficients still along directions that change no response of the initial model,
        so that each response has one set of them.
    milestones : tuple of int
        Numbers of samples at which the first ones are gone over.
    """

    model: LinearModel
    base: LinearModel
    patterns: Array
    labels: tuple[str, ...]
    nominal: Array
    value: Array
    share_of_rate: float
    settings: FilterSettings
    one_to_one: bool = False
    milestones: tuple[int, ...] = MILESTONES

    @cached_property
    def layout(self) -> Layout:  # type: ignore[override]
        """Sizes of the packed memory."""
        base = self.base
        return Layout(base.n_states, len(self.labels), base.n_inputs + 1, base.n_outputs, 0, 0)

    @cached_property
    def bounds(self) -> tuple[Array, Array]:  # type: ignore[override]
        """No bounds."""
        free = np.full(len(self.labels), np.inf)
        return -free, free

    @cached_property
    def share(self) -> float:  # type: ignore[override]
        """Standard deviations a coefficient may move before rediscretization."""
        return _SHARE if self.base.is_continuous else NEVER

    @cached_property
    def watch(self) -> float:  # type: ignore[override]
        """Mean square of normalized innovations at which the filter restarts."""
        return _SURPRISE if self.labels else NEVER

    def start(self) -> Array:
        """Zero, the initial model."""
        return np.zeros(len(self.labels))

    def stacked(self, theta: Array) -> Array:
        """[A B; C D] at these coefficients."""
        return self._whole + np.tensordot(theta, self.patterns, axes=1)

    @cached_property
    def _whole(self) -> Array:
        base = self.base
        return np.block([[base.A, base.B], [base.C, base.D]])

    def system(self, theta: Array, widths: Array, name: str) -> LinearModel:
        """Model at these coefficients, in the timebase that it is estimated in."""
        n, whole = self.base.n_states, self.stacked(theta)
        return self.base.with_arrays(
            A=whole[:n, :n], B=whole[:n, n:], C=whole[n:, :n], D=whole[n:, n:], name=name
        )

    @property
    def translates(self) -> bool:  # type: ignore[override]
        """True where discrete entries stand for a continuous model."""
        return self.model.is_continuous and not self.base.is_continuous

    def translated(self, theta: Array, covariance: Array) -> tuple[Array, Array]:
        """Return coefficients and covariance in the given time domain.

        Entries of a discrete form of a continuous model are those of its continuous model; the covariance
        follows to first order. What is not learned stays as it is.
        """
        if not (self.translates and np.isfinite(covariance).all()):
            return theta, covariance
        steps = np.diag(_SMALL * standard_deviations(covariance))
        with unheard(ConversionWarning):
            found, *moved = (self._continuous(theta + step) for step in (0.0 * theta, *steps))
        sizes = np.where(np.diag(steps) > 0, np.diag(steps), 1.0)
        slope = (np.array(moved) - found).T / sizes
        return found - self.value, slope @ covariance @ slope.T

    def _continuous(self, theta: Array) -> Array:
        """Return the entries of the continuous model at these coefficients."""
        near = nearest_continuous(self.system(theta, theta, ""))
        return np.tensordot(self.patterns, np.block([[near.A, near.B], [near.C, near.D]]), axes=2)

    def rows(self, theta: Array, spread: Array) -> tuple[Any, ...]:
        """Estimated parameters, one row each."""
        from ...inference.parameters import EstimatedParameter

        return tuple(
            EstimatedParameter(
                name=name, kind=Entry.name, place=name, initial=float(value), value=float(value + change),
                coefficient=float(change), std=float(std), unit="", role="coefficient",
            )
            for name, value, change, std in zip(self.labels, self.value, theta, spread, strict=True)
        )  # fmt: skip

    def go_over(self, memory: CoefficientMemory) -> CoefficientMemory:
        """Return the memory after filtering the first samples again.

        The filter starts from the present coefficients.

        Where that diverges, the filter goes on as it was.
        """
        # first samples give the sizes of signals and with them the prior
        memory = _with_sizes(self, memory)
        # filter as at the start, but about the present coefficients
        about = self.about(memory, self.layout.parts(memory.packed).theta)
        parts = self.layout.parts(about.packed)
        parts.level[:] = memory.sizes[-self.layout.ny :] ** 2
        parts.count[:] = DOUBT
        about = replace(about, rounds=memory.rounds + 1, doubted=0)
        # run over the samples that were kept from the beginning
        found, done = advanced(self, about, about.first, self.layout.record(0))
        if done == len(about.inputs) and np.isfinite(found.packed).all():
            return found
        if memory.rounds == 0:  # from now on sample by sample: the guard says where it fails
            return about
        return replace(memory, rounds=memory.rounds + 1, kernel=None)

    # -- for the kernel ------------------------------------------------------------------------------

    def discretized(self, theta: Array) -> tuple[Array, Array]:
        """Return the discretized state equation and its derivatives.

        The columns belong to the state and to the inputs before and after one sample. The
        derivatives are by each coefficient.
        """
        base, hold = self.base, self.settings.hold
        n, nw, p = base.n_states, base.n_inputs, len(self.labels)
        nu = nw + 1
        whole = self.stacked(theta)[:n]
        M, dM = np.zeros((1, n, n + 2 * nu)), np.zeros((p, n, n + 2 * nu))
        # a discrete model needs no discretization: its patterns are the derivatives
        if not base.is_continuous:
            M[0, :, : n + nw] = whole
            dM[:, :, : n + nw] = self.patterns[:, :n]
            return M[0], dM
        # zero-order or first-order hold by the exponential of an augmented matrix
        columns = 2 * nw if hold == "foh" else nw
        moving = np.flatnonzero(self.patterns[:, :n].any(axis=(1, 2)))  # coefficients that enter A or B
        blocks = np.zeros((1 + moving.size, n + columns, n + columns), complex)
        blocks[:, :n, : n + nw] = whole
        # complex step: the imaginary part is the derivative, without cancellation
        blocks[1:, :n, : n + nw] += 1j * _TINY_STEP * self.patterns[moving, :n]
        blocks *= self.settings.dt
        if hold == "foh":
            blocks[:, n : n + nw, n + nw :] = np.eye(nw)
        with np.errstate(over="ignore", invalid="ignore"):  # the loop says so where the model blows up
            E = exponential(blocks)[:, :n]
        # first-order hold: part of the integral belongs to the input at the end of the sample
        late = E[:, :, n + nw :] if hold == "foh" else np.zeros((len(E), n, nw))
        held = np.zeros((len(E), n, n + 2 * nu), complex)
        held[:, :, :n] = E[:, :, :n]
        held[:, :, n : n + nw] = E[:, :, n : n + nw] - late
        held[:, :, n + nu : n + nu + nw] = late
        M[0] = held[0].real
        slopes = held[1:].imag / _TINY_STEP
        dM[moving] = np.where(np.isfinite(slopes), slopes, 0.0)  # in units too far apart to tell: it stays
        return M[0], dM

    def compile(self, memory: CoefficientMemory) -> Kernel:
        """Discretize at `memory.centre` and pack what the loop needs."""
        lay, base = self.layout, self.base
        n, nu, ny, p = lay.n, lay.nu, lay.ny, lay.p
        nw = nu - 1
        M, dM = self.discretized(memory.centre)
        O, dO = np.zeros((ny, n + nu)), np.zeros((p, ny, n + nu))
        # outputs: the derivatives are the patterns themselves
        O[:, : n + nw] = self.stacked(memory.centre)[n:]
        dO[:, :, : n + nw] = self.patterns[:, n:]
        level = np.where(memory.sizes[:nw] > 0, memory.sizes[:nw], 1.0)
        inputs = base.B * level * (self.settings.dt if base.is_continuous else 1.0)
        head, floor = self.head(memory, self.bounds, inputs * self.settings.disturbance, inputs)
        fixed = np.concatenate([*head, M.ravel(), O.ravel(), dM.ravel(), dO.ravel(), np.arange(float(p))])
        sizes = np.array([n, p, nu, ny, p, 0, 0, 0], dtype=np.int64)
        return Kernel(sizes, fixed, None, floor)

    def prior_covariance(self, spread: Array) -> Array:
        """Covariance of the coefficients before the first sample, shape (p, p).

        Along a change of coordinates of the states no sample tells anything; what linearization
        seems to tell there would let the coefficients wander.
        """
        if not self.one_to_one or not self.labels:
            return super().prior_covariance(spread)
        # singular directions of the response change; those that change nothing get no prior variance
        _, sizes, directions = np.linalg.svd(self._response_change * spread)
        seen = directions[: np.count_nonzero(sizes > _UNSEEN * sizes[0])]
        return (seen * spread).T @ (seen * spread)

    @cached_property
    def _response_change(self) -> Array:
        """Change of the initial frequency response by each coefficient.

        The shape is (2 K n_y n_w, p).
        """
        n, nw, p = self.base.n_states, self.base.n_inputs, len(self.labels)
        M, dM = self.discretized(self.start())
        nu = nw + 1
        # both input columns act as one in a steady sine
        A, B = M[:, :n], M[:, n : n + nw] + M[:, n + nu : n + nu + nw]
        C = self.base.C
        rows = []
        # frequencies below the Nyquist frequency, relative to the largest gain at each
        for omega in np.geomspace(1e-3, 0.9, 60) * np.pi:
            resolvent = np.linalg.inv(np.exp(1j * omega) * np.eye(n) - A)
            left, right = C @ resolvent, resolvent @ B
            size = max(float(np.abs(left @ B + self.base.D).max(initial=0.0)), 1e-300)
            dA, dB = dM[:, :, :n], dM[:, :, n : n + nw] + dM[:, :, n + nu : n + nu + nw]
            # dG = C (zI - A)^-1 (dA (zI - A)^-1 B + dB) + dC (zI - A)^-1 B + dD
            change = left @ (dA @ right + dB) + self.patterns[:, n:, :n] @ right + self.patterns[:, n:, n:]
            rows.append(change.reshape(p, -1).T / size)
        found = np.concatenate(rows)
        return np.concatenate([found.real, found.imag])

    # -- sizes ---------------------------------------------------------------------------------------

    def prior(self, states: Array, inputs: Array, outputs: Array) -> Array:
        """Standard deviation of each coefficient for signals of these sizes."""
        base = self.base
        # size of each row of [A B; C D] [x; w]; of a discrete A without its identity part
        whole = np.abs(self._whole - np.eye(*self._whole.shape) * (not base.is_continuous))
        sources = np.concatenate([states, inputs])
        moved = np.abs(whole) * sources
        rate = np.concatenate([moved[: base.n_states].max(axis=1, initial=0.0), outputs])
        # a row with no entry may change the state by its size within one sample
        rest = states / self.settings.dt if base.is_continuous else states
        rate[: base.n_states] = np.where(rate[: base.n_states] > 0, rate[: base.n_states], rest)
        found = np.zeros(len(self.labels))
        # prior: half the nominal value, or the share of its row that the entry may contribute
        for a, pattern in enumerate(self.patterns):
            drive = np.abs(pattern) * sources  # what a unit of the coefficient moves, row by row
            active = drive > 0
            by_rate = float(np.min((rate[:, None] / np.where(active, drive, 1.0))[active], initial=np.inf))
            by_rate = by_rate if np.isfinite(by_rate) else 1.0
            found[a] = max(0.5 * self.nominal[a], self.share_of_rate * by_rate) or _LEAST * by_rate
        return found


def _with_sizes(setup: EntriesSetup, memory: CoefficientMemory) -> CoefficientMemory:
    """Return the memory with signal and state sizes and a matching prior."""
    sizes = signal_sizes(memory)
    inputs, outputs = np.split(sizes, [setup.base.n_inputs])
    # an unstable model is followed no longer than it takes to grow twentyfold: under a controller its
    # states do not leave that range either
    discrete = to_discrete(setup.base, setup.settings.dt, setup.settings.hold)
    poles = np.abs(np.linalg.eigvals(discrete.A)) if discrete.n_states else np.zeros(0)
    growth = np.log(max(float(poles.max(initial=0.0)), 1.0))
    span = max(int(min(3.0 / max(growth, 1e-9), len(memory.inputs))), 1)
    # states by simulation, and by the pseudo-inverse of C from the outputs
    shown = np.abs(np.linalg.pinv(discrete.C)) @ outputs
    states = np.hypot(np.sqrt(state_power(discrete.A, discrete.B, memory.inputs[:span])), shown)
    states = np.where(states > 0, states, 1.0)
    spread = setup.prior(states, inputs, outputs)
    return replace(memory, sizes=sizes, states=states, spread=spread)


FORMS = ("nonzero", "discrete", "input")
_ENTRY = re.compile(r"\s*([ABCD])\s*\[\s*(\d+)\s*,\s*(\d+)\s*\]\s*")
_RATE = 0.1  # of what moves a row that an entry which is zero may do, one standard deviation
_WIDE = 0.5  # the same for a correction, of which nothing is known


@dataclass(frozen=True, slots=True)
class _Entry:
    """An entry of A, B, C or D."""

    matrix: str
    row: int
    column: int

    def __str__(self) -> str:
        return f"{self.matrix}[{self.row},{self.column}]"

    def place(self, model: LinearModel) -> tuple[int, int]:
        """Row and column in [A B; C D]."""
        n = model.n_states
        return self.row + n * (self.matrix in "CD"), self.column + n * (self.matrix in "BD")


def nonzero_entries(model: LinearModel, settings: FilterSettings) -> EntriesSetup:
    """Entries that are not zero, where physics may have put them.

    Rows x1' = x2 are kinematics, and an output that shows one state is a sensor: both are
    no parameters. An output that mixes several signals (an acceleration) holds some.
    """
    found = []
    for row in range(model.n_states):
        columns = np.flatnonzero(model.A[row])
        # x1' = x2: kinematics
        kinematic = columns.size == 1 and columns[0] != row and model.A[row, columns[0]] == 1.0
        if kinematic and not model.B[row].any():
            continue
        found += [_Entry("A", row, int(j)) for j in columns]
        found += [_Entry("B", row, int(j)) for j in np.flatnonzero(model.B[row])]
    found += _mixed_outputs(model)
    return replace(_of_entries(model, model, found, settings, 0.0), one_to_one=True)


def all_entries(model: LinearModel, discrete: LinearModel, settings: FilterSettings) -> EntriesSetup:
    """Return the setup with all entries of the discrete A and B.

    Entries of outputs that mix several signals are included.
    """
    n = model.n_states
    found = [_Entry("A", i, j) for i in range(n) for j in range(n)]
    found += [_Entry("B", i, j) for i in range(n) for j in range(model.n_inputs)]
    return _of_entries(model, discrete, found + _mixed_outputs(discrete), settings, _RATE)


def named_entries(model: LinearModel, names: Sequence[str], settings: FilterSettings) -> EntriesSetup:
    """Entries by their names, such as "A[1,0]", in the timebase of the model.

    Raises
    ------
    control.ControlArgument
        If a name is none of an entry.
    ModelError
        If the model has no such entry, or it is named twice.
    """
    found: list[_Entry] = []
    for name in names:
        match = _ENTRY.fullmatch(name)
        if match is None:
            raise ct.ControlArgument(
                f"static: {name!r} is no entry; write it as 'A[1,0]' (rows and columns from 0)"
            )
        entry = _Entry(match[1], int(match[2]), int(match[3]))
        shape = getattr(model, entry.matrix).shape
        if entry.row >= shape[0] or entry.column >= shape[1]:
            raise ModelError(f"static: the model has no entry {entry}; {entry.matrix} has shape {shape}")
        if entry in found:
            raise ModelError(f"static: {entry} is named twice; give each entry once")
        found.append(entry)
    return _of_entries(model, model, found, settings, _RATE)


def correction(
    model: LinearModel, inputs: Array, feedthrough: Array, settings: FilterSettings
) -> EntriesSetup:
    """Return the setup of the paper's correction u = theta [x; w].

    The correction acts through B_u and D_u, in the timebase of the model.
    """
    n, nw = model.n_states, model.n_inputs
    acts = np.vstack([inputs, feedthrough])
    patterns, names = [], []
    signals = (*model.state_labels, *model.input_labels)
    # one coefficient for each pair of correction input and signal
    for c in range(acts.shape[1]):
        for j in range(n + nw):
            pattern = np.zeros((n + model.n_outputs, n + nw))
            pattern[:, j] = acts[:, c]
            patterns.append(pattern)
            names.append(f"u{c} from {signals[j]}" if acts.shape[1] > 1 else f"u from {signals[j]}")
    none = np.zeros(len(names))
    return EntriesSetup(model, model, np.array(patterns), tuple(names), none, none.copy(), _WIDE, settings)


def _mixed_outputs(model: LinearModel) -> list[_Entry]:
    found = []
    for row in range(model.n_outputs):
        # a single state is a sensor; sums of several signals carry parameters
        states, inputs = np.flatnonzero(model.C[row]), np.flatnonzero(model.D[row])
        if states.size + inputs.size > 1 or (not states.size and inputs.size):
            found += [_Entry("C", row, int(j)) for j in states] + [_Entry("D", row, int(j)) for j in inputs]
    return found


def _of_entries(
    initial: LinearModel, base: LinearModel, entries: Sequence[_Entry], settings: FilterSettings, rate: float
) -> EntriesSetup:
    whole = np.block([[base.A, base.B], [base.C, base.D]])
    rest = whole - np.eye(*whole.shape) * (not base.is_continuous)
    places = [entry.place(base) for entry in entries]
    patterns = np.zeros((len(places), *whole.shape))
    for a, (i, j) in enumerate(places):
        patterns[a, i, j] = 1.0
    given = np.block([[initial.A, initial.B], [initial.C, initial.D]])
    value = np.array([given[place] for place in places], dtype=float)
    nominal = np.array([abs(rest[place]) for place in places], dtype=float)
    return EntriesSetup(initial, base, patterns, tuple(map(str, entries)), nominal, value, rate, settings)


def no_entries(model: LinearModel, settings: FilterSettings) -> EntriesSetup:
    """The initial model itself, whose state alone is estimated."""
    return _of_entries(model, model, [], settings, 0.0)
