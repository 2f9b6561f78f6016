"""The table of hypotheses of one record: screen, refit, compare, criticize."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
from hypotheses import FITTED_SPREAD, Trial, measured, parameters_of, score, steps_of
from noise import Noise, noise_of
from screening import Group, Screen, compatible
from verdict import EXCLUDED, eligible

from rcorefine.diagnosis.beside import Beside
from rcorefine.diagnosis.case import Case, not_held
from rcorefine.diagnosis.floating import is_number
from rcorefine.diagnosis.residual_tests import TestedResidual, passed_without_library, run_tests
from rcorefine.diagnosis.starts import plain_cost
from rcorefine.diagnosis.unmeasured_force import likely_forces
from rcorefine.diagnosis.verdict import overall
from rcorefine.effects.along_motion import unit_forces
from rcorefine.effects.effect import Effect
from rcorefine.engine.point import resting, tangents
from rcorefine.engine.structure import Structure
from rcorefine.inference.descent import Descent, descend
from rcorefine.inference.fitted import FittedModel, fitted_from
from rcorefine.inference.problem import Problem
from rcorefine.inference.search import step_matters
from rcorefine.inference.sensitivities import Candidate, candidate_columns
from rcorefine.inference.starts import estimated_motion, shape_starts
from rcorefine.inference.whitening import Whitener
from rcorefine.models.operating_point import sensed
from rcorefine.refinement.base_fit import base_fit
from rcorefine.systems.linear import Array

STRONG = 75.0  # fit in percent of the base below which screens led by an observer are asked as well
SINGLES, SETS, MOST = 6, 4, 4  # refits of each screen: single effects, sets; effects of a set
ROUNDS = 2  # linearizations about the winner
NEAR = 60.0  # log evidence behind the best within which a trial is polished
FORCES = 14  # sizes and places of an unmeasured force
STEP_SHARE = 0.25  # standard deviations that halving the substep may shift a coefficient

Values = list[dict[str, float]]  # coefficients of each effect, by name


class Start(NamedTuple):
    """Where a refit begins: coefficients of the effects, of the base, and initial states."""

    values: Values
    theta: Array
    states: Array


class Search:
    """Hypotheses about what a fitted model lacks, and their scores.

    Parameters
    ----------
    case : Case
        Model, records, library.

    Attributes
    ----------
    trials : list of Trial
        Hypotheses that were fitted.
    """

    def __init__(self, case: Case) -> None:
        self.case, self.fitted, self.motion = case, case.fitted, case.motions[0]
        self.trials: list[Trial] = []
        self.base_residual = [r for r, _ in self.fitted.blocks()]
        self.base_cost = 0.5 * sum(float(np.sum(r**2)) for r in self.base_residual)
        self.steps = steps_of(self.fitted.problem)
        self.price = float(np.log(max(len(case.library), 2)))
        self.substeps = 1
        self.log: dict[str, float] = {}
        self.odds: dict[int, float] = {}
        self._tested: dict[int, tuple[float, list[Any]]] = {}
        self._polished: set[int] = set()
        self._asked: set[Any] = set()
        self._kept: list[Any] = []  # their ids stay theirs
        self._ratios: dict[int, float] = {}

    @contextmanager
    def timed(self, name: str) -> Iterator[None]:
        """Add the CPU seconds of a step."""
        start = time.process_time()
        yield
        self.log[name] = self.log.get(name, 0.0) + time.process_time() - start

    # ------------------------------------------------------------ bases and scores
    @cached_property
    def numbers(self) -> list[tuple[Effect, float]]:
        """Parameters of the model with their nominal sizes."""
        return parameters_of(self.case)

    @cached_property
    def floated(self) -> FittedModel:
        """The model with every parameter free under its prior; as it is where it has none."""
        if not self.numbers:
            return self.fitted
        loose = [e.replace(prior={e.coefficients[0]: FITTED_SPREAD * s}) for e, s in self.numbers]
        problem, options = self.fitted.problem, self.case.options
        refined = base_fit(self.case.base, self.case.records, free=loose, **options)
        noise = 1.0 / problem.weights
        return fitted_from(refined, problem.records, tolerance=options["tolerance"], noise=noise)

    def ratio(self, base: FittedModel) -> float:
        """Unmeasured force over the measured one that a base allows for, 0 for none."""
        return self._ratios.get(id(base), 0.0)

    def gain(self, base: FittedModel, problem: Problem | None = None) -> Array | None:
        """Gain of the predictor at a base, None for the free run."""
        gain, n = base.gain(self.ratio(base)), (problem or base.problem).n_states
        return None if gain is None else np.pad(gain, ((0, n - gain.shape[0]), (0, 0)))

    def is_floated(self, trial: Trial) -> bool:
        """Whether the parameters are free in a trial."""
        return trial.base.problem.n_theta > self.fitted.problem.n_theta

    def posterior(self, trial: Trial) -> float:
        """Log evidence and log prior: each effect is one of the library, a force one of its sizes."""
        force = float(np.log(FORCES)) if self.ratio(trial.base) else 0.0
        return trial.total - float(np.log(2.0)) - self.price * len(trial.effects) - force

    @property
    def best(self) -> Trial:
        """The most probable of those whose every effect is determined."""
        return max((x for x in self.trials if eligible(x)), key=self.posterior)

    def scored(self, trial: Trial) -> Trial:
        """A trial with its noise and its score."""
        p0 = trial.base.problem.n_theta
        n, ratio = self.fitted.problem.n_theta, self.ratio(trial.base)
        trial.ratio = ratio
        before = [r for r, _ in trial.base.blocks(ratio)] if ratio else self.base_residual
        return score(trial, before, self.steps, p0, slice(n, p0) if p0 > n else slice(0, 0))

    def add(self, trial: Trial | None) -> Trial | None:
        """Enter a trial into the table."""
        if trial is not None and np.isfinite(trial.total):
            self.trials.append(trial)
        return trial

    @staticmethod
    def is_gain(effect: Effect) -> bool:
        """Whether an effect is the gain of a channel: a parameter of the record, beside the model's."""
        return bool(effect.spec.relative and effect.spec.at_channel)

    def is_free(self, group: Group) -> bool:
        """Whether a candidate is more than a parameter that is free already."""
        e = group.effect
        held = {(o.kind, o.place) for o, _ in self.numbers}
        return not is_number(e) or (self.is_gain(e) and (e.kind, e.place) not in held)

    def first_time(self, *key: Any) -> bool:
        """Whether something was not asked yet."""
        new = key not in self._asked
        self._asked.add(key)
        return new

    # ------------------------------------------------------------ refits
    def placed(self, base: FittedModel, effects: Sequence[Effect], start: Start) -> tuple[Problem, Array]:
        """The problem of effects at a base, and the point of a start."""
        problem, absent = base.extended(list(effects), self.motion)
        if self.substeps > problem.substeps and not problem.structure.is_linear:
            problem = problem.like(substeps=self.substeps)
        structure, theta = problem.structure, problem.unpack(absent)[0].copy()
        theta[: len(start.theta)] = start.theta
        first = len(structure.effects) - len(effects)
        for i, own in enumerate(start.values):
            for name, value in own.items():
                if (at := structure.position(first + i, name)) >= 0:
                    theta[at] = value
        states = np.zeros((len(problem.records), problem.n_states))
        states[:, : base.problem.n_states] = start.states[:, : base.problem.n_states]
        return problem, problem.inside(problem.pack(theta, states))

    def absent(self, base: FittedModel) -> Start:
        """The base without any effect."""
        theta, states = base.problem.unpack(base.point)
        return Start([], theta, states)

    def refit(
        self,
        effects: Sequence[Effect],
        base: FittedModel,
        starts: Sequence[Start],
        *,
        shares: Sequence[float] = (1.0,),
        led: bool = False,
        evaluations: int = 8,
    ) -> Trial | None:
        """Fit a set of effects at a base, from the best of some starts.

        Sizes are tried at shares of those of a start; where none helps, `led` lets observers of falling gain
        take the last start into the free run.
        """
        tried, point, problem = [], None, None
        for start in starts:
            for share in shares:
                problem, point = self.placed(base, effects, self._shared(base, effects, start, share))
                gain = self.gain(base, problem)
                tried.append((plain_cost(problem, point, gain), point))
                if tried[-1][0] < 0.3 * self.base_cost:
                    break
        if problem is None or point is None:
            return None
        cost, nearest = min(tried, key=lambda one: one[0])
        run = descend(problem, nearest, gain=gain, evaluations=evaluations) if np.isfinite(cost) else None
        if led and problem.in_time and (run is None or run.cost > 0.1 * self.base_cost):
            point = self.placed(base, effects, starts[0])[1]
            other = self._led(problem, point, nearest, base, evaluations)
            run = other if run is None or other.cost < run.cost else run
        if run is None or not np.isfinite(run.cost):
            return None
        return self._under_own_noise(tuple(effects), base, problem, run, gain, evaluations)

    @staticmethod
    def _shared(base: FittedModel, effects: Sequence[Effect], start: Start, share: float) -> Start:
        """A start with its sizes, and what the base moved for them, times a share."""
        if share == 1.0:
            return start
        values = [
            {n: v if n in e.spec.shaping or e.spec.secant else share * v for n, v in own.items()}
            for e, own in zip(effects, start.values, strict=True)
        ]
        theta, states = base.problem.unpack(base.point)
        n = min(states.shape[1], start.states.shape[1])
        mixed = states[:, :n] + share * (start.states[:, :n] - states[:, :n])
        return Start(values, theta + share * (start.theta - theta), mixed)

    def _led(
        self, problem: Problem, point: Array, nearest: Array, base: FittedModel, evaluations: int
    ) -> Descent:
        """A descent that observers of falling gain lead along the record before it runs free."""
        for ratio in (1.0, 0.1):
            try:
                strong = _padded(base.gain(ratio), problem)
            except (np.linalg.LinAlgError, ValueError):  # no observer of that gain exists
                continue
            run = descend(problem, point, gain=strong, evaluations=5, tolerance=1e-3)
            point = run.point if np.isfinite(run.cost) else point
        gain = self.gain(base, problem)
        options = [point, problem.pack(problem.unpack(point)[0], problem.unpack(nearest)[1])]
        costs = [plain_cost(problem, option, gain) for option in options]
        return descend(problem, options[int(np.argmin(costs))], gain=gain, evaluations=evaluations)

    def _under_own_noise(
        self,
        effects: tuple[Effect, ...],
        base: FittedModel,
        problem: Problem,
        run: Descent,
        gain: Array | None,
        evaluations: int,
    ) -> Trial:
        """The fit under its own noise, which changes with it: as long as the score rises."""
        best = self.scored(Trial(effects, base, problem, run.point, run.blocks(problem)))
        for _ in range(3):
            assert best.noise is not None
            again = descended(problem, best.point, best.noise, gain, evaluations)
            if not np.isfinite(again.cost):
                break
            trial = self.scored(Trial(effects, base, problem, again.point, again.blocks(problem)))
            gained = trial.total - best.total
            best = trial if gained > 0 else best
            if gained < 1.0 or best.noise is None or not best.noise.uneven:
                break
        return best

    def empty(self, base: FittedModel) -> Trial:
        """A base without effects, under its own noise."""
        run = descend(base.problem, base.point, gain=self.gain(base), evaluations=1)
        return self._under_own_noise((), base, base.problem, run, self.gain(base), 8)

    # ------------------------------------------------------------ the search
    def run(self) -> Search:
        """Fill the table."""
        case = self.case
        with self.timed("bases"):
            self.add(self.empty(self.fitted))
            if self.floated is not self.fitted:
                self.add(self.empty(self.floated))
        strong = bool(self.fitted.problem.in_time and self.trials[0].fit.min() < STRONG)
        with self.timed("columns"):
            ratios = (0.0, 1.0) if strong else (0.0,)
            scored = candidate_columns(self.fitted, case.library, self.motion, ratios)
        with self.timed("screens"):
            screens = self.screens(self.fitted, scored, strong)
            singles = [s.beam(1, False, self.price)[: SINGLES + 1] for s in screens]
        with self.timed("singles"):
            for _, groups in [one for ranked in singles for one in ranked if one[1]]:
                self.single(groups[0].effect, screens, strong)
            places = {e.place for e in self.best.effects}
            for group in screens[0].groups:  # relatives
                if group.effect.place in places:
                    self.single(group.effect, screens, strong)
        with self.timed("beside"):
            order = sorted((x for x in self.trials if len(x.effects) == 1), key=self.posterior)[::-1]
            for trial in [x for x in order if not is_number(x.effects[0]) or self.is_gain(x.effects[0])][:3]:
                self.beside(trial)
        self.polish()
        if not self.passed(self.best):
            with self.timed("sets"):
                self.sets(screens, strong)
            self.cores()
            self.polish()
        for _ in range(ROUNDS):
            before = self.best
            if self.passed(before):
                break
            with self.timed("relinearized"):
                self.relinearized(before)
            self.cores()
            self.polish()
            if self.best is before:
                break
        if case.in_time and (self.best.effects or not self.passed(self.best)):
            with self.timed("forces"):
                self.forces()
            self.polish()
        with self.timed("names"):
            self.prune()
            self.names()
        self.polish()
        return self

    def screens(self, fitted: FittedModel, scored: Sequence[Candidate], strong: bool) -> list[Screen]:
        """Screens at a model: in plain metric, under its own noise, under that of the best set, led."""
        numbers = [e for e, _ in self.numbers]
        sd = FITTED_SPREAD * np.array([s for _, s in self.numbers])
        residual = [r for r, _ in fitted.blocks()]

        def made(whitener: Whitener, weights: Any = None, ratio: float = 0.0) -> Screen:
            return Screen(fitted, scored, numbers, sd, whitener, ratio, self.motion, weights)

        plain = made(Whitener.fit(residual, order=0))
        found, own = [plain], noise_of(residual, measured(fitted.problem), self.steps)
        if any(own.whitener.orders) or own.uneven:
            found.append(made(own.whitener, own.weights))
        best = plain.beam(MOST, True, self.price, usable=self.is_free)[0]
        left = plain.left(best[1], True)
        if len(left) == sum(r.size for r in residual):
            parts = np.split(left, np.cumsum([r.size for r in residual])[:-1])
            shaped = [part.reshape(r.shape) for part, r in zip(parts, residual, strict=True)]
            other = noise_of(shaped, measured(fitted.problem), self.steps)
            if any(other.whitener.orders) and other.whitener.orders != own.whitener.orders:
                found.append(made(other.whitener))
        if strong:
            found.append(made(Whitener.fit([r for r, _ in fitted.blocks(1.0)]), None, 1.0))
        return found

    def single(self, effect: Effect, screens: Sequence[Screen], led: bool) -> None:
        """One effect in the model as it is."""
        if not self.first_time("single", effect):
            return
        starts = []
        for screen in screens[::-1]:
            own = [g for g in screen.groups if g.effect == effect]
            own = sorted(own, key=lambda g: -screen.solve([g], False)[0])
            starts += [Start(*screen.start([g], False, self.fitted)) for g in own[:2]]
        self.add(self.refit((effect,), self.fitted, starts, shares=(1.0, 0.4, 0.1), led=led))

    def sets(self, screens: Sequence[Screen], led: bool) -> None:
        """Sets of effects beside the parameters: a short fit of each, and the best to the end."""
        begun: list[Trial] = []
        for screen in screens:
            ranked = [one for one in screen.beam(MOST, True, self.price, usable=self.is_free) if one[1]]
            for _, groups in ranked[:SETS]:
                effects = tuple(g.effect for g in groups)
                if self.first_time("set", frozenset(effects)):
                    start = Start(*screen.start(groups, self.floated is not self.fitted, self.floated))
                    given = {"shares": (1.0, 0.4, 0.1), "led": led, "evaluations": 5}
                    trial = self.add(self.refit(effects, self.floated, [start], **given))
                    begun += [trial] if trial is not None else []
        for trial in sorted(begun, key=self.posterior)[::-1][:4]:
            self.add(self.refit(trial.effects, trial.base, [start_of(trial)], evaluations=8))

    def beside(self, trial: Trial) -> None:
        """A trial of the model as it is, beside the parameters."""
        if self.floated is self.fitted or not self.first_time("set", frozenset(trial.effects)):
            return
        here, n = start_of(trial), self.fitted.problem.n_theta
        nominal = np.concatenate([here.theta[:n], self.floated.problem.prior_mean[n:]])
        starts = [here._replace(theta=theta) for theta in (nominal, self.floated.theta)]
        self.add(self.refit(trial.effects, self.floated, starts))

    def relinearized(self, trial: Trial) -> None:
        """More effects about the winner, beside the parameters."""
        fitted = as_fitted(trial)
        rest = not_held(self.case.library, fitted.structure.effects)
        rest = [e for e in rest if not is_number(e) or self.is_gain(e)]
        scored = candidate_columns(fitted, rest, self.motion, (0.0,))
        numbers = [] if self.is_floated(trial) else self.numbers
        sd = FITTED_SPREAD * np.array([s for _, s in numbers])
        here = start_of(trial)
        if not self.is_floated(trial) and self.floated is not self.fitted:
            mean = self.floated.problem.prior_mean[len(here.theta) :]
            here = here._replace(theta=np.concatenate([here.theta, mean]))
        held = [Group.of(e) for e in trial.effects]
        residual = [r for r, _ in fitted.blocks()]
        own = noise_of(residual, measured(fitted.problem), self.steps)
        for whitener, weights in ((Whitener.fit(residual, order=0), None), (own.whitener, own.weights)):
            given = ([e for e, _ in numbers], sd, whitener, 0.0, self.motion, weights)
            screen = Screen(fitted, scored, *given)
            for _, groups in [one for one in screen.beam(2, True, self.price) if one[1]][:3]:
                effects = (*trial.effects, *(g.effect for g in groups))
                fine = len(effects) <= MOST + 1 and all(compatible(held, g) for g in groups)
                if fine and self.first_time("set", frozenset(effects)):
                    values = screen.start(groups, False, fitted)[0]
                    start = here._replace(values=[*here.values, *values])
                    weaker = [{n: 0.3 * v for n, v in own.items()} for own in values]
                    weak = here._replace(values=[*here.values, *weaker])
                    self.add(self.refit(effects, self.floated, [start, weak]))

    def forces(self) -> None:
        """An unmeasured force beside nothing, and beside the leaders."""
        best = self.best
        fewer = [x for x in self.trials if 0 < len(x.effects) < len(best.effects) and eligible(x)]
        leaders = [
            best,
            *sorted(fewer, key=self.posterior)[::-1][:2],
            *[x for x in self.trials if not x.effects],
        ]
        for trial in dict.fromkeys(leaders):
            if self.ratio(trial.base):
                continue
            fitted = as_fitted(trial)
            for led in likely_forces(fitted, TestedResidual(fitted), 3.0, self.case.levels)[:1]:
                base = trial.base.forced(led.fitted.force_at)
                base = replace(base) if base is trial.base else base
                self._kept.append(base)
                self._ratios[id(base)] = led.ratio
                if trial.effects:
                    self.add(self.refit(trial.effects, base, [start_of(trial)]))
                else:
                    self.add(self.empty(base))

    def without(self, trial: Trial, kept: Sequence[int]) -> None:
        """A trial with some of its effects, from where it stands."""
        effects = tuple(trial.effects[k] for k in kept)
        if not effects or not self.first_time("without", frozenset(effects), id(trial)):
            return
        start = start_of(trial)
        start = start._replace(values=[start.values[k] for k in kept])
        again = self.refit(effects, trial.base, [start], evaluations=10)
        same = [x for x in self.trials if set(x.effects) == set(effects) and x.base is trial.base]
        if again is not None and self.posterior(again) > max(map(self.posterior, same), default=-np.inf):
            self.add(again)

    def cores(self) -> None:
        """Of the leading sets with undetermined members: those that are determined, and all but one."""
        with self.timed("cores"):
            for trial in sorted(self.trials, key=self.posterior)[::-1][:4]:
                if len(trial.effects) < 2 or eligible(trial):
                    continue
                sure = np.array(trial.surest()) >= 3.0
                self.without(trial, np.flatnonzero(sure))
                for i in np.flatnonzero(~sure):
                    self.without(trial, np.delete(np.arange(len(sure)), i))

    def prune(self) -> None:
        """The winner without each of its weaker effects."""
        for _ in range(MOST):
            best = self.best
            if len(best.effects) < 2:
                return
            for i in np.argsort(best.surest())[:2]:
                self.without(best, [k for k in range(len(best.effects)) if k != i])
            if self.best is best:
                return

    def names(self) -> None:
        """The winner with each force replaced by other laws at its place that imitate it."""
        for _ in range(2):
            best = self.best
            here = start_of(best)
            for i in range(len(best.effects)):
                for other, values in self._imitations(best, i):
                    effects = tuple(other if k == i else e for k, e in enumerate(best.effects))
                    own = [values if k == i else v for k, v in enumerate(here.values)]
                    self.add(self.refit(effects, best.base, [here._replace(values=own)], evaluations=10))
            if self.best is best:
                return

    def _imitations(self, trial: Trial, i: int, most: int = 3) -> list[tuple[Effect, dict[str, float]]]:
        """Laws at the place of one effect that come nearest to its force, with their coefficients."""
        along = force_of(trial, i)
        if along is None:
            return []
        d, v, w, force = along
        structure, place = trial.problem.structure, trial.effects[i].place
        held, options = {(e.kind, e.place) for e in trial.effects}, []
        for other in self.case.library:
            if other.place != place or (other.kind, place) in held or is_number(other):
                continue
            if not self.first_time("name", frozenset(trial.effects), i, other):
                continue
            one = Structure(structure.model, [other])
            for start in shape_starts(one, one.start(), self.motion):
                own = dict(zip([q.name for q in one.parameters], map(float, start), strict=True))
                shape = {n: value for n, value in own.items() if n in other.spec.shaping}
                free = [n for n in other.free if n not in shape]
                columns = unit_forces(other, d, v, [shape], w, resting(structure, place))
                if columns and len(columns) == len(free):
                    F = np.array(columns).T
                    levels = np.linalg.lstsq(F, force, rcond=1e-10)[0]
                    left = float(np.sum((force - F @ levels) ** 2) / np.sum(force**2))
                    options.append((left, other, {**shape, **dict(zip(free, levels, strict=True))}))
        best: dict[Effect, dict[str, float]] = {}
        for left, other, values in sorted(options, key=lambda o: o[0]):
            if left < 0.6 and len(best) < most:
                best.setdefault(other, values)
        return list(best.items())

    # ------------------------------------------------------------ polish
    def polish(self, most: int = 4) -> None:
        """Polish the leaders until the order among them holds."""
        with self.timed("polish"):
            for _ in range(most):
                best = self.posterior(self.best)
                todo = [x for x in self.trials if x.effects and id(x) not in self._polished]
                todo = [x for x in todo if eligible(x) and self.posterior(x) > best - NEAR]
                if not todo:
                    return
                trial = max(todo, key=self.posterior)
                self._polished.add(id(trial))
                better = self._polish(trial)
                if self.posterior(better) > self.posterior(trial) - 1.0:
                    self.trials[self.trials.index(trial)] = better
                    self._polished.add(id(better))
                    self._kept.append(trial)

    def _polish(self, trial: Trial) -> Trial:
        """The trial at its minimum, with the substeps and widths that the record asks for."""
        problem, gain = trial.problem, self.gain(trial.base, trial.problem)
        # weights take errors of a fit that is far from its minimum for outliers: once without them
        plain = descend(problem, trial.point, gain=gain, evaluations=20, tolerance=1e-6)
        if np.isfinite(plain.cost):
            again = self._under_own_noise(trial.effects, trial.base, problem, plain, gain, 8)
            trial = again if self.posterior(again) > self.posterior(trial) else trial
        noise = trial.noise
        assert noise is not None
        run = descended(problem, trial.point, noise, gain, 8, 1e-7)
        if not problem.structure.is_linear and problem.in_time:
            for _ in range(3):
                finer = problem.like(substeps=2 * problem.substeps)
                if step_matters(problem, finer, run.point) < STEP_SHARE:
                    break
                problem = finer
                self.substeps = max(self.substeps, problem.substeps)
                run = descended(problem, run.point, noise, gain, 6, 1e-7)
        structure = problem.structure
        for k in range(len(structure.effects) - len(trial.effects), len(structure.effects)):
            effect, price = structure.effects[k], 0.5 * float(np.log(problem.n_points))
            for factor in (
                (0.5, 2.0, 1 / 1.4, 1.4) if effect.spec.jumps and "width" not in effect.fixed else ()
            ):
                for _ in range(4):
                    widths = problem.structure.constants
                    widths = {**widths, k: factor * widths[k]}
                    other = problem.like(Structure(structure.model, structure.effects, constants=widths))
                    again = descended(other, run.point, noise, gain, 5, 1e-7)
                    if not again.cost < run.cost - price:
                        break
                    problem, run, price = other, again, 1.0
        if not np.isfinite(run.cost):
            return trial
        return self.scored(Trial(trial.effects, trial.base, problem, run.point, run.blocks(problem)))

    # ------------------------------------------------------------ criticism
    def passed(self, trial: Trial) -> bool:
        """Whether the residual of a trial is noise, and no free force beats its laws."""
        p = self.tested(trial)[0]
        return p >= self.case.significance and self.odds[id(trial)] <= float(np.log(1 / EXCLUDED))

    def tested(self, trial: Trial) -> tuple[float, list[Any]]:
        """Smallest p-value of the residual tests, corrected for their number, and the tests."""
        if id(trial) not in self._tested:
            with self.timed("tests"):
                self._tested[id(trial)] = self._tests_of(trial)
        return self._tested[id(trial)]

    def _tests_of(self, trial: Trial) -> tuple[float, list[Any]]:
        fitted, odds = as_fitted(trial), -np.inf
        self.odds[id(trial)] = odds
        motions = [estimated_motion(fitted.structure, fitted.theta, m.data) for m in self.case.motions]
        ratio = self.ratio(trial.base)
        battery = TestedResidual(fitted, ratio)
        others = passed_without_library(battery, motions, self.case.significance)
        if others is None:
            return 0.0, []
        rest = not_held(self.case.library, fitted.structure.effects)
        scored = candidate_columns(fitted, rest, motions[0], (ratio,))
        tests = run_tests(battery, scored, motions, 0, others)
        if fitted.problem.in_time and overall(tests) >= self.case.significance:
            for place in dict.fromkeys(e.place for e in trial.effects):
                forces = [force_of(trial, i) for i, e in enumerate(trial.effects) if e.place == place]
                forces = [one for one in forces if one is not None]
                if forces:
                    beside = Beside(battery, place)
                    tests += beside.tests()
                    odds = float(np.logaddexp(odds, beside.odds(sum(one[-1] for one in forces))))
        self.odds[id(trial)] = odds
        return overall(tests), tests

    def table(self) -> list[tuple[float, Trial]]:
        """Best trial of each set of effects and kind of base, with its log posterior."""
        rows: dict[Any, tuple[float, Trial]] = {}
        for trial in self.trials:
            key, value = (frozenset(trial.effects), self.is_floated(trial)), self.posterior(trial)
            if key not in rows or rows[key][0] < value:
                rows[key] = value, trial
        return sorted(rows.values(), key=lambda row: -row[0])


