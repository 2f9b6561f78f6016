"""The race: shortlist by score, laps, likelihood under one common whitening."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from ..effects.effect import Effect
from ..inference.descent import descend, remeasured
from ..inference.f_tests import FTest
from ..inference.fitted import FittedModel
from ..inference.search import step_matters
from ..inference.sensitivities import Candidate
from ..inference.whitening import Whitener
from ..progress import Progress
from ..systems.linear import Array
from .candidate_fit import (
    LACK,
    CandidateFit,
    continued,
    fitted_model,
    log_likelihood,
    price,
    prior_cost,
    whitener_of,
)
from .families import contains, in_families, start_from, stuck_fits
from .residual_tests import TestedResidual
from .starts import at_home, gain_for, imitated, led, observed, plain_cost, regressed
from .widths import settled_width

__all__ = ["CandidateFit", "CandidateFits", "fit_candidates", "shortlist"]

_SHORT = 5  # best of each score
_SHAPES = 3  # starts of a law that has a shape
_LAPS = (4, 6, 8)
_ROUNDS = 3
_EXCHANGES = 2
_LACK_SHARE = 0.05  # what a rival lacks over what it is behind: no such step brings it near
_AS_GOOD = 1.0  # twice the log-likelihood that makes no difference
STRONG = 75.0  # fit in percent of the model without the effect, below which it may move the resonances
_POLISHED = (60.0, 0.02)  # twice the log-likelihood behind the best, plus that per sample
_NEAR = 60.0  # twice the log-likelihood behind the leader within which rivals get its substeps
_STEP_SHARE = 0.25  # of a standard deviation that halving the substep may shift a coefficient
_MOST_HALVINGS = 4

_Task = tuple[FittedModel, Candidate, float, bool, bool, tuple[Array, ...]]


@dataclass(eq=False)
class CandidateFits:
    """Rivals in order of likelihood under one filter.

    Attributes
    ----------
    rivals : list of CandidateFit
        The most likely first.
    ratio : float
        Unmeasured force that was allowed for.
    whitener : Whitener
        Filter of the best.
    base_log_likelihood : float
        Of the model without any of them, in the same metric.
    left : tuple of Candidate
        Not fitted: they contain laws that do not lead.
    """

    fitted: FittedModel
    rivals: list[CandidateFit]
    ratio: float
    whitener: Whitener
    base_log_likelihood: float
    left: tuple[Candidate, ...] = ()
    _models: dict[int, FittedModel] = field(default_factory=dict)

    def model(self, index: int = 0) -> FittedModel:
        """The fitted model of one rival."""
        if index not in self._models:
            self._models[index] = fitted_model(self.fitted, self.rivals[index], self.whitener, self.ratio)
        return self._models[index]


def shortlist(
    candidates: Sequence[Candidate], batteries: Sequence[TestedResidual]
) -> tuple[list[int], list[FTest]]:
    """Indices of the candidates worth a refit, and the free-run score of every one.

    The best of each score (free run, observers of two gains), and all laws at the
    places that win one: the linearized score is right for weak effects, the observer's
    for strong ones.
    """
    scores = []
    chosen: list[int] = []
    for battery in batteries:
        tests = battery.each(candidates)
        scores.append(tests)
        order = sorted(range(len(tests)), key=lambda i: (tests[i].p_value, -tests[i].statistic))
        chosen += order[:_SHORT]
        chosen += sorted(order, key=lambda i: tests[i].p_equal)[: _SHORT // 2]  # what acts on few samples
        place = candidates[order[0]].effect.place
        chosen += [i for i, c in enumerate(candidates) if c.effect.place == place]
    chosen += [i for i, c in enumerate(candidates) if c.effect.spec.of_record]
    linear = batteries[0].fitted.structure.linear_model
    if linear.B.shape[1] == linear.C.shape[0] == 1:  # what is linear acts alike at either end of one path
        path = [i for i, c in enumerate(candidates) if c.effect.spec.at_channel and c.effect.spec.linear]
        chosen += path if set(path) & set(chosen) else []
    if not batteries[0].fitted.problem.in_time:  # no score is right for a peak that moved by its width
        chosen += [i for i, c in enumerate(candidates) if c.effect.spec.linear or c.effect.spec.delays]
    return list(dict.fromkeys(chosen)), scores[0]


def fit_candidates(
    fitted: FittedModel,
    candidates: Sequence[Candidate],
    ratio: float = 0.0,
    *,
    entered: Sequence[CandidateFit] = (),
    thorough: bool = False,
    progress: Progress | None = None,
) -> CandidateFits | None:
    """Refit candidates, all with the parameters of the fitted model.

    Each starts from the model as it is and from where an observer-led fit takes it; those
    that fall far behind after a lap are not polished. The others are polished in the
    metric of the best one's residual, in which their likelihoods are compared.

    Parameters
    ----------
    fitted : FittedModel
        Model without them.
    candidates : sequence of Candidate
        New in the race.
    ratio : float
        Unmeasured force to allow for.
    entered : sequence of CandidateFit
        From an earlier race, continued from where they stand.
    thorough : bool
        More laps and more starts: for when nothing fits.
    progress : Progress, optional
        What does the steps and counts them.

    Returns
    -------
    CandidateFits or None
        None where nothing could be refitted.
    """
    progress = progress or Progress()
    strong = float(np.min(fitted.refinement.fit)) < STRONG
    simple, general = in_families(candidates)
    tasks: list[_Task] = [(fitted, c, ratio, thorough, strong, ()) for c in simple]
    new = [r for r in progress.map(_laps, tasks, "first laps") if r is not None]
    old = [_entered(fitted, r, ratio) for r in progress.over(entered, "more laps")]
    rivals = _best_of_each([*old, *new])
    if not rivals:
        return None
    n = fitted.problem.n_points
    _run_laps(fitted, rivals, ratio, progress)
    leading = {r.effect.place for r in _near(rivals, n)}
    left = tuple(c for c in general if c.effect.place not in leading and not c.effect.spec.of_record)
    tasks = []
    for c in [c for c in general if c not in left]:
        inside = [r for r in rivals if contains(c.effect, r.effect)]
        points = [p for r in inside for p in imitated(r.candidate, r.descent.point, c, _SHAPES)]
        tasks.append((fitted, c, ratio, thorough, strong, tuple(points)))
    new = [r for r in progress.map(_laps, tasks, "first laps") if r is not None]
    rivals = _best_of_each([*rivals, *new])
    for _ in range(_EXCHANGES):
        if not _exchange(fitted, rivals, ratio):
            break
        _run_laps(fitted, rivals, ratio, progress)
    for rival in rivals:
        rival.free_run, rival.raced = rival.descent, None if ratio else rival.candidate
    whitener = whitener_of(min(rivals, key=lambda r: r.descent.cost))
    for rival in rivals:
        if rival.known is not None:  # it need not be sought again
            stands = (remeasured(rival.candidate.problem, d, whitener) for d in (rival.descent, rival.known))
            rival.descent = min(stands, key=lambda descent: descent.cost)
    polished = _near(rivals, n)
    for evaluations in (10, 6):
        for rival in progress.over(polished, "polishing"):
            rival.descent = continued(fitted, rival, ratio, whitener, evaluations, 1e-7)
        leader = min(polished, key=lambda r: r.descent.cost)
        previous, whitener = whitener, whitener_of(leader)
        if previous.orders == whitener.orders and np.allclose(previous.scales, whitener.scales, rtol=2e-3):
            break
    with progress.step("widths"):
        whitener = _settle_widths(fitted, rivals, polished, ratio, whitener)
    with progress.step("substeps"):
        whitener = _settle_substeps(fitted, polished, ratio, whitener)
    whitener = _from_free_runs(fitted, polished, ratio, whitener)
    _settle(fitted, rivals, ratio, whitener, progress)
    white = whitener.apply(fitted.residuals(ratio))
    base = -0.5 * (float(white @ white) + prior_cost(fitted.problem, fitted.point))
    # each holds the model without it: one that is less likely is no estimate
    rivals = [r for r in rivals if r.log_likelihood + price(r, white.size) >= base - LACK]
    rivals.sort(key=lambda r: -r.log_likelihood)
    return CandidateFits(fitted, rivals, ratio, whitener, base, left) if rivals else None


def _from_free_runs(
    fitted: FittedModel, rivals: Sequence[CandidateFit], ratio: float, whitener: Whitener
) -> Whitener:
    """Restart the finalists from their free-run optima where one of these has the smaller innovations.

    Those whose substeps or widths changed first find their free-run optima again. A filter fitted to slow
    errors makes these cheap: under it, a descent may end far from the free-run optimum.
    """
    plain = [replace(r, descent=r.free_run) for r in rivals if r.free_run is not None]
    for rival, free in zip(rivals, plain, strict=True):
        if rival.raced is not rival.candidate and not ratio:
            rival.free_run = free.descent = continued(fitted, free, ratio, None, 10)
            rival.raced = rival.candidate
    best = min(map(whitener_of, plain), key=lambda one: float(np.sum(np.log(one.scales))))
    if 2 * fitted.problem.n_points * np.mean(np.log(whitener.scales / best.scales)) <= _AS_GOOD:
        return whitener
    for rival, free in zip(rivals, plain, strict=True):
        stands = [remeasured(r.candidate.problem, r.descent, best) for r in (rival, free)]
        rival.descent = min(stands, key=lambda descent: descent.cost)
        rival.descent = continued(fitted, rival, ratio, best, 10, 1e-7)
    return whitener_of(min(rivals, key=lambda r: r.descent.cost))


def _entered(fitted: FittedModel, rival: CandidateFit, ratio: float) -> CandidateFit:
    """A rival of an earlier race: its free run is known, unless another force or other steps were allowed."""
    if ratio or rival.free_run is None or rival.raced is not rival.candidate:
        return CandidateFit(rival.candidate, continued(fitted, rival, ratio, None, 4))
    return CandidateFit(rival.candidate, rival.free_run, known=rival.descent)


def _best_of_each(rivals: Sequence[CandidateFit]) -> list[CandidateFit]:
    """One fit of each effect: it may come from an earlier race, and from new starts."""
    better: dict[Effect, CandidateFit] = {}
    for rival in rivals:
        other = better.get(rival.effect)
        if np.isfinite(rival.descent.cost) and (other is None or rival.descent.cost < other.descent.cost):
            better[rival.effect] = rival
    return list(better.values())


def _near(rivals: Sequence[CandidateFit], n: int) -> list[CandidateFit]:
    """Rivals that may still be the best one under whitening."""
    best = min(r.descent.cost for r in rivals)
    return [r for r in rivals if r.descent.cost <= best * np.exp(_POLISHED[0] / n + _POLISHED[1])]


def _settle(
    fitted: FittedModel, rivals: Sequence[CandidateFit], ratio: float, whitener: Whitener, progress: Progress
) -> None:
    """Likelihoods, each with its certificate: polished until what it lacks cannot change the order."""
    open_, rounds = list(rivals), 0
    while open_:
        for rival in open_:
            rival.log_likelihood = log_likelihood(rival, whitener)
            rival.descent = remeasured(rival.candidate.problem, rival.descent, whitener)
            rival.lack = rival.descent.lack
        top = max(r.log_likelihood for r in rivals)
        for rival in rivals:
            rival.settled = rival.lack <= max(LACK, _LACK_SHARE * (top - rival.log_likelihood))
        open_, rounds = [r for r in rivals if not r.settled], rounds + 1
        near = [r for r in rivals if 2 * (top - r.log_likelihood) <= _NEAR]
        if rounds > _ROUNDS:
            break
        for rival, giver in stuck_fits(near, fitted.problem.n_points, rounds == 1):
            if start_from(fitted, rival, giver, ratio, whitener):
                open_ = [*(r for r in open_ if r is not rival), rival]
        for rival in progress.over(open_, "polishing"):
            rival.descent = continued(fitted, rival, ratio, whitener, 10, 1e-9)


def _run_laps(fitted: FittedModel, rivals: Sequence[CandidateFit], ratio: float, progress: Progress) -> None:
    """Laps until each stands at a minimum, or where what it lacks cannot bring it near the best."""
    n = fitted.problem.n_points
    for laps in _LAPS:
        best = min(r.descent.cost for r in rivals)
        for rival in progress.over(rivals, "more laps"):
            behind = 0.5 * n * np.log(max(rival.descent.cost, 1e-300) / max(best, 1e-300))
            share = rival.descent.lack / max(rival.descent.cost, 1e-300)
            lack = -0.5 * n * np.log1p(-min(share, 1 - 1e-12))
            if lack > max(LACK, _LACK_SHARE * behind):
                rival.descent = continued(fitted, rival, ratio, None, laps)


def _exchange(fitted: FittedModel, rivals: Sequence[CandidateFit], ratio: float) -> bool:
    """Start laws again from the leader's force, and from a law that they contain; whether any gained."""
    n = fitted.problem.n_points
    leader = min(rivals, key=lambda r: r.descent.cost)
    gained = False
    for rival in rivals:
        behind = n * np.log(max(rival.descent.cost, 1e-300) / max(leader.descent.cost, 1e-300))
        if rival is leader or behind <= _AS_GOOD:
            continue
        gain = gain_for(fitted, rival.candidate, ratio)
        inside = [
            r for r in rivals if contains(rival.effect, r.effect) and r.descent.cost < rival.descent.cost
        ]
        givers = dict.fromkeys([leader, *inside])
        for point in [p for g in givers for p in imitated(g.candidate, g.descent.point, rival.candidate)]:
            again = descend(rival.candidate.problem, point, gain=gain, evaluations=4)
            if n * np.log(max(again.cost, 1e-300) / max(rival.descent.cost, 1e-300)) < -_AS_GOOD:
                rival.descent, gained = again, True
    return gained


