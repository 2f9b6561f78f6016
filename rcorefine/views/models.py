"""Physical models, refinements and improvements as text and pictures."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import control as ct
import numpy as np
from numpy.typing import ArrayLike

from ..arguments import as_choice
from ..comparison.signals import root_mean_square
from ..diagnosis.result import Improvement
from ..effects.effect import Effect
from ..inference.parameters import EstimatedParameter
from ..inference.refinement import Refinement
from ..models.physical_model import PhysicalModel
from ..results import counted
from ..systems.linear import Array, LinearModel
from ..systems.response import as_sampled, frequency_response
from .bode import as_response, bode, bode_grid, level_bode
from .content import Content, content, fields
from .figures import BAND, Frame, plain, style, unit_text, write_at
from .page import signal_names
from .tables import TextTable

_SHOWN = 12  # parameters in the text


@content.register
def physical_content(model: PhysicalModel) -> Content:
    """Return the content of a physical model: signals, places and parameters."""
    linear = model.linear
    counts = {"state": linear.n_states, "input": linear.n_inputs, "output": linear.n_outputs}
    signals = {
        "inputs": (linear.input_labels, model.input_units),
        "outputs": (linear.output_labels, model.output_units),
        "states": (linear.state_labels, model.state_units),
    }
    said = [f"{what}: {signal_names(*names)}" for what, names in signals.items()]
    rows = []
    for item in model.parameters[:_SHOWN]:
        # the effect in the words of its place, and the kind that `Effect` takes
        called, label = f"{item.kind} at {item.place}", model.check(Effect(item.kind, item.place)).label
        unit = "" if item.unit == "1" else item.unit
        told = called if label == called else f"{label} ({item.kind})"
        rows.append([f"{item.name} = {item.value:.6g} {unit}".rstrip(), told])
    left = len(model.parameters) - len(rows)
    notes = ["An effect at the place adds to the value."] if rows else []
    notes += [f"... and {left} more in `parameters`."] if left else []
    places = [[port.name, port.description] for port in model.ports]
    others = [f"... and {', '.join(name for name, _ in places[_SHOWN:])}"] if places[_SHOWN:] else []
    names = "input_units output_units state_units parameters ports"
    return Content(
        title=f"Physical model {linear.name!r}: " + ", ".join(counted(n, word) for word, n in counts.items()),
        above=said,
        tables=[
            TextTable(["place", "what it is"], places[:_SHOWN], notes=others, left=2),
            TextTable(["parameter of the initial model", "effect"], rows, notes=notes, left=2),
        ],
        data=lambda: {"name": model.name, "system": system_dict(linear), **fields(model, names)},
    )


def system_dict(model: LinearModel) -> dict[str, Any]:
    """Return matrices and labels of a linear model, by name."""
    labels = {"inputs": model.input_labels, "outputs": model.output_labels, "states": model.state_labels}
    return {**{key: getattr(model, key) for key in "ABCD"}, **labels}


def estimates_table(
    parameters: Sequence[EstimatedParameter], title: str | None = None, *, full: bool = False
) -> TextTable:
    """Estimated parameters; in full with their roles and intervals."""
    known = any(row.is_known for row in parameters)
    headers = ["parameter", "effect", "place", *["role"] * full, "initial", *["prior"] * known]
    rows = []
    for row in parameters:
        *head, initial, value, std, unit = row.cells
        prior = f"{row.prior:.3g}" if row.is_known else ""
        interval = " ... ".join(f"{end:.5g}" for end in row.interval)
        head += [*[row.role] * full, initial, *[prior] * known, value, std]
        rows.append([*head, *[interval] * full, unit])
    notes = ["std: standard deviation of the estimate over repeated records."] * full
    return TextTable(
        [*headers, "value", "std", *["95 % interval"] * full, "unit"], rows, title, notes, 1 + 3 * full
    )


_DRAWN = 100  # models whose spread is the band of a Bode plot


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
    measured = as_response(measured)
    systems = [("initial", found.physical_model.system), ("refined", found.system)]

    def deviation(grid: Array) -> Array:
        models = [LinearModel.from_statespace(one) for one in found.drawn(_DRAWN)]
        if measured is not None:
            models = [as_sampled(one, measured.dt, measured.hold) for one in models]
        return np.asarray(np.std([frequency_response(one, grid) for one in models], axis=0))

    return bode(systems, measured, omega, frame, deviation)


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
        return frame.finish(axes, lines, f"{found.physical_model.linear.name}: {_TITLES[kind]}")


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
            text = name if marker == "x" else f"_{name}"
            lines[0, 0] += ax.plot(
                at.real, at.imag, color=style(k).color, mfc="none", ls="", marker=marker, label=text
            )  # fmt: skip
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
            over = [values[0], *values]
            lines[0, 0] += ax.step(position, over, where="pre", color=color, ls=line, lw=width, label=name)
        held = errors["validation"]
        for i, value in enumerate(held):
            above = value >= max(errors["train"][i], errors["choice"][i])  # where no other line runs
            look = {"ha": "center", "va": "bottom" if above else "top", "fontsize": "small"}
            write_at(ax, f"{value:.3g}", (i, value), (0, 5 if above else -5), **look)
        if min(held) > 0 and held[0] / min(held) > 5:
            ax.set_yscale("log")
            ax.set_ylim(bottom=min(held) / 2)
        else:
            ax.set_ylim(0, max(held) * 1.35 or 1.0)
        ax.set_xlim(-0.5, len(steps) - 0.5)
        ax.set_xticks(range(len(steps)), [step.name for step in steps], rotation=25, ha="right")
        unit = improvement.output_units[0] if len(improvement.output_units) == 1 else ""
        ax.set_ylabel(unit_text("RMS error", unit))
        after = f"{improvement.verdict} after {counted(len(steps) - 1, 'step')}"
        return frame.finish(axes, lines, f"Error after each step: {after}")


def estimates(refinement: Refinement) -> list[EstimatedParameter]:
    """Return the estimated parameters without nuisance offsets.

    An offset has no scale on which to draw it.
    """
    return [row for row in refinement.parameters if row.role != "offset" and np.isfinite(row.std)]


def parameter_plot(refinement: Refinement) -> ct.ControlPlot:
    """Estimates with intervals, one row each, relative to the initial model."""
    rows = estimates(refinement)
    frame = Frame()
    with frame.axes([max(1.0, 0.3 * len(rows))], 1) as (axes, lines):
        axis = axes[0, 0]
        names = []
        for i, row in enumerate(rows):
            size = abs(row.initial) or abs(row.value) or 1.0
            start, value, spread = row.initial / size, row.value / size, 1.96 * row.std / size
            axis.errorbar(value, i, xerr=min(spread, 1e3), fmt="o", color="#1f4e9c", capsize=3, markersize=4)
            axis.plot(start, i, marker="|", markersize=14, color="0.15")
            text = f"{row.value:.4g} {row.unit}"
            write_at(axis, text, (value, i), (0, 6), ha="center", fontsize="x-small")
            names.append(plain(row.name if row.name != row.kind else f"{row.kind} {row.place}"))
        axis.margins(x=0.08)
        axis.set_yticks(range(len(rows)), names)
        axis.set(ylim=(len(rows) - 0.4, -0.6), xlabel="Estimate over initial value")
        lines[0, 0] = list(axis.lines)
        return frame.finish(axes, lines, legends=[])
