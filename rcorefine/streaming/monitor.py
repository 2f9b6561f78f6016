"""`Monitor`: the diagnosis on a stream."""

from __future__ import annotations

import math
import os
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Unpack

import control as ct
import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..arguments import as_number, as_text
from ..data.channels import match_channels, record_for
from ..data.measurement import Measurement
from ..data.records import as_record
from ..effects.effect import Effect, as_effects
from ..engine.engine import MOST_SUBSTEPS
from ..engine.simulation import structure_of
from ..engine.structure import Structure
from ..exceptions import DataError, ModelError
from ..inference.levels import levels
from ..inference.whitening import MAX_ORDER
from ..models.library import effect_library
from ..models.operating_point import check_stream_hold, refuse_discrete
from ..results import Options, Result, picture, show
from ..systems.discretization import check_sampling_time
from ..systems.linear import Array
from ..writing import damaged
from .locks import Locked
from .naming import (
    Adequacy,
    Alarm,
    Change,
    MonitorRow,
    adequacy_of,
    attend,
    begin_change,
    history_row,
    linear_rows,
)
from .persistence import check_like, check_range, check_schema, read_file, storable, write_file
from .samples import Block, as_missing, as_size, checked_block
from .score import (
    PER,
    Base,
    Healthy,
    State,
    WatchedModel,
    advance,
    begin,
    block_of,
    found_anew,
    keep_of,
    learn,
    numbers_of,
)  # fmt: skip

_LEAST = 2000  # samples of the learning phase
_LEARN_PERIODS = 20
_ROWS = 2048  # of the history
_MOST_PAST = 100  # alarms that are kept
_LAYOUT = 4  # of a file; raised when what a monitor learned changes its form
storable(Adequacy, Alarm, Block, Change, Healthy, MonitorRow, State)


@dataclass(frozen=True, slots=True, eq=False)
class _Memory:
    """All that an update changes, replaced as a whole.

    An update that fails changes nothing.

    Attributes
    ----------
    count : int
        Samples taken.
    latest : ndarray, shape (n_w,)
        Last inputs.
    waiting : Block
        Samples that make no whole block yet.
    watched : WatchedModel or None
        Healthy model; None in the learning phase.
    state : State or None
        Observer and scores.
    change : Change or None
        The change, once a threshold was crossed.
    past : tuple of Alarm
        Alarms that have ended.
    adequacy : Adequacy or None
        Of the model in the learning phase.
    """

    count: int
    latest: Array
    waiting: Block
    watched: WatchedModel | None = None
    state: State | None = None
    change: Change | None = None
    past: tuple[Alarm, ...] = ()
    adequacy: Adequacy | None = None


