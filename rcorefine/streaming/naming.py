"""Names of changes: fits at an alarm, their ranking, and its end."""

from __future__ import annotations

import math
import textwrap
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import NamedTuple

import numpy as np
from scipy.stats import chi2

from ..comparison.signals import fit_percent
from ..data.measurement import block_of_stream
from ..diagnosis.hypothesis import unphysical
from ..effects.effect import Effect, hold_coefficients
from ..engine.engine import Engine
from ..engine.initial_state import estimate_initial_state
from ..engine.structure import Structure
from ..inference.levels import levels
from ..inference.parameters import nominal_size
from ..inference.starts import Motion, law_widths, shape_starts
from ..models.physical_model import PhysicalModel
from ..results import Row, with_error
from ..systems.linear import Array
from .block import BlockFit, Stretch, fit_block
from .samples import Block
from .score import BLOCKS, FREE, State, WatchedModel, radius, recent, restarted, statistics, variances

PATIENCE = 16  # quarters of a period that an alarm may wait for a clear name
_SETTLE = 4  # periods in which the time of the change is estimated again
_FOLLOW = 8  # periods in the fits after that
_AGAIN = 4  # periods from one follow-up to the next
_LEADERS, _PLACES = 3, 2  # candidates, and places, for which the time of the change is moved
_SCREEN, _FIT = 4, 15  # simulations of a first fit, and of one that counts
_STARTS = 2  # starting points of a law with a gap or a limit
_UNKNOWN = 4  # coefficients that a change of unknown form would take
_LEFT = 1e-3  # chance that the noise alone leaves more
_KEPT = 14.0  # log-likelihood below the best candidate within which one is fitted again
_SHOWN = 3  # parameters in a sentence


# ------------------------------------------------------------------------ results
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
        Whether the estimate is a nonlinear fit (after an alarm), or the linear one of the scores.
    """

    effect: Effect
    coefficients: dict[str, float]
    std: dict[str, float]
    probability: float
    log_likelihood: float
    fitted: bool


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


@dataclass(frozen=True, slots=True)
class Change:
    """A change between the crossing of a threshold and its end.

    Attributes
    ----------
    crossed : int
        Sample at which the threshold was crossed.
    statistic, threshold : float
        What crossed it.
    look, follow : int
        Number of samples at which the ranking, and the size of the named effect, are updated next.
    since : int
        Sample of the change.
    rows : tuple of MonitorRow
        All candidates, the most probable first.
    misfit, none : float
        Mean square that the best fit leaves; log-likelihood of a change that is none of the candidates.
    place : str
        Place that was clear at the last look, "" for none.
    alarm : Alarm or None
        The alarm, once it has a name.
    value, std : float
        Size of the named effect in the last periods.
    """

    crossed: int
    statistic: float
    threshold: float
    look: int
    follow: int
    since: int
    rows: tuple[MonitorRow, ...] = ()
    misfit: float = math.inf
    none: float = -math.inf
    place: str = ""
    alarm: Alarm | None = None
    value: float = math.nan
    std: float = math.nan


class Fitted(NamedTuple):
    """A candidate fitted from a sample on.

    `gain` is the log-likelihood that it gains over the healthy model.
    """

    effect: Effect
    fit: BlockFit
    gain: float

    @property
    def determined(self) -> bool:
        """Return whether the samples determine a size of the effect."""
        shaping = self.effect.spec.shaping
        sizes = [name not in shaping for name in self.effect.free]
        clear = np.abs(self.fit.theta) > levels().moved * self.fit.std
        return bool(clear[sizes].any() if any(sizes) else clear.any())

    def possible(self, model: PhysicalModel) -> bool:
        """Return whether a friction that the model lacks resists the motion."""
        values = dict(zip(self.effect.free, map(float, self.fit.theta), strict=True))
        return not unphysical(self.effect, values, model)


# ------------------------------------------------------------------------ decisions
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
    """
    # probability of a change: logistic function of the log-likelihood ratio
    something = 1.0 / (1.0 + math.exp(-min(max(change, -700.0), 700.0)))
    # candidates by Bayes' rule with equal priors; "none of these" is one of them
    top = max(float(gains.max()), none)
    weight = np.exp(gains - top)
    return np.concatenate([[1.0 - something], something * weight / (weight.sum() + math.exp(none - top))])


