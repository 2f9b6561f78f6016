"""Table and plot of a monitor.

They show how close it is to an alarm, the probable effects, and the size of the change.
"""

from __future__ import annotations

from typing import Any

import control as ct
import numpy as np

from ..exceptions import DataError
from ..streaming.monitor.monitor import Monitor
from ..words import with_error
from .figures import BAND, Frame, draws, style, unit_text
from .tables import Table, number, tabulates

__all__ = ["monitor_table", "plot_monitor"]

_SHOWN = 8  # candidates in the table
_MOST = 4  # candidates whose probability is drawn


@tabulates(Monitor)
def monitor_table(monitor: Monitor) -> Table:
    """The candidates of a monitor, the most probable first."""
    n, name = monitor.n_samples, monitor._structure.linear_model.name
    stream = monitor._stream
    state = monitor.alarm
    if stream is None:
        head = f"learning until sample {monitor.learn}"
    elif state is not None:
        head = "ALARM"
    else:
        head = (
            "a threshold was crossed, the effect is not identified yet" if monitor._watch.busy else "no alarm"
        )
    title = f"Monitor of {name!r}: {head}; {n} samples so far ({n * monitor.dt:.6g} s)"
    rows = []
    for row in monitor.ranking[:_SHOWN]:
        first = next(iter(row.coefficients))
        unit = monitor._structure.model.unit(row.effect, first)
        figure = with_error(row.coefficients[first], row.std[first], unit)
        rows.append([row.effect.label, figure, f"{row.probability:.3f}", number(row.log_likelihood, 3)])
    notes = [state.sentence] if state is not None else []
    if monitor.adequacy is not None and monitor.adequacy.adequate:
        notes.append(monitor.adequacy.sentence)
    notes += list(monitor.remarks)
    notes += [f"Ended: {alarm.sentence}" for alarm in monitor.past_alarms[-2:]]
    if stream is not None:
        ratio = float(monitor.statistic[-1]) if monitor.statistic.size else 0.0
        force = stream.healthy.ratio
        noise = "white" if not any(stream.healthy.orders) else f"AR({max(stream.healthy.orders)})"
        grows = stream.healthy.noise[:, 1:].sum(axis=1) * stream.healthy.power
        noise += ", growing with the signal" if (grows > stream.healthy.noise[:, 0]).any() else ""
        notes.append(
            f"The largest statistic is {ratio:.2f} of its threshold. Noise in the healthy state: {noise}"
            + (f", unmeasured force about {100 * force:.2g} % of the input." if force else ".")
        )
        notes.append(
            "probability: of each candidate among all candidates and no change, with "
            "equal prior probabilities. gain: increase of the log-likelihood over the "
            "healthy model. "
            + ("The values are fitted since the change." if state else "The values are linearized.")
        )
    every = 1e5 / monitor.false_alarms
    notes.append(
        f"False alarms: at most {monitor.false_alarms:g} in 100 000 healthy samples, one in "
        f"{_duration(every * monitor.dt)}."
    )
    return Table(["candidate", "coefficient", "probability", "gain"], rows, title, notes)


def _duration(seconds: float) -> str:
    for size, word in ((86400 * 365, "years"), (86400, "days"), (3600, "hours"), (60, "minutes")):
        if seconds >= 2 * size:
            return f"{seconds / size:.3g} {word}"
    return f"{seconds:.3g} s"


@draws(Monitor)
def plot_monitor(monitor: Monitor, frame: Frame) -> ct.ControlPlot:
    """Draw statistic, probabilities and coefficient over time.

    The statistic is divided by its threshold. The coefficient is that of the named effect. See
    `Monitor.plot`.
    """
    t, p = monitor.timepts, monitor.probability
    if t.size == 0:
        raise DataError(
            f"nothing to draw yet: {monitor.n_samples} samples taken, the learning phase has {monitor.learn}"
        )
    peak = p[1:].max(axis=1)
    shown = [int(i) for i in np.argsort(-peak)[:_MOST] if peak[i] > 0.1]
    names = ["nothing", *(monitor.candidates[i].label for i in shown)]
    labels = frame.labels(names)
    alarms = [*monitor.past_alarms, *([monitor.alarm] if monitor.alarm else [])]
    with frame.axes([1.2, 1.6, 1.2], 1) as (axes, lines):
        top, middle, bottom = axes[:, 0]
        pen = style(0)
        lines[0, 0] = top.plot(t, monitor.statistic, color=pen.color, linewidth=1.0, label="statistic")
        top.axhline(1.0, color="0.3", linestyle="--", linewidth=1.0, label="threshold")
        top.set_yscale("log")
        top.set_ylabel("statistic /\nthreshold")
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
            for k, alarm in enumerate(alarms):
                word = "alarm" if k == 0 else None
                axis.axvline(alarm.time, color="#b5400a", linewidth=1.0, label=word if axis is top else None)
                until = alarm.ended if alarm.ended is not None else t[-1]
                axis.axvspan(alarm.since, max(until, alarm.since), color="#b5400a", alpha=0.07, linewidth=0)
        middle.axvspan(0.0, monitor.learn * monitor.dt, color="0.5", alpha=0.12, linewidth=0)
        middle.set_xlim(0.0, max(float(t[-1]), monitor.dt))
        return frame.finish(axes, lines, [top, middle], _title(monitor, alarms))


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
    ended = "" if last.ended is None else f", ended by {last.ended:.4g} s"
    return f"{last.effect.label} since {last.since:.4g} s{ended}"
