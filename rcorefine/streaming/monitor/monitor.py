"""`Monitor`: the diagnosis on a stream."""

from __future__ import annotations

import math
import os
from collections.abc import Callable, Mapping, Sequence
from copy import copy
from types import SimpleNamespace
from typing import Any, Unpack

import control as ct
import numpy as np
from numpy.typing import ArrayLike

from ...arguments import as_list, as_number, as_text
from ...arithmetic import own_arithmetic
from ...data.measurement import Measurement
from ...effects.effect import Effect, as_effects
from ...exceptions import DataError, ModelError
from ...models.library import effect_library
from ...results import Options, Result, picture, show
from ...systems.discretization import check_sampling_time
from ...systems.linear import Array
from ..checks import as_size
from ..gaps import Block, as_missing, block_with_gaps, whole_block
from ..persistence import read_file, write_file
from ..restoring import damaged
from ..samples import checked_block
from .alarm import Alarm, MonitorRow
from .bank import build_bank
from .baseline import learn as learn_from
from .course import Course
from .observer import Observer, as_base, pace_of
from .saving import content_of, restored
from .sequential_test import Watch
from .standing import find_state, linear_rows, misfit_remarks, shares, standing
from .stream import Stream, Windows
from .thresholds import threshold

__all__ = ["Monitor"]

_PER = 100_000  # samples to which `false_alarms` refers
_CHUNK = 2048
_LEAST = 2000  # samples of the learning phase
_LEARN_PERIODS = 20
_LONGEST = 200  # periods in the longest window
_BLOCKS = 256
_SLOW = 16  # periods of the mean that is taken off


