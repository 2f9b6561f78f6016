"""Options of the next experiment: probability over cost."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import control as ct
import matplotlib.pyplot as plt
import numpy as np

if TYPE_CHECKING:
    from ..diagnosis.experiment import ExperimentAdvice

__all__ = ["experiment_plot"]


def experiment_plot(
    advice: ExperimentAdvice,
    *,
    ax: Any = None,
    label: str | None = None,
    title: str | None = None,
    legend_loc: str | bool | None = None,
    rcParams: dict[str, Any] | None = None,
    show_legend: bool | None = None,
) -> ct.ControlPlot:
    """Bars: probability with which each option separates the rivals, the cheapest on top.

    Parameters
    ----------
    advice : ExperimentAdvice
        Result of `Diagnosis.suggest_experiment`.
    ax : Axes, optional
        Where to draw.
    label : str, optional
        Label of the bars.
    title : str, optional
        Title.
    legend_loc : str or bool, optional
        Place of the legend, False for none.
    rcParams : dict, optional
        Matplotlib settings for this plot.
    show_legend : bool, optional
        Whether to show a legend.

    Returns
    -------
    ControlPlot
    """
    settings: Any = {**ct.rcParams, **(rcParams or {})}
    with plt.rc_context(settings):
        options = advice.options
        if ax is None:
            height = 1.6 + 0.32 * max(len(options), 1)
            _, ax = plt.subplots(figsize=(7.0, height), layout="constrained")
        rows = np.arange(len(options))
        colors = ["C0" if option is advice.chosen else "0.7" for option in options]
        values = [option.probability for option in options]
        bars = ax.barh(rows, values, color=colors, label=label or "then separated")
        for row, option in zip(rows, options, strict=True):
            text = "not possible" if option.failed else f"{option.probability:.2f}"
            far = f", {option.reach:.2g} x the motion" if 1.25 < option.reach < np.inf else ""
            inside = option.probability > 0.7
            ax.annotate(
                text + far,
                (option.probability, row),
                xytext=(-4 if inside else 4, 0),
                textcoords="offset points",
                ha="right" if inside else "left",
                va="center",
                fontsize="small",
                color="white" if inside and option is advice.chosen else "black",
            )
        line = ax.axvline(advice.probability, color="C3", linestyle="--", linewidth=1.2, label="asked for")
        names = [f"{option.name} ({option.cost:.2g})" for option in options]
        ax.set_yticks(rows, names)
        ax.invert_yaxis()
        ax.set_xlim(0, 1)
        ax.set_xlabel("probability that the true effect then stands alone")
        if title is None:
            title = "Next experiment (cost in record lengths)" if options else "Nothing to separate"
        ax.set_title(title)
        ax.grid(True, axis="x", alpha=0.4)
        shown = show_legend or (show_legend is None and legend_loc is not False and bool(options))
        place = legend_loc if isinstance(legend_loc, str) else "lower right"
        legend = ax.legend(loc=place, framealpha=0.9) if shown else None
    out = np.empty((1, 1), dtype=object)
    out[0, 0] = [*bars, line]
    return ct.ControlPlot(out, np.array([[ax]]), ax.figure, legend)
