"""What has changed, since when and how much: fits at an alarm, their ranking, and the end of an alarm."""

from __future__ import annotations

import math
import textwrap
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, NamedTuple

import numpy as np
from scipy.stats import chi2

from ..comparison.signals import fit_percent
from ..data.measurement import Measurement
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
from .score import BLOCKS, FREE, State, Watched, radius, recent, restarted, statistics, variances

PATIENCE = 4  # periods that an alarm may wait for a clear name
_SETTLE = 4  # periods in which the time of the change is estimated again
_FOLLOW = 8  # periods in the fits after that
_AGAIN = 4  # periods from one follow-up to the next
_LEADERS, _PLACES = 3, 2  # candidates, and places, for which the time of the change is moved
_SCREEN, _FIT = 4, 15  # simulations of a first fit, and of one that counts
_STARTS = 2  # starting points of a law with a gap or a limit
_UNKNOWN = 4  # coefficients that a change of unknown form would take
_LEFT = 1e-2  # chance that the noise alone leaves more
_KEPT = 1e-6  # probability with which a candidate is fitted again
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
class Case:
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


class Trial(NamedTuple):
    """A candidate fitted from a sample on, and the log-likelihood that it gains over the healthy model."""

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


def weighed(trials: Sequence[Trial], healthy: float) -> tuple[list[Trial], float, float]:
    """Return the trials with fair gains, best first, the misfit, and the gain of no candidate.

    Parameters
    ----------
    trials : sequence of Trial
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
    """Return the place that has nearly all of the probability, if its fit leaves noise only; otherwise ""."""
    places: dict[str, float] = {}
    for row in rows:
        places[row.effect.place] = places.get(row.effect.place, 0.0) + row.probability
    place, level = max(places, key=lambda name: places[name]), levels()
    clear = places[place] > level.alarm_place * sum(places.values()) and misfit < level.alarm_left
    return place if clear else ""


def next_look(age: int, period: int, room: int) -> int:
    """Age of a change in samples at which it is looked at next: 1/2, 1, 2, 4, ... periods."""
    step = max(period // 2, 1)
    while step <= age:
        step *= 2
    return min(step, age + room)


def simplest(rows: Sequence[MonitorRow]) -> tuple[MonitorRow, list[MonitorRow]]:
    """Return the simplest of the rows that explain as much as the first at its place, and these rows."""
    best = rows[0]
    alike = [
        row
        for row in rows
        if row.fitted == best.fitted
        and row.effect.place == best.effect.place
        and row.log_likelihood > best.log_likelihood - 0.5 * levels().rival
    ]
    return min(alike, key=lambda row: len(row.coefficients)), alike


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
def standing(watched: Watched, state: State, candidates: Sequence[Effect]) -> tuple[float, Array]:
    """Return the largest statistic over its threshold, and the gain of each candidate, 0 at the threshold.

    A candidate that changes a parameter of the model has the score of that; the others have the energy.
    """
    square, level = statistics(watched, state), watched.levels**2
    best = np.where(np.isfinite(level), 0.5 * (square - level), -np.inf).max(axis=0)
    columns = [column_of(watched, effect) for effect in candidates]
    return float(np.sqrt((square / level).max(initial=0.0))), best[columns]


def column_of(watched: Watched, effect: Effect) -> int:
    """Column of the scores in which a candidate is seen; -1 is the energy."""
    s = watched.numbers.structure
    for k, column in enumerate(watched.numbers.columns):
        other = s.effects[s.parameters[column].effect]
        if (other.kind, other.place) == (effect.kind, effect.place) and len(effect.free) == 1:
            return k
    return -1


def linear_rows(watched: Watched, state: State, candidates: Sequence[Effect]) -> tuple[MonitorRow, ...]:
    """Ranking by the scores alone, while no alarm is on."""
    _, gains = standing(watched, state, candidates)
    square, wide, level = statistics(watched, state), variances(watched, state), watched.levels**2
    rows = []
    for effect, gain in zip(candidates, gains, strict=True):
        k = column_of(watched, effect)
        m = int(np.argmax(square[:, k] - np.where(np.isfinite(level[:, k]), level[:, k], np.inf)))
        V = state.V[m, k]
        # one step of Gauss-Newton: N / V; forgetting sums the squares once, not twice
        seen = k >= 0 and V > 1e-200 and np.isfinite(wide[m, k])
        size = 1 / (V * (1 + watched.keep[m])) if seen else 0.0
        value, std = (state.N[m, k] * size, math.sqrt(wide[m, k]) * size) if seen else (0.0, math.inf)
        name = effect.free[0]
        rows.append(MonitorRow(effect, {name: float(value)}, {name: float(std)}, math.nan, float(gain), False))
    return ranked(rows, shares(float(gains.max()), gains)[1:])


def ranked(rows: Iterable[MonitorRow], probabilities: Array) -> tuple[MonitorRow, ...]:
    """Rows with these probabilities, the most probable first."""
    shared = [replace(row, probability=float(p)) for row, p in zip(rows, probabilities, strict=True)]
    return tuple(sorted(shared, key=lambda row: (-row.probability, -row.log_likelihood)))


def history_row(watched: Watched, state: State, case: Case | None, candidates: Sequence[Effect]) -> Array:
    """Probabilities, statistic over its threshold, coefficient and its standard deviation."""
    ratio, gains = standing(watched, state, candidates)
    if case is None or not case.rows:
        p, value, std = shares(float(gains.max()), gains), math.nan, math.nan
    else:
        by = {row.effect: row.log_likelihood for row in case.rows}
        now = np.array([by[effect] for effect in candidates])
        p, value, std = shares(change_of(case, gains), now, case.none), case.value, case.std
    return np.concatenate([p, [ratio, value, std]])


def change_of(case: Case, gains: Array) -> float:
    """Log-likelihood ratio of a change, 0 at the threshold; never less than at the alarm."""
    return max(0.5 * (case.statistic**2 - case.threshold**2), float(gains.max()))


# ------------------------------------------------------------------------ fits
@dataclass(frozen=True, eq=False)
class Fits:
    """Fits of candidates to the samples of a state.

    Attributes
    ----------
    watched : Watched
        Healthy model.
    state : State
        Samples that are kept.
    known : mapping
        Coefficients from which a candidate starts.
    """

    watched: Watched
    state: State
    known: Mapping[Effect, Array] = field(default_factory=dict)
    made: dict[Any, Any] = field(default_factory=dict)

    @property
    def oldest(self) -> int:
        """First sample from which on a fit can begin."""
        return max(self.state.count - BLOCKS, 0) * self.watched.block + 1

    def stretch(self, first: int, known_start: bool) -> Stretch:
        """Samples from `first` on, with the state of the healthy model there."""
        if (first, known_start) not in self.made:
            w, B = self.watched, self.watched.block
            # ring_x is the corrected state at the last sample before a block
            b = min(max((first + 1) // B, self.state.count - BLOCKS + 1, 1), self.state.count - 1)
            blocks = self.state.count - b + 1
            part, at = recent(self.state, min(blocks, BLOCKS)), B - 1
            scale = self.state.ring_scale[-blocks:].reshape(len(part.use), -1)
            ahead, x = max(first - (b * B - 1), 0), self.state.ring_x[1 - blocks]
            if ahead:
                whole = w.stretch(part.part(at, at + ahead + 1), x, scale[at : at + ahead + 1], known_start=True)
                use = whole.use.copy()
                use[0] = False
                engine = Engine(w.numbers.structure, whole.data, substeps=w.substeps)
                gain = w.healthy.gain if w.healthy.gain.any() else None
                run = engine.run(
                    w.healthy.theta, x, sensitivity=False, gain=gain, use=use, histories=True, check=False
                )
                x, at = run.states[:, -1], at + ahead
            found = w.stretch(part.part(at, len(part.use)), x, scale[at:], known_start=known_start)
            found.use[0] = not known_start  # the state there is corrected already
            self.made[first, known_start] = found
        return self.made[first, known_start]

    @property
    def motion(self) -> Motion:
        """Motion at the places, for the shapes of laws."""
        if "motion" not in self.made:
            blocks = min(self.state.count - 1, 64)
            bare = Structure(self.watched.base.structure.model)
            data = self.stretch((self.state.count - blocks) * self.watched.block, False).data
            self.made["motion"] = Motion(bare, np.zeros(0), data)
        return self.made["motion"]

    def structure(self, effect: Effect | None) -> tuple[Structure, list[Array], int]:
        """Healthy model with its parameters held and the candidate; starts, and substeps."""
        if effect not in self.made:
            s, theta = self.watched.numbers.structure, self.watched.healthy.theta
            held = [
                hold_coefficients(e, {n: float(s.value(theta, i, n)) for n in e.coefficients})
                for i, e in enumerate(s.effects)
            ]
            bare = Structure(s.model, [*held, *filter(None, [effect])], constants=s.constants)
            widths = law_widths(bare, self.motion) if effect is not None and bare.port_effects else {}
            whole = Structure(s.model, bare.effects, constants=widths | s.constants)
            points = [np.zeros(0)]
            if effect is not None:
                points = shape_starts(whole, whole.start(), self.motion, len(held))[:_STARTS]
            steps = max(self.watched.base.substeps, 1 if whole.is_linear else 2)
            self.made[effect] = whole, points, steps
        return self.made[effect]

    def fit(self, effect: Effect | None, first: int, known_start: bool, evaluations: int = _FIT) -> BlockFit:
        """Fit a candidate (None: the healthy model) to the samples from `first` on."""
        whole, points, steps = self.structure(effect)
        stretch = self.stretch(first, known_start)._replace(substeps=steps)
        if effect in self.known:
            points = [self.known[effect]]
        fits = [fit_block(whole, stretch, point, evaluations=evaluations) for point in points]
        return min(fits, key=lambda fit: fit.cost)


@dataclass(eq=False)
class Contest:
    """Candidates, each from the sample on from which it explains most.

    Attributes
    ----------
    fits : Fits
        Samples.
    known_start : bool
        Whether the state at the change is that of the healthy model.
    since : dict
        Sample from which each candidate acts.
    """

    fits: Fits
    known_start: bool
    since: dict[Effect, int]
    found: dict[Any, Any] = field(default_factory=dict)
    points: dict[Effect, Array] = field(default_factory=dict)

    def nothing(self, at: int) -> BlockFit:
        """What the healthy model leaves from a sample on."""
        if at not in self.found:
            self.found[at] = self.fits.fit(None, at, self.known_start)
        return self.found[at]

    def trial(self, effect: Effect, at: int, evaluations: int = _FIT) -> Trial:
        """Fit a candidate from a sample on; it goes on from where it was found to fit elsewhere."""
        if (effect, at) not in self.found or self.found[effect, at][1] < evaluations:
            fits = self.fits
            if effect in self.points:
                fits = replace(fits, known={effect: self.points[effect]})
            fit = fits.fit(effect, at, self.known_start, evaluations)
            one = Trial(effect, fit, -math.inf)
            if math.isfinite(fit.cost):
                self.points[effect] = fit.theta
                gain = 0.5 * (self.nothing(at).cost - fit.cost)
                # a size that the samples do not determine, or that physics excludes, explains nothing
                sound = one.determined and one.possible(fits.watched.numbers.structure.model)
                one = one._replace(gain=gain if sound else min(gain, 0.0))
            self.found[effect, at] = one, evaluations
        return self.found[effect, at][0]

    def best(self, effect: Effect) -> Trial:
        """Fit of a candidate at its own sample."""
        return self.trial(effect, self.since[effect], 0)

    @property
    def top(self) -> Effect:
        """Candidate that gains most."""
        return max(self.since, key=lambda effect: self.best(effect).gain)

    def screened(self) -> list[Effect]:
        """Return the candidates by a first fit, and fit those that lead to the end."""
        for effect in self.since:
            self.trial(effect, self.since[effect], _SCREEN)
        order = sorted(self.since, key=lambda effect: -self.best(effect).gain)
        places = list(dict.fromkeys(effect.place for effect in order))[:_PLACES]
        firsts = [next(effect for effect in order if effect.place == place) for place in places]
        leaders = list(dict.fromkeys([*order[:_LEADERS], *firsts]))
        for effect in leaders:
            self.trial(effect, self.since[effect])
        return leaders

    def moved(self, leaders: Sequence[Effect], step: int, oldest: int, latest: int) -> None:
        """Give each leader its own best sample: a few samples off, a wrong candidate can fit better."""
        while step:
            for effect in leaders:
                for way in (-step, step):
                    while oldest < self.since[effect] + way <= latest:
                        there = self.trial(effect, self.since[effect] + way)
                        if not there.gain > self.best(effect).gain:
                            break
                        self.since[effect] += way
            step //= 2
        # what one of them found of the time counts for all at these places
        at, places = self.since[self.top], {effect.place for effect in leaders}
        for effect in self.since:
            if effect.place in places and self.trial(effect, at).gain > self.best(effect).gain:
                self.since[effect] = at


def name(watched: Watched, state: State, case: Case, candidates: Sequence[Effect]) -> Case:
    """Fit the candidates to the samples since the change, and rank them."""
    n, B, T = state.count * watched.block, watched.block, watched.period
    latest = 0
    before = {
        row.effect: np.array(list(row.coefficients.values()))
        for row in case.rows
        if row.fitted and row.probability > _KEPT
    }
    fits = Fits(watched, state, before)
    settle = n - 1 - case.crossed <= _SETTLE * T or not before
    first = max(n - _FOLLOW * T, fits.oldest)
    known_start = case.since >= fits.oldest and (settle or case.since >= first)
    if settle:
        # filters need a past: the change began before the crossing, and some samples ago
        latest = max(min(case.crossed, n - 2 * len(state.past) - 8), fits.oldest)
        first = int(np.clip(likely_change(watched, state), fits.oldest, latest))
    elif known_start:
        first = case.since
    simple = [e for e in candidates if len(e.free) == 1] or list(candidates)
    contest = Contest(fits, known_start, dict.fromkeys(simple if settle else before, first))
    leaders = contest.screened()
    for stage in range(2):
        if settle:
            contest.moved(leaders, 2 * B, fits.oldest, latest)
        best = contest.best(contest.top)
        if best.fit.cost < chi2.isf(_LEFT, max(best.fit.points, 1)) and best.gain > 0:
            break
        # more than noise is left: all laws at the places that lead
        at, places = contest.since[contest.top], {effect.place for effect in leaders}
        others = [e for e in candidates if e.place in places and e not in contest.since]
        if stage or not others:
            break
        contest.since |= dict.fromkeys(others, at)
        leaders = contest.screened()
    since = contest.since[contest.top]
    trials = [contest.best(effect) for effect in contest.since]
    trials = [one for one in trials if math.isfinite(one.fit.cost)]
    if not trials:
        return case
    fair, misfit, none = weighed(trials, contest.nothing(since).cost)
    level = levels()
    if not settle and (misfit > level.alarm_left * case.misfit or fair[0].gain < level.alarm_worth):
        return case  # the change itself is changing, or going: the name that fitted well stays
    rows = ranked_fits(watched, state, candidates, fair)
    _, gains = standing(watched, state, candidates)
    p = shares(change_of(case, gains), np.array([row.log_likelihood for row in rows]), none)
    kept = since if settle else case.since
    return replace(case, rows=ranked(rows, p[1:]), misfit=misfit, none=none, since=kept)


def ranked_fits(
    watched: Watched, state: State, candidates: Sequence[Effect], fair: Sequence[Trial]
) -> list[MonitorRow]:
    """Row of each candidate: its fit, or the linear estimate of one that was not worth it."""
    by, worst = {one.effect: one for one in fair}, min(one.gain for one in fair)
    rows = []
    for row in linear_rows(watched, state, candidates):
        if row.effect in by:
            one = by[row.effect]
            values, std = (
                dict(zip(row.effect.free, map(float, part), strict=True)) for part in (one.fit.theta, one.fit.std)
            )
            rows.append(MonitorRow(row.effect, values, std, math.nan, float(one.gain), True))
        else:  # not above those that were fitted
            rows.append(replace(row, log_likelihood=min(row.log_likelihood, worst)))
    return rows


def likely_change(watched: Watched, state: State) -> int:
    """Sample at which the likelihood of a change of one column is largest, the start of a block."""
    kept = min(state.count, BLOCKS)
    N, V = (np.cumsum(part[::-1], axis=0)[::-1] for part in state.sums[:, -kept:])
    wide = np.where(V > 1e-200, V, np.inf) * np.maximum(state.scatter.min(axis=0), 1.0)
    block = int(np.argmax((N**2 / wide).max(axis=1)))
    return (state.count - kept + block) * watched.block


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


def adequacy_of(watched: Watched, state: State, candidates: Sequence[Effect], block: Block) -> Adequacy:
    """Judge the healthy model by the samples that were learned from.

    Parameters
    ----------
    watched : Watched
        Healthy model.
    state : State
        After these samples.
    candidates : sequence of Effect
        What may be missing.
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
        fits = Fits(watched, state)
        simple = [e for e in candidates if len(e.free) == 1] or list(candidates)
        contest = Contest(fits, False, dict.fromkeys(simple, fits.oldest))
        contest.screened()
        score = math.sqrt(2 * max(contest.best(contest.top).gain, 0.0))
        missing = contest.top if score >= watched.levels[-1, 0] else None
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


