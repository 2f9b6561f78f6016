"""`check`: one table before everything else."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import Any

import control as ct
import numpy as np
from scipy import stats

from ...arguments import as_flag
from ...arithmetic import own_arithmetic
from ...comparison.compare import compare
from ...comparison.result import Comparison
from ...data.channels import match_channels
from ...data.measurement import Measurement
from ...data.range_ends import clipped, coarse_noise, resolution, runs
from ...data.records import as_record
from ...effects.effect import Effect, as_effects
from ...exceptions import DataError, DivergenceError, unheard
from ...inference.autoregression import autoregression
from ...inference.basis import project, rank_basis
from ...inference.levels import levels
from ...inference.sensitivities import candidate_columns
from ...inference.whitening import Whitener
from ...models.conversion import as_physical, known_physical, under_control
from ...models.operating_point import Controller, OperatingPoint, answer, ordered_record, unrecorded
from ...models.physical_model import PhysicalModel
from ...progress import Progress
from ...refinement.refine import base_fit
from ...systems.linear import Array, LinearModel
from ...words import counted, with_error
from ..case import Case
from ..ranking import detectable
from ..residual_tests import TestedResidual
from ..result import Detectable
from .gains import gain_rows, settling
from .result import Check
from .row import LOOK, OK, STOP, CheckRow

__all__ = ["check", "controller_rows", "feedback_rows", "level_rows", "looks", "sampling_rows", "signal_rows"]

_LAGS = 20
_FEEDBACK = 1e-6  # p-value of past residuals in the input
_FREE = 1e-3  # turn over the record below which a mode is a free one, up to rounding
_STRONG = 0.15  # correlation: the innovations of steps are not independent, and make small ones by chance
_OTHER = 0.05  # share of an input that its controller does not give, from which it is worth a word
_RETURNS = 0.98  # correlation of an input with itself later, from which it is periodic


def sampling_rows(linear: LinearModel, data: Measurement, looped: bool = False) -> Iterator[CheckRow]:
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
    poles = np.linalg.eigvals(linear.A) if linear.n_states else np.zeros(0)
    if not linear.is_continuous:
        with np.errstate(divide="ignore"):
            poles = np.log(poles.astype(complex)) / data.dt
    poles = poles[np.isfinite(poles)]
    limit = np.pi / data.dt
    fast = sorted({float(f"{abs(p.imag):.4g}") for p in poles if abs(p.imag) >= limit})
    figure = f"{data.n_samples} samples, {1 / data.dt:.4g} Hz"
    if fast:
        yield CheckRow(
            LOOK, "sampling", "", figure,
            f"Modes at {', '.join(f'{w:.4g}' for w in fast[:4])} rad/s lie above half the sampling "
            f"frequency ({limit:.4g} rad/s): their motion depends on the input between the samples.",
        )  # fmt: skip
    else:
        yield CheckRow(OK, "sampling", "", figure, "Every mode lies below half the sampling frequency.")
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


def controller_rows(controller: Controller, model: LinearModel, data: Measurement) -> Iterator[CheckRow]:
    """Check whether the controller reproduces the recorded inputs.

    The controller is fed with the record.

    Parameters
    ----------
    controller : Controller
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
    given, _ = answer(controller, model, data)
    A, _, C, _ = controller.at(data.dt)
    if given is None or unrecorded(controller, model, data):
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
        if share < _OTHER:
            yield CheckRow(
                OK,
                "controller",
                label,
                f"{100 * share:.2g} % deviation",
                "The controller reproduces the recorded input.",
            )
        else:
            yield CheckRow(
                LOOK, "controller", label, f"{100 * share:.2g} % deviation",
                f"With the record as its input, the controller gives another {label}. Possible causes: "
                "sign, sampling time, delay, an actuator limit, or an added signal.",
            )  # fmt: skip


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
    # where the input of a sample already shows in its output, only earlier residuals are past
    at_once = data.hold != "zoh" or bool(compared.models[0].D.any())
    for label, w in zip(data.input_labels, data.inputs, strict=True):
        if np.ptp(w) == 0 or _periodic(w) or data.n_samples < 10 * _LAGS:
            continue
        new = _white(w)
        for name, e in zip(data.output_labels, residuals, strict=True):
            p, most = _follows(new, _white(e), 1 if at_once else 0)
            if p < _FEEDBACK and most > _STRONG:
                yield CheckRow(
                    LOOK, "closed loop", label, f"p = {p:.1g}",
                    f"{label} depends on past values of {name} (correlation up to {most:.2g}): a controller "
                    "acts. Noise then enters the inputs, and simulations may be biased.",
                )  # fmt: skip
                return
    yield CheckRow(OK, "closed loop", "", "open", "No input was found to depend on past outputs.")