def _settle_widths(
    fitted: FittedModel,
    rivals: Sequence[CandidateFit],
    polished: Sequence[CandidateFit],
    ratio: float,
    whitener: Whitener,
) -> Whitener:
    """Where friction leads, the width over which each law of friction there turns over."""
    leader = min(polished, key=lambda r: r.descent.cost)
    if not leader.effect.spec.turns:
        return whitener
    for rival in rivals:
        if rival.effect.place == leader.effect.place:
            gain = gain_for(fitted, rival.candidate, ratio)
            rival.candidate, rival.descent = settled_width(rival.candidate, rival.descent, gain, whitener)
    return whitener_of(min(polished, key=lambda r: r.descent.cost))


def _settle_substeps(
    fitted: FittedModel, rivals: Sequence[CandidateFit], ratio: float, whitener: Whitener
) -> Whitener:
    """Finer substeps for the leader and those near it, until they no longer matter."""
    for _ in range(_MOST_HALVINGS):
        leader = min(rivals, key=lambda r: r.descent.cost)
        problem = leader.candidate.problem
        if problem.structure.is_linear:
            break
        steps = 2 * problem.engines[0].substeps
        if step_matters(problem, leader.candidate.at(steps), leader.descent.point) < _STEP_SHARE:
            break
        for rival in rivals:
            near = 2 * (rival.descent.cost - leader.descent.cost) <= _NEAR
            if near and not rival.candidate.problem.structure.is_linear:
                rival.candidate = rival.candidate.finer(steps)
                rival.descent = continued(fitted, rival, ratio, whitener, 6, 1e-7)
        whitener = whitener_of(min(rivals, key=lambda r: r.descent.cost))
    return whitener


