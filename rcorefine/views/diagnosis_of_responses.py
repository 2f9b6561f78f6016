"""Picture of a diagnosis of frequency responses.

It shows the candidates, the residual relative to the noise, the magnitude and the phase.
"""

from __future__ import annotations

from typing import Any

import control as ct
import numpy as np

from ..comparison.compare import compare
from ..comparison.responses import FrequencyComparison
from ..diagnosis.result import Diagnosis
from .bode_axes import BodeUnits, broken_phase
from .figures import MEASURED, Frame, style, unit_text
from .rankings import ranking_bars, test_bars, title_of

__all__ = ["plot_of_responses"]


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
