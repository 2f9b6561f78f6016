"""Physical models, refinements and improvements as text and pictures."""

from __future__ import annotations

from collections.abc import Sequence
from html import escape
from typing import Any

import control as ct
import numpy as np
from numpy.typing import ArrayLike

from ..arguments import as_choice
from ..data.measurement import Measurement
from ..diagnosis.check_rows import warned
from ..diagnosis.result import Improvement, next_step
from ..effects.effect import Effect
from ..inference.parameters import EstimatedParameter
from ..inference.refinement import Refinement
from ..models.physical_model import PhysicalModel
from ..results import counted, shows, with_error
from ..systems.linear import Array, LinearModel
from ..systems.response import as_sampled, frequency_response
from .bode import bode, bode_grid, level_bode
from .figures import BAND, Frame, draws, plain, style, unit_text, write_at
from .tables import WIDTH, TextTable, Told, cells, html_table, root_mean_square, tells

_SHOWN = 12  # parameters in the text


@shows(PhysicalModel, "text")
def model_text(model: PhysicalModel) -> str:
    """Signals, places and nominal parameters in at most 80 columns.

    Parameters
    ----------
    model : PhysicalModel
        Model to describe.

    Returns
    -------
    str
        Lines of text.
    """
    linear = model.linear
    counts = {"state": linear.n_states, "input": linear.n_inputs, "output": linear.n_outputs}
    size = ", ".join(counted(count, word) for word, count in counts.items())
    lines = [f"Physical model {linear.name!r}: {size}"]
    for what, labels, units in (
        ("inputs", linear.input_labels, model.input_units),
        ("outputs", linear.output_labels, model.output_units),
        ("states", linear.state_labels, model.state_units),
    ):
        pairs = zip(labels, units, strict=True)
        lines += _wrap(f"{what:<8}", [f"{label} [{unit}]" if unit else label for label, unit in pairs])
    lines += _wrap("places  ", [port.name for port in model.ports])
    shown = model.parameters[:_SHOWN]
    if shown:
        width = max(len(item.name) for item in shown)
        lines.append("parameters of the initial model (an effect at the place adds to the value)")
        for item in shown:
            unit = "" if item.unit == "1" else item.unit
            value = f"{item.value:.6g} {unit}".strip()
            # the effect in the words of its place, and the kind that `Effect` takes
            called, label = f"{item.kind} at {item.place}", model.check(Effect(item.kind, item.place)).label
            called = called if label == called else f"{label} ({item.kind})"
            lines.append(f"  {item.name:<{width}} = {value:<20} {called}"[:WIDTH])
        if len(model.parameters) > len(shown):
            lines.append(f"  ... and {len(model.parameters) - len(shown)} more")
    return "\n".join(line.rstrip() for line in lines)


@shows(PhysicalModel, "html")
def model_html(model: PhysicalModel) -> str:
    """Places and nominal parameters for a notebook.

    Parameters
    ----------
    model : PhysicalModel
        Model to describe.

    Returns
    -------
    str
        HTML, escaped.
    """
    rows = [cells(item, "name value:.6g unit kind place") for item in model.parameters]
    ports = "".join(f"<li>{escape(str(port))}</li>" for port in model.ports)
    head = f"<p><b>Physical model {escape(repr(model.name))}</b></p><p>Places:</p><ul>{ports}</ul>"
    return head + html_table(["parameter", "value", "unit", "kind", "place"], rows)


def _wrap(head: str, items: Sequence[str]) -> list[str]:
    """Comma-separated items in lines of at most 80 columns."""
    lines, line = [], head
    for index, item in enumerate(items):
        piece = item + ("," if index + 1 < len(items) else "")
        if len(line) + 1 + len(piece) > WIDTH and line.strip():
            lines.append(line)
            line = " " * len(head)
        line += " " + piece
    return [*lines, line]


_DRAWN = 100  # models whose spread is the band of a Bode plot


@tells(Refinement)
def refinement_told(found: Refinement) -> Told:
    """The parameters, and what the figures mean."""
    name, said = found.physical_model.linear.name, found.sentences()
    return [f"Refinement of {name!r}"], estimates_table(found.parameters, f"Refinement of {name}", said), said


