"""Text and picture of a diagnosis.

The picture shows the ranking, the hidden force against the motion, and the residual before and after.
"""

from __future__ import annotations

from typing import Any

import control as ct
import numpy as np
from scipy.signal import welch

from ..comparison.compare import compare
from ..comparison.responses import FrequencyComparison
from ..data.measurement import Measurement
from ..diagnosis.checks.row import warned
from ..diagnosis.hidden_force import HiddenForce
from ..diagnosis.result import Diagnosis
from ..diagnosis.words import next_step
from ..effects.along_motion import unit_forces
from ..engine.simulation import simulated
from ..systems.linear import Array
from ..words import chance, estimate
from .bode_axes import BodeUnits, broken_phase
from .figures import MEASURED, Frame, draws, style, unit_text
from .rankings import ranking_bars, test_bars, title_of
from .refinement import estimates_table
from .tables import Table, Told, tells
from .traces import trace

__all__ = ["diagnosis_told", "plot_diagnosis", "plot_of_responses"]


def plot_of_responses(found: Diagnosis, frame: Frame) -> ct.ControlPlot:
    """Draw the evidence of a diagnosis of frequency responses.

    It shows the first response; see `Diagnosis.plot`.
    """
    models: list[Any] = [found.base]
    names = ["model as given"]
    if found.floated is not None:
        models, names = [*models, found.floated], [*names, "parameters re-estimated"]
    if found.best is not None:
        models, names = [*models, found.best.refinement], [*names, f"with {found.best.label}"]
    first: Any = found.records[0]
    result: FrequencyComparison = compare(models, first)
    i, j = np.unravel_index(int(np.argmin(result.fit[0])), result.fit[0].shape)
    with frame.axes([1.0, 1.0], 2, figsize=(10.5, 7.2), sharex=False) as (axes, lines):
        bars = ranking_bars if found.best is not None else test_bars
        lines[0, 0] = bars(axes[0, 0], found)
        lines[0, 1] = _residual(axes[0, 1], result, names, (i, j))
        lines[1, 0], lines[1, 1] = _curves(axes[1], result, names, (i, j))
        return frame.finish(axes, lines, [axes[0, 0], axes[0, 1], axes[1, 0]], title_of(found))


def _residual(ax: Any, result: FrequencyComparison, names: list[str], at: Any) -> list[Any]:
    units, drawn = BodeUnits.from_defaults(), []
    x = result.measured.omega * units.frequency_factor
    std = result.measured.std
    known = std is not None and bool(std.all())
    size = result.measured.magnitude[at] if std is None or not known else std[at]
    for m, name in enumerate(names):
        look = style(m)
        error = np.abs(result.measured.response[at] - result.responses[m][at]) / size
        drawn += ax.loglog(x, error, ".", ms=3, color=look.color, label=name)
    ax.set_xlabel(unit_text("frequency", units.frequency))
    ax.set_ylabel("|G - Gh| over " + ("std" if known else "|G|"))
    ax.set_title(f"Residual, {result.measured.input_labels[at[1]]} to {result.measured.output_labels[at[0]]}")
    ax.grid(True, alpha=0.3)
    return drawn


def _curves(axes: Any, result: FrequencyComparison, names: list[str], at: Any) -> tuple[list[Any], list[Any]]:
    units, measured = BodeUnits.from_defaults(), result.measured
    x = measured.omega * units.frequency_factor
    dots = {"color": MEASURED, "marker": ".", "ms": 3, "linestyle": "none"}
    upper = axes[0].loglog(x, measured.magnitude[at], label=measured.name, **dots)
    lower = axes[1].semilogx(x, measured.phase[at] * units.phase_factor, label=measured.name, **dots)
    for m, name in enumerate(names):
        look: dict[str, Any] = dict(style(m)._asdict(), label=name)
        upper += axes[0].plot(x, np.abs(result.responses[m][at]), **look)
        where, angle = broken_phase(measured.omega, result.responses[m][at])
        lower += axes[1].plot(where * units.frequency_factor, angle * units.phase_factor, **look)
    for axis, what in ((axes[0], "magnitude"), (axes[1], unit_text("phase", "deg" if units.deg else "rad"))):
        axis.set_xlabel(unit_text("frequency", units.frequency))
        axis.set_ylabel(what)
        axis.grid(True, alpha=0.3)
    return upper, lower