def _white(row: Array) -> Array:
    centered = (row - row.mean())[None]
    return Whitener.fit([centered]).apply([centered])


def _periodic(w: Array) -> bool:
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
    z = sums / np.maximum([np.linalg.norm(p) for p in products], 1e-300)
    most = np.abs(sums).max() / (np.linalg.norm(new) * np.linalg.norm(past))
    return float(stats.chi2.sf(float(z @ z), _LAGS)), float(most)


_FAR = 3.0  # standard deviations of a signal that its mean stands away
_SURE = 5.0  # standard errors of a level
_TELLS = 1e-6  # of the samples: with fewer, none tells a level from an initial state
_SEEN = 0.05  # of the spread of an output: a level that is worth a word


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
    means, spreads = data.outputs.mean(axis=1) + taken, data.outputs.std(axis=1)
    levels = {} if compared is None or compared.led else dict(_unexplained(compared))
    # where a model integrates, its level is that of its initial state: any level goes with it
    fixed = np.array([levels.get(label, (0.0,)) is not None for label in data.output_labels])
    far = (np.abs(means) > _FAR * spreads) & fixed
    odd = False
    if point is not None:
        for i in np.flatnonzero((np.abs(point.outputs) > _FAR * spreads) & ~far & fixed & (taken == 0)):
            odd = True
            yield CheckRow(
                LOOK, "level", data.output_labels[i], with_error(means[i], spreads[i]),
                f"{data.output_labels[i]} looks like deviations from an operating point, but in the model "
                f"this point is {point.outputs[i]:.4g}. Give the record as it was measured, or a model "
                "without an operating point.",
            )  # fmt: skip
    # where it is led, or begins anew, its level is that of the record
    free = compared is not None and len(compared.starts) == 1 and not compared.led
    absolute = ": declare this by physical(model, operating_point=...), or give Measurement.deviation()"
    for label, found in levels.items() if free and not odd else ():
        if found is not None and _stands(*found):
            odd = True
            yield CheckRow(
                LOOK, "level", label, with_error(*found[:2]),
                f"{label} differs from the model by a constant {with_error(*found[:2])}, with a spread of "
                f"{found[2]:.3g}: an offset, or a record about an operating point."
                + (f" The outputs look absolute{absolute}." if far.any() and point is None else ""),
            )  # fmt: skip
    if odd:
        return
    if point is not None and far.any():
        yield CheckRow(OK, "level", "", "absolute", "The outputs look like absolute values, as in the model.")
    elif far.any():
        yield CheckRow(
            OK, "level", data.output_labels[int(np.argmax(far))], "absolute",
            "The outputs look like absolute values. If the model is linear about an operating point, "
            "declare it by physical(model, operating_point=...), or give Measurement.deviation().",
        )  # fmt: skip
    elif not fixed.all():
        yield CheckRow(
            OK, "level", "", "any", "The model integrates, so its initial state can explain any level."
        )
    elif any(_stands(y.mean(), _error(y, y.size), y.std()) for y in data.outputs):
        said = "the model explains them." if free else "no simulation shows whether the model explains them."
        figure = "by the model" if free else "not zero"
        yield CheckRow(OK, "level", "", figure, f"The outputs have nonzero means, and {said}")
    else:
        yield CheckRow(
            OK, "level", "", "about zero", "The outputs look like deviations from an operating point."
        )


def _stands(level: float, error: float, spread: float) -> bool:
    """Return whether a level is significant and large enough to report."""
    return abs(level) > max(_SURE * error, _SEEN * spread)


def _unexplained(compared: Comparison) -> Iterator[tuple[str, tuple[float, float, float] | None]]:
    """Yield the level of each output that the simulation does not explain.

    With each level come its standard error and the spread. The gain of the simulation is free. The error has
    no bound where gain and level have the same effect, or an output stands still; None where an initial state
    can hold any level.
    """
    data = compared.data
    (free,) = settling(compared.models[0], data.dt, [0, data.n_samples])
    for i, (label, y) in enumerate(zip(data.output_labels, data.outputs, strict=True)):
        # what an initial state adds is fitted beside the level, which its estimate took up in part
        run = compared.runs[0, i] - free[i] @ compared.initial_states[0][0]
        others = rank_basis(np.column_stack([run, free[i]]))
        own, left = project(np.ones(y.size), others), project(y, others)
        seen = float(own @ own)  # samples that tell the level from the rest
        found = 0.0, np.inf, float(y.std())
        if seen > _TELLS * y.size and np.ptp(y):
            level = float(own @ left) / seen
            found = level, _error(left - level * own, seen), found[2]
        alone = project(np.ones(y.size), rank_basis(free[i]))
        yield label, found if alone @ alone > _TELLS * y.size else None


