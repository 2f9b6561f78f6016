"""Decisions of the monitor: alarm, ranking, and history rows."""

from __future__ import annotations

import math
import textwrap
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from ...data.measurement import Measurement
from ...effects.effect import Effect
from ...engine.structure import Structure
from ...inference.levels import levels
from ...models.physical_model import PhysicalModel
from ...results import Row, with_error
from ...systems.linear import Array
from ..samples import Block
from .isolation import CandidateFit, Segment, fit_candidate
from .stream import Stream


@dataclass(frozen=True, slots=True)
class MonitorRow(Row):
    """One candidate of `Monitor.ranking`.

    Attributes
    ----------
    effect : Effect
        Candidate.
    coefficients : dict
        Name and estimate, in the units of the model.
    std : dict
        Standard deviations.
    probability : float
        Share among the candidates and "nothing", all of which are as likely before.
    log_likelihood : float
        Gain of log-likelihood over the healthy model, since the change.
    fitted : bool
        Whether the estimate is a nonlinear fit (after an alarm), or the linear one of the bank.
    """

    effect: Effect
    coefficients: dict[str, float]
    std: dict[str, float]
    probability: float
    log_likelihood: float
    fitted: bool


def row_of(
    effect: Effect, names: Sequence[str], values: Array, stds: Array, gain: float, fitted: bool
) -> MonitorRow:
    """Row with these estimates; its probability is not known yet."""
    found, std = (dict(zip(names, map(float, part), strict=True)) for part in (values, stds))
    return MonitorRow(effect, found, std, math.nan, float(gain), fitted)


def ranked(rows: Iterable[MonitorRow], probabilities: Array) -> list[MonitorRow]:
    """Rows with these probabilities, the most probable first."""
    shared = [replace(row, probability=float(p)) for row, p in zip(rows, probabilities, strict=True)]
    return sorted(shared, key=lambda row: (-row.probability, -row.log_likelihood))


@dataclass(frozen=True, slots=True)
class Alarm(Row):
    """A change that chance does not explain.

    Attributes
    ----------
    sample : int
        Sample at which the alarm was raised, counted from the start of the stream.
    time : float
        The same in seconds.
    crossed : float
        Time [s] at which the threshold was crossed; the alarm then waits for a clear name.
    since_sample : int
        Sample since which the structure has changed, estimated.
    since : float
        The same in seconds.
    effect : Effect
        Candidate that explains the change best.
    coefficients : dict
        Name and estimate.
    std : dict
        Standard deviations.
    probability : float
        Of this effect among all candidates, "nothing" and "none of these".
    statistic : float
        Largest windowed score, in standard deviations.
    threshold : float
        Level that it crossed.
    false_alarms : float
        Stated expected number of false alarms per 100 000 healthy samples.
    ended : float or None
        Time [s] at which the change was gone; None while it lasts.
    sentence : str
        All that in words.
    """

    sample: int
    time: float
    crossed: float
    since_sample: int
    since: float
    effect: Effect
    coefficients: dict[str, float]
    std: dict[str, float]
    probability: float
    statistic: float
    threshold: float
    false_alarms: float
    ended: float | None
    sentence: str

    def __str__(self) -> str:
        return textwrap.fill(self.sentence, 80)


Scored = list[tuple[CandidateFit, float]]  # fits and their gains of log-likelihood
_SHORTLIST = 10
_LEADERS = 5  # candidates with which the time of the change is settled, beside the best of each place
_MOVES = 4
_PLACES = 3  # leading places
_UNKNOWN = 4  # coefficients that a change of unknown form would take
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
    # squared score over its variance, for each window and column, (M, k)
    levels = stream.windows.levels**2
    square = stream.memory["N"] ** 2 / stream.variances()
    ratio = float(np.sqrt((square / levels[:, None]).max(initial=0.0)))
    best = (0.5 * (square - levels[:, None])).max(axis=0)
    return ratio, _by_candidate(stream, best)


