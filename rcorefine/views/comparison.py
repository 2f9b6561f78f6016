"""Table and pictures of a `Comparison`."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import control as ct
import numpy as np
from matplotlib.axes import Axes

from ..arguments import as_choice
from ..comparison.model_error import horizon_error
from ..comparison.result import KINDS, Comparison
from ..comparison.signals import Decay, correlogram, decay_of
from ..data.signals import check_whole
from ..exceptions import DataError
from ..results import counted
from ..systems.linear import Array
from .bode import bode
from .failure_map import plot_map
from .figures import BAND, MEASURED, Frame, busiest_stretch, look_of, plain, style, trace, unit_text
from .tables import TextTable, number


def plot_decay(result: Comparison, frame: Frame) -> ct.ControlPlot:
    """Draw amplitude, period, damping ratio and frequency of each output.

    See `Comparison.plot`.
    """
    data, names = result.data, frame.labels(result.names)
    check_whole(data, "plot('decay')")
    with frame.axes([2.2, 2.2] * data.n_outputs, 2) as (axes, lines):
        for i in range(data.n_outputs):
            measured = decay_of(data.outputs[i], data.dt, float(data.timepts[0]))
            block, drawn = axes[2 * i : 2 * i + 2], lines[2 * i : 2 * i + 2]
            dots = {"color": MEASURED, "marker": "o", "markersize": 3.5, "linestyle": "", "label": "measured"}
            _draw(block, drawn, measured, dots)
            for m, name in enumerate(names):
                try:
                    model = decay_of(result.runs[m, i], data.dt, float(data.timepts[0]))
                except DataError:  # this model does not swing
                    continue
                _draw(block, drawn, model, dict(style(m)._asdict(), label=name))
            label, unit = data.output_labels[i], data.output_units[i]
            texts = [f"Amplitude of {label}", "Damping ratio [%]", "Period [s]", "Frequency [Hz]"]
            for axis, text in zip(block.ravel(), texts, strict=True):
                axis.set_ylabel(unit_text(text, unit) if "Ampl" in text else text)
            block[0, 0].set_yscale("log")
            block[0, 1].set_ylim(0.0, 1.3 * 100 * float(np.max(measured.damping_ratio)))
            below = ((measured.period, "Time [s]"), (1 / measured.period, unit_text("Amplitude", unit)))
            for axis, (known, text) in zip(block[1], below, strict=True):
                axis.set(ylim=(0.95 * np.median(known), 1.05 * np.median(known)), xlabel=text)
        return frame.finish(axes, lines, f"Free decay, record {data.name}")


def _draw(axes: Any, lines: Any, found: Decay, look: dict[str, Any]) -> None:
    """Draw one decay in four panels."""
    curves = (
        (found.timepts, found.amplitude), (found.amplitude, 100 * found.damping_ratio),
        (found.timepts, found.period), (found.amplitude, 1 / found.period),
    )  # fmt: skip
    for where, (x, y) in zip(np.ndindex(2, 2), curves, strict=True):
        lines[where] = [*(lines[where] or []), *axes[where].plot(x, y, **look)]


_START = {
    "estimate": "the initial state is estimated from the record",
    "zero": "from rest (x0 = 0)",
    "given": "from the given x0",
}


def comparison_table(result: Comparison) -> TextTable:
    """One row per model and output."""
    data = result.data
    headers = ["model", "output", "unit", "fit [%]", "RMSE", "bias", "largest", "at [s]"]
    residual = data.outputs[None] - result.runs
    fit, rmse = np.atleast_2d(result.fit), np.atleast_2d(result.rmse)
    rows = []
    for m, name in enumerate(result.names):
        for i, output in enumerate(data.output_labels):
            worst = int(np.nanargmax(np.abs(residual[m, i])))
            percent = f"{fit[m, i]:.5g}" if abs(fit[m, i]) >= 99.5 else number(fit[m, i], 3)
            sizes = [number(rmse[m, i], 3), number(np.nanmean(residual[m, i]), 2)]
            sizes += [number(residual[m, i, worst], 3), number(data.timepts[worst])]
            rows.append([name, output, data.output_units[i], percent, *sizes])
    title = (
        f"{counted(len(result.names), 'model')} on record {data.name!r}: {data.n_samples} samples, "
        f"dt = {number(data.dt, 6)} s, t = {number(data.timepts[0])} ... {number(data.timepts[-1])} s, "
        f"hold {data.hold!r}"
    )
    notes = [_how(result)]
    if np.isnan(fit).any():
        notes.append(
            "fit '-': the measured output is constant, so there is nothing to explain: check the sensor."
        )
    lines = result.line_levels
    said = [*result.notes, *([] if lines is None else [lines.sentence()])]
    notes += [f"{note[0].upper()}{note[1:].removesuffix('.')}." for note in said]
    if not any(row[2] for row in rows):  # no units
        headers, rows = headers[:2] + headers[3:], [row[:2] + row[3:] for row in rows]
    return TextTable(headers, rows, title, notes, left=len(headers) - 5)


def _how(result: Comparison) -> str:
    if result.led:
        return f"Predicted one sample ahead by an observer; {_START[result.x0]}."
    if result.looped and len(result.starts) == 1:
        return f"Simulation in closed loop with the controller, over the whole record; {_START[result.x0]}."
    if len(result.starts) == 1:
        return f"Simulation over the whole record (free run, not prediction); {_START[result.x0]}."
    length = result.data.duration / len(result.starts)
    return (
        f"Simulation in {len(result.starts)} windows of {number(length, 3)} s; {_START[result.x0]} in every "
        "window."
    )


def plot_comparison(
    result: Comparison, frame: Frame, kind: str = "time", *, measured: Any = None, omega: Any = None
) -> ct.ControlPlot:
    """The picture asked for; see `Comparison.plot`."""
    as_choice(kind, "kind", KINDS)
    if kind == "bode":
        return bode(
            [(model.name, model) for model in result.models],
            result.data.frequency_response() if measured is None else measured,
            omega,
            frame,
            title=f"Models and record {result.data.name}",
        )
    for keyword, value in (("measured", measured), ("omega", omega)):
        if value is not None:
            raise ct.ControlArgument(f"{keyword} belongs to kind='bode', not to kind={kind!r}")
    draw = {"time": plot_time, "residual": plot_residual, "horizon": plot_horizon, "decay": plot_decay}
    return plot_map(result, frame) if kind == "map" else draw[kind](result, frame)


def plot_time(result: Comparison, frame: Frame) -> ct.ControlPlot:
    """Draw measured and simulated outputs and the residuals.

    See `Comparison.plot`.
    """
    data = result.data
    names = frame.labels(result.names)
    fits = np.atleast_2d(result.fit)
    residual = data.outputs[None] - result.runs
    stretch, title = busiest_stretch(data.timepts, data.outputs, residual), f"Models and record {data.name}"
    with frame.axes([1.9, 1.0] * data.n_outputs, 1) as (axes, lines):
        for i, (output, unit) in enumerate(zip(data.output_labels, data.output_units, strict=True)):
            upper, lower = axes[2 * i, 0], axes[2 * i + 1, 0]
            # the record lies under the models, broad and pale: a good model would hide it otherwise
            lines[2 * i, 0] = upper.plot(
                data.timepts, data.outputs[i], color="0.72", linewidth=2.8, label=data.name, zorder=1
            )
            lines[2 * i + 1, 0] = []
            lower.axhline(0.0, color=MEASURED, linewidth=0.7, zorder=1)
            for m, name in enumerate(names):
                fit = "" if np.isnan(fits[m, i]) else f" (fit {_percent(fits[m, i])} %)"
                look = look_of(m, name, linewidth=0.8 * style(m).linewidth)
                times, run = _broken(data.timepts, result.runs[m, i], result.starts)
                lines[2 * i, 0] += upper.plot(times, run, **look | {"label": name + fit})
                times, rest = _broken(data.timepts, residual[m, i], result.starts)
                draw = trace if stretch is None else Axes.plot  # a stretch has room for lines
                lines[2 * i + 1, 0] += draw(lower, times, rest, **look)
            _focus(upper, data.outputs[i], result.runs[:, i])
            upper.set_ylabel(unit_text(output, unit))
            lower.set_ylabel(unit_text("Residual", unit))
        axes[-1, 0].set_xlabel("Time [s]")
        axes[-1, 0].margins(x=0.01)
        if stretch is not None:
            axes[-1, 0].set_xlim(stretch)
            title += ", where they differ most"
        axes[0, 0].figure.align_ylabels(axes[:, 0])
        return frame.finish(axes, lines, title, axes[::2, 0])


def _percent(fit: float) -> str:
    """Format a fit in percent.

    It has one decimal, two if it is close to 100, and four significant digits if it is far below zero.
    """
    if abs(fit) < 99.5:
        return f"{fit:.1f}"
    return f"{fit:.4g}" if fit < 0 else f"{fit:.2f}"


def _broken(times: Any, values: Any, starts: Sequence[int]) -> tuple[Any, Any]:
    """A line that stops at the start of each window."""
    cuts = np.asarray(starts[1:], dtype=int)
    return np.insert(times, cuts, times[cuts]), np.insert(values, cuts, np.nan)


def _focus(axis: Any, measured: Any, runs: Any) -> None:
    """Keep the record readable where a model runs far away."""
    low, high = float(np.nanmin(measured)), float(np.nanmax(measured))
    span = (high - low) or max(abs(high), 1.0)
    reach = (max(float(runs.max()), high), min(float(runs.min()), low))
    if reach[0] > high + 2.0 * span or reach[1] < low - 2.0 * span:
        axis.set_ylim(
            max(reach[1], low - 2.0 * span) - 0.05 * span, min(reach[0], high + 2.0 * span) + 0.05 * span
        )


_LAGS = 25


def plot_residual(result: Comparison, frame: Frame) -> ct.ControlPlot:
    """Draw the correlations of residuals with themselves and the inputs.

    See `Comparison.plot`.
    """
    data = result.data
    check_whole(data, "plot('residual')")
    names = frame.labels(result.names)
    residual = data.outputs[None] - result.runs
    lags = min(_LAGS, data.n_samples // 4)
    with frame.axes([1.5] * data.n_outputs, 1 + data.n_inputs) as (axes, lines):
        for i, j in np.ndindex(axes.shape):
            axis, source = axes[i, j], data.inputs[j - 1] if j else None
            lines[i, j] = _correlations(axis, residual[:, i], source, lags, names)
            if i == 0:
                of = f"with {data.input_labels[j - 1]} (left of 0: feedback)" if j else "with itself"
                axis.set_title(plain(of), fontsize="medium")
            if j == 0:
                axis.set_ylabel(plain(f"Correlation\n{data.output_labels[i]}"))
        for axis in axes[-1]:
            axis.set_xlabel("Lag [samples]")
        return frame.finish(axes, lines, f"Residuals on record {data.name}")


def _correlations(
    axis: Any, residuals: Array, source: Array | None, lags: int, names: Sequence[str]
) -> list[Any]:
    """Draw the correlations of residuals with an input or themselves."""
    drawn, wide, dotted = list[Any](), 0.0, {"linewidth": 0.8, "linestyle": ":", "zorder": 2}
    for m, (name, e) in enumerate(zip(names, residuals, strict=True)):
        if np.ptp(e) == 0.0 or (source is not None and np.ptp(source) == 0.0):
            continue
        found = correlogram(e if source is None else source, e, lags)
        keep = found.lags > 0 if source is None else np.isfinite(found.lags)
        look = look_of(m, name, marker=".", markersize=3.5)
        drawn += axis.plot(found.lags[keep], found.correlation[keep], **look)
        bound = float(found.bound[0])
        wide = max(wide, bound)
        if len(names) > 1 and source is not None:  # each residual has a color of its own, and so a bound
            for level in (-bound, bound):
                axis.axhline(level, color=style(m).color, **dotted)
    text = "no correlation (99 % per lag)"
    axis.axhspan(-wide, wide, color=BAND, linewidth=0, zorder=1, label=text)
    axis.axhline(0.0, color=MEASURED, linewidth=0.7, zorder=2)
    if source is not None:
        axis.axvline(0.0, color=MEASURED, linewidth=0.7, linestyle=":", zorder=2)
    return drawn


def plot_horizon(result: Comparison, frame: Frame) -> ct.ControlPlot:
    """Error against how far ahead is predicted; see `Comparison.plot`."""
    found = horizon_error(result)
    data = result.data
    names = frame.labels(result.names)
    with frame.axes([2.2] * data.n_outputs, 1) as (axes, lines):
        for i in range(data.n_outputs):
            axis = axes[i, 0]
            for m, name in enumerate(names):
                look = look_of(m, name, marker=".")
                lines[i, 0] += axis.plot(found.seconds, found.rmse[m, i], **look)
                axis.axhline(
                    found.free_run[m, i], color=style(m).color, linewidth=0.8, linestyle=":", zorder=2,
                    label=("observer" if result.led else "simulation") if m == 0 else None,
                )  # fmt: skip
            label = unit_text(f"RMSE of {data.output_labels[i]}", data.output_units[i])
            scale = "log" if found.rmse[:, i].any() else "linear"  # no error has no logarithm
            axis.set(xscale="log", yscale=scale, ylabel=label)
        axes[-1, 0].set_xlabel("Prediction horizon [s]")
        return frame.finish(axes, lines, f"Error against prediction horizon, record {data.name}")
