"""Healthy model: observer gain, noise, uncertain parameters.

All are learned from the first, healthy samples.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Annotated

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import nnls
from scipy.signal import lfilter
from scipy.stats import norm

from ...data.measurement import Measurement
from ...effects.channels import OutputOffset
from ...effects.effect import Effect
from ...engine.engine import Engine
from ...engine.initial_state import estimate_initial_state
from ...engine.observer import observer_gain
from ...engine.structure import Structure
from ...exceptions import DataError
from ...inference.covariance import standard_deviations
from ...inference.parameters import nominal_size
from ...inference.whitening import autoregression, innovations
from ...models.library import effect_library
from ...systems.linear import Array
from ..samples import Flags, Integers
from .isolation import Segment, descend
from .kernels import CLIP, EVEN

#: Unknown force over the measured input, relative to sensor noise of 3 %: observer gains that are tried.
RATIOS = (0.0, *(float(r) for r in np.geomspace(2**-11, 2, 13)))
FREE = 0.9999  # spectral radius up to which the model may run free
_WORTH = 3.0  # log-likelihood that another gain has to earn
TINY = float(np.finfo(float).tiny)
_MOST_MISSING = 0.2
_STANDS_OUT = 8.0  # standard deviations at which a sample is left out of what is learned
_MOST_ALONE = 0.05  # share of samples up to which they are outliers, not the noise itself
_PASSES = 3
_REWEIGHTED = 4  # passes of the noise law
_ROUNDING = 1e-9  # least noise over the rms of the signal: arithmetic leaves 1e-12, alike over long windows
_CONSTANT = 1e-3  # share of the noise that is there whatever the signal


@dataclass(frozen=True, slots=True, eq=False)
class Healthy:
    """Observer and noise of the healthy structure.

    Attributes
    ----------
    ratio : float
        Unknown force over the measured input that the gain answers to.
    gain : ndarray, shape (n, n_y)
        Observer gain.
    x0 : ndarray, shape (n,)
        Initial state.
    filters : ndarray, shape (n_y, q)
        Whitening polynomials without the leading one.
    mix : ndarray, shape (n_y, n_y)
        Lower triangular; makes the whitened innovations independent, of unit variance.
    settle : int
        Samples after which the observer has forgotten a wrong state.
    orders : tuple of int
        Order of the whitening filter of each output.
    mean : ndarray, shape (n_y,)
        Mean of the innovations: offset of the sensors.
    noise : ndarray, shape (n_y, 3)
        Variance of the whitened innovations: a constant, a share of the prediction squared, and of
        the mean of that.
    least : ndarray, shape (n_y,)
        The smallest variance that was seen.
    pace : float
        Weight of a sample in that mean.
    power : ndarray, shape (n_y,)
        Mean square of the predictions.
    """

    ratio: float
    gain: Annotated[Array, "n ny"]
    x0: Annotated[Array, "n"]
    filters: Annotated[Array, "ny q"]
    mix: Annotated[Array, "ny ny"]
    settle: Annotated[int, "", 1, 2**53]
    orders: tuple[int, ...]
    mean: Annotated[Array, "ny"]
    noise: Annotated[Array, "ny 3", 0.0, math.inf]
    least: Annotated[Array, "ny", TINY, math.inf]
    pace: Annotated[float, "", 0.0, 1.0]
    power: Annotated[Array, "ny", 0.0, math.inf]


@dataclass(frozen=True, slots=True, eq=False)
class Phase:
    """Healthy samples that the monitor learns from.

    Attributes
    ----------
    data : Measurement
        Samples, gaps filled.
    use : ndarray of uint8, shape (N, n_y)
        Which outputs were measured.
    disturbance : float or None
        Declared ratio of unknown force to input; None to choose it.
    period : int
        Samples over which the mean square of the signal is taken.
    """

    data: Measurement
    use: Flags
    disturbance: float | None
    period: int


def check_outputs(structure: Structure, phase: Phase) -> None:
    """Refuse a learning phase with a missing or constant output."""
    use, data = phase.use, phase.data
    for i, label in enumerate(structure.linear_model.output_labels):
        there = use[:, i] > 0
        if there.mean() < 1 - _MOST_MISSING:
            raise DataError(
                f"output {label!r} is missing in {100 * (1 - there.mean()):.0f} % of the learning phase "
                f"({use.shape[0]} samples); learn from a whole stretch, or leave it out of the model"
            )
        if np.ptp(data.outputs[i][there]) == 0:
            raise DataError(f"output {label!r} is constant over the learning phase; check the sensor")


def learn(numbers: Numbers, phase: Phase, most: float) -> tuple[Healthy, Flags, Array]:
    """Choose the observer and its whitening filter by likelihood.

    Parameters
    ----------
    numbers : Numbers
        Healthy model.
    phase : Phase
        Healthy samples.
    most : float
        Largest ratio to try: a better model has less that nobody measured.

    Returns
    -------
    healthy : Healthy
    sound : ndarray of uint8, shape (N, n_y)
        Measured outputs without samples that stand out alone.
    scale : ndarray, shape (N, n_y)
        Standard deviation of the whitened innovation of each sample.
    """
    # ratios of unknown force to input: those of the grid, or the one that is declared
    declared = phase.disturbance
    ratios = [ratio for ratio in RATIOS if ratio <= most] if declared is None else [declared]
    # observer by likelihood, outliers left out, and once more until the outliers stay the same
    for _ in range(_PASSES):
        healthy, white, scale = _choose_observer(numbers, phase, ratios)
        before, sound = phase.use, np.where(_isolated_outliers(white, phase.use), 0, phase.use)
        phase = replace(phase, use=sound.astype(np.uint8))
        if np.array_equal(before, phase.use):
            break
    return healthy, phase.use, scale


def _isolated_outliers(white: Array, use: Flags) -> NDArray[np.bool_]:
    """Return isolated outliers of the whitened innovations.

    The shape is (N, n_y). There are none where outliers are frequent.
    """
    # robust scale: the median absolute innovation
    size = np.abs(white.T)
    usual = np.array([np.median(row[there > 0]) for row, there in zip(size.T, use.T, strict=True)])
    out = (size > _STANDS_OUT / norm.ppf(0.75) * usual) & (use > 0) & (usual > 0)
    return np.asarray(out & (out.mean(axis=0) < _MOST_ALONE))


def _choose_observer(numbers: Numbers, phase: Phase, ratios: Sequence[float]) -> tuple[Healthy, Array, Array]:
    """Return the most likely observer and its whitened innovations.

    The standard deviations of the innovations are returned as well.
    """
    best: tuple[float, Healthy, Array, Array] | None = None
    for ratio in ratios:
        # unknown force at the inputs only, then at all ports
        for everywhere in (False, True):
            gain, radius = gain_of(numbers, phase.data, ratio, everywhere)
            if ratio == 0 and radius > FREE:
                # an unstable or undamped model does not run free: smallest gain instead
                if len(ratios) > 1:
                    continue  # what was once wrong about the state would stay wrong
                gain, radius = gain_of(numbers, phase.data, RATIOS[1], everywhere)
            found = _evaluate_observer(numbers, phase, gain, ratio, radius)
            # the smallest gain that the likelihood does not clearly reject
            if found is not None and (best is None or found[0] < best[0] - _WORTH):
                best = found
            if ratio == 0:
                break
    if best is None:
        raise DataError(
            "no observer of the healthy model follows the learning phase; check model, units and channels "
            "with compare(), or refine the model first"
        )
    return best[1:]


def gain_of(
    numbers: Numbers, data: Measurement, ratio: float, everywhere: bool = False
) -> tuple[Array, float]:
    """Gain, and the spectral radius of the observer."""
    structure, theta = numbers.structure, numbers.theta
    n = structure.n_states
    # Phi: transition over one sample
    Phi = structure.discretize(theta, data.dt, derivatives=False).M[0, -n:, :n]
    if ratio == 0:
        K = np.zeros((n, structure.n_outputs))
    else:
        # the unknown force comes in where the measured one does, or at the ports too
        K = observer_gain(structure, theta, data, ratio, at="everywhere" if everywhere else "inputs")
    # error dynamics of the observer: Phi (I - K C)
    closed = Phi @ (np.eye(n) - K @ structure.matrices(theta).C.astype(float))
    if not np.isfinite(closed).all():  # there is no such observer
        return K, np.inf
    return K, float(np.abs(np.linalg.eigvals(closed)).max(initial=0.0))


def _evaluate_observer(
    numbers: Numbers, phase: Phase, gain: Array, ratio: float, radius: float
) -> tuple[float, Healthy, Array, Array] | None:
    """Return minus log-likelihood, observer and filtered innovations.

    Return None if the observer cannot follow the data.
    """
    theta, use, period = numbers.theta, phase.use, phase.period
    engine = Engine(numbers.structure, phase.data, substeps=numbers.substeps)
    y, flags = engine.data.outputs, use.T > 0
    spread = np.maximum(y.std(axis=1), 1e-300)
    K = gain if gain.any() else None
    # initial state by least squares, then innovations e = y - y_hat
    x0 = estimate_initial_state(engine, theta, 1.0 / spread, gain=K, use=use > 0)
    run = engine.run(theta, x0, sensitivity=False, gain=K, use=use > 0, check=False)
    if run.blew_up >= 0 or not np.isfinite(run.outputs).all():
        return None
    # mean of each output's innovations: sensor offset
    e = y - run.outputs
    mean = np.array([row[there].mean() for row, there in zip(e, flags, strict=True)])
    e = np.where(flags, e - mean[:, None], 0.0)
    # noise may grow with the signal: its square now, and smoothed over a period
    square = run.outputs**2
    power = square.mean(axis=1)
    local = lfilter([1.0 / period], [1.0, 1.0 / period - 1.0], square - power[:, None], axis=1)
    rows, orders, white, noise, scale, rounding = [], [], [], [], [], []
    cost = 0.0
    for i in range(e.shape[0]):
        # whiten each output by an autoregressive model
        floor = max(float(np.mean((_ROUNDING * y[i]) ** 2)), 1e-300)
        louder = float(np.mean(e[i] ** 2)) > floor  # rounding has no color to learn
        a = autoregression(e[i], known=flags[i])[0] if louder else np.ones(1)
        w = innovations(a, e[i])
        sizes = np.column_stack([np.ones(w.size), square[i], power[i] + local[i]])
        # variance of the whitened innovations as a function of the signal
        law = noise_law(w[flags[i]], sizes[flags[i]], floor)
        variance = variance_by(law, sizes)
        # minus the Gaussian log-likelihood, with Schwarz's penalty per coefficient
        cost += 0.5 * float(np.log(variance[flags[i]]).sum())
        cost += 0.5 * math.log(int(flags[i].sum())) * (a.size - 1)
        noise.append(law)
        scale.append(np.sqrt(variance))
        rows.append(a[1:])
        orders.append(a.size - 1)
        white.append(w / scale[-1])
        rounding.append(float(np.mean(floor / variance)))
        mean[i] += np.average(e[i][flags[i]], weights=1.0 / variance[flags[i]])
    q = max(orders)
    filters = np.zeros((len(rows), q))
    for i, row in enumerate(rows):
        filters[i, : row.size] = row
    # covariance between outputs; mix = inverse of its Cholesky factor
    w = np.array(white)[:, q:]
    covariance = np.atleast_2d(np.cov(w, bias=True))
    diagonal = np.maximum(np.diag(covariance), rounding)
    covariance = covariance + np.diag(diagonal - np.diag(covariance) + 1e-12 * diagonal)
    lower = np.linalg.cholesky(covariance)
    # minus log-likelihood of the correlation
    correlation = covariance / np.sqrt(np.outer(diagonal, diagonal))
    cost += 0.5 * w.shape[1] * math.log(max(np.linalg.det(correlation), 1e-300))
    # samples until the observer has forgotten 99 % of a wrong state
    settle = math.ceil(math.log(0.01) / math.log(radius)) if 0 < radius < 1 else 1
    mix = np.tril(np.linalg.inv(lower))
    least = np.array([row[there].min() ** 2 for row, there in zip(scale, flags, strict=True)])
    healthy = Healthy(
        ratio, gain, x0, filters, mix, settle, tuple(orders), mean,
        np.array(noise), least, 1.0 / period, power,
    )  # fmt: skip
    return cost, healthy, np.array(white), np.array(scale).T


def variance_by(law: Array, sizes: Array) -> Array:
    """Return the variance of each sample for a noise model.

    It is never far below the variance of the samples around it; see `noise_law`.
    """
    return np.asarray(np.maximum(sizes @ law, EVEN * (law[0] + (law[1] + law[2]) * sizes[:, 2])))


def noise_law(white: Array, sizes: Array, floor: float) -> Array:
    """Fit the variance of a signal as a sum of nonnegative terms.

    Each term is a size times a factor of zero or more.

    Parameters
    ----------
    white : ndarray, shape (N,)
        Signal.
    sizes : ndarray, shape (N, 3)
        Ones, the square of what the variance may grow with, and the mean of that around.
    floor : float
        Least variance.

    Returns
    -------
    ndarray, shape (3,)
        Factors, by weighted least squares of the squares (each scatters as its own variance), one
        square counting as that of 3 standard deviations at most. The last one has to earn its place:
        where the signal is as large all the time, it cannot be distinguished from a constant.

    Examples
    --------
    >>> rng = np.random.default_rng(0)
    >>> level = rng.standard_normal(20000) ** 2
    >>> e = np.sqrt(1 + 4 * level) * rng.standard_normal(20000)
    >>> print(noise_law(e, np.column_stack([np.ones(20000), level, np.ones(20000)]), 1e-300).round(1))
    [1. 4. 0.]
    """
    mean = max(float(np.mean(white**2)), floor)
    least = max(floor, _CONSTANT * mean)  # a signal that rests tells nothing of the noise there

    def fitted(used: int) -> tuple[float, Array]:
        # iteratively reweighted nonnegative least squares
        law = np.array([mean, 0.0, 0.0])
        for _ in range(_REWEIGHTED):
            variance = variance_by(law, sizes)
            # clipped squares; 1.005 restores their mean for Gaussian noise
            square = 1.005 * np.minimum(white**2, CLIP**2 * variance)
            scaled = sizes[:, :used] / variance[:, None]
            unit = np.maximum(np.linalg.norm(scaled, axis=0), 1e-300)
            law[:used] = nnls(scaled / unit, square / variance)[0] / unit
            law[0] = max(law[0], least)
        variance = variance_by(law, sizes)
        return 0.5 * float(np.sum(np.log(variance) + np.minimum(white**2 / variance, CLIP**2))), law

    # the term of the smoothed signal only if the likelihood demands it
    plain, whole = fitted(2), fitted(3)
    return whole[1] if whole[0] < plain[0] - _WORTH else plain[1]


_ROUNDS = 3  # of noise for the numbers, and numbers for the noise
_LEAST = 1e-6  # variance of a combination of estimates that are alike but for the sign, relative
_AT_REST = 0.3  # standard deviations by which another round moves no number


@dataclass(frozen=True, eq=False)
class Numbers:
    """The healthy model, and how well it is known.

    Attributes
    ----------
    structure : Structure
        Model with all its numbers as effects.
    theta : ndarray, shape (q,)
        Their coefficients.
    substeps : int
        Substeps per sample.
    loose : ndarray of int, shape (p,)
        Those that are not known exactly.
    covariance : ndarray, shape (p, p)
        Of these.
    """

    structure: Structure
    theta: Array
    substeps: int
    loose: Integers
    covariance: Array

    @cached_property
    def moving(self) -> list[tuple[Effect, str]]:
        """Effect and coefficient of each uncertain parameter.

        The force law is taken at the gap or limit that it has.
        """
        return [_effect_of(self.structure, self.theta, int(i)) for i in self.loose]


def _effect_of(structure: Structure, theta: Array, at: int) -> tuple[Effect, str]:
    # an effect that is part of the model, linearized at the shape it has
    parameter = structure.parameters[at]
    index = parameter.effect
    effect = structure.effects[index]
    shape = {name: float(structure.value(theta, index, name)) for name in effect.spec.shaping}
    fixed = {**effect.fixed, **shape}
    return Effect(effect.kind, effect.place, fixed=fixed, law=effect.law, name=effect.name), parameter.name


def numbers_of(
    structure: Structure, theta: Array, substeps: int, covariance: Array | None, tolerance: float
) -> Numbers:
    """Return the uncertain model parameters and estimated coefficients.

    Parameters
    ----------
    structure, theta, substeps
        Healthy model as it was given.
    covariance : ndarray, shape (q, q), or None
        Of `theta`, where it was estimated.
    tolerance : float
        Relative standard deviation of each number of the model.

    Returns
    -------
    Numbers
    """
    # parameters that the user does not estimate: linear elements, within `tolerance` of their size
    held = {(effect.kind, effect.place) for effect in structure.effects}
    extra: list[Effect] = []
    sizes: list[float] = []
    for effect in effect_library(structure.model) if tolerance > 0 else ():
        linear = (effect.spec.is_parameter or effect.spec.relative) and len(effect.free) == 1
        size = nominal_size(structure, effect) if linear else 0.0
        if 0.0 < size < np.inf and (effect.kind, effect.place) not in held:
            extra.append(effect)
            sizes.append(tolerance * size)
    # sensor offsets start with zero spread: `offset` estimates them first
    offsets = [Effect(OutputOffset.name, label) for label in structure.linear_model.output_labels]
    extra += sorted(set(offsets) - set(structure.effects), key=offsets.index)
    sizes += [0.0] * (len(extra) - len(sizes))
    whole = Structure(structure.model, [*structure.effects, *extra], constants=structure.constants)
    q = whole.n_parameters
    # covariance: as given for estimated coefficients, tolerance^2 for the others
    spread = np.zeros((q, q))
    if covariance is not None:
        spread[: theta.size, : theta.size] = covariance
    spread[range(theta.size, q), range(theta.size, q)] = np.square(sizes)
    # those that act as a force along the motion can be columns
    laws = [(whole.effects[p.effect].spec, p.name) for p in whole.parameters]
    known = np.array([law.along_motion and name not in law.shaping for law, name in laws], dtype=bool)
    finite = np.isfinite(spread).all(axis=0) & (np.diag(spread) > 0)
    loose = np.flatnonzero(known & finite)
    full = np.concatenate([theta, np.zeros(q - theta.size)])
    return Numbers(whole, full, substeps, loose, spread[np.ix_(loose, loose)])


def offset(numbers: Numbers, phase: Phase) -> Numbers:
    """Return the parameters with the constant offset of each sensor.

    The offsets are estimated together with the initial state.

    Without it, observer and parameters would follow the offset.
    """
    structure, data, use = numbers.structure, phase.data, phase.use
    n, ny, theta = structure.n_states, structure.n_outputs, numbers.theta.copy()
    # free run of the model, or the smallest gain if it does not decay
    gain, radius = gain_of(numbers, data, 0.0)
    if radius > FREE:
        gain, _ = gain_of(numbers, data, RATIOS[1])
    if not np.isfinite(gain).all():
        return numbers
    # residual weighted by the standard deviation of each output
    spread = np.array([np.std(y[there > 0]) for y, there in zip(data.outputs, use.T, strict=True)])
    segment = Segment(
        structure, theta, numbers.substeps, data, use, np.zeros(n), gain, np.zeros((ny, 0)),
        np.diag(1.0 / spread), np.ones((data.n_samples, ny)), True,
    )  # fmt: skip
    kinds = [structure.effects[parameter.effect].kind for parameter in structure.parameters]
    at = np.flatnonzero(np.array(kinds) == OutputOffset.name)
    beyond = np.full(at.size, np.inf)
    engine = Engine(structure, data, substeps=numbers.substeps)
    # least squares for offsets and initial state
    fit = descend(segment, engine, theta, at, -beyond, beyond)
    theta[at] = fit.coefficients
    return replace(numbers, theta=theta)


def settled(numbers: Numbers, phase: Phase) -> tuple[Numbers, Healthy]:
    """Return the most likely parameters and noise of the healthy samples.

    The parameters come with their remaining uncertainty.

    Parameters
    ----------
    numbers : Numbers
        As they are known before.
    phase : Phase
        Healthy samples.

    Returns
    -------
    numbers : Numbers
        As they are known afterwards.
    healthy : Healthy
        Observer and noise.
    """
    # alternate: noise for given parameters, parameters for given noise
    before, most = numbers, np.inf
    for _ in range(_ROUNDS):
        healthy, sound, scale = learn(numbers, phase, most)
        most = max(healthy.ratio, RATIOS[1])
        if numbers.loose.size == 0:
            break
        last, numbers = numbers, _fit_parameters(before, numbers.theta, phase.data, sound, scale, healthy)
        # stop where no parameter moved by 0.3 standard deviations
        moved = np.abs(numbers.theta - last.theta)[numbers.loose]
        if (moved < _AT_REST * standard_deviations(numbers.covariance)).all():
            break
    return numbers, healthy


def _fit_parameters(
    before: Numbers,
    start: Array,
    data: Measurement,
    use: Flags,
    scale: Array,
    healthy: Healthy,
) -> Numbers:
    """The numbers at the maximum of their posterior."""
    structure, loose = before.structure, before.loose
    # maximum a posteriori: the prior is `before`, the data are the innovations
    outputs = data.outputs - healthy.mean[:, None]
    shifted = Measurement(data.inputs, outputs, dt=data.dt, hold=data.hold)
    engine = Engine(structure, shifted, substeps=before.substeps)
    segment = Segment(
        structure, before.theta, before.substeps, shifted, use, healthy.x0, healthy.gain, healthy.filters,
        healthy.mix, scale, True,
    )  # fmt: skip
    # square root of the prior's covariance, by eigenvectors of the correlation
    size = standard_deviations(before.covariance)
    values, vectors = np.linalg.eigh(before.covariance / np.outer(size, size))
    root = size[:, None] * vectors * np.sqrt(np.maximum(values, _LEAST))
    bounds = np.array([(structure.parameters[i].lower, structure.parameters[i].upper) for i in loose])
    # the prior adds rows to the least-squares problem
    found = descend(
        segment, engine, start, loose, bounds[:, 0], bounds[:, 1], prior=(before.theta[loose], root)
    )
    if not np.isfinite(found.cost):
        return before
    theta = start.copy()
    theta[loose] = found.coefficients
    return replace(before, theta=theta, covariance=found.covariance)
