"""Bode plot at several input amplitudes, beside the measured response at the record's levels."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise
from typing import Any

import control as ct
import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy import stats

from ..arguments import as_vector
from ..data.channels import match_channels, record_for
from ..data.frequency_response import FrequencyResponse
from ..data.measurement import Measurement, as_records
from ..engine.amplitude_response import AmplitudeResponse, frequency_response_at
from ..engine.simulation import simulate, structure_of
from ..exceptions import DivergenceError
from ..systems.linear import Array, LinearModel
from ..systems.response import frequency_response
from .bode import bode_grid
from .bode_axes import BodeUnits, bode_rows, broken_phase, draw_measured, magnitude_limits
from .figures import curve_labels, finish, make_axes, picture, settings, style

__all__ = ["hold_factor", "level_bode", "stretches_by_level"]

_BLOCKS = 24  # pieces of a record whose level is looked at
_RATIO = 1.6  # of the levels of two stretches that count as different
_FEWEST = 4  # blocks of a stretch
_POINTS = 90
_MOST = 3  # levels of a record that are drawn
_MARKERS = (".", "x", "+")
_GRAYS = ("0.15", "0.45", "0.65")


def stretches_by_level(data: Measurement) -> list[tuple[float, Measurement]]:
    """Longest stretch of a record at each level of its excitation.

    Parameters
    ----------
    data : Measurement
        Record.

    Returns
    -------
    list of (float, Measurement)
        Root mean square of the inputs about their mean, and the stretch, the lowest level first; the
        whole record where the level does not change.

    Examples
    --------
    >>> w = np.random.default_rng(0).standard_normal(4000)
    >>> w[2000:] *= 5
    >>> data = rco.Measurement(w, w, dt=0.01)
    >>> [(round(level), part.n_samples) for level, part in stretches_by_level(data)]
    [(1, 2000), (5, 2000)]
    """
    n, centered = data.n_samples, data.inputs - data.inputs.mean(axis=1, keepdims=True)
    scale = centered.std(axis=1, keepdims=True)
    relative = np.divide(centered, scale, out=np.zeros_like(centered), where=scale > 0)
    edges = np.linspace(0, n, min(_BLOCKS, max(1, n // 64)) + 1).round().astype(int)
    power = np.array([np.mean(relative[:, a:b] ** 2) for a, b in pairwise(edges)])
    whole = [(_level(data), data)]
    if power.size < 2 * _FEWEST or not (power > 0).all():
        return whole
    height = 0.5 * np.log(power)
    # the step that starts a new stretch is larger than what chance makes of one level
    jumps = np.flatnonzero(np.abs(np.diff(height)) > np.log(_RATIO)) + 1
    bounds = [0, *jumps.tolist(), power.size]
    bounds = [0] + [cut for a, b in pairwise(bounds) for cut in _thirds(height, a, b)]
    found: list[tuple[float, Measurement]] = []
    for a, b in sorted(pairwise(bounds), key=lambda pair: pair[0] - pair[1]):
        if b - a < _FEWEST:
            continue
        stop = float(data.timepts[edges[b]]) if edges[b] < n else None
        part = data.segment(float(data.timepts[edges[a]]), stop)
        level = _level(part)
        if all(max(level, other) / min(level, other) > _RATIO for other, _ in found):
            found.append((level, part))
    return sorted(found[:_MOST], key=lambda pair: pair[0]) if found else whole


def _thirds(height: Array, first: int, last: int) -> list[int]:
    """Ends of the parts of a stretch: three where its level climbs or falls all the way, else one."""
    blocks = last - first
    if blocks < 3 * _FEWEST:
        return [last]
    line = stats.linregress(np.arange(blocks), height[first:last])
    climbs = abs(line.slope) * blocks > 2 * np.log(_RATIO) and line.pvalue < 1e-4
    return [first + blocks // 3, first + 2 * blocks // 3, last] if climbs else [last]


def _level(data: Measurement) -> float:
    """Root mean square of the inputs about their mean."""
    return float(np.sqrt(np.mean(data.inputs.var(axis=1))))


def hold_factor(omega: Array, dt: float, hold: str) -> NDArray[np.complex128]:
    """What a hold makes of a sine's fundamental.

    Parameters
    ----------
    omega : ndarray, shape (n,)
        Frequencies in rad/s.
    dt : float
        Sampling time in s, 0 for none.
    hold : {"zoh", "foh", "bandlimited"}
        How the input runs between samples.

    Returns
    -------
    complex ndarray, shape (n,)
        1 for a band-limited input.

    Examples
    --------
    >>> abs(hold_factor(np.array([1e-9]), 0.1, "zoh"))
    array([1.])
    """
    half = 0.5 * omega * dt
    if hold == "bandlimited" or dt == 0:
        return np.ones(omega.shape, complex)
    size = np.sinc(half / np.pi)
    return size * np.exp(-1j * half) if hold == "zoh" else (size**2).astype(complex)


@picture
def level_bode(
    refinement: Any,
    levels: Sequence[float] | Array,
    measured: Any = None,
    omega: ArrayLike | None = None,
    *,
    ax: Any = None,
    label: str | Sequence[str] | None = None,
    title: str | None = None,
    legend_loc: str | bool | None = None,
    rcParams: dict[str, Any] | None = None,
    show_legend: bool | None = None,
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
    ax : array of Axes, optional
        Axes to draw in, shape (2 n_y, n_w).
    label : str or sequence of str, optional
        Labels of the levels.
    title, legend_loc, rcParams, show_legend
        As in `bode_comparison`.

    Returns
    -------
    ControlPlot
        Lines, axes (magnitude and phase for each output), figure.

    Raises
    ------
    DataError
        If no level is given.
    """
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
    names = curve_labels(label, [f"{peak:.4g} {unit} sine".replace("  ", " ") for peak in peaks])
    with settings(rcParams):
        figure, axes = make_axes(ax, [1.9, 1.4] * linear.n_outputs, linear.n_inputs)
        units = bode_rows(axes, linear.output_labels, linear.input_labels, extra=None)
        lines = np.empty(axes.shape, dtype=object)
        for place in np.ndindex(axes.shape):
            lines[place] = []
        factor = hold_factor(grid, dt, hold)
        base = frequency_response(initial, grid) * factor
        look: dict[str, Any] = {"color": "0.55", "linestyle": (0, (2, 1.5)), "linewidth": 1.3}
        _draw(axes, lines, grid, base, units, look | {"label": "initial model"})
        for j in range(linear.n_inputs):
            found = frequency_response_at(refinement, grid, peaks, source=j)
            for index, name in enumerate(names):
                look = dict(style(index)._asdict(), label=name if j == 0 else f"_{name}", zorder=3)
                curve = _seen(found, index) * factor
                _draw(axes[:, j : j + 1], lines[:, j : j + 1], grid, curve[:, None, :], units, look)
        _draw_groups(axes, lines, groups, units, unit)
        for i, j in np.ndindex(linear.n_outputs, linear.n_inputs):
            magnitude_limits(axes[2 * i, j], lines[2 * i, j], units)
        return finish(
            figure,
            axes,
            lines,
            title=title,
            legends=[axes[0, 0]],
            legend_loc=legend_loc,
            show_legend=show_legend,
        )


