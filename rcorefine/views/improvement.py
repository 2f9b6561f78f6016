"""Table of an improvement, and plot of its error after each step.

The error is that on held-out data.
"""

from __future__ import annotations

import control as ct
import numpy as np

from ..diagnosis.checks.row import warned
from ..diagnosis.improvement import Improvement
from ..diagnosis.words import next_step
from ..words import counted, with_error
from .figures import Frame, draws
from .tables import Table, Told, root_mean_square, tells

__all__ = ["improvement_told", "plot_staircase"]


@tells(Improvement)
def improvement_told(found: Improvement) -> Told:
    """The steps, and what they mean."""
    headers = ["step", "coefficient", "fitted", "selection", "held out"]
    rows = []
    for i, step in enumerate(found.steps):
        value = ""
        if step.coefficients:
            key = next(iter(step.coefficients))
            value = with_error(step.coefficients[key], step.std[key])
        errors = (step.train_rmse, step.choice_rmse, step.validation_rmse)
        rows.append([f"{i} {step.name}", value, *(f"{root_mean_square(e):.4g}" for e in errors)])
    odd = warned(found.checks, found.verdict in ("adequate", "parameters"), [e.place for e in found.effects])
    said = found.sentences()
    above = [f"Improvement in {counted(len(found.steps) - 1, 'step')}: {found.verdict.upper()}", *odd]
    following = f"Next: {next_step(found)}"
    table = Table(headers, rows, f"Improvement: {found.verdict}", [*odd, *said, following])
    return above, table, [*said, following]


@draws(Improvement)
def plot_staircase(improvement: Improvement, frame: Frame) -> ct.ControlPlot:
    """Draw the error after each step on the three parts of the record.

    See `Improvement.plot`.
    """
    (held_out,) = frame.labels(["held out"])
    with frame.axes([1.0], 1, figsize=(7.0, 4.2)) as (axes, lines):
        ax = axes[0, 0]
        steps = improvement.steps
        position = np.arange(len(steps) + 1) - 0.5
        styles = (
            ("train_rmse", "fitted", "0.65", ":", 1.5),
            ("choice_rmse", "selection", "0.45", "--", 1.5),
            ("validation_rmse", held_out, "C0", "-", 2.5),
        )
        for attribute, name, color, line, width in styles:
            values = [root_mean_square(getattr(step, attribute)) for step in steps]
            look = {"color": color, "linestyle": line, "linewidth": width, "label": name}
            lines[0, 0] += ax.step(position, [values[0], *values], where="pre", **look)
        held = [root_mean_square(step.validation_rmse) for step in steps]
        for i, (value, step) in enumerate(zip(held, steps, strict=True)):
            others = (root_mean_square(rmse) for rmse in (step.train_rmse, step.choice_rmse))
            above = value >= max(others)  # the side on which no other line runs
            ax.annotate(
                f"{value:.3g}",
                (i, value),
                xytext=(0, 5 if above else -5),
                textcoords="offset points",
                ha="center",
                va="bottom" if above else "top",
                fontsize="small",
            )
        if min(held) > 0 and held[0] / min(held) > 5:
            ax.set_yscale("log")
            ax.set_ylim(bottom=min(held) / 2)
        else:
            ax.set_ylim(0, max(held) * 1.35)
        ax.set_xlim(-0.5, len(steps) - 0.5)
        ax.set_xticks(range(len(steps)), [step.name for step in steps], rotation=25, ha="right")
        unit = improvement.output_units[0] if len(improvement.output_units) == 1 else ""
        ax.set_ylabel(f"RMS error [{unit}]" if unit else "RMS error")
        ax.set_title(
            frame.title
            or f"Error after each step: {improvement.verdict} after {counted(len(steps) - 1, 'step')}"
        )
        ax.grid(True, axis="y", alpha=0.4)
        place = frame.legend_loc if isinstance(frame.legend_loc, str) else "upper right"
        legend = ax.legend(loc=place) if frame.legends else None
    return ct.ControlPlot(lines, axes, ax.figure, legend)
