"""Tables and pictures of models beside measured frequency responses."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import control as ct
import numpy as np

from ..comparison.responses import FrequencyComparison, LevelComparison
from ..data.frequency_response import FrequencyResponse
from ..words import frequency_text
from .bode import bode
from .bode_axes import bode_rows, broken_phase, draw_measured, magnitude_limits
from .figures import Frame, draws, style
from .tables import Table, number, tabulates

__all__ = ["draw_points", "level_name", "plot_levels", "plot_responses", "responses_table"]

_NOTES = (
    "fit = 100 (1 - |G - Gh| / |G - mean(G)|) of the complex responses: 100 % is perfect.",
    "error: median of |Gh/G - 1|. worst: frequency where |G - Gh| is largest. over std: residual divided "
    "by the standard deviation of the points, 1 if it is noise ('-': not known).",
)
_HEADERS = ("model", "output", "input", "fit [%]", "error", "over std", "worst")
_GRAYS = ("0.15", "0.4", "0.6", "0.75")


@tabulates(FrequencyComparison)
def responses_table(result: FrequencyComparison) -> Table:
    """One row per model, output and input."""
    several = "s" if len(result.names) > 1 else ""
    title = (
        f"{len(result.names)} model{several} on response {result.measured.name!r}: {_band(result.measured)}"
    )
    return Table(list(_HEADERS), _rows(result), title, list(_NOTES), left=3)


@tabulates(LevelComparison)
def levels_table(result: LevelComparison) -> Table:
    """One row per amplitude, model, output and input."""
    first = result.levels[0]
    title = f"{len(first.names)} model(s) on {len(result.levels)} responses: {_band(first.measured)}"
    rows = [[level_name(level.measured), *row] for level in result.levels for row in _rows(level)]
    return Table(["response", *_HEADERS], rows, title, list(_NOTES), left=4)


def _band(measured: FrequencyResponse) -> str:
    omega = measured.omega
    low, high = frequency_text(float(omega[0])), frequency_text(float(omega[-1]))
    return f"{omega.size} frequencies, {low} ... {high}"


def level_name(measured: FrequencyResponse) -> str:
    """A response by its amplitude, or by its name where that is not known."""
    if measured.amplitude is None:
        return measured.name
    low, high = float(measured.amplitude.min()), float(measured.amplitude.max())
    peak = number(low, 3) if low == high else f"{number(low, 3)} ... {number(high, 3)}"
    return f"{peak} {measured.input_units[0]}".strip()


def _rows(result: FrequencyComparison) -> list[list[str]]:
    figures = (result.fit, result.worst, result.relative_error, result.over_noise)
    fit, worst, typical, noise = (a if result.several else a[None] for a in figures)
    return [
        [
            name, result.measured.output_labels[i], result.measured.input_labels[j], number(fit[m, i, j], 3),
            number(float(np.nanmedian(typical[m, i, j])), 2),
            number(float(noise[m, i, j]), 3) if np.isfinite(noise[m, i, j]) else "-",
            frequency_text(float(worst[m, i, j])),
        ]
        for m, name in enumerate(result.names)
        for i in range(fit.shape[1])
        for j in range(fit.shape[2])
    ]  # fmt: skip


@draws(FrequencyComparison)
def plot_responses(result: FrequencyComparison, frame: Frame, *, omega: Any = None) -> ct.ControlPlot:
    """Bode plot with an error row; see `FrequencyComparison.plot`.

    Where a model has a delay or nonlinear effects, its curve joins the measured points, without that row.
    """
    title = f"Models and response {result.measured.name}"
    if not result.linear:
        return draw_points([(result.measured, result.responses)], result.names, frame, title)
    systems = [(model.name, model) for model in result.models]
    return bode(systems, result.measured, omega, frame, title=title)


@draws(LevelComparison)
def plot_levels(result: LevelComparison, frame: Frame) -> ct.ControlPlot:
    """Draw measured points and models at each amplitude.

    See `LevelComparison.plot`.
    """
    curves = [(level.measured, level.responses) for level in result.levels]
    return draw_points(curves, result.levels[0].names, frame, "Models and responses at several amplitudes")


def draw_points(
    curves: Sequence[tuple[FrequencyResponse, Any]], names: Sequence[str], frame: Frame, title: str
) -> ct.ControlPlot:
    """Draw measured responses as dots and models as lines.

    The models have shape (n_models, n_y, n_w, n_omega) and the frequencies of the measured responses.
    """
    first = curves[0][0]
    said = frame.labels([level_name(measured) for measured, _ in curves])
    with frame.axes([1.8, 1.4] * first.noutputs, first.ninputs) as (axes, lines):
        units = bode_rows(axes, first.output_labels, first.input_labels, extra=None)
        for k, (measured, responses) in enumerate(curves):
            x = measured.omega * units.frequency_factor
            for i, j in np.ndindex(measured.response.shape[:2]):
                upper, lower = axes[2 * i : 2 * i + 2, j]
                dots = draw_measured(upper, lower, measured, i, j, said[k], units)
                for row, some in enumerate(dots):
                    for dot in some:
                        dot.set_color(_GRAYS[k % len(_GRAYS)])
                    lines[2 * i + row, j] += some
                for m, curve in enumerate(responses[:, i, j]):
                    look: dict[str, Any] = dict(style(m)._asdict(), zorder=3)
                    look["label"] = names[m] if k == 0 else f"_{names[m]}"
                    lines[2 * i, j] += upper.plot(x, units.magnitude(np.abs(curve)), **look)
                    at, angle = broken_phase(measured.omega, curve)
                    turned = angle * units.phase_factor
                    lines[2 * i + 1, j] += lower.plot(at * units.frequency_factor, turned, **look)
                magnitude_limits(upper, lines[2 * i, j], units)
        return frame.finish(axes, lines, [axes[0, 0]], title)
