"""Tests and plots of residuals.

The plots show their correlations and their size against the prediction horizon.
"""

from __future__ import annotations

from typing import Any

import control as ct
import numpy as np

from ..comparison.correlation import correlogram
from ..comparison.horizon import horizon_error
from ..comparison.residual_tests import TestTable
from ..comparison.result import Comparison
from ..words import chance
from .figures import BAND, MEASURED, Frame, plain, style, unit_text
from .tables import Table, number, tabulates

__all__ = ["plot_horizon", "plot_residual", "tests_table"]

_LAGS = 25


@tabulates(TestTable)
def tests_table(tests: TestTable) -> Table:
    """One row per test and signal."""
    rows = [[r.test, r.signal, number(r.statistic), str(r.dof), chance(r.p_value)] for r in tests.rows]
    bad = tests.failed()
    verdict = (
        "No test is significant at 1 %, corrected for the number of tests."
        if not bad
        else f"Significant at 1 %: {', '.join(dict.fromkeys(r.test for r in bad))}."
    )
    return Table(["test", "signal", "statistic", "dof", "p-value"], rows, notes=[verdict, tests.note], left=2)


def plot_residual(result: Comparison, frame: Frame) -> ct.ControlPlot:
    """Draw the correlations of residuals with themselves and the inputs.

    See `Comparison.plot`.
    """
    data = result.data
    names = frame.labels(result.names)
    residual = data.outputs[None] - result.runs
    lags = min(_LAGS, data.n_samples // 4)
    with frame.axes([1.5] * data.n_outputs, 1 + data.n_inputs) as (axes, lines):
        for i, j in np.ndindex(axes.shape):
            axis = axes[i, j]
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
            axis.axhspan(
                -wide, wide, color=BAND, linewidth=0, zorder=1, label="no correlation (99 % per lag)"
            )
            axis.axhline(0.0, color=MEASURED, linewidth=0.7, zorder=2)
            if j:
                axis.axvline(0.0, color=MEASURED, linewidth=0.7, linestyle=":", zorder=2)
            if i == 0:
                source = data.input_labels[j - 1] if j else ""
                heading = "with itself" if j == 0 else f"with {source} (left of 0: feedback)"
                axis.set_title(plain(heading), fontsize="medium")
            if j == 0:
                axis.set_ylabel(plain(f"Correlation\n{data.output_labels[i]}"))
            axis.grid(True, alpha=0.3)
        for axis in axes[-1]:
            axis.set_xlabel("Lag [samples]")
        return frame.finish(axes, lines, [axes[0, 0]], f"Residuals on record {data.name}")


def plot_horizon(result: Comparison, frame: Frame) -> ct.ControlPlot:
    """Error against how far ahead is predicted; see `Comparison.plot`."""
    found = horizon_error(result)
    data = result.data
    names, led = frame.labels(result.names), "observer"
    with frame.axes([2.2] * data.n_outputs, 1) as (axes, lines):
        for i in range(data.n_outputs):
            axis = axes[i, 0]
            for m, name in enumerate(names):
                look: dict[str, Any] = dict(style(m)._asdict(), label=name, zorder=3)
                lines[i, 0] += axis.plot(found.seconds, found.rmse[m, i], marker=".", **look)
                axis.axhline(
                    found.free_run[m, i], color=style(m).color, linewidth=0.8, linestyle=":", zorder=2,
                    label=(led if result.led else "simulation") if m == 0 else None,
                )  # fmt: skip
            axis.set_xscale("log")
            axis.set_yscale("log")
            axis.set_ylabel(unit_text(f"RMSE of {data.output_labels[i]}", data.output_units[i]))
            axis.grid(True, which="both", alpha=0.25)
        axes[-1, 0].set_xlabel("Prediction horizon [s]")
        title = f"Error against prediction horizon, record {data.name}"
        return frame.finish(axes, lines, [axes[0, 0]], title)
