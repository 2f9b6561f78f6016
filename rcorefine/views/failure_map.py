"""Tables and picture of a `FailureMap`."""

from __future__ import annotations

from typing import Any

import control as ct
import numpy as np

from ..comparison.failure_map.search import FailureMap
from ..comparison.failure_map.state import residual_force
from ..comparison.model_error import model_error
from ..comparison.result import Comparison
from ..exceptions import DataError
from ..results import chance, counted
from .bode import BodeUnits
from .content import Content, content, fields
from .figures import BAND, MEASURED, Frame, log_labels, plain, style, trace, unit_text
from .tables import TextTable, cells, clip


@content.register
def map_content(found: FailureMap) -> Content:
    """Return the content of a failure map: each failure in a row."""
    return Content(
        tables=[failure_table(found)], data=lambda: {**fields(found, "name notes"), "rows": tuple(found)}
    )


def failure_table(found: FailureMap, *, full: bool = False) -> TextTable:
    """Return a table with one row per failure; in full with all sentences.

    If there is no failure, the title and the notes say so.
    """
    rows = []
    for row in found.rows:
        figures = cells(row, "dimension where measure" + " statistic:.3g" * full)
        rows.append(
            [
                row.mark,
                *figures,
                f"{100 * row.share:{'.3g' if full else '.0f'}} %",
                chance(row.p_value),
            ]
        )
    title = f"Where {found.name!r} fails: {counted(len(rows), 'row')}"
    notes = [f"{k}. {row.sentence}" for k, row in enumerate(found.rows[: None if full else 4], 1)]
    if rows:
        notes.append(
            "share: part of the error energy that the row explains (rows overlap). p-value: probability of "
            "such a row by chance if the model were right. 1: best single explanation; +: adds to the rows "
            "above; =: alternative to row 1."
        )
        notes += ["statistic: twice the increase of the log-likelihood."] * full
    elif found.looked:
        title = f"No failure of {found.name!r} found (searched: {', '.join(found.looked)})"
        notes = [
            "No significant failure: the residual looks like noise that is independent of input, motion and "
            "time."
        ]
    else:
        title = f"Failures of {found.name!r} were not searched"
    notes += [f"{note}." for note in found.notes]
    headers = ["", "", "where", "measure", *["statistic"] * full, "share", "p-value"]
    return TextTable(headers, rows, title, notes, left=4)


_ROWS = (1.6, 1.3, 1.5, 1.5)
_LOOKS = {
    "time": ("#1f4e9c", ""), "frequency": ("#b5400a", "///"), "amplitude": ("#1b7837", "..."),
    "state": ("#7b3294", "xxx"), "place": ("0.6", "\\\\\\"),
}  # fmt: skip
_MARK = "#e8c9b8"


def plot_map(result: Comparison, frame: Frame) -> ct.ControlPlot:
    """Draw the failure map of each model in four rows.

    The rows show shares, residual over time, error over frequency, and force over motion.
    """
    maps = result.failures if result.several else (result.failures,)
    names = frame.labels(result.names)
    size = (max(7.0, 4.0 * len(maps)), 8.2)
    with frame.axes(_ROWS, len(maps), figsize=size, sharex=False) as (axes, lines):
        for m, (found, name) in enumerate(zip(maps, names, strict=True)):
            lines[0, m] = _shares(axes[0, m], found, name)
            lines[1, m] = _times(axes[1, m], result, m, found)
            lines[2, m] = _frequencies(axes[2, m], result, m, found)
            lines[3, m] = _motions(axes[3, m], result, m, found)
        title = f"Where the model fails on record {result.data.name}"
        return frame.finish(axes, lines, title, [axes[2, 0]])


def _shares(axis: Any, found: FailureMap, name: str) -> list[Any]:
    """Bars: share of the error that each row explains."""
    rows = list(found.rows)[:6]
    drawn = []
    for k, row in enumerate(rows):
        color, hatch = _LOOKS[row.dimension]
        drawn += axis.barh(
            k, 100 * row.share, color=color, hatch=hatch, edgecolor="white", alpha=0.85, height=0.7
        )  # fmt: skip
        text = plain(clip(f"{row.dimension}: {row.where} ({row.measure})", 62))
        axis.text(1.5, k, text, va="center", fontsize="x-small", zorder=4,
                  bbox={"facecolor": "white", "alpha": 0.8, "linewidth": 0, "pad": 0.8})  # fmt: skip
    if not rows:
        said = "no significant failure" if found.looked else "not searched"
        axis.text(50, 0, said, ha="center", va="center")
    axis.set_yticks(range(len(rows)), [str(k + 1) for k in range(len(rows))])
    axis.set(xlim=(0, 100), ylim=(max(len(rows), 1) - 0.4, -0.6))
    axis.set_xlabel("Share of the error [%] (rows overlap)")
    axis.set_title(plain(name), fontsize="medium")
    return drawn