def _error(left: Array, seen: float) -> float:
    """Return the standard error of a mean under colored noise.

    The mean is over `seen` samples, and `left` is the remainder.
    """
    a, variance = autoregression(left)
    return float(np.sqrt(variance / seen) / max(abs(float(np.sum(a))), 1e-12))


_SAME = 1.0 - 1e-9  # correlation from which two signals are one
_COARSE = 2.0  # steps of the converter over the noise
_FEW = 0.1  # of the standard deviation: a step from which on a signal has but few levels
_JUMP = 2.5  # steps of a coarse signal: its own, through zero, are smaller


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
    named = [
        *zip(data.input_labels, data.inputs, strict=True),
        *zip(data.output_labels, data.outputs, strict=True),
    ]
    still = [label for label, row in named if np.ptp(row) == 0]
    whole = len([label for label in data.input_labels if label in still]) == data.n_inputs
    for label in still:
        stop = label in data.output_labels or (whole and not data.outputs.std(axis=1).any())
        yield CheckRow(
            STOP if stop else LOOK, "motion", label, "constant",
            f"{label} never changes, so the record contains no information about it.",
        )  # fmt: skip
    if not still:
        yield CheckRow(
            OK, "motion", "", f"{len(named)} signals move", "Every signal changes over the record."
        )
    yield from _repeated([(label, row) for label, row in named if label not in still])
    for label, y in zip(data.output_labels, data.outputs, strict=True):
        if label not in still:
            yield from _output_rows(label, y)
    for label, w in zip(data.input_labels, data.inputs, strict=True):
        if label not in still and (w.min() >= 0 or w.max() <= 0) and abs(w.mean()) > 0.2 * np.abs(w).max():
            yield CheckRow(
                LOOK, "sign", label, f"{w.min():.3g} to {w.max():.3g}",
                f"{label} never changes sign, so effects that differ by direction may not be "
                "distinguishable.",
            )  # fmt: skip


def _repeated(named: list[tuple[str, Array]]) -> Iterator[CheckRow]:
    centered = {label: row - row.mean() for label, row in named}
    for i, (one, a) in enumerate(centered.items()):
        for other, b in list(centered.items())[i + 1 :]:
            like = float(a @ b) / float(np.linalg.norm(a) * np.linalg.norm(b))
            if abs(like) > _SAME:
                yield CheckRow(
                    LOOK, "repeated", f"{one}, {other}", f"correlation {like:.3g}",
                    f"{one} and {other} are the same signal up to scale, so the data cannot distinguish "
                    "their effects.",
                )  # fmt: skip


def _output_rows(label: str, y: Array) -> Iterator[CheckRow]:
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
    lost = _lost(y)
    if lost:
        yield CheckRow(
            LOOK, "dropouts", label, f"{lost} samples read 0",
            f"{label} jumps to exactly 0 and back in {lost} samples: the sensor or its connection dropped "
            "out. Mark these samples as missing if possible.",
        )  # fmt: skip


def _lost(y: Array) -> int:
    """Samples that read exactly zero between neighbors that do not."""
    first, end = runs(y == 0.0)
    inner = (first > 0) & (end < y.size)
    first, end = first[inner], end[inner]
    far = max(0.5 * y.std(), _JUMP * resolution(y))
    jumps = (np.abs(y[first - 1]) > far) & (np.abs(y[end]) > far) if first.size else np.zeros(0, dtype=bool)
    return int(np.sum((end - first)[jumps]))


_SHORTEST = 20  # samples
_TESTS = 6  # among which one would have to show an effect
_SETTINGS = {"free": (), "tolerance": 0.0, "offset": True, "noise": None, "horizon": None}