class Monitor(Locked, Result):
    """Monitor that detects changes of a structure on a stream.

    It reports whether the structure is still healthy, and if not, what has changed since when.

    A steady observer of the healthy model follows the samples. What it does not explain is whitened, and
    a sequential test asks after each block of samples (an eighth of a period) whether a parameter of the
    model has changed, or more than noise has been left, for the last 8, 16, 32, ... samples. Then the
    candidate effects are fitted to the samples since the change.

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
    hold : {"zoh", "foh"}, optional
        Input between samples.
    missing : {"raise", "hold-out"}, optional
        With "hold-out" samples that are NaN or masked are predicted over and not judged. After a gap the
        monitor pauses until the state is sure enough; after one of an input it finds the state anew.
    tolerance : float, optional
        Relative standard deviation within which the parameters of the model (and masses, gains)
        are moved to fit the learning phase; default 0.05. 0 trusts the model to the last digit.

    Attributes
    ----------
    dt, false_alarms, learn, hold, missing, tolerance
        As given.
    candidates : tuple of Effect
        Candidates, in the order of `probability`.

    Raises
    ------
    control.ControlArgument
        If a setting has the wrong type.
    ModelError
        If a setting is out of range, the model is discrete, or a candidate has no place in it.

    Notes
    -----
    *Test.* With the whitened innovation r and its whitened derivative s by a parameter, the statistic
    of a window with forgetting factor g is ``sum g^i s r / sqrt(sum g^2i s^2)``, of unit variance
    whatever the input does. One more statistic is the energy, ``sum g^i (r^2 - 1)``: it sees what no
    parameter explains. Thresholds follow from the rate at which such a process crosses a level by
    chance (Siegmund; the skewness of squares is allowed for), shared out evenly among statistics and windows,
    which errs to the safe side. One innovation counts for 3 standard deviations at most, and up to three of a
    block beyond 8 are left out, so that outliers ring nothing. While nothing is wrong the noise level is
    followed, and where statistics scatter more than by theory their thresholds rise by as much.

    *Nuisances.* The parameters of the model are moved to where the learning phase wants them; the covariance
    P that is left widens each statistic by ``c' P c``, c the sum of products of its sensitivity with
    those of the parameters: an error of the model that grows with the signal is no change. The variance of
    the noise may have a part that follows the signal, and goes on growing beyond the learning phase.

    *Name.* After a crossing the candidates are fitted to the samples since the change
    (nonlinear, in the observer's form), 1/4, 1/2, 3/4, 1, 3/2, ... periods later. The alarm rings when one
    place is clear twice in a row, or after 4 periods. From then on fits to the last 8 periods follow growth
    and healing.

    *Slow drift.* A slow mean (16 periods) is taken off innovations and derivatives alike:
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
        hold: str = "zoh",
        missing: str = "raise",
        tolerance: float | None = None,
    ) -> None:
        structure, theta, substeps = _structure_of(model, hold)
        covariance = getattr(model, "covariance", None)
        usual_error = levels().off if tolerance is None else tolerance
        self.tolerance = as_number(usual_error, "tolerance", least=0.0, error=ModelError)
        if dt is None:
            name = structure.linear_model.name
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
        self.candidates = _checked_candidates(structure.model, candidates)
        # period of the first mode: the unit of all durations
        self._period = _period_of(structure, theta, self.dt)
        usual = max(_LEAST, _LEARN_PERIODS * self._period)
        self.learn = as_size(usual if learn is None else learn, "learn", 200, "samples of the learning phase")
        given = None if covariance is None else np.asarray(covariance, dtype=float)
        self._base = Base(structure, theta, substeps, given, self.tolerance, self.dt, hold)
        self.reset()

    def reset(self) -> None:
        """Forget all samples; the learning phase starts again."""
        linear = self._base.structure.linear_model
        flags = np.zeros((0, linear.n_outputs), dtype=np.uint8)
        nothing = Block(np.zeros((0, linear.n_inputs)), np.zeros(flags.shape), flags[:, 0], flags)
        self._memory = _Memory(0, np.zeros(linear.n_inputs), nothing)
        block = block_of(self._period)
        self._course = _Timeline(len(self.candidates) + 4, block * max(1, self._period // (2 * block)))

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
        How the stream is cut into updates makes no difference. An update that raises changes nothing.
        Several threads may call it in turn.
        """
        before = self._memory
        # a missing input holds its last value
        latest = None if self.missing == "raise" else before.latest
        block = checked_block(self._base.structure.linear_model, self.dt, w, y, before.count, latest)
        rows: list[tuple[int, Array]] = []
        self._memory = self._after(before, block, rows)
        for sample, row in rows:
            self._course.add(sample, row)

    def _after(self, m: _Memory, block: Block, rows: list[tuple[int, Array]]) -> _Memory:
        """Return the memory after a block; rows of the history come behind `rows`."""
        count, waiting = m.count + len(block.inputs), Block.joined([m.waiting, block])
        m = replace(m, count=count, latest=block.inputs[-1].copy(), waiting=waiting)
        watched, state, change, past, adequacy = m.watched, m.state, m.change, m.past, m.adequacy
        phase: Block | None = None
        if watched is None:
            if count < self.learn:
                return m
            phase = waiting.part(0, self.learn)
            watched = learn(self._base, self.candidates, self._period, self.false_alarms, phase)
            state = begin(watched)
        at, B = 0, watched.block
        assert state is not None
        while len(waiting.inputs) - at >= B:
            state, ratio = advance(watched, state, waiting.part(at, at + B), change is None)
            at, n = at + B, state.blocks * B
            if change is not None:
                state, change, ended = attend(watched, state, change)
                past = (*past, ended)[-_MOST_PAST:] if ended is not None else past
            else:
                state = found_anew(watched, state)
                if ratio > 1.0 and n > self.learn:
                    change = begin_change(watched, state)
            if phase is not None and n + B > self.learn:
                adequacy, phase = adequacy_of(watched, state, phase), None
            if n % self._course.stride == 0:
                rows.append((n, history_row(watched, state, change)))
        waiting = waiting.part(at, len(waiting.inputs))
        return _Memory(count, m.latest, waiting, watched, state, change, past, adequacy)

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
        data, model = as_record(data), self._base.structure.linear_model
        if not math.isclose(data.dt, self.dt, rel_tol=1e-6):
            raise DataError(f"the record has dt = {data.dt:g} s and the monitor {self.dt:g} s; resample one")
        if data.hold != self.hold:
            raise DataError(
                f"the record has hold={data.hold!r} and the monitor hold={self.hold!r}; build the "
                f"monitor with hold={data.hold!r}"
            )
        # channels in the order of the model
        ordered = record_for(data, match_channels(model, data))
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
        write_file(path, self.__getstate__())

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
        monitor = cls.__new__(cls)
        with damaged(path):
            monitor.__setstate__(read_file(path, laws, "monitor"))
        return monitor

    def __repr__(self) -> str:
        state = "alarm" if self.alarm else ("learning" if self._memory.watched is None else "no alarm")
        return f"<Monitor of {self._base.structure.linear_model.name!r}: {self.n_samples} samples, {state}>"

    def __getstate__(self) -> dict[str, Any]:
        s, m, c = self._base.structure, self._memory, self._course
        names = ("dt", "false_alarms", "learn", "hold", "missing", "tolerance", "candidates")
        base = {"physical": s.model, "effects": s.effects, "constants": s.constants}
        base |= {name: getattr(self._base, name) for name in ("theta", "covariance", "substeps")}
        memory = {name: getattr(m, name) for name in _Memory.__slots__ if name != "watched"}
        memory["healthy"] = None if m.watched is None else m.watched.healthy
        course = {
            "stride": c.stride,
            "rows": c.rows[: c.count].copy(),
            "samples": c.samples[: c.count].copy(),
        }
        settings = {name: getattr(self, name) for name in names}
        return {
            "what": "monitor",
            "layout": _LAYOUT,
            "base": base,
            "settings": settings,
            **memory,
            "course": course,
        }

    def __setstate__(self, content: dict[str, Any]) -> None:
        if content.get("layout") != _LAYOUT:
            raise DataError(
                "this monitor was saved by another version of rcorefine (0.2 or before), which learned other "
                "parameters: build it again and let it learn, or load it with that version"
            )
        # a fresh monitor of the same settings; substeps set the size of loops, so check them first
        settings, base = dict(content["settings"]), content["base"]
        check_like(base["substeps"], 1, "substeps of the model")
        check_range(base["substeps"], 1, MOST_SUBSTEPS, "substeps of the model")
        fresh = Monitor(_Saved(base), settings.pop("candidates"), **settings)
        vars(self).update(vars(fresh))
        self._memory = _restored(self, content)
        self._course = _Timeline.restored(content["course"], self._course, content["count"])

    # ------------------------------------------------------------------ what it says
    @property
    def n_samples(self) -> int:
        """Number of samples taken."""
        return self._memory.count

    @property
    def alarm(self) -> Alarm | None:
        """The alarm that is on, or None."""
        change = self._memory.change
        return None if change is None else change.alarm

    @property
    def past_alarms(self) -> tuple[Alarm, ...]:
        """Alarms that have ended, the last 100."""
        return self._memory.past

    @property
    def adequacy(self) -> Adequacy | None:
        """After learning, how far the model is from the samples.

        `.fit` in percent, `.fit_moved` with the parameters `.moved`, the `.missing` effect, `.adequate`,
        `.sentence` with what to do.
        """
        return self._memory.adequacy

    @property
    def remarks(self) -> tuple[str, ...]:
        """Cautions of the learning phase, one sentence each."""
        found = self._memory.adequacy
        return () if found is None or found.adequate else (found.sentence,)

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
        m = self._memory
        if m.watched is None or m.state is None:
            return ()
        # fits since the change while an alarm is on, otherwise the scores
        if m.change is not None and m.change.rows:
            return m.change.rows
        return linear_rows(m.watched, m.state)

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


