"""Verdict of a diagnosis from the table of hypotheses."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np
from scipy import stats

from ..comparison.compare import compare
from ..data.measurement import Measurement
from ..effects.effect import Effect
from ..effects.law import KINDS
from ..inference.f_tests import project
from ..inference.levels import Levels
from ..inference.parameters import EstimatedParameter
from ..inference.refinement import Refinement
from ..inference.sensitivities import Candidate, candidate_columns
from .case import Case, not_held
from .check_rows import Detectable
from .hypothesis import Trial, unphysical
from .noise import error_shares
from .residual_tests import TestedResidual
from .result import RankedEffect
from .search import Search, is_gain, is_number

_CLOSE = 12  # most probable sets of which one may be close enough
_LEFT_OVER = 0.3  # of the error of the model as it is, that what explains it may leave
_ERRORS = 2.0  # standard deviations within which a shape is that of a simpler law
_ROUNDS, _PART = 4, 0.02  # of the noise model; share of an effect in a residual that does not change it


@dataclass(frozen=True, eq=False)
class TableRow:
    """A set of effects with its probability over all nuisances.

    Attributes
    ----------
    effects : tuple of Effect
        The set; empty if nothing is missing.
    floated : bool
        For the empty set: whether the parameters of the model are re-estimated. False for other sets.
    value : float
        Log posterior probability, summed over the nuisances, up to a constant.
    trials : list of Trial
        Fits that the data do not exclude, the most probable first.
    same : tuple of Trial
        Fits of other sets that are the same change of the model. Their probabilities are included.
    """

    effects: tuple[Effect, ...]
    floated: bool
    value: float
    trials: list[Trial]
    same: tuple[Trial, ...] = ()


def log_sum(rows: Iterable[TableRow]) -> float:
    """Return the log of the sum of the probabilities of rows."""
    return float(np.logaddexp.reduce([row.value for row in rows]))


#: Tells whether a trial passes its tests.
Passed = Callable[[Trial], bool]


class Answer(NamedTuple):
    """A verdict with the row and the fit that support it.

    Attributes
    ----------
    verdict : str
        As `Diagnosis.verdict`.
    row : TableRow
        Row of the answer, or the most probable row if the verdict is "unexplained".
    trial : Trial
        Fit of this row that passes the tests, or its most probable fit if the verdict is "unexplained".
    effects : tuple of Effect
        Named effects; those of the most probable row if the verdict is "unexplained".
    ties : tuple of TableRow
        Other rows that the data cannot distinguish from it.
    inside : tuple of TableRow
        Rows that contain it or are special cases of it; their probability counts for it.
    probability : float
        Probability of the answer; NaN if the verdict is "unexplained".
    none : float
        Probability that no candidate effect is right: a free force explains the record instead. NaN if the
        verdict is "adequate" because of the row without effects.
    """

    verdict: str
    row: TableRow
    trial: Trial
    effects: tuple[Effect, ...]
    ties: tuple[TableRow, ...]
    inside: tuple[TableRow, ...]
    probability: float
    none: float


def table(search: Search) -> list[TableRow]:
    """Return the table of sets of effects, the most probable first.

    Trials with an effect that the data do not determine are left out. The empty set has two rows: with the
    parameters held, and with them re-estimated. Likely sets that are the same change of the model have one
    row.
    """
    # trials by their set of effects; the empty set with held and with free parameters
    by_set: dict[Any, list[Trial]] = {}
    for trial in search.ranked():
        if search.determined(trial):
            by_set.setdefault(frozenset(trial.effects) or trial.hypothesis.floated, []).append(trial)
    excluded = -0.5 * search.case.levels.rival
    rows = []
    for key, trials in by_set.items():
        # probability of a set: sum over its nuisances
        values = [search.posterior(trial) for trial in trials]
        near = [t for t, v in zip(trials, values, strict=True) if v > values[0] + excluded]
        rows.append(TableRow(near[0].effects, key is True, float(np.logaddexp.reduce(values)), near))
    rows.sort(key=lambda row: -row.value)
    # equal changes of the model share a row
    likely = [row for row in rows if row.effects and row.value > rows[0].value + excluded]
    rest = [row for row in rows if row not in likely]
    return sorted([*_distinct(likely), *rest], key=lambda row: -row.value)


def _distinct(rows: Sequence[TableRow]) -> list[TableRow]:
    """Return one row for all that are the same change of the model."""
    found: list[TableRow] = []
    for row in rows:
        i = next((i for i, r in enumerate(found) if r.trials[0].equals(row.trials[0])), len(found))
        if i == len(found):
            found.append(row)
            continue
        # a law has a meaning that an entry of a matrix lacks
        own, other = sorted((found[i], row), key=lambda r: any("any" in e.spec.where for e in r.effects))
        value = float(np.logaddexp(own.value, other.value))
        found[i] = replace(own, value=value, same=(*own.same, other.trials[0], *other.same))
    return found


def special(one: Sequence[Effect], other: Sequence[Effect]) -> bool:
    """Return whether a set of effects is a special case of another.

    Both have the same number of effects. Each effect of the first is in the second, or is contained in an
    effect of the second at the same place.
    """
    # each effect equal, or a special case at the same place
    if len(one) != len(other) or set(one) == set(other):
        return False

    def inside(e: Effect, o: Effect) -> bool:
        return e == o or (e.place == o.place and e.kind in o.spec.special_cases)

    return all(any(inside(e, o) for o in other) for e in one)


def answer(search: Search, rows: Sequence[TableRow], passed: Passed) -> Answer:
    """Return the verdict of a table.

    Parameters
    ----------
    search : Search
        Search with its fitted trials.
    rows : sequence of TableRow
        Table of the search.
    passed : callable
        Function that tells whether a trial passes its tests.

    Returns
    -------
    Answer
    """
    levels = search.case.levels
    keeps, excluded = -float(np.log(search.case.significance)), -0.5 * levels.rival
    total = log_sum(rows)
    nothing = next(row for row in rows if not row.effects and not row.floated)
    top, first = search.ranked()[0], rows[0]
    # a set that is far more probable but undetermined makes the answer uncertain
    unexplained = Answer("unexplained", first, first.trials[0], first.effects, (), (), np.nan, 1.0)
    if search.posterior(top) > rows[0].value + keeps + search.price and not search.determined(top):
        return unexplained
    # adequate: no set is clearly more probable, and the residual passes
    plainest = sorted(nothing.trials, key=lambda trial: len(trial.hypothesis.nuisances))
    fine = rows[0].value - nothing.value < keeps and next(filter(passed, plainest), None)
    if fine:
        share = float(np.exp(nothing.value - total))
        return Answer("adequate", nothing, fine, (), (), (), share, np.nan)
    # the most probable sets in turn: the first that passes its tests is named
    for row in rows[:4]:
        if row.value < rows[0].value + excluded:
            break
        trial = next(filter(passed, row.trials[:3]), None)
        if trial is not None:
            # sets that failed have less than half the probability, related ones left out
            failed = (one for one in rows[: rows.index(row)] if not _related(one, row))
            likely = log_sum(failed) < total + np.log(0.5)
            return _named(search, rows, row, trial, passed) if likely else unexplained
    return unexplained


def close_enough(search: Search, rows: Sequence[TableRow], found: Answer) -> Answer:
    """Return "adequate" if the error of the model as it is does not matter.

    Used where no set passes its tests. The answer has no probability: no hypothesis of the table is exact.
    """
    nothing = search.trials[0]
    if _model_error(search, nothing) > 1.0:
        return found
    row = next(row for row in rows if not row.effects and not row.floated)
    return Answer("adequate", row, nothing, (), (), (), np.nan, np.nan)


def close_models(search: Search) -> list[Trial]:
    """Return the models that are close enough, if possible without effects.

    Effects must explain nearly all of the error of the model as it is. Of the sets, those with the fewest
    coefficients are returned: the evidence does not decide between models that are all inexact. Parameters
    alone are not returned: they imitate many a law to within what matters.
    """
    nothing = search.trials[0]
    before = _model_error(search, nothing)
    if before <= 1.0:
        return [nothing]
    # free runs only: process noise hides model error
    sets = [t for t in search.ranked() if t.effects and not t.hypothesis.ratio and search.determined(t)]
    most = min(1.0, _LEFT_OVER * before)
    # among the close sets those with the fewest coefficients
    found = [trial for trial in sets[:_CLOSE] if _model_error(search, trial) <= most]
    least = min((trial.n_coefficients for trial in found), default=0)
    return [trial for trial in found if trial.n_coefficients == least]


def _model_error(search: Search, trial: Trial) -> float:
    """Return the largest error of a model in free run over what matters."""
    least = search.case.levels.matters
    left = error_shares(trial.tested, search.tests(trial), search.case.significance)
    return max((one.model / max(least, one.step, 1e-300) for one in left), default=np.inf)


def _related(one: TableRow, other: TableRow) -> bool:
    """Return whether one set of effects is a special case of the other."""
    return special(one.effects, other.effects) or special(other.effects, one.effects)


def _family(rows: Sequence[TableRow], row: TableRow) -> list[TableRow]:
    """Return a row and the rows whose probability counts for it.

    If its effects are parameters of the model only, those are re-estimated parameters, too.
    """
    numbers = row.effects and all(map(is_number, row.effects))
    return [r for r in rows if r is row or _related(r, row) or (numbers and r.floated and not r.effects)]


def _preferred(
    family: Sequence[TableRow], row: TableRow, trial: Trial, passed: Passed, levels: Levels
) -> tuple[TableRow, Trial]:
    """Return the row and fit to name of a row and those related to it.

    A simpler law is named if it is nearly as probable and passes. It is also named if the shape of the
    general law is within two standard deviations of the value at which it is the simpler one.
    """
    for simpler in (r for r in family if special(r.effects, row.effects)):
        odds = row.value - simpler.value
        reached = odds < 0.5 * levels.rival and _reaches(trial, simpler.effects)
        for fit in simpler.trials[:3]:
            if reached or (odds < levels.family and passed(fit)):
                return simpler, fit
    return row, trial


def _reaches(trial: Trial, simpler: Sequence[Effect]) -> bool:
    """Return whether a law of a trial is a simpler one within its errors."""
    law, *more = set(trial.effects) - set(simpler)
    (effect, *_) = set(simpler) - set(trial.effects)
    shape = law.spec.contains.get(effect.kind)
    if more or not shape:
        return False
    rows = estimates(trial.model.refinement, law)
    return all(n in rows and abs(rows[n].coefficient - x) <= _ERRORS * rows[n].std for n, x in shape.items())


def _named(search: Search, rows: Sequence[TableRow], row: TableRow, trial: Trial, passed: Passed) -> Answer:
    """Return the answer for a row with a trial that passes its tests."""
    levels, family = search.case.levels, _family(rows, row)
    row, trial = _preferred(family, row, trial, passed, levels)
    # probability that the force is of another form, from the free-force odds
    none = 1.0 / (1.0 + float(np.exp(-search.criticized(trial).odds)))
    probability = float(np.exp(log_sum(family) - log_sum(rows))) * (1.0 - none)
    # effects to name: without those that were not asked for, and gains beside re-estimated parameters
    floated, unasked = trial.hypothesis.floated, not_held(row.effects, search.case.library)
    asked = not_held(row.effects, unasked)
    effects = tuple(e for e in asked if not (floated and is_gain(e)))
    if not effects:
        word = "parameters" if floated or row.effects else "adequate"
        return Answer(word, row, trial, (), (), (), probability, none)
    # ties: other rows that the data cannot distinguish from this one
    least = row.value - 0.5 * levels.rival
    ties = tuple(r for r in rows if r.value > least and r not in family)
    # named alone: probable enough, or at least one half and nothing near
    alone = probability >= (levels.named if ties else min(levels.named, 0.5))
    word = "effect" if alone else "ambiguous"
    inside = tuple(r for r in family if r is not row)
    return Answer(word, row, trial, effects, ties, inside, probability, none)


class Listed(NamedTuple):
    """A set of effects in the ranking.

    Attributes
    ----------
    trial : Trial
        Its fit.
    probability : float
        Probability of the set.
    alike : bool
        Whether the data cannot distinguish it from the best one.
    same : tuple of Trial
        Its fits under other names.
    """

    trial: Trial
    probability: float
    alike: bool
    same: tuple[Trial, ...]


def ranking(
    listed: Sequence[Listed],
    nothing: float,
    case: Case,
    validation: Measurement | None,
) -> tuple[RankedEffect, ...]:
    """Return a row of the ranking for each trial, in the given order.

    Parameters
    ----------
    listed : sequence of Listed
        One for each set of effects.
    nothing : float
        Log evidence without any effect.
    case : Case
        Fitted model, records and settings.
    validation : Measurement or None
        Validation data for the fits; used for the first eight rows only.

    Returns
    -------
    tuple of RankedEffect
    """
    horizon = case.settings["horizon"]
    # fit on validation data, p-values by score tests
    before = _validated(case.base, validation, horizon)
    every = [trial for one in listed for trial in (one.trial, *one.same)]
    effects = list(dict.fromkeys(effect for trial in every for effect in trial.effects))
    scored = candidate_columns(case.fitted, effects, case.motions[0], (0.0,))
    tests = TestedResidual(case.fitted).each(scored)
    scores = {c.effect: test.p_value for c, test in zip(scored, tests, strict=True)}

    def row(i: int, one: Listed, trial: Trial, others: tuple[RankedEffect, ...] = ()) -> RankedEffect:
        refinement = trial.model.refinement
        order = sorted(range(len(trial.effects)), key=lambda k: -trial.surest[k])
        first, *more = (trial.effects[k] for k in order)
        after = _validated(refinement, validation if i < 8 else None, horizon)
        p_value = min(scores.get(effect, 1.0) for effect in trial.effects)
        figures = (before, after, p_value, float(one.probability), trial.total - nothing)
        sizes = sizes_of(refinement, first)
        return RankedEffect(first, *sizes, *figures, refinement, tuple(more), one.alike, others)

    rows = enumerate(listed)
    return tuple(row(i, one, one.trial, tuple(row(i, one, same) for same in one.same)) for i, one in rows)


def estimates(refinement: Refinement, effect: Effect) -> dict[str, EstimatedParameter]:
    """Return the estimates of the free coefficients of an effect, by name.

    Empty if the model does not hold the effect.
    """
    name = (effect.kind, effect.place, "effect")
    rows = [row for row in refinement.parameters if (row.kind, row.place, row.role) == name]
    return dict(zip(effect.free, rows, strict=True)) if rows else {}


def sizes_of(refinement: Refinement, effect: Effect) -> tuple[dict[str, float], dict[str, float]]:
    """Return coefficients and standard deviations of an effect, by name."""
    rows = estimates(refinement, effect).items()
    return {name: row.coefficient for name, row in rows}, {name: row.std for name, row in rows}


def undetermined(refinement: Refinement, effect: Effect, levels: Levels) -> list[EstimatedParameter]:
    """Return the estimates that keep an effect from being named or kept.

    Parameters
    ----------
    refinement : Refinement
        Model with the effect.
    effect : Effect
        Effect. Coefficients held by its `fixed` are not tested.
    levels : Levels
        Levels; `moved` is the least number of standard deviations.

    Returns
    -------
    list of EstimatedParameter
        All sizes of the effect, if none is more than `Levels.moved` standard deviations from zero or if their
        sign contradicts physics. Otherwise the insignificant ones among the essential coefficients and the
        shaping coefficients with a finite lower bound. Insignificant coefficients without a finite standard
        deviation are included, too. Empty if the data determine the effect. Standard deviations are those
        with an inertia of the model held: where all forces and masses scale together, as in a free decay,
        only ratios act.
    """
    # standard deviations beside a known inertia
    rows, law = _with_an_inertia_held(refinement, estimates(refinement, effect)), effect.spec
    values = {name: row.coefficient for name, row in rows.items()}
    loose = {name: row for name, row in rows.items() if not abs(row.coefficient) > levels.moved * row.std}
    sizes = [name for name in rows if name not in law.shaping] or list(rows)
    if loose.keys() >= set(sizes) or unphysical(effect, values, refinement.physical_model):
        return [rows[name] for name in sizes]
    asked = {*law.essential, *(name for name in law.shaping if np.isfinite(effect.bounds(name)[0]))}
    return [row for name, row in loose.items() if name in asked or not np.isfinite(row.std)]


def _with_an_inertia_held(
    refinement: Refinement, rows: dict[str, EstimatedParameter]
) -> dict[str, EstimatedParameter]:
    """Return estimates with their standard deviations beside a known inertia.

    It is the inertia that tells most about them.
    """
    C, every = refinement.covariance, refinement.parameters
    inertias = [i for i, row in enumerate(every) if row.role == "linear" and KINDS[row.kind].inertial]
    known = [i for i in inertias if np.isfinite(C[i]).all() and C[i, i] > 0]
    if not known:
        return rows
    # conditional variance: covariance minus what one known inertia takes away
    own = [every.index(row) for row in rows.values()]
    variance = np.min([np.diag(C)[own] - C[i, own] ** 2 / C[i, i] for i in known], axis=0)
    std = np.sqrt(np.maximum(variance, 0.0))
    return {name: replace(row, std=float(sd)) for (name, row), sd in zip(rows.items(), std, strict=True)}


def _validated(refinement: Refinement, validation: Measurement | None, horizon: float | None) -> float:
    """Return the mean fit on validation data, or else on the fitted record."""
    if validation is None:
        return float(np.mean(refinement.fit))
    return float(np.mean(compare(refinement, validation, horizon=horizon).fit))


def detectable(
    tested: TestedResidual, scored: Sequence[Candidate], tests: int, significance: float, levels: Levels
) -> tuple[Detectable, ...]:
    """Return the smallest detectable coefficient of each simple candidate.

    Candidates with several coefficients or starts are left out. The power is 95 % by default
    (`Levels.power`), at the level `significance` shared by all tests and candidates. In a short record the
    effect is a large part of the residual, so the noise is that which would be taken for it then.
    """
    # two-sided, shared by all tests and candidates
    chance, found = significance / (2 * tests * max(len(scored), 1)), []
    for candidate in scored:
        if len(candidate.effect.free) != 1 or len(candidate.starts) != 1:
            continue
        smallest = _smallest(tested, candidate, chance, levels.power)
        for _ in range(_ROUNDS if stats.norm.isf(chance) ** 2 > _PART * tested.left.size else 0):
            if not np.isfinite(smallest):
                break
            columns = candidate.columns[tested.ratio]
            rows = zip(tested.fitted.residuals(tested.ratio), columns, strict=True)
            # in a short record the effect itself enters the noise model
            whitener = tested.fitted.problem.whitener([r + smallest * c[:, :, 0] for r, c in rows])
            spoiled = TestedResidual(tested.fitted, tested.ratio, whitener)
            smallest = max(smallest, _smallest(spoiled, candidate, chance, levels.power))
        if np.isfinite(smallest):
            parameter = candidate.problem.structure.parameters[-1]
            unit = candidate.problem.structure.unit(parameter)
            found.append(Detectable(candidate.effect, parameter.name, smallest, unit))
    return tuple(found)


def _smallest(tested: TestedResidual, candidate: Candidate, chance: float, power: float) -> float:
    """Return the smallest coefficient that the test of a candidate shows.

    It is infinite where nothing is seen of the candidate.
    """
    # whitened column outside the fitted directions
    white = tested.whiten(candidate.columns[tested.ratio])[:, 0]
    column = project(white, tested.basis)
    size = float(np.linalg.norm(column))
    if size <= 1e-9 * max(float(np.linalg.norm(white)), 1e-300):
        return np.inf
    free = max(tested.left.size - tested.basis.rank - 1, 1)
    noise = float(np.linalg.norm(tested.left)) / np.sqrt(free)
    # larger if the column is large on few samples, or on samples that are noisier than the rest
    spread = max(noise, float(np.linalg.norm(column * tested.left)) / size)
    few = 1.0 / float(np.sum((column / size) ** 4))
    return float((stats.t.isf(chance, min(free, few)) + power) * spread / size)
