"""Learning phase of the monitor, and adequacy of the healthy model in it."""

from __future__ import annotations

import math
import textwrap
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import control as ct
import numpy as np
from scipy.optimize import brentq

from ...arguments import as_list
from ...comparison.signals import fit_percent
from ...data.channels import match_channels, record_for
from ...data.measurement import Measurement
from ...data.records import as_record
from ...effects.effect import Effect
from ...engine.engine import Engine
from ...engine.initial_state import estimate_initial_state
from ...engine.structure import Structure
from ...exceptions import DataError
from ...inference.covariance import standard_deviations
from ...inference.levels import levels
from ...inference.parameters import nominal_size
from ...results import Row
from ...systems.linear import Array, LinearModel
from ..samples import Block, as_size
from .bank import Bank, build_bank
from .baseline import FREE, Healthy, Numbers, Phase, check_outputs, gain_of, numbers_of, offset, settled
from .stream import Observer, Stream, Windows
from .watching import linear_estimates, watch_block

if TYPE_CHECKING:
    from .monitor import Monitor


_SHOWN = 3  # numbers in the sentence


@dataclass(frozen=True, slots=True)
class Adequacy(Row):
    """Adequacy of the healthy model after the learning phase.

    It is the value of `Monitor.adequacy`.

    Attributes
    ----------
    fit : tuple of float
        Of each output by the model as it was given, in percent: 100 (1 - |y - yh| / |y - mean y|) of
        the free run; of the prediction one sample ahead where the model has no free run.
    fit_moved : tuple of float
        The same with the numbers of the model moved to where the samples want them.
    moved : dict
        Number and its relative change, those that were moved by more than 3 standard deviations.
    missing : Effect or None
        Candidate for which what is left asks.
    score : float
        How many standard deviations that is.
    adequate : bool
        Whether no candidate is missing and no number was moved by more than twice the tolerance.
    sentence : str
        All that in words, with the line of code that comes first where it is not adequate.
    """

    fit: tuple[float, ...]
    fit_moved: tuple[float, ...]
    moved: dict[str, float]
    missing: Effect | None
    score: float
    adequate: bool
    sentence: str

    def __str__(self) -> str:
        return textwrap.fill(self.sentence, 80)


def explained(numbers: Numbers, phase: Phase, gain: Array) -> Array:
    """Return the fit of each output in percent, shape (n_y,).

    It is that of the free run if there is one.
    """
    theta, data, there = numbers.theta, phase.data, phase.use > 0
    # a stable model runs free, another one with the observer
    free = gain_of(numbers, data, 0.0)[1] <= FREE
    engine = Engine(numbers.structure, data, substeps=numbers.substeps)
    K = None if free or not gain.any() else gain
    x0 = estimate_initial_state(engine, theta, gain=K, use=there)
    run = engine.run(theta, x0, sensitivity=False, gain=K, use=there, check=False)
    # fit of each output over the samples that were measured
    rows = zip(data.outputs, run.outputs, there.T, strict=True)
    return np.array([fit_percent(y[known], yh[known]) for y, yh, known in rows])


def adequacy_of(
    stream: Stream, given: Numbers, numbers: Numbers, tolerance: float, fits: tuple[Array, Array], dt: float
) -> Adequacy:
    """Judge the healthy model by the samples that were learned from.

    Parameters
    ----------
    stream : Stream
        After these samples.
    given, numbers : Numbers
        As they were, and as they were moved.
    tolerance : float
        Relative standard deviation of the numbers.
    fits : tuple of two ndarray, each of shape (n_y,)
        `explained` before and after.
    dt : float
        Sampling time [s].

    Returns
    -------
    Adequacy
    """
    # which parameters moved by more than their uncertainty, relative to their size
    change = (numbers.theta - given.theta)[numbers.loose]
    clear = np.abs(change) > levels().moved * standard_deviations(numbers.covariance)
    moved: dict[str, float] = {}
    for (effect, name), value, theta, seen in zip(
        numbers.moving, change, given.theta[numbers.loose], clear, strict=True
    ):
        size = nominal_size(numbers.structure, effect) or abs(float(theta))
        if seen and size > 0:
            moved[effect.label if len(effect.free) == 1 else f"{effect.label}: {name}"] = float(value) / size
    # is a candidate above the threshold already in the learning phase?
    _, _, gains = linear_estimates(stream, 0)
    best = int(np.argmax(gains))
    score = math.sqrt(2 * max(float(gains[best]), 0.0))
    lacks = score >= stream.windows.levels[-1]
    missing = stream.bank.effects[stream.bank.owner[best]] if lacks else None
    # a shift far beyond the tolerance, too, means that the model is not adequate
    far = max(map(abs, moved.values()), default=0.0) > levels().moved_wide * tolerance > 0
    before, after = (tuple(map(float, fit)) for fit in fits)
    sentence = _sentence(before, after, moved, missing, score, far, dt)
    return Adequacy(before, after, moved, missing, score, missing is None and not far, sentence)


