"""`Monitor`: the diagnosis on a stream."""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping, Sequence
from copy import copy
from typing import Any, Unpack

import control as ct
import numpy as np
from numpy.typing import ArrayLike

from ...arguments import as_number, as_text
from ...data.measurement import Measurement
from ...effects.effect import Effect
from ...exceptions import ModelError
from ...inference.levels import levels
from ...results import Options, Result, picture, show
from ...systems.discretization import check_sampling_time
from ...systems.linear import Array
from ...writing import damaged
from ..locks import Locked
from ..persistence import read_file, write_file
from ..samples import Block, as_missing, as_size, checked_block
from .bank import checked_candidates
from .learning import BLOCKS, PER, Adequacy, learned, record_to_watch, window_lengths
from .saving import content_of, restored
from .stream import Stream, as_base, period_of
from .watching import Alarm, Course, MonitorRow, Watch, idle_remarks, linear_rows, watch_block

_LEAST = 2000  # samples of the learning phase
_LEARN_PERIODS = 20


class Monitor(Locked, Result):
    """Monitor that detects changes of a structure on a stream.

    It reports whether the structure is still healthy, and if not, what has changed since when.

    A steady observer of the healthy model follows the samples. What it does not explain is whitened;
    every candidate effect contributes what it would add to the outputs, and a sequential test asks at
    each sample whether one has been present for the last 8, 16, 32, ... samples.

    Parameters
    ----------
    model : StateSpace, PhysicalModel or Refinement
        Healthy structure, continuous time. A `Refinement` brings its effects, and the covariance of
        what was estimated. What is missing from the model is a change from the start: see `adequacy`.
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
        Input between samples.
    missing : {"raise", "hold-out"}, optional
        With "hold-out" samples that are NaN or masked are predicted over and not judged. After a gap the
        monitor pauses until the state is sure enough; after one of an input it finds the state anew.
    windows : tuple of two int, optional
        Shortest and longest memory of the test in samples; default a quarter of a period
        (at least 8) and 200 periods of the first mode.
    patience : float, optional
        Periods of the first mode that an alarm may wait for a clear name, default 4; 0 rings
        at once, with the best name that there is.
    tolerance : float, optional
        Relative standard deviation within which the numbers of the model (parameters, masses, gains)
        are moved to fit the learning phase; default 0.05. 0 trusts the model to the last digit.

    Attributes
    ----------
    dt, false_alarms, learn, disturbance, hold, missing, patience, tolerance
        As given.
    candidates : tuple of Effect
        Candidates, in the order of `probability`.
    adequacy : Adequacy or None
        After learning, how far the model is from the samples: `.fit` in percent, `.fit_moved` with the
        numbers `.moved`, the `.missing` effect, `.adequate`, `.sentence` with what to do.
    remarks : tuple of str
        What else the learning phase showed, one sentence each.

    Raises
    ------
    control.ControlArgument
        If a setting has the wrong type.
    ModelError
        If a setting is out of range, the model is discrete, or a candidate has no place in it.

    Notes
    -----
    *Test.* With the whitened innovation r and the whitened sensitivity s of a candidate, the statistic
    of a window with forgetting factor g is ``sum g^i s r / sqrt(sum g^2i s^2)``, of unit variance
    whatever the input does. Thresholds follow from the rate at which such a process crosses a level by
    chance (Siegmund), shared out evenly among columns and windows, which errs to the safe side. One
    innovation counts for 3 standard deviations at most, and up to three in a short while beyond 8 are
    left out, so that outliers ring nothing. While nothing is wrong the noise level is followed, and
    where statistics scatter more than by theory their thresholds rise by as much.

    *Nuisances.* The numbers of the model are moved to where the learning phase wants them; the covariance
    P that is left widens each statistic by ``c' P c``, c the sum of products of its sensitivity with
    those of the numbers: an error of the model that grows with the signal is no change. The variance of
    the noise may have a part that follows the signal, and goes on growing beyond the learning phase.

    *Name.* After a crossing the candidates are fitted to the samples since the change
    (nonlinear, in the observer's form) until one place is clear, then from time to time to the last 8
    periods, so that growth is followed and healing is noticed.

    *Slow drift.* A slow mean (16 periods) is taken off innovations and candidates alike:
    drift of sensors rings nothing, jumps do. A constant offset is estimated with the initial state.

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
        tolerance: float | None = None,
    ) -> None:
        # model with its effects and coefficients; their covariance where they were estimated
        self._structure, self._theta, self._substeps = as_base(model, hold)
        covariance = getattr(model, "covariance", None)
        self._covariance = None if covariance is None else np.asarray(covariance, dtype=float)
        # relative uncertainty of the nominal parameters
        usual_error = levels().off if tolerance is None else tolerance
        self.tolerance = as_number(usual_error, "tolerance", least=0.0, error=ModelError)
        if dt is None:
            name = self._structure.linear_model.name
            raise ModelError(f"model {name!r} is continuous: give dt, the sampling time in seconds")
        self.dt = check_sampling_time(dt)
        if as_text(hold, "hold") not in ("zoh", "foh"):
            raise ct.ControlArgument(
                f"hold must be 'zoh' or 'foh' on a stream, not {hold!r}: band-limited needs the future"
            )
        self.hold = hold
        self.missing = as_missing(missing)
        self.false_alarms = as_number(
            false_alarms, f"false_alarms per {PER} samples", above=0.0, most=1000.0, error=ModelError
        )
        self.disturbance = disturbance
        if disturbance is not None:
            self.disturbance = as_number(disturbance, "disturbance", least=0.0, error=ModelError)
        self.patience = as_number(patience, "patience (in periods)", least=0.0, error=ModelError)
        self.candidates = checked_candidates(self._structure.model, candidates)
        # period of the first mode: the unit of all durations
        self._period = period_of(self._structure, self._theta, self.dt)
        # learning phase: 2,000 samples, at least 20 periods
        usual = max(_LEAST, _LEARN_PERIODS * self._period)
        self.learn = as_size(usual if learn is None else learn, "learn", 200, "samples of the learning phase")
        # scores are summed over blocks of an eighth of a period
        self._block = max(1, self._period // 8)
        self.windows = windows
        self._lengths = window_lengths(windows, self._period)
        self.reset()

    def reset(self) -> None:
        """Forget all samples; the learning phase starts again."""
        # observer and noise are learned again
        linear = self._structure.linear_model
        self._stream: Stream | None = None
        self._waiting: list[Block] = []
        self._count = 0
        self._latest = np.zeros(linear.n_inputs)
        self.remarks: tuple[str, ...] = ()
        self.adequacy: Adequacy | None = None
        self._watch = Watch(self._period, self.dt, self.false_alarms, self.patience, BLOCKS * self._block)
        self._course = Course(len(self.candidates) + 4, max(1, self._period // 2))

    # ------------------------------------------------------------------ samples in
    @np.errstate(divide="warn", over="warn", invalid="warn", under="ignore")  # NumPy's defaults
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
            If a sample is missing or not finite (see `missing`), or the learning phase is of no use
            (begin anew with `reset`).
        DivergenceError
            If the observer leaves all bounds.

        Notes
        -----
        How the stream is cut into blocks makes no difference. An update that raises changes nothing.
        Several threads may call it in turn.
        """
        linear = self._structure.linear_model
        # a missing input holds its last value
        latest = None if self.missing == "raise" else self._latest
        block = checked_block(linear, self.dt, w, y, self._count, latest)
        # an update that fails leaves the monitor as it was
        restore = self._way_back(len(block.inputs))
        try:
            self._go_on(block)
        except BaseException:
            restore()
            raise

    def _way_back(self, coming: int) -> Callable[[], None]:
        """Return a function that restores the present state.

        It undoes an update of `coming` samples that failed.
        """
        # keep references to what is replaced, copies of what changes in place
        names = "_stream", "_count", "_latest", "remarks", "adequacy"
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
        # collect the learning phase, then learn and go through it
        position = 0
        if self._stream is None:
            position = min(self.learn - self._count, len(block.inputs))
            self._waiting.append(block.part(0, position))
            self._count += position
            if self._count < self.learn:
                return
            whole = Block.joined(self._waiting)
            self._stream, self.adequacy = learned(self, whole)
            caution = () if self.adequacy.adequate else (self.adequacy.sentence,)
            self.remarks, self._waiting = idle_remarks(self._stream) + caution, []
        # after it, sample by sample through observer and windows
        watch_block(self._stream, self._watch, self._course, block, position)
        self._count = self._stream.n_samples

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
        # channels in the order of the model
        ordered = record_to_watch(self._structure.linear_model, self.dt, self.hold, data)
        self.update(ordered.inputs, ordered.outputs)
        return self

    # ------------------------------------------------------------------ files

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write the monitor to a file.

        The file is replaced in one step. A loaded monitor continues exactly where this one stopped.

        Parameters
        ----------
        path : path-like
            File.
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
            Laws of your own by the label of the effect. Default: those of which this process has
            made an effect already. Loading imports no module.

        Returns
        -------
        Monitor
            Ready for the next sample.

        Raises
        ------
        DataError
            If the file is none of a monitor, or damaged.
        ModelError
            If a law of your own is neither given nor one of this process.
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
        # a row stands after its last sample
        return np.asarray((c.samples[: c.count] - 1) * self.dt)

    @property
    def probability(self) -> Array:
        """Probabilities at `timepts`, shape (1 + n_candidates, n_rows).

        The first row is "nothing has changed": one half where the statistic is at its
        threshold. The others follow in the order of `candidates`. What a column lacks to one is the
        probability of a change that is none of them. At most 2048 rows are kept; a longer stream is thinned.
        """
        c = self._course
        return c.rows[: c.count, : 1 + len(self.candidates)].T.copy()

    @property
    def statistic(self) -> Array:
        """Largest statistic over its threshold at `timepts`, shape (n_rows,)."""
        c = self._course
        return c.rows[: c.count, -3].copy()

    @property
    def coefficient(self) -> Array:
        """First coefficient of the named effect, with its standard deviation.

        The shape is (2, n_rows).

        NaN while no alarm is on.
        """
        c = self._course
        return c.rows[: c.count, -2:].T.copy()

    @property
    def ranking(self) -> tuple[MonitorRow, ...]:
        """All candidates, the most probable first.

        The ranking is empty during the learning phase.
        """
        if self._stream is None:
            return ()
        # fits since the change while an alarm is on, otherwise the linear statistics
        if self._watch.rows:
            return tuple(self._watch.rows)
        return tuple(linear_rows(self._stream))

    @picture
    def plot(self, **options: Unpack[Options]) -> ct.ControlPlot:
        """Draw statistic, probabilities and coefficient over time.

        The coefficient is that of the named effect.

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