def _explained(watched: Watched, block: Block) -> tuple[tuple[float, ...], tuple[float, ...]]:
    """Fit of each output in percent by the model as given and with its parameters moved, offsets apart."""
    numbers, h, use = watched.numbers, watched.healthy, block.use > 0
    data = Measurement(block.inputs.T, block.outputs.T, dt=watched.base.dt, hold=watched.base.hold)
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


# ------------------------------------------------------------------------ course of a case
def rung(watched: Watched, state: State) -> Case:
    """A change whose threshold was crossed with the last block."""
    n = state.count * watched.block
    square = statistics(watched, state)
    m, k = np.unravel_index(int(np.argmax(square / watched.levels**2)), square.shape)
    first = next_look(0, watched.period, n)
    return Case(
        n - 1, float(np.sqrt(square[m, k])), float(watched.levels[m, k]), n + first,
        n + _AGAIN * watched.period, likely_change(watched, state),
    )  # fmt: skip


def attend(
    watched: Watched, state: State, case: Case, candidates: Sequence[Effect]
) -> tuple[State, Case | None, Alarm | None]:
    """Do what is due with a change: name it, follow its size, or end it.

    Returns
    -------
    state : State
        Healthy again where the change is gone.
    case : Case or None
        None where it is gone.
    ended : Alarm or None
        The alarm that has ended.
    """
    n, T = state.count * watched.block, watched.period
    if n >= case.look:
        case = _looked(watched, state, case, candidates)
    if n < case.follow:
        return state, case, None
    case = replace(case, follow=n + _AGAIN * T)
    start = n - _FOLLOW * T
    if case.alarm is None or start < case.since:
        return state, case, None
    # the named effect in the last periods alone: it may grow, or be gone
    effect, before = case.alarm.effect, np.array(list(case.alarm.coefficients.values()))
    fits = Fits(watched, state, {effect: before})
    start = max(start, fits.oldest)
    fit, plain = fits.fit(effect, start, False), fits.fit(None, start, False)
    if not math.isfinite(fit.cost) or not np.isfinite(fit.std[0]):
        return state, case, None
    case = replace(case, value=float(fit.theta[0]), std=float(fit.std[0]))
    if not is_gone(case.value, case.std, float(before[0]), fit.cost, plain.cost, plain.points):
        return state, case, None
    alarm = replace(case.alarm, ended=n * watched.base.dt)
    alarm = replace(alarm, sentence=_sentence(alarm, watched.base.structure.model))
    state = restarted(state, plain.last)
    nothing = {part: np.zeros_like(getattr(state, part)) for part in ("N", "V", "shared", "sums", "S")}
    return state._replace(**nothing), None, alarm


