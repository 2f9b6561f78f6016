"""Table of a survey, and plot of its coefficients over all machines."""

from __future__ import annotations

from typing import Any

import control as ct
import numpy as np

from ..fleet.comparison import FleetEffect
from ..fleet.result import Survey
from ..fleet.row import SurveyRow
from ..words import counted, with_error
from .figures import BAND, Frame, draws, plain, unit_text
from .tables import Table, Told, number, tells

__all__ = ["plot_survey", "row_cells", "survey_told"]

_SHOWN = 12  # rows of the text; the others are counted
_NAMED = 40  # machines up to which each has its name on the axis


def row_cells(row: SurveyRow) -> list[str]:
    """Return the cells of one row.

    They are machine, record, verdict, effect, coefficient, probability and seconds.
    """
    if row.error is not None:
        return [row.machine, row.record, "failed", row.error, "", "", f"{row.seconds:.2g}"]
    size = "" if row.coefficient is None or row.std is None else with_error(row.coefficient, row.std)
    chance = "" if row.probability is None else number(row.probability, 3)
    return [row.machine, row.record, row.verdict or "", row.label, size, chance, f"{row.seconds:.2g}"]


@tells(Survey)
def survey_told(found: Survey) -> Told:
    """Return the text of a survey, the most important rows first.

    Failed rows come first, then machines that stand out, then rows with effects.
    """
    out = {machine.machine for _, machine in found.standing_out} | {t.machine for t in found.growing}
    order = sorted(found.rows, key=lambda row: (row.error is None, row.machine not in out, not row.effects))
    said = found.sentences()
    left = len(order) - _SHOWN
    more = [f"... and {counted(left, 'row')} more in `rows` and `to_dataframe()`."] if left > 0 else []
    headers = ["machine", "record", "verdict", "effect", "coefficient", "prob.", "s"]
    title = f"Survey ({found.task}): {said[0]}"
    below = [*more, *said[1:]]
    return [title], Table(headers, [row_cells(row) for row in order[:_SHOWN]], title, below, 4), below


@draws(Survey)
def plot_survey(found: Survey, frame: Frame) -> ct.ControlPlot:
    """Panels, one per coefficient; see `Survey.plot`."""
    shown = [effect for effect in found.effects if effect.sort != "unclear"] or list(found.effects)
    count = max(len(shown), 1)
    with frame.axes([2.0] * count, 1, sharex=False) as (axes, lines):
        labels = frame.labels([effect.label for effect in shown]) if shown else []
        for panel, effect, label, k in zip(axes[:, 0], shown, labels, range(count), strict=False):
            lines[k, 0] = _panel(panel, effect)
            panel.set_title(plain(f"{label}: {effect.sort}"), fontsize="medium")
            panel.set_ylabel(unit_text("", effect.unit) if effect.unit else "")
        if not shown:
            axes[0, 0].text(0.5, 0.5, "no coefficient to compare", ha="center", va="center")
        return frame.finish(axes, lines, [axes[0, 0]], f"{len(found.machines)} machines")


def _panel(panel: Any, effect: FleetEffect) -> list[Any]:
    machines = effect.machines
    where = np.arange(len(machines))
    panel.axhspan(effect.mean - effect.spread, effect.mean + effect.spread, color=BAND, alpha=0.6, lw=0)
    drawn = [panel.axhline(effect.mean, color="0.3", linewidth=1.2, label="fleet: mean, spread")]
    out = np.array([machine.stands_out for machine in machines])
    for chosen, color, text in (
        (~out, "#1f4e9c", "machine, 95 %"),
        (out, "#b5400a", "stands out"),
    ):
        if chosen.any():
            mine = [machine for machine, wanted in zip(machines, chosen, strict=True) if wanted]
            drawn.append(
                panel.errorbar(
                    where[chosen],
                    [m.value for m in mine],
                    [1.96 * m.std for m in mine],
                    fmt="o", color=color, capsize=2, markersize=3.5, label=text,
                )
            )  # fmt: skip
    drawn += panel.plot(
        where,
        [m.pooled for m in machines],
        "_",
        color="0.15",
        markersize=9,
        label="shrunk toward the fleet mean",
    )
    if len(machines) <= _NAMED:
        panel.set_xticks(
            where, [plain(m.machine) for m in machines], rotation=40, ha="right", fontsize="small"
        )
    else:
        panel.set_xlabel(f"machine (of {len(machines)})")
    panel.axhline(0.0, color="black", linewidth=0.6)
    panel.grid(True, axis="y", alpha=0.3)
    return drawn