def _padded(gain: Array | None, problem: Problem) -> Array | None:
    return None if gain is None else np.pad(gain, ((0, problem.n_states - gain.shape[0]), (0, 0)))


def descended(
    problem: Problem,
    point: Array,
    noise: Noise,
    gain: Array | None,
    evaluations: int,
    tolerance: float = 1e-6,
) -> Descent:
    """Descend in the metric of a noise; the evaluation is that of plain weights."""
    given: dict[str, Any] = {"gain": gain, "whitener": noise.whitener, "tolerance": tolerance}
    if not noise.uneven:
        return descend(problem, point, evaluations=evaluations, **given)
    run = descend(weighted(problem, noise), point, evaluations=evaluations, **given)
    return descend(problem, run.point, gain=gain, evaluations=1) if np.isfinite(run.cost) else run


def weighted(problem: Problem, noise: Noise) -> Problem:
    """The problem with the samples weighted by their noise."""
    found, plain = problem.like(), problem.judged
    judged: Callable[[Array], list[Array]] = lambda theta: [  # noqa: E731
        j * w for j, w in zip(plain(theta), noise.weights, strict=True)
    ]
    found.judged = judged  # type: ignore[method-assign]
    return found


def start_of(trial: Trial) -> Start:
    """Where a trial stands, as a start."""
    theta, states = trial.problem.unpack(trial.point)
    structure = trial.problem.structure
    first = len(structure.effects) - len(trial.effects)
    values: Values = [{} for _ in trial.effects]
    for k, q in enumerate(structure.parameters):
        if q.effect >= first:
            values[q.effect - first][q.name] = float(theta[k])
    return Start(values, theta[: trial.base.problem.n_theta], states)


