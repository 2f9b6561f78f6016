"""Table and plot of a monitor.

They show how close it is to an alarm, the probable effects, and the size of the change.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import control as ct
import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..exceptions import DataError
from ..results import with_error
from ..streaming.history import CoefficientHistory, History
from ..streaming.monitor import Monitor
from ..streaming.refiner import RCORefiner
from ..systems.linear import Array, LinearModel
from .bode import bode
from .content import Content, content, fields
from .figures import BAND, Frame, plain, style, trace, unit_text
from .models import system_dict
from .tables import TextTable, number

_SHOWN = 8  # candidates in the table
_MOST = 4  # candidates whose probability is drawn


@content.register
def monitor_content(monitor: Monitor) -> Content:
    """Return the content of a monitor: the most probable candidates."""
    n, name = monitor.n_samples, monitor._base.structure.linear_model.name
    memory, state = monitor._memory, monitor.alarm
    busy = "a threshold was crossed, the effect is not identified yet"
    head = "ALARM" if state is not None else busy if memory.change is not None else "no alarm"
    if memory.watched is None:
        head = f"learning until sample {monitor.learn}"
    title = f"Monitor of {name!r}: {head}; {n} samples so far ({n * monitor.dt:.6g} s)"
    rows = []
    for row in monitor.ranking[:_SHOWN]:
        first = next(iter(row.coefficients))
        unit = monitor._base.structure.model.unit(row.effect, first)
        figure = with_error(row.coefficients[first], row.std[first], unit)
        rows.append([row.effect.label, figure, f"{row.probability:.3f}", number(row.log_likelihood, 3)])
    notes = [state.sentence] if state is not None else []
    notes += [] if monitor.adequacy is None else [monitor.adequacy.sentence]
    notes += [f"Ended: {alarm.sentence}" for alarm in monitor.past_alarms[-2:]]
    if memory.watched is not None:
        notes += _healthy_notes(monitor, memory.watched.healthy)
    notes.append(_false_alarms(monitor))
    return Content(
        tables=[TextTable(["candidate", "coefficient", "probability", "gain"], rows, title, notes)],
        answer=lambda: (notes[:1], state is None),
        data=lambda: {"n_samples": n, "alarm": state, "rows": monitor.ranking},
        pictures={"plot": plot_monitor},
    )


def _healthy_notes(monitor: Monitor, healthy: Any) -> list[str]:
    """Return the statistic and the noise, and what the columns mean."""
    ratio = float(monitor.statistic[-1]) if monitor.statistic.size else 0.0
    noise = f"AR({max(healthy.orders)})" if any(healthy.orders) else "white"
    grows = healthy.law[:, 1:].sum(axis=1) * healthy.power
    noise += ", growing with the signal" if (grows > healthy.law[:, 0]).any() else ""
    force = f", unmeasured force about {100 * healthy.ratio:.2g} % of the input" if healthy.ratio else ""
    values = "fitted since the change" if monitor.alarm is not None else "linearized"
    return [
        f"The largest statistic is {ratio:.2f} of its threshold. Noise in the healthy state: {noise}{force}.",
        "probability: of each candidate among all, none of these and no change, with equal prior "
        "probabilities. gain: increase of the log-likelihood over the healthy model. The values are "
        f"{values}.",
    ]


def _false_alarms(monitor: Monitor) -> str:
    """Return the rate of false alarms, in the unit of time that suits it."""
    seconds = 1e5 / monitor.false_alarms * monitor.dt
    units = ((86400 * 365, "years"), (86400, "days"), (3600, "hours"), (60, "minutes"), (1, "s"))
    size, word = next((unit for unit in units if seconds >= 2 * unit[0]), units[-1])
    return (
        f"False alarms: at most {monitor.false_alarms:g} in 100 000 healthy samples, one in "
        f"{seconds / size:.3g} {word}."
    )


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
    labels = frame.labels(["nothing", *(monitor.candidates[i].label for i in shown)])
    alarms = [*monitor.past_alarms, *filter(None, [monitor.alarm])]
    with frame.axes([1.2, 1.6, 1.2], 1) as (axes, lines):
        top, middle, bottom = axes[:, 0]
        lines[0, 0] = top.plot(t, monitor.statistic, color=style(0).color, lw=1.0, label="statistic")
        top.axhline(1.0, color="0.3", linestyle="--", linewidth=1.0, label="threshold")
        top.set(yscale="log", ylabel="statistic /\nthreshold")
        for k, (row, name) in enumerate(zip([0, *(i + 1 for i in shown)], labels, strict=True)):
            look = style(k)._asdict() | ({"color": "0.6"} if k == 0 else {})
            lines[1, 0] += middle.plot(t, p[row], label=name, **look)
        middle.set(ylim=(-0.03, 1.03), ylabel="probability")
        value, std = monitor.coefficient
        band = np.where(np.isfinite(std), std, 0.0)
        bottom.fill_between(t, value - 2 * band, value + 2 * band, color=BAND, linewidth=0)
        lines[2, 0] = bottom.plot(t, value, color=style(1).color, linewidth=1.5)
        bottom.set(ylabel=_coefficient_name(monitor, alarms), xlabel="time [s]")
        for axis in (top, middle, bottom):
            for k, alarm in enumerate(alarms):
                word = "alarm" if k == 0 else None
                axis.axvline(alarm.time, color="#b5400a", linewidth=1.0, label=word if axis is top else None)
                until = alarm.ended if alarm.ended is not None else t[-1]
                axis.axvspan(alarm.since, max(until, alarm.since), color="#b5400a", alpha=0.07, linewidth=0)
        middle.axvspan(0.0, monitor.learn * monitor.dt, color="0.5", alpha=0.12, linewidth=0)
        middle.set_xlim(0.0, max(float(t[-1]), monitor.dt))
        return frame.finish(axes, lines, _title(monitor, alarms), [top, middle])


def _coefficient_name(monitor: Monitor, alarms: list[Any]) -> str:
    if not alarms:
        return "coefficient\n(no alarm)"
    last = alarms[-1]
    name = next(iter(last.coefficients))
    unit = monitor._base.structure.model.unit(last.effect, name)
    return f"{unit_text(name, unit)}\nat {last.effect.place}".replace("_", " ")


def _title(monitor: Monitor, alarms: list[Any]) -> str:
    if not alarms:
        return f"No alarm in {monitor.n_samples} samples"
    last = alarms[-1]
    ended = "" if last.ended is None else f", ended by {last.ended:.4g} s"
    return f"{last.effect.label} since {last.since:.4g} s{ended}"


@content.register
def refiner_content(refiner: RCORefiner) -> Content:
    """Return the content of a refiner: settings, and what it has learned."""
    found = refiner._summary()
    left = 1 if refiner.form == "paper" else 3
    return Content(
        tables=[TextTable(found.headers, found.rows, found.title, found.notes, left)],
        data=lambda: {
            **fields(refiner, "n_samples n_learned"),
            "system": system_dict(LinearModel.from_statespace(refiner.system)),
        },
        pictures={"bode_plot": plot_bode},
    )


def plot_bode(
    refiner: RCORefiner, frame: Frame, measured: Any = None, omega: ArrayLike | None = None
) -> ct.ControlPlot:
    """Draw the initial and refined model beside the measured response.

    See `RCORefiner.bode_plot`.
    """
    systems = [("initial", refiner._sampled.initial), ("refined", refiner.system)]
    return bode(systems, measured, omega, frame, refiner._estimator.deviation())


@content.register
def history_content(history: History) -> Content:
    """Return the content of a history with the paper's settings."""
    return Content(pictures={"plot": plot_stages})


