"""The staircase: held-out error after each effect."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import control as ct
import matplotlib.pyplot as plt
import numpy as np

from .figures import curve_labels, only_axes, picture

if TYPE_CHECKING:
    from ..diagnosis.stepwise.improvement import Improvement

__all__ = ["staircase_plot"]


@picture
def staircase_plot(
    improvement: Improvement,
    *,
    ax: Any = None,
    label: str | None = None,
    title: str | None = None,
    legend_loc: str | bool | None = "upper right",
    rcParams: dict[str, Any] | None = None,
    show_legend: bool | None = None,
) -> ct.ControlPlot:
    """Error after each step on the three parts of the record, the effect's name on each step.

    Parameters
    ----------
    improvement : Improvement
        Result of `improve`.
    ax : Axes, optional
        Where to draw.
    label : str, optional
        Label of the held-out line.
    title : str, optional
        Title.
    legend_loc : str, optional
        Place of the legend.
    rcParams : dict, optional
        Matplotlib settings for this plot.
    show_legend : bool, optional
        Whether to show a legend; default True.

    Returns
    -------
    ControlPlot
    """
    settings: Any = {**ct.rcParams, **(rcParams or {})}
    with plt.rc_context(settings):
        if ax is None:
            _, ax = plt.subplots(figsize=(7.0, 4.2), layout="constrained")
        ax = only_axes(ax)
        (held_out,) = curve_labels(label, ["held out"])
        steps = improvement.steps
        base = np.array([np.sqrt(np.mean(steps[0].validation_rmse ** 2))])
        position = np.arange(len(steps) + 1) - 0.5
        lines = []
        styles = (
            ("train_rmse", "fitted", "0.65", ":", 1.5),
            ("choice_rmse", "chosen on", "0.45", "--", 1.5),
            ("validation_rmse", held_out, "C0", "-", 2.5),
        )
        for attribute, name, color, line, width in styles:
            values = [float(np.sqrt(np.mean(getattr(step, attribute) ** 2))) for step in steps]
            lines += ax.step(
                position,
                [values[0], *values],
                where="pre",
                color=color,
                linestyle=line,
                linewidth=width,
                label=name,
            )
        held = [float(np.sqrt(np.mean(step.validation_rmse**2))) for step in steps]
        for i, (value, step) in enumerate(zip(held, steps, strict=True)):
            others = (float(np.sqrt(np.mean(rmse**2))) for rmse in (step.train_rmse, step.choice_rmse))
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
        if min(held) > 0 and base[0] / min(held) > 5:
            ax.set_yscale("log")
            ax.set_ylim(bottom=min(held) / 2)
        else:
            ax.set_ylim(0, max(held) * 1.35)
        ax.set_xlim(-0.5, len(steps) - 0.5)
        ax.set_xticks(range(len(steps)), [step.name for step in steps], rotation=25, ha="right")
        unit = improvement.output_units[0] if len(improvement.output_units) == 1 else ""
        ax.set_ylabel(f"RMS error [{unit}]" if unit else "RMS error")
        ax.set_title(title or f"The error falls: {improvement.verdict} after {len(steps) - 1} step(s)")
        ax.grid(True, axis="y", alpha=0.4)
        shown = show_legend or (show_legend is None and legend_loc is not False)
        legend = ax.legend(loc=legend_loc if isinstance(legend_loc, str) else None) if shown else None
    out = np.empty((1, 1), dtype=object)
    out[0, 0] = lines
    return ct.ControlPlot(out, np.array([[ax]]), ax.figure, legend)