def _laps(task: _Task) -> CandidateFit | None:
    """First laps of one candidate: from absent and from where an observer takes it, or from points given."""
    fitted, candidate, ratio, thorough, strong, given = task
    problem = candidate.problem
    gain = gain_for(fitted, candidate, ratio)
    starts = candidate.starts[: 6 if thorough else _SHAPES]
    if given and not (strong or thorough):
        order = np.argsort([plain_cost(problem, point, gain) for point in given])[:2]
        runs = [descend(problem, given[i], gain=gain, evaluations=4) for i in order]
    elif thorough:
        points = [*starts, *(observed(fitted, candidate, start, ratio) for start in starts)]
        runs = [descend(problem, point, gain=gain, evaluations=12) for point in points]
    else:
        points = list(starts)
        if len(starts) == 1:
            points += regressed(fitted, candidate)
        else:
            points += [observed(fitted, candidate, start, ratio) for start in starts[:2]]
        runs = []
        for group in (points, at_home(problem, points)):
            costs = [plain_cost(problem, point, gain) for point in group]
            order = np.argsort(costs)[: 1 if len(starts) == 1 else 2]
            runs += [descend(problem, group[i], gain=gain, evaluations=4) for i in order]
    if (strong or thorough) and not problem.dwells:
        runs += [led(fitted, candidate, start, ratio) for start in starts[: 3 if thorough else 1]]
    best = min(runs, key=lambda run: run.cost)
    return CandidateFit(candidate, best) if np.isfinite(best.cost) else None
