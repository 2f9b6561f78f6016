"""Both stages of the paper, by its equations (23) to (46).

Both minimize ``|f + Phi theta|^2 + alpha |theta - theta(k)|^2`` over a window that slides by one sample. The
rows of Phi and f do not depend on theta, so one row enters, one leaves, and the inverse of the normal matrix
follows by the formula of Sherman and Morrison. The gradient is taken from the rows themselves: what rounding
does to the inverse does not move the minimizer. Signals are scaled to unit size.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np

from ..arguments import as_flag, as_number
from ..exceptions import DataError, DivergenceError, ModelError, RCOError
from ..jit import compiled
from ..systems.conversion import nearest_continuous
from ..systems.discretization import discretize
from ..systems.linear import Array, LinearModel
from .history import History, Summary, joined, pole_samples, poles_of
from .persistence import check_course, check_like, storable
from .samples import Block, Integers, Sampled, as_matrix, as_size, whole_block
from .scales import (
    Plant,
    Scales,
    declared_scales,
    explain,
    first_responses,
    is_settled,
    markov_parameters,
    measured_scales,
    scaled_plant,
)

_DIVERGED = 1e6  # simulated output over the largest measured one: beyond it the correction has diverged
_REFRESH = 10  # windows between two inversions of the normal matrix
# the inverse is made anew where a row leaves less than this share of what is known along it, or brings this
# many times as much as was known
_DOWNDATE, _OUTLIER = 0.02, 1e6
_DIRECT = 1e11  # window energy over alpha beyond which the normal matrix has no digits left
_LEAST, _MOST, _LONGEST = 50, 100, 16  # samples that tell the scales: a window; that many times, at most


class Stage(NamedTuple):
    """All that a stage remembers.

    l_psi = (n_c + 1)(n + n_w) + n_c l_u, and m = l_u l_psi.

    Attributes
    ----------
    H : ndarray of shape (mu, n_y, l_u)
        Markov parameters from H_d on.
    theta : ndarray of shape (l_u, l_psi)
    psi, u : ndarray of shape (d + mu, l_psi), (d + mu, l_u)
        Regressors and corrections, the latest first.
    rows, f : ndarray of shape (p, n_y, m), (p, n_y)
        The window, a ring.
    gain : ndarray of shape (m, m)
        (Phi' Phi + alpha I)^-1.
    x : ndarray of shape (n,)
    learned : ndarray of shape (1,)
        Samples learned.
    """

    H: Array
    theta: Array
    psi: Array
    u: Array
    rows: Array
    f: Array
    gain: Array
    x: Array
    learned: Integers


class Record(NamedTuple):
    """Course of both stages, time first; of length 0 where none is kept."""

    z1: Array
    z2: Array
    theta1: Array
    theta2: Array
    x: Array


@compiled
def _correct(s, order, x, w):  # type: ignore[no-untyped-def]
    """Enter x(k), w(k) into the regressor; return u(k) = theta psi(k)."""
    n, n_w, l_u = x.size, w.size, s.u.shape[1]
    at_w, at_u = (order + 1) * n, (order + 1) * (n + n_w)
    before, last = s.psi[0].copy(), s.u[0].copy()
    s.u[1:] = s.u[:-1].copy()
    s.psi[1:] = s.psi[:-1].copy()
    psi = s.psi[0]
    # psi = [x(k) .. x(k - n_c), w(k) .. w(k - n_c), u(k - 1) .. u(k - n_c)]
    psi[:n], psi[n:at_w] = x, before[: at_w - n]
    psi[at_w : at_w + n_w], psi[at_w + n_w : at_u] = w, before[at_w : at_u - n_w]
    if order > 0:
        psi[at_u : at_u + l_u], psi[at_u + l_u :] = last, before[at_u : psi.size - l_u]
    s.u[0] = s.theta @ psi
    return s.u[0].copy()


@compiled
def _reach(H, u, d):  # type: ignore[no-untyped-def]
    """Return what past corrections do to y(k): the sum of H_i u(k - i)."""
    total = np.zeros(H.shape[1])
    for i in range(H.shape[0]):
        for r in range(H.shape[1]):
            for c in range(H.shape[2]):
                total[r] += H[i, r, c] * u[d + i, c]
    return total


@compiled
def _rows(s, d):  # type: ignore[no-untyped-def]
    """Phi(k), the sum of H_i (x) psi(k - i), and the rows that it replaces."""
    n_y, q = s.H.shape[1], s.psi.shape[1]
    moved = np.zeros((2 * n_y, s.rows.shape[2]))
    for i in range(s.H.shape[0]):
        for r in range(n_y):
            for c in range(s.H.shape[2]):
                for j in range(q):
                    moved[r, c * q + j] += s.H[i, r, c] * s.psi[d + i, j]
    slot = s.learned[0] % s.rows.shape[0]
    moved[n_y:] = s.rows[slot]
    s.rows[slot] = moved[:n_y]
    return moved


@compiled
def _learn(s, f, alpha, d):  # type: ignore[no-untyped-def]
    """Slide the window by one sample; minimize the cost, (36) to (42)."""
    p, n_y, m = s.rows.shape
    s.f[s.learned[0] % p] = f
    moved = _rows(s, d)
    s.learned[0] += 1
    rows, theta = s.rows.reshape(p * n_y, m), s.theta.reshape(m)
    left, G, rest = s.f.reshape(p * n_y) + rows @ theta, s.gain, 1.0
    # one row after the other (Sherman and Morrison): G -= G r r' G / (r' G r +- 1)
    for r in range(2 * n_y):
        g = G @ moved[r]
        size = moved[r] @ g + (1.0 if r < n_y else -1.0)
        rest = min(rest, _DOWNDATE * _OUTLIER / size if r < n_y else -size)
        for i in range(m):
            by = g[i] / size
            for j in range(m):
                G[i, j] -= by * g[j]
    # made anew where a row took its information along, and now and then
    if not rest > _DOWNDATE or G[0, 0] == 0.0 or s.learned[0] % (_REFRESH * p) == 0:
        normal = rows.T @ rows
        for i in range(m):
            normal[i, i] += alpha
        G[:, :] = 0.0
        if np.trace(normal) < _DIRECT * alpha:
            G[:, :] = np.linalg.inv(normal)
    if G[0, 0] > 0.0:
        theta -= G @ (left @ rows)
    else:  # no digits in the squares: least squares by orthogonal factors
        whole, right = np.zeros((p * n_y + m, m)), np.zeros(p * n_y + m)
        whole[: p * n_y], right[: p * n_y] = rows, -left
        for i in range(m):
            whole[p * n_y + i, i] = np.sqrt(alpha)
        theta += np.linalg.lstsq(whole, right)[0]


@compiled
def _far(y, u, x, limit):  # type: ignore[no-untyped-def]
    """Return whether outputs, correction or states exceed the limit."""
    return not (max(np.abs(y).max(), np.abs(u).max()) <= limit and np.abs(x).sum() <= _DIVERGED * limit)


@compiled
def _advance(plant, one, two, design, samples, course, into):  # type: ignore[no-untyped-def]
    """Run both stages over a block; they change in place.

    Return the samples done, and the stage that diverged there, or 0.
    """
    (order, d, estimated, alpha1, alpha2), (peak, levels, recent) = design, course
    w, y, use = samples
    rate = y.shape[1] / one.rows.shape[0]
    for k in range(w.shape[0]):
        # stage 1: simulate with the dynamic correction, (23) and (24)
        x = one.x.copy()
        u = _correct(one, order, x, w[k])
        simulated = plant.C @ x + plant.D @ w[k] + plant.Du @ u
        # what was not measured is as simulated: nothing is learned from it
        measured = np.where(use[k] > 0, y[k], simulated)
        peak[0] = max(peak[0], np.abs(y[k]).max())
        if _far(simulated, u, x, _DIVERGED * peak[0]):
            return k, 1
        z1 = simulated - measured
        # the effect of past corrections off: theta takes their place in the cost, (34)
        f1, f2 = z1 - _reach(one.H, one.u, d), z1 - _reach(two.H, one.u, d)
        if estimated:
            _learn(one, f1, alpha1, d)
            if not np.isfinite(one.theta.sum()):
                return k, 1
        one.x[:] = plant.A @ x + plant.B @ w[k] + plant.Bu @ u
        z2 = z1
        if two.rows.shape[0] > 0:
            # stage 2: a static correction, on the states that stage 1 estimates or on its own
            x2 = x if estimated else two.x.copy()
            u = _correct(two, 0, x2, w[k])
            reached = _reach(two.H, two.u, d)
            if estimated:
                z2 = f2 + reached
            else:
                z2 = plant.C @ x2 + plant.D @ w[k] + plant.Du @ u - measured
                two.x[:] = plant.A @ x2 + plant.B @ w[k] + plant.Bu @ u
            if _far(z2 + measured, u, x2, _DIVERGED * peak[0]):
                return k, 2
            _learn(two, z2 - reached, alpha2, d)
            if not np.isfinite(two.theta.sum()):
                return k, 2
            recent[(two.learned[0] - 1) % recent.shape[0]] = two.theta.reshape(-1)
        # mean squares for the printed performance, of one window
        for i in range(y.shape[1]):
            levels[0, i] += rate * (measured[i] ** 2 - levels[0, i])
            levels[1, i] += rate * (z1[i] ** 2 - levels[1, i])
            levels[2, i] += rate * (z2[i] ** 2 - levels[2, i])
        if into.z1.shape[0] > 0:
            into.z1[k], into.z2[k], into.x[k] = z1, z2, x
            into.theta1[k], into.theta2[k] = one.theta.reshape(-1), two.theta.reshape(-1)
    return w.shape[0], 0


class Settings(NamedTuple):
    """Settings of the stages.

    n_c of stage 1; p, mu and alpha of both; samples that theta is averaged over; whether stage 2 sees the
    states of stage 1.
    """

    order: int
    window: tuple[int, int]
    markov: tuple[int, int]
    learning_rate: tuple[float, float]
    average: int
    estimated: bool


@dataclass(frozen=True, slots=True, eq=False)
class Memory:
    """State of both stages between two calls.

    Parameters
    ----------
    stages : tuple of two Stage
        Both stages.
    peak, levels : ndarray of shape (1,), (3, n_y)
        Largest scaled output; mean squares of y, z1 and z2.
    recent_theta : ndarray of shape (average, m)
        Latest coefficients of stage 2, as a ring.
    inputs, outputs : ndarray of shape (K, n_w), (K, n_y)
        First samples, held back until they tell the scales; then empty.
    n_samples : int
        Samples taken, those held back included.
    scales : Scales or None
        None while samples are held back.
    """

    stages: tuple[Stage, Stage]
    peak: Array
    levels: Array
    recent_theta: Array
    inputs: Array
    outputs: Array
    n_samples: int
    scales: Scales | None


storable(Stage, Record, Memory, Scales)


class Diverged(DivergenceError):
    """Divergence.

    `sound` holds the memory before these samples, the block before the divergence, and the course so far.
    """

    def __init__(self, message: str, sound: Any = None) -> None:  # None: unpickled
        super().__init__(message)
        self.sound = sound


def _unavailable(what: str) -> Any:
    """Property that the paper's coefficients do not have."""

    def refuse(self: Any) -> None:
        raise RCOError(
            f"{what} belong to the Kalman filter: build RCORefiner(model, dt=..., effects=[...]) without "
            "the paper's settings (static_theta has the paper's coefficients)"
        )

    return property(refuse)


class PaperStages:
    """Retrospective cost optimization in two stages, equations (23) to (46).

    Parameters
    ----------
    sampled : Sampled
        Initial model, as given and in discrete time.
    given : mapping
        Arguments of `RCORefiner.paper` by name; None or missing: the default.
    keep : bool
        Whether to keep the course of every sample.
    beside : bool, optional
        Whether only stage 1 runs, beside another estimator, with a short window.
    """

    form = "paper"

    def __init__(
        self, sampled: Sampled, given: Mapping[str, Any], keep: bool, *, beside: bool = False
    ) -> None:
        self.sampled, self.keep = sampled, keep
        self.settings = _settings(given, beside)
        # B_u and D_u in the timebase of the model; the correction is held as the input is
        model, discrete = sampled.initial, sampled.discrete
        b_u, d_u = correction_path(model, given)
        if model.is_continuous and sampled.step is not None:
            b_u = discretize(model.A, b_u, sampled.step)[1]
        arrays = (discrete.A, discrete.B, b_u, discrete.C, discrete.D, d_u)
        self.plant = Plant(*map(np.ascontiguousarray, arrays))
        self.delay, _ = first_responses(self.plant)
        self._warm_up = min(max(self.settings.window[0], _LEAST), _MOST)
        self._declared = declared_scales(self.plant, given.get("scale", "auto"), self._warm_up)
        self.reset()

    def reset(self) -> None:
        """Forget all samples."""
        try:
            self.memory = self._begin(self._declared)
        except MemoryError as error:
            raise ModelError(
                f"order, window, markov and static_average need more memory than there is: {error}; "
                "choose smaller ones"
            ) from error
        self.records: list[tuple[Record, Array]] = []

    def _begin(self, scales: Scales | None) -> Memory:
        """Memory before the first sample: theta = 0, an empty window."""
        s, (n_y, n_w, n) = self.settings, self._sizes
        reach, l_u = self.delay + max(s.markov), self.plant.Du.shape[1]
        values = np.zeros((reach, n_y, l_u))
        if scales is not None:
            values = markov_parameters(scaled_plant(self.plant, scales), reach)

        def empty(which: int, order: int) -> Stage:
            q = (order + 1) * (n + n_w) + order * l_u
            m, p, mu = l_u * q, s.window[which], s.markov[which]
            H = np.ascontiguousarray(values[self.delay : self.delay + mu])
            gain, none = np.eye(m) / s.learning_rate[which], np.zeros(1, dtype=np.int64)
            window = np.zeros((p, n_y, m)), np.zeros((p, n_y))
            past = np.zeros((reach, q)), np.zeros((reach, l_u))
            return Stage(H, np.zeros((l_u, q)), *past, *window, gain, np.zeros(n), none)

        stages = empty(0, s.order), empty(1, 0)
        recent = np.zeros((s.average, stages[1].theta.size))
        held = np.zeros((0, n_w)), np.zeros((0, n_y))
        return Memory(stages, np.ones(1), np.zeros((3, n_y)), recent, *held, 0, scales)

    @property
    def _sizes(self) -> tuple[int, int, int]:
        return len(self.plant.C), self.plant.B.shape[1], len(self.plant.A)

    # -- samples in ----------------------------------------------------------------------------------

    @property
    def n_samples(self) -> int:
        """Samples taken."""
        return self.memory.n_samples

    @property
    def n_learned(self) -> int:
        """Samples learned from."""
        return self.memory.n_samples - len(self.memory.inputs)

    def take(self, block: Block, *, keep_sound: bool = False) -> None:
        """Learn from a block completely or not at all.

        With `keep_sound`, keep what came before a divergence.
        """
        try:
            self._commit(*self._after(block, last=False))
        except Diverged as error:
            if keep_sound:
                self._commit(*self._run(*error.sound))
            raise

    def finish(self) -> None:
        """Learn from what is still held back for the scales, however short."""
        if self.memory.scales is None:
            none = whole_block(self.memory.inputs[:0], self.memory.outputs[:0])
            self._commit(*self._after(none, last=True))

    def _commit(self, memory: Memory, records: list[tuple[Record, Array]]) -> None:
        self.memory = memory
        self.records += records

    def _after(self, block: Block, last: bool) -> tuple[Memory, list[tuple[Record, Array]]]:
        """Return the memory after some samples, and their course.

        The present memory stays as it is.
        """
        memory = self.memory
        if memory.scales is not None:
            return self._run(memory, block)
        # held back until their rms gives the scales: an output that is missing keeps its last value
        held, outputs = len(memory.inputs), np.concatenate([memory.outputs, block.outputs])
        for k, row in enumerate(block.use, held):
            if k == 0 and not row.all():
                raise DataError(
                    "an output is missing at the first sample, before anything can stand in for it; "
                    "start at a sample that is whole"
                )
            outputs[k, row == 0] = outputs[k - 1, row == 0]
        inputs, total = np.concatenate([memory.inputs, block.inputs]), memory.n_samples + len(block.inputs)
        scales, count = self._found_scales(inputs, outputs, held, last)
        if scales is None:
            return replace(memory, inputs=inputs, outputs=outputs, n_samples=total), []
        first = self._run(self._begin(scales), whole_block(inputs[:count], outputs[:count]))
        return self._run(first[0], block.part(count - held, len(block.inputs)), first[1])

    def _found_scales(
        self, inputs: Array, outputs: Array, before: int, last: bool
    ) -> tuple[Scales | None, int]:
        """Return the scales as soon as samples determine them, and how many.

        They do not depend on how the stream is cut into blocks.
        """
        labels = self.sampled.initial.input_labels, self.sampled.initial.output_labels
        # the length doubles until the signals no longer grow
        count, longest = self._warm_up, self._warm_up * _LONGEST
        while count <= min(longest, len(inputs)):
            w, y = inputs[:count].T, outputs[:count].T
            if count > before and (count == longest or (is_settled(w) and is_settled(y))):
                return measured_scales(self.plant, w, y, labels), count
            count *= 2
        whole = len(inputs)
        return (measured_scales(self.plant, inputs.T, outputs.T, labels) if last else None), whole

    def _run(
        self, before: Memory, block: Block, records: Sequence[tuple[Record, Array]] = ()
    ) -> tuple[Memory, list[tuple[Record, Array]]]:
        """Run the stages over a block, behind those whose course is given.

        A copy changes, so that an error leaves the memory as it was.
        """
        s, scales, count = self.settings, before.scales, len(block.inputs)
        assert scales is not None
        stages = [Stage._make(map(np.ndarray.copy, stage)) for stage in before.stages]
        peak, levels, recent = before.peak.copy(), before.levels.copy(), before.recent_theta.copy()
        n_y, _, n = self._sizes
        widths = (n_y, n_y, *(stage.theta.size for stage in stages), n)
        record = Record(*(np.empty((count if self.keep else 0, width)) for width in widths))
        signals = block.inputs / scales.inputs, block.outputs / scales.outputs
        plant = scaled_plant(self.plant, scales)
        with np.errstate(all="ignore"):  # a divergence is reported below, in words
            done, diverged = _advance(
                plant, stages[0], stages[1], (s.order, self.delay, s.estimated, *s.learning_rate),
                (*signals, block.use), (peak, levels, recent), record,
            )  # fmt: skip
        if diverged:
            sample, step = before.n_samples + done, self.sampled.step
            where = f"sample {sample}" + ("" if step is None else f" (t = {sample * step:.6g} s)")
            mu, alpha = s.markov[diverged - 1], s.learning_rate[diverged - 1]
            message = explain(plant, self.delay, mu, alpha, diverged, where, float(peak[0]))
            raise Diverged(message, (before, block.part(0, done), records))
        empty = np.zeros((0, self._sizes[1])), np.zeros((0, n_y))
        total = before.n_samples + count
        after = Memory((stages[0], stages[1]), peak, levels, recent, *empty, total, scales)
        if not self.keep:
            return after, []
        # back to the units of the signals
        shown = Record(
            record.z1 * scales.outputs, record.z2 * scales.outputs, self._in_units(record.theta1, 0, scales),
            self._in_units(record.theta2, 1, scales), record.x * scales.states,
        )  # fmt: skip
        return after, [*records, (shown, np.where(block.use > 0, block.outputs, np.nan))]

    # -- results -------------------------------------------------------------------------------------

    @property
    def scales(self) -> Scales | None:
        """Sizes that signals are divided by, None while they are not known yet."""
        return self.memory.scales

    def _in_units(self, theta: Array, stage: int, scales: Scales | None) -> Array:
        """Return coefficients (..., m) in the units of the signals.

        The shape is (..., l_u, l_psi).
        """
        theta = theta.reshape(
            *theta.shape[: -1 if theta.ndim > 1 else 0], *self.memory.stages[stage].theta.shape
        )
        if scales is None:
            return theta
        order, u = self.settings.order * (stage == 0), scales.corrections
        units = [np.tile(scales.states, order + 1), np.tile(scales.inputs, order + 1), np.tile(u, order)]
        return theta * u[:, None] / np.concatenate(units)

    @property
    def static(self) -> PaperStages:
        """The static stage."""
        return self

    filter = static

    scores, parameters, covariance = map(_unavailable, ("scores", "parameters", "covariance"))

    def dynamic_theta(self) -> Array:
        """Coefficients of stage 1 at this sample."""
        return self._in_units(self.memory.stages[0].theta.ravel(), 0, self.memory.scales)

    def _recent(self) -> Array:
        """Coefficients of stage 2 after the latest samples."""
        return self.memory.recent_theta[: int(self.memory.stages[1].learned[0])]

    def static_theta(self) -> Array:
        """Static coefficients, averaged over the latest samples."""
        recent = self._recent() if len(self._recent()) else self.memory.recent_theta[:1]
        return self._in_units(recent.mean(axis=0), 1, self.memory.scales)

    def standard_deviations(self) -> Array:
        """Return the scatter of the static coefficients.

        It is that over the samples that they are averaged over.
        """
        recent = self._recent()
        if len(recent) < 2:
            return np.full(self.memory.stages[1].theta.shape, np.inf)
        return np.abs(self._in_units(recent.std(axis=0, ddof=1), 1, self.memory.scales))

    def deviation(self) -> None:
        """The paper's coefficients have no covariance."""
        return None

    def discrete_system(self, name: str) -> LinearModel:
        """Refined model in discrete time."""
        return self._refined(self.static_theta(), name)

    def _refined(self, theta: Array, name: str) -> LinearModel:
        """Close the loop u = theta_x x + theta_w w around the model, (44)."""
        P, n = self.plant, self._sizes[2]
        on_x, on_w = theta[:, :n], theta[:, n:]
        return self.sampled.discrete.with_arrays(
            A=P.A + P.Bu @ on_x, B=P.B + P.Bu @ on_w, C=P.C + P.Du @ on_x, D=P.D + P.Du @ on_w, name=name
        )

    def system(self, name: str) -> LinearModel:
        """Refined model, continuous where the initial one is."""
        initial = self.sampled.initial
        if not initial.is_continuous:
            return self.discrete_system(name)
        # theta = 0: the initial model, without a conversion
        if not self.static_theta().any():
            return initial.with_arrays(name=name)
        return nearest_continuous(self.discrete_system(name))

    def predict(self, inputs: Array) -> Array:
        """Free run on further inputs of shape (N, n_w); outputs of shape (n_y, N)."""
        model, memory = self.discrete_system(""), self.memory
        outputs = np.empty((model.n_outputs, len(inputs)))
        # state after the last sample; before the scales are known that of the initial model
        x = memory.stages[0 if self.settings.estimated else 1].x
        x = x.copy() if memory.scales is None else x * memory.scales.states
        with np.errstate(over="ignore", invalid="ignore"):
            for w in memory.inputs:
                x = self.plant.A @ x + self.plant.B @ w
            for k, w in enumerate(inputs):
                outputs[:, k] = model.C @ x + model.D @ w
                x = model.A @ x + model.B @ w
        return outputs

    @property
    def _rows(self) -> Record:
        """A record of no sample, in the shapes of this model."""
        n_y, _, n = self._sizes
        theta = (stage.theta.shape for stage in self.memory.stages)
        return Record(*(np.zeros((0, *shape)) for shape in ((n_y,), (n_y,), *theta, (n,))))

    def history(self) -> History:
        """Course of both stages."""
        model, step = self.sampled.initial, self.sampled.step
        # join the blocks, samples last
        parts = {
            name: joined([getattr(record, name) for record, _ in self.records], empty.shape[1:])
            for name, empty in self._rows._asdict().items()
        }
        timepts = np.arange(parts["z1"].shape[1], dtype=np.float64) * (1.0 if step is None else step)
        at = pole_samples(timepts.size)
        systems = [self._refined(parts["theta2"][:, :, k], "") for k in at]
        return History(
            timepts=timepts,
            **parts,
            y=joined([y for _, y in self.records], (model.n_outputs,)),
            input_labels=model.input_labels,
            output_labels=model.output_labels,
            state_labels=model.state_labels,
            pole_timepts=timepts[at],
            poles=poles_of(systems, step),
        )

    def summary(self) -> Summary:
        """Cells and sentences of `str`."""
        s, model, step = self.settings, self.sampled.initial, self.sampled.step
        # settings of both stages, then their performance
        sizes = [stage.theta.size for stage in self.memory.stages]
        settings = {
            "order n_c": (s.order, 0),
            "window p [samples]": s.window,
            f"Markov parameters mu, from H_{self.delay}": s.markov,
            "learning rate alpha [scaled units]": s.learning_rate,
            "coefficients": sizes,
        }
        rows = [[name, *(f"{value:g}" for value in pair)] for name, pair in settings.items()]
        if self.n_learned:
            with np.errstate(divide="ignore", invalid="ignore"):
                share = np.sqrt(self.memory.levels[1:] / self.memory.levels[0])
            for label, column in zip(model.output_labels[:3], share.T, strict=False):
                rows.append([f"performance at {label} / its rms", *(f"{value:.3g}" for value in column)])
        channels = f"{model.n_states} states, {model.n_inputs} in, {model.n_outputs} out"
        timing = "" if step is None else f", dt = {step:g} s"
        title = f"RCORefiner of {model.name!r}: {channels}, {self.plant.Bu.shape[1]} correction(s){timing}"
        return Summary(title, ["setting", "stage 1", "stage 2"], rows, self._notes())

    def _notes(self) -> list[str]:
        memory, model = self.memory, self.sampled.initial
        if memory.scales is None:
            return [
                f"{memory.n_samples} samples taken, {len(memory.inputs)} held back until the size of the "
                "signals is known. The refined model is still the initial one."
            ]
        about = (
            "Stage 1 follows the output with a dynamic correction and so estimates the states. "
            "Stage 2 predicts the output from these states with the refined model."
            if self.settings.estimated
            else "Stage 1 does not run: its column shows the initial model. Stage 2 uses its own states."
        )
        scales = memory.scales
        labels, sizes = (*model.input_labels, *model.output_labels), (*scales.inputs, *scales.outputs)
        shown = [f"{label} {size:.3g}" for label, size in zip(labels, sizes, strict=True)]
        notes = [
            f"{self.n_learned} samples learned.",
            "Performance: rms of simulated minus measured output over about the last "
            f"{self.settings.window[0]} samples (0 is perfect). {about}",
            "Scaled units: signals are divided by their size "
            f"({', '.join(shown[:6] + ['...'] * (len(shown) > 6))}), so alpha has no unit.",
        ]
        if memory.peak[0] > 30.0:
            notes.append(
                f"Caution: an output has reached {memory.peak[0]:.3g} times its scale, so alpha has less "
                "weight than intended. Declare scale={...} if this is not an outlier."
            )
        return notes

    # -- files ---------------------------------------------------------------------------------------

    def state(self) -> dict[str, Any]:
        """All that is remembered, for a file."""
        return {"memory": self.memory, "records": self.records}

    def restore(self, state: dict[str, Any]) -> None:
        """Go on from what `state` gave, once it was held against a fresh memory."""
        found = state["memory"]
        n_y, n_w, n = self._sizes
        # what a file may hold: the shapes of a fresh memory, and samples only while the scales are unknown
        known = (
            None
            if getattr(found, "scales", None) is None
            else Scales(*map(np.ones, (n_w, n_y, n, self.plant.Bu.shape[1])))
        )
        fresh, held = self._begin(known), {} if known else {"inputs": "samples", "outputs": "samples"}
        check_like(found, fresh, "memory", held)
        check_course(state["records"], self._rows, n_y)
        self.memory, self.records = found, state["records"]


_DEFAULTS: dict[str, Any] = {"order": 5, "window": 800, "markov": 20, "learning_rate": 1e5}
_AVERAGE = 800  # samples that static coefficients are averaged over where no window is given


def _settings(given: Mapping[str, Any], beside: bool) -> Settings:
    """Return the checked settings.

    Those of stage 2 are by default those of stage 1.
    """
    usual = _DEFAULTS | {"window": 100} if beside else _DEFAULTS

    def of(name: str, prefix: str) -> Any:
        own = given.get(prefix + name) if prefix else None
        return given.get(name, usual[name]) if own is None else own

    def counts(name: str, letter: str) -> tuple[int, int]:
        first, second = (as_size(of(name, p), p + name, 1, letter) for p in ("", "static_"))
        return first, second

    rates = [
        as_number(of("learning_rate", p), f"{p}learning_rate (alpha)", above=0.0, error=ModelError)
        for p in ("", "static_")
    ]
    window, average = counts("window", "p"), given.get("static_average")
    if average is None:
        windows = given.get("window") or given.get("static_window")
        average = 2 * window[1] if windows else _AVERAGE
    average = as_size(average, "static_average", 1, "samples to average over")
    estimated = as_flag(given.get("use_estimated_states", True), "use_estimated_states")
    order = as_size(of("order", ""), "order", 0, "n_c")
    # beside another estimator the static stage has no window, and does not run
    if beside:
        window, average = (window[0], 0), 1
    return Settings(order, window, counts("markov", "mu"), (rates[0], rates[1]), average, estimated)


def correction_path(model: LinearModel, given: Mapping[str, Any]) -> tuple[Array, Array]:
    """Return B_u and D_u in the timebase of the model.

    By default they are those of its inputs.
    """
    b_u, d_u = given.get("correction_input"), given.get("correction_feedthrough")
    acts = model.B if b_u is None else as_matrix(b_u, "correction_input (B_u)", model.n_states, None, "state")
    if d_u is not None:
        size = acts.shape[1]
        return acts, as_matrix(d_u, "correction_feedthrough (D_u)", model.n_outputs, size, "output")
    return acts, model.D if b_u is None else np.zeros((model.n_outputs, acts.shape[1]))