def check(
    model: Any,
    data: Measurement,
    *,
    information: bool = True,
    controller: ct.StateSpace | None = None,
    effects: Sequence[Effect] | None = None,
) -> Check:
    """Check a record and a model before anything is concluded from them.

    Parameters
    ----------
    model : StateSpace, PhysicalModel or Refinement
        Model.
    data : Measurement
        Record; its channels are matched as in `compare`.
    information : bool
        Whether to work out the smallest effects that the record could show.
    controller : StateSpace or TransferFunction, optional
        As in `refine`: the controller under which the record was taken.
    effects : sequence of Effect, optional
        Effects of your own model. A row for each compares its size, given by ``start`` or ``fixed``, with the
        smallest that this record would show. All other coefficients must be fixed.

    Returns
    -------
    Check
        A row for each thing that was looked at, *ok*, *look* or *stop*; ``print`` it.

    Raises
    ------
    control.ControlArgument
        If model or data are something else, or an effect has more than one coefficient that is not fixed.
    control.ControlDimension
        If channels do not fit.
    DataError
        If the record is too short.

    Notes
    -----
    Looked at: constant, repeated, clipped, coarse and spiky signals, dropouts; sampling and length against
    the model's modes; of each output beside the free run its sign, gain and unit (known where record and
    model declare it; else a gain that is 9.549 within a small error, while the rest of the record fits, is
    rpm for rad/s, and one near that may be), delay, offset, drift; inputs that follow the outputs. The gain's
    standard deviation comes from the spread over blocks of the record, so the noise may have any color.

    Examples
    --------
    >>> motor = rco.dc_motor(gain=2.0, time_constant=0.5, inputs="voltage", outputs="speed")
    >>> volts = np.random.default_rng(0).standard_normal(1000)
    >>> y = rco.simulate(motor, rco.Measurement(volts, np.zeros(1000), dt=0.05), "zero").outputs[0]
    >>> found = rco.check(motor, rco.Measurement(volts, y * 60 / (2 * np.pi), dt=0.05))
    >>> found.stops, found.looks[0].what
    (True, 'units')
    """
    as_flag(information, "information")
    if as_record(data).n_samples < _SHORTEST:
        raise DataError(f"a record of {data.n_samples} samples is too short to look over; give {_SHORTEST}")
    model = under_control(model, controller, data)
    with own_arithmetic(), unheard():
        record, rows = _looked_over(model, data, None)
        stopped = any(row.status == STOP for row in rows)
        shown = _shown(model, record) if information and not stopped else ()
        own = () if effects is None or stopped else _own(model, record, as_effects(effects, "effects"))
    rows += _information_rows(shown, as_physical(model) if shown else None)
    rows += [_against(effect, found) for effect, found in own]
    return Check(tuple(rows), shown)


def looks(model: Any, records: Sequence[Measurement], horizon: float | None) -> tuple[CheckRow, ...]:
    """Return the check rows that need attention for these records.

    Parameters
    ----------
    model : StateSpace, PhysicalModel or Refinement
        Model.
    records : sequence of Measurement
        Records; of several, each row says which it is about.
    horizon : float, optional
        Length of the free runs (s).

    Returns
    -------
    tuple of CheckRow
        Those that say stop first.
    """
    rows = []
    with unheard():
        for i, data in enumerate(records):
            about = f"record {i + 1}"
            for row in _looked_over(model, data, horizon)[1] if data.n_samples >= _SHORTEST else ():
                where, sentence = f"{row.where}, {about}".removeprefix(", "), f"{about}: {row.sentence}"
                rows.append(row if len(records) == 1 else replace(row, where=where, sentence=sentence))
    return Check(tuple(rows)).looks


def _looked_over(model: Any, data: Measurement, horizon: float | None) -> tuple[Measurement, list[CheckRow]]:
    """Return the record in the model's channel order, and its check rows.

    The rows on information are not included.
    """
    physical = known_physical(model)
    point = None if physical is None else physical.operating_point
    straight = point is None or point.field is None
    controller = None if physical is None else physical.controller
    about = physical is not None and point is not None and straight and controller is None
    if physical is not None and point is not None and about:  # beside what the record has above the point
        compared = _compared(physical.system, ordered_record(physical, data), horizon)
        known = dict(zip(match_channels(physical.linear, data).outputs, point.outputs, strict=True))
        point = replace(point, outputs=np.array([known.get(i, 0.0) for i in range(data.n_outputs)]))
    else:
        compared = _compared(model, data, horizon)
    record = data if compared is None or about else compared.data
    rows = list(signal_rows(record if data.n_inputs else data))
    levels = list(level_rows(data, point, compared)) if straight else []
    linear = LinearModel.from_statespace(getattr(model, "system", model))
    sampling = list(sampling_rows(linear, record, controller is not None))
    if compared is not None and controller is not None:
        return record, [*rows, *levels, *sampling, *controller_rows(controller, linear, data)]
    if compared is not None:
        # of a nonlinear model a gain says little
        straight = straight and not compared.led
        gains = list(gain_rows(compared, _units(physical, data, compared))) if straight else []
        # they say what a level and a limit there come from
        bent = {row.where for row in gains if row.what in ("rectified", "stops")}
        kept = [r for r in (*rows, *levels) if r.where not in bent or r.what not in ("level", "clipping")]
        return record, [*kept, *sampling, *gains, *feedback_rows(compared)]
    diverges = CheckRow(
        STOP, "free run", "", "diverges",
        "The simulation diverges, so the model cannot be compared with the record. Give compare a short "
        "horizon=, or correct the poles.",
    )  # fmt: skip
    return record, [*rows, *levels, *sampling, diverges]


