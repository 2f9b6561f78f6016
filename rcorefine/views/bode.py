"""Bode plots of several systems, a measured response and their errors."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, Unpack

import control as ct
import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..arguments import as_vector
from ..data.frequency_response import FrequencyResponse
from ..data.measurement import Measurement
from ..exceptions import ModelError
from ..results import Options, picture
from ..systems.linear import Array, LinearModel
from ..systems.response import as_sampled, frequency_response
from .bode_axes import BodeUnits, bode_rows, broken_phase, draw_measured, magnitude_limits
from .figures import BAND, Frame, log_labels, style

__all__ = ["bode", "bode_comparison", "bode_grid"]

# |noise| of a complex point stays below this many standard deviations of one component, 95 of 100 times
_RAYLEIGH_95 = float(np.sqrt(-2.0 * np.log(0.05)))
_POINTS = 600


@picture
def bode_comparison(
    systems: Sequence[tuple[str, ct.StateSpace | LinearModel]],
    measured: FrequencyResponse | Measurement | ct.FrequencyResponseData | None = None,
    omega: ArrayLike | None = None,
    *,
    deviation: Callable[[Array], Array] | None = None,
    **options: Unpack[Options],
) -> ct.ControlPlot:
    """Bode plot of systems, beside a measured response where there is one.

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
    deviation : callable, optional
        Standard deviation of the last system's response, shape (n_y, n_w, K), at frequencies of
        shape (K,): drawn as a band of two of them about its curve.
    ax : array of Axes, optional
        Axes to draw in, shape (2 n_y, n_w), with `measured` (3 n_y, n_w).
    label : str or sequence of str, optional
        Labels in place of those in `systems`.

    Returns
    -------
    ControlPlot
        Lines, axes, figure. Units follow ``control.defaults`` (``freqplot.dB``,
        ``freqplot.deg``, ``freqplot.Hz``); the phase is wrapped to +-180 deg.

    Raises
    ------
    control.ControlDimension
        If systems and measured response differ in size.

    Examples
    --------
    >>> first, second = ct.ss(ct.tf(1, [1, 0.1, 1])), ct.ss(ct.tf(1, [1, 0.3, 1]))
    >>> cplt = bode_comparison([("initial", first), ("refined", second)])
    >>> cplt.axes.shape
    (2, 1)
    """
    return bode(systems, measured, omega, Frame(**options), deviation)


def bode(
    systems: Sequence[tuple[str, ct.StateSpace | LinearModel]],
    measured: FrequencyResponse | Measurement | ct.FrequencyResponseData | None,
    omega: ArrayLike | None,
    frame: Frame,
    deviation: Callable[[Array], Array] | None = None,
    title: str | None = None,
) -> ct.ControlPlot:
    """`bode_comparison` in a frame, with a title of its own."""
    models = [
        (str(text), m if isinstance(m, LinearModel) else LinearModel.from_statespace(m))
        for text, m in systems
    ]
    seen_as = _as_measured(measured)
    outputs, inputs = _channels(models, seen_as)
    points = None if omega is None else as_vector(omega, "omega", above=0.0)
    names = frame.labels([text for text, _ in models])
    ratios = [1.8, 1.4] if seen_as is None else [1.8, 1.4, 1.2]
    with frame.axes(ratios * len(outputs), len(inputs)) as (axes, lines):
        units = bode_rows(axes, outputs, inputs, extra=None if seen_as is None else "error")
        for index, (name, (_, model)) in enumerate(zip(names, models, strict=True)):
            seen = model if seen_as is None else as_sampled(model, seen_as.dt, seen_as.hold)
            grid = bode_grid(seen, seen_as, points)
            _draw_model(axes, lines, seen, grid, name, index, units, seen_as)
            if deviation is not None and index == len(models) - 1:
                _draw_band(axes, seen, grid, deviation(grid), index, units, len(ratios))
        if seen_as is not None:
            _draw_measured(axes, lines, seen_as, units)
        for i, j in np.ndindex(len(outputs), len(inputs)):
            magnitude_limits(axes[len(ratios) * i, j], lines[len(ratios) * i, j], units)
        return frame.finish(axes, lines, axes[[0] if seen_as is None else [0, 2], 0], title)


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


def _as_measured(measured: Any) -> FrequencyResponse | None:
    if measured is None or isinstance(measured, FrequencyResponse):
        return measured
    return (
        measured.frequency_response()
        if isinstance(measured, Measurement)
        else FrequencyResponse.from_frd(measured)
    )


def _channels(
    models: Sequence[tuple[str, LinearModel]], measured: FrequencyResponse | None
) -> tuple[tuple[str, ...], tuple[str, ...]]:
    if not models and measured is None:
        raise ModelError("nothing to draw: give at least one (label, system) or a measured response")
    if measured is not None:
        outputs, inputs = measured.output_labels, measured.input_labels
    else:
        outputs, inputs = models[0][1].output_labels, models[0][1].input_labels
    for text, model in models:
        if (model.n_outputs, model.n_inputs) != (len(outputs), len(inputs)):
            raise ct.ControlDimension(
                f"system {text!r} has {model.n_outputs} outputs and {model.n_inputs} inputs, "
                f"the others {len(outputs)} and {len(inputs)}"
            )
    return outputs, inputs


def _draw_model(
    axes: Any,
    lines: Any,
    model: LinearModel,
    grid: Array,
    name: str,
    index: int,
    units: BodeUnits,
    measured: FrequencyResponse | None,
) -> None:
    if not model.is_continuous and model.dt is not None:
        grid = grid[grid <= np.pi / float(model.dt) * (1.0 + 1e-9)]
    response = frequency_response(model, grid)
    look: dict[str, Any] = dict(style(index)._asdict(), label=name, zorder=3)
    per_output = 2 if measured is None else 3
    factor = units.frequency_factor
    for i, j in np.ndindex(response.shape[:2]):
        top = per_output * i
        curve = _finite(response[i, j])
        lines[top, j] += axes[top, j].plot(grid * factor, units.magnitude(np.abs(curve)), **look)
        x, angle = broken_phase(grid, curve)
        lines[top + 1, j] += axes[top + 1, j].plot(x * factor, angle * units.phase_factor, **look)
    if measured is not None:
        at_points = frequency_response(model, measured.omega)
        with np.errstate(divide="ignore", invalid="ignore"):
            error = np.abs(at_points / measured.response - 1.0)
        for i, j in np.ndindex(error.shape[:2]):
            row = per_output * i + 2
            lines[row, j] += axes[row, j].plot(
                measured.omega * factor, _finite(error[i, j]), **(look | {"label": f"_{name}"})
            )


def _draw_band(
    axes: Any,
    model: LinearModel,
    grid: Array,
    deviation: Array,
    index: int,
    units: BodeUnits,
    per_output: int,
) -> None:
    """Band of two standard deviations about the curve of a model."""
    if not model.is_continuous and model.dt is not None:
        kept = grid <= np.pi / float(model.dt) * (1.0 + 1e-9)
        grid, deviation = grid[kept], deviation[:, :, kept]
    response = frequency_response(model, grid)
    x = grid * units.frequency_factor
    look: dict[str, Any] = {"color": style(index).color, "alpha": 0.25, "linewidth": 0, "zorder": 2}
    for i, j in np.ndindex(response.shape[:2]):
        size, spread = np.abs(response[i, j]), 2.0 * deviation[i, j]
        low = np.maximum(size - spread, 1e-3 * size)
        axes[per_output * i, j].fill_between(x, units.magnitude(low), units.magnitude(size + spread), **look)
        with np.errstate(divide="ignore", invalid="ignore"):
            turn = np.arcsin(np.minimum(spread / size, 1.0))
        angle = np.angle(response[i, j])
        whole = np.abs(np.gradient(np.unwrap(angle) - angle)) < 1e-6  # not where it wraps
        axes[per_output * i + 1, j].fill_between(
            x, np.maximum(angle - turn, -np.pi) * units.phase_factor,
            np.minimum(angle + turn, np.pi) * units.phase_factor, where=whole, **look,
        )  # fmt: skip


def _draw_measured(axes: Any, lines: Any, measured: FrequencyResponse, units: BodeUnits) -> None:
    x = measured.omega * units.frequency_factor
    name = measured.name
    for i, j in np.ndindex(measured.response.shape[:2]):
        magnitude, phase, error = axes[3 * i : 3 * i + 3, j]
        upper, lower = draw_measured(magnitude, phase, measured, i, j, name, units)
        lines[3 * i, j] += upper
        lines[3 * i + 1, j] += lower
        size = measured.magnitude[i, j]
        spread = np.zeros(size.shape) if measured.std is None else measured.std[i, j]
        noise = _RAYLEIGH_95 * np.divide(spread, size, out=np.full_like(size, np.nan), where=size > 0)
        error.set_yscale("log")
        log_labels(error.yaxis)
        drawn = np.concatenate([np.zeros(0), *(np.asarray(line.get_ydata()) for line in lines[3 * i + 2, j])])
        drawn = drawn[np.isfinite(drawn) & (drawn > 0)]
        usual = noise[np.isfinite(noise) & (noise > 0)]
        low = min(np.quantile(drawn, 0.02, method="nearest") if drawn.size else 1e-2, 1e-1)
        if usual.size:
            low = min(low, 0.5 * float(np.median(usual)))
        low = max(low, 1e-6)
        error.set_ylim(low, max(2.0, min(100.0, 2.0 * float(drawn.max(initial=1.0)))))
        error.set_ylabel("Error |G/G$_{meas}$ - 1|" if len(axes) == 3 else "|G/G$_{meas}$ - 1|")
        if not usual.size:
            continue
        error.fill_between(x, low * 1e-3, noise, color=BAND, linewidth=0, zorder=1, label="noise only (95 %)")


def _finite(values: NDArray[Any]) -> NDArray[Any]:
    return np.where(np.isfinite(values), values, np.nan)
