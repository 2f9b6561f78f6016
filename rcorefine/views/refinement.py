"""Table and pictures of a `Refinement`."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import control as ct
import numpy as np
from numpy.typing import ArrayLike

from ..arguments import as_choice
from ..data.measurement import Measurement
from ..inference.refinement import EstimatedParameter, Refinement
from ..systems.linear import Array, LinearModel
from ..systems.response import as_sampled, frequency_response
from .bode import bode, bode_grid
from .figures import BAND, Frame, draws, plain, style
from .level_bode import level_bode
from .tables import Table, Told, tells

_DRAWN = 100  # models whose spread is the band of a Bode plot

__all__ = ["estimates_table", "plot_bode", "refinement_told"]


@tells(Refinement)
def refinement_told(found: Refinement) -> Told:
    """The parameters, and what the figures mean."""
    title = f"Refinement of {found.physical_model.linear.name}"
    return (
        [f"Refinement of {found.physical_model.linear.name!r}"],
        estimates_table(found.parameters, title, found.sentences()),
        found.sentences(),
    )


def estimates_table(parameters: Sequence[EstimatedParameter], title: str, notes: Sequence[str]) -> Table:
    """Estimated numbers, initial and fitted."""
    headers = ["parameter", "effect", "place", "initial", "value", "std", "unit"]
    return Table(headers, [row.cells for row in parameters], title, notes)


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
    draw = {"step": _step, "poles": _poles, "nyquist": _nyquist}[
        as_choice(kind, "kind", ("step", "poles", "nyquist"))
    ]
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
    ax.set_xlabel("real part [rad/s]")
    ax.set_ylabel("imaginary part [rad/s]")


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
        ax.set_xlabel("real part")
        ax.set_ylabel("imaginary part")