def _by_candidate(stream: Stream, values: Array) -> Array:
    # best column of each candidate
    gain = np.full(len(stream.bank.candidates), -np.inf)
    np.maximum.at(gain, stream.bank.owner[: values.size], values)
    return gain


def shares(change: float, gains: Array, none: float = -math.inf) -> Array:
    """Return the probabilities of no change and of each candidate.

    The prior probabilities of the candidates and of "none of these" are equal. What the probabilities lack to
    one is that of none.

    Parameters
    ----------
    change : float
        Log-likelihood ratio of a change, 0 at the threshold.
    gains : ndarray, shape (n_candidates,)
        Log-likelihoods of the candidates, up to a constant.
    none : float
        That of a change that is none of the candidates.

    Returns
    -------
    ndarray, shape (1 + n_candidates,)
    """
    # probability of a change: logistic function of the log-likelihood ratio
    something = 1.0 / (1.0 + math.exp(-min(max(change, -700.0), 700.0)))
    # candidates by Bayes' rule with equal priors; "none of these" is one of them
    top = max(float(gains.max()), none)
    weight = np.exp(gains - top)
    return np.concatenate([[1.0 - something], something * weight / (weight.sum() + math.exp(none - top))])


def change_of(stream: Stream) -> tuple[int, Array]:
    """Return the sample of the change, and the gain of each column since.

    The change that makes the likelihood of one candidate largest, among the starts of the
    blocks that are kept.
    """
    # cumulative sums from the end: score and information since each block
    starts, sums = stream.block_sums()
    N, V = np.cumsum(sums[0][::-1], axis=0)[::-1], np.cumsum(sums[1][::-1], axis=0)[::-1]
    factor = stream.memory["factor"].min(axis=0)
    # generalized likelihood ratio of a change at the start of each block
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
    # blocks that reach past `since`
    starts, sums = stream.block_sums()
    recent = starts + stream.windows.block > since
    N, V = sums[0][recent].sum(axis=0), sums[1][recent].sum(axis=0)
    # one-step estimate N / V, deviation 1 / sqrt(V), gain N^2 / (2 V)
    safe = np.where(V > 1e-200, V, np.inf)
    scale = stream.bank.scale[: stream.bank.watched]
    return N / safe * scale, scale / np.sqrt(safe), 0.5 * N**2 / safe


def linear_rows(stream: Stream) -> list[MonitorRow]:
    """Ranking from the windows alone, linearized: while no alarm is on."""
    _, gains = standing(stream)
    mem, keep = stream.memory, stream.windows.keep[:, None]
    V = np.where(mem["V"] > 1e-200, mem["V"], np.inf)
    levels = stream.windows.levels[:, None] ** 2
    wide = stream.variances()
    square = mem["N"] ** 2 / wide
    rows = []
    # each candidate: the window and column with the largest statistic
    for i, effect in enumerate(stream.bank.candidates):
        own = np.flatnonzero(stream.bank.owner == i)
        m, c = np.unravel_index(int(np.argmax((square - levels)[:, own])), (keep.size, own.size))
        j = own[[c]]
        scale = stream.bank.scale[j] / (1.0 + float(keep[m, 0]))  # forgetting sums s^2 once, not twice
        value, std = scale * mem["N"][m, j] / V[m, j], scale * np.sqrt(wide[m, j]) / V[m, j]
        std = np.where(np.isfinite(V[m, j]), std, np.inf)
        gain = 0.5 * float(square[m, j][0])
        rows.append(row_of(effect, [stream.bank.names[j[0]]], value, std, gain, False))
    # probabilities from the best gain above the threshold
    return ranked(rows, shares(float(gains.max()), gains)[1:])


def idle_remarks(stream: Stream) -> tuple[str, ...]:
    """Candidates that are not watched for, in words."""
    # candidates whose columns have no force on this motion
    owner, effects = stream.bank.owner, stream.bank.candidates
    idle = [e.label for i, e in enumerate(effects) if not stream.bank.scale[owner == i].any()]
    return (f"Not monitored, because the needed motion is missing: {', '.join(idle)}.",) if idle else ()