def _units(physical: PhysicalModel | None, data: Measurement, compared: Comparison) -> tuple[str, ...]:
    """Units that the model declares for the outputs that were compared."""
    if physical is None or not any(physical.output_units):
        return ()
    outputs = match_channels(physical.linear, data).outputs
    labels = [data.output_labels[place] if place >= 0 else "" for place in outputs]
    return tuple(physical.output_units[labels.index(label)] for label in compared.data.output_labels)


def _compared(model: Any, data: Measurement, horizon: float | None) -> Comparison | None:
    """The model on the record, None where its free run has no bounds."""
    try:
        compared = compare(model, data, horizon=horizon)
    except DivergenceError:
        return None
    return compared if np.isfinite(compared.runs).all() else None


def _own(model: Any, data: Measurement, effects: Sequence[Effect]) -> list[tuple[Effect, Detectable | None]]:
    """Return effects, each with the smallest size that the record shows.

    The size is None if the record shows none.
    """
    bare = []
    for effect in effects:
        sizes = [name for name in effect.coefficients if name not in effect.spec.shaping]
        if len(sizes) != 1 or set(effect.free) - set(sizes):
            others = ", ".join(name for name in effect.free if name not in sizes[:1])
            raise ct.ControlArgument(
                f"{effect.label} has more coefficients than its size: fix the others ({others}) by "
                "fixed={...}"
            )
        fixed = {name: value for name, value in effect.fixed.items() if name not in sizes}
        bare.append(effect.replace(start={}, prior={}, fixed=fixed))
    shown = {found.effect: found for found in _shown(model, data, bare)}
    return [(effect, shown.get(one)) for effect, one in zip(effects, bare, strict=True)]


def _against(effect: Effect, found: Detectable | None) -> CheckRow:
    """Return the row of an effect of the user's own model."""
    if found is None:
        return CheckRow(
            LOOK,
            "information",
            effect.place,
            f"{effect.kind}: not seen",
            f"This record cannot show {effect.label}.",
        )
    value = {**effect.start, **effect.fixed}.get(found.coefficient)
    least = f"{found.smallest:.3g} {found.unit}".strip()
    sentence = f"{effect.label}: this record cannot show less than {least} (95 % probability)."
    if value is None:
        return CheckRow(OK, "information", effect.place, f"{effect.kind}: from {least}", sentence)
    said = f"{sentence} Your model has {value:.3g} {found.unit}".strip() + "."
    status, word = (OK, "shows") if abs(value) >= found.smallest else (LOOK, "too small to show")
    return CheckRow(status, "information", effect.place, f"{effect.kind}: {word}", said)


def _shown(model: Any, data: Measurement, effects: Sequence[Effect] | None = None) -> tuple[Detectable, ...]:
    """Smallest coefficients that one of the tests of `diagnose` would show."""
    try:
        base = base_fit(model, [data], free=(), tolerance=0.0, offset=True, noise=None)
        case = Case.prepare(base, [data], effects, dict(_SETTINGS), 0.01, Progress())
    except (DataError, ct.ControlArgument):
        return ()  # too short, or nothing that could be missing: there is no such row then
    scored = candidate_columns(case.fitted, case.library, case.motions[0], (0.0,))
    return detectable(TestedResidual(case.fitted), scored, _TESTS, 0.01, levels())


def _information_rows(shown: tuple[Detectable, ...], model: PhysicalModel | None) -> list[CheckRow]:
    """Return check rows on the changes that the record could show.

    A parameter counts as not seen if the record would not even show that it doubles.
    """
    if model is None:
        return []
    nominal = {(q.kind, q.place): abs(q.value) for q in model.parameters}
    blind = [
        d.effect.label for d in shown if d.smallest > nominal.get((d.effect.kind, d.effect.place), np.inf)
    ]
    best = ", ".join(f"{d.effect.label} {d.smallest:.3g} {d.unit}".strip() for d in shown[:3])
    seen = CheckRow(
        OK, "information", "", f"{counted(len(shown), 'effect')} tried",
        f"Smallest effects that it would show (95 % probability): {best}, and others (.detectable).",
    )  # fmt: skip
    if not blind:
        return [seen]
    least = f"The record would not show these even if they doubled: {', '.join(blind[:4])}."
    return [seen, CheckRow(LOOK, "information", "", f"{len(blind)} not seen", least)]