def as_fitted(trial: Trial) -> FittedModel:
    """A trial as a fitted model that can be tested and added to."""
    old, problem, blocks = trial.base.refinement, trial.problem, trial.blocks
    theta, starts = problem.unpack(trial.point)
    errors = np.concatenate([b / problem.weights[:, None] for b, _ in blocks], axis=1)
    refinement = replace(
        old,
        effects=problem.structure.effects,
        roles=(*old.roles, *("effect",) * len(trial.effects)),
        constants=dict(problem.structure.constants),
        theta=theta.copy(),
        initial_states=starts.copy(),
        substeps=problem.engines[0].substeps,
        fit=trial.fit,
        rmse=np.sqrt(np.mean(errors**2, axis=1)),
    )
    noise = trial.noise
    if noise is not None and noise.uneven:
        problem = weighted(problem, noise)
        blocks = [(w * r, w[:, :, None] * j) for w, (r, j) in zip(noise.weights, blocks, strict=True)]
    found = FittedModel(refinement, problem, trial.point, trial.base.tolerance, trial.base.force_at)
    found._blocks[trial.ratio] = blocks
    return found


def force_of(trial: Trial, i: int) -> tuple[Array, Array, Array, Array] | None:
    """Motion at the place of an effect, inputs and its force, records joined; None where it is none."""
    problem, structure = trial.problem, trial.problem.structure
    k = len(structure.effects) - len(trial.effects) + i
    if k not in structure.port_effects:
        return None
    theta, starts = problem.unpack(trial.point)
    at, rows = list(structure.port_effects).index(k), []
    place = structure.effects[k].place
    (d0, v0), rest = resting(structure, place) or (0.0, 0.0), tangents(structure, theta)[at]
    for engine, start in zip(problem.engines, starts, strict=True):
        run = engine.run(theta, start, sensitivity=False, histories=True, check=False)
        d, v = sensed(structure.model, place, run.states, engine.data.inputs)
        force = run.forces[at] - (rest[0] + rest[1] * (d - d0) + rest[2] * (v - v0))
        rows.append((d, v, engine.data.inputs, force))
    d, v, w, force = (np.concatenate(parts, axis=-1) for parts in zip(*rows, strict=True))
    return (d, v, w, force) if np.isfinite([d, v, force]).all() and force.any() else None
