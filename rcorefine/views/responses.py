"""Tables and pictures of models beside measured frequency responses."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import control as ct
import numpy as np

from ..comparison.responses import FrequencyComparison, LevelComparison
from ..data.frequency_response import FrequencyResponse
from ..engine.amplitude_response import AmplitudeResponse
from ..results import counted, frequency_text
from .bode import BodeAxes, bode
from .content import Content, content
from .figures import Frame, look_of
from .tables import TextTable, number

_NOTES = (
    "fit = 100 (1 - |G - Gh| / |G - mean(G)|) of the complex responses: 100 % is perfect.",
    "error: median of |Gh/G - 1|. worst: frequency where |G - Gh| is largest. over std: residual divided "
    "by the standard deviation of the points, 1 if it is noise ('-': not known).",
)
_HEADERS = ("model", "output", "input", "fit [%]", "error", "over std", "worst")
_GRAYS = ("0.15", "0.4", "0.6", "0.75")


def responses_table(result: FrequencyComparison) -> TextTable:
    """One row per model, output and input."""
    measured = result.measured
    title = f"{counted(len(result.names), 'model')} on response {measured.name!r}: {_band(measured)}"
    return TextTable(_HEADERS, _rows(result), title, _NOTES, left=3)


@content.register
def levels_content(result: LevelComparison) -> Content:
    """Return the content of a comparison at several amplitudes."""
    first = result.levels[0]
    title = f"{len(first.names)} model(s) on {len(result.levels)} responses: {_band(first.measured)}"
    rows = [[level_name(level.measured), *row] for level in result.levels for row in _rows(level)]
    return Content(
        tables=[TextTable(["response", *_HEADERS], rows, title, _NOTES, left=4)],
        pictures={"plot": plot_levels},
    )


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


def plot_responses(result: FrequencyComparison, frame: Frame, *, omega: Any = None) -> ct.ControlPlot:
    """Bode plot with an error row; see `FrequencyComparison.plot`.

    Where a model has a delay or nonlinear effects, its curve joins the measured points, without that row.
    """
    title = f"Models and response {result.measured.name}"
    if not result.linear:
        return draw_points([(result.measured, result.responses)], result.names, frame, title)
    systems = [(model.name, model) for model in result.models]
    return bode(systems, result.measured, omega, frame, title=title)


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
        drawn = BodeAxes(axes, lines, first.output_labels, first.input_labels)
        for k, (measured, responses) in enumerate(curves):
            drawn.measured(measured, said[k], color=_GRAYS[k % len(_GRAYS)])
            for m, (name, response) in enumerate(zip(names, responses, strict=True)):
                drawn.curves(measured.omega, response, look_of(m, name if k == 0 else f"_{name}"))
        drawn.limits()
        return frame.finish(axes, lines, title)


_LEVEL_NOTES = (
    "|G|: fundamental of the output divided by the sine at the input; its maximum is also searched between "
    "the frequencies. A linear model has the same |G| at every amplitude.",
    "distortion: the largest share of higher harmonics over the frequencies.",
)


@content.register
def amplitude_content(found: AmplitudeResponse) -> Content:
    """Return the content of an amplitude response: each peak in a row."""
    lost, loose = int((~found.converged).sum()), int((found.converged & ~found.stable).sum())
    title = (
        f"{found.name} driven by a sine at {found.input_label}: {found.omega.size} frequencies, "
        f"{found.omega.min():.4g} ... {found.omega.max():.4g} rad/s"
        + (f"; no steady state found at {lost} of {found.converged.size} points" if lost else "")
        + (f"; unstable at {loose} of {found.converged.size} points" if loose else "")
    )
    rows = []
    for level, amplitude in enumerate(found.amplitude):
        for i, label in enumerate(found.output_labels):
            gain, omega = found.peak_gain[level, i], found.peak_omega[level, i]
            figures = ["-", "-", "-"]
            if np.isfinite(gain):
                most = 100 * np.nanmax(found.distortion[level, i])
                figures = [f"{gain:.4g}", f"{omega:.5g}", f"{most:.2g}"]
            rows.append([f"{amplitude:.4g} {found.input_unit}".strip(), label, *figures])
    headers = ["amplitude", "output", "largest |G|", "at [rad/s]", "distortion [%]"]
    return Content(
        tables=[TextTable(headers, rows, title, _LEVEL_NOTES, left=2)],
        columns=lambda: (_points(found),),
    )


def _points(found: AmplitudeResponse) -> list[dict[str, Any]]:
    """Return the response at each frequency, amplitude and output."""
    response = np.asarray(found.response)
    return [
        {"omega": omega, "amplitude": level, "output": label, "response": response[k, i, j]}
        for k, level in enumerate(np.ravel(found.amplitude))
        for i, label in enumerate(found.output_labels)
        for j, omega in enumerate(found.omega)
    ]
