"""Rows of `check`, and its checks of the record.

They cover the signals, sampling and length, the controller, and feedback.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator, Sequence
from dataclasses import dataclass
from itertools import combinations
from typing import Unpack

import control as ct
import numpy as np
from scipy import stats

from ..comparison.result import Comparison
from ..comparison.signals import is_rounding
from ..data.measurement import Measurement
from ..data.records import clipped, coarse_noise, resolution
from ..effects.effect import Effect
from ..inference.whitening import Whitener, autoregression, innovations
from ..models.controller import JoinedController, answer, unrecorded
from ..results import Options, Result, Row, picture, show
from ..systems.linear import Array, LinearModel

_MOST, _LONG = 4, 150  # rows that are named above another result; letters of the first one there
_OF_THE_FREE_RUN = ("delay", "drift", "gain", "level", "rectified", "stops", "units")

OK, LOOK, STOP = "ok", "look", "stop"


@dataclass(frozen=True, slots=True)
class CheckRow(Row):
    """One thing that was looked at.

    Attributes
    ----------
    status : str
        "ok", "look" (go on, but know this) or "stop" (what follows means nothing before it is mended).
    what, where : str
        What was looked at, and the signal, "" for the whole record.
    figure : str
        What was found, with its unit.
    sentence : str
        What it means, and what to do.
    """

    status: str
    what: str
    where: str
    figure: str
    sentence: str


def warned(rows: Sequence[CheckRow], explained: bool = False, places: Collection[str] = ()) -> list[str]:
    """Return the warnings for a result that rests on these rows.

    Parameters
    ----------
    rows : sequence of CheckRow
        Rows that ask for attention.
    explained : bool
        Whether the result explains the record. Then it explains what the model's free run leaves, too.
    places : collection of str
        Where the effects are that it found: they explain that an output is cut off there.

    Returns
    -------
    list of str
        The first one in a sentence, the others by name: the answer is what was asked for.
    """
    if explained:
        left = [row for row in rows if row.what != "clipping" or row.where.split(", ")[0] not in places]
        rows = [row for row in left if row.status == STOP or row.what not in _OF_THE_FREE_RUN]
    if not rows:
        return []
    first, *others = rows
    short = f"{first.what} {first.where}: {first.figure} (see .checks)."
    whole = len(first.sentence) <= _LONG or first.status == STOP
    said = [f"{first.status.upper()}: {first.sentence if whole else short}"]
    named = [f"{row.what} of {row.where}" if row.where else row.what for row in others]
    if named:
        more = f" and {len(named) - _MOST} more" if len(named) > _MOST else ""
        said.append(f"{others[0].status.upper()}: also {', '.join(named[:_MOST])}{more} (see .checks).")
    return said


@dataclass(frozen=True, slots=True)
class Detectable(Row):
    """Smallest coefficient of an effect that the record would have shown.

    The power of detection is 95 %.
    """

    effect: Effect
    coefficient: str
    smallest: float
    unit: str


@dataclass(frozen=True, slots=True, eq=False)
class Check(Result):
    """Check of a record and a model before anything is concluded.

    Attributes
    ----------
    rows : tuple of CheckRow
        All that was looked at.
    data : Measurement
        Record.
    detectable : tuple of Detectable
        Smallest coefficient of each effect and parameter that this record would show with 95 %
        probability, the model being otherwise right.
    """

    rows: tuple[CheckRow, ...]
    data: Measurement
    detectable: tuple[Detectable, ...] = ()

    @property
    def looks(self) -> tuple[CheckRow, ...]:
        """Rows that ask for attention, those that say stop first."""
        return tuple(row for status in (STOP, LOOK) for row in self.rows if row.status == status)

    @property
    def stops(self) -> bool:
        """Return whether something must be corrected first."""
        return any(row.status == STOP for row in self.rows)

    @picture
    def plot(self, **options: Unpack[Options]) -> ct.ControlPlot:
        """Record with its first remarks; signals that they name in color.

        Parameters
        ----------
        ax : array of Axes, optional
            Axes to draw in, one per output and input.
        label : str, optional
            Label of the record.

        Returns
        -------
        ControlPlot
        """
        return show(self, "plot", **options)


_SAME = 1.0 - 1e-9  # correlation from which two signals are one
_COARSE = 2.0  # steps of the converter over the noise
_FEW = 0.1  # of the standard deviation: a step from which on a signal has but few levels
_JUMP = 2.5  # steps of a coarse signal: its own, through zero, are smaller
_RESTS = 0.2  # share of samples at exactly 0 from which on that is where the signal rests


def signal_rows(data: Measurement) -> Iterator[CheckRow]:
    """Rows on each signal of a record.

    Parameters
    ----------
    data : Measurement
        Record.

    Yields
    ------
    CheckRow
    """
    outputs = [(label, y[~np.isnan(y)]) for label, y in zip(data.output_labels, data.outputs, strict=True)]
    inputs = list(zip(data.input_labels, data.inputs, strict=True))
    # signals that never change
    still = [label for label, row in (*inputs, *outputs) if np.ptp(row) == 0]
    whole = set(data.input_labels) <= set(still) and not any(y.std() for _, y in outputs)
    for label in still:
        yield CheckRow(
            STOP if whole or label in data.output_labels else LOOK, "motion", label, "constant",
            f"{label} never changes, so the record contains no information about it.",
        )  # fmt: skip
    if not still:
        moving = f"{len(inputs) + len(outputs)} signals move"
        yield CheckRow(OK, "motion", "", moving, "Every signal changes over the record.")
    every = zip((*data.input_labels, *data.output_labels), (*data.inputs, *data.outputs), strict=True)
    yield from _repeated([(label, row) for label, row in every if label not in still])
    for signals, rows in ((outputs, _output_rows), (inputs, _input_rows)):
        for label, row in signals:
            if label not in still:
                yield from rows(label, row)


def _repeated(signals: Sequence[tuple[str, Array]]) -> Iterator[CheckRow]:
    for (one, first), (other, second) in combinations(signals, 2):
        known = ~np.isnan(first + second)
        if not known.all() and np.count_nonzero(known) < Measurement.shortest:
            continue
        # correlation of 1: the same signal
        a, b = (row[known] - row[known].mean() for row in (first, second))
        like = float(a @ b) / (float(np.linalg.norm(a) * np.linalg.norm(b)) or 1.0)
        if abs(like) > _SAME:
            yield CheckRow(
                LOOK, "repeated", f"{one}, {other}", f"correlation {like:.3g}",
                f"{one} and {other} are the same signal up to scale, so the data cannot distinguish "
                "their effects.",
            )  # fmt: skip


def _input_rows(label: str, w: Array) -> Iterator[CheckRow]:
    if (w.min() >= 0 or w.max() <= 0) and abs(w.mean()) > 0.2 * np.abs(w).max():
        yield CheckRow(
            LOOK, "sign", label, f"{w.min():.3g} to {w.max():.3g}",
            f"{label} never changes sign, so effects that differ by direction may not be distinguishable.",
        )  # fmt: skip


def _output_rows(label: str, y: Array) -> Iterator[CheckRow]:
    # clipped samples, coarse steps, dropouts
    side = clipped(y)
    if side is not None:
        yield CheckRow(
            LOOK, "clipping", label, f"{side[1]} samples at {side[0]:.4g}",
            f"{label} stays at exactly {side[0]:.4g} for up to {side[1]} samples: the sensor may be clipped "
            "(output_saturation, output_range), or a stop holds it.",
        )  # fmt: skip
    step, spread = resolution(y), float(y.std())
    few = step > _FEW * spread
    if few or step > _COARSE * max(coarse_noise(y), step / 4.0):
        count = f"{np.unique(y).size} levels, " if few else ""
        said = f"{step / spread:.2g} of its standard deviation" if few else "more than its noise"
        yield CheckRow(
            LOOK, "resolution", label, f"{count}steps of {step:.3g}",
            f"{label} has {count}steps of {step:.3g} ({said}): smaller changes cannot be seen.",
        )  # fmt: skip
    lost = _lost(y, max(0.5 * spread, _JUMP * step))
    if lost:
        yield CheckRow(
            LOOK, "dropouts", label, f"{lost} samples read 0",
            f"{label} reads exactly 0 in {lost} samples, far from what the samples before and after predict: "
            "the sensor or its connection dropped out. Mark these samples as missing if possible.",
        )  # fmt: skip


def _lost(y: Array, least: float) -> int:
    """Count exact zeros that the signal before and after does not predict.

    A signal also passes through 0 or rests there by its own motion, which a converter shows as exactly 0. So
    the predictions from both sides must be `least` from 0, and further than any other reading from its own.
    """
    if not 0.0 < np.mean(y == 0.0) < _RESTS:
        return 0
    # prediction from the past and from the future
    a, _ = autoregression(y)
    centered = y - y.mean()
    ahead, back = np.abs(innovations(a, centered)), np.abs(innovations(a, centered[::-1])[::-1])
    edges = np.flatnonzero(np.diff(y)) + 1
    first, end = np.append(0, edges), np.append(edges, y.size)  # of each reading, however long it stays
    # without a whole past or future there is no prediction
    inner = (first >= a.size) & (end <= y.size - a.size)
    first, end = first[inner], end[inner]
    off, zero = np.minimum(ahead[first], back[end - 1]), y[first] == 0.0
    return int(np.sum((end - first)[zero & (off > off[~zero].max(initial=least))]))


_LAGS = 20
_FEEDBACK = 1e-6  # p-value of past residuals in the input
_FREE = 1e-3  # turn over the record below which a mode is a free one, up to rounding
_STRONG = 0.15  # correlation: the innovations of steps are not independent, and make small ones by chance
_OTHER = 0.05  # share of an input that its controller does not give, from which it is worth a word
_RETURNS = 0.98  # correlation of an input with itself later, from which it is periodic


def sampling_rows(linear: LinearModel, data: Measurement, looped: bool) -> Iterator[CheckRow]:
    """Check sampling time and record length against the model's modes.

    Parameters
    ----------
    linear : LinearModel
        Model.
    data : Measurement
        Record.
    looped : bool
        Whether it runs in the loop of a controller.

    Yields
    ------
    CheckRow
    """
    # poles in continuous time, against the Nyquist frequency and the length of the record
    poles = np.linalg.eigvals(linear.A) if linear.n_states else np.zeros(0)
    if not linear.is_continuous:
        with np.errstate(divide="ignore"):
            poles = np.log(poles.astype(complex)) / data.dt
    poles = poles[np.isfinite(poles)]
    limit = np.pi / data.dt
    fast = sorted({float(f"{abs(p.imag):.4g}") for p in poles if abs(p.imag) >= limit})
    status, said = OK, "Every mode lies below half the sampling frequency."
    if fast:
        status = LOOK
        said = (
            f"Modes at {', '.join(f'{w:.4g}' for w in fast[:4])} rad/s lie above half the sampling "
            f"frequency ({limit:.4g} rad/s): their motion depends on the input between the samples."
        )
    yield CheckRow(status, "sampling", "", f"{data.n_samples} samples, {1 / data.dt:.4g} Hz", said)
    length = data.dt * data.n_samples
    slow = [abs(p) for p in poles if _FREE < abs(p) * length < 2.0]
    if slow:
        yield CheckRow(
            LOOK, "length", "", f"{length:.4g} s",
            f"The slowest mode ({min(slow):.3g} rad/s) has hardly begun to settle in {length:.4g} s: the "
            "record contains little information about it.",
        )  # fmt: skip
    unstable = [p for p in poles if p.real * length > 1.0]
    if unstable and not looped:
        yield CheckRow(
            LOOK, "stability", "", f"pole at {max(p.real for p in unstable):.3g}",
            "The model is unstable, so it is judged by one-step predictions (or short simulations, "
            "horizon=). Gain and unit cannot be checked.",
        )  # fmt: skip


def controller_rows(
    controller: JoinedController, model: LinearModel, data: Measurement
) -> Iterator[CheckRow]:
    """Check whether the controller reproduces the recorded inputs.

    The controller is fed with the record.

    Parameters
    ----------
    controller : JoinedController
        Around the model.
    model : LinearModel
        The model alone.
    data : Measurement
        Record, with what the controller read and what it gave.

    Yields
    ------
    CheckRow
        None where the record does not hold both.
    """
    # simulate the controller on the record, its initial state by least squares
    given, _ = answer(controller, model, data)
    A, _, C, _ = controller.at(data.dt)
    if given is None or unrecorded(controller.driven, model, data):
        return
    begun, x = np.zeros((data.n_samples, len(C), len(A))), np.eye(len(A))
    for k in range(data.n_samples):
        begun[k], x = C @ x, A @ x
    for i, where in enumerate(controller.driven):
        label = model.input_labels[where]
        row = data.input_labels.index(label) if label in data.input_labels else where
        u = data.inputs[row] + data.origin[row]
        left = u - given[i]
        left = left - begun[:, i] @ np.linalg.lstsq(begun[:, i], left, rcond=1e-10)[0]
        share = float(np.linalg.norm(left)) / max(float(np.linalg.norm(u - u.mean())), 1e-300)
        status, said = OK, "The controller reproduces the recorded input."
        if share >= _OTHER:
            status = LOOK
            said = (
                f"With the record as its input, the controller gives another {label}. Possible causes: "
                "sign, sampling time, delay, an actuator limit, or an added signal."
            )
        yield CheckRow(status, "controller", label, f"{100 * share:.2g} % deviation", said)


def feedback_rows(compared: Comparison) -> Iterator[CheckRow]:
    """Check whether an input depends on past outputs (closed loop).

    Parameters
    ----------
    compared : Comparison
        Model on the record.

    Yields
    ------
    CheckRow

    Notes
    -----
    The innovation of an input that nobody steers by the outputs is independent of every past residual,
    whatever is wrong with the model. A periodic input has no innovation, so nothing is said there.
    """
    data = compared.data
    residuals = data.outputs - compared.runs[0]
    # residuals in which nothing is missing, for the lags
    shown = np.flatnonzero(~is_rounding(residuals, data.outputs) & ~np.isnan(residuals).any(axis=1))
    # where the input of a sample already shows in its output, only earlier residuals are past
    at_once = data.hold != "zoh" or bool(compared.models[0].D.any())
    tested = False
    for label, w in zip(data.input_labels, data.inputs, strict=True):
        if np.ptp(w) == 0 or _periodic(w) or data.n_samples < 10 * _LAGS or not shown.size:
            continue
        tested, new = True, _white(w)
        # whiten the input, then correlate it with past residuals
        for name, e in ((data.output_labels[i], residuals[i]) for i in shown):
            p, most = _follows(new, _white(e), 1 if at_once else 0)
            if p < _FEEDBACK and most > _STRONG:
                yield CheckRow(
                    LOOK, "closed loop", label, f"p = {p:.1g}",
                    f"{label} depends on past values of {name} (correlation up to {most:.2g}). Possible "
                    "causes: a controller, a plant that acts back on its actuator, or a disturbance that "
                    "reaches both. Noise then enters the inputs, and simulations may be biased.",
                )  # fmt: skip
                return
    figure, said = "not tested", f"Inputs that rest, repeat or have under {10 * _LAGS} samples cannot "
    said += "show a controller."
    if tested:
        figure = "no sign"
        said = "No sign of a controller in this record: no input was found to depend on past outputs."
    yield CheckRow(OK, "closed loop", "", figure, said)


def _white(row: Array) -> Array:
    centered = (row - row.mean())[None]
    return Whitener.fit([centered]).apply([centered])


def _periodic(w: Array) -> bool:
    # autocorrelation by the Fourier transform, without bias
    centered = w - w.mean()
    spectrum = np.abs(np.fft.rfft(centered, 2 * w.size)) ** 2
    own = np.fft.irfft(spectrum)[: w.size // 2] / np.arange(w.size, w.size - w.size // 2, -1)
    below = np.flatnonzero(own < 0.5 * own[0])
    return bool(below.size and np.max(own[below[0] :], initial=0.0) > _RETURNS * own[0])


def _follows(new: Array, past: Array, first: int) -> tuple[float, float]:
    """Return the p-value of independence and the largest correlation.

    The test asks whether the innovation of an input is independent of past residuals. Each product is weighed
    by its own size: an input that seldom steps counts as much as it has steps.
    """
    n = min(new.size, past.size)
    new, past = new[-n:], past[-n:]
    products = [new[k:] * past[: n - k] for k in range(first, _LAGS + first)]
    sums = np.array([p.sum() for p in products])
    # each product over its own size: chi-square with one degree per lag
    z = sums / np.maximum([np.linalg.norm(p) for p in products], 1e-300)
    most = np.abs(sums).max() / max(np.linalg.norm(new) * np.linalg.norm(past), 1e-300)
    return float(stats.chi2.sf(z @ z, _LAGS)), float(most)
