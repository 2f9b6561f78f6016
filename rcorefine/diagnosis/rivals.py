"""The race: shortlist by score, laps, likelihood under one common whitening."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from ..physics.effects import Effect
from ..physics.laws import JUMPING
from ..progress import Progress
from ..refinement.outcome import _fit, _rows
from ..refinement.problem import Problem
from ..refinement.refinement import Refinement
from ..refinement.search import step_matters
from ..systems.linear import Array
from .battery import Battery
from .beginnings import at_home, gain_for, imitated, led, observed, plain_cost, regressed
from .columns import Candidate
from .descent import Descent, descend, lacking
from .state import Fitted, evaluated
from .whitening import FTest, Whitener
from .widths import settled_width

__all__ = ["Race", "Rival", "run_race", "shortlist"]

_SHORT = 5  # best of each score
_SHAPES = 3  # starts of a law that has a shape
_LAPS = (4, 6, 8)
_ROUNDS = 3
_EXCHANGES = 2
_LACK = 0.1  # log-likelihood that the next full step would gain, at most, at a minimum
_LACK_SHARE = 0.05  # the same over what a rival is behind: no such step brings it near
_AS_GOOD = 1.0  # twice the log-likelihood that makes no difference
_STRONG = 75.0  # fit in percent of the model without the effect, below which it may move the resonances
_POLISHED = (60.0, 0.02)  # twice the log-likelihood behind the best, plus that per sample
_NEAR = 60.0  # twice the log-likelihood behind the leader within which rivals get its substeps
_STEP_SHARE = 0.25  # of a standard deviation that halving the substep may shift a coefficient
_MOST_HALVINGS = 4
_TURNING = JUMPING | {"hysteresis"}


@dataclass(eq=False)
class Rival:
    """A candidate in the race, at its best point so far."""

    candidate: Candidate
    descent: Descent
    log_likelihood: float = -np.inf
    free_run: Descent | None = None  # its minimum of the plain error, before any whitening
    settled: bool = False  # at a minimum, or lacking too little to come near the best
    lack: float = np.inf  # log-likelihood that its next full step would gain

    @property
    def effect(self) -> Effect:
        """Its effect."""
        return self.candidate.effect

    @property
    def converged(self) -> bool:
        """Whether its gradient is small against its standard deviation."""
        return self.lack <= _LACK

    @property
    def n_coefficients(self) -> int:
        """Coefficients that it adds."""
        return self.candidate.problem.n_theta - self.candidate.fitted.problem.n_theta


@dataclass(eq=False)
class Race:
    """Rivals in order of likelihood under one filter.

    Attributes
    ----------
    rivals : list of Rival
        The most likely first.
    ratio : float
        Unmeasured force that was allowed for.
    whitener : Whitener
        Filter of the best.
    base_log_likelihood : float
        Of the model without any of them, in the same metric.
    """

    fitted: Fitted
    rivals: list[Rival]
    ratio: float
    whitener: Whitener
    base_log_likelihood: float
    _models: dict[int, Fitted] = field(default_factory=dict)

    def model(self, index: int = 0) -> Fitted:
        """The fitted model of one rival."""
        if index not in self._models:
            self._models[index] = _model(self.fitted, self.rivals[index], self.whitener, self.ratio)
        return self._models[index]

    def in_free_run(self, most: int) -> list[tuple[Effect, Refinement]]:
        """The rivals whose plain error is smallest, at the minimum of that error."""
        runs = [(r, r.free_run) for r in self.rivals if r.free_run is not None]
        found = []
        for rival, run in sorted(runs, key=lambda pair: pair[1].cost)[:most]:
            plain = replace(rival, descent=run)
            found.append((rival.effect, _model(self.fitted, plain, self.whitener, 0.0).refinement))
        return found


def shortlist(candidates: Sequence[Candidate], batteries: Sequence[Battery]) -> tuple[list[int], list[FTest]]:
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
        order = sorted(range(len(tests)), key=lambda i: _rank(tests[i]))
        chosen += order[:_SHORT]
        place = candidates[order[0]].effect.place
        chosen += [i for i, c in enumerate(candidates) if c.effect.place == place]
    return list(dict.fromkeys(chosen)), scores[0]


def _rank(test: FTest) -> tuple[float, float]:
    return test.p_value, -test.statistic


def run_race(
    fitted: Fitted,
    candidates: Sequence[Candidate],
    ratio: float = 0.0,
    *,
    entered: Sequence[Rival] = (),
    thorough: bool = False,
    progress: Progress | None = None,
) -> Race | None:
    """Refit candidates, all with the parameters of the fitted model.

    Each starts from the model as it is and from where an observer-led fit takes it; those
    that fall far behind after a lap are not polished. The others are polished in the
    metric of the best one's residual, in which their likelihoods are compared.

    Parameters
    ----------
    fitted : Fitted
        Model without them.
    candidates : sequence of Candidate
        New in the race.
    ratio : float
        Unmeasured force to allow for.
    entered : sequence of Rival
        From an earlier race, continued from where they stand.
    thorough : bool
        More laps and more starts: for when nothing fits.
    progress : Progress, optional
        What does the steps and counts them.

    Returns
    -------
    Race or None
        None where nothing could be refitted.
    """
    progress = progress or Progress()
    strong = float(np.min(fitted.refinement.fit)) < _STRONG
    tasks = [(fitted, c, ratio, thorough, strong) for c in candidates]
    new = [r for r in progress.map(_laps, tasks, "first laps") if r is not None]
    old = [
        Rival(r.candidate, _continued(fitted, r, ratio, None, 4)) for r in progress.over(entered, "more laps")
    ]
    rivals = [r for r in [*new, *old] if np.isfinite(r.descent.cost)]
    if not rivals:
        return None
    n = fitted.problem.n_points
    _run_laps(fitted, rivals, ratio, progress)
    for _ in range(_EXCHANGES):
        if not _exchange(fitted, rivals, ratio):
            break
        _run_laps(fitted, rivals, ratio, progress)
    for rival in rivals:
        rival.free_run = rival.descent
    whitener = _whitener_of(min(rivals, key=lambda r: r.descent.cost))
    best = min(r.descent.cost for r in rivals)
    near = best * np.exp(_POLISHED[0] / n + _POLISHED[1])
    polished = [r for r in rivals if r.descent.cost <= near]
    for evaluations in (10, 6):
        for rival in progress.over(polished, "polishing"):
            rival.descent = _continued(fitted, rival, ratio, whitener, evaluations, 1e-7)
        leader = min(polished, key=lambda r: r.descent.cost)
        previous, whitener = whitener, _whitener_of(leader)
        if previous.orders == whitener.orders and np.allclose(previous.scales, whitener.scales, rtol=2e-3):
            break
    with progress.step("widths"):
        whitener = _settle_widths(fitted, rivals, polished, ratio, whitener)
    with progress.step("substeps"):
        whitener = _settle_substeps(fitted, polished, ratio, whitener)
    _settle(fitted, rivals, ratio, whitener, progress)
    white = whitener.apply(fitted.residuals(ratio))
    base = -0.5 * (float(white @ white) + _prior(fitted.problem, fitted.point))
    # each holds the model without it: one that is less likely is no estimate
    rivals = [r for r in rivals if r.log_likelihood + _penalty(r, white.size) >= base - _LACK]
    rivals.sort(key=lambda r: -r.log_likelihood)
    return Race(fitted, rivals, ratio, whitener, base) if rivals else None


def _settle(
    fitted: Fitted, rivals: Sequence[Rival], ratio: float, whitener: Whitener, progress: Progress
) -> None:
    """Likelihoods, each with its certificate: polished until what it lacks cannot change the order."""
    open_, rounds = list(rivals), 0
    while open_:
        for rival in open_:
            rival.log_likelihood = _log_likelihood(rival, whitener)
            rival.lack = lacking(rival.candidate.problem, rival.descent, whitener)
        top = max(r.log_likelihood for r in rivals)
        for rival in rivals:
            rival.settled = rival.lack <= max(_LACK, _LACK_SHARE * (top - rival.log_likelihood))
        open_, rounds = [r for r in rivals if not r.settled], rounds + 1
        if rounds > _ROUNDS:
            break
        for rival in progress.over(open_, "polishing"):
            rival.descent = _continued(fitted, rival, ratio, whitener, 10, 1e-9)


def _run_laps(fitted: Fitted, rivals: Sequence[Rival], ratio: float, progress: Progress) -> None:
    """Laps until each stands at a minimum, or where what it lacks cannot bring it near the best."""
    n = fitted.problem.n_points
    for laps in _LAPS:
        best = min(r.descent.cost for r in rivals)
        for rival in progress.over(rivals, "more laps"):
            behind = 0.5 * n * np.log(max(rival.descent.cost, 1e-300) / max(best, 1e-300))
            share = rival.descent.lack / max(rival.descent.cost, 1e-300)
            lack = -0.5 * n * np.log1p(-min(share, 1 - 1e-12))
            if lack > max(_LACK, _LACK_SHARE * behind):
                rival.descent = _continued(fitted, rival, ratio, None, laps)


def _exchange(fitted: Fitted, rivals: Sequence[Rival], ratio: float) -> bool:
    """Start the laws at the leader's place again from the leader's force; whether any gained."""
    n = fitted.problem.n_points
    leader = min(rivals, key=lambda r: r.descent.cost)
    gained = False
    for rival in rivals:
        behind = n * np.log(max(rival.descent.cost, 1e-300) / max(leader.descent.cost, 1e-300))
        if rival is leader or behind <= _AS_GOOD:
            continue
        gain = gain_for(fitted, rival.candidate, ratio)
        for point in imitated(leader.candidate, leader.descent.point, rival.candidate):
            again = descend(rival.candidate.problem, point, gain=gain, evaluations=4)
            if n * np.log(max(again.cost, 1e-300) / max(rival.descent.cost, 1e-300)) < -_AS_GOOD:
                rival.descent, gained = again, True
    return gained


def _settle_widths(
    fitted: Fitted, rivals: Sequence[Rival], polished: Sequence[Rival], ratio: float, whitener: Whitener
) -> Whitener:
    """Where friction leads, the width over which each law of friction there turns over."""
    leader = min(polished, key=lambda r: r.descent.cost)
    if leader.effect.kind not in _TURNING:
        return whitener
    for rival in rivals:
        if rival.effect.place == leader.effect.place:
            gain = gain_for(fitted, rival.candidate, ratio)
            rival.candidate, rival.descent = settled_width(rival.candidate, rival.descent, gain, whitener)
    return _whitener_of(min(polished, key=lambda r: r.descent.cost))


def _settle_substeps(fitted: Fitted, rivals: Sequence[Rival], ratio: float, whitener: Whitener) -> Whitener:
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
                rival.descent = _continued(fitted, rival, ratio, whitener, 6, 1e-7)
        whitener = _whitener_of(min(rivals, key=lambda r: r.descent.cost))
    return whitener


def _laps(task: tuple[Fitted, Candidate, float, bool, bool]) -> Rival | None:
    """First laps of one candidate: from absent, and from where an observer takes it."""
    fitted, candidate, ratio, thorough, strong = task
    problem = candidate.problem
    gain = gain_for(fitted, candidate, ratio)
    starts = candidate.starts[: 6 if thorough else _SHAPES]
    if thorough:
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
    if strong or thorough:
        runs += [led(fitted, candidate, start, ratio) for start in starts[: 3 if thorough else 1]]
    best = min(runs, key=lambda run: run.cost)
    return Rival(candidate, best) if np.isfinite(best.cost) else None


def _continued(
    fitted: Fitted,
    rival: Rival,
    ratio: float,
    whitener: Whitener | None,
    evaluations: int,
    tolerance: float = 1e-4,
) -> Descent:
    return descend(
        rival.candidate.problem,
        rival.descent.point,
        gain=gain_for(fitted, rival.candidate, ratio),
        whitener=whitener,
        evaluations=evaluations,
        tolerance=tolerance,
    )


def _blocks(rival: Rival) -> list[tuple[Array, Array]]:
    return rival.descent.blocks(rival.candidate.problem)


def _whitener_of(rival: Rival) -> Whitener:
    return Whitener.fit([r for r, _ in _blocks(rival)])


def _prior(problem: Problem, point: Array) -> float:
    theta = problem.unpack(point)[0]
    mean, sd = problem.prior_mean, problem.prior_sd
    held = np.isfinite(sd)
    return float(np.sum(((theta[held] - mean[held]) / sd[held]) ** 2))


def _log_likelihood(rival: Rival, whitener: Whitener) -> float:
    """Each coefficient beyond the first costs half the log of the number of samples."""
    white = whitener.apply([r for r, _ in _blocks(rival)])
    prior = _prior(rival.candidate.problem, rival.descent.point)
    return -0.5 * (float(white @ white) + prior) - _penalty(rival, white.size)


def _penalty(rival: Rival, samples: int) -> float:
    return 0.5 * max(rival.n_coefficients - 1, 0) * float(np.log(samples))


def _words(rival: Rival) -> list[str]:
    """How far its fit got, and what stands at a bound."""
    bound = rival.candidate.problem.at_bound(rival.descent.point, rival.descent.slopes)
    far = "Not polished: far behind the best candidate." if rival.settled else "Not converged."
    state = "Converged." if rival.converged else far
    return [state, f"At its bound: {', '.join(bound)}."] if bound else [state]


def _model(fitted: Fitted, rival: Rival, whitener: Whitener, ratio: float) -> Fitted:
    """The rival as a refinement; its covariance is that of generalized least squares."""
    problem, point = rival.candidate.problem, rival.descent.point
    gain = gain_for(fitted, rival.candidate, ratio)
    blocks = _blocks(rival)
    white = whitener.apply([r for r, _ in blocks])
    J = whitener.apply([j for _, j in blocks])
    held = np.isfinite(problem.prior_sd) & (problem.prior_sd > 0)
    prior = np.zeros(problem.size)
    prior[: problem.n_theta][held] = problem.prior_sd[held] ** -2.0
    size = np.linalg.norm(J, axis=0)
    unfelt = np.flatnonzero(size <= 1e-100 * size.max())
    size[unfelt] = 1.0
    information = (J / size).T @ (J / size) + np.diag(prior / size**2)
    freedom = max(white.size - problem.size, 1)
    scale = float(white @ white) / freedom
    covariance = scale * np.linalg.pinv(information, rcond=1e-12, hermitian=True) / np.outer(size, size)
    covariance[unfelt, unfelt] = np.inf
    p = problem.n_theta
    spread = np.sqrt(np.maximum(np.diag(covariance)[:p], 0.0))
    old = fitted.refinement
    theta, starts = problem.unpack(point)
    free = [r for r, _ in (blocks if ratio == 0 else evaluated(problem, point))]
    error = np.concatenate([r / problem.weights[:, None] for r in free], axis=1)
    measured = np.concatenate([r.outputs for r in problem.records], axis=1)
    roles = [*old.roles, "effect"]
    refinement: Refinement = replace(
        old,
        effects=problem.structure.effects,
        roles=tuple(roles),
        constants=dict(problem.structure.constants),
        theta=theta.copy(),
        parameters=_rows(problem.structure, roles, theta, spread),
        covariance=covariance[:p, :p],
        fit=_fit(measured, error),
        rmse=np.sqrt(np.mean(error**2, axis=1)),
        initial_states=starts.copy(),
        substeps=problem.engines[0].substeps,
        residual_orders=whitener.orders,
        success=rival.converged,
        message=" ".join(_words(rival)),
        warnings=(),
    )
    extended = Fitted(refinement, problem, point, fitted.tolerance, fitted.force_at)
    extended._blocks[ratio] = blocks
    if gain is not None:
        extended._gains[ratio] = gain
    return extended