def _sentence(
    before: tuple[float, ...],
    after: tuple[float, ...],
    moved: dict[str, float],
    missing: Effect | None,
    score: float,
    far: bool,
    dt: float,
) -> str:
    # first the fits, then the largest changes, then what is missing, then the next step
    figures = [" and ".join(f"{percent:.1f} %" for percent in fit) for fit in (before, after)]
    sentence = f"The model explains {figures[0]} of the learning phase."
    if moved:
        largest = sorted(moved, key=lambda name: -abs(moved[name]))[:_SHOWN]
        by = ", ".join(f"{name} by {100 * moved[name]:+.2g} %" for name in largest)
        by += ", ..." if len(moved) > _SHOWN else ""
        sentence += f" With re-estimated parameters ({by}) it explains {figures[1]}."
    if missing is None and not far:
        return sentence + " The residual cannot be distinguished from noise: the model is adequate."
    effects = "" if missing is None else f"[rco.Effect({missing.kind!r}, {missing.place!r})], "
    if missing is not None:
        sentence += (
            f" {missing.label} or a similar effect is missing ({score:.0f} standard deviations). Changes "
            "that resemble it are detected late."
        )
    else:
        sentence += " The changes are larger than the tolerance allows."
    return (
        sentence + f" Next: better = rco.refine(model, healthy_record, {effects}free='linear'), then "
        f"rco.Monitor(better, dt={dt:.6g})."
    )


PER = 100_000  # samples to which `false_alarms` refers
BLOCKS = 256  # blocks of samples that are kept
_SLOW = 16  # periods of the mean that is taken off


def learned(monitor: Monitor, block: Block) -> tuple[Stream, Adequacy]:
    """Learn parameters, noise and columns from the first samples.

    These samples are then monitored like any others.

    Parameters
    ----------
    monitor : Monitor
        Its settings, watch and course.
    block : Block
        Samples of the learning phase.
    """
    # learning needs every input
    if not block.known.all():
        sample = int(np.argmin(block.known))
        raise DataError(
            f"an input is missing at sample {sample}, in the learning phase of {len(block.inputs)} samples; "
            "start the stream where the inputs are whole"
        )
    # prior of the parameters from the model and the tolerance
    data = Measurement(block.inputs.T, block.outputs.T, dt=monitor.dt, hold=monitor.hold)
    phase = Phase(data, block.use, monitor.disturbance, monitor._period)
    given = numbers_of(
        monitor._structure, monitor._theta, monitor._substeps, monitor._covariance, monitor.tolerance
    )
    check_outputs(given.structure, phase)
    # offsets first, or observer and parameters would follow them
    given = offset(given, phase)
    # noise and parameters by alternation, then the columns of all candidates
    numbers, healthy = settled(given, phase)
    bank = build_bank(numbers, monitor.candidates, data, monitor.hold, healthy.gain)
    stream = stream_of(monitor, numbers.structure, numbers.theta, healthy, bank)
    stream = replace(stream, bank=replace(bank, root=_root_as_seen(stream, block)), memory={})
    # the same samples run through the windows, which calibrates the statistics
    watch_block(stream, monitor._watch, monitor._course, block)
    before, after = (explained(at, phase, healthy.gain) for at in (given, numbers))
    return stream, adequacy_of(stream, given, numbers, monitor.tolerance, (before, after), monitor.dt)


def _root_as_seen(stream: Stream, block: Block) -> Array:
    """Return a root of the covariance of the numbers that fits their columns.

    Columns approximate: beside little noise they react to a change that the model does not feel at all, such
    as the same factor on all masses and springs. No direction is left less certain than they find it.
    """
    bank = stream.bank
    probe = replace(
        stream,
        bank=replace(bank, watched=bank.size),
        windows=replace(stream.windows, keep=np.ones(1), levels=np.ones(1)),
        memory={},
    )
    while probe.n_samples < len(block.inputs):
        rest = block.part(probe.n_samples, len(block.inputs))
        probe.advance(rest.inputs, rest.outputs, rest.use, rest.known, stop=False)
    # R' S R with the sum S of the products of sensitivities: at most 1 for the posterior R R'
    values, vectors = np.linalg.eigh(bank.root.T @ probe.memory["shared"][0, bank.numbers])
    return np.asarray(bank.root @ (vectors / np.sqrt(np.maximum(values, 1.0))))


