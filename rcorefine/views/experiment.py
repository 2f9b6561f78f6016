"""Tables and plots of experiment advice and of confirmations.

They show what to measure next and what a further record confirms.
"""

from __future__ import annotations

import control as ct
import numpy as np

from ..diagnosis.confirmation import Confirmation
from ..diagnosis.experiment_design.result import ExperimentAdvice
from .figures import Frame, draws, unit_text
from .tables import Table, Told, tells

__all__ = [
    "advice_told",
    "confirmation_told",
    "plot_advice",
    "plot_confirmation",
]


def _head(advice: ExperimentAdvice) -> str:
    return "Experiment: " + (advice.chosen.name if advice.chosen else "nothing to separate")


@tells(ExperimentAdvice)
def advice_told(advice: ExperimentAdvice) -> Told:
    """The advice, and the experiments that were judged."""
    headers = ["experiment", "cost", "probability", "distance", "reach"]
    rows = [
        [
            ("> " if option is advice.chosen else "  ") + option.name,
            f"{option.cost:.3g}",
            "-" if option.failed else f"{option.probability:.2f}",
            "-" if option.failed else f"{option.distance:.3g}",
            "-" if option.failed else f"{option.reach:.2g}",
        ]
        for option in advice.options
    ]
    message, *rest = advice.sentences()
    return [_head(advice), message], Table(headers, rows, _head(advice), advice.sentences()), rest


@draws(ExperimentAdvice)
def plot_advice(advice: ExperimentAdvice, frame: Frame) -> ct.ControlPlot:
    """Draw the probability that each option separates the candidates.

    Each option is a bar, the cheapest on top.
    """
    options = advice.options
    (name,) = frame.labels(["candidates distinguished"])
    with frame.axes([1.0], 1, figsize=(7.0, 1.6 + 0.32 * max(len(options), 1))) as (axes, lines):
        ax = axes[0, 0]
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
            advice.probability, color="C3", linestyle="--", linewidth=1.2, zorder=0, label="required"
        )
        names = [f"{option.name} ({option.cost:.2g})" for option in options]
        ax.set_yticks(rows, names)
        ax.invert_yaxis()
        ax.set_xlim(0, 1)
        ax.set_xlabel("probability that only the true effect remains")
        heading = "Next experiment (cost in record lengths)" if options else "Nothing to separate"
        ax.set_title(heading if frame.title is None else frame.title)
        ax.grid(True, axis="x", alpha=0.4)
        lines[0, 0] = [*bars, line]
        legend = None
        if frame.show_legend or (frame.legends and options):
            if frame.ax is None and not isinstance(frame.legend_loc, str):
                legend = ax.figure.legend(loc="outside lower center", ncols=2)
            else:
                place = frame.legend_loc if isinstance(frame.legend_loc, str) else "best"
                legend = ax.legend(loc=place, framealpha=0.9)
    return ct.ControlPlot(lines, axes, ax.figure, legend)


@tells(Confirmation)
def confirmation_told(found: Confirmation) -> Told:
    """The verdict, the records, and what the columns are."""
    headers = ["record", "coefficient", "alone", "std", "level", "agreement", "residual"]
    rows = []
    for estimate in found.estimates:
        for i, name in enumerate(found.names):
            first = i == 0
            rows.append(
                [
                    estimate.name if first else "",
                    name,
                    f"{estimate.coefficients[i]:.4g}",
                    f"{estimate.std[i]:.2g}",
                    f"{estimate.level:.3g}" if first else "",
                    f"{estimate.agreement:.2g}" if first and estimate is not found.estimates[0] else "",
                    f"{estimate.residual:.2g}" if first else "",
                ]
            )
    message, *rest = found.sentences()
    return (
        [f"Further records: {found.verdict.upper()}", message],
        Table(headers, rows, f"Further records: {found.verdict}", found.sentences(), left=2),
        rest,
    )


@draws(Confirmation)
def plot_confirmation(confirmation: Confirmation, frame: Frame) -> ct.ControlPlot:
    """Draw the coefficients of each record with 95 % intervals.

    They are estimated from each record alone. Each coefficient has its own panel.
    """
    count = len(confirmation.names)
    (name,) = frame.labels(["95 % interval"])
    if frame.ax is not None and (given := np.asarray(frame.ax, dtype=object).size) != count:
        raise ct.ControlDimension(f"ax holds {given} axes; there are {count} coefficients")
    with frame.axes([1.0], count, figsize=(2.2 + 2.8 * count, 3.2)) as (axes, lines):
        names = [
            f"{e.name}, level {e.level:.2g}\nresidual p = {e.residual:.2g}" for e in confirmation.estimates
        ]
        places = np.arange(len(names))
        for i, axis in enumerate(axes[0]):
            values = np.array([e.coefficients[i] for e in confirmation.estimates])
            spread = 1.96 * np.array([e.std[i] for e in confirmation.estimates])
            bars = axis.errorbar(places, values, spread, fmt="o", capsize=4, label=name)
            lines[0, i] = [bars.lines[0]]
            factors = np.array([e.factors[i] for e in confirmation.estimates])
            if np.ptp(factors):
                axis.plot(places, values[0] * factors, "_", color="tab:red", ms=24, label="in proportion")
                axis.legend(framealpha=0.9)
            axis.set_xticks(places, names)
            axis.set_xlim(-0.5, len(names) - 0.5)
            axis.set_ylabel(unit_text(confirmation.names[i], confirmation.units[i]))
            axis.grid(True, axis="y", alpha=0.4)
        legends = [axes[0, 0]] if frame.label is not None or frame.show_legend else []
        return frame.finish(axes, lines, legends, f"Each record alone: {confirmation.verdict}")