def estimates_table(parameters: Sequence[EstimatedParameter], title: str, notes: Sequence[str]) -> TextTable:
    """Estimated numbers, initial and fitted, with the priors that count."""
    headers, rows = ["parameter", "effect", "place", "initial", "value", "std", "unit"], []
    known = any(row.is_known for row in parameters)
    if known:
        headers.insert(4, "prior")
    for row in parameters:
        prior = f"{row.prior:.3g}" if row.is_known else ""
        rows.append([*row.cells[:4], *([prior] if known else []), *row.cells[4:]])
    return TextTable(headers, rows, title, notes)


@draws(Refinement, "bode_plot")
def plot_bode(
    found: Refinement,
    frame: Frame,
    measured: Any = None,
    omega: ArrayLike | None = None,
    *,
    levels: Sequence[float] | None = None,
) -> ct.ControlPlot:
    """Draw the initial and refined model beside the measured response.

    See `Refinement.bode_plot`.
    """
    if levels is not None:
        return level_bode(found, levels, measured, omega, frame)
    if isinstance(measured, Measurement):
        measured = measured.frequency_response()
    systems = [("initial", found.physical_model.system), ("refined", found.system)]

    def deviation(grid: Array) -> Array:
        models = [LinearModel.from_statespace(one) for one in found.drawn(_DRAWN)]
        if measured is not None:
            models = [as_sampled(one, measured.dt, measured.hold) for one in models]
        return np.asarray(np.std([frequency_response(one, grid) for one in models], axis=0))

    return bode(systems, measured, omega, frame, deviation)


@draws(Refinement, "response_plot")
def plot_response(
    found: Refinement, frame: Frame, kind: str = "step", *, count: int = 200, seed: int = 0
) -> ct.ControlPlot:
    """Draw step responses, poles and zeros, or Nyquist curves.

    See `Refinement.response_plot`.
    """
    draws_of = {"step": _step, "poles": _poles, "nyquist": _nyquist}
    draw = draws_of[as_choice(kind, "kind", (*draws_of,))]
    names = frame.labels(["initial", "refined"])
    systems, drawn = [found.physical_model.system, found.system], found.drawn(count, seed)
    size = (1, 1) if kind == "poles" else (systems[1].noutputs, systems[1].ninputs)
    with frame.axes([2.4] * size[0], size[1]) as (axes, lines):
        draw(axes, lines, systems, names, drawn)
        if kind != "poles":
            for i, j in np.ndindex(size):
                to, by = systems[1].output_labels[i], systems[1].input_labels[j]
                axes[i, j].set_title(f"{plain(by)} to {plain(to)}", fontsize="medium")
        return frame.finish(axes, lines, axes[:1, 0], f"{found.physical_model.linear.name}: {_TITLES[kind]}")


_TITLES = {"step": "step response", "poles": "poles (x) and zeros (o)", "nyquist": "Nyquist curves"}


def _step(axes: Any, lines: Any, systems: Any, names: Sequence[str], drawn: Any) -> None:
    times = ct.step_response(systems[1]).time
    for k, (system, name) in enumerate(zip(systems, names, strict=True)):
        y = ct.step_response(system, times, squeeze=False).outputs
        for i, j in np.ndindex(axes.shape):
            lines[i, j] += axes[i, j].plot(times, y[i, j], label=name, **style(k)._asdict())
    if drawn:
        of_draws = np.array([ct.step_response(one, times, squeeze=False).outputs for one in drawn])
        low, high = np.quantile(of_draws, [0.025, 0.975], axis=0)
        for i, j in np.ndindex(axes.shape):
            axes[i, j].fill_between(times, low[i, j], high[i, j], color=BAND, lw=0, label="95 % band")
    for ax in axes[-1]:
        ax.set_xlabel("time [s]")


def _poles(axes: Any, lines: Any, systems: Any, names: Sequence[str], drawn: Any) -> None:
    ax = axes[0, 0]
    cloud = np.concatenate([[], *(part for one in drawn for part in (one.poles(), _zeros(one)))])
    ax.plot(cloud.real, cloud.imag, ".", color=BAND, ms=3, zorder=1)
    for k, (system, name) in enumerate(zip(systems, names, strict=True)):
        for at, marker in ((system.poles(), "x"), (_zeros(system), "o")):
            look = {"color": style(k).color, "mfc": "none", "ls": "", "marker": marker}
            lines[0, 0] += ax.plot(at.real, at.imag, label=name if marker == "x" else f"_{name}", **look)
    ax.axhline(0.0, color="0.6", lw=0.6, zorder=0)
    ax.axvline(0.0, color="0.6", lw=0.6, zorder=0)
    ax.set(xlabel="real part [rad/s]", ylabel="imaginary part [rad/s]")


