"""A refiner as a table, as a Bode plot, and its course over time."""

from __future__ import annotations

from typing import Any

import control as ct
import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..streaming.coefficients.history import CoefficientHistory
from ..streaming.rcmr.history import History
from ..streaming.refiner import RCORefiner
from ..systems.linear import Array
from .bode import bode
from .figures import Frame, draws, plain, style
from .tables import Table, tabulates
from .traces import trace

__all__ = ["plot_bode", "plot_coefficients", "plot_stages", "refiner_table"]


@tabulates(RCORefiner)
def refiner_table(refiner: RCORefiner) -> Table:
    """Settings, or parameters, with what the refiner has learned so far."""
    found = refiner._summary()
    left = 1 if refiner.form == "paper" else 3
    return Table(found.headers, found.rows, found.title, found.notes, left)


@draws(RCORefiner, "bode_plot")
def plot_bode(
    refiner: RCORefiner, frame: Frame, measured: Any = None, omega: ArrayLike | None = None
) -> ct.ControlPlot:
    """Draw the initial and refined model beside the measured response.

    See `RCORefiner.bode_plot`.
    """
    systems = [("initial", refiner._sampled.initial), ("refined", refiner.system)]
    return bode(systems, measured, omega, frame, refiner._estimator.deviation())


@draws(History)
def plot_stages(history: History, frame: Frame) -> ct.ControlPlot:
    """Draw the performance of both stages, static coefficients and poles.

    See `History.plot`.
    """
    names = frame.labels(["stage 1", "stage 2"])
    n_y = history.z1.shape[0]
    with frame.axes([1.6] * (n_y + 2), 1) as (axes, lines):
        for row, output in enumerate(history.output_labels):
            axis = axes[row, 0]
            for index, z in ((1, history.z2), (0, history.z1)):
                look = {"color": style(index).color, "linewidth": 0.8, "label": names[index]}
                lines[row, 0] += trace(axis, history.timepts, z[row], **look)
            axis.set_ylabel(plain(f"simulated - measured\n{output}"))
            axis.grid(True, alpha=0.35)
        axis = axes[n_y, 0]
        lines[n_y, 0] = axis.plot(
            history.timepts, history.theta2.reshape(-1, history.timepts.size).T, linewidth=1.0
        )
        for line, text in zip(lines[n_y, 0], _coefficients(history), strict=False):
            line.set_label(plain(text))
        axis.set_ylabel("static coefficients")
        axis.grid(True, alpha=0.35)
        lines[n_y + 1, 0] = _draw_poles(axes[n_y + 1, 0], history.pole_timepts, history.poles)
        return frame.finish(axes, lines, [axes[0, 0], axis])


def _coefficients(history: History) -> list[str]:
    """Signal of each static coefficient, where the static stage has no memory."""
    names = [*history.state_labels, *history.input_labels]
    l_u, q = history.theta2.shape[:2]
    if q != len(names):
        return []
    return [f"{name} (u{c})" if l_u > 1 else name for c in range(l_u) for name in names]


@draws(CoefficientHistory)
def plot_coefficients(history: CoefficientHistory, frame: Frame) -> ct.ControlPlot:
    """Performance, coefficients and poles; see `CoefficientHistory.plot`."""
    names = frame.labels(history.names)
    n_y = history.z2.shape[0]
    with frame.axes([1.6] * n_y + [2.0, 1.6], 1) as (axes, lines):
        for row, output in enumerate(history.output_labels):
            axis = axes[row, 0]
            stages = ((history.z1, "stage 1"), (history.z2, "static stage, one sample ahead"))
            for index, (z, text) in enumerate(stages):
                if np.isfinite(z[row]).any():
                    look = {"color": style(index).color, "linewidth": 0.8, "label": text}
                    lines[row, 0] += trace(axis, history.timepts, z[row], **look)
            # a stage 1 that diverged must not hide the rest
            usual = np.nanmax(np.abs(history.z2[row]), initial=0.0)
            if usual > 0:
                axis.set_ylim(-1.1 * usual, 1.1 * usual)
            axis.set_ylabel(plain(f"predicted - measured\n{output}"))
            axis.grid(True, alpha=0.35)
        axis = axes[n_y, 0]
        size = np.nanmax(np.abs(history.coefficients), axis=1, initial=0.0)[:, None]
        shown = history.coefficients / np.where(size > 0, size, 1.0)
        lines[n_y, 0] = axis.plot(history.timepts, shown.T, linewidth=1.0)
        for line, text in zip(lines[n_y, 0], names, strict=True):
            line.set_label(plain(text))
        axis.set_ylabel("coefficients /\nlargest value")
        axis.grid(True, alpha=0.35)
        lines[n_y + 1, 0] = _draw_poles(axes[n_y + 1, 0], history.pole_timepts, history.poles)
        return frame.finish(axes, lines, [axes[0, 0], axis])


def _draw_poles(axis: Any, timepts: Array, poles: NDArray[np.complex128]) -> list[Any]:
    """Size of the refined poles over time: dashed where a pole is complex."""
    lines: list[Any] = []
    with np.errstate(invalid="ignore"):
        for pole in poles:
            size, oscillates = np.abs(pole), np.abs(pole.imag) > 1e-6 * np.abs(pole)
            for part, line, name in ((~oscillates, "-", "real"), (oscillates, "--", "complex")):
                if part.any():
                    drawn = axis.plot(
                        timepts, np.where(part, size, np.nan), line, linewidth=1.0, color="tab:purple"
                    )
                    drawn[0].set_label(name if all(one.get_label() != name for one in lines) else f"_{name}")
                    lines += drawn
    positive = np.abs(poles)[np.isfinite(poles) & (np.abs(poles) > 0)]
    if positive.size and positive.max() > 30 * positive.min():
        axis.set_yscale("log")
        axis.set_ylim(max(0.5 * positive.min(), 1e-6 * positive.max()), 2.0 * positive.max())
    axis.set_ylabel("refined poles\n|s| [rad/s]")
    axis.set_xlabel("Time [s]")
    axis.grid(True, alpha=0.35)
    return lines
