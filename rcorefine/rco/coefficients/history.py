"""What a refiner with physical effects did, sample by sample."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import control as ct
import numpy as np

from ...systems.linear import Array

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
        """Plot the error of the physical stage over time, and its coefficients.

        Parameters
        ----------
        ax : array of Axes, optional
            Axes to draw in, shape (n_y + 1, 1).
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
        from ...reporting.figures import curve_labels, finish, make_axes, settings, style, unit_text

        names = curve_labels(list(label) if isinstance(label, tuple) else label, list(self.names))
        n_y = self.z2.shape[0]
        with settings(rcParams):
            figure, axes = make_axes(ax, [1.6] * n_y + [2.0], 1)
            lines = np.empty(axes.shape, dtype=object)
            for row, output in enumerate(self.output_labels):
                axis = axes[row, 0]
                lines[row, 0] = axis.plot(
                    self.timepts, self.z2[row], color=style(1).color, linestyle="-", linewidth=0.8
                )
                axis.set_ylabel(unit_text(f"predicted - measured\n{output}", ""))
                axis.grid(True, alpha=0.35)
            axis = axes[n_y, 0]
            lines[n_y, 0] = axis.plot(self.timepts, self.coefficients.T, linewidth=1.0)
            for line, text in zip(lines[n_y, 0], names, strict=True):
                line.set_label(unit_text(text, ""))
            axis.set_ylabel("coefficients")
            axis.set_xlabel("Time [s]")
            axis.grid(True, alpha=0.35)
            return finish(
                figure,
                axes,
                lines,
                title=title,
                legends=[axis],
                legend_loc=legend_loc,
                show_legend=show_legend,
            )