def weighed(trials: Sequence[Fitted], healthy: float) -> tuple[list[Fitted], float, float]:
    """Weigh fits by what the best one leaves, and by their coefficients.

    Return them with fair gains, best first, the misfit, and the gain of no candidate.

    Parameters
    ----------
    trials : sequence of Fitted
        Fits; a gain of zero or less counts as no explanation.
    healthy : float
        Sum of squares that the healthy model leaves.
    """
    points = max(max(one.fit.points for one in trials), 1)
    sound = [one.fit.cost for one in trials if one.gain > 0]
    # what the best one leaves, where that is more than noise, weighs all of them less
    misfit = min([healthy, *sound]) / points
    temper, price = max(1.0, misfit), 0.5 * math.log(points)  # Schwarz's penalty per coefficient
    # a change of unknown form would leave noise only, with four coefficients
    none = 0.5 * (healthy - levels().alarm_left * points) / temper - _UNKNOWN * price
    fair = [one._replace(gain=one.gain / temper - price * (len(one.effect.free) - 1)) for one in trials]
    return sorted(fair, key=lambda one: -one.gain), misfit, none


def clear_place(rows: Iterable[MonitorRow], misfit: float) -> str:
    """Return the place that has nearly all of the probability.

    It is "" if there is none, or if its fit leaves more than noise.
    """
    places: dict[str, float] = {}
    for row in rows:
        places[row.effect.place] = places.get(row.effect.place, 0.0) + row.probability
    place, level = max(places, key=lambda name: places[name]), levels()
    clear = places[place] > level.alarm_place * sum(places.values()) and misfit < level.alarm_left
    return place if clear else ""


