"""Pictures of residuals: their correlations, and their size against the prediction horizon."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import control as ct
import numpy as np

from .figures import BAND, MEASURED, curve_labels, finish, make_axes, picture, settings, style, unit_text

if TYPE_CHECKING:
    from ..comparison.result import Comparison

__all__ = ["plot_horizon", "plot_residual"]

_LAGS = 25


@picture
def plot_residual(
    result: Comparison,
    *,
    ax: Any = None,
    label: str | Sequence[str] | None = None,
    title: str | None = None,
    legend_loc: str | bool | None = None,
    rcParams: dict[str, Any] | None = None,
    show_legend: bool | None = None,
) -> ct.ControlPlot:
    """Autocorrelation of residuals and their correlation with the inputs; see `Comparison.plot`."""
    from ..comparison.residual_tests import correlogram

    data = result.data
    names = curve_labels(label, result.names)
    residual = data.outputs[None] - result.runs
    lags = min(_LAGS, data.n_samples // 4)
    with settings(rcParams):
        figure, axes = make_axes(ax, [1.5] * data.n_outputs, 1 + data.n_inputs)
        lines = np.empty(axes.shape, dtype=object)
        for i, j in np.ndindex(axes.shape):
            axis, lines[i, j] = axes[i, j], []
            wide = 0.0
            for m, name in enumerate(names):
                e = residual[m, i]
                if np.ptp(e) == 0.0 or (j and np.ptp(data.inputs[j - 1]) == 0.0):
                    continue
                found = correlogram(e if j == 0 else data.inputs[j - 1], e, lags)
                keep = found.lags > 0 if j == 0 else np.isfinite(found.lags)
                look: dict[str, Any] = dict(style(m)._asdict(), label=name, zorder=3)
                look |= {"marker": ".", "markersize": 3.5}
                lines[i, j] += axis.plot(found.lags[keep], found.correlation[keep], **look)
                wide = max(wide, float(found.bound[0]))
                if len(names) > 1 and j:  # each residual has a color of its own, and so a bound
                    for bound in (-found.bound[0], found.bound[0]):
                        axis.axhline(bound, color=style(m).color, linewidth=0.8, linestyle=":", zorder=2)
            axis.axhspan(-wide, wide, color=BAND, linewidth=0, zorder=1, label="chance (99 % per lag)")
            axis.axhline(0.0, color=MEASURED, linewidth=0.7, zorder=2)
            if j:
                axis.axvline(0.0, color=MEASURED, linewidth=0.7, linestyle=":", zorder=2)
            if i == 0:
                source = data.input_labels[j - 1] if j else ""
                heading = "with itself" if j == 0 else f"with {source} (left of 0: feedback)"
                axis.set_title(heading.replace("$", r"\$"), fontsize="medium")
            if j == 0:
                axis.set_ylabel(f"Correlation\n{data.output_labels[i]}".replace("$", r"\$"))
            axis.grid(True, alpha=0.3)
        for axis in axes[-1]:
            axis.set_xlabel("Lag [samples]")
        return finish(
            figure, axes, lines,
            title=f"Residuals on record {data.name}" if title is None and ax is None else title,
            legends=[axes[0, 0]], legend_loc=legend_loc, show_legend=show_legend,
        )  # fmt: skip


@picture
def plot_horizon(
    result: Comparison,
    *,
    ax: Any = None,
    label: str | Sequence[str] | None = None,
    title: str | None = None,
    legend_loc: str | bool | None = None,
    rcParams: dict[str, Any] | None = None,
    show_legend: bool | None = None,
) -> ct.ControlPlot:
    """Error against how far ahead is predicted; see `Comparison.plot`."""
    from ..comparison.horizon import horizon_error

    found = horizon_error(result)
    data = result.data
    names = curve_labels(label, result.names)
    with settings(rcParams):
        figure, axes = make_axes(ax, [2.2] * data.n_outputs, 1)
        lines = np.empty(axes.shape, dtype=object)
        for i in range(data.n_outputs):
            axis, lines[i, 0] = axes[i, 0], []
            for m, name in enumerate(names):
                look: dict[str, Any] = dict(style(m)._asdict(), label=name, zorder=3)
                lines[i, 0] += axis.plot(found.seconds, found.rmse[m, i], marker=".", **look)
                axis.axhline(
                    found.free_run[m, i], color=style(m).color, linewidth=0.8, linestyle=":", zorder=2,
                    label="free run" if m == 0 else None,
                )  # fmt: skip
            axis.set_xscale("log")
            axis.set_yscale("log")
            axis.set_ylabel(unit_text(f"RMSE of {data.output_labels[i]}", data.output_units[i]))
            axis.grid(True, which="both", alpha=0.25)
        axes[-1, 0].set_xlabel("Predicted ahead [s]")
        return finish(
            figure, axes, lines,
            title=f"Error against prediction horizon, record {data.name}"
            if title is None and ax is None
            else title,
            legends=[axes[0, 0]], legend_loc=legend_loc, show_legend=show_legend,
        )  # fmt: skip
