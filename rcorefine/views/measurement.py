"""Tables and pictures of a record and of its measured frequency response."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import control as ct
import numpy as np

from ..data.frequency_response import FrequencyResponse
from ..data.measurement import Measurement
from ..diagnosis.check_rows import Check, CheckRow
from ..results import frequency_text
from .bode import BodeAxes, BodeUnits
from .content import Content, content, fields
from .figures import MEASURED, Frame, style, trace, unit_text
from .tables import TextTable, number, wrapped

_HOLD_TEXT = {
    "zoh": "constant between samples",
    "foh": "straight lines between samples",
    "bandlimited": "band-limited between samples",
}


@content.register
def measurement_content(data: Measurement) -> Content:
    """Return the content of a record: each signal in a row."""
    headers = ["signal", "unit", "role", "min", "mean", "max", "std"]
    labels, units = data.input_labels + data.output_labels, data.input_units + data.output_units
    signals, rows = np.vstack([data.inputs, data.outputs]), []
    for k, (label, unit, signal) in enumerate(zip(labels, units, signals, strict=True)):
        figures = (np.nanmin(signal), np.nanmean(signal), np.nanmax(signal), np.nanstd(signal))
        rows.append([label, unit, "input" if k < data.n_inputs else "output", *map(number, figures)])
    title = (
        f"Record {data.name!r}: {data.n_samples} samples, dt = {number(data.dt, 6)} s, "
        f"t = {number(data.timepts[0])} ... {number(data.timepts[-1])} s"
    )
    notes = [f"hold {data.hold!r}: the inputs are taken as {_HOLD_TEXT[data.hold]}."]
    still = [row[0] for row in rows if row[2] == "input" and row[3] == row[5]]
    if still:
        notes.append(f"Constant over the record, so without visible effect: {', '.join(still)}.")
    notes += [f"{note}." for note in data.notes]
    return Content(
        tables=[TextTable(headers, rows, title, notes, left=3)],
        columns=lambda: (dict(zip(labels, signals, strict=True)), data.timepts, "time"),
        pictures={"plot": plot_measurement},
    )


def plot_measurement(data: Measurement, frame: Frame) -> ct.ControlPlot:
    """Outputs above inputs, one row per signal; see `Measurement.plot`."""
    n_rows = data.n_outputs + data.n_inputs
    (name,) = frame.labels([data.name])
    with frame.axes([1.2] * n_rows, 1) as (axes, lines):
        signals = np.vstack([data.outputs, data.inputs])
        labels = data.output_labels + data.input_labels
        units = data.output_units + data.input_units
        fresh = frame.ax is None
        for row in range(n_rows):
            axis = axes[row, 0]
            steps = "steps-post" if row >= data.n_outputs and data.hold == "zoh" else "default"
            look: dict[str, Any] = {"color": MEASURED} if fresh else {}
            lines[row, 0] = trace(
                axis, data.timepts, signals[row], drawstyle=steps, linewidth=1.0, label=name, **look
            )
            axis.set_ylabel(unit_text(labels[row], units[row]))
        axes[-1, 0].set_xlabel("Time [s]")
        axes[0, 0].figure.align_ylabels(axes[:, 0])
        legends = [axes[0, 0]] if frame.show_legend or not fresh or frame.legend_loc else []
        return frame.finish(axes, lines, f"Record {data.name}", legends)


@content.register
def frequency_response_content(measured: FrequencyResponse) -> Content:
    """Return the content of a measured response: each channel in a row."""
    units = BodeUnits.from_defaults()
    headers = ["output", "input", "peak |G|", f"at [{units.frequency}]", "coherence > 0.9", "median std/|G|"]
    rows = []
    points = measured.omega * units.frequency_factor
    for i, output in enumerate(measured.output_labels):
        share = "-" if measured.coherence is None else f"{float(np.mean(measured.coherence[i] > 0.9)):.0%}"
        for j, source in enumerate(measured.input_labels):
            magnitude = measured.magnitude[i, j]
            top = int(np.argmax(magnitude))
            relative = "-"
            if measured.std is not None:
                floor = np.maximum(magnitude, np.finfo(float).tiny)
                relative = f"{float(np.median(measured.std[i, j] / floor)):.2%}"
            rows.append([output, source, number(magnitude[top]), number(points[top]), share, relative])
    title = (
        f"Measured frequency response of {measured.name!r}: {points.size} points, "
        f"{number(points[0])} ... {number(points[-1])} {units.frequency}"
    )
    if measured.segment_length == 0:
        known = {"coherence": measured.coherence, "error": measured.std}
        unknown = [word for word, value in known.items() if value is None]
        said = f"Taken as given: {' and '.join(unknown)} are not known." if unknown else "Taken as given."
        if measured.amplitude is not None:
            low, high = measured.amplitude.min(), measured.amplitude.max()
            unit = measured.input_units[0]
            peak = number(low) if low == high else f"{number(low)} ... {number(high)}"
            said += f" Sines of peak {f'{peak} {unit}'.strip()} at the input."
        notes = [said]
    else:
        notes = [
            f"H1 from {measured.n_averages:.1f} effective segments of {measured.segment_length} samples, "
            f"lines {frequency_text(measured.resolution)} apart (narrower peaks are flattened).",
            "Coherence: share of the output power that the inputs explain linearly. 'coherence > 0.9': share "
            "of the frequencies with such a coherence. std/|G|: random error of a point.",
        ]
        if measured.n_omitted:
            notes.append(f"{measured.n_omitted} frequencies are left out: an input has no power there.")
    names = {"name": measured.name, "inputs": measured.input_labels, "outputs": measured.output_labels}
    more = "omega coherence std amplitude n_averages dt hold"
    columns = {
        f"{output}/{given}": measured.frdata[i, j]
        for i, output in enumerate(measured.output_labels)
        for j, given in enumerate(measured.input_labels)
    }
    return Content(
        tables=[TextTable(headers, rows, title, notes, left=2)],
        data=lambda: {**names, "response": measured.frdata, **fields(measured, more)},
        columns=lambda: (columns, measured.omega, "omega"),
        pictures={"plot": plot_frequency_response},
    )


def plot_frequency_response(measured: FrequencyResponse, frame: Frame) -> ct.ControlPlot:
    """Magnitude, phase and coherence; see `FrequencyResponse.plot`."""
    n_y, n_w = measured.response.shape[:2]
    (name,) = frame.labels([measured.name])
    with frame.axes([1.8, 1.4, 0.9] * n_y, n_w) as (axes, lines):
        drawn = BodeAxes(axes, lines, measured.output_labels, measured.input_labels, "coherence")
        drawn.measured(measured, name)
        drawn.limits()
        x = measured.omega * drawn.units.frequency_factor
        for i, j in np.ndindex(n_y, n_w):
            share = np.full(x.size, np.nan) if measured.coherence is None else measured.coherence[i]
            lines[3 * i + 2, j] = axes[3 * i + 2, j].plot(x, share, color=MEASURED, linewidth=1.0)
            axes[3 * i + 2, j].set_ylim(0.0, 1.05)
        return frame.finish(axes, lines, f"Measured frequency response of {measured.name}")


_TOLD = 3  # remarks above the picture
_HEADERS = ["", "looked at", "where", "found"]


@content.register
def check_content(found: Check) -> Content:
    """Return the content of a check: the warnings, and all its findings."""
    looks = [f"{row.status.upper()}: {row.sentence}" for row in found.looks]
    return Content(
        above=looks or ["No problem found: the record and the model can be compared."],
        tables=[TextTable(_HEADERS, _rows(found.rows), left=4)],
        answer=lambda: ([row.sentence for row in found.looks], not found.stops),
        data=lambda: fields(found, "rows detectable"),
        below=[row.sentence for row in found.rows if row.what == "information" and row not in found.looks],
        pictures={"plot": plot_check},
        records=[found.data],
    )


def plot_check(found: Check, frame: Frame) -> ct.ControlPlot:
    """Draw the record with its first remarks; see `Check.plot`."""
    first = check_content(found).above[:_TOLD]
    heading = "\n".join(wrapped(first)) if frame.title is None else frame.title
    drawn = plot_measurement(found.data, replace(frame, title=heading))
    named = {label for row in found.looks for label in row.where.split(", ")}
    for label, lines in zip(
        (*found.data.output_labels, *found.data.input_labels), drawn.lines.flat, strict=True
    ):
        if label in named:
            lines[0].set_color(style(1).color)
    return drawn


def odd(rows: Sequence[CheckRow]) -> list[TextTable]:
    """A table of what asks for attention, none where nothing does.

    Parameters
    ----------
    rows : sequence of CheckRow
        Rows that ask for attention.

    Returns
    -------
    list of TextTable
    """
    title, notes = "Checks that need attention", [row.sentence for row in rows]
    return [TextTable(_HEADERS, _rows(rows), title, notes, 4)] if rows else []


def _rows(rows: Sequence[CheckRow]) -> list[list[str]]:
    return [[row.status, row.what, row.where, row.figure] for row in rows]