def next_look(age: int, period: int, room: int) -> int:
    """Age of a change in samples at which it is looked at next.

    Looks come 1/4, 1/2, 3/4, 1, 3/2, 2, 3, 4 and then 8, 16, ... periods after the crossing.
    """
    step = max(period // 4, 1)
    while age >= 4 * step:
        step *= 2
    later = (age // step + 1) * step if step <= period else 4 * step
    return min(later, age + room)


def simplest(rows: Sequence[MonitorRow]) -> tuple[MonitorRow, list[MonitorRow]]:
    """Return the simplest of the best rows at the best place.

    The rows that explain as much follow.
    """
    best = rows[0]
    alike = [
        row
        for row in rows
        if row.fitted == best.fitted
        and row.effect.place == best.effect.place
        and row.log_likelihood > best.log_likelihood - 0.5 * levels().rival
    ]
    return min(alike, key=lambda row: len(row.coefficients)), alike


def renames(misfit: float, before: float, gain: float) -> bool:
    """Return whether a later ranking replaces one.

    Its fit is about as good, and worth a name.
    """
    level = levels()
    return misfit <= level.alarm_left * before and gain >= level.alarm_worth


def is_gone(value: float, std: float, expected: float, cost: float, plain: float, points: int) -> bool:
    """Return whether an effect that had a size is gone from the last periods.

    Parameters
    ----------
    value, std : float
        Its size in them.
    expected : float
        Its size at the alarm.
    cost, plain : float
        Sums of squares that it and the healthy model leave.
    points : int
        Number of squares.
    """
    level = levels()
    small = abs(value) < max(level.alarm_gone * std, 0.1 * abs(expected))
    as_good = plain < min(level.alarm_left * points, cost + level.alarm_worth)
    return bool(small and as_good and level.alarm_missed * std < abs(expected))


# ------------------------------------------------------------------------ scores
def standing(watched: WatchedModel, state: State) -> tuple[float, Array]:
    """Return the largest statistic, and the gain of each candidate.

    The statistic is divided by its threshold; the gain is 0 there.

    A candidate that changes a parameter of the model has the score of that; the others have the energy.
    """
    square, level = statistics(watched, state), watched.squares
    best = np.where(np.isfinite(level), 0.5 * (square - level), -np.inf).max(axis=0)
    return float(np.sqrt((square / level).max(initial=0.0))), best[watched.seen_in]


def linear_rows(watched: WatchedModel, state: State) -> tuple[MonitorRow, ...]:
    """Ranking by the scores alone, while no alarm is on."""
    rows = _linear(watched, state)
    gains = np.array([row.log_likelihood for row in rows])
    return ranked(rows, shares(float(gains.max()), gains)[1:])


def _linear(watched: WatchedModel, state: State) -> list[MonitorRow]:
    """Estimate of each candidate by the scores, in their order."""
    _, gains = standing(watched, state)
    square, wide, level = statistics(watched, state), variances(watched, state), watched.squares
    rows = []
    for effect, k, gain in zip(watched.candidates, watched.seen_in, gains, strict=True):
        m = int(np.argmax(square[:, k] - np.where(np.isfinite(level[:, k]), level[:, k], np.inf)))
        V = state.V[m, k]
        # one step of Gauss-Newton: N / V; forgetting sums the squares once, not twice
        seen = k >= 0 and V > 1e-200 and np.isfinite(wide[m, k])
        size = 1 / (V * (1 + watched.keep[m])) if seen else 0.0
        value, std = (state.N[m, k] * size, math.sqrt(wide[m, k]) * size) if seen else (0.0, math.inf)
        name = effect.free[0]
        rows.append(
            MonitorRow(effect, {name: float(value)}, {name: float(std)}, math.nan, float(gain), False)
        )
    return rows


def ranked(rows: Iterable[MonitorRow], probabilities: Array) -> tuple[MonitorRow, ...]:
    """Rows with these probabilities, the most probable first.

    Of equal ones the first candidate leads.
    """
    shared = [replace(row, probability=float(p)) for row, p in zip(rows, probabilities, strict=True)]
    return tuple(sorted(shared, key=lambda row: -round(row.log_likelihood, 3)))


def history_row(watched: WatchedModel, state: State, change: Change | None) -> Array:
    """Probabilities, statistic, coefficient and its standard deviation."""
    ratio, gains = standing(watched, state)
    if change is None or not change.rows:
        p, value, std = shares(float(gains.max()), gains), math.nan, math.nan
    else:
        by = {row.effect: row.log_likelihood for row in change.rows}
        now = np.array([by[effect] for effect in watched.candidates])
        p, value, std = shares(change_of(change, gains), now, change.none), change.value, change.std
    return np.concatenate([p, [ratio, value, std]])


def change_of(change: Change, gains: Array) -> float:
    """Log-likelihood ratio of a change, 0 at the threshold.

    It is never less than at the alarm.
    """
    return max(0.5 * (change.statistic**2 - change.threshold**2), float(gains.max()))


# ------------------------------------------------------------------------ fits
@dataclass(eq=False)
class Fits:
    """Candidates fitted to the samples of a state.

    Each acts from the sample on from which it explains most.

    Attributes
    ----------
    watched : WatchedModel
        Healthy model.
    state : State
        Samples that are kept.
    known_start : bool
        Whether the state at the change is that of the healthy model.
    points : dict
        Coefficients at which a candidate was found last: there it starts.
    since : dict
        Sample from which each candidate acts.
    """

    watched: WatchedModel
    state: State
    known_start: bool
    points: dict[Effect, Array] = field(default_factory=dict)
    since: dict[Effect, int] = field(default_factory=dict)
    stretches: dict[int, Stretch] = field(default_factory=dict)
    structures: dict[Effect | None, tuple[Structure, list[Array]]] = field(default_factory=dict)
    plain: dict[int, BlockFit] = field(default_factory=dict)
    trials: dict[tuple[Effect, int], tuple[Fitted, int]] = field(default_factory=dict)

    @property
    def oldest(self) -> int:
        """First sample from which on a fit can begin."""
        return max(self.state.blocks - BLOCKS, 0) * self.watched.block + 1

    def stretch(self, first: int) -> Stretch:
        """Samples from `first` on, with the state of the healthy model there."""
        if first in self.stretches:
            return self.stretches[first]
        w, B, s = self.watched, self.watched.block, self.state
        # ring_x is the corrected state at the last sample before a block
        b = min(max((first + 1) // B, s.blocks - BLOCKS + 1, 1), s.blocks - 1)
        blocks, at = s.blocks - b + 1, B - 1
        part, x, ahead = recent(s, blocks), s.ring_x[1 - blocks], max(first - (b * B - 1), 0)
        scale = s.ring_scale[-blocks:].reshape(part.use.shape)
        if ahead:
            known = w.stretch(part.part(at, at + ahead + 1), x, scale[at : at + ahead + 1], known_start=True)
            run = Engine(w.numbers.structure, known.data, substeps=w.substeps).run(
                w.healthy.theta, x, sensitivity=False, gain=known.gain if known.gain.any() else None,
                use=known.use, histories=True, check=False,
            )  # fmt: skip
            x, at = run.states[:, -1], at + ahead
        found = w.stretch(part.part(at, len(part.use)), x, scale[at:], known_start=self.known_start)
        return self.stretches.setdefault(first, found)

    @cached_property
    def motion(self) -> Motion:
        """Motion at the places, for the shapes of laws."""
        first = (self.state.blocks - min(self.state.blocks - 1, 64)) * self.watched.block
        return Motion(Structure(self.watched.base.structure.model), np.zeros(0), self.stretch(first).data)

    def structure(self, effect: Effect | None) -> tuple[Structure, list[Array]]:
        """Healthy model, held, with a candidate; and where its fit starts."""
        if effect in self.structures:
            return self.structures[effect]
        s, theta = self.watched.numbers.structure, self.watched.healthy.theta
        effects = [
            hold_coefficients(e, {n: float(s.value(theta, i, n)) for n in e.coefficients})
            for i, e in enumerate(s.effects)
        ]
        starts = [np.zeros(0)]
        whole = Structure(s.model, effects, constants=s.constants)
        if effect is not None:
            bare = Structure(s.model, [*effects, effect], constants=s.constants)
            whole = Structure(s.model, bare.effects, constants=law_widths(bare, self.motion) | s.constants)
            starts = shape_starts(whole, whole.start(), self.motion, len(effects))[:_STARTS]
        return self.structures.setdefault(effect, (whole, starts))

    def fit(self, effect: Effect | None, first: int, evaluations: int = _FIT) -> BlockFit:
        """Fit a candidate (None: the healthy model) from a sample on."""
        whole, starts = self.structure(effect)
        steps = max(self.watched.base.substeps, 1 if whole.is_linear else 2)
        stretch = self.stretch(first)._replace(substeps=steps)
        if effect is not None and effect in self.points:
            starts = [self.points[effect]]
        fits = [fit_block(whole, stretch, start, evaluations=evaluations) for start in starts]
        return min(fits, key=lambda fit: fit.cost)

    def nothing(self, at: int) -> BlockFit:
        """Fit of the healthy model alone from a sample on."""
        if at not in self.plain:
            self.plain[at] = self.fit(None, at)
        return self.plain[at]

    def trial(self, effect: Effect, at: int, evaluations: int = _FIT) -> Fitted:
        """Fit a candidate from a sample on, unless that was done as well."""
        found, spent = self.trials.get((effect, at), (None, -1))
        if found is None or spent < evaluations:
            fit, gain = self.fit(effect, at, evaluations), -math.inf
            if math.isfinite(fit.cost):
                self.points[effect], gain = fit.theta, 0.5 * (self.nothing(at).cost - fit.cost)
            found = Fitted(effect, fit, gain)
            # a size that the samples do not determine, or that physics excludes, explains nothing
            if gain > 0 and not (found.determined and found.possible(self.watched.numbers.structure.model)):
                found = found._replace(gain=0.0)
            self.trials[effect, at] = found, evaluations
        return found

    def best(self, effect: Effect) -> Fitted:
        """Fit of a candidate at its own sample."""
        return self.trial(effect, self.since[effect], 0)

    @property
    def top(self) -> Fitted:
        """Candidate that gains most."""
        return max(map(self.best, self.since), key=lambda one: one.gain)

    def screened(self) -> list[Effect]:
        """Return the candidates that lead after a first fit, well fitted."""
        for effect in self.since:
            self.trial(effect, self.since[effect], _SCREEN)
        order = sorted(self.since, key=lambda effect: -self.best(effect).gain)
        places = list(dict.fromkeys(effect.place for effect in order))[:_PLACES]
        firsts = [next(effect for effect in order if effect.place == place) for place in places]
        leaders = list(dict.fromkeys([*order[:_LEADERS], *firsts]))
        for effect in leaders:
            self.trial(effect, self.since[effect])
        return leaders

    def move(self, leaders: Sequence[Effect], step: int, latest: int) -> None:
        """Give each leader its own best sample.

        A few samples off, a wrong candidate can fit better.
        """
        while step:
            for effect in leaders:
                for way in (-step, step):
                    while self.oldest < self.since[effect] + way <= latest:
                        if self.trial(effect, self.since[effect] + way).gain <= self.best(effect).gain:
                            break
                        self.since[effect] += way
            step //= 2
        # what one of them found of the time counts for all at these places
        at, places = self.since[self.top.effect], {effect.place for effect in leaders}
        for effect in self.since:
            if effect.place in places and self.trial(effect, at).gain > self.best(effect).gain:
                self.since[effect] = at


def name(watched: WatchedModel, state: State, change: Change) -> Change:
    """Fit the candidates to the samples since a change, and rank them."""
    known = {
        row.effect: np.array(list(row.coefficients.values()))
        for row in change.rows
        if row.fitted and row.log_likelihood > change.rows[0].log_likelihood - _KEPT
    }
    age = state.blocks * watched.block - 1 - change.crossed
    settle = age <= _SETTLE * watched.period or not known
    fits = (_searched if settle else _followed)(watched, state, change, known)
    found = [one for one in map(fits.best, fits.since) if math.isfinite(one.fit.cost)]
    if not found:
        return change
    since = fits.since[fits.top.effect]
    fair, misfit, none = weighed(found, fits.nothing(since).cost)
    if not settle and not renames(misfit, change.misfit, fair[0].gain):
        return change  # the change itself is changing, or going: the name that fitted well stays
    rows, (_, gains) = ranked_fits(watched, state, fair), standing(watched, state)
    p = shares(change_of(change, gains), np.array([row.log_likelihood for row in rows]), none)
    kept = since if settle else change.since
    return replace(change, rows=ranked(rows, p[1:]), misfit=misfit, none=none, since=kept)


def _searched(watched: WatchedModel, state: State, change: Change, known: dict[Effect, Array]) -> Fits:
    """Fit candidates, each from its best sample near the likely change."""
    n, B, fits = state.blocks * watched.block, watched.block, Fits(watched, state, True, known)
    # filters need a past: the change began before the crossing, and some samples ago
    latest = max(min(change.crossed, n - 2 * len(state.past) - 8), fits.oldest)
    # the sample from which a fit left noise only is near the right one
    near = change.misfit < levels().alarm_left
    first = change.since if near else likely_change(watched, state)
    fits.since = dict.fromkeys(_simple(watched), int(np.clip(first, fits.oldest, latest)))
    for wider in (True, False):
        leaders = fits.screened()
        fits.move(leaders, B // 2 if near else 2 * B, latest)
        top, places = fits.top, {effect.place for effect in leaders}
        if not wider or (top.fit.cost < chi2.isf(_LEFT, max(top.fit.points, 1)) and top.gain > 0):
            break
        # more than noise is left: all laws at the places that lead
        others = [effect for effect in watched.candidates if effect.place in places]
        fits.since = dict.fromkeys(others, fits.since[top.effect]) | fits.since
    return fits


def _followed(watched: WatchedModel, state: State, change: Change, known: dict[Effect, Array]) -> Fits:
    """Fit the likely candidates, and simple ones there, to the last periods."""
    fits = Fits(watched, state, True, dict(known))
    first = max(state.blocks * watched.block - _FOLLOW * watched.period, fits.oldest, change.since)
    # while a change grows, laws of several coefficients take its name: the simple ones are asked again
    simple = [e for e in _simple(watched) if e.place in {one.place for one in known}]
    fits.known_start, fits.since = first == change.since, dict.fromkeys([*known, *simple], first)
    fits.screened()
    return fits


def _simple(watched: WatchedModel) -> list[Effect]:
    """Candidates of one coefficient, or all where there are none."""
    return [e for e in watched.candidates if len(e.free) == 1] or list(watched.candidates)


def ranked_fits(watched: WatchedModel, state: State, fair: Sequence[Fitted]) -> list[MonitorRow]:
    """Row of each candidate: its fit, or the linear estimate."""
    by, worst = {one.effect: one for one in fair}, min(one.gain for one in fair)
    rows = []
    for row in _linear(watched, state):
        if row.effect in by:
            one = by[row.effect]
            values, std = (
                dict(zip(row.effect.free, map(float, part), strict=True))
                for part in (one.fit.theta, one.fit.std)
            )
            rows.append(MonitorRow(row.effect, values, std, math.nan, float(one.gain), True))
        else:  # as if it explained nothing
            rows.append(replace(row, log_likelihood=min(0.0, worst)))
    return rows


def likely_change(watched: WatchedModel, state: State) -> int:
    """Sample at which a change of one column is likeliest.

    It is the start of a block.
    """
    kept = min(state.blocks, BLOCKS)
    N, V = np.cumsum(state.sums[-kept:][::-1], axis=0)[::-1].transpose(1, 0, 2)
    wide = np.where(V > 1e-200, V, np.inf) * np.maximum(state.scatter.min(axis=0), 1.0)
    block = int(np.argmax((N**2 / wide).max(axis=1)))
    return (state.blocks - kept + block) * watched.block


# ------------------------------------------------------------------------ adequacy
@dataclass(frozen=True, slots=True)
class Adequacy(Row):
    """Adequacy of the healthy model after the learning phase.

    It is the value of `Monitor.adequacy`.

    Attributes
    ----------
    fit : tuple of float
        Of each output by the model as it was given, in percent: 100 (1 - |y - yh| / |y - mean y|) of
        the free run; of the prediction one sample ahead where the model has no free run.
    fit_moved : tuple of float
        The same with the parameters of the model moved to where the samples want them.
    moved : dict
        Parameter and its relative change, those that were moved by more than 3 standard deviations.
    missing : Effect or None
        Candidate for which what is left asks.
    score : float
        How many standard deviations that is.
    adequate : bool
        Whether no candidate is missing and no parameter was moved by more than twice the tolerance.
    sentence : str
        All that in words, with the line of code that comes first where it is not adequate.
    """

    fit: tuple[float, ...]
    fit_moved: tuple[float, ...]
    moved: dict[str, float]
    missing: Effect | None
    score: float
    adequate: bool
    sentence: str

    def __str__(self) -> str:
        return textwrap.fill(self.sentence, 80)


def adequacy_of(watched: WatchedModel, state: State, block: Block) -> Adequacy:
    """Judge the healthy model by the samples that were learned from.

    Parameters
    ----------
    watched : WatchedModel
        Healthy model.
    state : State
        After these samples.
    block : Block
        The samples.
    """
    # which parameters moved by more than their uncertainty, relative to their size
    numbers, h, tolerance = watched.numbers, watched.healthy, watched.base.tolerance
    s, sd = numbers.structure, np.sqrt(np.sum(h.root**2, axis=1))
    moved: dict[str, float] = {}
    for i in np.setdiff1d(numbers.free, numbers.offsets):
        effect, change = s.effects[s.parameters[i].effect], h.theta[i] - numbers.theta[i]
        size = nominal_size(s, effect) or abs(float(numbers.theta[i]))
        if abs(change) > levels().moved * sd[i] and size > 0:
            name = s.parameters[i].name
            moved[effect.label if len(effect.free) == 1 else f"{effect.label}: {name}"] = float(change / size)
    # white innovations of a free run ask for nothing; otherwise each candidate says what it would explain
    missing, score = None, 0.0
    if any(h.orders) or h.gain.any() or h.law[:, 1:].any():
        fits = Fits(watched, state, True)
        fits.since = dict.fromkeys(_simple(watched), fits.oldest)
        fits.screened()
        score = math.sqrt(2 * max(fits.top.gain, 0.0))
        missing = fits.top.effect if score >= watched.levels[-1, 0] else None
    return judged(_explained(watched, block), moved, missing, score, tolerance, watched.base.dt)


def judged(
    fits: tuple[tuple[float, ...], tuple[float, ...]], moved: dict[str, float], missing: Effect | None,
    score: float, tolerance: float, dt: float,
) -> Adequacy:  # fmt: skip
    """Decide whether a model is adequate, and say so."""
    far = max(map(abs, moved.values()), default=0.0) > levels().moved_wide * tolerance > 0
    before, after = (" and ".join(f"{percent:.1f} %" for percent in fit) for fit in fits)
    sentence = f"The model explains {before} of the learning phase."
    if moved:
        largest = sorted(moved, key=lambda name: -abs(moved[name]))[:_SHOWN]
        by = ", ".join(f"{name} by {100 * moved[name]:+.2g} %" for name in largest)
        by += ", ..." if len(moved) > _SHOWN else ""
        sentence += f" With re-estimated parameters ({by}) it explains {after}."
    if missing is None and not far:
        sentence += " The residual cannot be distinguished from noise: the model is adequate."
        return Adequacy(*fits, moved, None, score, True, sentence)
    effects = "" if missing is None else f"[rco.Effect({missing.kind!r}, {missing.place!r})], "
    if missing is not None:
        sentence += (
            f" {missing.label} or a similar effect is missing ({score:.0f} standard deviations). Changes "
            "that resemble it are detected late."
        )
    else:
        sentence += " The changes are larger than the tolerance allows."
    sentence += (
        f" Next: better = rco.refine(model, healthy_record, {effects}free='linear'), then "
        f"rco.Monitor(better, dt={dt:.6g})."
    )
    return Adequacy(*fits, moved, missing, score, False, sentence)


def _explained(watched: WatchedModel, block: Block) -> tuple[tuple[float, ...], tuple[float, ...]]:
    """Fit of each output in percent, offsets apart.

    First that of the model as given, then that with its parameters moved.
    """
    numbers, h, use = watched.numbers, watched.healthy, block.use > 0
    data = block_of_stream(block.inputs.T, block.outputs.T, watched.base.dt, watched.base.hold)
    given = numbers.theta.copy()
    given[numbers.offsets] = h.theta[numbers.offsets]
    found = []
    for theta in (given, h.theta):
        # a model that forgets its state runs free, another one with the observer
        free = radius(watched.base, numbers, theta, 0 * h.gain) <= FREE
        engine, K = Engine(numbers.structure, data, substeps=watched.substeps), None if free else h.gain
        x0 = estimate_initial_state(engine, theta, gain=K, use=use)
        run = engine.run(theta, x0, sensitivity=False, gain=K, use=use, check=False)
        rows = zip(data.outputs, run.outputs, use.T, strict=True)
        found.append(tuple(float(fit_percent(y[there], yh[there])) for y, yh, there in rows))
    return found[0], found[1]


# ------------------------------------------------------------------------ course of a change
def begin_change(watched: WatchedModel, state: State) -> Change:
    """A change whose threshold was crossed with the last block."""
    n = state.blocks * watched.block
    square = statistics(watched, state)
    m, k = np.unravel_index(int(np.argmax(square / watched.squares)), square.shape)
    first = next_look(0, watched.period, n)
    return Change(
        n - 1, float(np.sqrt(square[m, k])), float(watched.levels[m, k]), n + first,
        n + _AGAIN * watched.period, likely_change(watched, state),
    )  # fmt: skip


def attend(watched: WatchedModel, state: State, change: Change) -> tuple[State, Change | None, Alarm | None]:
    """Do what is due with a change: name it, follow its size, or end it.

    Returns
    -------
    state : State
        Healthy again where the change is gone.
    change : Change or None
        None where it is gone.
    ended : Alarm or None
        The alarm that has ended.
    """
    n, T = state.blocks * watched.block, watched.period
    if n >= change.look:
        change = _looked(watched, state, change)
    if n < change.follow:
        return state, change, None
    change = replace(change, follow=n + _AGAIN * T)
    start = n - _FOLLOW * T
    if change.alarm is None or start < change.since:
        return state, change, None
    # the named effect in the last periods alone: it may grow, or be gone
    alarm, before = change.alarm, np.array(list(change.alarm.coefficients.values()))
    fits = Fits(watched, state, False, {alarm.effect: before})
    start = max(start, fits.oldest)
    fit, plain = fits.fit(alarm.effect, start), fits.fit(None, start)
    if not math.isfinite(fit.cost) or not np.isfinite(fit.std[0]):
        return state, change, None
    change = replace(change, value=float(fit.theta[0]), std=float(fit.std[0]))
    if not is_gone(change.value, change.std, float(before[0]), fit.cost, plain.cost, plain.points):
        return state, change, None
    alarm = replace(alarm, ended=n * watched.base.dt)
    alarm = replace(alarm, sentence=_sentence(alarm, watched.base.structure.model))
    state = restarted(state, plain.last)
    nothing = {part: np.zeros_like(getattr(state, part)) for part in ("N", "V", "shared", "sums", "S")}
    return state._replace(**nothing), None, alarm


def _looked(watched: WatchedModel, state: State, change: Change) -> Change:
    """Rank the candidates, and ring where it is time.

    A place is clear twice in a row, or patience is at its end.
    """
    n, T, dt = state.blocks * watched.block, watched.period, watched.base.dt
    age, place = n - 1 - change.crossed, change.place
    change = name(watched, state, change)
    look = next_look(age, T, 24 * T)
    change = replace(change, look=change.crossed + 1 + look)
    if not change.rows:
        return change
    change = replace(change, place=clear_place(change.rows, change.misfit))
    waits = age < PATIENCE * max(T // 4, 1)
    if change.alarm is None and waits and not (change.place and change.place == place):
        return change
    change = replace(change, look=max(change.look, change.crossed + 1 + min(2 * age, age + 24 * T)))
    row, alike = simplest(change.rows)
    first = next(iter(row.coefficients))
    sample = n - 1 if change.alarm is None else change.alarm.sample
    alarm = Alarm(
        sample, sample * dt, change.crossed * dt, change.since, change.since * dt, row.effect,
        row.coefficients, row.std, row.probability, change.statistic, change.threshold, watched.false_alarms,
        None, "",
    )  # fmt: skip
    others = tuple(other.effect.kind for other in alike if other is not row)
    none = 0.0 if change.none == -math.inf else 1.0 - sum(one.probability for one in change.rows)
    sentence = _sentence(alarm, watched.base.structure.model, others, none)
    return replace(
        change, alarm=replace(alarm, sentence=sentence), value=row.coefficients[first], std=row.std[first]
    )


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
