"""Checks of each output against the simulation.

They cover sign, units, gain, delay, drift, spikes, rectification and stops. A factor between record and model
may look like a conversion of units.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from itertools import pairwise, permutations
from typing import NamedTuple

import numpy as np
from scipy.linalg import block_diag
from scipy.signal import correlate

from ..comparison.result import Comparison
from ..data.measurement import Measurement
from ..data.records import clipped, coarse_noise, resolution
from ..data.signals import over_time
from ..inference.f_tests import project, rank_basis
from ..inference.whitening import autoregression
from ..models.operating_point import OperatingPoint
from ..results import counted, with_error
from ..systems.conversion import to_discrete
from ..systems.linear import Array, LinearModel
from .check_rows import LOOK, OK, STOP, CheckRow

_BLOCKS = 12
_SURE = 4.0  # standard deviations
_LEAST = 0.03  # of a gain that is worth a word
_FAR = 5.0  # a factor that parameters seldom make
_RELATED = 0.3  # correlation below which no gain is read
_CLEAR, _SAME = 0.8, 0.97  # the same for a sign, and for a unit of a size that dynamics could make
_SPIKE = 8.0  # robust standard deviations from the samples before and after
_NORMAL = 1.4826  # standard deviation over the median absolute deviation, for normal noise
_SMALL = 1e-4  # of an output's size: what is smaller carries no error
_LATER = 20.0  # log-likelihood by which a delay must win
_MOVED = 1e-9  # of a run: what inputs move less than this is rounding
_EXPLAINED = 0.9  # of the error's energy: a gain that explains less is not alone
_PART, _TELLS = 0.25, 0.01  # of what a plain gain leaves; of the samples, that tell a level from a start
_OTHER_SIGN = 0.01  # of a signal's energy: with less of it, the signal has one sign
_END, _MUCH_THERE, _OFTENER = 0.02, 0.05, 3.0  # of the range; of the samples; times as much as is usual


class _Gain(NamedTuple):
    """Gain of the record relative to the simulation, with its details.

    The fields are the value, its standard error, the correlations with and without the delay, the delay in
    samples, the share of the error's energy that the gain alone explains, and the remainder.
    """

    value: float
    std: float
    correlation: float
    undelayed: float
    delay: int
    share: float
    left: Array

    @property
    def alone(self) -> bool:
        """True if only the gain differs: dynamics change a size, too."""
        return self.share > _EXPLAINED

    def meets(self, known: float) -> bool:
        """Return whether the gain is a known one within its error."""
        return abs(self.value / known - 1.0) <= max(_SURE * self.std / known, _LEAST)


def gain_rows(compared: Comparison, units: Sequence[str]) -> Iterator[CheckRow]:
    """Rows on each output beside the free run of the model.

    Parameters
    ----------
    compared : Comparison
        Model on the record.
    units : sequence of str
        Units that the model declares for these outputs; empty for none.

    Yields
    ------
    CheckRow
    """
    data, linear = compared.data, compared.models[0]
    free = settling(linear, data.dt, [*compared.starts, data.n_samples])
    ends = np.cumsum([part.shape[1] for part in free])[:-1]
    for i, (label, signal) in enumerate(zip(data.output_labels, data.outputs, strict=True)):
        known = ~np.isnan(signal)
        y, simulated = signal[known], compared.runs[0, i, known]
        # what an initial state adds is fitted beside the gain: with a wrong gain its estimate is wrong too
        motions = zip(free, compared.initial_states[0], strict=True)
        settled = np.concatenate([part[i] @ x0 for part, x0 in motions])
        run = simulated - settled[known]
        least = _MOVED * float(np.linalg.norm(run) + np.linalg.norm(settled[known]))
        begun = [part[i, mine] for part, mine in zip(free, np.split(known, ends), strict=True)]
        nuisances = [np.column_stack([part, np.ones(len(part))]) for part in begun]
        found = _gain(y, run, nuisances, least, y.size == signal.size)
        if not np.ptp(y) or found is None:
            continue
        declared = (data.output_units[i], units[i] if units else "")
        yield from _unit_row(found, data, i, declared[1])
        bent = _bent_row(label, y, simulated, data.inputs[:, known], begun[0])
        if bent is not None:  # gain and delay would only follow from that
            yield bent
            continue
        yield from _delay_row(label, found, data.dt)
        yield from _gain_row(label, found, *declared)
        if abs(found.correlation) >= _RELATED:
            if len(free) == 1:  # where a model integrates, an initial state is an offset
                yield from _drift_row(label, found.left, y, data.timepts[known])
            yield from _spike_row(label, found.left, max(resolution(y), _SMALL * float(y.std())))


def settling(linear: LinearModel, dt: float, edges: list[int]) -> list[Array]:
    """Free responses of each state in each window, (n_y, N, n)."""
    # free responses C Phi^k
    step, most = to_discrete(linear, dt).A, int(np.diff(edges).max())
    rows = np.empty((most, *linear.C.shape))
    rows[0] = linear.C
    for k in range(1, most):
        rows[k] = rows[k - 1] @ step
    whole = rows.transpose(1, 0, 2)
    return [whole[:, : j - i] for i, j in pairwise(edges)]


def _gain(y: Array, run: Array, nuisances: list[Array], least: float, whole: bool) -> _Gain | None:
    """Fit the gain of the record relative to the simulation.

    This is a least-squares fit together with the free responses. The standard error comes from the spread
    over blocks, so the noise may be colored. None where the inputs move the run by less than `least`. A delay
    may not turn the sign that the record has without it, where it has one. It is looked for in signals that
    are whole.
    """
    n = y.size
    ends = np.cumsum([len(part) for part in nuisances])[:-1]
    bases = [rank_basis(part) for part in nuisances]

    def without(row: Array) -> Array:
        return np.concatenate([project(part, q) for part, q in zip(np.split(row, ends), bases, strict=True)])

    # project out initial state and level, window by window
    a, b = without(run), without(y)
    if np.linalg.norm(a) <= least:
        return None
    # cross-correlation over lags up to a tenth of the record
    both = correlate(b, a, mode="full", method="fft") / (np.linalg.norm(a) * np.linalg.norm(b) or 1.0)
    reach = min(n // 10, 200) * whole
    near = both[n - 1 - reach : n + reach]
    now = float(near[reach])
    best = int(np.argmax(np.abs(near) if abs(now) < _RELATED else np.sign(now) * near)) - reach
    then = float(near[best + reach])
    # log-likelihood ratio of the best lag against none
    later = 0.5 * n * np.log(max(1 - now**2, 1e-12) / max(1 - then**2, 1e-12))
    delay = best if later > _LATER and abs(then) > _RELATED else 0
    moved = run[np.clip(np.arange(n) - delay, 0, n - 1)]
    a = without(moved)
    # gain by least squares, and the share of the error that it explains
    value = float(a @ b) / float(a @ a)
    left = b - value * a
    share = 1.0 - float(left @ left) / max(float((b - a) @ (b - a)), 1e-300)
    std = float(np.linalg.norm([*_scores(a, left, bases)])) / float(a @ a)
    rest = zip(np.split(y - value * moved, ends), nuisances, strict=True)
    level = [row - part[:, :-1] @ np.linalg.lstsq(part, row)[0][:-1] for row, part in rest]
    return _Gain(value, std, then if delay else now, now, delay, share, np.concatenate(level))


def _scores(a: Array, left: Array, bases: list[Array]) -> Iterator[float]:
    """Yield the score of a gain in each block.

    What the fit took there is given back, as by the jackknife (Bell and McCaffrey, Survey Methodology 28
    (2002) 169).
    """
    taken = np.column_stack([block_diag(*bases), a / np.linalg.norm(a)])
    parts = (np.array_split(rows, _BLOCKS) for rows in (a, left, taken))
    for one, rest, q in zip(*parts, strict=True):
        # a transient within one block is not felt by the others
        felt = np.eye(q.shape[1]) - q.T @ q
        yield float(one @ (rest + q @ np.linalg.lstsq(felt, q.T @ rest, rcond=1e-6)[0]))


def _bent_row(label: str, y: Array, run: Array, inputs: Array, begun: Array) -> CheckRow | None:
    """Return a row on a rectified output or one at its limits, or None.

    Such an output never changes sign, or rests at both ends of its range. No gain explains that. Where a
    model integrates, the level of its output, and with it the sign, is that of its initial state.
    """
    spread = np.ptp(y)
    shapes = np.array([run, abs(run), run.clip(0), run.clip(None, 0), y])
    shapes -= shapes.mean(axis=1, keepdims=True)
    shapes /= np.maximum(np.linalg.norm(shapes, axis=1, keepdims=True), 1e-300)
    like = np.abs(shapes[:4] @ shapes[4])
    follows = like.max() > _CLEAR and 1.0 - like.max() ** 2 < _PART * (1.0 - like[0] ** 2)
    own = project(np.ones(len(begun)), rank_basis(begun))
    if follows and not _both_signs(y) and any(map(_both_signs, inputs)) and own @ own > _TELLS * own.size:
        return CheckRow(
            LOOK, "rectified", label, f"{y.min():.3g} to {y.max():.3g}",
            f"{label} never changes sign although the input does, and it follows the size of the model "
            "output: the signal is rectified or clipped at zero.",
        )  # fmt: skip
    band = max(_END, 6.0 * coarse_noise(y) / spread, resolution(y) / spread)
    there = _at_ends(y, band)
    if clipped(y) or min(there) < max(
        _MUCH_THERE, *(_OFTENER * max(_at_ends(row, band)) for row in (run, *inputs))
    ):
        return None
    figure = f"{100 * sum(there):.2g} % of the samples"
    return CheckRow(
        LOOK, "stops", label, f"{figure} at both ends",
        f"{label} stays near {y.min():.3g} and {y.max():.3g} in {figure}, but the model does not: "
        "mechanical stops, or a sensor or actuator at its limits.",
    )  # fmt: skip


def _both_signs(row: Array) -> bool:
    share = float(np.sum(row.clip(0) ** 2)) / max(float(row @ row), 1e-300)
    return _OTHER_SIGN < share < 1.0 - _OTHER_SIGN


def _at_ends(row: Array, band: float) -> tuple[float, float]:
    """Return the shares of samples near the bottom and top of the range.

    A sample is near an end within the share `band` of the range.
    """
    place = (row - row.min()) / max(float(np.ptp(row)), 1e-300)
    return float(np.mean(place <= band)), float(np.mean(place >= 1.0 - band))


def _delay_row(label: str, found: _Gain, dt: float) -> Iterator[CheckRow]:
    if not found.delay:
        return
    count, time = counted(abs(found.delay), "sample"), f"{abs(found.delay) * dt:.3g} s"
    word, cause, pace = "ahead of", "different clocks", "slow"
    if found.delay > 0:
        word, cause, pace = "behind", "a delay (output_delay, input_delay)", "fast"
    yield CheckRow(
        LOOK, "delay", label, f"{count}, {time}",
        f"{label} is best matched {count} ({time}) {word} the model: {cause}, model dynamics that are too "
        f"{pace}, or a missing effect.",
    )  # fmt: skip


def _unit_row(found: _Gain, data: Measurement, i: int, model: str) -> Iterator[CheckRow]:
    """Yield a row on declared units that differ.

    Where units are declared, no guess is needed.
    """
    label, record = data.output_labels[i], data.output_units[i]
    factor = between(record, model)
    if factor is None or abs(np.log(factor)) < _LEAST:
        return
    said = f"{label} is declared in {record} on the record and in {model} on the model"
    size = abs(found.value)
    if abs(found.correlation) >= _RELATED and abs(np.log(size)) < abs(np.log(size / factor)):
        yield CheckRow(
            LOOK, "units", label, with_error(found.value, found.std),
            f"{said}, but its size is that of the model: one unit is declared wrong, or a gain compensates "
            "the difference.",
        )  # fmt: skip
        return
    others = range(data.n_outputs)
    factors = [f"{1 / factor:.6g}" if k == i else "1" for k in others]
    units = [model if k == i else data.output_units[k] for k in others]
    by, named = (f"[[{'], ['.join(factors)}]]", str(units)) if len(units) > 1 else (factors[0], repr(model))
    yield CheckRow(
        STOP, "units", label, f"factor {factor:.4g}",
        f"{said}, which makes it {factor:.4g} times as large; convert it: "
        f"data = dataclasses.replace(data, outputs=data.outputs * {by}, output_units={named}).",
    )  # fmt: skip


def _gain_row(label: str, found: _Gain, record: str, model: str) -> Iterator[CheckRow]:
    """Yield a row on the size of an output relative to the simulation."""
    if abs(found.correlation) < _RELATED:
        yield CheckRow(
            LOOK, "gain", label, f"correlation {found.correlation:.2g}",
            f"The simulation hardly correlates with {label}, so gain, sign and unit cannot be checked. "
            "Check the wiring, the order of the channels and the time constants.",
        )  # fmt: skip
        return
    factor = between(record, model)
    known = factor not in (None, 1.0)  # the row on units tells it
    words, certain = "", False
    if found.meets(1.0) or found.meets(factor or 1.0):
        if not known:
            said = f"{label} has the size that the model predicts."
            yield CheckRow(OK, "gain", label, with_error(found.value, found.std), said)
        return
    if not known:
        words, certain = _unit_of(label, found, record, model)
    yield _other_gain_row(label, found, words, certain, factor is None)


def _other_gain_row(label: str, found: _Gain, words: str, certain: bool, undeclared: bool) -> CheckRow:
    """Return the row on another size: a sign, a unit, or a gain."""
    figure = with_error(found.value, found.std)
    unit = f"{'the record looks like' if certain else 'perhaps'} {words}"
    if found.undelayed < -_CLEAR and found.value + _SURE * found.std < 0:
        more = f", and {unit}" if words else ""
        said = f"{label} has the opposite sign of the model{more}: swapped wires, or another sign convention."
        return CheckRow(STOP, "sign", label, figure, said)
    if certain:
        said = f"{label}: {unit}. The size agrees within its error, and so does the rest of the record."
        return CheckRow(STOP, "units", label, figure, said)
    causes = ["a wrong gain or parameter value" if found.alone else "a wrong parameter value"]
    causes.append("a missing effect")
    if words or (found.alone and undeclared):
        causes.append(f"a unit ({words})" if words else "a unit")
    causes += ["a sign"] if found.value < 0 else []
    more = "" if found.alone else ", and differs by more than a gain"
    said = f"{label} is {figure} times the model output{more}: {', '.join(causes[:-1])}, or {causes[-1]}."
    return CheckRow(LOOK, "units" if words else "gain", label, figure, said)


def _unit_of(label: str, found: _Gain, record: str, model: str) -> tuple[str, bool]:
    """Return the unit that a size looks like, and whether it is certain.

    Missing dynamics turn and shrink a response, too, but then little of the record goes with the model.
    """
    large, like = abs(np.log(abs(found.value))) > np.log(_FAR), abs(found.correlation)
    if not (large or (like > _SAME and found.alone)):
        return "", False
    words, certain = likely(abs(found.value), found.std, label, record, model)
    return words, certain and like > _SAME  # the rest of the record has to go with it


def _drift_row(label: str, left: Array, y: Array, timepts: Array) -> Iterator[CheckRow]:
    """Drift of what the scaled free run leaves."""
    parts = np.array_split(left, _BLOCKS)
    means = np.array([part.mean() for part in parts])
    times = np.array([part.mean() for part in np.array_split(timepts, _BLOCKS)])
    slope, level = np.polyfit(times - times.mean(), means, 1)
    rest = means - level - slope * (times - times.mean())
    scatter = float(np.sqrt(rest @ rest / (_BLOCKS - 2)))
    moved = slope * (timepts[-1] - timepts[0])
    error = scatter / float(np.linalg.norm(times - times.mean())) * (timepts[-1] - timepts[0])
    if abs(moved) > max(5.0 * error, 0.05 * float(y.std())):
        yield CheckRow(
            LOOK, "drift", label, f"{moved:.3g} over the record",
            f"{label} drifts by {with_error(moved, error)} over the record; the model does not.",
        )  # fmt: skip


def _spike_row(label: str, left: Array, step: float) -> Iterator[CheckRow]:
    five = np.lib.stride_tricks.sliding_window_view(left, 5)
    # from what is before and from what is after: a step is far from one of them, a spike from both
    sides = np.abs(five[:, [2]] - np.stack([five[:, :2].mean(axis=1), five[:, 3:].mean(axis=1)], axis=1))
    far = sides.min(axis=1)
    size = max(_NORMAL * float(np.median(far)), step)
    # a spike stands alone: where a residual moves fast all samples are far from their median
    beside = np.max([np.roll(far, k) for k in (-4, -3, -2, 2, 3, 4)], axis=0)
    spikes = int(np.sum(far > _SPIKE * np.maximum(size, beside))) if size > 0 else 0
    if spikes > max(1, 1e-3 * left.size):
        yield CheckRow(
            LOOK, "spikes", label, f"{spikes} samples",
            f"{label} has {spikes} samples that differ strongly from their neighbors and dominate the error.",
        )  # fmt: skip


_FAR_OFF = 3.0  # standard deviations of a signal that its mean stands away
_SURE_LEVEL = 5.0  # standard errors of a level
_LEVEL_TELLS = 1e-6  # of the samples: with fewer, none tells a level from an initial state
_SEEN = 0.05  # of the spread of an output: a level that is worth a word
_DECLARE = "declare {} by physical(model, operating_point=...), or give Measurement.deviation()."


def level_rows(
    data: Measurement, point: OperatingPoint | None, compared: Comparison | None
) -> Iterator[CheckRow]:
    """Check the output levels and compare them with the model.

    Parameters
    ----------
    data : Measurement
        Record, as it was given.
    point : OperatingPoint, optional
        Of the model.
    compared : Comparison, optional
        Model on the record, where its free run has bounds.

    Yields
    ------
    CheckRow
        One on each output that does not go with the model or its point; where all do, one on all.
    """
    taken = data.origin[data.n_inputs :]
    means, spreads = over_time(np.mean, data.outputs) + taken, over_time(np.std, data.outputs)
    run = None if compared is None or compared.led else compared
    levels = {} if run is None else dict(_unexplained(run))
    # where a model integrates, its level is that of its initial state: any level goes with it
    fixed = np.array([levels.get(label, (0.0,)) is not None for label in data.output_labels])
    far = (np.abs(means) > _FAR_OFF * spreads) & fixed
    odd = list[CheckRow]()
    if point is not None:
        nearer = (np.abs(means) < np.abs(means - point.outputs)) & ~far & fixed & (taken == 0)
        for i in np.flatnonzero(nearer & (np.abs(point.outputs) > _FAR_OFF * spreads)):
            said = (
                f"The mean of {data.output_labels[i]} is nearer to zero than to the operating point of the "
                f"model ({point.outputs[i]:.4g}). If the record holds deviations from a point, give it as it "
                "was measured, or a model without an operating point."
            )
            odd.append(CheckRow(LOOK, "level", data.output_labels[i], with_error(means[i], spreads[i]), said))
    # where it is led, or begins anew, its level is that of the record
    free = run is not None and len(run.starts) == 1
    undeclared = bool(far.any()) and point is None
    if free and not odd:
        odd += _constant_rows(levels, undeclared)
    if odd:
        yield from odd
    elif far.any():
        said, where = "The outputs look like absolute values, as in the model.", ""
        if undeclared:
            where = data.output_labels[int(np.argmax(far))]
            said = "The outputs look like absolute values. If the model is linear about an operating point, "
            said += _DECLARE.format("it")
        yield CheckRow(OK, "level", where, "absolute", said)
    elif not fixed.all():
        said = "The model integrates, so its initial state can explain any level."
        yield CheckRow(OK, "level", "", "any", said)
    else:
        yield _mean_row(data, free)


def _constant_rows(
    levels: Mapping[str, tuple[float, float, float] | None], undeclared: bool
) -> Iterator[CheckRow]:
    """Yield a row on each output that differs from the model by a constant."""
    for label, found in levels.items():
        if found is None or not _stands(*found):
            continue
        figure = with_error(*found[:2])
        said = (
            f"{label} differs from the model by a constant {figure}, with a spread of {found[2]:.3g}: an "
            "offset, or a record about an operating point."
        )
        said += f" The outputs look absolute: {_DECLARE.format('this')}" if undeclared else ""
        yield CheckRow(LOOK, "level", label, figure, said)


def _mean_row(data: Measurement, free: bool) -> CheckRow:
    """Return the row on the means of outputs in which nothing is odd."""
    if not any(_stands(y.mean(), _error(y, y.size), y.std()) for y in _measured(data.outputs)):
        said = "The means of the outputs are about zero, as those of deviations from an operating point."
        return CheckRow(OK, "level", "", "about zero", said)
    said = "the model explains them." if free else "no simulation shows whether the model explains them."
    figure = "by the model" if free else "not zero"
    return CheckRow(OK, "level", "", figure, f"The outputs have nonzero means, and {said}")


def _measured(outputs: Array) -> list[Array]:
    """Return the samples of each output that were measured."""
    return [y[~np.isnan(y)] for y in outputs]


def _stands(level: float, error: float, spread: float) -> bool:
    """Return whether a level is significant and large enough to report."""
    return abs(level) > max(_SURE_LEVEL * error, _SEEN * spread)


def _unexplained(compared: Comparison) -> Iterator[tuple[str, tuple[float, float, float] | None]]:
    """Yield the level of each output that the simulation does not explain.

    With each level come its standard error and the spread. The gain of the simulation is free. The error has
    no bound where gain and level have the same effect, or an output stands still; None where an initial state
    can hold any level.
    """
    data = compared.data
    (free,) = settling(compared.models[0], data.dt, [0, data.n_samples])
    for i, (label, y) in enumerate(zip(data.output_labels, _measured(data.outputs), strict=True)):
        known = ~np.isnan(data.outputs[i])
        begun = free[i, known]
        # what an initial state adds is fitted beside the level, which its estimate took up in part
        run = compared.runs[0, i, known] - begun @ compared.initial_states[0][0]
        others = rank_basis(np.column_stack([run, begun]))
        own, left = project(np.ones(y.size), others), project(y, others)
        seen = float(own @ own)  # samples that tell the level from the rest
        found = 0.0, np.inf, float(y.std())
        if seen > _LEVEL_TELLS * y.size and np.ptp(y):
            level = float(own @ left) / seen
            found = level, _error(left - level * own, seen), found[2]
        alone = project(np.ones(y.size), rank_basis(begun))
        yield label, found if alone @ alone > _LEVEL_TELLS * y.size else None


def _error(left: Array, seen: float) -> float:
    """Return the standard error of a mean under colored noise.

    The mean is over `seen` samples, and `left` is the remainder.
    """
    a, variance = autoregression(left)
    return float(np.sqrt(variance / seen) / max(abs(a.sum()), 1e-12))


#: Size of each unit of a quantity, by the names that messages use.
_SIZES = {
    "rate": {"rad/s": 1.0, "rpm": 2 * np.pi / 60, "Hz": 2 * np.pi},
    "angle": {"radians": 1.0, "degrees": np.pi / 180},
    "velocity": {"m/s": 1.0, "km/h": 1 / 3.6},
    "acceleration": {"m/s^2": 1.0, "g": 9.80665},
    "length": {"millimeters": 1.0, "inches": 25.4},
    "force": {"newtons": 1.0, "pounds": 4.44822},
    "temperature": {"Celsius": 1.0, "Fahrenheit": 1 / 1.8},
    "": {"per second": 1.0, "per minute": 1 / 60},
    "share": {"shares of 1": 1.0, "percent": 0.01},
    "prefix": {"units": 1.0, "thousandths": 1e-3, "millionths": 1e-6},
}
_ANY = ("", "share", "prefix")  # of whatever quantity
#: What labs write for them: (quantity, size, name in a message).
_WRITTEN = {
    written: (quantity, _SIZES[quantity][name], name)
    for quantity, name, spelled in (
        ("rate", "rad/s", "rad/s rad/sec 1/s s^-1"), ("rate", "rpm", "rpm 1/min rev/min U/min"),
        ("rate", "Hz", "Hz rps rev/s"),
        ("angle", "radians", "rad"), ("angle", "degrees", "deg ° degrees"),
        ("velocity", "km/h", "km/h kph"), ("length", "inches", "in inch"),
        ("acceleration", "g", "g gn"), ("force", "pounds", "lbf lb"),
    )
    for written in spelled.split()
} | {written: ("rate", np.pi / 180, "deg/s") for written in ("deg/s", "°/s")}  # fmt: skip
_METRIC = {
    "m": ("length", 1e3), "m/s": ("velocity", 1.0), "m/s^2": ("acceleration", 1.0),
    "m/s²": ("acceleration", 1.0), "N": ("force", 1.0), "rad": ("angle", 1.0), "V": ("voltage", 1.0),
    "A": ("current", 1.0), "Pa": ("pressure", 1.0), "W": ("power", 1.0), "Nm": ("torque", 1.0),
    "N m": ("torque", 1.0),
}  # fmt: skip
_PREFIXES = {"": 1.0, "m": 1e-3, "u": 1e-6, "µ": 1e-6, "μ": 1e-6, "c": 1e-2, "k": 1e3, "M": 1e6}
#: Quantities that a signal's name speaks of.
_NAMED = (
    (r"speed|veloc|omega|rate|rpm|freq", ("rate", "velocity")),
    (r"acc", ("acceleration",)),
    (r"angle|theta|phi|posi|disp|travel", ("angle", "length")),
    (r"temp", ("temperature",)),
    (r"force|load", ("force",)),
)
_ABOUT = 0.5  # log by which a unit may be missed where a gain is `_FAR`
_NEAR = 0.1  # most that a factor which parameters do make may be missed by
_FINE = 0.01  # of a gain: how well it must be known for a unit to be certain
_ROUND = 1e-3  # share that simulation and rounding may cost
_MOST = 3  # units that a sentence lists


class _Known(NamedTuple):
    """Declared unit; its quantity is "?" if it is not known here."""

    quantity: str
    size: float
    name: str


def between(record: str, model: str) -> float | None:
    """Return the factor between record and model from declared units.

    None is returned where the units do not determine it.
    """
    one, other = _known(record), _known(model)
    if one is None or other is None or one.quantity != other.quantity or one.quantity == "?":
        return None
    return other.size / one.size


def likely(value: float, std: float, label: str, record: str, model: str) -> tuple[str, bool]:
    """Guess the unit of a record from its size relative to the model.

    Parameters
    ----------
    value, std : float
        Size of the record over that of the free run, positive, with its standard deviation.
    label : str
        Name of the signal.
    record, model : str
        Units that are declared; "" for none.

    Returns
    -------
    words : str
        The conversion that the size looks like; empty where it looks like none.
    certain : bool
        Whether one factor is met within a standard deviation that leaves room for no other.
    """
    # parameters that are off make a gain of 1.3 and not of 60
    within = _ABOUT if abs(np.log(value)) > np.log(_FAR) else min(max(3.0 * std / value, 0.01), _NEAR)
    given, declared = _known(record), _known(model)
    if record == model:
        given = None  # that was taken over, or is what is in doubt
    near = sorted(
        (rank, far, factor, words)
        for rank, factor, words in _conversions(label, given, declared)
        if (far := abs(float(np.log(value / factor)))) <= within
    )
    met = {round(f, 6) for *_, f, _ in near if abs(value - f) <= max(_SURE * std, _ROUND * value)}
    certain = len(met) == 1 and _SURE * std <= _FINE * value
    said = [words for *_, f, words in near if not certain or round(f, 6) in met]
    return ", or ".join(said[:_MOST]), certain


def _conversions(
    label: str, given: _Known | None, declared: _Known | None
) -> Iterator[tuple[int, float, str]]:
    """Yield rank, factor and words of each conversion that is possible."""
    for quantity, sizes in _SIZES.items():
        rank = _rank(quantity, label, given or declared)
        for (here, one), (there, other) in permutations(sizes.items(), 2):
            fits = all(unit is None or unit.name == name for unit, name in ((given, here), (declared, there)))
            if rank is not None and (quantity in _ANY or fits):
                yield rank, other / one, f"{here} where the model has {there}"


def _known(unit: str) -> _Known | None:
    if unit in _WRITTEN:
        return _Known(*_WRITTEN[unit])
    for prefix, size in _PREFIXES.items():
        base = unit.removeprefix(prefix)
        if unit.startswith(prefix) and base in _METRIC:
            quantity, whole = _METRIC[base]
            sizes = {size: name for name, size in reversed(_SIZES.get(quantity, {}).items())}
            return _Known(quantity, size * whole, sizes.get(size * whole, unit))
    return _Known("?", 1.0, unit) if unit else None


def _rank(quantity: str, label: str, declared: _Known | None) -> int | None:
    """Rank how well a quantity suits a signal.

    The rank is 0 for what suits it, 1 for what it may be, and None for what it is not.
    """
    if declared is not None and quantity not in _ANY:
        return 0 if declared.quantity == quantity else None
    spoken = [q for pattern, quantities in _NAMED if re.search(pattern, label.lower()) for q in quantities]
    if quantity in _ANY or not spoken:
        return 1
    return 0 if quantity in spoken else None