def plot_stages(history: History, frame: Frame) -> ct.ControlPlot:
    """Draw the performance of both stages, static coefficients and poles.

    See `History.plot`.
    """
    names = frame.labels(["stage 1", "stage 2"])
    stages = [(1, history.z2, names[1]), (0, history.z1, names[0])]
    static = np.concatenate(history.theta2)
    with frame.axes([1.6] * (len(history.z1) + 2), 1) as (axes, lines):
        _draw_history(axes, lines, history, stages, "simulated")
        _draw_coefficients(axes[-2, 0], lines[-2], history.timepts, static, _coefficients(history))
        axes[-2, 0].set_ylabel("static coefficients")
        return frame.finish(axes, lines, legends=axes[[0, -2], 0])


def _draw_history(axes: Any, lines: Any, history: Any, stages: Sequence[Any], what: str) -> None:
    """Draw the error of each stage, an output in a row, and the poles."""
    for row, output in enumerate(history.output_labels):
        for index, z, text in stages:
            if np.isfinite(z[row]).any():
                lines[row, 0] += trace(
                    axes[row, 0], history.timepts, z[row], color=style(index).color, lw=0.8, label=text
                )  # fmt: skip
        axes[row, 0].set_ylabel(plain(f"{what} - measured\n{output}"))
    lines[-1, 0] = _draw_poles(axes[-1, 0], history.pole_timepts, history.poles)