_SHOWN = 8


@tells(Diagnosis)
def diagnosis_told(found: Diagnosis) -> Told:
    """The verdict in words, and the ranking."""
    explained = found.verdict in ("adequate", "parameters", "effect")
    places = () if found.best is None else tuple(e.place for e in found.best.effects)
    answer, *more = found.sentences()
    odd = warned(found.checks, explained, places)
    above = [f"Diagnosis: {found.verdict.upper()}", answer, *odd, *more]
    title, following = f"Diagnosis: {found.verdict}", f"Next: {next_step(found)}"
    if found.floated is not None:
        return above, estimates_table(found.parameters, title, [*above[1:], following]), [following]
    headers = ["effect", "value", "std", "fit %", "p-value"]
    named = found.verdict != "unexplained"  # no probability for what fails its own tests
    headers += ["P"] if named else []
    rows = []
    for row in found.ranking[:_SHOWN]:
        for i, (effect, own) in enumerate(row.estimates):
            first = next(iter(own.values()))
            whole = [f"{row.fit_after:.2f}", chance(row.p_value), f"{row.probability:.3f}"][: 2 + named]
            value = estimate(first.coefficient, first.std)
            rows.append(["+ " * (i > 0) + effect.label, *value, *([""] * len(whole) if i else whole)])
    if rows and named:
        rows.append(["none of these", "", "", "", "", f"{found.none_of_these:.3f}"])
    if found.open_law is not None:
        rows.append([found.open_law.effect.label, "", "", f"{found.open_law.fit_after:.2f}", ""])
    return above, Table(headers, rows, title, [*above[1:], following]), [following]


@draws(Diagnosis)
def plot_diagnosis(found: Diagnosis, frame: Frame) -> ct.ControlPlot:
    """Draw the evidence of a diagnosis.

    See `Diagnosis.plot`.
    Axes: ranking (or tests, where nothing is missing), hidden force estimated without
    any formula with the curve of the effect through it, residual in time, residual in frequency.
    """
    if found.base.of_responses:
        return plot_of_responses(found, frame)
    record = found.ordered_records()[0]
    with frame.axes([1.0, 1.0], 2, figsize=(10.5, 7.2), sharex=False) as (axes, lines):
        bars = ranking_bars if found.best is not None else test_bars
        lines[0, 0] = bars(axes[0, 0], found)
        lines[0, 1] = _force(axes[0, 1], found, record)
        lines[1, 0], lines[1, 1] = _residuals(axes[1], found, record)
        return frame.finish(axes, lines, [axes[0, 0], axes[0, 1], axes[1, 1]], title_of(found))


def _channel_curve(ax: Any, found: Diagnosis, record: Measurement) -> list[Any]:
    """Draw the tabulated curve of a channel, and the straight line."""
    effect: Any = found.law()
    unit = dict(zip(record.input_labels, record.input_units, strict=True))
    unit |= dict(zip(record.output_labels, record.output_units, strict=True))
    d, values = np.array(effect.law.d), np.array(effect.law.force)[:, 0]
    lines = ax.plot(d, d, color="0.55", lw=1.2, label="model as given")
    lines += ax.plot(d, values, "o-", color=style(1).color, ms=4, lw=1.6, label=effect.label)
    ax.set_xlabel(unit_text(f"{effect.place} of the record", unit[effect.place]))
    ax.set_ylabel(unit_text(f"{effect.place} after the curve", unit[effect.place]))
    ax.set_title("Curve estimated from the record")
    return list(lines)


