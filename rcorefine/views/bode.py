"""Bode plots of models and measured responses, at several amplitudes too.

The units follow `control.defaults`.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import control as ct
import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..arguments import as_vector
from ..data.channels import match_channels, record_for
from ..data.frequency_response import FrequencyResponse
from ..data.measurement import Measurement
from ..data.records import MOST_LEVELS, as_records, stretches_by_level
from ..engine.amplitude_response import frequency_response_at
from ..engine.simulation import simulated, structure_of
from ..exceptions import DivergenceError, ModelError
from ..systems.linear import Array, LinearModel
from ..systems.response import as_sampled, frequency_response, hold_factor
from .figures import BAND, MEASURED, Frame, log_labels, look_of, plain

# |noise| of a complex point stays below this many standard deviations of one component, 95 of 100 times
_RAYLEIGH_95 = float(np.sqrt(-2.0 * np.log(0.05)))
_POINTS = 600
_SINES = 90  # frequencies at which a model with nonlinear effects is evaluated
_AROUND = 3.0  # the range of the picture on both sides of the modes
_MARKERS = (".", "x", "+")
_GRAYS = ("0.15", "0.45", "0.65")


class BodeUnits(NamedTuple):
    """Units of a Bode plot, from the `freqplot` defaults of python-control."""

    dB: bool
    deg: bool
    Hz: bool

    @classmethod
    def from_defaults(cls) -> BodeUnits:
        """Read ``freqplot.dB``, ``freqplot.deg`` and ``freqplot.Hz``."""
        return cls(*(bool(ct.defaults[f"freqplot.{key}"]) for key in ("dB", "deg", "Hz")))

    @property
    def frequency_factor(self) -> float:
        """Factor from rad/s to the unit of the axis."""
        return 1.0 / (2.0 * np.pi) if self.Hz else 1.0

    @property
    def frequency(self) -> str:
        """Unit of the axis."""
        return "Hz" if self.Hz else "rad/s"

    @property
    def size(self) -> str:
        """Label of the magnitude axis."""
        return f"Magnitude{' [dB]' if self.dB else ''}"

    @property
    def phase(self) -> str:
        """Label of the phase axis."""
        return f"Phase [{'deg' if self.deg else 'rad'}]"

    @property
    def phase_factor(self) -> float:
        """Factor from rad to the unit of the axis."""
        return 180.0 / np.pi if self.deg else 1.0

    def magnitude(self, values: Array) -> Array:
        """Magnitude as drawn; NaN where it is zero, which a logarithm cannot show."""
        shown: Array = np.where(values > 0.0, values, np.nan)
        return 20.0 * np.log10(shown) if self.dB else shown


class BodeAxes:
    """Axes of a Bode plot: magnitude and phase, and one more row on request.

    Parameters
    ----------
    axes, lines : ndarray of shape (rows, n_w)
        Axes, and a list for the lines in each, with 2 or 3 rows per output.
    outputs, inputs : sequence of str
        Names of the channels.
    extra : str, optional
        What the third row of each output shows.
    """

    def __init__(
        self, axes: Any, lines: Any, outputs: Sequence[str], inputs: Sequence[str], extra: str | None = None
    ) -> None:
        self.axes, self.lines, self.units = axes, lines, BodeUnits.from_defaults()
        self.rows = 2 if extra is None else 3
        many, half = len(outputs) > 1, 180.0 if self.units.deg else np.pi
        for i, j in np.ndindex(len(outputs), len(inputs)):
            block = axes[self.rows * i : self.rows * (i + 1), j]
            for axis in block:
                axis.set_xscale("log")
                log_labels(axis.xaxis)
                # python-control labels each axes and asks for these attributes when it draws on top
                axis.tick_params(labelbottom=False)
            if not self.units.dB:
                block[0].set_yscale("log")
            block[1].set(ylim=(-1.1 * half, 1.1 * half), yticks=np.linspace(-half, half, 5))
            if j == 0:
                of = f"\n{plain(outputs[i])}" if many else ""
                texts = (self.units.size, self.units.phase, str(extra).capitalize())
                for axis, text in zip(block, texts, strict=False):
                    axis.set_ylabel(text + of)
            if i == 0 and (len(inputs) > 1 or many):
                block[0].set_title(f"from {plain(inputs[j])}")
        for axis in axes[-1]:
            axis.tick_params(labelbottom=True)
            axis.set_xlabel(f"Frequency [{self.units.frequency}]")
        axes[0, 0].figure.align_ylabels(axes[:, 0])

    def curves(self, omega: Array, response: Any, look: Any, column: int = 0) -> None:
        """Draw responses of shape (n_y, n_w, n_omega) as lines.

        The first is in the given column of axes.
        """
        for i, j in np.ndindex(response.shape[:2]):
            at = self.rows * i, column + j
            size = self.units.magnitude(np.abs(response[i, j]))
            self.lines[at] += self.axes[at].plot(omega * self.units.frequency_factor, size, **look)
            below = at[0] + 1, at[1]
            x, angle = broken_phase(omega, response[i, j])
            x, angle = x * self.units.frequency_factor, angle * self.units.phase_factor
            self.lines[below] += self.axes[below].plot(x, angle, **look)

    def measured(self, measured: FrequencyResponse, label: str, **changed: Any) -> None:
        """Draw measured points as dots, with bands of two standard deviations."""
        units, omega = self.units, measured.omega
        x = omega * units.frequency_factor
        look = {
            "color": MEASURED,
            "marker": ".",
            "markersize": 3.5,
            "linestyle": "none",
            "zorder": 2,
        } | changed
        for i, j in np.ndindex(measured.response.shape[:2]):
            upper, lower = self.rows * i, self.rows * i + 1
            size, angle = measured.magnitude[i, j], measured.phase[i, j]
            spread = np.zeros(size.shape) if measured.std is None else measured.std[i, j]
            turn = np.zeros(size.shape) if measured.phase_std is None else 2.0 * measured.phase_std[i, j]
            band: dict[str, Any] = {"color": BAND, "linewidth": 0, "zorder": 1}
            _band(self.axes[upper, j], x, size, 2.0 * spread, units, band)
            wraps = np.flatnonzero(np.abs(np.diff(angle)) > np.pi) + 1
            broken, wide = np.insert(angle, wraps, np.nan), np.insert(turn, wraps, np.nan)
            low, high = np.maximum(broken - wide, -np.pi), np.minimum(broken + wide, np.pi)
            low, high = low * units.phase_factor, high * units.phase_factor
            self.axes[lower, j].fill_between(np.insert(x, wraps, x[wraps]), low, high, **band)
            text = f"{label} (band: 2 std)" if spread.any() else label
            self.lines[upper, j] += self.axes[upper, j].plot(x, units.magnitude(size), label=text, **look)
            self.lines[lower, j] += self.axes[lower, j].plot(
                x, angle * units.phase_factor, label=label, **look
            )

    def limits(self) -> None:
        """Set magnitude limits that show the curves.

        The far ends of a band and the bottom of a notch may be cut off.
        """
        for i, j in np.ndindex(len(self.axes) // self.rows, self.axes.shape[1]):
            axis, drawn = self.axes[self.rows * i, j], self.lines[self.rows * i, j]
            values = np.concatenate([np.asarray(line.get_ydata(), dtype=float) for line in drawn])
            values = values[np.isfinite(values) & (self.units.dB | (values > 0))]
            if not values.size:
                continue
            low, high = values.min(), values.max()
            if self.units.dB:
                low = max(low, np.median(values) - 100.0)
                margin = 0.06 * (high - low) + 1.0
                axis.set_ylim(low - margin, high + margin)
            else:
                low = max(low, 1e-5 * np.median(values))
                margin = max((high / low) ** 0.06, 1.1)
                axis.set_ylim(low / margin, high * margin)


def _band(axis: Any, x: Array, size: Array, spread: Array, units: BodeUnits, look: dict[str, Any]) -> None:
    """Fill a band about a magnitude.

    A band that reaches zero would stretch a logarithmic axis without end.
    """
    low = units.magnitude(np.maximum(size - spread, 1e-3 * size))
    axis.fill_between(x, low, units.magnitude(size + spread), **look)


def broken_phase(omega: Array, response: NDArray[np.complex128]) -> tuple[Array, Array]:
    """Phase within +-pi, the line broken where it wraps.

    Parameters
    ----------
    omega : ndarray of shape (n,)
        Frequencies in rad/s.
    response : complex ndarray of shape (n,)
        Response at them.

    Returns
    -------
    omega, phase : ndarray of shape (m,)
        With a NaN between two points more than pi apart.
    """
    angle = np.angle(response)
    wraps = np.flatnonzero(np.abs(np.diff(angle)) > np.pi) + 1
    return np.insert(omega, wraps, omega[wraps]), np.insert(angle, wraps, np.nan)


def bode(
    systems: Sequence[tuple[str, ct.StateSpace | LinearModel]],
    measured: FrequencyResponse | Measurement | ct.FrequencyResponseData | None,
    omega: ArrayLike | None,
    frame: Frame,
    deviation: Callable[[Array], Array] | None = None,
    title: str | None = None,
) -> ct.ControlPlot:
    """Draw a Bode plot of systems, beside a measured response if given.

    Parameters
    ----------
    systems : sequence of (str, StateSpace)
        Label and system; all with the same numbers of inputs and outputs.
    measured : FrequencyResponse, Measurement or FrequencyResponseData, optional
        Measured response (of unknown uncertainty in the last case), drawn as dots with a band of two standard
        deviations; adds a row with the relative error abs(G/G_measured - 1)
        of each system. Continuous systems are then drawn as the record sees
        them: sampled with its dt and hold.
    omega : array_like of shape (n_omega,), optional
        Frequencies in rad/s. Default: the measured band, or a decade around
        the poles and zeros.
    frame : Frame
        Axes, labels and settings.
    deviation : callable, optional
        Standard deviation of the last system's response, shape (n_y, n_w, K), at frequencies of
        shape (K,): drawn as a band of two of them about its curve.
    title : str, optional
        Title of the figure.

    Returns
    -------
    ControlPlot
        Lines, axes, figure. Units follow ``control.defaults`` (``freqplot.dB``,
        ``freqplot.deg``, ``freqplot.Hz``); the phase is wrapped to +-180 deg.

    Raises
    ------
    control.ControlDimension
        If systems and measured response differ in size.
    """
    models = [m if isinstance(m, LinearModel) else LinearModel.from_statespace(m) for _, m in systems]
    texts = [str(text) for text, _ in systems]
    measured = as_response(measured)
    outputs, inputs = _channels(texts, models, measured)
    points = None if omega is None else as_vector(omega, "omega", above=0.0)
    names, rows = frame.labels(texts), 2 if measured is None else 3
    if measured is not None:  # a model beside a record is seen with its sampling and hold
        models = [as_sampled(model, measured.dt, measured.hold) for model in models]
    with frame.axes([1.8, 1.4, 1.2][:rows] * len(outputs), len(inputs)) as (axes, lines):
        drawn = BodeAxes(axes, lines, outputs, inputs, "error" if rows == 3 else None)
        for index, (name, model) in enumerate(zip(names, models, strict=True)):
            grid, last = bode_grid(model, measured, points), index == len(models) - 1
            spread = deviation(grid) if deviation is not None and last else None
            _draw_model(drawn, model, grid, look_of(index, name), spread)
            if measured is not None:
                _draw_error(drawn, model, measured, look_of(index, f"_{name}"))
        if measured is not None:
            drawn.measured(measured, measured.name)
            _scale_error(drawn, measured)
        drawn.limits()
        return frame.finish(axes, lines, title, axes[[0, 2][: rows - 1], 0])


def as_response(measured: Any) -> FrequencyResponse | None:
    """Return what was measured as a frequency response; None stays."""
    if measured is None or isinstance(measured, FrequencyResponse):
        return measured
    if isinstance(measured, Measurement):
        return measured.frequency_response()
    return FrequencyResponse.from_frd(measured)


def bode_grid(model: LinearModel, measured: FrequencyResponse | None, omega: Array | None) -> Array:
    """Return the frequencies in rad/s at which to draw a model.

    The grid is dense around the lightly damped modes.
    """
    if omega is not None:
        return omega
    roots = np.linalg.eigvals(model.A) if model.n_states else np.zeros(0)
    if not model.is_continuous and model.dt is not None:
        with np.errstate(divide="ignore", invalid="ignore"):
            roots = np.log(roots.astype(complex)) / float(model.dt)
    sizes = np.abs(roots[np.isfinite(roots)])
    sizes = sizes[sizes > 1e-9 * max(1.0, sizes.max(initial=0.0))]
    if measured is not None:
        low, high = float(measured.omega[0]), float(measured.omega[-1])
    else:
        low = 0.1 * sizes.min(initial=np.inf) if sizes.size else 0.1
        high = 10.0 * sizes.max(initial=0.0) if sizes.size else 10.0
        if not model.is_continuous and model.dt is not None:
            high = np.pi / float(model.dt)
            low = min(low, 1e-2 * high)
    grid = np.geomspace(low, max(high, low * 1.0001), _POINTS)
    turning = roots[np.isfinite(roots) & (roots.imag > 0)]
    around = [abs(r.imag) + max(abs(r.real), 1e-6 * abs(r)) * np.linspace(-4, 4, 41) for r in turning[:100]]
    extra = np.concatenate([np.zeros(0), *around])
    return np.unique(np.concatenate([grid, extra[(extra > low) & (extra < high)]]))


def _channels(
    texts: Sequence[str], models: Sequence[LinearModel], measured: FrequencyResponse | None
) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """Return the outputs and inputs that all curves have."""
    if not models and measured is None:
        raise ModelError("nothing to draw: give at least one (label, system) or a measured response")
    first = models[0] if measured is None else measured
    outputs, inputs = tuple(first.output_labels), tuple(first.input_labels)
    for text, model in zip(texts, models, strict=True):
        if (model.n_outputs, model.n_inputs) != (len(outputs), len(inputs)):
            raise ct.ControlDimension(
                f"system {text!r} has {model.n_outputs} outputs and {model.n_inputs} inputs, "
                f"the others {len(outputs)} and {len(inputs)}"
            )
    return outputs, inputs


def _draw_model(
    drawn: BodeAxes, model: LinearModel, grid: Array, look: dict[str, Any], deviation: Array | None
) -> None:
    """Draw the curves of a model, in a band of two standard deviations."""
    if not model.is_continuous and model.dt is not None:
        kept = grid <= np.pi / float(model.dt) * (1.0 + 1e-9)
        grid, deviation = grid[kept], None if deviation is None else deviation[:, :, kept]
    response, units = frequency_response(model, grid), drawn.units
    drawn.curves(grid, np.where(np.isfinite(response), response, np.nan), look)
    if deviation is None:
        return
    x = grid * units.frequency_factor
    band: dict[str, Any] = {"color": look["color"], "alpha": 0.25, "linewidth": 0, "zorder": 2}
    for i, j in np.ndindex(response.shape[:2]):
        size, angle, spread = np.abs(response[i, j]), np.angle(response[i, j]), 2.0 * deviation[i, j]
        _band(drawn.axes[drawn.rows * i, j], x, size, spread, units, band)
        with np.errstate(divide="ignore", invalid="ignore"):
            turn = np.arcsin(np.minimum(spread / size, 1.0))
        whole = np.abs(np.gradient(np.unwrap(angle) - angle)) < 1e-6  # not where it wraps
        low = np.maximum(angle - turn, -np.pi) * units.phase_factor
        high = np.minimum(angle + turn, np.pi) * units.phase_factor
        drawn.axes[drawn.rows * i + 1, j].fill_between(x, low, high, where=whole, **band)


def _draw_error(
    drawn: BodeAxes, model: LinearModel, measured: FrequencyResponse, look: dict[str, Any]
) -> None:
    """Draw the relative error of a model at the measured points."""
    with np.errstate(divide="ignore", invalid="ignore"):
        error = np.abs(frequency_response(model, measured.omega) / measured.response - 1.0)
    error[~np.isfinite(error)] = np.nan
    for i, j in np.ndindex(error.shape[:2]):
        at = 3 * i + 2, j
        drawn.lines[at] += drawn.axes[at].plot(
            measured.omega * drawn.units.frequency_factor, error[i, j], **look
        )


def _scale_error(drawn: BodeAxes, measured: FrequencyResponse) -> None:
    """Scale the axes of the errors, and shade what noise alone causes."""
    for i, j in np.ndindex(measured.response.shape[:2]):
        axis, curves = drawn.axes[3 * i + 2, j], drawn.lines[3 * i + 2, j]
        size = measured.magnitude[i, j]
        spread = np.zeros(size.shape) if measured.std is None else measured.std[i, j]
        noise = _RAYLEIGH_95 * np.divide(spread, size, out=np.full_like(size, np.nan), where=size > 0)
        axis.set_yscale("log")
        log_labels(axis.yaxis)
        values = np.concatenate([np.zeros(0), *(np.asarray(line.get_ydata()) for line in curves)])
        values = values[np.isfinite(values) & (values > 0)]
        usual = noise[np.isfinite(noise) & (noise > 0)]
        low = min(np.quantile(values, 0.02, method="nearest") if values.size else 1e-2, 1e-1)
        low = max(min(low, 0.5 * float(np.median(usual))) if usual.size else low, 1e-6)
        axis.set_ylim(low, max(2.0, min(100.0, 2.0 * float(values.max(initial=1.0)))))
        axis.set_ylabel("Error |G/G$_{meas}$ - 1|" if len(drawn.axes) == 3 else "|G/G$_{meas}$ - 1|")
        if usual.size:
            x = measured.omega * drawn.units.frequency_factor
            axis.fill_between(
                x, low * 1e-3, noise, label="noise only (95 %)", color=BAND, linewidth=0, zorder=1
            )  # fmt: skip


def level_bode(
    refinement: Any,
    levels: Sequence[float] | Array,
    measured: Any,
    omega: ArrayLike | None,
    frame: Frame,
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
    frame : Frame
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
        drawn = BodeAxes(axes, lines, linear.output_labels, linear.input_labels)
        base = frequency_response(initial, grid) * hold_factor(grid, dt, hold)
        dashes = {"color": "0.55", "linestyle": (0, (2, 1.5)), "linewidth": 1.3, "label": "initial model"}
        drawn.curves(grid, base, dashes)
        for j in range(linear.n_inputs):
            found = frequency_response_at(refinement, grid, peaks, source=j)
            if omega is None:  # with the peaks, which lie between
                with_peaks = np.union1d(grid, found.peak_omega[found.peak_omega > 0])
                found = frequency_response_at(refinement, with_peaks, peaks, source=j)
            seen = np.where(found.stable[:, None], found.response, np.nan)  # broken where none is stable
            seen = seen * hold_factor(found.omega, dt, hold)
            for index, name in enumerate(names):
                look = look_of(index, name if j == 0 else f"_{name}")
                drawn.curves(found.omega, seen[index, :, None], look, j)
        for index, (level, response, own) in enumerate(groups):
            name = response.name
            if np.isfinite(level):
                name = f"{name}, {level:.3g} {unit} rms".replace("  ", " ")
            gray = _GRAYS[index % 3]
            drawn.measured(response, name, color=gray, marker=_MARKERS[index % 3])
            if own is not None:  # a thin line for the model on the same input
                text = "refined model on the same input" if index == 0 else "_same"
                look = {"color": gray, "linestyle": "-", "linewidth": 0.8, "zorder": 2, "label": text}
                drawn.curves(own.omega, own.response, look)
        drawn.limits()
        return frame.finish(axes, lines)


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
    for level, part in sorted(parts, key=lambda pair: pair[0])[:MOST_LEVELS]:
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
    even = np.geomspace(full[0], full[-1], _SINES)
    near = [w * np.linspace(0.75, 1.35, 31) for w in turning[:6]]
    both = np.unique(np.concatenate([even, *near]))
    inside: Array = both[(both >= full[0]) & (both <= full[-1])]
    return inside
