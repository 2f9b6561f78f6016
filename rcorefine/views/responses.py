"""Table and picture of models beside a measured frequency response."""

from __future__ import annotations

from typing import Any

import control as ct
import numpy as np

from ..comparison.failure_map.frequency import frequency_text
from ..comparison.responses import FrequencyComparison
from .bode import bode
from .figures import Frame, draws
from .tables import Table, number, tabulates

__all__ = ["plot_responses", "responses_table"]


@tabulates(FrequencyComparison)
def responses_table(result: FrequencyComparison) -> Table:
    """One row per model, output and input."""
    fit, worst = (a if result.several else a[None] for a in (result.fit, result.worst))
    typical = result.relative_error if result.several else result.relative_error[None]
    rows = [
        [
            name, result.measured.output_labels[i], result.measured.input_labels[j], number(fit[m, i, j], 3),
            number(float(np.nanmedian(typical[m, i, j])), 2), frequency_text(float(worst[m, i, j])),
        ]
        for m, name in enumerate(result.names)
        for i in range(fit.shape[1])
        for j in range(fit.shape[2])
    ]  # fmt: skip
    omega = result.measured.omega
    low, high = frequency_text(float(omega[0])), frequency_text(float(omega[-1]))
    several = "s" if len(result.names) > 1 else ""
    title = (
        f"{len(result.names)} model{several} on response {result.measured.name!r}: "
        f"{omega.size} frequencies, {low} ... {high}"
    )
    notes = [
        "fit = 100 (1 - |G - Gh| / |G - mean(G)|) of the complex responses: 100 % is perfect.",
        "error: median of |Gh/G - 1|; worst: where |G - Gh| is largest.",
    ]
    headers = ["model", "output", "input", "fit [%]", "error", "worst"]
    return Table(headers, rows, title, notes, left=3)


@draws(FrequencyComparison)
def plot_responses(result: FrequencyComparison, frame: Frame, *, omega: Any = None) -> ct.ControlPlot:
    """Bode plot with an error row; see `FrequencyComparison.plot`."""
    systems = [(model.name, model) for model in result.models]
    title = f"Models and response {result.measured.name}"
    return bode(systems, result.measured, omega, frame, title=title)
