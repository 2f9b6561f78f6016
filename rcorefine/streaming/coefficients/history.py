"""History of a refiner with physical effects, sample by sample."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Unpack

import control as ct
import numpy as np
from numpy.typing import NDArray

from ...results import Options, picture, show
from ...systems.linear import Array

__all__ = ["CoefficientHistory"]


@dataclass(frozen=True, slots=True, eq=False)
class CoefficientHistory:
    """History of both stages with physical effects.

    Values are in the units of the signals.

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

    @picture
    def plot(self, **options: Unpack[Options]) -> ct.ControlPlot:
        """Plot the performance of both stages, coefficients and refined poles.

        The horizontal axis is time.

        Parameters
        ----------
        ax : array of Axes, optional
            Axes to draw in, shape (n_y + 2, 1).
        label : list of str, optional
            Labels of the coefficients.

        Returns
        -------
        ControlPlot
            Lines, axes, figure.
        """
        return show(self, "plot", **options)