class Monitor(Result):
    """Watch a structure on a stream: is it still healthy, and if not, what has changed since when.

    A steady observer of the healthy model follows the samples. What it does not explain is
    whitened; every candidate effect contributes what it would add to the outputs, and a
    sequential test asks at each sample whether one of them has been present for the last
    8, 16, 32, ... samples. The memory taken does not grow with the stream.

    Parameters
    ----------
    model : StateSpace, PhysicalModel or Refinement
        Healthy structure, continuous time. Where its numbers are not exact, refine it
        first (`refine` on a healthy record): a wrong model is a change from the start.
    candidates : sequence of Effect, optional
        What may come; default `effect_library` without hidden modes.
    dt : float
        Sampling time [s].
    false_alarms : float, optional
        Expected number of false alarms in 100 000 healthy samples, at most. The default
        0.01 is one in ten million samples.
    learn : int, optional
        Samples at the start that are taken for healthy, from which the noise (color and
        level, unmeasured forces) is learned; default 2000, or 20 periods of the first mode.
    disturbance : float, optional
        Unmeasured force over the measured input, rms; by default found by likelihood.
    hold : {"zoh", "foh"}, optional
        The input between samples: held, or linear.
    missing : {"raise", "hold-out"}, optional
        With "hold-out" samples that are NaN or masked are predicted over and not judged. After
        a gap of an input the monitor pauses until its observer has settled, at most 8 periods;
        then the state is found anew.
    windows : tuple of two int, optional
        Shortest and longest memory of the test in samples; default a quarter of a period
        (at least 8) and 200 periods of the first mode.
    patience : float, optional
        Periods of the first mode that an alarm may wait for a clear name, default 4; 0 rings
        at once, with the best name that there is.

    Attributes
    ----------
    dt, false_alarms, learn, disturbance, hold, missing, patience
        As given.
    candidates : tuple of Effect
        Candidates, in the order of `probability`.
    remarks : tuple of str
        What the learning phase showed, one sentence each.

    Raises
    ------
    control.ControlArgument
        If a setting has the wrong type.
    ModelError
        If a setting is out of range, the model is discrete, or a candidate has no place in it.

    Notes
    -----
    *Test.* With the whitened innovation r and the whitened sensitivity s of a candidate, the
    statistic of a window with forgetting factor g is ``sum g^i s r / sqrt(sum g^2i s^2)``: for
    a healthy structure of unit variance whatever the input does. Thresholds
    follow from the rate at which such a process crosses a level by chance (Siegmund),
    the stated rate shared out evenly among columns and windows, which errs to the
    safe side because they are correlated. One innovation counts for 3 standard deviations at most, and
    up to three samples in a short while that stand out by more than 8 are left out altogether, in the
    observer too, so that single outliers of a sensor ring nothing. While nothing is wrong the
    noise level is followed, and where the statistics of a candidate scatter more than by
    theory (an unmeasured force of unknown color, say) its thresholds rise by as much.

    *Name.* After a crossing the candidates are fitted to the samples since the change
    (nonlinear, in the observer's form) until one place is clear, then from time to time to the last 8
    periods, so that growth is followed and healing is noticed.

    *Slow drift.* A slow mean (16 periods) is taken off innovations and candidates alike:
    offsets and drift of sensors ring nothing, jumps do.

    References
    ----------
    M. Basseville, I. Nikiforov, Detection of Abrupt Changes, Prentice Hall 1993, chapters 7 to 9.
    D. Siegmund, Sequential Analysis, Springer 1985.

    Examples
    --------
    >>> model = rco.mass_spring_damper(1.0, 0.4, 100.0)
    >>> damaged = rco.mass_spring_damper(1.0, 0.4, 90.0)
    >>> rng = np.random.default_rng(1)
    >>> w = rng.standard_normal(1500)
    >>> def measured(plant, w):
    ...     y = ct.forced_response(plant.system.sample(0.05), inputs=w).outputs
    ...     return y + 0.002 * rng.standard_normal(w.size)
    >>> monitor = rco.Monitor(model, [rco.Effect("stiffness", "link1"), rco.Effect("damping", "link1")],
    ...                       dt=0.05, learn=500)
    >>> monitor.update(w, measured(model, w))
    >>> monitor.alarm is None
    True
    >>> monitor.update(w, measured(damaged, w))
    >>> print(monitor.alarm.effect.label, f"{monitor.alarm.coefficients['stiffness']:.0f}")
    stiffness at link1 -10
    """

    def __init__(
        self,
        model: Any,
        candidates: Sequence[Effect] | None = None,
        *,
        dt: float | None = None,
        false_alarms: float = 0.01,
        learn: int | None = None,
        disturbance: float | None = None,
        hold: str = "zoh",
        missing: str = "raise",
        windows: tuple[int, int] | None = None,
        patience: float = 4.0,
    ) -> None:
        self._structure, self._theta, self._substeps = as_base(model, hold)
        name = self._structure.linear_model.name
        if dt is None:
            raise ModelError(f"model {name!r} is continuous: give dt, the sampling time in seconds")
        self.dt = check_sampling_time(dt)
        if as_text(hold, "hold") not in ("zoh", "foh"):
            raise ct.ControlArgument(
                f"hold must be 'zoh' or 'foh' on a stream, not {hold!r}: a band-limited input "
                "needs the future"
            )
        self.hold = hold
        self.missing = as_missing(missing)
        self.false_alarms = as_number(
            false_alarms, f"false_alarms per {_PER} samples", above=0.0, most=1000.0, error=ModelError
        )
        self.disturbance = disturbance
        if disturbance is not None:
            self.disturbance = as_number(disturbance, "disturbance", least=0.0, error=ModelError)
        self.patience = as_number(patience, "patience (in periods)", least=0.0, error=ModelError)
        self.candidates = _candidates(self._structure.model, candidates)
        self._pace = pace_of(self._structure, self._theta, self.dt)
        if learn is None:
            learn = max(_LEAST, _LEARN_PERIODS * self._pace.period)
        self.learn = as_size(learn, "learn", 200, "samples of the learning phase")
        self._block = max(1, self._pace.period // 8)
        self.windows = windows
        self._lengths = _lengths(windows, self._pace.period)
        self._view = SimpleNamespace(initial=self._structure.linear_model, step=self.dt)
        self.reset()

    def reset(self) -> None:
        """Forget all samples; the learning phase starts again."""
        linear = self._structure.linear_model
        self._stream: Stream | None = None
        self._waiting: list[Block] = []
        self._count = 0
        self._latest = np.zeros(linear.n_inputs)
        self.remarks: tuple[str, ...] = ()
        self._watch = Watch(
            self._pace.period, self.dt, self.false_alarms, self.patience, _BLOCKS * self._block
        )
        self._course = Course(len(self.candidates) + 4, max(1, self._pace.period // 2))

    # ------------------------------------------------------------------ samples in
    @own_arithmetic()
    def update(self, w: ArrayLike, y: ArrayLike) -> None:
        """Take one sample or a block.

        Parameters
        ----------
        w : array_like of shape (n_w,) or (n_w, N)
            Inputs; 1-D of shape (N,) for a single input.
        y : array_like of shape (n_y,) or (n_y, N)
            Outputs at the same samples.

        Raises
        ------
        control.ControlDimension
            If shapes do not fit.
        DataError
            If a sample is missing or not finite (see `missing`), or the learning phase is
            of no use.
        DivergenceError
            If the observer leaves all bounds.

        Notes
        -----
        The result does not depend on how the stream is cut into blocks. An update that raises
        changes nothing; where the learning phase itself is of no use, begin anew with `reset`.
        """
        if self.missing == "raise":
            block = whole_block(*checked_block(self._view, w, y, self._count))  # type: ignore[arg-type]
        else:
            block = block_with_gaps(self._view, w, y, self._count, self._latest)  # type: ignore[arg-type]
        restore = self._way_back(len(block.inputs))
        try:
            self._go_on(block)
        except BaseException:
            restore()
            raise

    def _way_back(self, coming: int) -> Callable[[], None]:
        """What restores the present state after an update of `coming` samples that failed."""
        names = ("_stream", "_count", "_latest", "remarks")
        before: dict[str, Any] = {name: getattr(self, name) for name in names}
        before |= {name: copy(getattr(self, name)) for name in ("_waiting", "_watch", "_course")}
        stream = None if self._stream is None else self._stream.way_back(coming)

        def restore() -> None:
            self.__dict__.update(before)
            if stream is not None:
                stream()

        return restore

    def _go_on(self, block: Block) -> None:
        self._latest = block.inputs[-1].copy()
        position = 0
        if self._stream is None:
            position = min(self.learn - self._count, len(block.inputs))
            self._waiting.append(_part(block, 0, position))
            self._count += position
            if self._count < self.learn:
                return
            whole = _joined(self._waiting)
            self._stream = self._start(whole)
            self._waiting = []
            self._take(whole, 0)
            self.remarks = misfit_remarks(self._stream)
        self._take(block, position)

    def run(self, data: Measurement) -> Monitor:
        """Take a whole record, channels matched by name.

        Parameters
        ----------
        data : Measurement
            Record with the sampling time and the hold of the monitor.

        Returns
        -------
        Monitor
            The monitor itself.

        Raises
        ------
        DataError
            If sampling time or hold differ.
        """
        from ...data.channels import match_channels, record_for

        if not isinstance(data, Measurement):
            raise ct.ControlArgument(
                f"data must be a Measurement, not {type(data).__name__}; "
                "build one with Measurement(inputs, outputs, dt=...)"
            )
        if not math.isclose(data.dt, self.dt, rel_tol=1e-6):
            raise DataError(f"the record has dt = {data.dt:g} s and the monitor {self.dt:g} s; resample one")
        if data.hold != self.hold:
            raise DataError(
                f"the record has hold={data.hold!r} and the monitor hold={self.hold!r}; build the "
                f"monitor with hold={data.hold!r}"
            )
        ordered = record_for(data, match_channels(self._structure.linear_model, data))
        self.update(ordered.inputs, ordered.outputs)
        return self

    def _start(self, block: Block) -> Stream:
        """Learn from the first samples."""
        if not block.known.all():
            sample = int(np.argmin(block.known))
            raise DataError(
                f"an input is missing at sample {sample}, in the learning phase of {self.learn} samples; "
                "start the stream where the inputs are whole"
            )
        W, Y = block.inputs, block.outputs
        data = Measurement(W.T, Y.T, dt=self.dt, hold=self.hold)
        healthy = learn_from(self._structure, self._theta, self._substeps, data, block.use, self.disturbance)
        bank = build_bank(self._structure, self._theta, self.candidates, data, self.hold, healthy.gain)
        keep = 1.0 - 1.0 / self._lengths
        T = self._pace.period
        levels = threshold(self.false_alarms / _PER, keep, bank.size)
        windows = Windows(keep, levels, self._block, _BLOCKS, 1.0 / (_SLOW * T))
        observer = Observer(self._structure, self._theta, self.dt, self.hold, self._substeps, healthy.gain)
        return Stream(observer, healthy, bank, windows, self.learn)

    def _take(self, block: Block, position: int) -> None:
        stream, watch = self._stream, self._watch
        assert stream is not None
        total = len(block.inputs)
        while position < total:
            here = stream.n_samples
            until = min(here + total - position, here + _CHUNK, self._course.due(here))
            healthy = not watch.busy
            if not healthy:
                until = min(until, watch.next_event(here))
            if stream.find_at > here:
                until = min(until, stream.find_at)
            stop = position + until - here
            done, ratio = stream.advance(
                block.inputs[position:stop], block.outputs[position:stop], block.use[position:stop],
                block.known[position:stop], stop=healthy,
            )  # fmt: skip
            position += done
            if healthy and ratio[-1] > 1.0:
                watch.ring(stream)
            elif not healthy and stream.n_samples >= watch.next_event(here):
                watch.attend(stream)
            if stream.n_samples == stream.find_at:
                find_state(stream)
            self._count = stream.n_samples
            if self._count % self._course.stride == 0:
                self._course.add(self._count, self._row())

    def _row(self) -> Array:
        assert self._stream is not None
        ratio, gains = standing(self._stream)
        watch = self._watch
        if watch.gains is None:
            p = shares(float(gains.max()), gains)
            value, std = math.nan, math.nan
        else:
            p = shares(watch.change(self._stream), watch.gains)
            value, std = watch.value, watch.std
        return np.concatenate([p, [ratio, value, std]])

    # ------------------------------------------------------------------ results
    @property
    def n_samples(self) -> int:
        """Number of samples taken."""
        return self._count

    @property
    def alarm(self) -> Alarm | None:
        """The alarm that is on, or None."""
        return self._watch.alarm

    @property
    def past_alarms(self) -> tuple[Alarm, ...]:
        """Alarms that have ended, the last 100."""
        return tuple(self._watch.past)

    @property
    def timepts(self) -> Array:
        """Times of the rows of `probability`."""
        c = self._course
        return np.asarray((c.samples[: c.count] - 1) * self.dt)

    @property
    def probability(self) -> Array:
        """Course of the probabilities at `timepts`, shape (1 + n_candidates, n_rows).

        The first row is "nothing has changed": one half where the statistic stands at its
        threshold. The others follow in the order of `candidates`. At most 2048
        rows are kept; a longer stream is thinned.
        """
        c = self._course
        return c.rows[: c.count, : 1 + len(self.candidates)].T.copy()

    @property
    def statistic(self) -> Array:
        """Course of the largest statistic over its threshold at `timepts`, shape (n_rows,)."""
        c = self._course
        return c.rows[: c.count, -3].copy()

    @property
    def coefficient(self) -> Array:
        """Course of the named effect's first coefficient and its standard deviation, (2, n_rows).

        NaN while no alarm is on.
        """
        c = self._course
        return c.rows[: c.count, -2:].T.copy()

    @property
    def ranking(self) -> tuple[MonitorRow, ...]:
        """All candidates, the most probable first; empty during the learning phase."""
        if self._stream is None:
            return ()
        if self._watch.rows:
            return tuple(self._watch.rows)
        return tuple(linear_rows(self._stream))

    # ------------------------------------------------------------------ pictures, text, files
    @picture
    def plot(self, **options: Unpack[Options]) -> ct.ControlPlot:
        """Draw statistic, probabilities and the coefficient of the named effect over time.

        Parameters
        ----------
        ax : array of Axes, shape (3, 1), optional
            Where to draw.
        label : str or sequence of str, optional
            Labels of the probabilities shown, "nothing" first.

        Returns
        -------
        ControlPlot
            Lines, axes and figure.

        Raises
        ------
        DataError
            During the learning phase, when there is nothing to draw yet.
        """
        return show(self, "plot", **options)

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write the monitor to a file, to go on later exactly where it stood.

        Parameters
        ----------
        path : path-like
            File, replaced in one step.
        """
        write_file(path, content_of(self))

    @classmethod
    def load(
        cls, path: str | os.PathLike[str], *, laws: Mapping[str, Callable[..., Any]] | None = None
    ) -> Monitor:
        """Read a monitor that `save` wrote.

        Parameters
        ----------
        path : path-like
            File.
        laws : mapping, optional
            Functions of `custom` effects by the label of the effect; no file holds them.

        Returns
        -------
        Monitor
            Ready for the next sample.

        Raises
        ------
        DataError
            If the file is none of a monitor, or damaged.
        """
        with damaged(path):
            return restored(cls, read_file(path, laws, "monitor"))

    def __repr__(self) -> str:
        state = "alarm" if self.alarm else ("learning" if self._stream is None else "no alarm")
        return f"<Monitor of {self._structure.linear_model.name!r}: {self.n_samples} samples, {state}>"

    def __getstate__(self) -> dict[str, Any]:
        return dict(content_of(self))

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__dict__.update(restored(Monitor, state).__dict__)


def _candidates(model: Any, given: Sequence[Effect] | None) -> tuple[Effect, ...]:
    if given is None:
        return tuple(e for e in effect_library(model) if e.spec.along_motion)
    effects = tuple(as_effects(given, "candidates"))
    if not effects:
        raise ModelError("candidates is empty: name at least one Effect, or leave candidates out")
    for effect in effects:
        model.check(effect)
        if not effect.spec.along_motion:
            raise ModelError(
                f"{effect.label} cannot be watched for: it is no force along the model's motion; "
                "use diagnose() on a record"
            )
        if effect.law is not None and len(effect.coefficients) > 1:
            raise ModelError(f"{effect.label} can be watched for with one coefficient only, its scale")
    if len(set(effects)) < len(effects):
        raise ModelError("a candidate is named twice; give each effect once")
    return effects


def _lengths(windows: tuple[int, int] | None, period: int) -> Array:
    if windows is None:
        shortest, longest = max(8, period // 4), _LONGEST * period
    else:
        pair = as_list(windows, "windows", "two sizes, the shortest first")
        if len(pair) != 2:
            raise ct.ControlDimension(f"windows has {len(pair)} entries; give the shortest and the longest")
        shortest = as_size(pair[0], "windows[0]", 4, "samples in the shortest window")
        longest = as_size(pair[1], "windows[1]", shortest, "samples in the longest window")
    count = max(1, round(math.log2(longest / shortest)) + 1)
    return np.asarray(shortest * 2.0 ** np.arange(count))


def _part(block: Block, start: int, stop: int) -> Block:
    return Block(
        block.inputs[start:stop], block.outputs[start:stop], block.known[start:stop], block.use[start:stop]
    )


def _joined(blocks: list[Block]) -> Block:
    return Block(
        np.concatenate([b.inputs for b in blocks]),
        np.concatenate([b.outputs for b in blocks]),
        np.concatenate([b.known for b in blocks]),
        np.concatenate([b.use for b in blocks]),
    )
