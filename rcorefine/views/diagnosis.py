"""Texts and pictures of diagnoses, advice and confirmations."""

from __future__ import annotations

from typing import Any

import control as ct
import numpy as np
from scipy.signal import welch

from ..comparison.compare import compare
from ..comparison.responses import FrequencyComparison
from ..data.measurement import Measurement
from ..diagnosis.confirm import Confirmation
from ..diagnosis.experiments import ExperimentAdvice
from ..diagnosis.open_law import HiddenForce
from ..diagnosis.result import Diagnosis, RankedEffect
from ..effects.effect import unit_forces
from ..engine.simulation import simulated
from ..exceptions import ModelError
from ..results import chance, estimate
from ..systems.linear import Array
from .bode import BodeAxes, BodeUnits
from .content import Content, content, fields
from .figures import BAND, MEASURED, Frame, look_of, plain, style, trace, unit_text, write_at
from .tables import TextTable, cells, number

_SHOWN = 8


def _title_of(found: Diagnosis) -> str:
    """The verdict in one line."""
    more = "" if found.best is None else f" ({found.best.label}, probability {found.best.probability:.2f})"
    if found.verdict == "unexplained":
        place = found.place
        more = "" if place is None else f" (at {place}, probability {found.places[place]:.2f})"
    if found.best is None or found.verdict == "adequate":
        more = ""
    return f"Diagnosis: {found.verdict}{more}"


def _bars(ax: Any, found: Diagnosis) -> list[Any]:
    """Draw the misfit of each refitted candidate, or else the tests, as bars.

    The misfit is 100 minus the fit in percent.
    """
    if found.best is None:
        return _test_bars(ax, found)
    rows = found.ranking[:_SHOWN][::-1]
    where = np.arange(len(rows))
    colors = [style(1).color if row.alike or row is found.best else "0.75" for row in rows]
    loss = [100 - row.fit_after for row in rows]
    bars = ax.barh(where, loss, color=colors, edgecolor="0.3", height=0.65)
    before = 100 - rows[0].fit_before
    line = ax.axvline(before, color=style(0).color, ls="--", lw=1.4, label="model as given")
    for y, row, value in zip(where, rows, loss, strict=True):
        text = "" if found.verdict == "unexplained" else f"P = {row.probability:.2f}"
        write_at(ax, text, (value, y), (4, 0), va="center", fontsize=8)
    ax.set_yticks(where, [_wrapped(row.label) for row in rows], fontsize=7)
    ax.set(xlim=(0, 1.25 * max(before, *loss)), xlabel="100 - fit of the refitted model [%]")
    ax.set_title("Candidate effects, refitted")
    return [*bars, line]


def _wrapped(label: str) -> str:
    label, *names = label.split(" = ")
    one, *more = label.split(" + ")  # each effect of a set has a line, a single one has two
    lines = [one, *more] if more else one.replace(" at ", "\nat ", 1).split("\n")
    lines = [("+ " if more and i else "") + line for i, line in enumerate(lines)]
    lines += [f"= {name}" for name in names]
    words = [a.replace("_", " ") + at + b for a, at, b in (line.partition("at ") for line in lines)]
    return plain("\n".join(words))


def _test_bars(ax: Any, found: Diagnosis) -> list[Any]:
    """The tests of the model as it is."""
    tests = [t for t in found.tests if t.dof][::-1]
    where, sizes = np.arange(len(tests)), [-np.log10(max(t.p_value, 1e-300)) for t in tests]
    bars = ax.barh(where, sizes, color="0.75", edgecolor="0.3", height=0.65)
    level = -np.log10(found.significance / max(len(tests), 1))
    line = ax.axvline(level, color=style(1).color, ls="--", lw=1.4, label="significance level")
    ax.set_yticks(where, [t.name.split(" (")[0] for t in tests], fontsize=8)
    ax.set(xlim=(0, max(1.2 * level, ax.get_xlim()[1])), xlabel="-log10 of the p-value")
    ax.set_title("Residual tests of the model")
    return [*bars, line]


def _models(found: Diagnosis) -> dict[str, Any]:
    """The models that a diagnosis compares, by their names in pictures."""
    models: dict[str, Any] = {"model as given": found.base}
    if found.floated is not None:
        models["parameters re-estimated"] = found.floated
    if found.best is not None:
        models[f"with {found.best.label}"] = found.best.refinement
    return models


