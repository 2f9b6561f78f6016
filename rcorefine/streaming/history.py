"""Course of a refiner sample by sample, and what its summary consists of."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Unpack

import control as ct
import numpy as np
from scipy.optimize import linear_sum_assignment

from ..results import Options, picture, show
from ..systems.linear import Array, LinearModel
from .samples import Complex, Integers

#: Headings of the table of parameters.
PARAMETERS = ["parameter", "effect", "place", "initial", "value", "std", "unit"]
_POINTS = 200  # at which poles are given over time


@dataclass(frozen=True, slots=True, eq=False)
class History:
    """Course of both stages, in the units of the signals.

    Attributes
    ----------
    timepts : ndarray of shape (N,)
        Times in s (sample numbers where the model has no definite dt).
    z1 : ndarray of shape (n_y, N)
        Performance of stage 1, simulated minus measured output.
    z2 : ndarray of shape (n_y, N)
        Performance of stage 2: output predicted from the estimated states
        minus measured output.
    theta1, theta2 : ndarray of shape (l_u, l_psi, N)
        Coefficients of the stages after each sample.
    x : ndarray of shape (n, N)
        Estimated states.
    y : ndarray of shape (n_y, N)
        Measured outputs that were learned from.
    input_labels, output_labels, state_labels : tuple of str
        Names of the signals.
    pole_timepts : ndarray of shape (K,)
        Times in s, up to 200 of them, at which the poles are given.
    poles : complex ndarray of shape (n, K)
        Complex of the refined model in rad/s (of a discrete one log(z) / dt) at these times.
    """

    timepts: Array
    z1: Array
    z2: Array
    theta1: Array
    theta2: Array
    x: Array
    y: Array
    input_labels: tuple[str, ...]
    output_labels: tuple[str, ...]
    state_labels: tuple[str, ...]
    pole_timepts: Array = field(default_factory=lambda: np.zeros(0))
    poles: Complex = field(default_factory=lambda: np.zeros((0, 0), complex))

    @property
    def n_samples(self) -> int:
        """Number of samples learned."""
        return int(self.timepts.size)

    def performance(self, start: int = 0, stop: int | None = None) -> tuple[Array, Array]:
        """Rms of z1 and z2 over rms of y on a stretch, each of shape (n_y,).

        Parameters
        ----------
        start, stop : int, optional
            Samples of the stretch, as in a slice; default all.

        Returns
        -------
        first, second : ndarray of shape (n_y,)
            Performance of stage 1 and of stage 2; NaN where the stretch is
            empty or the output is zero.
        """
        part = slice(start, stop)
        if self.timepts[part].size == 0:
            none = np.full(self.y.shape[0], np.nan)
            return none, none.copy()
        # relative to the rms of the measured output; an output that is zero has no ratio
        size = np.sqrt(np.mean(self.y[:, part] ** 2, axis=1))
        size[size == 0.0] = np.nan
        first, second = (np.sqrt(np.mean(z[:, part] ** 2, axis=1)) / size for z in (self.z1, self.z2))
        return first, second

    @picture
    def plot(self, **options: Unpack[Options]) -> ct.ControlPlot:
        """Plot the performance, static coefficients and refined poles.

        The performance is shown for both stages over time.

        Parameters
        ----------
        ax : array of Axes, optional
            Axes to draw in, shape (n_y + 2, 1).
        label : list of str, optional
            Labels of the two stages.

        Returns
        -------
        ControlPlot
            Lines, axes, figure.
        """
        return show(self, "plot", **options)


def pole_samples(n_samples: int) -> Integers:
    """Samples at which the poles are given."""
    # at most 200 samples, evenly spread
    return np.unique(np.linspace(0, max(n_samples - 1, 0), min(n_samples, _POINTS)).astype(np.int64))


def rates(model: LinearModel, dt: float | None) -> Complex:
    """Poles in rad/s; those of a discrete model are s = ln(z) / dt."""
    poles = np.linalg.eigvals(model.A).astype(complex)
    if model.is_continuous:
        return poles
    with np.errstate(divide="ignore"):
        return np.asarray(np.log(poles) / (dt or 1.0))


def poles_of(models: Sequence[LinearModel], dt: float | None) -> Complex:
    """Return the poles in rad/s, shape (n, K), in matching order.

    Each is matched to the nearest pole of the previous model. It is NaN where a model has none.
    """
    found: list[Complex] = []
    for model in models:
        poles = np.full(len(model.A), complex(np.nan, np.nan))
        if np.isfinite(model.A).all():
            poles = rates(model, dt)
        # by frequency at first, then in the order of the poles before
        poles = poles[np.lexsort((poles.imag, np.abs(poles)))]
        # assignment problem: the smallest total distance in the complex plane
        if found and poles.size and np.isfinite(poles).all() and np.isfinite(found[-1]).all():
            rows, columns = linear_sum_assignment(np.abs(found[-1][:, None] - poles[None, :]))
            poles = poles[columns[np.argsort(rows)]]
        found.append(poles)
    return np.array(found).T if found else np.zeros((0, 0), complex)


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
        Complex of the refined model in rad/s (of a discrete one log(z) / dt) at these times.
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
    poles: Complex
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


@dataclass(frozen=True, slots=True)
class Summary:
    """Cells of the table and the sentences around it."""

    title: str
    headers: list[str]
    rows: list[list[str]]
    notes: list[str]


def joined(blocks: Sequence[Array], shape: tuple[int, ...]) -> Array:
    """Join blocks of samples of this shape, time last."""
    if not blocks:
        return np.zeros((*shape, 0))
    # samples first in the blocks, last in the history
    return np.ascontiguousarray(np.moveaxis(np.concatenate(blocks), 0, -1))
