"""Time of the change, and the probability of each candidate."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from ...data.measurement import Measurement
from ...effects.effect import Effect
from ...inference.starts import Motion
from ...systems.linear import Array
from .alarm import MonitorRow
from .isolation import Fit, Segment, fit_candidate
from .stream import Stream

__all__ = [
    "change_of", "find_state", "fit_all", "fit_one", "idle_remarks", "linear_estimates", "linear_rows",
    "shares", "standing",
]  # fmt: skip

_SHORTLIST = 10
_LEADERS = 3  # candidates with which the time of the change is settled
_MOVES = 4
_PLACES = 3  # leading fits whose places are searched through
_HOPELESS = 100.0  # sum of squares by which a fit may lie behind before it is given up


def standing(stream: Stream) -> tuple[float, Array]:
    """Return the largest statistic over its threshold, and all gains.

    A gain says by how much a candidate's log-likelihood exceeds the threshold.

    Returns
    -------
    ratio : float
        Largest windowed score over its threshold.
    gain : ndarray, shape (n_candidates,)
        Half of (squared score - squared threshold), the best of each candidate's
        columns and windows; 0 at the threshold.
    """
    levels = stream.windows.levels**2
    square = stream.memory["N"] ** 2 / stream.variances()
    ratio = float(np.sqrt((square / levels[:, None]).max(initial=0.0)))
    best = (0.5 * (square - levels[:, None])).max(axis=0)
    return ratio, _by_candidate(stream, best)


def _by_candidate(stream: Stream, values: Array) -> Array:
    gain = np.full(len(stream.bank.candidates), -np.inf)
    np.maximum.at(gain, stream.bank.owner[: values.size], values)
    return gain


def shares(change: float, gains: Array) -> Array:
    """Return the probabilities of no change and of each candidate.

    The prior probabilities of the candidates are equal.

    Parameters
    ----------
    change : float
        Log-likelihood ratio of a change, 0 at the threshold.
    gains : ndarray, shape (n_candidates,)
        Log-likelihoods of the candidates, up to a constant.

    Returns
    -------
    ndarray, shape (1 + n_candidates,)
    """
    something = 1.0 / (1.0 + math.exp(-min(max(change, -700.0), 700.0)))
    weight = np.exp(gains - gains.max())
    return np.concatenate([[1.0 - something], something * weight / weight.sum()])


def change_of(stream: Stream) -> tuple[int, Array]:
    """Return the sample of the change, and the gain of each column since.

    The change that makes the likelihood of one candidate largest, among the starts of the
    blocks that are kept.
    """
    starts, sums = stream.block_sums()
    N, V = np.cumsum(sums[0][::-1], axis=0)[::-1], np.cumsum(sums[1][::-1], axis=0)[::-1]
    factor = stream.memory["factor"].min(axis=0)
    gain = 0.5 * N**2 / np.where(V > 1e-200, V * factor, np.inf)
    block = int(np.argmax(gain.max(axis=1)))
    since = int(starts[block])
    if block > 0:  # a block in which part of the samples were sound pulls the start a block too far
        since = max(since - stream.windows.block, int(starts[0]))
    return since, gain[block]


def linear_estimates(stream: Stream, since: int) -> tuple[Array, Array, Array]:
    """Return linearized estimates of each column since a sample.

    They are coefficient, standard deviation and gain.
    """
    starts, sums = stream.block_sums()
    recent = starts + stream.windows.block > since
    N, V = sums[0][recent].sum(axis=0), sums[1][recent].sum(axis=0)
    safe = np.where(V > 1e-200, V, np.inf)
    scale = stream.bank.scale[: stream.bank.watched]
    return N / safe * scale, scale / np.sqrt(safe), 0.5 * N**2 / safe


def linear_rows(stream: Stream) -> list[MonitorRow]:
    """Ranking from the windows alone, linearized: while no alarm is on."""
    _, gains = standing(stream)
    p = shares(float(gains.max()), gains)[1:]
    mem, keep = stream.memory, stream.windows.keep[:, None]
    V = np.where(mem["V"] > 1e-200, mem["V"], np.inf)
    levels = stream.windows.levels[:, None] ** 2
    wide = stream.variances()
    square = mem["N"] ** 2 / wide
    rows = []
    for i, effect in enumerate(stream.bank.candidates):
        own = np.flatnonzero(stream.bank.owner == i)
        m, c = np.unravel_index(int(np.argmax((square - levels)[:, own])), (keep.size, own.size))
        j = own[c]
        scale = stream.bank.scale[j] / (1.0 + float(keep[m, 0]))  # forgetting sums s^2 once, not twice
        name = stream.bank.names[j]
        value = scale * mem["N"][m, j] / V[m, j]
        std = scale * np.sqrt(wide[m, j]) / V[m, j] if np.isfinite(V[m, j]) else np.inf
        rows.append(
            MonitorRow(
                effect,
                {name: float(value)},
                {name: float(std)},
                float(p[i]),
                float(0.5 * square[m, j]),
                False,
            )
        )
    return sorted(rows, key=lambda row: (-row.probability, -row.log_likelihood))


def idle_remarks(stream: Stream) -> tuple[str, ...]:
    """Candidates that are not watched for, in words."""
    owner, effects = stream.bank.owner, stream.bank.candidates
    idle = [e.label for i, e in enumerate(effects) if not stream.bank.scale[owner == i].any()]
    return (f"Not monitored, because the needed motion is missing: {', '.join(idle)}.",) if idle else ()


def segment_of(stream: Stream, start: int, free_state: bool, mean: Array) -> Segment:
    """Samples from `start` on as the fit needs them."""
    W, Y, use, scale, x0 = stream.recent(start)
    observer, healthy = stream.observer, stream.healthy
    data = Measurement(W.T, (Y - mean).T, dt=observer.dt, hold=observer.hold)
    mix = healthy.mix / np.sqrt(stream.memory["size"])[:, None]
    return Segment(
        observer.structure, observer.theta, observer.substeps, data, use, x0, observer.gain,
        healthy.filters, mix, scale, free_state,
    )  # fmt: skip


def fit_all(
    stream: Stream,
    since: int,
    mean: Array,
    before: Mapping[Effect, Array],
    *,
    latest: int | None,
    window: int,
) -> tuple[list[tuple[Fit, float]], int, float]:
    """Fit each promising candidate to the samples since the change.

    Parameters
    ----------
    stream : Stream
        The stream.
    since : int
        Sample of the change, as the bank sees it.
    mean : ndarray, shape (n_y,)
        Offset of the sensors.
    before : mapping
        Coefficients found the last time, to go on from.
    latest : int or None
        Latest sample to which the start of the change may move. None: it is past, and the
        fits take the last samples, their state before unknown.
    window : int
        How many last samples.

    Returns
    -------
    scored : list of (Fit, float)
        Fits and their gains of log-likelihood, best first.
    since : int
        Sample of the change, moved to what the best fits prefer.
    misfit : float
        Mean square of what the best fit leaves, in units of the noise.
    """
    effects = stream.bank.candidates
    estimates, _, gains = linear_estimates(stream, since)
    order = np.argsort(-_by_candidate(stream, gains))
    chosen = [int(i) for i in order[:_SHORTLIST]]
    always = (lambda effect: effect in before) if before else (lambda effect: effect.spec.may_wear)
    chosen += [int(i) for i in order[_SHORTLIST:] if always(effects[i])]

    contest = _Contest(stream, mean, latest, window, estimates)
    scored = contest.fits_from(since, chosen, before)
    # a strong change bends the linear scores: all laws at the places that lead
    leading = {fit.effect.place for fit, _ in scored[:_PLACES] if fit.effect is not None}
    others = [i for i in range(len(effects)) if effects[i].place in leading and i not in chosen]
    if others:
        scored = _best_first([*scored, *contest.fits_from(since, others, before)])
    if scored and latest is not None:
        scored, since = contest.moved(scored, since, latest)
    if not scored:
        return [], since, math.inf
    points = max(scored[0][0].points, 1)
    # what the best one leaves, where that is more than noise, weighs all of them less
    temper = max(1.0, scored[0][0].cost / points)
    fair = [
        (fit, gain / temper - 0.5 * (fit.coefficients.size - 1) * math.log(points)) for fit, gain in scored
    ]
    return _best_first(fair), since, temper


def _best_first(scored: Iterable[tuple[Fit, float]]) -> list[tuple[Fit, float]]:
    return sorted(scored, key=lambda pair: -pair[1])


@dataclass(frozen=True, slots=True, eq=False)
class _Contest:
    """Candidates fitted to the same samples.

    The fields are the arguments of `fit_all`.
    """

    stream: Stream
    mean: Array
    latest: int | None
    window: int
    estimates: Array

    def fits_from(
        self, start: int, which: Sequence[int], known: Mapping[Effect, Array]
    ) -> list[tuple[Fit, float]]:
        """Fit some candidates to the samples from `start` on.

        Return the fits and their gains, best first.
        """
        stream = self.stream
        if self.latest is None:
            first, free = max(start, stream.n_samples - self.window, stream.oldest), True
        else:
            first, free = max(start, stream.oldest), start < stream.oldest
        segment = segment_of(stream, first, free, self.mean)
        found: list[tuple[Fit, float]] = []
        if not segment.judged.any():  # a change of a moment ago: the filters have no past yet
            return found
        motion = Motion(segment.structure, segment.theta, segment.data)
        nothing = fit_candidate(segment, None, motion)
        worst = math.inf
        for i in which:
            effect = stream.bank.effects[i]
            starts = [known[effect]] if effect in known else []
            own = int(np.flatnonzero(stream.bank.owner == i)[0])
            if not starts and len(effect.free) == 1:
                starts = [np.array([self.estimates[own]])]
            fit = fit_candidate(segment, effect, motion, starts, alone=effect in known, worst=worst)
            worst = min(worst, fit.cost + _HOPELESS)
            if math.isfinite(fit.cost):
                found.append((fit, 0.5 * (nothing.cost - fit.cost)))
        return _best_first(found)

    def moved(
        self, scored: list[tuple[Fit, float]], since: int, latest: int
    ) -> tuple[list[tuple[Fit, float]], int]:
        """Move the change to the sample at which the leaders fit best.

        It may be earlier or later than the linear scores indicate.
        """
        index = {effect: i for i, effect in enumerate(self.stream.bank.candidates)}
        leaders = [index[fit.effect] for fit, _ in scored[:_LEADERS] if fit.effect is not None]
        known = {fit.effect: fit.coefficients for fit, _ in scored if fit.effect is not None}
        best = {fit.effect: (fit, gain) for fit, gain in scored}
        step = max(2 * self.stream.windows.block, 2)
        top = scored[0][1]
        for direction in (-1, 1):
            start = since
            for _ in range(_MOVES):
                start += direction * step
                if start <= self.stream.oldest or start > latest:
                    break
                trial = self.fits_from(start, leaders, known)
                for fit, gain in trial:
                    if gain > best[fit.effect][1]:
                        best[fit.effect] = fit, gain
                if not trial or trial[0][1] <= top:
                    break
                top, since = trial[0][1], start
        return _best_first(best.values()), since


def find_state(stream: Stream) -> None:
    """Find the state again after a missing input.

    A lightly damped model does not forget a wrong state.
    """
    start = max(int(stream.memory["lost"][0]), stream.oldest)
    segment = segment_of(stream, start, True, stream.memory["mean_e"])
    motion = Motion(segment.structure, segment.theta, segment.data)
    fit = fit_candidate(segment, None, motion)
    stream.found(start, fit.state, fit.doubt)


def fit_one(stream: Stream, index: int, start: int, mean: Array, before: Array) -> tuple[Fit, Fit]:
    """Fit one candidate, and no effect, to the samples from `start` on.

    The state at `start` is unknown.
    """
    segment = segment_of(stream, max(start, stream.oldest), True, mean)
    motion = Motion(segment.structure, segment.theta, segment.data)
    effect = stream.bank.effects[index]
    nothing = fit_candidate(segment, None, motion)
    starts = [before, np.where([name in effect.spec.shaping for name in effect.free], before, 0.0)]
    return fit_candidate(segment, effect, motion, starts, alone=True), nothing
