"""Units, labels and measured points of Bode plots.

The units follow `control.defaults`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import control as ct
import numpy as np
from numpy.typing import NDArray

from ..systems.linear import Array
from .figures import BAND, MEASURED, log_labels, plain

if TYPE_CHECKING:
    from ..data.frequency_response import FrequencyResponse

__all__ = ["BodeUnits", "bode_rows", "broken_phase", "draw_measured", "magnitude_limits"]


@dataclass(frozen=True, slots=True)
class BodeUnits:
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
    def phase_factor(self) -> float:
        """Factor from rad to the unit of the axis."""
        return 180.0 / np.pi if self.deg else 1.0

    def magnitude(self, values: Array) -> Array:
        """Magnitude as drawn; NaN where it is zero, which a logarithm cannot show."""
        shown: Array = np.where(values > 0.0, values, np.nan)
        return 20.0 * np.log10(shown) if self.dB else shown


def bode_rows(axes: Any, outputs: Sequence[str], inputs: Sequence[str], *, extra: str | None) -> BodeUnits:
    """Scale and label the magnitude and phase axes of a Bode plot.

    If `extra` is given, each output has one more row of axes.
    """
    units = BodeUnits.from_defaults()
    per_output = 2 if extra is None else 3
    many = len(outputs) > 1
    half = 180.0 if units.deg else np.pi
    for i, output in enumerate(outputs):
        for j, source in enumerate(inputs):
            magnitude, phase = axes[per_output * i, j], axes[per_output * i + 1, j]
            for axis in axes[per_output * i : per_output * (i + 1), j]:
                axis.set_xscale("log")
                log_labels(axis.xaxis)
                axis.grid(True, which="major", alpha=0.35)
                axis.grid(True, which="minor", alpha=0.12)
                # python-control labels each axes and asks for these attributes when it draws on top
                axis.tick_params(labelbottom=False)
            if not units.dB:
                magnitude.set_yscale("log")
            phase.set_ylim(-1.1 * half, 1.1 * half)
            phase.set_yticks(np.array([-1.0, -0.5, 0.0, 0.5, 1.0]) * half)
            if j == 0:
                of = f"\n{plain(output)}" if many else ""
                magnitude.set_ylabel(f"Magnitude{' [dB]' if units.dB else ''}{of}")
                phase.set_ylabel(f"Phase [{'deg' if units.deg else 'rad'}]{of}")
                if extra is not None:
                    axes[per_output * i + 2, j].set_ylabel(extra.capitalize() + of)
            if i == 0 and (len(inputs) > 1 or many):
                magnitude.set_title(f"from {plain(source)}")
    for axis in axes[-1]:
        axis.tick_params(labelbottom=True)
        axis.set_xlabel(f"Frequency [{units.frequency}]")
    axes[0, 0].figure.align_ylabels(axes[:, 0])
    return units


def draw_measured(
    magnitude: Any,
    phase: Any,
    measured: FrequencyResponse,
    i: int,
    j: int,
    label: str,
    units: BodeUnits,
) -> tuple[list[Any], list[Any]]:
    """Measured points as dots with their band of two standard deviations."""
    x = measured.omega * units.frequency_factor
    size = measured.magnitude[i, j]
    spread = np.zeros(size.shape) if measured.std is None else measured.std[i, j]
    # a band that reaches zero would stretch a logarithmic axis without end
    low = np.maximum(size - 2.0 * spread, 1e-3 * size)
    magnitude.fill_between(
        x, units.magnitude(low), units.magnitude(size + 2.0 * spread), color=BAND, linewidth=0, zorder=1
    )
    dots = {"color": MEASURED, "marker": ".", "markersize": 3.5, "linestyle": "none", "zorder": 2}
    band = " (band: 2 std)" if spread.any() else ""
    upper = magnitude.plot(x, units.magnitude(size), label=label + band, **dots)
    angle, known = measured.phase[i, j], measured.phase_std
    turn = np.zeros(size.shape) if known is None else 2.0 * known[i, j]
    factor = units.phase_factor
    wraps = np.flatnonzero(np.abs(np.diff(angle)) > np.pi) + 1
    broken = np.insert(angle, wraps, np.nan)
    broken_turn = np.insert(turn, wraps, np.nan)
    phase.fill_between(
        np.insert(x, wraps, x[wraps]),
        np.maximum(broken - broken_turn, -np.pi) * factor,
        np.minimum(broken + broken_turn, np.pi) * factor,
        color=BAND,
        linewidth=0,
        zorder=1,
    )
    lower = phase.plot(x, angle * factor, label=label, **dots)
    return upper, lower


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


def magnitude_limits(axis: Any, lines: Sequence[Any], units: BodeUnits) -> None:
    """Set magnitude limits that show the curves.

    The far ends of a band and the bottom of a notch may be cut off.
    """
    values = np.concatenate([np.asarray(line.get_ydata(), dtype=float) for line in lines])
    values = values[np.isfinite(values)] if units.dB else values[np.isfinite(values) & (values > 0)]
    if not values.size:
        return
    if units.dB:
        low, high = max(values.min(), np.median(values) - 100.0), values.max()
        margin = 0.06 * (high - low) + 1.0
        axis.set_ylim(low - margin, high + margin)
    else:
        low, high = max(values.min(), 1e-5 * np.median(values)), values.max()
        margin = max((high / low) ** 0.06, 1.1)
        axis.set_ylim(low / margin, high * margin)