def _draw_coefficients(axis: Any, lines: Any, times: Array, values: Array, names: Sequence[str]) -> None:
    lines[0] = axis.plot(times, values.T, linewidth=1.0)
    for line, text in zip(lines[0], names, strict=False):
        line.set_label(plain(text))


def _coefficients(history: History) -> list[str]:
    """Signal of each static coefficient, where the static stage has no memory."""
    names = [*history.state_labels, *history.input_labels]
    l_u, q = history.theta2.shape[:2]
    if q != len(names):
        return []
    return [f"{name} (u{c})" if l_u > 1 else name for c in range(l_u) for name in names]


@content.register
def coefficients_content(history: CoefficientHistory) -> Content:
    """Return the content of a history of coefficients."""
    return Content(pictures={"plot": plot_coefficients})


def plot_coefficients(history: CoefficientHistory, frame: Frame) -> ct.ControlPlot:
    """Performance, coefficients and poles; see `CoefficientHistory.plot`."""
    names = frame.labels(history.names)
    stages = [(0, history.z1, "stage 1"), (1, history.z2, "static stage, one sample ahead")]
    size = np.nanmax(np.abs(history.coefficients), axis=1, initial=0.0)[:, None]
    shown = history.coefficients / np.where(size > 0, size, 1.0)
    with frame.axes([1.6] * len(history.z2) + [2.0, 1.6], 1) as (axes, lines):
        _draw_history(axes, lines, history, stages, "predicted")
        for axis, z in zip(axes[:, 0], history.z2, strict=False):
            usual = np.nanmax(np.abs(z), initial=0.0)
            if usual > 0:  # a stage 1 that diverged must not hide the rest
                axis.set_ylim(-1.1 * usual, 1.1 * usual)
        _draw_coefficients(axes[-2, 0], lines[-2], history.timepts, shown, names)
        axes[-2, 0].set_ylabel("coefficients /\nlargest value")
        return frame.finish(axes, lines, legends=axes[[0, -2], 0])


def _draw_poles(axis: Any, timepts: Array, poles: NDArray[np.complex128]) -> list[Any]:
    """Size of the refined poles over time: dashed where a pole is complex."""
    lines: list[Any] = []
    with np.errstate(invalid="ignore"):
        for pole in poles:
            size, oscillates = np.abs(pole), np.abs(pole.imag) > 1e-6 * np.abs(pole)
            for part, line, name in ((~oscillates, "-", "real"), (oscillates, "--", "complex")):
                if part.any():
                    first = all(one.get_label() != name for one in lines)
                    text, shown = name if first else f"_{name}", np.where(part, size, np.nan)
                    lines += axis.plot(timepts, shown, line, linewidth=1.0, color="tab:purple", label=text)
    positive = np.abs(poles)[np.isfinite(poles) & (np.abs(poles) > 0)]
    if positive.size and positive.max() > 30 * positive.min():
        axis.set_yscale("log")
        axis.set_ylim(max(0.5 * positive.min(), 1e-6 * positive.max()), 2.0 * positive.max())
    axis.set(ylabel="refined poles\n|s| [rad/s]", xlabel="Time [s]")
    return lines
