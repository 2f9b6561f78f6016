"""Part of the monitor that runs with every sample.

It consists of observer, bank and windows.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from scipy.signal import lfilter

from ...effects.compiled import raise_pending
from ...engine.inputs import InputSignal
from ...engine.linear import Corrections
from ...engine.march import MarchResult, MarchState, march
from ...engine.setting import setting
from ...engine.simulation import structure_of
from ...engine.structure import Structure
from ...exceptions import DataError, DivergenceError, ModelError
from ...models.operating_point import check_stream_hold, refuse_discrete
from ...systems.linear import Array
from ..samples import Flags, Integers
from . import kernels
from .bank import Bank
from .baseline import Healthy
from .kernels import forces


def as_base(model: Any, hold: str) -> tuple[Structure, Array, int]:
    """Return structure, coefficients and substeps of the healthy model.

    Raises
    ------
    ModelError
        If the model is discrete, was found to have another hold, or holds what needs the future.
    """
    # the monitor needs a continuous model whose effects act at once
    refuse_discrete(model)
    structure, theta, substeps = structure_of(model)
    check_stream_hold(structure.model, hold)
    if structure.output_delays:
        raise ModelError(
            f"{structure.effects[structure.output_delays[0][0]].label}: a delay at an output cannot be "
            "estimated on a stream; refine with an input_delay or an output_lag"
        )
    return structure, np.asarray(theta, dtype=float), int(substeps)


def period_of(structure: Structure, theta: Array, dt: float) -> int:
    """Return the period of the first mode in samples.

    Where nothing swings, it is two time constants of the slowest state. The result is kept between 8 and
    100 000.
    """
    # poles of the linear part; damping ratio up to 0.98 counts as a mode
    poles = np.linalg.eigvals(structure.matrices(theta).A.astype(float))
    swinging = np.abs(poles[np.abs(poles.imag) > 0.2 * np.abs(poles)])
    if swinging.size:
        samples = 2 * math.pi / swinging.min() / dt
    else:
        # no oscillation: two time constants of the slowest pole that is no integrator
        rates = np.abs(poles)
        rates = rates[rates > 1e-6 * rates.max(initial=0.0)]
        samples = 2 / rates.min() / dt if rates.size else 50
    return int(np.clip(round(samples), 8, 100_000))


class Observer:
    """Steady observer of a structure, advanced block by block.

    Parameters
    ----------
    structure : Structure
        Model with its effects.
    theta : ndarray, shape (p,)
        Their coefficients.
    dt : float
        Sampling time [s].
    hold : {"zoh", "foh"}
        The input between samples.
    substeps : int
        Substeps per sample.
    gain : ndarray, shape (n, n_y)
        Gain of ``x = x + gain (y - y_model)``.
    """

    def __init__(
        self, structure: Structure, theta: Array, dt: float, hold: str, substeps: int, gain: Array
    ) -> None:
        s = self.structure = structure
        self.theta, self.dt, self.hold, self.substeps = theta, dt, hold, substeps
        self.gain = np.ascontiguousarray(gain)
        self._model = setting(s, theta, dt / substeps, False).model
        # delays at the inputs look back on past samples
        delays = [
            float(s.value(theta, i, s.effects[i].coefficients[0]))
            for i, _ in s.input_statics
            if s.effects[i].spec.delays
        ]
        turning = [s.effects[i].label for i, _ in s.input_statics if s.effects[i].spec.inner_states]
        if turning:
            raise ModelError(
                f"{turning[0]}: an input effect with an inner state cannot be part of the healthy "
                "model of a monitor; leave it out, or name it among the candidates"
            )
        self.lag = 1 + (math.ceil(sum(delays) / dt) + 2 if delays else 0)

    def begin(self, x0: Array) -> dict[str, Array]:
        """Memory before the first sample."""
        s = self.structure
        inner = np.zeros(s.n_ports + s.n_outputs * s.remembers)
        return {"x": np.array(x0, dtype=float), "z": inner, "w": np.zeros((0, s.n_inputs))}

    def advance(
        self,
        memory: Mapping[str, Array],
        W: Array,
        Y: Array,
        use: Flags,
        first: int,
    ) -> tuple[dict[str, Array], Array, Array]:
        """Advance over a block.

        Parameters
        ----------
        memory : mapping
            From `begin` or the last call; left as it is.
        W, Y : ndarray, shape (N, n_w), (N, n_y)
            Samples, finite.
        use : ndarray of uint8, shape (N, n_y)
            Which outputs correct the state.
        first : int
            Samples before, for messages.

        Returns
        -------
        memory : dict
            Memory after the block.
        outputs : ndarray, shape (N, n_y)
            Predicted outputs.
        states : ndarray, shape (N, n)
            States after the correction.
        """
        s = self.structure
        # past inputs in front, for delays and for the first step
        past = memory["w"]
        before = min(len(past), 1)  # the sample before, from which the first step starts
        whole = np.concatenate([past, W])
        N, ny, n, m = W.shape[0] + before, s.n_outputs, s.n_states, s.n_ports
        # inputs with their effects at the nodes of the substeps
        signal = InputSignal(np.ascontiguousarray(whole.T), self.dt, self.hold, self.substeps)
        drive = signal.drive(s, self.theta)
        skip = len(whole) - N
        measured, flags = np.zeros((N, ny)), np.zeros((N, ny), dtype=np.uint8)
        measured[before:], flags[before:] = Y, use
        x, z = memory["x"].copy(), memory["z"].copy()
        Yout, SY = np.full((N, ny), np.nan), np.zeros((N, ny, 0))
        X, F = np.full((N, n), np.nan), np.full((N if m else 0, m), np.nan)
        # divergence: 1e12 times the signals
        limit = 1e12 * (1.0 + float(np.abs(x).max(initial=0.0) + np.abs(Y).max() + np.abs(W).max()))
        first_row = skip * self.substeps * max(drive.course, 1)
        now = drive.held._replace(
            W=np.ascontiguousarray(drive.W[first_row:]), Wout=np.ascontiguousarray(drive.Wout[skip:])
        )
        # steady-state gain: correct with each measured output, then march to the next sample
        observer = Corrections(measured, flags, self.gain, np.zeros((0, 0)))
        into = MarchResult(Yout, SY, X, F, np.full(ny, np.inf), limit, self.substeps)
        blew_up = march(self._model, now, observer, MarchState(x, z, np.zeros((0, n))), into)
        raise_pending()
        if blew_up >= 0:
            raise DivergenceError(
                f"the observer of the healthy model left all bounds at sample {first + blew_up - before}; "
                "check the model, the units of the samples, or raise disturbance"
            )
        # state and past inputs at the end of the block
        after = {"x": x, "z": z, "w": whole[-self.lag :].copy()}
        return after, Yout[before:], X[before:]


_RINGS = ("ring_w", "ring_y", "ring_use", "ring_x", "ring_scale")  # the last samples
_FIND = 64  # blocks after a missing input from which the state is found anew
_CROWDED = 400  # most samples over which those that stand out are counted
_DOUBT = 0.1  # by how much a state that is not sure yet may widen the variance of a statistic


@dataclass(frozen=True, slots=True, eq=False)
class Windows:
    """Memory lengths over which scores are summed.

    Attributes
    ----------
    keep : ndarray, shape (M,)
        Share that each window keeps per sample.
    levels : ndarray, shape (M,)
        Threshold of the statistic in each.
    block : int
        Samples per block of the sums that tell since when.
    blocks : int
        Number of blocks kept.
    fading : float
        Weight of a sample in the slow mean that is taken off the innovations.
    """

    keep: Array
    levels: Array
    block: int
    blocks: int
    fading: float


@dataclass(eq=False)
class Stream:
    """Everything after the learning phase.

    Parameters
    ----------
    observer : Observer
        Observer of the healthy model.
    healthy : Healthy
        Its noise.
    bank : Bank
        Columns of the candidates.
    windows : Windows
        Windows and thresholds.
    learned : int
        Samples of the learning phase.
    """

    observer: Observer
    healthy: Healthy
    bank: Bank
    windows: Windows
    learned: int
    memory: dict[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        # settings of the loop; the threshold is compared with squares
        bank, h, w = self.bank, self.healthy, self.windows
        self._columns = bank.columns
        self._fixed = kernels.Fixed(
            bank.Phi, bank.drive, bank.C, bank.through, self.observer.gain, h.filters, h.noise, h.least,
            h.pace, h.mix, np.linalg.norm(np.linalg.inv(h.mix), axis=1), w.keep, w.levels**2, w.fading,
            bank.numbers, bank.root, w.block, max(4 * w.fading, 1 / _CROWDED),  # four periods
        )  # fmt: skip
        bad = [name for name, part in self._fixed._asdict().items() if not np.isfinite(part).all()]
        if bad:
            raise DataError(
                f"the learning phase gave {bad[0]} that are not finite; check model, units and channels with "
                "compare(), then learn from another stretch"
            )
        self._gaps()
        # a loaded stream brings its memory
        if self.memory:
            return
        k, M, p = self.bank.watched, self.windows.keep.size, self.bank.numbers.size
        columns = self.bank.size
        n, ny = self.observer.gain.shape
        nw = self.observer.structure.n_inputs
        q = self.healthy.filters.shape[1]
        # circular buffers: as long as all blocks together
        kept = self.windows.block * self.windows.blocks
        inner = np.full((3, columns), np.nan)
        inner[0] = 0.0
        self.memory = {
            **self.observer.begin(self.healthy.x0),
            "inner": inner,
            "Xc": np.zeros((n, columns)),
            "past_e": np.zeros((q, ny)),
            "past_s": np.zeros((q, ny, columns)),
            "known": np.zeros(ny),
            "N": np.zeros((M, k)),
            "V": np.zeros((M, k)),
            "power": self.healthy.power.copy(),
            "cross": np.zeros((k, p)),
            "shared": np.zeros((M, k, p)),
            "doubt": np.zeros((M, k)),
            "mean_e": self.healthy.mean.copy(),
            "mean_s": np.zeros((ny, columns)),
            "spread": np.ones((M, k + 1)) * np.r_[np.ones(k), 0.0],
            "factor": np.ones((M, k)),
            "crowd": np.zeros(ny),
            "size": np.ones(ny),
            "sums": np.zeros((2, self.windows.blocks, k)),
            "counters": np.zeros(2, dtype=np.int64),
            "pause": np.zeros(2, dtype=np.int64),  # samples to wait, outputs missing in a row
            "lost": np.full(1, -1, dtype=np.int64),
            "ring_w": np.zeros((kept, nw)),
            "ring_y": np.zeros((kept, ny)),
            "ring_scale": np.ones((kept, ny)),
            "ring_use": np.zeros((kept, ny), dtype=np.uint8),
            "ring_x": np.zeros((kept, n)),
        }

    @property
    def n_samples(self) -> int:
        """Samples taken, those of the learning phase included."""
        return int(self.memory["counters"][0])

    def way_back(self, coming: int) -> Callable[[], None]:
        """Return a function that restores the present state.

        It works after up to `coming` more samples.
        """
        mem = self.memory
        # rows of the buffers that the coming samples overwrite
        kept = len(mem["ring_w"])
        place = (self.n_samples + np.arange(min(coming, kept))) % kept
        rings = {key: mem[key][place] for key in _RINGS}
        others = {key: value.copy() for key, value in mem.items() if key not in _RINGS}

        def restore() -> None:
            mem.update(others)
            for key, rows in rings.items():
                mem[key][place] = rows

        return restore

    def advance(self, W: Array, Y: Array, use: Flags, known: Flags, *, stop: bool) -> tuple[int, Array]:
        """Take a block, or its samples until a threshold is exceeded.

        Parameters
        ----------
        W, Y : ndarray, shape (N, n_w), (N, n_y)
            Samples, gaps filled.
        use : ndarray of uint8, shape (N, n_y)
            Which outputs were measured.
        known : ndarray of uint8, shape (N,)
            Whether the inputs were.
        stop : bool
            Whether the structure counts as healthy: stop at an alarm, follow the noise level.

        Returns
        -------
        done : int
            Samples taken.
        ratio : ndarray, shape (done,)
            Largest squared statistic over its threshold.
        """
        mem, first = self.memory, self.n_samples
        given, use = use, use.copy()  # samples that stand out alone are marked in it
        # samples that count for the scores: none soon after a gap
        calm, pause = self._calm(known, use)
        state = {key: mem[key] for key in ("x", "z", "w")}
        # observer, and forces of the candidates along its motion
        after, before, F, inner = self._motion(state, W, Y, use, first)
        ratio, scale = np.zeros(len(W)), np.ones(Y.shape)
        # whiten, update the windows, compare with the thresholds
        state_of = kernels.State(*(mem[name] for name in kernels.State._fields))
        samples = Y - after[1], after[1], use, calm, F
        done = int(kernels.scores(samples, self._fixed, state_of, stop, scale, ratio))
        if np.isnan(ratio[:done]).any():
            sample = first + int(np.argmax(np.isnan(ratio)))
            raise DivergenceError(
                f"the statistic at sample {sample} is not a number; check the samples before it, then reset()"
            )
        left_out = bool((use[:done] == kernels.ALONE).any())
        marks, use = use[:done], (use[:done] == 1).astype(np.uint8)
        if done < len(W) or left_out:  # the observer stops at the same sample, and does not follow it
            after, before, _, inner = self._motion(state, W[:done], Y[:done], use, first)
            _, pause = self._calm(known[:done], given[:done])
        mem.update(after[0])
        mem["inner"] = inner
        mem["pause"][:] = pause
        # a missing input: the state is found anew some time later
        gaps = np.flatnonzero(known[:done] == 0)
        if gaps.size:
            mem["lost"][0] = first + gaps[-1] + 1
        # keep the samples for the fit after an alarm
        at = np.arange(max(first, first + done - len(mem["ring_w"])), first + done)
        place, here = at % len(mem["ring_w"]), at - first
        mem["ring_w"][place], mem["ring_y"][place] = W[here], Y[here]
        mem["ring_use"][place], mem["ring_x"][place] = marks[here], before[here]
        mem["ring_scale"][place] = scale[here]
        return done, ratio[:done]

    @property
    def wait(self) -> int:
        """Samples after a missing input before the state is found anew."""
        # the observer's settling time, within what the buffers hold
        enough = 4 * (self.observer.structure.n_states + len(self.memory["past_e"]))
        return max(min(self.healthy.settle, _FIND * self.windows.block), enough)

    @property
    def find_at(self) -> int:
        """Number of samples at which the state is to be found anew, -1 if not."""
        lost = int(self.memory["lost"][0])
        return -1 if lost < 0 else lost + self.wait

    def _gaps(self) -> None:
        """Prepare how long an uncertain state or missing outputs matter.

        The energy of the whitened innovations by a state error, from a sample on, bounds the relative
        increase of the variance of every statistic (Cauchy-Schwarz).
        """
        # error system: state of the observer and the past of the whitening filters
        bank, h = self.bank, self.healthy
        n, (ny, q) = len(bank.Phi), h.filters.shape
        level = np.sqrt(h.noise[:, 0] + (h.noise[:, 1] + h.noise[:, 2]) * h.power)
        step, seen = np.zeros((n + q * ny,) * 2), np.zeros((ny, n + q * ny))
        step[:n, :n] = bank.Phi - bank.Phi @ h.gain @ bank.C
        seen[:, :n] = bank.C
        for a in range(q):  # the past of the whitening filters
            rows = slice(n + a * ny, n + (a + 1) * ny)
            step[rows, slice(0, n) if a == 0 else slice(rows.start - ny, rows.start)] = (
                bank.C if a == 0 else np.eye(ny)
            )
            seen[:, rows] = np.diag(h.filters[:, a])
        seen = h.mix / level @ seen
        # observability Gramian by doubling: sum of (step^k)' seen' seen step^k
        energy, self._steps = seen.T @ seen, [step]  # after 1, 2, 4, ... samples
        with np.errstate(all="ignore"):
            for _ in range(math.ceil(math.log2(4 * h.settle + 2))):
                power = self._steps[-1]
                energy = energy + power.T @ energy @ power
                self._steps.append(power @ power)
            self._energy = energy
            impulse = np.eye(1, 1000)[0]
            color = [np.linalg.norm(lfilter([1.0], np.r_[1.0, row], impulse)) for row in h.filters]
            # covariance of the state after 1, 2, 4, ... missed corrections
            missed = bank.Phi @ h.gain * (level * color)  # what one correction does to the state
            doubt, open_loop = missed @ missed.T, bank.Phi
            self._pauses = []  # after 1, 2, 4, ... samples without an output
            for _ in self._steps:
                self._pauses.append(self._matters(doubt))
                doubt = doubt + open_loop @ doubt @ open_loop.T
                open_loop = open_loop @ open_loop

    def _matters(self, doubt: Array) -> int:
        """Return how many samples an uncertain state affects the statistics.

        `doubt` is the covariance of the state, (n, n).
        """
        # bisection over powers of two: when does the state error fall below the limit?
        n, samples = len(doubt), 0
        P = np.zeros_like(self._energy)
        P[:n, :n] = doubt
        if not (np.isfinite(doubt).all() and np.isfinite(self._energy).all()):
            return self.healthy.settle
        if np.sum(self._energy * P) <= _DOUBT:
            return 0
        for k in reversed(range(len(self._steps))):
            later = self._steps[k] @ P @ self._steps[k].T
            if np.sum(self._energy * later) > _DOUBT:
                P, samples = later, samples + 2**k
        return samples + 1

    def _calm(self, known: Flags, use: Flags) -> tuple[Flags, tuple[int, int]]:
        """Return the samples that count.

        Samples after a gap do not count until the state is known well enough.
        """
        # count missing outputs in a row; after a gap wait as long as its length demands
        pause, gone = map(int, self.memory["pause"])
        whole = np.asarray(use.all(axis=1))
        if known.all() and whole.all() and pause == gone == 0:
            return known, (0, 0)
        calm = np.ones_like(known)
        for i, there in enumerate(known):
            if whole[i] and gone:
                pause = max(pause, self._pauses[min((gone - 1).bit_length(), len(self._pauses) - 1)])
            gone = 0 if whole[i] else gone + 1
            # a missing input makes the state uncertain for longer
            if not there:
                pause = max(pause, self.wait + 1)
            calm[i] = pause == 0
            pause = max(pause - 1, 0)
        return calm, (pause, gone)

    def _motion(
        self, state: dict[str, Array], W: Array, Y: Array, use: Flags, first: int
    ) -> tuple[tuple[dict[str, Array], Array], Array, Array, Array]:
        """Observer over a block, and the candidates' forces along its motion."""
        after, outputs, states = self.observer.advance(state, W, Y, use, first)
        bank = self.bank
        # before the correction: what is said about a sample must not contain its own noise
        before = states - np.where(use > 0, Y - outputs, 0.0) @ self.observer.gain.T
        sensed = np.ascontiguousarray(np.hstack([before, W]))
        F, inner = np.zeros((len(W), bank.size)), self.memory["inner"].copy()
        n, rate = self.observer.structure.n_states, 1.0 / self.observer.dt
        forces(sensed, self._columns, n, rate, inner, F)
        raise_pending()
        return (after, outputs), before, F * bank.scale, inner

    def recent(self, start: int) -> tuple[Array, Array, Flags, Array, Array]:
        """Return the stored samples from `start` on.

        They are inputs, outputs, flags, noise and the first state, as far as they are kept.
        """
        mem = self.memory
        place = np.arange(start, self.n_samples) % len(mem["ring_w"])
        marks = mem["ring_use"][place]
        # what was left out, where it turned out to be the beginning of a change
        use = (marks == 1) | ((marks == kernels.ALONE) & (mem["crowd"] > kernels.FEW))
        return (
            mem["ring_w"][place], mem["ring_y"][place], use.astype(np.uint8), mem["ring_scale"][place],
            mem["ring_x"][place[0]],
        )  # fmt: skip

    def variances(self) -> Array:
        """Variance of the scores by chance, (M, k); inf where nothing is seen."""
        mem = self.memory
        # variance of N under no change, widened by doubt and calibration
        wide = (mem["V"] + mem["doubt"]) * mem["factor"]
        return np.where(wide <= 1e-200, np.inf, wide)

    @property
    def oldest(self) -> int:
        """First sample that is kept."""
        return max(0, self.n_samples - len(self.memory["ring_w"]))

    def block_sums(self) -> tuple[Integers, Array]:
        """Return first sample, scores and information of each stored block.

        The blocks are in order of time.
        """
        # the last blocks, oldest first
        w = self.windows
        last = (self.n_samples - 1) // w.block
        index = np.arange(max(0, last - w.blocks + 1), last + 1)
        return index * w.block, self.memory["sums"][:, index % w.blocks]

    def restart(self, start: int, state: Array) -> None:
        """Begin anew as healthy, from the state that was found at sample `start`."""
        self.found(start, state)
        for key in ("N", "V", "sums", "Xc", "past_e", "past_s", "cross", "shared", "doubt"):
            self.memory[key][:] = 0

    def found(self, start: int, state: Array, doubt: Array | None = None) -> None:
        """Continue from the state that was found at sample `start`.

        `doubt` is its covariance. None means that the state is exact.
        """
        mem = self.memory
        # run the observer again from the state at `start`
        W, Y, use, _, _ = self.recent(start)
        begin = {"x": state, "z": mem["z"], "w": mem["w"][:0]}
        after, _, _ = self.observer.advance(begin, W, Y, use, start)
        mem["x"], mem["z"] = after["x"], after["z"]
        # whitening filters need a new past
        mem["known"][:] = 0
        mem["lost"][0] = -1
        # wait until the remaining uncertainty no longer matters
        if doubt is not None:
            wait = self._matters(doubt) - (self.n_samples - start)
            mem["pause"][0] = max(int(mem["pause"][0]), wait)