def _looked(watched: Watched, state: State, case: Case, candidates: Sequence[Effect]) -> Case:
    """Rank the candidates; raise the alarm where a place is clear twice in a row, or patience is at its end."""
    n, T, dt = state.count * watched.block, watched.period, watched.base.dt
    age, place = n - 1 - case.crossed, case.place
    case = name(watched, state, case, candidates)
    look = next_look(age, T, 24 * T)
    if case.alarm is None and age < PATIENCE * T:
        look = min(look, PATIENCE * T)
    case = replace(case, look=case.crossed + 1 + look)
    if not case.rows:
        return case
    case = replace(case, place=clear_place(case.rows, case.misfit))
    if case.alarm is None and not (case.place and case.place == place) and age < PATIENCE * T:
        return case
    row, alike = simplest(case.rows)
    first = next(iter(row.coefficients))
    sample = n - 1 if case.alarm is None else case.alarm.sample
    alarm = Alarm(
        sample, sample * dt, case.crossed * dt, case.since, case.since * dt, row.effect, row.coefficients, row.std,
        row.probability, case.statistic, case.threshold, watched.false_alarms, None, "",
    )  # fmt: skip
    others = tuple(other.effect.kind for other in alike if other is not row)
    none = 0.0 if case.none == -math.inf else 1.0 - sum(one.probability for one in case.rows)
    sentence = _sentence(alarm, watched.base.structure.model, others, none)
    return replace(
        case, alarm=replace(alarm, sentence=sentence), value=row.coefficients[first], std=row.std[first]
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
