"""Pictures of what to measure next, and of what a further record says."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import control as ct
import matplotlib.pyplot as plt
import numpy as np

from .figures import curve_labels, finish, only_axes, picture, unit_text

if TYPE_CHECKING:
    from ..diagnosis.confirmation import Confirmation
    from ..diagnosis.experiment_design.result import ExperimentAdvice

__all__ = ["confirmation_plot", "experiment_plot"]


@picture
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
        own = ax is None
        if own:
            height = 1.6 + 0.32 * max(len(options), 1)
            _, ax = plt.subplots(figsize=(7.0, height), layout="constrained")
        ax = only_axes(ax)
        (name,) = curve_labels(label, ["then separated"])
        rows = np.arange(len(options))
        colors = ["C0" if option is advice.chosen else "0.7" for option in options]
        values = [option.probability for option in options]
        bars = ax.barh(rows, values, color=colors, label=name)
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
        line = ax.axvline(
            advice.probability, color="C3", linestyle="--", linewidth=1.2, zorder=0, label="asked for"
        )
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
        legend = None
        if shown and (own and not isinstance(legend_loc, str)):
            legend = ax.figure.legend(loc="outside lower center", ncols=2)
        elif shown:
            legend = ax.legend(loc=legend_loc if isinstance(legend_loc, str) else "best", framealpha=0.9)
    out = np.empty((1, 1), dtype=object)
    out[0, 0] = [*bars, line]
    return ct.ControlPlot(out, np.array([[ax]]), ax.figure, legend)


@picture
def confirmation_plot(
    confirmation: Confirmation,
    *,
    ax: Any = None,
    label: str | None = None,
    title: str | None = None,
    legend_loc: str | bool | None = None,
    rcParams: dict[str, Any] | None = None,
    show_legend: bool | None = None,
) -> ct.ControlPlot:
    """Coefficients of each record alone, with 95 % intervals, one panel per coefficient.

    Parameters
    ----------
    confirmation : Confirmation
        Result of `confirm`.
    ax : Axes or array of Axes, optional
        Where to draw, one per coefficient.
    label : str, optional
        Label of the estimates.
    title : str, optional
        Title.
    legend_loc : str or bool, optional
        Place of the legend, False for none.
    rcParams : dict, optional
        Matplotlib settings for this plot.
    show_legend : bool, optional
        Whether to show a legend; default only where a label is given.

    Returns
    -------
    ControlPlot
    """
    settings: Any = {**ct.rcParams, **(rcParams or {})}
    with plt.rc_context(settings):
        count = len(confirmation.names)
        if ax is None:
            _, ax = plt.subplots(
                1, count, squeeze=False, figsize=(2.2 + 2.8 * count, 3.2), layout="constrained"
            )
        axes = np.atleast_1d(np.asarray(ax, dtype=object)).reshape(1, -1)
        if axes.size != count:
            raise ct.ControlDimension(f"ax holds {axes.size} axes; there are {count} coefficients")
        (name,) = curve_labels(label, ["95 % interval"])
        lines = np.empty((1, count), dtype=object)
        names = [
            f"{e.name}, {e.level:.2g} x input\nresidual p = {e.residual:.2g}" for e in confirmation.estimates
        ]
        places = np.arange(len(names))
        for i, axis in enumerate(axes[0]):
            values = np.array([e.coefficients[i] for e in confirmation.estimates])
            spread = 1.96 * np.array([e.std[i] for e in confirmation.estimates])
            bars = axis.errorbar(places, values, spread, fmt="o", capsize=4, label=name)
            lines[0, i] = [bars.lines[0]]
            axis.set_xticks(places, names)
            axis.set_xlim(-0.5, len(names) - 0.5)
            axis.set_ylabel(unit_text(confirmation.names[i], confirmation.units[i]))
            axis.grid(True, axis="y", alpha=0.4)
        axes[0, 0].figure.suptitle(title or f"Each record alone: {confirmation.verdict}")
        return finish(
            axes[0, 0].figure,
            axes,
            lines,
            title=None,
            legends=[axes[0, 0]] if label is not None or show_legend else [],
            legend_loc=legend_loc,
            show_legend=show_legend,
        )