def _panels_of_responses(axes: Any, lines: Any, found: Diagnosis) -> list[int]:
    """Draw the first response with its residual; return axes with a legend."""
    models = _models(found)
    first: Any = found.records[0]
    result: FrequencyComparison = compare([*models.values()], first)
    i, j = np.unravel_index(int(np.argmin(result.fit[0])), result.fit[0].shape)
    lines[0, 1] = _residual(axes[0, 1], result, [*models], (i, j))
    _curves(axes[1], lines[1], result, [*models], (i, j))
    return [0, 1, 2]


def _panels_in_time(axes: Any, lines: Any, found: Diagnosis) -> list[int]:
    """Draw force and residuals of a record; return axes with a legend."""
    record = found.ordered_records()[0]
    lines[0, 1] = _force(axes[0, 1], found, record)
    lines[1, 0], lines[1, 1] = _residuals(axes[1], found, record)
    return [0, 1, 3]


def _residual(ax: Any, result: FrequencyComparison, names: list[str], at: Any) -> list[Any]:
    units, drawn = BodeUnits.from_defaults(), []
    x = result.measured.omega * units.frequency_factor
    std = result.measured.std
    known = std is not None and bool(std.all())
    size = result.measured.magnitude[at] if std is None or not known else std[at]
    for m, name in enumerate(names):
        error = np.abs(result.measured.response[at] - result.responses[m][at]) / size
        drawn += ax.loglog(x, error, ".", ms=3, color=style(m).color, label=name)
    where = f"{result.measured.input_labels[at[1]]} to {result.measured.output_labels[at[0]]}"
    ax.set(xlabel=unit_text("frequency", units.frequency), title=f"Residual, {where}")
    ax.set_ylabel("|G - Gh| over " + ("std" if known else "|G|"))
    return drawn


def _curves(axes: Any, lines: Any, result: FrequencyComparison, names: list[str], at: Any) -> None:
    """Draw magnitude and phase of one channel side by side."""
    measured, (i, j) = result.measured, at
    drawn = BodeAxes(axes[:, None], lines[:, None], [measured.output_labels[i]], [measured.input_labels[j]])
    dots = {"color": MEASURED, "marker": ".", "markersize": 3, "linestyle": "none", "label": measured.name}
    looks = [look_of(m, name, zorder=2) for m, name in enumerate(names)]
    for response, look in zip((measured.response, *result.responses), (dots, *looks), strict=True):
        drawn.curves(measured.omega, response[None, None, i, j], look)
    for axis in axes:
        axis.tick_params(labelbottom=True)
        axis.set(xlabel=unit_text("frequency", drawn.units.frequency))


def ranking_table(found: Diagnosis, *, full: bool = False) -> TextTable:
    """Candidate effects that were refitted; in full with all coefficients."""
    # no probability for what fails its own tests
    named = found.verdict != "unexplained" and bool(np.isnan(found.adequate_to))
    headers = [
        "effect",
        *["parameter"] * full,
        "value",
        "std",
        *["fit before %"] * full,
        "fit %",
        "p-value",
    ]
    headers += ["P"] * named
    rows = []
    for row in found.ranking[: None if full else _SHOWN]:
        whole = [f"{row.fit_before:.2f}"] * full + [f"{row.fit_after:.2f}", chance(row.p_value)]
        whole += [f"{row.probability:.3f}"] * named
        for name in (row, *row.same):
            for i, (effect, own) in enumerate(name.estimates):
                sign = "+ " if i else "= " * (name is not row)
                for k, (what, one) in enumerate(own.items() if full else [*own.items()][:1]):
                    head = ["" if k else sign + effect.label, *[what] * full]
                    rows.append([*head, *estimate(one.coefficient, one.std), *whole])
                    whole = [""] * len(whole)  # of the row, in its first line only
    blank = [""] * (len(headers) - 3)
    if rows and named:
        rows.append(["none of these", *blank, "", f"{found.none_of_these:.3f}"])
    if found.open_law is not None:
        rows.append([found.open_law.effect.label, *blank, f"{found.open_law.fit_after:.2f}", ""])
    return TextTable(headers, rows)


def caption_of(found: Diagnosis) -> str:
    """Say what the picture of a diagnosis shows."""
    if found.floated is not None:
        return (
            "The residual tests of the model as given; and the residual before and after its parameters were "
            "re-estimated."
        )
    if found.best is None:
        return "The residual tests of the model, and its residual."
    if found.base.of_responses:
        return "The candidates, the most probable first; the residual and the response with and without them."
    return (
        "The candidates, the most probable first; the force that was estimated at the place of the "
        "best one, with its formula; and the residual with and without it."
    )