def _zeros(system: ct.StateSpace) -> Any:
    """Return the zeros of each channel, joined."""
    channels = np.ndindex(system.noutputs, system.ninputs)
    return np.concatenate([[], *(system[i, j].zeros() for i, j in channels)])


def _nyquist(axes: Any, lines: Any, systems: Any, names: Sequence[str], drawn: Any) -> None:
    models = [LinearModel.from_statespace(one) for one in systems]
    grid = np.unique(np.concatenate([bode_grid(model, None, None) for model in models]))
    for one in drawn:
        G = frequency_response(LinearModel.from_statespace(one), grid)
        for i, j in np.ndindex(axes.shape):
            axes[i, j].plot(G[i, j].real, G[i, j].imag, color=BAND, lw=0.6, zorder=1)
    for k, (model, name) in enumerate(zip(models, names, strict=True)):
        G = frequency_response(model, grid)
        for i, j in np.ndindex(axes.shape):
            look = style(k)._asdict()
            lines[i, j] += axes[i, j].plot(G[i, j].real, G[i, j].imag, label=name, zorder=3, **look)
    for ax in axes.flat:
        ax.plot(-1.0, 0.0, "+", color="0.3", zorder=2)
        ax.set(xlabel="real part", ylabel="imaginary part")


@tells(Improvement)
def improvement_told(found: Improvement) -> Told:
    """The steps, and what they mean."""
    headers = ["step", "coefficient", "fitted", "selection", "held out"]
    rows = []
    for i, step in enumerate(found.steps):
        value = next((with_error(v, step.std[name]) for name, v in step.coefficients.items()), "")
        errors = (step.train_rmse, step.choice_rmse, step.validation_rmse)
        rows.append([f"{i} {step.name}", value, *(f"{root_mean_square(e):.4g}" for e in errors)])
    odd = warned(found.checks, found.verdict in ("adequate", "parameters"), [e.place for e in found.effects])
    said = found.sentences()
    above = [f"Improvement in {counted(len(found.steps) - 1, 'step')}: {found.verdict.upper()}", *odd]
    following = f"Next: {next_step(found)}"
    table = TextTable(headers, rows, f"Improvement: {found.verdict}", [*odd, *said, following])
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
        errors = {
            name: [root_mean_square(getattr(step, f"{name}_rmse")) for step in steps]
            for name in ("train", "choice", "validation")
        }
        looks = (("fitted", "0.65", ":", 1.5), ("selection", "0.45", "--", 1.5), (held_out, "C0", "-", 2.5))
        for values, (name, color, line, width) in zip(errors.values(), looks, strict=True):
            look = {"color": color, "linestyle": line, "linewidth": width, "label": name}
            lines[0, 0] += ax.step(position, [values[0], *values], where="pre", **look)
        held = errors["validation"]
        for i, value in enumerate(held):
            above = value >= max(errors["train"][i], errors["choice"][i])  # where no other line runs
            look = {"ha": "center", "va": "bottom" if above else "top", "fontsize": "small"}
            write_at(ax, f"{value:.3g}", (i, value), (0, 5 if above else -5), **look)
        if min(held) > 0 and held[0] / min(held) > 5:
            ax.set_yscale("log")
            ax.set_ylim(bottom=min(held) / 2)
        else:
            ax.set_ylim(0, max(held) * 1.35)
        ax.set_xlim(-0.5, len(steps) - 0.5)
        ax.set_xticks(range(len(steps)), [step.name for step in steps], rotation=25, ha="right")
        unit = improvement.output_units[0] if len(improvement.output_units) == 1 else ""
        ax.set_ylabel(unit_text("RMS error", unit))
        after = f"{improvement.verdict} after {counted(len(steps) - 1, 'step')}"
        ax.set_title(frame.title or f"Error after each step: {after}")
        ax.grid(True, axis="y", alpha=0.4)
        place = frame.legend_loc if isinstance(frame.legend_loc, str) else "upper right"
        legend = ax.legend(loc=place) if frame.legends else None
    return ct.ControlPlot(lines, axes, ax.figure, legend)