class _Timeline:
    """History rows at equal steps.

    When it is full, every other row is dropped and the step doubles.

    Parameters
    ----------
    width : int
        Figures per row.
    stride : int
        Samples between rows to begin with.
    """

    def __init__(self, width: int, stride: int) -> None:
        self.stride = stride
        self.rows: Array = np.zeros((_ROWS, width))
        self.samples: NDArray[np.int64] = np.zeros(_ROWS, dtype=np.int64)
        self.count = 0

    def add(self, sample: int, row: Array) -> None:
        """Keep a row, if it is due."""
        if self.count == _ROWS and sample % self.stride == 0:
            self.stride *= 2
            kept = self.samples % self.stride == 0
            self.count = int(kept.sum())
            self.rows[: self.count], self.samples[: self.count] = self.rows[kept], self.samples[kept]
        if sample % self.stride == 0:
            self.rows[self.count], self.samples[self.count] = row, sample
            self.count += 1

    @classmethod
    def restored(cls, found: Any, fresh: _Timeline, count: int) -> _Timeline:
        """The course of a file, checked against a fresh one."""
        width = fresh.rows.shape[1]
        like = {"stride": 1, "rows": np.full((1, width), np.nan), "samples": np.zeros(1, dtype=np.int64)}
        check_like(found, like, "course", {"rows": "rows", "samples": "rows"})
        check_range(found["stride"], fresh.stride, math.inf, "course.stride")
        check_range(len(found["rows"]), 0, _ROWS, "rows of the course")
        check_range(found["samples"], 0, count, "course.samples")
        course = cls(width, int(found["stride"]))
        course.count = len(found["rows"])
        course.rows[: course.count], course.samples[: course.count] = found["rows"], found["samples"]
        return course