def stream_of(monitor: Monitor, structure: Structure, theta: Array, healthy: Healthy, bank: Bank) -> Stream:
    """Stream of a monitor, from what it has learned."""
    # forgetting factor of each window, threshold of each from the rate of false alarms
    keep = 1.0 - 1.0 / monitor._lengths
    heights = threshold(monitor.false_alarms / PER, keep, bank.watched)
    windows = Windows(keep, heights, monitor._block, BLOCKS, 1.0 / (_SLOW * monitor._period))
    observer = Observer(structure, theta, monitor.dt, monitor.hold, monitor._substeps, healthy.gain)
    return Stream(observer, healthy, bank, windows, monitor.learn)


def record_to_watch(model: LinearModel, dt: float, hold: str, data: Any) -> Measurement:
    """Return a record in the order of the model's channels.

    It must have the sample time and the hold of the stream.
    """
    data = as_record(data)
    # same sampling time, same hold, channels by name
    if not math.isclose(data.dt, dt, rel_tol=1e-6):
        raise DataError(f"the record has dt = {data.dt:g} s and the monitor {dt:g} s; resample one")
    if data.hold != hold:
        raise DataError(
            f"the record has hold={data.hold!r} and the monitor hold={hold!r}; build the "
            f"monitor with hold={data.hold!r}"
        )
    return record_for(data, match_channels(model, data))


_LONGEST = 200  # periods in the longest window


def window_lengths(windows: tuple[int, int] | None, period: int) -> Array:
    """Return the samples in each window, doubled from one to the next.

    `period` is that of the first mode.
    """
    # from a quarter of the first mode's period to 200 periods
    if windows is None:
        shortest, longest = max(8, period // 4), _LONGEST * period
    else:
        pair = as_list(windows, "windows", "two sizes, the shortest first")
        if len(pair) != 2:
            raise ct.ControlDimension(f"windows has {len(pair)} entries; give the shortest and the longest")
        shortest = as_size(pair[0], "windows[0]", 4, "samples in the shortest window")
        longest = as_size(pair[1], "windows[1]", shortest, "samples in the longest window")
    # doubled from one to the next
    count = max(1, round(math.log2(longest / shortest)) + 1)
    return np.asarray(shortest * 2.0 ** np.arange(count))


def crossing_rate(level: float, keep: float) -> float:
    """Return the rate per sample of chance crossings of a level.

    The rate is that of one windowed statistic.

    Parameters
    ----------
    level : float
        Level of the absolute value of the statistic, which has unit variance.
    keep : float
        Share that the window keeps per sample, so that the correlation of the
        statistic over a lag of h samples is ``keep**h``.

    Returns
    -------
    float
        Expected number of crossings (clusters of them) per sample.

    Notes
    -----
    The statistic is a sampled Ornstein-Uhlenbeck process; a high level b is
    crossed at the rate ``2 c b phi(b)`` with c = -ln(keep) (Pickands), thinned by
    Siegmund's ``exp(-0.583 b sqrt(2 c))`` because the process is not seen between
    samples, and never more often than single samples lie above it.

    References
    ----------
    D. Siegmund, Sequential Analysis, Springer 1985, chapters IV and VIII.

    Examples
    --------
    >>> 0.9 < crossing_rate(4.0, 0.99) / 7.1e-6 < 1.1
    True
    """
    # statistic of a forgetting window: autocorrelation exp(-c |k|)
    c = -math.log(keep)
    density = math.exp(-0.5 * level * level) / math.sqrt(2 * math.pi)
    # clusters of crossings of a Gaussian process, corrected for discrete time (Siegmund)
    clusters = 2 * c * level * density * math.exp(-0.583 * level * math.sqrt(2 * c))
    # never more than the chance of a single sample
    return min(clusters, math.erfc(level / math.sqrt(2)))


def threshold(rate: float, keep: Array, columns: int) -> Array:
    """Levels of the statistic for each window, the rate shared out evenly.

    Parameters
    ----------
    rate : float
        Expected false alarms per sample, all columns and windows together.
    keep : ndarray, shape (M,)
        Share that each window keeps per sample.
    columns : int
        Number of columns; their rates add up at most (Bonferroni).

    Returns
    -------
    ndarray, shape (M,)
        Levels.
    """
    # equal share of the false alarms for each column and window
    goal = math.log(rate / (columns * keep.size))

    def excess(level: float, share: float) -> float:
        return math.log(max(crossing_rate(level, share), 1e-300)) - goal

    # crossing rate = share, solved for the level
    return np.array([brentq(excess, 1.5, 30.0, args=(float(share),), xtol=1e-6) for share in keep])
