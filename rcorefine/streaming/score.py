"""Score test of a stream: samples against the healthy model, by block.

The observer of the healthy model leaves innovations e. Whitened, of unit variance, they are r; the same
filter makes s of the derivatives of the outputs by the parameters of the model. A change of a parameter is
seen by the windowed scores sum g^i s r; what no parameter explains is seen by the energy sum g^i (r^2 - 1).
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property
from typing import Annotated, Any, NamedTuple

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray
from scipy.optimize import brentq, nnls
from scipy.signal import lfilter
from scipy.stats import norm

from ..data.measurement import Measurement, block_of_stream
from ..effects.channels import OutputOffset
from ..effects.compiled import raise_pending
from ..effects.effect import Effect
from ..engine.inputs import InputSignal
from ..engine.linear import Corrections
from ..engine.march import Discretized, MarchResult, MarchState, march
from ..engine.observer import observer_gain
from ..engine.setting import setting
from ..engine.structure import Structure
from ..exceptions import DataError, DivergenceError
from ..inference.parameters import nominal_size
from ..inference.whitening import Whitener, innovations
from ..models.library import effect_library
from ..systems.linear import Array
from .block import Stretch, Whitening, fit_block
from .samples import Block, Flags

BLOCKS = 256  # blocks that are kept: 32 periods or more
RATIOS = (0.0, 2**-9, 2**-7, 2**-5, 2**-3, 0.5, 2.0)  # unknown force over the measured one, rms
CLIP = 3.0  # standard deviations that one innovation counts for at most
MEAN_SQUARE = 0.99501  # of a normal number clipped there
PER = 100_000  # samples to which `false_alarms` refers
_OUTLIER, _ALONE = 8.0, 3  # standard deviations beyond which up to 3 samples of a block are set aside
_SLOW = 16  # periods of the mean that is taken off
FREE = 0.9999  # spectral radius up to which a wrong state is forgotten
_WORTH = 3.0  # log-likelihood that an observer of a larger gain has to earn
_MEMORY = 1200.0  # samples over which the noise level is followed
_LEAST = 0.8  # of the learned variance: silence is no lower noise
_CALIBRATE = 64.0  # windows over which the scatter of a statistic is followed
_SURE = 0.01  # variance by an uncertain state, over that of the noise, with which a sample counts
_ENERGY = 8  # periods of the longest window of the energy: the level of the noise may change slowly
_ROUNDING = 1e-9  # noise over the signal, below which it is that of the arithmetic
_MOST_MISSING = 0.5  # share of an output in the learning phase
_EVEN = 0.05  # least variance of a sample over that of its surroundings
_TINY = 1e-300


# ------------------------------------------------------------------------ thresholds
def crossing_rate(level: float, keep: float) -> float:
    """Return the rate per sample of chance crossings of a level.

    Parameters
    ----------
    level : float
        Level in standard deviations.
    keep : float
        Share of its sum that the statistic keeps per sample.

    Notes
    -----
    The statistic is a sampled Ornstein-Uhlenbeck process; a high level b is
    crossed at the rate ``2 c b phi(b)`` with c = -ln(keep) (Pickands), thinned by
    Siegmund's ``exp(-0.583 b sqrt(2 c))`` because the process is not seen between
    samples, and never more often than single samples lie above it.

    References
    ----------
    D. Siegmund, Sequential Analysis, Springer 1985, chapters IV and VIII.

    Examples
    --------
    >>> 0.9 < crossing_rate(4.0, 0.99) / 7.1e-6 < 1.1
    True
    """
    c = -math.log(keep)
    density = math.exp(-0.5 * level * level) / math.sqrt(2 * math.pi)
    clusters = 2 * c * level * density * math.exp(-0.583 * level * math.sqrt(2 * c))
    return min(clusters, math.erfc(level / math.sqrt(2)))


def thresholds(rate: float, keep: Array, columns: int) -> Array:
    """Return the level of each window, the rate shared out evenly.

    Parameters
    ----------
    rate : float
        Expected false alarms per sample, all columns and windows together.
    keep : ndarray, shape (M,)
        Share that each window keeps per sample.
    columns : int
        Number of columns; their rates add up at most (Bonferroni).
    """
    goal = math.log(rate / (columns * keep.size))

    def excess(level: float, share: float) -> float:
        return math.log(max(crossing_rate(level, share), _TINY)) - goal

    return np.array([brentq(excess, 1.5, 30.0, args=(float(share),), xtol=1e-6) for share in keep])


def energy_levels(levels: Array, keep: Array, power: Array, outputs: int) -> Array:
    """Return levels of the energy as rare as those of a normal number.

    Parameters
    ----------
    levels : ndarray, shape (M,)
        Levels of a normal statistic.
    keep : ndarray, shape (M,)
        Share that each window keeps per sample.
    power : ndarray, shape (N,)
        Clipped squares of healthy innovations.
    outputs : int
        Outputs, whose squares are summed.

    Notes
    -----
    A sum of few squares is skewed. Its tail follows from the cumulants K of the squares themselves:
    at the tilt t the sum is K'(t), and it is as rare there as a normal number of the size
    r + ln(u / r) / r with r^2 = 2 (t K' - K), u^2 = t^2 K'' (Lugannani and Rice, Adv. Appl. Prob. 12, 1980).

    Examples
    --------
    >>> power = np.random.default_rng(0).standard_normal(100_000) ** 2
    >>> 3.0 < float(energy_levels(np.array([3.0]), np.array([1 - 1 / 1000]), power, 1)[0]) < 3.4
    True
    """
    counts, edges = np.histogram(power, 100)
    share, middle = counts / power.size, 0.5 * (edges[1:] + edges[:-1])
    value = (middle - share @ middle) / max(math.sqrt(share @ (middle - share @ middle) ** 2), _TINY)
    found = levels.copy()
    for m, g in enumerate(keep):
        weights = g ** np.arange(min(math.ceil(6 / (1 - g)), 4000))
        weights /= math.sqrt(outputs * np.sum(weights**2))

        def moments(tilt: float, weights: Array = weights) -> tuple[float, float, float]:
            each = weights[:, None] * value
            top = tilt * each.max(axis=1, keepdims=True)
            part = share * np.exp(tilt * each - top)
            whole = part.sum(axis=1)
            mean = np.sum(part * each, axis=1) / whole
            second = np.sum(part * each**2, axis=1) / whole
            K = np.sum(np.log(whole) + top[:, 0])
            return outputs * K, outputs * mean.sum(), outputs * np.sum(second - mean**2)

        def rarity(tilt: float, moments: Any = moments) -> float:
            K, first, second = moments(tilt)
            r, u = math.sqrt(max(2 * (tilt * first - K), _TINY)), tilt * math.sqrt(max(second, _TINY))
            return r + math.log(u / r) / r

        far = 1.0
        while far < 100 and rarity(far) < levels[m]:
            far *= 1.5
        tilt = brentq(lambda t, m=m: rarity(t) - levels[m], 0.1, far) if far < 100 else far
        found[m] = moments(tilt)[1]
    return found


# ------------------------------------------------------------------------ healthy model
class Base(NamedTuple):
    """The model as it was given, and what the user said of it."""

    structure: Structure
    theta: Array
    substeps: int
    covariance: Array | None
    tolerance: float
    dt: float
    hold: str


class Numbers(NamedTuple):
    """Parameters of the model as coefficients.

    Attributes
    ----------
    structure : Structure
        Model with its effects, those that change its parameters, and the offsets of the sensors.
    theta : ndarray, shape (p,)
        Coefficients as given.
    free : ndarray of int, shape (f,)
        Those that are not known exactly.
    root : ndarray, shape (f, f)
        Root U of their covariance U U', as given.
    columns : ndarray of int, shape (k - 1,)
        Those whose scores are watched: all but offsets, gaps, limits and fading speeds.
    """

    structure: Structure
    theta: Array
    free: NDArray[np.intp]
    root: Array
    columns: NDArray[np.intp]

    @property
    def offsets(self) -> NDArray[np.intp]:
        """Coefficients that are offsets of sensors."""
        s = self.structure
        kinds = [s.effects[q.effect].kind == OutputOffset.name for q in s.parameters]
        return np.flatnonzero(np.array(kinds, dtype=bool))


def numbers_of(base: Base) -> Numbers:
    """Return the parameters of the model as coefficients."""
    s, own = base.structure, base.theta.size
    named = {(e.kind, e.place) for e in s.effects}
    linear = [e for e in effect_library(s.model) if e.spec.is_parameter or e.spec.relative]
    sizes = [(e, nominal_size(s, e)) for e in linear if len(e.free) == 1 and (e.kind, e.place) not in named]
    loose = [(e, base.tolerance * size) for e, size in sizes if 0 < size < np.inf]
    # the learning phase alone finds the offsets
    offsets = [Effect(OutputOffset.name, label) for label in s.linear_model.output_labels]
    loose += [(e, 0.0) for e in offsets if (e.kind, e.place) not in named]
    whole = Structure(s.model, [*s.effects, *(e for e, _ in loose)], constants=s.constants)
    p = whole.n_parameters
    # covariance: as given for what was estimated, tolerance^2 for the rest
    P = np.zeros((p, p))
    if base.covariance is not None:
        P[:own, :own] = base.covariance
    P[range(own, p), range(own, p)] = np.square([size for _, size in loose])
    shaping = np.array([q.name in whole.effects[q.effect].spec.shaping for q in whole.parameters], dtype=bool)
    free = np.flatnonzero(~shaping & np.isfinite(P).all(axis=0) & (np.diag(P) > 0))
    theta = np.concatenate([base.theta, np.zeros(p - own)])
    # a sensor drifts: a jump of it is seen by the energy
    watched = ~shaping & [whole.effects[q.effect].kind != OutputOffset.name for q in whole.parameters]
    return Numbers(whole, theta, free, _root_of(P[np.ix_(free, free)], 1e-6), np.flatnonzero(watched))


@dataclass(frozen=True, slots=True, eq=False)
class Healthy:
    """Findings of the learning phase.

    Attributes
    ----------
    theta : ndarray, shape (p,)
        Coefficients of the model.
    root : ndarray, shape (p, f)
        Root of their covariance, zero for those that are known exactly.
    gain : ndarray, shape (n, n_y)
        Gain of the observer.
    ratio : float
        Unknown force over the measured one to which it belongs.
    x0 : ndarray, shape (n,)
        State before the first sample.
    filters : ndarray, shape (n_y, q + 1)
        Whitening polynomials, padded with zeros.
    scales : ndarray, shape (n_y,)
        Standard deviations of the whitened innovations.
    law : ndarray, shape (n_y, 3)
        Their variance, relative: a constant, a share of the squared prediction, and of the mean of that.
    middle, power : ndarray, shape (n_y,)
        Mean and mean square of the predictions.
    spread : float
        Standard deviation of the clipped squares.
    energy : ndarray, shape (M,)
        Levels of the energy in each window.
    settle : int
        Samples after which the observer has forgotten a wrong state.
    """

    theta: Annotated[Array, "p"]
    root: Annotated[Array, "p f"]
    gain: Annotated[Array, "n ny"]
    ratio: float
    x0: Annotated[Array, "n"]
    filters: Annotated[Array, "ny q"]
    scales: Annotated[Array, "ny", _TINY, math.inf]
    law: Annotated[Array, "ny 3", 0.0, math.inf]
    middle: Annotated[Array, "ny"]
    power: Annotated[Array, "ny", 0.0, math.inf]
    spread: Annotated[float, "", _TINY, math.inf]
    energy: Annotated[Array, "m", 0.0, math.inf]
    settle: Annotated[int, "", 1, 2**53]

    @property
    def orders(self) -> tuple[int, ...]:
        """Order of the whitening filter of each output."""
        return tuple(int(np.flatnonzero(a)[-1]) for a in self.filters)

    def scale(self, outputs: Array, power: Array) -> Array:
        """Return by how much the noise is larger at each sample, (N, n_y)."""
        square = (outputs - self.middle) ** 2
        return np.sqrt(relative_variance(self.law, square, power))


def relative_variance(law: Array, square: Array, power: Array) -> Array:
    """Return the variance of each sample by the noise law, (N, n_y)."""
    grown = law[:, 0] + law[:, 1] * square + law[:, 2] * power
    # never far below that of the samples around it
    return np.maximum(grown, _EVEN * (law[:, 0] + (law[:, 1] + law[:, 2]) * power))


@dataclass(frozen=True, eq=False)
class WatchedModel:
    """The healthy model and its windows.

    This is all that does not change with the samples.

    Attributes
    ----------
    base : Base
        Model as given.
    numbers : Numbers
        Its parameters as coefficients.
    healthy : Healthy
        What the learning phase found.
    candidates : tuple of Effect
        What may come.
    period : int
        Samples in a period of the first mode.
    false_alarms : float
        Per 100 000 samples.
    learn : int
        Samples of the learning phase.
    """

    base: Base
    numbers: Numbers
    healthy: Healthy
    candidates: tuple[Effect, ...]
    period: int
    false_alarms: float
    learn: int

    @property
    def substeps(self) -> int:
        """Substeps per sample."""
        return _substeps(self.base, self.numbers)

    @cached_property
    def model(self) -> Discretized:
        """Model as the march takes it, with derivatives."""
        step = self.base.dt / self.substeps
        return setting(self.numbers.structure, self.healthy.theta, step, True).model

    @property
    def block(self) -> int:
        """Samples in a block."""
        return block_of(self.period)

    @cached_property
    def keep(self) -> Array:
        """Share of its sum that each window keeps per sample, (M,)."""
        return keep_of(self.period)

    @cached_property
    def levels(self) -> Array:
        """Threshold of each window and column, (M, k), the energy last."""
        k = self.numbers.columns.size + 1
        levels = np.repeat(thresholds(self.false_alarms / PER, self.keep, k)[:, None], k, axis=1)
        levels[:, -1] = self.healthy.energy
        levels[1 / (1 - self.keep) > _ENERGY * self.period, -1] = np.inf
        return levels

    @cached_property
    def filters(self) -> Array:
        """Whitening polynomials with a zero for the mean, (n_y, q + 1)."""
        # (1 - z^-1) / (1 - (1 - f) z^-1) takes the mean of 1 / f samples off, a(z) whitens
        h = self.healthy
        return np.array([np.convolve(a, [1.0, -1.0]) for a in h.filters]) / h.scales[:, None]

    @cached_property
    def seen_in(self) -> NDArray[np.intp]:
        """Column of the scores in which each candidate is seen; -1 is the energy."""
        s, columns = self.numbers.structure, self.numbers.columns
        effects = [s.effects[s.parameters[i].effect] for i in columns]
        places = {(effect.kind, effect.place): k for k, effect in enumerate(effects)}
        found = [places.get((e.kind, e.place), -1) if len(e.free) == 1 else -1 for e in self.candidates]
        return np.array(found, dtype=np.intp)

    @cached_property
    def squares(self) -> Array:
        """Squares of the thresholds, (M, k)."""
        return np.asarray(self.levels**2)

    @cached_property
    def fade(self) -> tuple[Array, Array]:
        """Weights of the samples of a block in each window, and squared."""
        back = np.arange(self.block)[::-1]
        return self.keep[:, None] ** back, self.keep[:, None] ** (2 * back)

    @cached_property
    def lag(self) -> int:
        """Samples before a block that its delayed inputs need."""
        s = self.base.structure
        found = 0.0
        for i, _ in s.input_statics:
            spec = s.effects[i].spec
            if spec.delays:
                found += float(s.value(self.base.theta, i, s.effects[i].coefficients[0]))
        return 1 + (math.ceil(found / self.base.dt) + 2 if found else 0)

    @cached_property
    def error_steps(self) -> tuple[Array, Array]:
        """Transition of the state over a sample, and the output matrix."""
        return transition(self.numbers.structure, self.healthy.theta, self.base.dt)

    def stretch(self, block: Block, x0: Array, scale: Array, *, known_start: bool) -> Stretch:
        """Samples as `fit_block` takes them."""
        b, h, use = self.base, self.healthy, block.use > 0
        data = block_of_stream(block.inputs.T, block.outputs.T, b.dt, b.hold)
        whitener = Whitener(tuple(a[: q + 1] for a, q in zip(h.filters, h.orders, strict=True)), h.scales)
        whiten = Whitening(whitener, use.T, scale.T)
        return Stretch(data, use, whiten, x0, known_start, h.gain, self.substeps)


def block_of(period: int) -> int:
    """Samples in a block: an eighth of a period."""
    return max(8, period // 8)


def keep_of(period: int) -> Array:
    """Windows, doubled from a quarter of a period to 200 periods."""
    shortest = max(8, period // 4)
    lengths = shortest * 2.0 ** np.arange(round(math.log2(200 * period / shortest)) + 1)
    return np.asarray(1.0 - 1.0 / lengths)


def transition(structure: Structure, theta: Array, dt: float) -> tuple[Array, Array]:
    """Transition of the state over a sample, and the output matrix.

    The shapes are (n, n) and (n_y, n).
    """
    n = structure.n_states
    Phi = structure.discretize(theta, dt, derivatives=False).M[0, -n:, :n] if n else np.zeros((0, 0))
    return Phi, structure.matrices(theta).C.astype(float)


# ------------------------------------------------------------------------ learning
def learn(
    base: Base, candidates: tuple[Effect, ...], period: int, false_alarms: float, block: Block
) -> WatchedModel:
    """Learn parameters, offsets, observer and noise of healthy samples.

    Raises
    ------
    DataError
        If the samples do not determine them.
    """
    numbers, use = numbers_of(base), block.use > 0
    _check_outputs(block, numbers.structure.linear_model.output_labels)
    # noise and parameters in turn; samples that stand out alone are left out
    theta, prior = numbers.theta.copy(), (numbers.theta[numbers.free], numbers.root)
    for _ in range(3):
        data = _whole(base, block, use)
        found = _likeliest_observer(base, numbers, theta, data, use, period)
        sound = use & ~found.outliers
        if (sound == use).all() or sound.all(axis=1).mean() < 0.9:
            break
        use = sound
    stretch = Stretch(data, use, found.whiten, found.x0, False, found.gain, _substeps(base, numbers))
    loose = np.union1d(numbers.free, numbers.offsets)
    for again in (True, False):
        mean, root = _with_offsets(numbers, loose, prior, data)
        fit = fit_block(numbers.structure, stretch, found.theta, free=loose, prior=(mean, root))
        if not math.isfinite(fit.cost):
            break
        theta = fit.theta
        if again:
            found = _likeliest_observer(base, numbers, theta, data, use, period, found.ratio)
            stretch = Stretch(data, use, found.whiten, found.x0, False, found.gain, _substeps(base, numbers))
    wide = np.zeros((theta.size, loose.size))
    wide[loose] = _root_of(fit.covariance)
    # clipped squares of the healthy innovations give the levels of the energy
    r = np.clip(found.whiten(fit.outputs - data.outputs), -CLIP, CLIP)
    power, keep = r**2, keep_of(period)
    usual = thresholds(false_alarms / PER, keep, numbers.columns.size + 1)
    most = 1 / (1 - keep) <= _ENERGY * period
    energy = np.where(most, 0.0, usual)
    energy[most] = energy_levels(usual[most], keep[most], power, use.shape[1])
    slowest = radius(base, numbers, theta, found.gain)
    settle = math.ceil(math.log(0.01) / math.log(slowest)) if 0 < slowest < 1 else 1
    whitener, ny = found.whiten.whitener, use.shape[1]
    filters = np.zeros((ny, 1 + max(whitener.orders)))
    for i, a in enumerate(whitener.filters):
        filters[i, : a.size] = a
    healthy = Healthy(
        theta, wide, found.gain, found.ratio, fit.x0, filters, whitener.scales, found.law, found.middle,
        found.power, max(float(power.std()), _TINY), energy, settle,
    )  # fmt: skip
    return WatchedModel(base, numbers, healthy, candidates, period, false_alarms, len(block.inputs))


def _substeps(base: Base, numbers: Numbers) -> int:
    return max(base.substeps, 1 if numbers.structure.is_linear else 2)


def _with_offsets(
    numbers: Numbers, loose: NDArray[np.intp], prior: tuple[Array, Array], data: Measurement
) -> tuple[Array, Array]:
    """Return the prior of the parameters with that of the offsets.

    The latter is as good as none.
    """
    root, inside = np.zeros((loose.size, loose.size)), np.isin(loose, numbers.free)
    root[np.ix_(inside, inside)] = prior[1]
    size = 1e3 * (np.abs(data.outputs).max(axis=1) + _TINY)
    wide = [size[i % size.size] for i in range(int((~inside).sum()))]
    root[~inside, np.flatnonzero(~inside)] = wide
    return numbers.theta[loose], root


def _root_of(P: Array, least: float = 0.0) -> Array:
    """Return a root of a covariance by that of its correlation.

    Units may differ by decades.
    """
    size = np.sqrt(np.maximum(np.diag(P), _TINY))
    values, vectors = np.linalg.eigh(P / np.outer(size, size))
    return np.asarray(size[:, None] * vectors * np.sqrt(np.maximum(values, least)))


def _check_outputs(block: Block, labels: Any) -> None:
    """Refuse a learning phase with a missing signal or a constant output."""
    if not block.known.all():
        raise DataError(
            f"an input is missing at sample {int(np.argmin(block.known))}, in the learning phase of "
            f"{len(block.inputs)} samples; start the stream where the inputs are whole"
        )
    for label, y, there in zip(labels, block.outputs.T, block.use.T > 0, strict=True):
        if there.mean() < 1 - _MOST_MISSING:
            raise DataError(
                f"output {label!r} is missing in {100 * (1 - there.mean()):.0f} % of the learning phase "
                f"({there.size} samples); learn from a whole stretch, or leave it out of the model"
            )
        if np.ptp(y[there]) == 0:
            raise DataError(f"output {label!r} is constant over the learning phase; check the sensor")


def _whole(base: Base, block: Block, use: NDArray[np.bool_]) -> Measurement:
    """Samples with the mean where none counts."""
    mean = np.sum(np.where(use, block.outputs, 0.0), axis=0) / use.sum(axis=0)
    y = np.where(use, block.outputs, mean)
    return block_of_stream(block.inputs.T, y.T, base.dt, base.hold)


def radius(base: Base, numbers: Numbers, theta: Array, gain: Array) -> float:
    """Return the spectral radius of the error of the observer, Phi (I - K C)."""
    Phi, C = transition(numbers.structure, theta, base.dt)
    closed = Phi - Phi @ gain @ C
    return float(np.abs(np.linalg.eigvals(closed)).max(initial=0.0)) if np.isfinite(closed).all() else np.inf


class _Observer(NamedTuple):
    """An observer, its noise, and how likely both are."""

    score: float
    ratio: float
    gain: Array
    theta: Array
    x0: Array
    whiten: Whitening
    law: Array
    middle: Array
    power: Array
    outliers: NDArray[np.bool_]


def _likeliest_observer(
    base: Base, numbers: Numbers, theta: Array, data: Measurement, use: NDArray[np.bool_], period: int,
    most: float = math.inf,
) -> _Observer:  # fmt: skip
    """Return the likeliest observer.

    It has the smallest gain that the likelihood does not clearly reject.
    """
    best: _Observer | None = None
    ratios = [ratio for ratio in RATIOS if ratio <= max(most, RATIOS[1])]
    for near in (2.0, math.sqrt(2.0), 1.0):  # a coarse grid, then finer ones around its best
        for ratio in ratios:
            found = _evaluate(base, numbers, theta, data, use, period, ratio)
            if found is not None and (best is None or found.score < best.score - _WORTH):
                best = found
        if best is None or not best.ratio:
            break
        ratios = [best.ratio / near, best.ratio * near]
    if best is None:
        raise DataError(
            "no observer of the healthy model follows the learning phase; check model, units and channels "
            "with compare(), or refine the model first"
        )
    return best


def _evaluate(
    base: Base, numbers: Numbers, theta: Array, data: Measurement, use: NDArray[np.bool_], period: int,
    ratio: float,
) -> _Observer | None:  # fmt: skip
    """Fit offsets and initial state with an observer, and its noise."""
    s = numbers.structure
    gain = observer_gain(s, theta, data, ratio, at="inputs") if ratio else np.zeros((s.n_states, s.n_outputs))
    if not np.isfinite(gain).all() or radius(base, numbers, theta, gain) > FREE:
        return None  # what was once wrong about the state would stay wrong
    size = np.array([y[there].std() for y, there in zip(data.outputs, use.T, strict=True)])
    plain = Whitening(Whitener(tuple(np.ones(1) for _ in size), size), use.T, np.ones(use.T.shape))
    stretch = Stretch(data, use, plain, np.zeros(s.n_states), False, gain, _substeps(base, numbers))
    fit = fit_block(s, stretch, theta, free=numbers.offsets, evaluations=4)
    if not math.isfinite(fit.cost):
        return None
    left = np.where(use.T, data.outputs - fit.outputs, 0.0)
    # rounding has no color to learn
    color = np.sqrt(np.mean(left**2, axis=1)) > 100 * _ROUNDING * size
    whitener = Whitener.fit([left], order=None if color.any() else 0, floor=_ROUNDING * size)
    # noise that grows with the signal: its square now, and the mean of that over a period
    outputs = fit.outputs.T
    middle = outputs.mean(axis=0)
    square = (outputs - middle) ** 2
    power = square.mean(axis=0)
    local = power + lfilter([1 / period], [1.0, 1 / period - 1], square - power, axis=0)
    law, score = np.zeros((len(size), 3)), 0.0
    outliers = np.zeros(use.shape, dtype=bool)
    for i, a in enumerate(whitener.filters):
        white = innovations(a, left[i]) / whitener.scales[i]
        usual = np.median(np.abs(white[use[:, i]])) / norm.ppf(0.75)
        outliers[:, i] = use[:, i] & (np.abs(white) > _OUTLIER * usual) if color.any() else False
        sizes = np.column_stack([np.ones(len(use)), square[:, i], local[:, i]])[use[:, i]]
        law[i] = noise_law(white[use[:, i]], sizes)
        variance = relative_variance(law[[i]], sizes[:, 1:2], sizes[:, 2:])[:, 0]
        score += float(np.sum(0.5 * np.log(variance) + math.log(whitener.scales[i])))
        score += 0.5 * math.log(len(use)) * (a.size - 1)
    scale = np.sqrt(relative_variance(law, square, local))
    whiten = Whitening(whitener, use.T, scale.T)
    return _Observer(score, ratio, gain, fit.theta, fit.x0, whiten, law, middle, power, outliers)


def noise_law(white: Array, sizes: Array) -> Array:
    """Fit the variance of a signal as a sum of nonnegative terms.

    Parameters
    ----------
    white : ndarray, shape (N,)
        Signal.
    sizes : ndarray, shape (N, 3)
        Ones, the square of what the variance may grow with, and the mean of that around.

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
    >>> print(noise_law(e, np.column_stack([np.ones(20000), level, np.ones(20000)])).round(1))
    [1. 4. 0.]
    """
    mean = max(float(np.mean(white**2)), _TINY)
    best, found = math.inf, np.zeros(3)
    for used in (1, 2, 3):
        law = np.array([mean, 0.0, 0.0])
        for _ in range(5):  # reweighted nonnegative least squares
            variance = relative_variance(law[None], sizes[:, 1:2], sizes[:, 2:])[:, 0]
            square = np.minimum(white**2, CLIP**2 * variance) / MEAN_SQUARE
            scaled = sizes[:, :used] / variance[:, None]
            unit = np.maximum(np.linalg.norm(scaled, axis=0), _TINY)
            law[:used] = nnls(scaled / unit, square / variance)[0] / unit
            law[0] = max(law[0], 1e-2 * mean)  # a signal that rests tells nothing of the noise there
        variance = relative_variance(law[None], sizes[:, 1:2], sizes[:, 2:])[:, 0]
        cost = 0.5 * float(np.sum(np.log(variance) + np.minimum(white**2 / variance, CLIP**2)))
        if cost < best - _WORTH:
            best, found = cost, law
    return found


# ------------------------------------------------------------------------ the state
class State(NamedTuple):
    """All that changes with the samples.

    Attributes
    ----------
    blocks : int
        Number of blocks taken.
    x, z, S : ndarray, shape (n,), (m,), (p, n)
        State of the observer, inner states of laws, derivatives of the state.
    before : ndarray, shape (lag, n_w)
        Last inputs.
    past : ndarray, shape (q + 1, n_y, 1 + p)
        Memory of the whitening filters.
    used : ndarray, shape (q, n_y)
        Whether the last outputs were.
    doubt : ndarray, shape (n, n)
        Covariance by which the state is less sure than without gaps.
    lost : int
        Sample at which a missing input left the state unknown, -1 if none.
    power, level : ndarray, shape (n_y,)
        Mean square of the predictions over a period; variance of the noise over the learned one.
    N, V, shared, scatter : ndarray, shape (M, k), (M, k), (M, k, f), (M, k)
        Scores, their variances, products with the uncertain parameters, mean squares of statistics.
    sums : ndarray, shape (R, 2, k)
        Scores and variances of the last blocks.
    ring_w, ring_y, ring_use, ring_scale, ring_x : ndarray, shape (R, B, .), the last (R, n)
        Samples of these blocks, whether they count (2: set aside), their noise; state before them.
    """

    blocks: int
    x: Array
    z: Array
    S: Array
    before: Array
    past: Array
    used: Flags
    doubt: Array
    lost: int
    power: Array
    level: Array
    N: Array
    V: Array
    shared: Array
    scatter: Array
    sums: Array
    ring_w: Array
    ring_y: Array
    ring_use: Flags
    ring_scale: Array
    ring_x: Array


def begin(watched: WatchedModel) -> State:
    """State before the first sample."""
    s, h = watched.numbers.structure, watched.healthy
    n, ny, nw, p = s.n_states, s.n_outputs, s.n_inputs, s.n_parameters
    q, M, k, B = h.filters.shape[1], watched.keep.size, watched.numbers.columns.size + 1, watched.block
    flags = np.uint8
    return State(
        0, h.x0.copy(), np.zeros(s.n_ports + ny * s.remembers), np.zeros((p, n)), np.zeros((0, nw)),
        np.zeros((q, ny, 1 + p)), np.zeros((q - 1, ny), flags), np.zeros((n, n)), -1,
        h.power.copy(), np.ones(ny), np.zeros((M, k)), np.zeros((M, k)), np.zeros((M, k, h.root.shape[1])),
        np.ones((M, k)), np.zeros((BLOCKS, 2, k)), np.zeros((BLOCKS, B, nw)), np.zeros((BLOCKS, B, ny)),
        np.zeros((BLOCKS, B, ny), flags), np.ones((BLOCKS, B, ny)), np.zeros((BLOCKS, n)),
    )  # fmt: skip


def _observe(watched: WatchedModel, state: State, block: Block) -> tuple[Array, Array, State]:
    """Advance the observer over a block.

    Return outputs (B, n_y), their derivatives (B, n_y, p), and the state.
    """
    s, b, K = watched.numbers.structure, watched.base, len(state.before)
    # the input before the block begins its first step, those before that a delay brings in
    rows, first = np.concatenate([state.before, block.inputs]), max(K - 1, 0)
    drive = InputSignal(np.ascontiguousarray(rows.T), b.dt, b.hold, watched.substeps).drive(
        s, watched.healthy.theta
    )
    if first:
        skip = first * watched.substeps * max(drive.course, 1)
        found = drive.W[skip:], drive.Wout[first:], drive.dW[:, skip:], drive.dWout[:, first:]
        W, Wout, dW, dWout = map(np.ascontiguousarray, found)
        drive = drive._replace(W=W, Wout=Wout, dW=dW, dWout=dWout)
    lead, N, ny = K - first, len(rows) - first, s.n_outputs
    measured, flags = np.zeros((N, ny)), np.zeros((N, ny), dtype=np.uint8)
    measured[lead:], flags[lead:] = block.outputs, block.use
    x, z, S = state.x.copy(), state.z.copy(), state.S.copy()
    limit = 1e12 * (1.0 + float(np.abs(x).max(initial=0.0) + np.abs(measured).max() + np.abs(rows).max()))
    into = MarchResult(
        np.full((N, ny), np.nan), np.zeros((N, ny, len(S))), np.zeros((0, x.size)), np.zeros((0, s.n_forces)),
        np.full(ny, np.inf), limit, watched.substeps,
    )  # fmt: skip
    gain = np.ascontiguousarray(watched.healthy.gain)
    blew_up = march(
        watched.model, drive, Corrections(measured, flags, gain, np.zeros((0, 0))), MarchState(x, z, S), into
    )
    raise_pending()
    if blew_up >= 0:
        raise DivergenceError(
            "the observer of the healthy model left all bounds at sample "
            f"{state.blocks * watched.block + blew_up - lead}; check the model and the units of the samples"
        )
    after = state._replace(x=x, z=z, S=S, before=rows[-watched.lag :].copy())
    return into.outputs[lead:], into.sensitivity[lead:], after


def _whitened(watched: WatchedModel, state: State, e: Array, use: NDArray[np.bool_]) -> tuple[Array, Array]:
    """Whiten innovations (B, n_y, 1 + p), a slow mean taken off.

    The memory of the filters follows.
    """
    fading = 1 / (_SLOW * watched.period)
    white, past = np.zeros_like(e), state.past.copy()
    for i, (numerator, there) in enumerate(zip(watched.filters, use.T, strict=True)):
        # over a gap the filter rests: the mean goes on behind it
        white[there, i], past[:, i] = lfilter(
            numerator, [1.0, fading - 1.0], e[there, i], axis=0, zi=past[:, i]
        )
    return white, past


def _calm(watched: WatchedModel, state: State, block: Block) -> tuple[NDArray[np.bool_], Array, int]:
    """Return which samples (B, n_y) count after gaps.

    The doubt of the state follows, and since when it is lost.

    The error of the state goes on as x = Phi (I - K C) x; a correction that is missing leaves it without the
    noise that K would bring in, and with what K would have taken off.
    """
    h, use, q = watched.healthy, block.use, len(state.used)
    calm, there = use > 0, bool(use.all() and block.known.all())
    if there and state.lost < 0 and state.used.all() and not state.doubt.any():
        return calm, state.doubt, -1
    past = np.concatenate([state.used, use])
    for i, order in enumerate(h.orders):  # the filters need a whole past
        calm[:, i] &= sliding_window_view(past[q - order :, i] > 0, order + 1).all(axis=1)
    D, lost, first = state.doubt, state.lost, state.blocks * watched.block
    if not there or D.any() or lost >= 0:
        Phi, C = watched.error_steps
        noise = h.scales**2 * state.level
        whole = np.eye(len(Phi))
        for i in range(len(use)):
            seen = np.sqrt(np.sum((C @ D) * C, axis=1))
            if not block.known[i]:
                lost = first + i
            calm[i] &= (seen**2 <= _SURE * noise) & (lost < 0)
            K = h.gain * use[i]
            missed = Phi @ (h.gain - K) * np.sqrt(noise)
            step = Phi @ (whole - K @ C)
            D = step @ D @ step.T + missed @ missed.T
        if np.trace(C @ D @ C.T / noise) < 1e-3 * _SURE:
            D = np.zeros_like(D)
    return calm, D, lost


def advance(watched: WatchedModel, state: State, block: Block, healthy: bool) -> tuple[State, float]:
    """Take a block.

    Parameters
    ----------
    watched : WatchedModel
        Healthy model and windows.
    state : State
        Before; left as it is.
    block : Block
        Samples.
    healthy : bool
        Whether nothing is wrong: only then the level of the noise and the scatter of statistics are followed.

    Returns
    -------
    state : State
        After the block.
    ratio : float
        Largest statistic over its threshold.
    """
    h, B, use = watched.healthy, watched.block, block.use.copy()
    # up to three samples that stand out alone are set aside, and do not correct the state
    for count in range(_ALONE + 2):
        outputs, S, after = _observe(watched, state, block._replace(use=(use == 1).astype(np.uint8)))
        e = np.concatenate([(block.outputs - outputs)[:, :, None], S], axis=2)
        white, past = _whitened(watched, state, e, use == 1)
        square, slow = (outputs - h.middle) ** 2, 1 / watched.period
        local, _ = lfilter([slow], [1.0, slow - 1], square, axis=0, zi=(1 - slow) * state.power[None])
        scale = h.scale(outputs, local)
        r = white[:, :, 0] / (scale * np.sqrt(state.level))
        out = (np.abs(r) > _OUTLIER) & (use == 1)
        if not out.any():
            break
        if count == _ALONE:  # that many do not stand alone
            use = block.use.copy()
            continue
        if count > _ALONE:
            break
        use[np.unravel_index(int(np.argmax(out)), out.shape)] = 2
    calm, doubt, lost = _calm(watched, state, block._replace(use=(use == 1).astype(np.uint8)))
    white /= (scale * np.sqrt(state.level))[:, :, None]
    scores = _scores(watched, white, calm)
    fade = watched.keep[:, None] ** B
    N = fade * state.N + watched.fade[0] @ scores.score
    V = fade**2 * state.V + watched.fade[1] @ scores.info
    shared = fade[:, :, None] * state.shared + np.tensordot(watched.fade[0], scores.shared, 1)
    last = np.concatenate([state.used, (use == 1).astype(np.uint8)])[len(use) :]
    after = after._replace(
        blocks=state.blocks + 1, past=past, used=last,
        doubt=doubt, lost=lost, power=local[-1], N=N, V=V, shared=shared,
        sums=_pushed(state.sums, np.array([scores.score.sum(axis=0), scores.info.sum(axis=0)])),
        ring_w=_pushed(state.ring_w, block.inputs), ring_y=_pushed(state.ring_y, block.outputs),
        ring_use=_pushed(state.ring_use, use), ring_x=_pushed(state.ring_x, state.x),
        ring_scale=_pushed(state.ring_scale, scale * np.sqrt(state.level)),
    )  # fmt: skip
    square = statistics(watched, after)
    ratio = float(np.sqrt((square / watched.squares).max(initial=0.0)))
    if not math.isfinite(ratio):
        raise DivergenceError(
            f"the statistic at sample {state.blocks * B} is not a number; check the samples before it, then "
            "reset()"
        )
    if healthy and ratio <= 1.0:
        after = _followed(watched, after, scores.power, calm, square)
    return after, ratio


def _pushed(ring: Any, new: Any) -> Any:
    """Return a ring with a new entry behind, without its first one."""
    return np.concatenate([ring[1:], new[None]])


class _Scores(NamedTuple):
    """Scores of a block.

    Scores (B, k), variances (B, k), products with doubts (B, k, f), clipped squares (B, n_y).
    """

    score: Array
    info: Array
    shared: Array
    power: Array


def _scores(watched: WatchedModel, white: Array, calm: NDArray[np.bool_]) -> _Scores:
    """Multiply what a block left with its derivatives, and judge its energy."""
    h = watched.healthy
    white = white * calm[:, :, None]
    r, s = np.clip(white[:, :, 0], -CLIP, CLIP), white[:, :, 1:]
    doubt = s @ h.root
    # the uncertain parameters widen the innovations: only what exceeds that is energy
    power = np.minimum(white[:, :, 0] ** 2 / (1 + np.sum(doubt**2, axis=2)), CLIP**2)
    energy = (calm * (power - MEAN_SQUARE)).sum(axis=1) / h.spread
    seen = s[:, :, watched.numbers.columns]
    B, k = len(r), seen.shape[2] + 1  # the last column is the energy
    score, info, shared = np.empty((B, k)), np.empty((B, k)), np.zeros((B, k, doubt.shape[2]))
    score[:, :-1], score[:, -1] = np.einsum("bi,bik->bk", r, seen), energy
    info[:, :-1], info[:, -1] = np.einsum("bik,bik->bk", seen, seen), calm.sum(axis=1)
    shared[:, :-1] = np.matmul(seen.transpose(0, 2, 1), doubt)
    return _Scores(score, info, shared, power)


def variances(watched: WatchedModel, state: State) -> Array:
    """Return the variance of the scores by chance, (M, k).

    It is inf where nothing is seen.
    """
    wide = state.V + np.sum(state.shared**2, axis=2)
    # the level of the noise is known from so many samples: it moves all squares of a window alike
    weight = watched.healthy.middle.size / (1 - watched.keep) ** 2
    wide[:, -1] += weight / min(watched.learn, 2 * _MEMORY)
    wide = wide * np.maximum(state.scatter, 1.0)
    return np.where(wide <= 1e-200, np.inf, wide)


def statistics(watched: WatchedModel, state: State) -> Array:
    """Return the squared statistics, (M, k).

    Less energy than usual is no change.
    """
    N, energy = state.N.copy(), state.N[:, -1]
    # its level is that of a full window
    full = state.V[:, -1] > 0.5 * watched.healthy.middle.size / (1 - watched.keep**2)
    N[:, -1] = np.where(full, np.maximum(energy, 0.0), 0.0)
    return N**2 / variances(watched, state)


def _followed(
    watched: WatchedModel, state: State, power: Array, calm: NDArray[np.bool_], square: Array
) -> State:
    """Follow the level of the noise, and the scatter of the statistics."""
    seen = calm.sum(axis=0)
    mean = np.sum(power * calm, axis=0) / np.maximum(seen, 1) / MEAN_SQUARE
    level = state.level + (mean - 1) * state.level * seen / _MEMORY
    few = np.minimum((1 - watched.keep)[:, None] * watched.block / _CALIBRATE, 0.1) * calm.any()
    whole = np.minimum(square * np.maximum(state.scatter, 1.0), CLIP**2)
    return state._replace(
        level=np.maximum(level, _LEAST), scatter=state.scatter + few * (whole - state.scatter)
    )


def found_anew(watched: WatchedModel, state: State) -> State:
    """Find the state again some time after an input was missing.

    The samples since then determine it with all parameters held.
    """
    h, B = watched.healthy, watched.block
    wait = max(min(h.settle, 8 * watched.period), 4 * (h.x0.size + len(state.past)))
    if state.lost < 0 or state.blocks * B < state.lost + wait:
        return state
    first = state.lost // B + 1
    blocks = min(state.blocks - first, BLOCKS)
    part = recent(state, blocks)
    stretch = watched.stretch(
        part, state.ring_x[-blocks], state.ring_scale[-blocks:].reshape(len(part.use), -1), known_start=False
    )
    fit = fit_block(
        watched.numbers.structure, stretch, h.theta, free=np.zeros(0, dtype=np.intp), evaluations=4
    )
    if not math.isfinite(fit.cost):
        return state
    Phi, C = watched.error_steps
    ahead = np.linalg.matrix_power(Phi @ (np.eye(len(Phi)) - h.gain @ C), len(part.inputs) - 1)
    P = ahead @ np.where(np.isfinite(fit.doubt), fit.doubt, 0.0) @ ahead.T
    return restarted(state, fit.last)._replace(doubt=P, lost=-1)


def restarted(state: State, x: Array) -> State:
    """Go on from another state: the filters need a new past."""
    return state._replace(x=x, past=np.zeros_like(state.past), used=np.zeros_like(state.used))


def recent(state: State, blocks: int) -> Block:
    """Samples of the last blocks.

    Those that were set aside count where they turned out to be many.
    """
    rings: tuple[Any, ...] = state.ring_w, state.ring_y, state.ring_use
    w, y, use = (ring[-blocks:].reshape(-1, ring.shape[2]) for ring in rings)
    there = (use == 1) | ((use == 2) & ((use == 2).sum() > _ALONE))
    return Block(w, y, np.ones(len(w), dtype=np.uint8), there.astype(np.uint8))
