"""Starting values: shapes of effects and scans of coefficients.

The shapes follow from the motion; the scans reach distant values.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.signal import fftconvolve, find_peaks, welch

from ..data.measurement import Measurement
from ..data.response_record import ResponseRecord
from ..data.signals import difference, over_time
from ..engine.amplitude_response import channel_signal, engine_on, port_phasors, sampled
from ..engine.engine import Engine
from ..engine.observer import existing_gain
from ..engine.structure import Structure
from ..models.operating_point import sensed
from ..models.physical_model import PhysicalModel
from ..systems.linear import Array
from .problem import Problem

_MOST_DRIFT, _DRIFTS = 0.02, 300  # largest relative drift of the clocks; candidates on each side
_SLIP = 0.5  # phase difference in radians between candidates, at the end of the record


@np.errstate(invalid="ignore")  # without motion the correlation is NaN
def growing_lags(structure: Structure, records: Sequence[Measurement]) -> list[float]:
    """Return the share of time by which outputs precede the simulation.

    A fit has no gradient beyond a phase error of half a period, so a scan tries every share.

    Parameters
    ----------
    structure : Structure
        Model.
    records : sequence of Measurement
        Records.

    Returns
    -------
    list of float
        Empty where the free run does not move, or has no bounds.
    """
    pairs = [pair for record in records for pair in _free_run(structure, record)]
    # phase error at the end of the record per unit of drift, in radians
    slips = [float(t[-1] * np.std(np.gradient(x, t)) / np.std(x)) for t, _, x in pairs]
    if not slips:
        return []
    # steps of half a radian; the share with the highest correlation
    step = _SLIP / max(slips)
    most = min(int(_MOST_DRIFT / step), _DRIFTS)
    tried = step * np.arange(-most, most + 1)
    alike = [[np.corrcoef(y, np.interp(t * (1 + s), t, x))[0, 1] for t, y, x in pairs] for s in tried]
    return [float(tried[int(np.argmax(np.nansum(alike, axis=1)))])]


def _free_run(structure: Structure, record: Measurement) -> list[tuple[Any, ...]]:
    """Return times, record and free run of each output that moves.

    There is none where the free run has no bounds.
    """
    run = Engine(structure, record).run(np.zeros(structure.n_parameters), sensitivity=False, check=False)
    if run.blew_up >= 0 or not np.isfinite(run.outputs).all():
        return []
    # time since the recording began
    passed = record.elapsed + record.dt * np.arange(record.n_samples)
    # a sample that was not measured correlates with nothing
    level = over_time(np.mean, record.outputs)[:, None]
    pairs = zip(np.where(np.isnan(record.outputs), level, record.outputs), run.outputs, strict=True)
    return [(passed, y, free) for y, free in pairs if np.ptp(y) > 0 < np.ptp(free)]


def common_lag(structure: Structure, record: Measurement) -> float:
    """Return the time [s] by which the outputs lag behind the simulation.

    It is the lag of the highest correlation, and at most a third of the record.

    Parameters
    ----------
    structure : Structure
        Model.
    record : Measurement
        Record.

    Returns
    -------
    float
        0 where the free run does not move, or has no bounds.
    """
    # correlation over all outputs
    alike = sum(np.abs(_correlations(y, x, y.size // 3)) for _, y, x in _free_run(structure, record))
    return record.dt * int(np.argmax(alike))


def _correlations(late: Array, early: Array, count: int) -> Array:
    """Return the correlation coefficient at each of the first lags.

    At lag k it is that of ``late[k:]`` and ``early[:N - k]``.
    """
    # x in reverse, so that sums over the overlap are cumulative
    y, x = late - late.mean(), early[::-1] - early.mean()
    size = y.size - np.arange(count)

    def left(part: Array) -> Array:
        return np.asarray(np.cumsum(part[::-1])[::-1][:count])

    # covariance at each lag by FFT, with the mean of the overlapping part removed
    both = fftconvolve(y, x)[y.size - 1 :][:count] - left(y) * left(x) / size
    # variances of both overlapping parts
    powers = [np.maximum(left(s * s) - left(s) ** 2 / size, _ROUNDING * (s @ s)) for s in (y, x)]
    return np.asarray(both / np.sqrt(powers[0]) / np.sqrt(powers[1]))


_ROUNDING = 1e-12  # share of a power that is rounding
_AT_REST = 0.01  # share of the largest rms velocity below which a record is at rest
_MOST_STARTS = 24


class Motion:
    """Displacement and velocity at the places, estimated by an observer."""

    def __init__(self, structure: Structure, theta: Array, data: Measurement, ratio: float = 1.0) -> None:
        # states of an observer along the record
        engine = Engine(structure, data)
        gain = existing_gain(structure, theta, data, ratio)
        run = engine.run(theta, sensitivity=False, gain=gain, histories=True, check=False)
        self.data: Any = data
        self.states = np.nan_to_num(run.states)
        self.residual: Array | NDArray[np.complex128] = -difference(np.nan_to_num(run.outputs), data.outputs)
        self.companions: list[Motion] = []  # the same system in other records
        self._structure = structure

    def port(self, name: str) -> tuple[Array, Array]:
        """Displacement and velocity, each of shape (N,), at one port."""
        return sensed(self._structure.model, name, self.states, self.data.inputs)

    def channel(self, place: str, at_input: bool) -> Array:
        """Return the samples that were measured at an input or output."""
        data, linear = self.data, self._structure.linear_model
        labels, rows, first = linear.output_labels, data.outputs, data.n_inputs
        if at_input:
            labels, rows, first = linear.input_labels, data.inputs, 0
        channel = labels.index(place)
        return np.asarray(rows[channel][~np.isnan(rows[channel])] + data.origin[first + channel])

    def spectrum(self) -> tuple[Array, Array]:
        """Return frequencies in rad/s and the power of the residual there."""
        left = self.residual - self.residual.mean(axis=1, keepdims=True)
        hertz, power = welch(left, fs=1.0 / self.data.dt, nperseg=min(1024, left.shape[1]))
        return 2 * np.pi * hertz[1:], power.mean(axis=0)[1:]

    def lag(self, model: PhysicalModel) -> float:
        """Return the time in s by which the outputs lag behind a model."""
        return common_lag(Structure(model), self.data)

    def drifts(self, model: PhysicalModel) -> list[float]:
        """Return the likely relative errors of the clock of the outputs."""
        return growing_lags(Structure(model), [motion.data for motion in (self, *self.companions)])


class ResponseMotion(Motion):
    """Motion at the places for a frequency response.

    It follows from the response and the model together, one sine after the other.

    Attributes
    ----------
    data : ResponseRecord
        The response.
    residual : complex ndarray, shape (n_y, n_w, n_omega)
        What the model leaves of it, in units of its noise.
    """

    def __init__(self, structure: Structure, theta: Array, data: ResponseRecord) -> None:
        self.data = data
        self.companions: list[Motion] = []
        # residual of the response in units of its noise
        run = engine_on(structure, data).run(theta, sensitivity=False)
        self.residual = data.points((data.outputs - run.outputs) / data.noise)
        self._structure, self._theta = structure, theta

    def port(self, name: str) -> tuple[Array, Array]:
        """Return displacement and velocity at one place.

        They are sampled over one period of each sine.
        """
        d, v = port_phasors(self._structure, self._theta, self.data, name)
        return sampled(d), sampled(v)

    def channel(self, place: str, at_input: bool) -> Array:
        """Return a period of each sine at an input or output."""
        return channel_signal(self._structure.linear_model, self.data, place, at_input)

    def spectrum(self) -> tuple[Array, Array]:
        """Return the frequencies and the power of the residual."""
        return self.data.omega, np.mean(np.abs(self.residual) ** 2, axis=(0, 1))

    def lag(self, model: PhysicalModel) -> float:
        """Return 0: a response has no start."""
        return 0.0

    def drifts(self, model: PhysicalModel) -> list[float]:
        """Return none: a response has no clock."""
        return []


def estimated_motion(structure: Structure, theta: Array, data: Any) -> Motion:
    """Motion at the ports as the record and the model together see it.

    Parameters
    ----------
    structure : Structure
        Model, as far as it is known.
    theta : ndarray, shape (p,)
        Coefficients.
    data : Measurement or ResponseRecord
        Record.

    Returns
    -------
    Motion
    """
    return (Motion if data.in_time else ResponseMotion)(structure, theta, data)


def law_widths(structure: Structure, motion: Motion) -> dict[int, float]:
    """Return the smoothing width of each effect that has one.

    It is a small share of the motion at the place of the effect.

    Parameters
    ----------
    structure : Structure
        Model with the effects.
    motion : Motion
        Estimated motion at the ports; of several records the quietest counts.

    Returns
    -------
    dict
        ``{index of the effect: width}``.
    """
    widths: dict[int, float] = {}
    motions = [motion, *motion.companions]
    for index in structure.port_effects:
        effect = structure.effects[index]
        share = effect.spec.width_share
        if share is not None:
            # width: the user's, else a share of the rms velocity
            given = (effect.fixed or {}).get("width")
            speeds = np.array([np.sqrt(np.mean(m.port(effect.place)[1] ** 2)) for m in motions])
            # the record with the smallest motion decides
            rms = float(speeds[speeds >= _AT_REST * speeds.max()].min())
            widths[index] = float(given) if given is not None else share * rms or 1.0
    return widths


def shape_starts(structure: Structure, theta: Array, motion: Motion, first: int = 0) -> list[Array]:
    """Return starting points for the shape coefficients of effects.

    These are gaps, delays, limits and the like.

    Parameters
    ----------
    structure : Structure
        Model with the effects.
    theta : ndarray, shape (p,)
        Default start; user's own starts are kept.
    motion : Motion
        Estimated motion at the ports.
    first : int
        First of the effects whose shape is open; those before it keep theirs.

    Returns
    -------
    list of ndarray
        Points to try, the default first where nothing needs a shape.
    """
    joint: list[list[list[tuple[int, float]]]] = []
    for index, effect in enumerate(structure.effects[first:], first):
        given = effect.start or {}
        # free coefficients without a value from the user
        wanted = {
            name: structure.position(index, name)
            for name in effect.coefficients
            if structure.position(index, name) >= 0 and name not in given
        }
        # values that the record suggests, one row for each shape
        options = effect.spec.starts(_Seen(structure, index, motion))
        rows = []
        for option in options:
            row = [(wanted[name], value) for name, value in option.items() if name in wanted]
            if row and row not in rows:
                rows.append(row)
        if rows:
            joint.append(rows)
    starts = []
    # all combinations of the shapes of the effects
    for combination in itertools.islice(itertools.product(*joint), _MOST_STARTS):
        point = theta.copy()
        for column, value in itertools.chain.from_iterable(combination):
            point[column] = value
        starts.append(point)
    return starts or [theta.copy()]


class _Seen:
    """Information in a record about the place of an effect.

    It is computed on demand; see `Seen`.
    """

    def __init__(self, structure: Structure, index: int, motion: Motion) -> None:
        self._structure, self._motion = structure, motion
        self._place, self._law = structure.effects[index].place, structure.effects[index].spec
        self.dt = motion.data.dt

    @property
    def signal(self) -> Array:
        return self._motion.channel(self._place, "input" in self._law.where)

    @cached_property
    def _port(self) -> tuple[Array, Array]:
        return self._motion.port(self._place)

    @property
    def d(self) -> Array:
        return self._port[0]

    @property
    def v(self) -> Array:
        return self._port[1]

    @property
    def peaks(self) -> Array:
        # the three most prominent peaks
        frequency, power = self._motion.spectrum()
        found, info = find_peaks(np.log(power + 1e-300), prominence=0.5)
        return np.asarray(frequency[found[np.argsort(info["prominences"])[::-1][:3]]])

    @property
    def lag(self) -> float:
        return self._motion.lag(self._structure.model)

    @property
    def drifts(self) -> list[float]:
        return self._motion.drifts(self._structure.model)

    @property
    def pull(self) -> float:
        # inertia times rms acceleration
        inertia = self._structure.inertia(self._place)
        return inertia * float(np.std(np.gradient(self.v, self.dt))) if np.isfinite(inertia) else 1.0

    @property
    def mobility(self) -> float:
        return float(np.abs(self._structure.model.port(self._place).act).max())


def far_starts(problem: Problem, structure: Structure, theta: Array) -> list[Array]:
    """Coefficients far from the model's, found by scanning each over decades.

    A parameter that is wrong by orders of magnitude can have no gradient at all (an
    inductance so small that the current settles within a sample).

    Parameters
    ----------
    problem : Problem
        Short problem in which to judge.
    structure : Structure
        Model with the effects.
    theta : ndarray, shape (p,)
        Where to scan from.

    Returns
    -------
    list of ndarray
        The best point of a coordinate-wise scan, empty where nothing can be scanned.
    """
    # elements of unknown size: springs, dampers, masses without a declared tolerance
    nominal = {(q.kind, q.place): abs(q.value) for q in structure.model.parameters}
    columns = []
    for i, parameter in enumerate(structure.parameters):
        effect = structure.effects[parameter.effect]
        size = nominal.get((effect.kind, effect.place), 0.0)
        if effect.spec.inertial:
            size = structure.inertia(effect.place)
        known = problem.prior_sd[i] < size  # a declared tolerance: no scan needed
        if effect.spec.is_element and 0 < size < np.inf and not known:
            columns.append((i, size))
    if not columns:
        return []
    # scan each coefficient over ten decades, one after the other, three times at most
    factors = np.logspace(-5, 5, 21)
    points = []
    for base in (theta, structure.start()):
        point = base.copy()
        best = _free_run_cost(problem, point)
        for _ in range(3):
            before = best
            for i, size in columns:
                for value in size * (factors - 1.0):
                    trial = point.copy()
                    trial[i] = max(value, structure.parameters[i].lower)
                    cost = _free_run_cost(problem, trial)
                    if cost < best:
                        best, point = cost, trial
            if best > 0.99 * before:
                break
        points.append(point)
    return points


def _free_run_cost(problem: Problem, theta: Array) -> float:
    # sum of squares of the free run from rest
    total = 0.0
    for engine in problem.engines:
        run = engine.run(theta, sensitivity=False, check=False)
        if run.blew_up >= 0 or not np.isfinite(run.outputs).all():
            return np.inf
        total += float(np.sum((problem.weights[:, None] * difference(run.outputs, engine.data.outputs)) ** 2))
    return total
