"""What a refiner with physical effects did, sample by sample."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import control as ct
import numpy as np
from numpy.typing import NDArray

from ...systems.linear import Array
from ..rcmr.history import draw_poles

__all__ = ["CoefficientHistory"]


@dataclass(frozen=True, slots=True, eq=False)
class CoefficientHistory:
    """Course of both stages with physical effects, in the units of the signals.

    Attributes
    ----------
    timepts : ndarray of shape (N,)
        Times in s.
    coefficients : ndarray of shape (p, N)
        Coefficients after each sample, in the order of `parameters`.
    z1, z2 : ndarray of shape (n_y, N)
        Simulated minus measured output of stage 1 (NaN where it does not run), and
        of the physical stage, one sample ahead (NaN in gaps and while samples are held back).
    x_D : ndarray of shape (n, N)
        States of stage 1, NaN where it does not run.
    x : ndarray of shape (n + extra, N)
        States of the physical stage.
    y : ndarray of shape (n_y, N)
        Measured outputs, NaN in gaps.
    names : tuple of str
        Names of the coefficients.
    pole_timepts : ndarray of shape (K,)
        Times in s, up to 200 of them, at which the poles are given.
    poles : complex ndarray of shape (n, K)
        Poles of the refined model in rad/s (of a discrete one log(z) / dt) at these times.
    output_labels : tuple of str
        Names of the outputs.
    """

    timepts: Array
    coefficients: Array
    z1: Array
    z2: Array
    x_D: Array
    x: Array
    y: Array
    names: tuple[str, ...]
    pole_timepts: Array
    poles: NDArray[np.complex128]
    output_labels: tuple[str, ...]

    @property
    def n_samples(self) -> int:
        """Number of samples taken."""
        return int(self.timepts.size)

    def plot(
        self,
        *,
        ax: Any = None,
        label: str | Sequence[str] | None = None,
        title: str | None = None,
        legend_loc: str | bool | None = None,
        rcParams: dict[str, Any] | None = None,
        show_legend: bool | None = None,
    ) -> ct.ControlPlot:
        """Plot the performance of both stages over time, the coefficients and the refined poles.

        Parameters
        ----------
        ax : array of Axes, optional
            Axes to draw in, shape (n_y + 2, 1).
        label : list of str, optional
            Labels of the coefficients.
        title : str, optional
            Title of the figure.
        legend_loc : str or False, optional
            Place of the legend, as in matplotlib; False for none.
        rcParams : dict, optional
            Matplotlib settings on top of `control.rcParams`.
        show_legend : bool, optional
            Force the legend on or off.

        Returns
        -------
        ControlPlot
            Lines, axes, figure.
        """
        from ...views.figures import curve_labels, finish, make_axes, settings, style, unit_text

        names = curve_labels(list(label) if isinstance(label, tuple) else label, list(self.names))
        n_y = self.z2.shape[0]
        with settings(rcParams):
            figure, axes = make_axes(ax, [1.6] * n_y + [2.0, 1.6], 1)
            lines = np.empty(axes.shape, dtype=object)
            for row, output in enumerate(self.output_labels):
                axis = axes[row, 0]
                lines[row, 0] = []
                for index, z, text in (
                    (0, self.z1, "stage 1"),
                    (1, self.z2, "static stage, one sample ahead"),
                ):
                    if np.isfinite(z[row]).any():
                        look = {"color": style(index).color, "linewidth": 0.8, "label": text}
                        lines[row, 0] += axis.plot(self.timepts, z[row], **look)
                usual = np.nanmax(
                    np.abs(self.z2[row]), initial=0.0
                )  # a stage 1 that diverged must not hide the rest
                if usual > 0:
                    axis.set_ylim(-1.1 * usual, 1.1 * usual)
                axis.set_ylabel(unit_text(f"predicted - measured\n{output}", ""))
                axis.grid(True, alpha=0.35)
            axis = axes[n_y, 0]
            size = np.nanmax(np.abs(self.coefficients), axis=1, initial=0.0)[:, None]
            shown = self.coefficients / np.where(size > 0, size, 1.0)
            lines[n_y, 0] = axis.plot(self.timepts, shown.T, linewidth=1.0)
            for line, text in zip(lines[n_y, 0], names, strict=True):
                line.set_label(unit_text(text, ""))
            axis.set_ylabel("coefficients\nover their largest")
            axis.grid(True, alpha=0.35)
            lines[n_y + 1, 0] = draw_poles(axes[n_y + 1, 0], self.pole_timepts, self.poles)
            return finish(
                figure,
                axes,
                lines,
                title=title,
                legends=[axes[0, 0], axis],
                legend_loc=legend_loc,
                show_legend=show_legend,
            )
