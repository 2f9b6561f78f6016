"""Noise of a residual, and what of the residual is an error of the model.

The noise is autoregressive, heavy-tailed, proportional, or rounded.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property, partial
from typing import NamedTuple

import numpy as np
from scipy.special import gammaln, ndtr

from ..data.signals import over_time
from ..inference.f_tests import FTest
from ..inference.levels import Levels, levels
from ..inference.whitening import RESOLUTION, Whitener, autoregression, readings, white_part
from ..results import Row, frequency_text
from ..systems.linear import Array
from .residual_tests import TestedResidual

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


class NoiseFit(NamedTuple):
    """Noise model fitted to the residual of one output."""

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
        Residual, NaN where nothing was measured.
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
        return 0.5 * float(np.log(self.count))

    @property
    def count(self) -> int:
        """Return the number of samples that were measured."""
        return int(np.count_nonzero(~np.isnan(self.left)))

    @cached_property
    def floor(self) -> float:
        """Return the variance of the arithmetic, the noise of an exact record."""
        resolved = RESOLUTION * float(np.nanstd(self.measured)) * (self.most != 0)
        return max(resolved**2, 1e-300)

    @cached_property
    def colored(self) -> tuple[float, Array, float]:
        """Return log-likelihood, filter and variance of the autoregressive model."""
        return self.autoregressive(self.left)

    def autoregressive(self, row: Array) -> tuple[float, Array, float]:
        """Fit an autoregressive model of the order by Schwarz's criterion.

        Returns log-likelihood (minus the penalty), filter and variance.
        """
        # order by Schwarz's criterion, then the likelihood on all samples
        n = self.count
        a, variance = autoregression(row, most=self.most, price=2.0 * self.price)
        a, variance = autoregression(row, order=a.size - 1)  # on all samples
        level = max(variance, self.floor)
        value = -0.5 * n * (float(np.log(2 * np.pi * level)) + variance / level) - (a.size - 1) * self.price
        return value, a, level


def _autoregressive(residual: Residual) -> NoiseFit:
    """Fit autoregressive noise with normal innovations.

    Schwarz's criterion determines the order (Annals of Statistics 6 (1978) 461).
    """
    value, a, variance = residual.colored
    return NoiseFit(value, a, variance, np.ones(residual.left.size), f"autoregressive {a.size - 1}")


def _heavy_tailed(dof: float, residual: Residual) -> NoiseFit | None:
    """Fit autoregressive noise with innovations of Student's t distribution.

    The filter is that of the normal model. Expectation-maximization gives the scale and the weights.
    """
    if residual.most == 0:
        return None
    _, a, _ = residual.colored
    row = residual.left
    e, known = white_part(a, row - np.nanmean(row)), ~np.isnan(row)
    # expectation-maximization for Student's t: weights, then scale
    scale = float(np.median(e**2)) / _MEDIAN + residual.floor
    w = np.ones(e.size)
    for _ in range(30):
        w = (dof + 1) / (dof + e**2 / scale)
        before, scale = scale, float(np.mean(w * e**2)) + residual.floor
        if abs(scale - before) < 1e-6 * scale:
            break
    # log-likelihood of Student's t with Schwarz's penalty
    constant = gammaln((dof + 1) / 2) - gammaln(dof / 2) - 0.5 * np.log(dof * np.pi * scale)
    value = e.size * constant - 0.5 * (dof + 1) * float(np.sum(np.log1p(e**2 / (dof * scale))))
    value = value * residual.count / e.size - a.size * residual.price
    weights = np.ones(row.size)
    weights[known] = np.concatenate([np.ones(a.size - 1), np.sqrt(w)])
    return NoiseFit(value, a, scale, weights, f"Student {dof:g}")


def _proportional(share: float, residual: Residual) -> NoiseFit | None:
    """Fit autoregressive noise with a part proportional to the output."""
    if residual.most == 0:
        return None
    # noise grows with the size of the simulated output
    level = np.abs(residual.measured + residual.left)
    level = np.where(np.isnan(level), 0.0, level) / (float(np.sqrt(np.nanmean(level**2))) or 1.0)
    w = 1.0 / np.sqrt(1.0 + (share * level) ** 2)
    w /= np.exp(np.mean(np.log(w)))
    value, a, variance = residual.autoregressive(residual.left * w)
    return NoiseFit(value - residual.price, a, variance, w, f"proportional {share:g}")


def _rounded(residual: Residual) -> NoiseFit | None:
    """Fit white normal noise, then rounded to whole steps.

    The likelihood is that of the rounding intervals (Sheppard).
    """
    step, r = residual.step, residual.left[~np.isnan(residual.left)]
    if step <= 0:
        return None
    best = -np.inf
    # probability of each rounding interval, over the noise before rounding
    for s in step * _SPREADS:
        p = ndtr((r + step / 2) / s) - ndtr((r - step / 2) / s)
        best = max(best, float(np.sum(np.log(np.maximum(p, 1e-30)))) - r.size * float(np.log(step)))
    value = best - residual.price
    return NoiseFit(value, np.ones(1), float(np.mean(r**2)) or 1.0, np.ones(residual.left.size), "rounded")


#: Noise models: each fits a residual, or returns None if it does not apply.
MODELS: tuple[Callable[[Residual], NoiseFit | None], ...] = (
    _autoregressive,
    *(partial(_heavy_tailed, dof) for dof in (2.5, 4.0, 8.0)),
    *(partial(_proportional, share) for share in (0.5, 1.0, 2.0, 4.0, 8.0)),
    _rounded,
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
    lefts, apart = readings(residuals)
    best = []
    for left, measured, step in zip(lefts, readings(outputs)[0], steps, strict=True):
        residual = Residual(left, measured, step, most)
        # the likeliest model of each output
        fits = [fit for model in MODELS if (fit := model(residual)) is not None]
        best.append(max(fits, key=lambda fit: fit.log_likelihood))
    ends, gaps = np.cumsum([r.shape[1] for r in residuals])[:-1], np.isnan(np.concatenate(residuals, axis=1))
    weights = np.ones(gaps.shape)
    for row, gone, left, fit in zip(weights, gaps, lefts, best, strict=True):
        row[~gone] = fit.weights[~np.isnan(left)]
    return Noise(
        Whitener(tuple(fit.filter for fit in best), np.sqrt([fit.variance for fit in best]), apart),
        np.split(weights, ends, axis=1),
        sum(fit.log_likelihood for fit in best),
        tuple(fit.name for fit in best),
    )


def rounding_step(values: Array) -> float:
    """Return the step of rounded values (N,), 0 if they are not rounded."""
    values = values[~np.isnan(values)]
    # rounded values: few distinct ones, on a grid
    distinct, times = np.unique(values, return_counts=True)
    if distinct.size < 3 or distinct.size > _DISTINCT * values.size:
        return 0.0
    gaps = np.diff(distinct)
    step = float(np.median(gaps[gaps > 1e-9 * np.ptp(distinct)]))
    counts = (values - distinct[np.argmax(times)]) / step
    return step if np.mean(np.abs(counts - np.round(counts)) < 0.01) > _ON_STEP else 0.0


_LOBE, _BESIDE = 2, 12  # bins of a Hann window's line on either side, and of what is compared with it
_PARTS = 8  # of the record, in each of which the line stands
_SHORTEST_LINE = 200  # samples


def spectral_line(residuals: Sequence[Array], dt: float) -> tuple[float, float] | None:
    """Frequency of the line that makes up most of a residual, if there is one.

    Parameters
    ----------
    residuals : sequence of ndarray of shape (n_y, N)
        Of each record; the longest is looked at.
    dt : float
        Sampling time (s).

    Returns
    -------
    frequency, share : float
        In Hz, and of the power of that output; None where no line stands out that keeps its phase.
    """
    longest = max(residuals, key=lambda block: block.shape[1])
    rows = np.nan_to_num(longest - over_time(np.mean, longest)[:, None])
    found = [line for row in rows if (line := _line_of(row, dt)) is not None]
    return max(found, key=lambda line: line[1], default=None)


def _line_of(row: Array, dt: float) -> tuple[float, float] | None:
    n = row.size
    if n < _SHORTEST_LINE or not row.any():
        return None
    window = np.hanning(n)
    power = np.abs(np.fft.rfft(window * row)) ** 2
    # peak of the windowed spectrum against the bins beside it
    k = int(np.argmax(power[_LOBE + 1 : -_BESIDE])) + _LOBE + 1
    near = slice(k - _LOBE, k + _LOBE + 1)
    beside = np.concatenate([power[max(k - _BESIDE, 1) : near.start], power[near.stop : k + _BESIDE + 1]])
    level = levels()
    if power[k] < level.line * beside.mean() or power[near].sum() < level.line_share * power.sum():
        return None
    # frequency between the bins
    bins = k + np.linspace(-1.0, 1.0, 81)
    waves = np.exp(-2j * np.pi * np.outer(bins, np.arange(n)) / n)
    best = int(np.argmax(np.abs(waves @ (window * row))))
    # a line keeps phase and amplitude over all parts of the record
    parts = np.array([part.mean() for part in np.array_split(waves[best] * row, _PARTS)])
    if np.abs(parts - parts.mean()).max() > level.line_drift * abs(parts.mean()):
        return None
    return float(bins[best] / (n * dt)), float(power[near].sum() / power.sum())


def left_to_noise(tested: TestedResidual, levels: Levels) -> str:
    """Describe a large residual that passes for colored noise.

    The error of a model may look like that.

    Parameters
    ----------
    tested : TestedResidual
        Residual that passed.
    levels : Levels
        How much of it may be color.

    Returns
    -------
    str
        What that is in words, empty where little does.
    """
    fit, memory = _fit_and_memory(tested)
    if memory == 0.0 or (fit >= levels.colored_fit and memory < levels.colored_size):
        return ""
    run = "The prediction" if tested.fitted.refinement.led else "The free run"
    problem = tested.fitted.problem
    residuals = tested.fitted.residuals(tested.ratio)
    line = spectral_line(residuals, problem.records[0].dt) if problem.in_time else None
    pure = ""
    if line is not None:
        at, share = frequency_text(2 * np.pi * line[0]), line[1]
        pure = (
            f" {100 * share:.0f} % of the residual is a line at {at}: an unmeasured force or a disturbance "
            "of that frequency."
        )
    lasts = ""
    if problem.in_time:
        # until the slowest mode of the filters forgets itself to 1/e
        slowest = max(float(np.abs(np.roots(a)).max()) for a in tested.whitener.filters if a.size > 1)
        forgotten = -problem.records[0].dt / float(np.log(min(slowest, 1.0 - 1e-9)))
        lasts = f" of about {float(f'{forgotten:.2g}'):g} s"
    return (
        f"{run} explains only {fit:.3g} % of the record. The residual cannot be distinguished from colored "
        f"noise with a time constant{lasts}; it is {memory:.2g} times as large as its innovations.{pure} If "
        "neither the sensor nor a disturbance drifts like that, the model is wrong. Repeat the record: an "
        "error that returns is an error of the model. Steps up and down, or a sweep, show what it is."
    )


def is_drowned(tested: TestedResidual, levels: Levels) -> bool:
    """Return whether colored noise leaves too little of the fit.

    The residual passes the tests as colored noise, but the fit is low.
    """
    fit, memory = _fit_and_memory(tested)
    return fit < levels.drowned and memory >= levels.colored_size


def _fit_and_memory(tested: TestedResidual) -> tuple[float, float]:
    """Return the worst fit in percent and the color of the residual.

    The color is the size of the residual relative to its innovation, 0 where no output has colored noise.
    """
    refined, orders = tested.fitted.refinement, np.array(tested.whitener.orders)
    whole = over_time(np.std, np.hstack(tested.fitted.residuals(tested.ratio)))
    memory = float(np.max(whole / tested.whitener.scales, where=orders > 0, initial=0.0))
    return float(refined.fit[np.isfinite(refined.fit)].min(initial=100.0)), memory


@dataclass(frozen=True, slots=True)
class ErrorShare(Row):
    """Error of a model at one output, as shares of its spread.

    Attributes
    ----------
    output : str
        Output.
    share : float
        Root mean square error of the free run.
    model : float
        At most this much of it is an error of the model: the part that the past of the residual predicts,
        and what the residual tests find. Colored noise of a sensor counts, too.
    step : float
        Rounding step of the sensor, 0 if the record is not rounded.
    """

    output: str
    share: float
    model: float
    step: float


def matter(rows: Sequence[ErrorShare], least: float) -> bool:
    """Return whether an error of a model is too large at some output.

    Too large is what exceeds a share of the spread and the step of the sensor.
    """
    return any(row.model > max(least, row.step) for row in rows)


def in_percent(share: float) -> str:
    """Write a share in percent with two digits."""
    return f"{float(f'{100.0 * share:.2g}'):g} %"


def error_shares(
    tested: TestedResidual, tests: Sequence[FTest], significance: float
) -> tuple[ErrorShare, ...]:
    """Return what a model leaves of each output of its records.

    Parameters
    ----------
    tested : TestedResidual
        Residual of the model in free run.
    tests : sequence of FTest
        Its residual tests.
    significance : float
        Level of one test, below which what it finds is an error of the model.

    Returns
    -------
    tuple of ErrorShare
        Empty for frequency responses.

    Notes
    -----
    The residual r has variance s^2 and its autoregressive model the innovation variance s_e^2 [1]_. A model
    error that is slow against the samples is predictable, s^2 - s_e^2; one that is not is found by the
    tests: of N innovations with the sum of squares N, the columns of a test take away its gain. With both,
    ``s^2 - s_e^2 (1 - sum of gains / N)`` bounds the power of the error, where the noise is white.

    References
    ----------
    .. [1] L. Ljung, System Identification, 2nd ed., Prentice Hall, 1999, chapter 16.
    """
    fitted = tested.fitted
    problem = fitted.problem
    # a frequency response has no motion of its own
    if not problem.in_time:
        return ()
    weights = problem.weights[:, None]
    left = [block / weights for block in fitted.residuals(tested.ratio)]
    outputs = [record.outputs for record in problem.records]
    # innovations in the units of the outputs
    innovations = tested.whitener.scales / problem.weights
    labels = fitted.refinement.physical_model.linear.output_labels
    return error_shares_of(labels, left, outputs, innovations, found_share(tested, tests, significance))


def found_share(tested: TestedResidual, tests: Sequence[FTest], significance: float) -> float:
    """Return the share of the innovations' power that the tests find.

    Parameters
    ----------
    tested, tests, significance
        As for `error_shares`.
    """
    # what the tests explain beyond chance: gain minus its degrees of freedom
    gains = sum(max(test.gain - test.dof, 0.0) for test in tests if test.p_value < significance)
    return min(gains / max(tested.residual.size, 1), 1.0)


def error_shares_of(
    labels: Sequence[str], left: Sequence[Array], outputs: Sequence[Array], innovations: Array, found: float
) -> tuple[ErrorShare, ...]:
    """Return what is left of each output.

    Parameters
    ----------
    labels : sequence of str
        Names of the outputs.
    left : sequence of ndarray, shape (n_y, N)
        Residuals of each record, in units of the outputs.
    outputs : sequence of ndarray, shape (n_y, N)
        Measured outputs that have the spread, of the same records or of more.
    innovations : ndarray, shape (n_y,)
        Standard deviations of the innovations of the residuals.
    found : float
        Share of the power of the innovations that is no noise.

    Returns
    -------
    tuple of ErrorShare
    """
    # power of the residual without the innovations, plus what the tests find in these
    residual, measured = np.hstack(left), np.hstack(outputs)
    power, white = over_time(np.mean, residual**2), innovations**2
    model = np.maximum(power - white, 0.0) + white * found
    # relative to the spread of the output
    spread = over_time(np.std, measured)
    size = np.where(spread > 0, spread, np.inf)
    shares = np.sqrt(np.array([power, np.minimum(model, power)])) / size
    steps = np.array([rounding_step(row) for row in measured]) / size
    rows = zip(labels, *shares, steps, strict=True)
    return tuple(ErrorShare(name, float(a), float(b), float(c)) for name, a, b, c in rows)