# ------------------------------------------------------------------------ settings
def _structure_of(model: Any, hold: str) -> tuple[Structure, Array, int]:
    """Return structure, coefficients and substeps of the healthy model."""
    refuse_discrete(model)
    structure, theta, substeps = structure_of(model)
    check_stream_hold(structure.model, hold)
    if structure.output_delays:
        raise ModelError(
            f"{structure.effects[structure.output_delays[0][0]].label}: a delay at an output cannot be "
            "estimated on a stream; refine with an input_delay or an output_lag"
        )
    turning = [structure.effects[i] for i, _ in structure.input_statics]
    for effect in (one for one in turning if one.spec.inner_states):
        raise ModelError(
            f"{effect.label}: an input effect with an inner state cannot be part of the healthy "
            "model of a monitor; leave it out, or name it among the candidates"
        )
    return structure, np.asarray(theta, dtype=float), int(substeps)


def _period_of(structure: Structure, theta: Array, dt: float) -> int:
    """Return the period of the first mode in samples, between 8 and 100 000.

    Where nothing swings, it is two time constants of the slowest state.
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


def _checked_candidates(model: Any, given: Sequence[Effect] | None) -> tuple[Effect, ...]:
    """Effects that can be watched for, by default those of the library."""
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
    if len(set(effects)) < len(effects):
        raise ModelError("a candidate is named twice; give each effect once")
    return effects


# ------------------------------------------------------------------------ files
class _Saved:
    """Model with effects at their coefficients, from a file."""

    def __init__(self, content: dict[str, Any]) -> None:
        constants = {int(key): float(value) for key, value in content["constants"].items()}
        self.physical_model = content["physical"]
        self._parts = content["physical"], tuple(content["effects"]), constants
        self._theta, self._substeps = content["theta"], int(content["substeps"])
        self.covariance = content["covariance"]

    def simulation_structure(self) -> tuple[Structure, Any, int]:
        physical, effects, constants = self._parts
        return Structure(physical, effects, constants=constants), self._theta, self._substeps


def _restored(monitor: Monitor, content: Mapping[str, Any]) -> _Memory:
    """Memory of a file, each part checked against a fresh one."""
    base, fresh, count = monitor._base, monitor._memory, content["count"]
    p = base.structure.n_parameters
    check_like(base.theta, np.zeros(p), "coefficients of the model")
    if base.covariance is not None:
        check_like(base.covariance, np.full((p, p), np.nan), "covariance")
    check_like(count, 0, "count")
    check_like(content["latest"], fresh.latest, "latest")
    rows = dict.fromkeys(("inputs", "outputs", "known", "use"), "samples")
    check_like(content["waiting"], fresh.waiting, "waiting", rows)
    waiting = len(content["waiting"].inputs)
    healthy, state, past, change = (content[name] for name in ("healthy", "state", "past", "change"))
    _check_names(monitor, change, past, content["adequacy"])
    if healthy is None:
        check_range(count, waiting, min(waiting, monitor.learn - 1), "count")
        return replace(fresh, count=count, latest=content["latest"], waiting=content["waiting"])
    # sizes from the model, the orders of the noise from the file
    numbers, s = numbers_of(base), base.structure
    sizes = {"p": numbers.theta.size, "n": numbers.structure.n_states, "ny": s.n_outputs}
    sizes |= {"f": np.union1d(numbers.free, numbers.offsets).size, "m": keep_of(monitor._period).size}
    check_schema(healthy, Healthy, sizes, "healthy")
    check_range(sizes["q"], 1, MAX_ORDER + 1, "orders of the noise")
    check_range(healthy.filters[:, 0], 1.0, 1.0, "filters")
    watched = WatchedModel(
        base, numbers, healthy, monitor.candidates, monitor._period, monitor.false_alarms, monitor.learn
    )
    check_like(state, begin(watched), "state", {"before": "rows"})
    check_range(len(state.before), 0, watched.lag, "rows of state.before")
    for name in ("level", "ring_scale"):
        check_range(getattr(state, name), 1e-150, math.inf, f"state.{name}")
    check_range(state.lost, -1, count, "state.lost")
    check_range(waiting, 0, watched.block - 1, "samples that wait")
    check_range(count, monitor.learn, math.inf, "count")
    check_range(state.blocks * watched.block + waiting, count, count, "blocks and samples that wait")
    return _Memory(
        count, content["latest"], content["waiting"], watched, state, change, past, content["adequacy"]
    )


def _check_names(monitor: Monitor, change: Any, past: Any, adequacy: Any) -> None:
    """Refuse an alarm or a ranking of other effects than the candidates."""
    for part, kind in ((change, Change | None), (adequacy, Adequacy | None), (past, tuple)):
        if not isinstance(part, kind):
            raise DataError(f"{part!r:.80} is no {kind}: the file is damaged")
    found: list[Any] = [*past]
    if change is not None:
        fields = "crossed", "look", "follow", "since", "statistic", "threshold"
        nothing = Change(0, 0.0, 0.0, 0, 0, 0)
        for name in fields:
            check_like(getattr(change, name), getattr(nothing, name), f"change.{name}")
        found += [*change.rows, *filter(None, [change.alarm])]
        effects = [row.effect for row in change.rows if type(row) is MonitorRow]
        if change.rows and sorted(map(repr, effects)) != sorted(map(repr, monitor.candidates)):
            raise DataError("change.rows are not the candidates: the file is damaged")
    for part in found:
        if type(part) not in (Alarm, MonitorRow) or part.effect not in monitor.candidates:
            raise DataError(f"{part!r:.80} is of none of the candidates: the file is damaged")
        own = [name for name in part.coefficients if name in part.effect.free]
        for name in ("coefficients", "std"):
            check_like(getattr(part, name), dict.fromkeys(own, math.nan), name)