def _seen(found: AmplitudeResponse, index: int) -> NDArray[np.complex128]:
    """Response at one level, broken where no stable steady state was found."""
    return np.where(found.stable[index], found.response[index], np.nan)


_Group = tuple[float, FrequencyResponse, FrequencyResponse | None]


def _measured_groups(refinement: Any, linear: LinearModel, measured: Any) -> list[_Group]:
    """Level, measured response, and the model's on the same input, per stretch."""
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
    for level, part in sorted(parts, key=lambda pair: pair[0])[:_MOST]:
        try:
            run = simulate(refinement, part).outputs
        except DivergenceError:
            own = None  # the picture shows the measured dots alone
        else:
            own = _with_outputs(part, run).frequency_response()
        groups.append((level, part.frequency_response(), own))
    return groups


def _with_outputs(data: Measurement, outputs: Array) -> Measurement:
    return Measurement(
        data.inputs,
        outputs,
        dt=data.dt,
        hold=data.hold,
        input_labels=data.input_labels,
        output_labels=data.output_labels,
        name=data.name,
    )


def _grid(model: LinearModel, groups: Sequence[_Group], omega: ArrayLike | None) -> Array:
    """Frequencies for the sines: fewer than for a linear curve, dense near the modes."""
    if omega is not None:
        return np.sort(omega)
    full = bode_grid(model, groups[0][1] if groups else None, None)
    even = np.geomspace(full[0], full[-1], _POINTS)
    roots = np.linalg.eigvals(model.A)
    turning = np.abs(roots[roots.imag > 0])
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