def plot_diagnosis(found: Diagnosis, frame: Frame) -> ct.ControlPlot:
    """Draw the evidence of a diagnosis.

    See `Diagnosis.plot`.
    Axes: ranking (or tests, where nothing is missing), hidden force estimated without
    any formula with the curve of the effect through it, residual in time, residual in frequency.
    """
    draw = _panels_of_responses if found.base.of_responses else _panels_in_time
    with frame.axes([1.0, 1.0], 2, figsize=(10.5, 7.2), sharex=False) as (axes, lines):
        lines[0, 0] = _bars(axes[0, 0], found)
        legends = draw(axes, lines, found)
        return frame.finish(axes, lines, _title_of(found), axes.flat[legends])


def _channel_curve(ax: Any, found: Diagnosis, record: Measurement) -> list[Any]:
    """Draw the tabulated curve of a channel, and the straight line."""
    effect: Any = found.law()
    linear = found.base.physical_model.linear
    unit = dict(zip(linear.input_labels, record.input_units, strict=True))
    unit |= dict(zip(linear.output_labels, record.output_units, strict=True))
    d, values = np.array(effect.law.d), np.array(effect.law.force)[:, 0]
    lines = ax.plot(d, d, color="0.55", lw=1.2, label="model as given")
    lines += ax.plot(d, values, "o-", color=style(1).color, ms=4, lw=1.6, label=effect.label)
    place = effect.place
    ax.set_xlabel(unit_text(f"{place} of the record", unit[place]))
    ax.set(ylabel=unit_text(f"{place} after the curve", unit[place]), title="Curve estimated from the record")
    return list(lines)


def _force(ax: Any, found: Diagnosis, record: Measurement) -> list[Any]:
    """Draw what is known of the force at the place of the best candidate."""
    if found.open_law is not None and found.open_law.effect.spec.at_channel:
        return _channel_curve(ax, found, record)
    if found.best is not None and found.hidden_force is not None:
        return _force_over_motion(ax, found, found.best, found.hidden_force, record)
    said = f"{found.place}\nis in the signal path: no force"
    said = "no additional effect is needed" if found.best is None else said
    ax.text(0.5, 0.5, said, ha="center", va="center", transform=ax.transAxes)
    ax.set_axis_off()
    return []


