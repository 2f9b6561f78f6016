"""Bode plot of a model at several input amplitudes.

The measured response is drawn at the amplitudes of the record.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import control as ct
import numpy as np
from numpy.typing import ArrayLike

from ..arguments import as_vector
from ..data.channels import match_channels, record_for
from ..data.frequency_response import FrequencyResponse
from ..data.levels import MOST, stretches_by_level
from ..data.records import as_records
from ..engine.amplitude_response import frequency_response_at
from ..engine.simulation import simulated, structure_of
from ..exceptions import DivergenceError
from ..systems.linear import Array, LinearModel
from ..systems.response import frequency_response, hold_factor
from .bode import bode_grid
from .bode_axes import BodeUnits, bode_rows, broken_phase, draw_measured, magnitude_limits
from .figures import Frame, style

__all__ = ["level_bode"]

_POINTS = 90
_AROUND = 3.0  # the range of the picture on both sides of the modes
_MARKERS = (".", "x", "+")
_GRAYS = ("0.15", "0.45", "0.65")


def level_bode(
    refinement: Any,
    levels: Sequence[float] | Array,
    measured: Any = None,
    omega: ArrayLike | None = None,
    frame: Frame | None = None,
) -> ct.ControlPlot:
    """Bode plot of a model with nonlinear effects at stated amplitudes.

    Parameters
    ----------
    refinement : Refinement
        Model.
    levels : sequence of float
        Peaks of the sine at the input, in its unit.
    measured : Measurement, sequence of Measurement or FrequencyResponse, optional
        Record: its stretches of equal level are drawn as dots, and beside them what the model makes of
        the same input, estimated in the same way.
    omega : array_like of shape (n_omega,), optional
        Frequencies in rad/s.
    frame : Frame, optional
        Axes of shape (2 n_y, n_w), labels of the levels, title, legend, settings.

    Returns
    -------
    ControlPlot
        Lines, axes (magnitude and phase for each output), figure.

    Raises
    ------
    DataError
        If no level is given.
    """
    frame = Frame() if frame is None else frame
    peaks = as_vector(levels, "levels", above=0.0)
    if omega is not None:
        omega = as_vector(omega, "omega", above=0.0)
    structure, theta, _ = structure_of(refinement)
    linear = structure.linear_model
    initial = LinearModel.from_statespace(structure.model.system)
    absorbed = LinearModel.from_statespace(structure.system(theta))
    groups = _measured_groups(refinement, linear, measured)
    dt, hold = (groups[0][1].dt, groups[0][1].hold) if groups else (0.0, "bandlimited")
    grid = _grid(absorbed, groups, omega)
    unit = structure.model.input_units[0] if structure.model.input_units else ""
    names = frame.labels([f"{peak:.4g} {unit} sine".replace("  ", " ") for peak in peaks])
    with frame.axes([1.9, 1.4] * linear.n_outputs, linear.n_inputs) as (axes, lines):
        units = bode_rows(axes, linear.output_labels, linear.input_labels, extra=None)
        base = frequency_response(initial, grid) * hold_factor(grid, dt, hold)
        look: dict[str, Any] = {"color": "0.55", "linestyle": (0, (2, 1.5)), "linewidth": 1.3}
        _draw(axes, lines, grid, base, units, look | {"label": "initial model"})
        for j in range(linear.n_inputs):
            found = frequency_response_at(refinement, grid, peaks, source=j)
            if omega is None:  # with the peaks, which lie between
                found = frequency_response_at(
                    refinement, np.union1d(grid, found.peak_omega[found.peak_omega > 0]), peaks, source=j
                )
            seen = np.where(found.stable[:, None], found.response, np.nan)  # broken where none is stable
            seen = seen * hold_factor(found.omega, dt, hold)
            for index, name in enumerate(names):
                look = dict(style(index)._asdict(), label=name if j == 0 else f"_{name}", zorder=3)
                curve = seen[index, :, None]
                _draw(axes[:, j : j + 1], lines[:, j : j + 1], found.omega, curve, units, look)
        _draw_groups(axes, lines, groups, units, unit)
        for i, j in np.ndindex(linear.n_outputs, linear.n_inputs):
            magnitude_limits(axes[2 * i, j], lines[2 * i, j], units)
        return frame.finish(axes, lines, [axes[0, 0]])


_Group = tuple[float, FrequencyResponse, FrequencyResponse | None]


def _measured_groups(refinement: Any, linear: LinearModel, measured: Any) -> list[_Group]:
    """Return level, measured and model response of each stretch.

    The model response is that to the measured input.
    """
    if measured is None:
        return []
    if isinstance(measured, ct.FrequencyResponseData):
        measured = FrequencyResponse.from_frd(measured)
    if isinstance(measured, FrequencyResponse):
        return [(float("nan"), measured, None)]
    records = as_records(measured, "measured")
    parts = []
    for record in records:
        parts += stretches_by_level(record_for(record, match_channels(linear, record)))
    groups: list[_Group] = []
    for level, part in sorted(parts, key=lambda pair: pair[0])[:MOST]:
        try:
            run = simulated(refinement, part, "estimate", led=True).outputs
        except DivergenceError:
            own = None  # the picture shows the measured dots alone
        else:
            own = part._changed(outputs=run).frequency_response()
        groups.append((level, part.frequency_response(), own))
    return groups


def _grid(model: LinearModel, groups: Sequence[_Group], omega: ArrayLike | None) -> Array:
    """Return the frequencies of the sines, dense near the modes.

    There are fewer than for the curve of a linear model.
    """
    if omega is not None:
        return np.sort(omega)
    full = bode_grid(model, groups[0][1] if groups else None, None)
    roots = np.linalg.eigvals(model.A)
    turning = np.abs(roots[roots.imag > 0])
    if turning.size and not groups:  # levels differ where something resonates
        full = np.geomspace(turning.min() / _AROUND, turning.max() * _AROUND, 2)
    even = np.geomspace(full[0], full[-1], _POINTS)
    near = [w * np.linspace(0.75, 1.35, 31) for w in turning[:6]]
    both = np.unique(np.concatenate([even, *near]))
    inside: Array = both[(both >= full[0]) & (both <= full[-1])]
    return inside


def _draw(axes: Any, lines: Any, grid: Array, curves: Any, units: BodeUnits, look: dict[str, Any]) -> None:
    """Magnitude and phase of curves of shape (n_y, n_w, n_omega)."""
    for i, j in np.ndindex(curves.shape[:2]):
        curve = curves[i, j]
        upper, lower = axes[2 * i, j], axes[2 * i + 1, j]
        lines[2 * i, j] += upper.plot(grid * units.frequency_factor, units.magnitude(np.abs(curve)), **look)
        x, angle = broken_phase(grid, curve)
        lines[2 * i + 1, j] += lower.plot(x * units.frequency_factor, angle * units.phase_factor, **look)


def _draw_groups(axes: Any, lines: Any, groups: Sequence[_Group], units: BodeUnits, unit: str) -> None:
    """Measured dots, and thin lines for the model on the same input."""
    for index, (level, response, own) in enumerate(groups):
        name = response.name
        if np.isfinite(level):
            name = f"{name}, {level:.3g} {unit} rms".replace("  ", " ")
        for i, j in np.ndindex(response.response.shape[:2]):
            upper, lower = draw_measured(axes[2 * i, j], axes[2 * i + 1, j], response, i, j, name, units)
            for dots in (*upper, *lower):
                dots.set(color=_GRAYS[index % 3], marker=_MARKERS[index % 3])
            lines[2 * i, j] += upper
            lines[2 * i + 1, j] += lower
        if own is not None:
            look: dict[str, Any] = {
                "color": _GRAYS[index % 3],
                "linestyle": "-",
                "linewidth": 0.8,
                "zorder": 2,
                "label": "refined model on the same input" if index == 0 else "_same",
            }
            _draw(axes, lines, own.omega, own.response, units, look)
