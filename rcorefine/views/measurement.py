"""Tables and pictures of a record and of its measured frequency response."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import control as ct
import numpy as np

from ..data.frequency_response import FrequencyResponse
from ..data.measurement import Measurement
from ..diagnosis.check_rows import Check, CheckRow
from ..results import frequency_text
from .bode import BodeAxes, BodeUnits
from .figures import MEASURED, Frame, draws, trace, unit_text
from .tables import TextTable, Told, number, tabulates, tells

_HOLD_TEXT = {
    "zoh": "constant between samples",
    "foh": "straight lines between samples",
    "bandlimited": "band-limited between samples",
}


@tabulates(Measurement)
def measurement_table(data: Measurement) -> TextTable:
    """One row per signal of a record."""
    headers = ["signal", "unit", "role", "min", "mean", "max", "std"]
    rows = []
    for role, labels, units, signals in (
        ("input", data.input_labels, data.input_units, data.inputs),
        ("output", data.output_labels, data.output_units, data.outputs),
    ):
        for label, unit, signal in zip(labels, units, signals, strict=True):
            figures = (signal.min(), signal.mean(), signal.max(), signal.std())
            rows.append([label, unit, role, *(number(value) for value in figures)])
    title = (
        f"Record {data.name!r}: {data.n_samples} samples, dt = {number(data.dt, 6)} s, "
        f"t = {number(data.timepts[0])} ... {number(data.timepts[-1])} s"
    )
    notes = [f"hold {data.hold!r}: the inputs are taken as {_HOLD_TEXT[data.hold]}."]
    still = [row[0] for row in rows if row[2] == "input" and row[3] == row[5]]
    if still:
        notes.append(f"Constant over the record, so without visible effect: {', '.join(still)}.")
    notes += [f"{note}." for note in data.notes]
    return TextTable(headers, rows, title, notes, left=3)


@draws(Measurement)
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
            axis.grid(True, alpha=0.3)
        axes[-1, 0].set_xlabel("Time [s]")
        axes[0, 0].figure.align_ylabels(axes[:, 0])
        legends = [axes[0, 0]] if frame.show_legend or not fresh or frame.legend_loc else []
        return frame.finish(axes, lines, legends, f"Record {data.name}")


@tabulates(FrequencyResponse)
def frequency_response_table(measured: FrequencyResponse) -> TextTable:
    """One row per output and input of a measured frequency response."""
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
        return TextTable(headers, rows, title, [said], left=2)
    notes = [
        f"H1 from {measured.n_averages:.1f} effective segments of {measured.segment_length} samples, "
        f"lines {frequency_text(measured.resolution)} apart (narrower peaks are flattened).",
        "Coherence: share of the output power that the inputs explain linearly. 'coherence > 0.9': share "
        "of the frequencies with such a coherence. std/|G|: random error of a point.",
    ]
    if measured.n_omitted:
        notes.append(f"{measured.n_omitted} frequencies are left out: an input has no power there.")
    return TextTable(headers, rows, title, notes, left=2)


@draws(FrequencyResponse)
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
        title = f"Measured frequency response of {measured.name}"
        return frame.finish(axes, lines, [axes[0, 0]], title)


_HEADERS = ["", "looked at", "where", "found"]


@tells(Check)
def check_told(found: Check) -> Told:
    """Return the warnings of a check and the table of all its findings."""
    looks = [f"{row.status.upper()}: {row.sentence}" for row in found.looks]
    head = looks or ["No problem found: the record and the model can be compared."]
    quiet = [row.sentence for row in found.rows if row.what == "information" and row not in found.looks]
    return head, TextTable(_HEADERS, _rows(found.rows), "Check", [*head, *quiet], 4), quiet


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
