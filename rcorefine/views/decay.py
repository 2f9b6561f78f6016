"""Plot of a free decay: amplitude, period, damping ratio, frequency."""

from __future__ import annotations

from typing import Any

import control as ct
import numpy as np

from ..comparison.decay import Decay, decay_of
from ..comparison.result import Comparison
from ..exceptions import DataError
from .figures import MEASURED, Frame, style, unit_text

__all__ = ["plot_decay"]


def plot_decay(result: Comparison, frame: Frame) -> ct.ControlPlot:
    """Draw amplitude, period, damping ratio and frequency of each output.

    See `Comparison.plot`.
    """
    data, names = result.data, frame.labels(result.names)
    with frame.axes([2.2, 2.2] * data.n_outputs, 2) as (axes, lines):
        for i in range(data.n_outputs):
            measured = decay_of(data.outputs[i], data.dt, float(data.timepts[0]))
            block, drawn = axes[2 * i : 2 * i + 2], lines[2 * i : 2 * i + 2]
            dots = {"color": MEASURED, "marker": "o", "markersize": 3.5, "linestyle": "", "label": "measured"}
            _draw(block, drawn, measured, dots)
            for m, name in enumerate(names):
                try:
                    model = decay_of(result.runs[m, i], data.dt, float(data.timepts[0]))
                except DataError:  # this model does not swing
                    continue
                _draw(block, drawn, model, dict(style(m)._asdict(), label=name))
            label, unit = data.output_labels[i], data.output_units[i]
            texts = [f"Amplitude of {label}", "Damping ratio [%]", "Period [s]", "Frequency [Hz]"]
            for axis, text in zip(block.ravel(), texts, strict=True):
                axis.set_ylabel(unit_text(text, unit) if "Ampl" in text else text)
                axis.grid(True, alpha=0.3)
            block[0, 0].set_yscale("log")
            block[0, 1].set_ylim(0.0, 1.3 * 100 * float(np.max(measured.damping_ratio)))
            for axis, known in ((block[1, 0], measured.period), (block[1, 1], 1 / measured.period)):
                axis.set_ylim(0.95 * np.median(known), 1.05 * np.median(known))
            for axis, text in zip(block[1], ("Time [s]", unit_text("Amplitude", unit)), strict=True):
                axis.set_xlabel(text)
        return frame.finish(axes, lines, [axes[0, 0]], f"Free decay, record {data.name}")


def _draw(axes: Any, lines: Any, found: Decay, look: dict[str, Any]) -> None:
    """Draw one decay in four panels."""
    curves = (
        (found.timepts, found.amplitude), (found.amplitude, 100 * found.damping_ratio),
        (found.timepts, found.period), (found.amplitude, 1 / found.period),
    )  # fmt: skip
    for where, (x, y) in zip(np.ndindex(2, 2), curves, strict=True):
        lines[where] = [*(lines[where] or []), *axes[where].plot(x, y, **look)]