def _times(axis: Any, result: Comparison, m: int, found: FailureMap) -> list[Any]:
    """Residuals over time, marked stretches shaded."""
    data = result.data
    drawn = []
    for i, name in enumerate(data.output_labels):
        look: dict[str, Any] = style(i)._asdict() | {"linewidth": 0.7, "linestyle": "-"}
        residual = data.outputs[i] - result.runs[m, i]
        drawn += trace(axis, data.timepts, residual, label=name, zorder=2, **look)
    for row in found.rows:
        if row.dimension == "time" and "start" in row.values:
            axis.axvspan(row.values["start"], row.values["stop"], color=_MARK, zorder=1)
    unit = data.output_units[0] if len(set(data.output_units)) == 1 else ""
    axis.set(xlabel="Time [s]", ylabel=unit_text("Residual", unit))
    axis.margins(x=0.01)
    if data.n_outputs > 1:
        axis.legend(fontsize="x-small", loc="upper right", ncols=data.n_outputs)
    return list(drawn)


def _frequencies(axis: Any, result: Comparison, m: int, found: FailureMap) -> list[Any]:
    """Draw the relative error of the model over frequency.

    The simultaneous band is drawn with it, and the frequency bands that were found are shaded.
    """
    units = BodeUnits.from_defaults()
    factor = units.frequency_factor
    axis.set(xlabel=f"Frequency [{units.frequency}]", ylabel="Error |G$_{meas}$/G - 1|")
    try:
        error = model_error(result, m)
    except DataError:
        axis.text(0.5, 0.5, "the input has no excitation", ha="center", transform=axis.transAxes)
        return []
    size = np.abs(error.model)
    significance = np.sum((np.abs(error.error) / error.simultaneous) ** 2, axis=-1)
    i, j = (int(k) for k in np.unravel_index(int(np.argmax(significance)), size.shape[:2]))
    ratio, bound = error.relative[i, j], error.simultaneous[i, j] / np.maximum(size[i, j], 1e-300)
    low = max(0.3 * float(np.nanquantile(np.minimum(ratio, bound), 0.02)), 1e-6)
    x = error.omega * factor
    axis.fill_between(x, low, np.maximum(bound, low), color=BAND, linewidth=0, zorder=1,
                      label="noise only (95 %, simultaneous)")  # fmt: skip
    beyond = error.differs[i, j]
    drawn = axis.plot(x, ratio, color="0.45", linewidth=0.8, zorder=2)
    drawn += axis.plot(
        x[beyond], ratio[beyond], linestyle="none", marker=".", color=MEASURED, zorder=3,
        label=plain(f"differs, {result.data.input_labels[j]} to {result.data.output_labels[i]}"),
    )  # fmt: skip
    for row in found.rows:
        if row.dimension == "frequency" and row.values.get("kind") != "gain":
            axis.axvspan(max(row.values["low"] * factor, x[0]), min(row.values["high"] * factor, x[-1]),
                         color=_MARK, zorder=0, alpha=0.5)  # fmt: skip
    top = max(3.0, min(2.0 * float(np.nanmax(ratio)), 100.0))
    axis.set(xscale="log", yscale="log", xlim=(x[0], x[-1]), ylim=(low, top))
    log_labels(axis.xaxis)
    return list(drawn)


def _motions(axis: Any, result: Comparison, m: int, found: FailureMap) -> list[Any]:
    """Draw the residual force over displacement or velocity.

    The place is the one that matters most.
    """
    rows = [row for kind in ("state", "place") for row in found.rows if row.dimension == kind]
    lead = rows[0] if rows else None
    force = residual_force(result, m, None if lead is None else str(lead.values["place"]))
    if force is None:
        axis.text(0.5, 0.5, "no place to show", ha="center", transform=axis.transAxes)
        return []
    over_d = np.ptp(force.position) > 0 and (lead is None or lead.values.get("axis", "d") == "d")
    motion, unit = (force.position, force.position_unit) if over_d else (force.velocity, force.velocity_unit)
    name = "displacement d" if over_d else ("velocity v" if force.mechanical else "x")
    dots = {"linestyle": "none", "marker": ",", "color": "0.6", "zorder": 1, "rasterized": True}
    drawn = axis.plot(motion, force.force, **dots)
    edges = np.unique(np.quantile(motion, np.linspace(0.002, 0.998, 22)))  # one where nothing moves
    cell = np.clip(np.searchsorted(edges, motion) - 1, 0, edges.size - 2)
    centers, means, spreads = [], [], []
    for c in range(edges.size - 1):
        inside = force.force[cell == c]
        if inside.size > 5:
            centers.append(float(motion[cell == c].mean()))
            means.append(float(np.median(inside)))
            # neighbors in time say the same: a tenth of the samples counts
            scatter = 1.4826 * float(np.median(np.abs(inside - np.median(inside))))
            spreads.append(2.0 * scatter / np.sqrt(max(inside.size / 10.0, 1.0)))
    drawn += list(axis.errorbar(centers, means, spreads, color="#7b3294", marker="o", markersize=3.5,
                                linewidth=1.2, capsize=2, zorder=3).lines[:1])  # fmt: skip
    # where a free run begins the estimate has no past yet: its first samples are not to set the scale
    if means:
        reach = 1.8 * max(np.max(np.abs(means) + spreads), 1e-300)
        axis.set_ylim(-reach, reach)
        axis.set_xlim(edges[0] - 0.05 * np.ptp(edges), edges[-1] + 0.05 * np.ptp(edges))
    axis.axhline(0.0, color=MEASURED, linewidth=0.7, zorder=2)
    axis.set_xlabel(unit_text(f"{name} at {force.place}", unit))
    axis.set_ylabel(unit_text("Missing\nforce", force.force_unit))
    return list(drawn)