def _force_over_motion(
    ax: Any, found: Diagnosis, best: RankedEffect, hidden: HiddenForce, record: Measurement
) -> list[Any]:
    """Draw the estimated force over the motion, its means, and the law."""
    along_d = "position" in best.effect.spec.needs
    motion = hidden.d if along_d else hidden.v
    unit = hidden.position_unit if along_d else hidden.velocity_unit
    moves = "velocity" if np.any(hidden.d) else "motion"  # a first-order place has one signal
    skip = max(record.n_samples // 50, 1)
    inner = slice(skip, -skip)
    law, label = _law(found, best, hidden, motion, record.inputs)
    # a constant force passes for the offset: the estimate has none, the law's is put in its place
    force = hidden.force - hidden.force[inner].mean() + (0.0 if law is None else float(np.mean(law[1])))
    motion, force = motion[inner], force[inner]
    text = "estimated from the record, no formula assumed"
    points = ax.plot(motion, force, ".", color="0.55", ms=2, alpha=0.5, label=text)
    edges = np.quantile(motion, np.linspace(0.005, 0.995, 25))
    which = np.digitize(motion, edges)
    parts = [which == i for i in range(1, edges.size) if np.count_nonzero(which == i) > 5]
    centers, means = [motion[part].mean() for part in parts], [force[part].mean() for part in parts]
    points += ax.plot(centers, means, "o", color=MEASURED, ms=4, label="mean over intervals of the motion")
    if law is not None:
        points += ax.plot(*law, color=style(1).color, ls=style(1).linestyle, lw=2, label=label)
    ax.set_xlabel(unit_text(f"{'displacement' if along_d else moves} at {hidden.place}", unit))
    ax.set_ylabel(unit_text("hidden resisting force", hidden.force_unit))
    ax.set_title("Force estimated from the record")
    return list(points)


def _law(
    found: Diagnosis, best: RankedEffect, hidden: HiddenForce, motion: Array, w: Array
) -> tuple[tuple[Array, Array] | None, str]:
    """Return the force of the effect along the motion, and its label.

    The points are sorted by the motion, unless the effect has memory or needs several signals.
    """
    effect, values = best.effect, dict(best.coefficients)
    if found.open_law is not None:
        effect, values = found.open_law.effect, {"scale": 1.0}
    columns = unit_forces(effect, hidden.d, hidden.v, [{**values, **effect.fixed}], w)
    known = effect.fixed | values
    levels = [known.get(n, 0.0) for n in effect.coefficients if n not in effect.spec.shaping]
    if columns is None or len(columns) != len(levels):
        return None, effect.label
    force = np.sum([level * column for level, column in zip(levels, columns, strict=True)], axis=0)
    if effect.spec.inner_states or len(effect.spec.needs) > 1:  # no curve over one signal
        return (motion, force), effect.label
    order = np.argsort(motion, kind="stable")
    return (motion[order], force[order]), effect.label


def _residuals(axes: Any, found: Diagnosis, record: Measurement) -> tuple[list[Any], list[Any]]:
    in_time, in_frequency = [], []
    main = int(np.argmax(record.outputs.std(axis=1) > 0))
    measured = record.outputs[main]
    units = BodeUnits.from_defaults()
    rate = 2 * np.pi * units.frequency_factor / record.dt  # of the samples, in the unit of Bode plots

    def density(signal: Array, **look: Any) -> Any:
        f, power = welch(signal, fs=rate, nperseg=min(512, record.n_samples))
        return axes[1].loglog(f[1:], np.sqrt(power[1:]), **look)

    for i, (name, model) in enumerate(_models(found).items()):
        error = measured - simulated(model, record, "estimate", led=True).outputs[main]
        color = style(i).color
        in_time += trace(axes[0], record.timepts, error, color=color, lw=0.7, label=name)
        in_frequency += density(error, color=color, ls=style(i).linestyle, lw=1.4, label=name)
    in_frequency += density(measured, color=MEASURED, lw=0.9, alpha=0.6, label="measured output")
    label, unit = record.output_labels[main], record.output_units[main]
    axes[0].set(xlabel="time [s]", ylabel=unit_text(f"residual of {label}", unit), title="Residual in time")
    density_unit = f"{unit}/sqrt({units.frequency})" if unit else ""
    axes[1].set(xlabel=unit_text("frequency", units.frequency), title="Residual in frequency")
    axes[1].set_ylabel(unit_text("amplitude density", density_unit))
    return in_time, in_frequency


@content.register
def hidden_force_content(found: HiddenForce) -> Content:
    """Return the content of a hidden force: each signal in a row."""
    signals = {
        "displacement d": (found.d, found.position_unit),
        "velocity v": (found.v, found.velocity_unit),
        "resisting force": (found.force, found.force_unit),
    }
    rows = [
        [name, *map(number, (np.sqrt(np.mean(x**2)), x.min(), x.max())), unit]
        for name, (x, unit) in signals.items()
    ]
    note = (
        f"Standard deviation of the force: {number(float(np.mean(found.std)))}. Its mean cannot be "
        "distinguished from the offset and is not estimated."
    )
    title = f"Hidden force at {found.place}, {found.force.size} samples"
    columns = fields(found, "d v force std")
    return Content(
        tables=[TextTable(["signal", "rms", "least", "largest", "unit"], rows, title, [note])],
        columns=lambda: (columns, found.timepts, "time"),
        pictures={"plot": plot_hidden_force},
    )


def plot_hidden_force(found: HiddenForce, frame: Frame) -> ct.ControlPlot:
    """Draw the force over time, displacement and velocity.

    See `HiddenForce.plot`.
    """
    t, f, wide = found.timepts, found.force, 2.0 * found.std
    with frame.axes([1.0], 3, figsize=(11.0, 3.4), sharex=False, sharey=True) as (axes, lines):
        over_time, *over_motion = axes[0]
        over_time.fill_between(t, f - wide, f + wide, color=BAND, linewidth=0, label="2 std")
        lines[0, 0] = over_time.plot(t, f, color=style(0).color, lw=0.8, label="estimate")
        over_time.set(xlabel="time [s]", ylabel=unit_text("resisting force", found.force_unit))
        motions = ((found.d, "displacement", found.position_unit), (found.v, "velocity", found.velocity_unit))
        for k, (axis, (x, name, unit)) in enumerate(zip(over_motion, motions, strict=True), 1):
            lines[0, k] = axis.plot(x, f, ".", color="0.5", ms=2, alpha=0.5)
            axis.set_xlabel(unit_text(f"{name} at {found.place}", unit))
        return frame.finish(axes, lines, f"Hidden force at {found.place}")


@content.register
def advice_content(advice: ExperimentAdvice) -> Content:
    """Return the content of an advice: the experiments that were judged."""
    rows = []
    for option in advice.options:
        figures = cells(option, "probability:.2f distance:.3g reach:.2g")
        name = ("> " if option is advice.chosen else "  ") + option.name
        rows.append([name, f"{option.cost:.3g}", *(["-"] * 3 if option.failed else figures)])
    message, *rest = advice.sentences()
    return Content(
        title="Experiment: " + (advice.chosen.name if advice.chosen else "nothing to separate"),
        above=[message],
        tables=[TextTable(["experiment", "cost", "probability", "distance", "reach"], rows)],
        below=rest,
        pictures={"plot": plot_advice},
    )


def plot_advice(advice: ExperimentAdvice, frame: Frame) -> ct.ControlPlot:
    """Draw the probability that each option separates the candidates.

    Each option is a bar, the cheapest on top.
    """
    options = advice.options
    (name,) = frame.labels(["candidates distinguished"])
    with frame.axes([1.0], 1, figsize=(7.0, 1.6 + 0.32 * max(len(options), 1))) as (axes, lines):
        ax = axes[0, 0]
        bars = _option_bars(ax, advice, name)
        least = ax.axvline(advice.probability, color="C3", ls="--", lw=1.2, zorder=0, label="required")
        lines[0, 0] = [*bars, least]
        ax.set_yticks(range(len(options)), [f"{option.name} ({option.cost:.2g})" for option in options])
        ax.invert_yaxis()
        ax.set(xlim=(0, 1), xlabel="probability that only the true effect remains")
        heading = "Next experiment (cost in record lengths)" if options else "Nothing to separate"
        return frame.finish(axes, lines, heading, axes[0] if options else [])


def _option_bars(ax: Any, advice: ExperimentAdvice, name: str) -> Any:
    """Draw the probability of each option as a bar with its figure."""
    colors = ["C0" if option is advice.chosen else "0.7" for option in advice.options]
    values = [option.probability for option in advice.options]
    bars = ax.barh(range(len(values)), values, color=colors, label=name)
    for row, option in enumerate(advice.options):
        text = "not possible" if option.failed else f"{option.probability:.2f}"
        far = f", {option.reach:.2g} x the motion" if 1.25 < option.reach < np.inf else ""
        inside = option.probability > 0.7
        look: dict[str, Any] = {"ha": "right" if inside else "left", "va": "center", "fontsize": "small"}
        look["color"] = "white" if inside and option is advice.chosen else "black"
        write_at(ax, text + far, (option.probability, row), (-4 if inside else 4, 0), **look)
    return bars


@content.register
def confirmation_content(found: Confirmation) -> Content:
    """Return the content of a confirmation: the estimates of each record."""
    headers = ["record", "coefficient", "alone", "std", "level", "agreement", "residual"]
    rows = []
    for one in found.estimates:
        agreement = "" if one is found.estimates[0] else f"{one.agreement:.2g}"
        tail = [f"{one.level:.3g}", agreement, f"{one.residual:.2g}"]
        for i, name in enumerate(found.names or ["none"]):
            figures = cells(one, f"coefficients[{i}]:.4g std[{i}]:.2g") if found.names else ["", ""]
            rows.append(["" if i else one.name, name, *figures, *([""] * 3 if i else tail)])
    message, *rest = found.sentences()
    return Content(
        title="Further records",
        verdict=found.verdict,
        above=[message],
        tables=[TextTable(headers, rows, left=2)],
        below=rest,
        answer=lambda: ([message], found.verdict == "confirmed"),
        pictures={"plot": plot_confirmation},
    )


def plot_confirmation(confirmation: Confirmation, frame: Frame) -> ct.ControlPlot:
    """Draw the coefficients of each record with 95 % intervals.

    They are estimated from each record alone. Each coefficient has its own panel.
    """
    count = len(confirmation.names)
    if not count:
        raise ModelError("the model has no added effect, so there is no coefficient to plot")
    (name,) = frame.labels(["95 % interval"])
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
        legends = [axes[0, 0]] if frame.label is not None or frame.show_legend else []
        return frame.finish(axes, lines, f"Each record alone: {confirmation.verdict}", legends)