def _force(ax: Any, found: Diagnosis, record: Measurement) -> list[Any]:
    if found.open_law is not None and found.open_law.effect.spec.at_channel:
        return _channel_curve(ax, found, record)
    best, hidden = found.best, found.hidden_force
    if best is None or hidden is None:
        said = (
            "no additional effect is needed"
            if best is None
            else f"{found.place}\nis in the signal path: no force"
        )
        ax.text(0.5, 0.5, said, ha="center", va="center", transform=ax.transAxes)
        ax.set_axis_off()
        return []
    along_d = "position" in best.effect.spec.needs
    motion = hidden.d if along_d else hidden.v
    unit = hidden.position_unit if along_d else hidden.velocity_unit
    first_order = not np.any(hidden.d)
    what = "displacement" if along_d else "motion" if first_order else "velocity"
    skip = max(record.n_samples // 50, 1)
    inner = slice(skip, -skip)
    law, label = _law(found, hidden, motion, record.inputs)
    # a constant force passes for the offset: the estimate has none, the law's is put in its place
    force = hidden.force - hidden.force[inner].mean() + (0.0 if law is None else float(np.mean(law[1])))
    points = ax.plot(
        motion[inner],
        force[inner],
        ".",
        color="0.55",
        ms=2,
        alpha=0.5,
        label="estimated from the record, no formula assumed",
    )
    edges = np.quantile(motion[inner], np.linspace(0.005, 0.995, 25))
    which = np.digitize(motion[inner], edges)
    centers, means = [], []
    for i in range(1, edges.size):
        if np.count_nonzero(which == i) > 5:
            centers.append(motion[inner][which == i].mean())
            means.append(force[inner][which == i].mean())
    points += ax.plot(centers, means, "o", color=MEASURED, ms=4, label="mean over intervals of the motion")
    if law is not None:
        x, y = law
        look = style(1)
        points += ax.plot(x, y, color=look.color, ls=look.linestyle, lw=2, label=label)
    ax.set_xlabel(unit_text(f"{what} at {hidden.place}", unit))
    ax.set_ylabel(unit_text("hidden resisting force", hidden.force_unit))
    ax.set_title("Force estimated from the record")
    return list(points)


def _law(
    found: Diagnosis, hidden: HiddenForce, motion: Array, w: Array
) -> tuple[tuple[Array, Array] | None, str]:
    """Return the force of the effect along the motion, and its label.

    The points are sorted by the motion, unless the effect has memory or needs several signals.
    """
    assert found.best is not None
    effect, values = found.best.effect, dict(found.best.coefficients)
    if found.open_law is not None:
        effect, values = found.open_law.effect, {"scale": 1.0}
    order = np.argsort(motion, kind="stable")
    columns = unit_forces(effect, hidden.d, hidden.v, [{**values, **effect.fixed}], w)
    levels = [
        values.get(n, effect.fixed.get(n, 0.0)) for n in effect.coefficients if n not in effect.spec.shaping
    ]
    if columns is None or len(columns) != len(levels):
        return None, effect.label
    force = np.sum([level * column for level, column in zip(levels, columns, strict=True)], axis=0)
    if effect.spec.inner_states or len(effect.spec.needs) > 1:  # no curve over one signal
        return (motion, force), effect.label
    return (motion[order], force[order]), effect.label


def _residuals(axes: Any, found: Diagnosis, record: Measurement) -> tuple[list[Any], list[Any]]:
    models = [("model as given", found.base)]
    if found.floated is not None:
        models.append(("parameters re-estimated", found.floated))
    if found.best is not None:
        models.append((f"with {found.best.label}", found.best.refinement))
    in_time, in_frequency = [], []
    scale = record.outputs.std(axis=1)
    main = int(np.argmax(scale > 0))
    units = BodeUnits.from_defaults()
    rate = 2 * np.pi * units.frequency_factor / record.dt  # of the samples, in the unit of Bode plots
    for i, (name, model) in enumerate(models):
        error = record.outputs[main] - simulated(model, record, "estimate", led=True).outputs[main]
        look = style(i)
        in_time += trace(axes[0], record.timepts, error, color=look.color, lw=0.7, label=name)
        f, power = welch(error, fs=rate, nperseg=min(512, record.n_samples))
        in_frequency += axes[1].loglog(
            f[1:], np.sqrt(power[1:]), color=look.color, ls=look.linestyle, lw=1.4, label=name
        )
    f, power = welch(record.outputs[main], fs=rate, nperseg=min(512, record.n_samples))
    in_frequency += axes[1].loglog(
        f[1:], np.sqrt(power[1:]), color=MEASURED, lw=0.9, alpha=0.6, label="measured output"
    )
    label, unit = record.output_labels[main], record.output_units[main]
    axes[0].set_xlabel("time [s]")
    axes[0].set_ylabel(unit_text(f"residual of {label}", unit))
    axes[0].set_title("Residual in time")
    axes[1].set_xlabel(unit_text("frequency", units.frequency))
    axes[1].set_ylabel(unit_text("amplitude density", f"{unit}/sqrt({units.frequency})" if unit else ""))
    axes[1].set_title("Residual in frequency")
    return in_time, in_frequency
