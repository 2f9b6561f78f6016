"""Noise models: autoregressive, heavy-tailed, proportional, or rounded."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple, Protocol

import numpy as np
from scipy.special import gammaln, ndtr

from ..inference.autoregression import autoregression
from ..inference.whitening import Whitener, innovations
from ..systems.linear import Array

__all__ = ["Noise", "NoiseModel", "noise_of", "rounding_step"]

_MEDIAN = 0.45  # median of the square of a standard normal variable
_DISTINCT, _ON_STEP = 0.6, 0.9  # rounded: most distinct values, least values on a whole step (shares)
_SPREADS = np.logspace(-1.5, 1.5, 25)  # standard deviations of the noise before rounding, in steps


class Noise(NamedTuple):
    """Likeliest noise of all outputs.

    Attributes
    ----------
    whitener : Whitener
        Filter of each output.
    weights : list of ndarray, shape (n_y, N)
        Weights of each record: one over the relative standard deviation of each sample.
    log_likelihood : float
        Log-likelihood minus the penalty for the parameters of the noise (Schwarz's criterion).
    names : tuple of str
        Name of the noise model of each output.
    """

    whitener: Whitener
    weights: list[Array]
    log_likelihood: float
    names: tuple[str, ...]

    @property
    def uneven(self) -> bool:
        """Return whether the noise level differs between samples."""
        return any(np.ptp(w) > 0 for w in self.weights)


class Fit(NamedTuple):
    """Noise model fitted to the residual of one output (`NoiseModel.fit`)."""

    log_likelihood: float
    filter: Array
    variance: float
    weights: Array
    name: str


@dataclass(eq=False)
class Residual:
    """Residual of one output, with the data that noise models need.

    Attributes
    ----------
    left : ndarray, shape (N,)
        Residual.
    measured : ndarray, shape (N,)
        Measured output, in the same unit.
    step : float
        Rounding step of the output, 0 for none.
    most : int or None
        Highest order of its filter, None for any. The points of a frequency response have no color: 0.
    """

    left: Array
    measured: Array
    step: float
    most: int | None

    @cached_property
    def price(self) -> float:
        """Return the penalty per parameter: half the log of the number of samples."""
        return 0.5 * float(np.log(self.left.size))

    @cached_property
    def colored(self) -> tuple[float, Array, float]:
        """Return log-likelihood, filter and variance of the autoregressive model."""
        return self.autoregressive(self.left)

    def autoregressive(self, row: Array) -> tuple[float, Array, float]:
        """Fit an autoregressive model of the order by Schwarz's criterion.

        Returns log-likelihood (minus the penalty), filter and variance.
        """
        n = row.size
        a, variance = autoregression(row, most=self.most, price=2.0 * self.price)
        a, variance = autoregression(row, order=a.size - 1)  # on all samples
        variance = max(variance, 1e-300)
        value = -0.5 * n * (float(np.log(2 * np.pi * variance)) + 1.0) - (a.size - 1) * self.price
        return value, a, variance


class NoiseModel(Protocol):
    """Protocol of a noise model."""

    def fit(self, residual: Residual) -> Fit | None:
        """Fit the model to a residual; None if it does not apply."""


@dataclass(frozen=True)
class Autoregressive:
    """Autoregressive noise with normal innovations.

    Schwarz's criterion determines the order (Annals of Statistics 6 (1978) 461).
    """

    def fit(self, residual: Residual) -> Fit:
        """Fit the filter and the variance."""
        value, a, variance = residual.colored
        return Fit(value, a, variance, np.ones(residual.left.size), f"autoregressive {a.size - 1}")


@dataclass(frozen=True)
class HeavyTailed:
    """Autoregressive noise with innovations of Student's t distribution.

    The filter is that of the normal model.
    """

    dof: float

    def fit(self, residual: Residual) -> Fit | None:
        """Fit the scale by expectation-maximization, with weights of the samples."""
        if residual.most == 0:
            return None
        _, a, _ = residual.colored
        row, dof = residual.left, self.dof
        e = innovations(a, row - row.mean())[a.size - 1 :]
        scale = float(np.median(e**2)) / _MEDIAN + 1e-300
        w = np.ones(e.size)
        for _ in range(30):
            w = (dof + 1) / (dof + e**2 / scale)
            before, scale = scale, float(np.mean(w * e**2)) + 1e-300
            if abs(scale - before) < 1e-6 * scale:
                break
        constant = gammaln((dof + 1) / 2) - gammaln(dof / 2) - 0.5 * np.log(dof * np.pi * scale)
        value = e.size * constant - 0.5 * (dof + 1) * float(np.sum(np.log1p(e**2 / (dof * scale))))
        value = value * row.size / e.size - a.size * residual.price
        weights = np.concatenate([np.ones(a.size - 1), np.sqrt(w)])
        return Fit(value, a, scale, weights, f"Student {dof:g}")


@dataclass(frozen=True)
class Proportional:
    """Noise with a part proportional to the output of the model."""

    share: float

    def fit(self, residual: Residual) -> Fit | None:
        """Fit an autoregressive model to the weighted residual."""
        if residual.most == 0:
            return None
        level = np.abs(residual.measured + residual.left)
        level = level / (float(np.sqrt(np.mean(level**2))) or 1.0)
        w = 1.0 / np.sqrt(1.0 + (self.share * level) ** 2)
        w /= np.exp(np.mean(np.log(w)))
        value, a, variance = residual.autoregressive(residual.left * w)
        return Fit(value - residual.price, a, variance, w, f"proportional {self.share:g}")


@dataclass(frozen=True)
class Rounded:
    """White normal noise, then rounding to whole steps.

    The likelihood is that of the rounding intervals (Sheppard).
    """

    def fit(self, residual: Residual) -> Fit | None:
        """Fit the standard deviation before rounding."""
        step, r = residual.step, residual.left
        if step <= 0:
            return None
        best = -np.inf
        for s in step * _SPREADS:
            p = ndtr((r + step / 2) / s) - ndtr((r - step / 2) / s)
            best = max(best, float(np.sum(np.log(np.maximum(p, 1e-30)))) - r.size * float(np.log(step)))
        value = best - residual.price
        return Fit(value, np.ones(1), float(np.mean(r**2)) or 1.0, np.ones(r.size), "rounded")


MODELS: tuple[NoiseModel, ...] = (
    Autoregressive(),
    *map(HeavyTailed, (2.5, 4.0, 8.0)),
    *map(Proportional, (0.5, 1.0, 2.0, 4.0, 8.0)),
    Rounded(),
)


def noise_of(
    residuals: Sequence[Array], outputs: Sequence[Array], steps: Sequence[float], most: int | None = None
) -> Noise:
    """Return the likeliest noise of residuals, output by output.

    Parameters
    ----------
    residuals, outputs : sequence of ndarray, shape (n_y, N)
        Residuals and measured outputs of each record, in the same units.
    steps : sequence of float
        Rounding step of each output, 0 for none.
    most : int or None
        Highest order of the filters, None for any; 0 for frequency responses.

    Returns
    -------
    Noise
    """
    rows = zip(np.concatenate(residuals, axis=1), np.concatenate(outputs, axis=1), steps, strict=True)
    best = []
    for left, measured, step in rows:
        residual = Residual(left, measured, step, most)
        fits = [fit for model in MODELS if (fit := model.fit(residual)) is not None]
        best.append(max(fits, key=lambda fit: fit.log_likelihood))
    ends = np.cumsum([r.shape[1] for r in residuals])[:-1]
    return Noise(
        Whitener(tuple(fit.filter for fit in best), np.sqrt([fit.variance for fit in best])),
        np.split(np.array([fit.weights for fit in best]), ends, axis=1),
        sum(fit.log_likelihood for fit in best),
        tuple(fit.name for fit in best),
    )


def rounding_step(values: Array) -> float:
    """Return the step of rounded values (N,), 0 if they are not rounded."""
    distinct, times = np.unique(values, return_counts=True)
    if distinct.size < 3 or distinct.size > _DISTINCT * values.size:
        return 0.0
    gaps = np.diff(distinct)
    step = float(np.median(gaps[gaps > 1e-9 * np.ptp(distinct)]))
    counts = (values - distinct[np.argmax(times)]) / step
    return step if np.mean(np.abs(counts - np.round(counts)) < 0.01) > _ON_STEP else 0.0