def segment_of(stream: Stream, start: int, free_state: bool, mean: Array) -> Segment:
    """Samples from `start` on as the fit needs them."""
    # samples, noise and state from the buffers; sensor offsets taken off
    W, Y, use, scale, x0 = stream.recent(start)
    observer, healthy = stream.observer, stream.healthy
    data = Measurement(W.T, (Y - mean).T, dt=observer.dt, hold=observer.hold)
    # whitening with the present noise level
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
) -> tuple[Scored, int, float, float]:
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
    none : float
        Log-likelihood, as the gains, of a change that is none of the candidates; -inf if nothing was fitted.
    """
    # shortlist by the linearized gains
    effects = stream.bank.candidates
    estimates, _, gains = linear_estimates(stream, since)
    order = np.argsort(-_by_candidate(stream, gains))
    chosen = [int(i) for i in order[:_SHORTLIST]]
    # besides, candidates fitted before, or else those that change by wear
    always = (lambda effect: effect in before) if before else (lambda effect: effect.spec.may_wear)
    chosen += [int(i) for i in order[_SHORTLIST:] if always(effects[i])]

    # fit them, add related ones, then move the time of the change
    contest = _Contest(stream, mean, latest, window, estimates)
    scored = contest.fits_from(since, chosen, before)
    scored = contest.wider(scored, since, chosen, before)
    if scored and latest is not None:
        scored, since = contest.moved(scored, since, latest)
    if not scored:
        return [], since, math.inf, -math.inf
    weighed, temper, none = _weigh(scored, stream.observer.structure)
    return weighed, since, temper, none


def _weigh(scored: Scored, known: Structure) -> tuple[Scored, float, float]:
    """Return fits with fair gains, the misfit, and the gain of no candidate."""
    # cost of the healthy model, from the gain of the first
    first, gained = scored[0]
    healthy, points = first.cost + 2.0 * gained, max(first.points, 1)
    # a size that the samples do not determine, or that physics excludes, explains nothing
    sound = [fit for fit, _ in scored if fit.determined and fit.possible(known)]
    scored = [(fit, gain if fit in sound else min(gain, 0.0)) for fit, gain in scored]
    left = min([healthy, *(fit.cost for fit in sound)]) / points
    # what the best one leaves, where that is more than noise, weighs all of them less
    # Schwarz's penalty per coefficient; temper: misfit of the best candidate
    temper, price = max(1.0, left), 0.5 * math.log(points)
    # a change of unknown form: it would leave noise only, with four coefficients
    none = 0.5 * (healthy - levels().alarm_left * points) / temper - _UNKNOWN * price
    fair = [(fit, gain / temper - price * (fit.coefficients.size - 1)) for fit, gain in scored]
    return _best_first(fair), temper, none


def _estimated_rows(stream: Stream, scored: Scored, since: int) -> list[MonitorRow]:
    """Row of each candidate, without its probability.

    It holds the fit where there is one, else the linearized estimate.
    """
    estimates, spreads, gains = linear_estimates(stream, since)
    fitted = {fit.effect: (fit, gain) for fit, gain in scored}
    worst = min((gain for _, gain in scored), default=math.inf)
    rows = []
    for i, effect in enumerate(stream.bank.candidates):
        if effect in fitted:
            fit, gain = fitted[effect]
            rows.append(row_of(effect, effect.free, fit.coefficients, fit.std, gain, True))
            continue
        own = np.flatnonzero(stream.bank.owner == i)
        best = own[[int(np.argmax(gains[own]))]]
        # the linear figure of one that was not worth a fit: not above those that were
        gain, name = min(float(gains[best[0]]), worst), stream.bank.names[best[0]]
        rows.append(row_of(effect, [name], estimates[best], spreads[best], gain, False))
    return rows


def _best_first(scored: Iterable[tuple[CandidateFit, float]]) -> Scored:
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

    def fits_from(self, start: int, which: Sequence[int], known: Mapping[Effect, Array]) -> Scored:
        """Fit some candidates to the samples from `start` on.

        Return the fits and their gains, best first.
        """
        # healthy before: known state at the change; later: the last window, state unknown
        stream = self.stream
        if self.latest is None:
            first, free = max(start, stream.n_samples - self.window, stream.oldest), True
        else:
            first, free = max(start, stream.oldest), start < stream.oldest
        segment = segment_of(stream, first, free, self.mean)
        found: Scored = []
        if not segment.judged.any():  # a change of a moment ago: the filters have no past yet
            return found
        # reference: the healthy model on the same samples
        nothing = fit_candidate(segment, None)
        worst = math.inf
        # start from earlier fits, or from the linearized estimate
        for i in which:
            effect = stream.bank.effects[i]
            starts = [known[effect]] if effect in known else []
            own = int(np.flatnonzero(stream.bank.owner == i)[0])
            if not starts and len(effect.free) == 1:
                starts = [np.array([self.estimates[own]])]
            # stop a fit early that lies far behind the best so far
            fit = fit_candidate(segment, effect, starts, alone=effect in known, worst=worst)
            worst = min(worst, fit.cost + _HOPELESS)
            if math.isfinite(fit.cost):
                found.append((fit, 0.5 * (nothing.cost - fit.cost)))
        return _best_first(found)

    def wider(
        self,
        scored: Scored,
        start: int,
        chosen: Sequence[int],
        known: Mapping[Effect, Array],
    ) -> Scored:
        """Fit more candidates, as a strong change bends the linear scores.

        Where more than noise is left, these are the elements at all places; then all laws at the
        places that lead.
        """
        effects, tried = self.stream.bank.candidates, set(chosen)
        # the best leaves more than noise: try all elements that wear
        if scored and not scored[0][0].reaches_noise:
            worn = [i for i, effect in enumerate(effects) if effect.spec.may_wear and i not in tried]
            scored = _best_first([*scored, *self.fits_from(start, worn, known)])
            tried.update(worn)
        # all effects at the three leading places
        leading = {fit.effect.place for fit, _ in scored[:_PLACES] if fit.effect is not None}
        others = [i for i, effect in enumerate(effects) if effect.place in leading and i not in tried]
        return _best_first([*scored, *self.fits_from(start, others, known)]) if others else scored

    def moved(self, scored: Scored, since: int, latest: int) -> tuple[Scored, int]:
        """Move the change to the sample at which the best candidate fits best.

        Each leader is given its own best sample, in steps that are halved down to one: a few samples off, a
        wrong candidate can fit better than the right one.
        """
        # coordinate search in time for each leader; step: two blocks, halved
        best = {fit.effect: (fit, gain) for fit, gain in scored}
        own = dict.fromkeys(_leaders(scored), since)
        step = max(2 * self.stream.windows.block, 2)
        while step:
            # up to four steps in each direction as long as the fit improves
            for way in (-step, step):
                going = list(own)
                for _ in range(_MOVES):
                    going = self._step_starts({e: own[e] + way for e in going}, latest, best)
                    own |= {effect: own[effect] + way for effect in going}
            step //= 2
        ranked = _best_first(best.values())
        first = ranked[0][0].effect
        return ranked, since if first is None else own.get(first, since)

    def _step_starts(
        self,
        starts: Mapping[Effect, int],
        latest: int,
        best: dict[Effect | None, tuple[CandidateFit, float]],
    ) -> list[Effect]:
        """Fit candidates from samples; enter and return what is better."""
        # start from the coefficients at the sample before
        index = {effect: i for i, effect in enumerate(self.stream.bank.candidates)}
        known = {effect: best[effect][0].coefficients for effect in starts}
        better: list[Effect] = []
        # one fit per start for all candidates there
        for start in dict.fromkeys(s for s in starts.values() if self.stream.oldest < s <= latest):
            which = [index[effect] for effect, own in starts.items() if own == start]
            for fit, gain in self.fits_from(start, which, known):
                if fit.effect is not None and gain > best[fit.effect][1]:
                    best[fit.effect] = fit, gain
                    better.append(fit.effect)
        return better


def _leaders(scored: Sequence[tuple[CandidateFit, float]]) -> list[Effect]:
    """Return the best candidates, and the best ones of the best places."""
    # first effect of each place, in order of gain
    effects = [fit.effect for fit, _ in scored if fit.effect is not None]
    places = {effect.place: effect for effect in effects[::-1]}
    likely = [effect for effect in effects if effect is places[effect.place]]
    return list(dict.fromkeys([*effects[:_LEADERS], *likely[:_PLACES]]))


def find_state(stream: Stream) -> None:
    """Find the state again after a missing input.

    A lightly damped model does not forget a wrong state.
    """
    # fit the state by least squares on the samples since the gap
    start = max(int(stream.memory["lost"][0]), stream.oldest)
    segment = segment_of(stream, start, True, stream.memory["mean_e"])
    fit = fit_candidate(segment, None)
    stream.found(start, fit.state, fit.doubt)


def fit_one(
    stream: Stream, index: int, start: int, mean: Array, before: Array
) -> tuple[CandidateFit, CandidateFit]:
    """Fit one candidate, and no effect, to the samples from `start` on.

    The state at `start` is unknown.
    """
    # named effect and healthy model on the same samples, state free
    segment = segment_of(stream, max(start, stream.oldest), True, mean)
    effect = stream.bank.effects[index]
    nothing = fit_candidate(segment, None)
    # starts: the coefficients so far, and the same shapes without a force
    starts = [before, np.where([name in effect.spec.shaping for name in effect.free], before, 0.0)]
    return fit_candidate(segment, effect, starts, alone=True), nothing


_SETTLE = 4  # periods in which more samples tell the time of the change better
_FOLLOW = 8  # periods over which the coefficient is followed
_MOST_PAST = 100
_KEPT = 1e-6  # probability up to which a fit is gone on from


@dataclass(eq=False)
class Watch:
    """State of the alarm.

    Parameters
    ----------
    period : int
        Samples in a period of the first mode.
    dt : float
        Sampling time [s].
    false_alarms : float
        Stated number per 100 000 samples.
    patience : float
        Periods that an alarm may wait for a clear name.
    room : int
        Samples that the stream keeps.
    """

    period: int
    dt: float
    false_alarms: float
    patience: float
    room: int
    found: Alarm | None = None
    confirmed: bool = False
    crossed: int = 0
    mean: Array = field(default_factory=lambda: np.zeros(0))
    misfit: float = float("inf")
    place: str = ""  # that led at the last look
    past: list[Alarm] = field(default_factory=list)
    rows: list[MonitorRow] = field(default_factory=list)
    gains: Array | None = None  # log-likelihoods of all candidates since the change
    none: float = -math.inf  # that of a change that is none of them
    next_naming: int = 0
    next_follow: int = 0
    value: float = float("nan")
    std: float = float("nan")

    @property
    def busy(self) -> bool:
        """Return whether the structure counts as changed.

        This is so after a threshold was crossed, until the structure counts as healthy again.
        """
        return self.found is not None

    @property
    def alarm(self) -> Alarm | None:
        """The alarm, once it has a name."""
        return self.found if self.confirmed else None

    def next_event(self, sample: int) -> int:
        """Number of samples at which something is to be done, while `busy`."""
        return max(min(self.next_naming, self.next_follow), sample + 1)

    def ring(self, stream: Stream) -> None:
        """Take note that a threshold was crossed at the last sample taken."""
        # time of the change by likelihood, column with the largest gain
        sample = stream.n_samples - 1
        since, columns = change_of(stream)
        levels = stream.windows.levels
        # statistic and threshold of the window that crossed
        score = np.abs(stream.memory["N"]) / np.sqrt(stream.variances())
        window = int(np.argmax((score / levels[:, None]).max(axis=1)))
        owner = int(stream.bank.owner[int(np.argmax(columns))])
        # an alarm without a name; it counts once the ranking is sure
        self.found = Alarm(
            sample=sample,
            time=sample * self.dt,
            crossed=sample * self.dt,
            since_sample=since,
            since=since * self.dt,
            effect=stream.bank.effects[owner],
            coefficients={},
            std={},
            probability=float("nan"),
            statistic=float(score[window].max()),
            threshold=float(levels[window]),
            false_alarms=self.false_alarms,
            ended=None,
            sentence="",
        )
        self.crossed, self.confirmed, self.misfit, self.place = sample, False, float("inf"), ""
        # sensor offsets as they were before the change
        self.mean = stream.memory["mean_e"].copy()
        self.next_naming = self._look(sample + 1, sample + 1 if self.patience == 0 else 0)
        self.next_follow = sample + 1 + 4 * self.period
        if self.patience == 0:
            self.attend(stream)

    def _look(self, sample: int, least: int = 0) -> int:
        """Return the sample at which the ranking is updated next.

        Updates come after 1/2, 1, 2, 4, ... periods, then once per memory.
        """
        age = sample - self.crossed
        step = max(self.period // 2, 1)
        while step <= age:
            step *= 2
        return max(least, self.crossed + min(step, age + self.room))

    def attend(self, stream: Stream) -> None:
        """Do what is due."""
        sample = stream.n_samples
        assert self.found is not None
        # fit and rank; in the first periods the time of the change is estimated, too
        if sample >= self.next_naming:
            settle = sample - self.crossed <= _SETTLE * self.period
            self.name(stream, settle=settle)
            self.next_naming = self._look(sample + 1)
            # confirm the alarm if the ranking is sure, or after `patience` periods
            if not self.confirmed:
                waited = sample - 1 - self.crossed
                if self._sure() or waited >= self.patience * self.period:
                    self.confirmed = True
                    self.found = replace(self.found, sample=sample - 1, time=(sample - 1) * self.dt)
                    self._state(stream.observer.structure.model)
                else:
                    last = self.crossed + 1 + round(self.patience * self.period)
                    self.next_naming = min(self.next_naming, last)
        # every four periods: follow the coefficient, and see whether the effect is gone
        if sample >= self.next_follow:
            self.next_follow = sample + 4 * self.period
            self.follow(stream)

    def _sure(self) -> bool:
        """Return whether one place clearly explains the change.

        It must have nearly all of the probability, twice in a row.
        """
        # probability of each place: sum over its effects
        places: dict[str, float] = {}
        for row in self.rows:
            places[row.effect.place] = places.get(row.effect.place, 0.0) + row.probability
        place = max(places, key=lambda name: places[name])
        before, self.place = self.place, place
        # clear: nearly all of the probability at one place, and its fit leaves no more than noise
        level = levels()
        clear = places[place] > level.alarm_place * sum(places.values()) and self.misfit < level.alarm_left
        return clear and place == before

    def name(self, stream: Stream, *, settle: bool) -> None:
        """Fit the candidates to the samples since the change, and rank them."""
        assert self.found is not None
        # while more samples settle the time of the change, estimate it again
        since = self.found.since_sample
        if settle:
            since = min(change_of(stream)[0], self.crossed)
        # fits of the last time serve as starts
        before = {
            row.effect: np.array(list(row.coefficients.values()))
            for row in self.rows
            if row.fitted and row.probability > _KEPT
        }
        window = _FOLLOW * self.period
        scored, since, misfit, self.none = fit_all(
            stream, since, self.mean, before, latest=self.crossed if settle else None, window=window
        )
        worst, least = levels().alarm_left * self.misfit, levels().alarm_worth
        if not settle and (not scored or misfit > worst or scored[0][1] < least):
            return  # the change itself is changing, or going: the name that fitted well stays
        self.misfit = misfit
        self.found = replace(self.found, since_sample=since, since=since * self.dt)
        rows = _estimated_rows(stream, scored, since)
        # posterior probabilities, then the ranking
        self.gains = np.array([row.log_likelihood for row in rows])
        self.rows = ranked(rows, shares(self.change(stream), self.gains, self.none)[1:])
        self._state(stream.observer.structure.model)

    def change(self, stream: Stream) -> float:
        """Return the log-likelihood ratio of a change, 0 at the threshold.

        It is never less than its value at the alarm.
        """
        assert self.found is not None
        # log-likelihood ratio over the threshold, at the alarm and now
        at_alarm = 0.5 * (self.found.statistic**2 - self.found.threshold**2)
        return max(at_alarm, float(standing(stream)[1].max()))

    def _state(self, model: PhysicalModel) -> None:
        """Write the best row into the alarm.

        If several rows explain the change equally well at that place, the simplest is taken.
        """
        assert self.found is not None
        # effects at the best place that the data cannot distinguish from the best
        best, near = self.rows[0], 0.5 * levels().rival
        alike = [
            row
            for row in self.rows
            if row.fitted == best.fitted
            and row.effect.place == best.effect.place
            and row.log_likelihood > best.log_likelihood - near
        ]
        # of these the one with the fewest coefficients
        row = min(alike, key=lambda row: len(row.coefficients))
        first = next(iter(row.coefficients))
        self.value, self.std = row.coefficients[first], row.std[first]
        found = replace(
            self.found,
            effect=row.effect,
            coefficients=row.coefficients,
            std=row.std,
            probability=row.probability,
        )
        others = tuple(other.effect.kind for other in alike if other is not row)
        # probability of none of the candidates
        none = 0.0 if self.none == -math.inf else 1.0 - sum(row.probability for row in self.rows)
        self.found = replace(found, sentence=_sentence(found, model, others, none))

    def follow(self, stream: Stream) -> None:
        """Fit the named effect to the last periods alone.

        End the alarm if the effect is gone.
        """
        assert self.found is not None
        # fit the named effect to the last eight periods
        index = stream.bank.effects.index(self.found.effect)
        sample, reach = stream.n_samples, _FOLLOW * self.period
        start = sample - reach
        if start < self.found.since_sample or not self.confirmed:
            return
        before = np.array(list(self.found.coefficients.values()))
        fit, nothing = fit_one(stream, index, start, self.mean, before)
        if not fit.coefficients.size or not np.isfinite(fit.std[0]):
            return
        self.value, self.std = float(fit.coefficients[0]), float(fit.std[0])
        # gone: coefficient near zero, healthy model as good, and the effect would be seen
        expected = abs(float(before[0]))
        level = levels()
        small = abs(self.value) < max(level.alarm_gone * self.std, 0.1 * expected)
        plain = nothing.cost < min(level.alarm_left * nothing.points, fit.cost + level.alarm_worth)
        if small and plain and level.alarm_missed * self.std < expected:
            self.end(stream, start, nothing.state)

    def end(self, stream: Stream, start: int, state: Array) -> None:
        """End the alarm and return to the healthy state.

        `state` is the healthy state at sample `start`.
        """
        assert self.found is not None
        # keep the alarm among the past ones
        gone = replace(self.found, ended=stream.n_samples * self.dt)
        if self.confirmed:
            self.past = [
                *self.past,
                replace(gone, sentence=_sentence(gone, stream.observer.structure.model)),
            ][-_MOST_PAST:]
        # back to the healthy state, windows empty
        self.found, self.confirmed, self.rows, self.gains = None, False, [], None
        self.none = -math.inf
        self.value = self.std = float("nan")
        stream.restart(start, state)


def _sentence(alarm: Alarm, model: PhysicalModel, others: tuple[str, ...] = (), none: float = 0.0) -> str:
    # coefficients with units and deviations
    figures = ", ".join(
        f"{name} {with_error(value, alarm.std[name], model.unit(alarm.effect, name))}"
        for name, value in alarm.coefficients.items()
    )
    alike = f"; {', '.join(others)} would explain it as well" if others else ""
    ended = "" if alarm.ended is None else f" It was gone by t = {alarm.ended:.6g} s."
    if none > max(alarm.probability, 0.5):
        return (
            f"Alarm at t = {alarm.time:.6g} s: a change since about t = {alarm.since:.6g} s that is none of "
            f"the candidates (probability {none:.2f}). Closest: {alarm.effect.label} ({figures}).{ended}"
        )
    return (
        f"Alarm at t = {alarm.time:.6g} s: {alarm.effect.label} since about t = {alarm.since:.6g} s "
        f"({figures}; probability {alarm.probability:.2f}{alike}).{ended}"
    )


_CHUNK = 2048  # samples at a time


def watch_block(stream: Stream, watch: Watch, course: Course, block: Block, position: int = 0) -> None:
    """Process a block from `position` on, and act on the test result.

    Parameters
    ----------
    stream : Stream
        Observer, bank and windows.
    watch : Watch
        The alarm, or what goes before one.
    course : Course
        Gets a row where one is due.
    block : Block
        Samples.
    position : int, optional
        First sample to take.
    """
    total = len(block.inputs)
    while position < total:
        # up to the next event: row of the history, naming, or the state after a gap
        here = stream.n_samples
        until = min(here + total - position, here + _CHUNK, course.due(here))
        healthy = not watch.busy
        if not healthy:
            until = min(until, watch.next_event(here))
        if stream.find_at > here:
            until = min(until, stream.find_at)
        # advance; while healthy it stops where a statistic crosses its threshold
        part = block.part(position, position + until - here)
        done, ratio = stream.advance(part.inputs, part.outputs, part.use, part.known, stop=healthy)
        position += done
        # alarm, naming, or state found anew
        if healthy and ratio[-1] > 1.0:
            watch.ring(stream)
        elif not healthy and stream.n_samples >= watch.next_event(here):
            watch.attend(stream)
        if stream.n_samples == stream.find_at:
            find_state(stream)
        if stream.n_samples % course.stride == 0:
            course.add(stream.n_samples, _row(stream, watch))


def _row(stream: Stream, watch: Watch) -> Array:
    """Return a history row: probabilities, statistic and coefficient.

    The statistic is divided by its threshold. The standard deviation of the coefficient comes last.
    """
    # no alarm: probabilities from the windows; alarm: from the fits
    ratio, gains = standing(stream)
    if watch.gains is None:
        p, value, std = shares(float(gains.max()), gains), math.nan, math.nan
    else:
        p, value, std = shares(watch.change(stream), watch.gains, watch.none), watch.value, watch.std
    return np.concatenate([p, [ratio, value, std]])


ROWS = 2048


class Course:
    """History rows at equal steps.

    When it is full, every other row is dropped and the step doubles.

    Parameters
    ----------
    width : int
        Figures per row.
    stride : int
        Samples between rows to begin with.
    """

    def __init__(self, width: int, stride: int) -> None:
        self.stride = stride
        self.rows = np.zeros((ROWS, width))
        self.samples = np.zeros(ROWS, dtype=np.int64)
        self.count = 0

    def due(self, sample: int) -> int:
        """Number of samples taken at which the next row is due."""
        return (sample // self.stride + 1) * self.stride

    def add(self, sample: int, row: Array) -> None:
        """Keep a row, if it is due."""
        if sample % self.stride:
            return
        # full: keep every other row
        if self.count == ROWS:
            self.stride *= 2
            kept = self.samples % self.stride == 0
            n = self.count = int(kept.sum())
            rows, samples = np.zeros_like(self.rows), np.zeros_like(self.samples)
            rows[:n], samples[:n] = self.rows[kept], self.samples[kept]
            self.rows, self.samples = rows, samples  # new ones: what a failed update goes back to stays
            if sample % self.stride:
                return
        self.rows[self.count], self.samples[self.count] = row, sample
        self.count += 1

    def content(self) -> dict[str, Any]:
        """All as plain arrays."""
        return {
            "stride": self.stride,
            "rows": self.rows[: self.count].copy(),
            "samples": self.samples[: self.count].copy(),
        }

    @classmethod
    def restored(cls, content: dict[str, Any]) -> Course:
        """The course that `content` was taken from."""
        rows = content["rows"]
        course = cls(rows.shape[1], int(content["stride"]))
        course.count = len(rows)
        course.rows[: course.count], course.samples[: course.count] = rows, content["samples"]
        return course
