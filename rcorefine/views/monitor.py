"""The course of a monitor: how close to an alarm, what it takes the change for, how large it is."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import control as ct
import numpy as np

from ..exceptions import DataError
from .figures import BAND, curve_labels, finish, make_axes, picture, settings, style, unit_text

if TYPE_CHECKING:
    from ..streaming.monitor import Monitor

__all__ = ["monitor_plot"]

_MOST = 4  # candidates whose probability is drawn


@picture
def monitor_plot(
    monitor: Monitor,
    *,
    ax: Any = None,
    label: str | Sequence[str] | None = None,
    title: str | None = None,
    legend_loc: str | bool | None = None,
    rcParams: dict[str, Any] | None = None,
    show_legend: bool | None = None,
) -> ct.ControlPlot:
    """Statistic over its threshold, probabilities, and the named coefficient, over time.

    Parameters
    ----------
    monitor : Monitor
        Monitor past its learning phase.
    ax : array of Axes, shape (3, 1), optional
        Where to draw.
    label : str or sequence of str, optional
        Labels of the probabilities shown.
    title : str, optional
        Title.
    legend_loc, show_legend, rcParams
        As in python-control's plots.

    Returns
    -------
    ControlPlot
        Three rows.

    Raises
    ------
    DataError
        If there is nothing to draw yet.
    """
    t, p = monitor.timepts, monitor.probability
    if t.size == 0:
        raise DataError(
            f"nothing to draw yet: {monitor.n_samples} samples taken, the learning phase has {monitor.learn}"
        )
    peak = p[1:].max(axis=1)
    shown = [int(i) for i in np.argsort(-peak)[:_MOST] if peak[i] > 0.1]
    names = ["nothing", *(monitor.candidates[i].label for i in shown)]
    labels = curve_labels(label, names)
    alarms = [*monitor.past_alarms, *([monitor.alarm] if monitor.alarm else [])]
    with settings(rcParams):
        figure, axes = make_axes(ax, [1.2, 1.6, 1.2], 1)
        lines = np.empty((3, 1), dtype=object)
        top, middle, bottom = axes[:, 0]
        pen = style(0)
        lines[0, 0] = top.plot(t, monitor.statistic, color=pen.color, linewidth=1.0, label="statistic")
        top.axhline(1.0, color="0.3", linestyle="--", linewidth=1.0, label="threshold")
        top.set_yscale("log")
        top.set_ylabel("statistic /\nthreshold")
        lines[1, 0] = []
        for k, (row, name) in enumerate(zip([0, *(i + 1 for i in shown)], labels, strict=True)):
            pen = style(k)
            color = "0.6" if k == 0 else pen.color
            lines[1, 0] += middle.plot(
                t, p[row], color=color, linestyle=pen.linestyle, linewidth=pen.linewidth, label=name
            )
        middle.set_ylim(-0.03, 1.03)
        middle.set_ylabel("probability")
        value, std = monitor.coefficient
        pen = style(1)
        band = np.where(np.isfinite(std), std, 0.0)
        bottom.fill_between(t, value - 2 * band, value + 2 * band, color=BAND, linewidth=0)
        lines[2, 0] = bottom.plot(t, value, color=pen.color, linewidth=1.5)
        bottom.set_ylabel(_coefficient_name(monitor, alarms))
        bottom.set_xlabel("time [s]")
        for axis in (top, middle, bottom):
            axis.grid(True, alpha=0.35)
            for number, alarm in enumerate(alarms):
                word = "alarm" if number == 0 else None
                axis.axvline(alarm.time, color="#b5400a", linewidth=1.0, label=word if axis is top else None)
                until = alarm.ended if alarm.ended is not None else t[-1]
                axis.axvspan(alarm.since, max(until, alarm.since), color="#b5400a", alpha=0.07, linewidth=0)
        middle.axvspan(0.0, monitor.learn * monitor.dt, color="0.5", alpha=0.12, linewidth=0)
        middle.set_xlim(0.0, max(float(t[-1]), monitor.dt))
        return finish(
            figure,
            axes,
            lines,
            title=_title(monitor, alarms) if title is None else title,
            legends=[top, middle],
            legend_loc=legend_loc,
            show_legend=show_legend,
        )


def _coefficient_name(monitor: Monitor, alarms: list[Any]) -> str:
    if not alarms:
        return "coefficient\n(no alarm)"
    last = alarms[-1]
    name = next(iter(last.coefficients))
    unit = monitor._structure.model.unit(last.effect, name)
    return f"{unit_text(name, unit)}\nat {last.effect.place}".replace("_", " ")


def _title(monitor: Monitor, alarms: list[Any]) -> str:
    if not alarms:
        return f"No alarm in {monitor.n_samples} samples"
    last = alarms[-1]
    ended = "" if last.ended is None else f", gone by {last.ended:.4g} s"
    return f"{last.effect.label} since {last.since:.4g} s{ended}"
