"""The search: screen, refit, table, criticism of the winner."""

from __future__ import annotations

import time
from dataclasses import replace
from functools import cached_property

import numpy as np
from hypotheses import FITTED_SPREAD, Trial, measured, parameters_of, score, steps_of
from noise import noise_of
from screening import Screen, compatible
from verdict import eligible

from rcorefine.diagnosis.beside import Beside
from rcorefine.diagnosis.case import Case, not_held
from rcorefine.diagnosis.floating import is_number
from rcorefine.diagnosis.residual_tests import TestedResidual, run_tests
from rcorefine.diagnosis.starts import plain_cost
from rcorefine.diagnosis.verdict import overall
from rcorefine.effects.along_motion import unit_forces
from rcorefine.engine.point import forces_at_rest, resting
from rcorefine.engine.structure import Structure
from rcorefine.inference.descent import descend
from rcorefine.inference.fitted import FittedModel, fitted_from
from rcorefine.inference.sensitivities import candidate_columns
from rcorefine.inference.search import step_matters
from rcorefine.inference.starts import estimated_motion, shape_starts
from rcorefine.inference.whitening import Whitener
from rcorefine.models.operating_point import sensed
from rcorefine.refinement.base_fit import base_fit

STRONG = 75.0
NOTHING, NUMBERS = np.log(0.5), np.log(0.5)


class Search:
    def __init__(self, case: Case, *, most=4, singles=6, sets=5, rounds=2):
        self.case, self.fitted, self.motion = case, case.fitted, case.motions[0]
        self.most, self.singles, self.sets, self.rounds = most, singles, sets, rounds
        self.log = {}
        self.base_residual = [r for r, _ in self.fitted.blocks()]
        self.steps = steps_of(self.fitted.problem)
        self.n_base = self.fitted.problem.n_theta
        self.trials = []
        self._tested, self._polished, self._kept = {}, set(), []
        self._pruned = set()
        self.odds = {}
        self.substeps = 1
        self.price = np.log(max(len(case.library), 2))

    def clock(self, name, start):
        self.log[name] = self.log.get(name, 0.0) + time.process_time() - start

    # ------------------------------------------------------------ bases
    @cached_property
    def numbers(self):
        return parameters_of(self.case)

    @cached_property
    def floated(self):
        """The model with every parameter free under its prior; None where it has none."""
        if not self.numbers:
            return None
        start = time.process_time()
        loose = [e.replace(prior={e.coefficients[0]: FITTED_SPREAD * s}) for e, s in self.numbers]
        problem = self.fitted.problem
        refined = base_fit(self.case.base, self.case.records, free=loose, **self.case.options)
        found = fitted_from(
            refined, problem.records, tolerance=self.case.options["tolerance"], noise=1.0 / problem.weights
        )
        self.clock("floated", start)
        return found

    def span(self, base):
        """Coefficients of the parameters in a base."""
        return slice(self.n_base, self.floated.problem.n_theta) if base is not self.fitted else slice(0, 0)

    def scored(self, trial):
        return score(trial, self.base_residual, self.steps, trial.base.problem.n_theta, self.span(trial.base))

    def empty(self, base):
        gain = base.gain(0.0)
        run = descend(base.problem, base.point, gain=gain, evaluations=1)
        return self._under_own_noise((), base, base.problem, run, gain, 8)

    # ------------------------------------------------------------ refits
    def refit(self, effects, base, starts, *, known=(), led=False, evaluations=(8, 8)):
        """Refit a set of effects at a base, from the best of some starts."""
        problem, absent = base.extended(list(effects), self.motion)
        if self.substeps > problem.substeps and not problem.structure.is_linear:
            problem = problem.like(substeps=self.substeps)
        p0, structure = base.problem.n_theta, problem.structure
        first = len(structure.effects) - len(effects)
        held = [
            i
            for i, q in enumerate(structure.parameters[p0:], p0)
            if q.name in structure.effects[q.effect].spec.shaping or structure.effects[q.effect].spec.secant
        ]
        gain = self._padded(base.gain(0.0), problem)
        tried, led_starts = [], []
        for values, theta, x0 in starts:
            full = problem.unpack(absent)[0].copy()
            full[:p0] = theta
            for (i, name), value in values.items():
                at = structure.position(first + i, name)
                if at >= 0:
                    full[at] = value
            states = np.pad(x0, ((0, 0), (0, problem.n_states - x0.shape[1])))
            point = problem.pack(full, states)
            led_starts.append(point)
            for share in (1.0, 0.4, 0.1):
                mixed = absent + share * (point - absent)
                mixed[held] = point[held]
                mixed = problem.inside(mixed)
                tried.append((plain_cost(problem, mixed, gain), mixed))
                if share == 1.0 and tried[-1][0] < 0.3 * self.base_cost:
                    break
        tried += [(plain_cost(problem, point, gain), point) for point in known]
        if not tried:
            return None
        cost, best = min(tried, key=lambda t: t[0])
        run = descend(problem, best, gain=gain, evaluations=evaluations[0]) if np.isfinite(cost) else None
        if led and problem.in_time and (run is None or run.cost > 0.1 * self.base_cost):
            point = led_starts[0] if led_starts else best
            for ratio in (1.0, 0.1):
                try:
                    strong = self._padded(base.gain(ratio), problem)
                except (np.linalg.LinAlgError, ValueError):
                    continue
                again = descend(problem, problem.inside(point), gain=strong, evaluations=5, tolerance=1e-3)
                if np.isfinite(again.cost):
                    point = again.point
            theta, _ = problem.unpack(point)
            options = [point, problem.pack(theta, problem.unpack(best)[1])]
            other = descend(problem, min(options, key=lambda q: plain_cost(problem, q, gain)), gain=gain, evaluations=evaluations[0])
            if np.isfinite(other.cost) and (run is None or other.cost < run.cost):
                run = other
        if run is None or not np.isfinite(run.cost):
            return None
        return self._under_own_noise(effects, base, problem, run, gain, evaluations[1])

    def _under_own_noise(self, effects, base, problem, run, gain, evaluations):
        """The fit under its own noise, which changes with it: as long as the score rises."""
        best = self.scored(Trial(tuple(effects), base, problem, run.point, run.blocks(problem)))
        for _ in range(3):
            again = self._descended(problem, best.point, best.noise, gain, evaluations)
            if not np.isfinite(again.cost):
                break
            trial = self.scored(Trial(tuple(effects), base, problem, again.point, again.blocks(problem)))
            better, gained = trial.total > best.total, trial.total - best.total
            best = trial if better else best
            if gained < 1.0 or not any(np.ptp(w) > 0 for w in best.noise.weights):
                break
        return best

    def _descended(self, problem, point, noise, gain, evaluations, tolerance=1e-6):
        """Descend in the metric of a noise; the evaluation is that of plain weights."""
        if not any(np.ptp(w) > 0 for w in noise.weights):
            return descend(problem, point, gain=gain, whitener=noise.whitener, evaluations=evaluations, tolerance=tolerance)
        plain = problem.judged
        problem.judged = lambda theta: [j * w for j, w in zip(plain(theta), noise.weights, strict=True)]
        problem._cache = None
        run = descend(problem, point, gain=gain, whitener=noise.whitener, evaluations=evaluations, tolerance=tolerance)
        del problem.judged
        problem._cache = None
        return descend(problem, run.point, gain=gain, evaluations=1) if np.isfinite(run.cost) else run

    @staticmethod
    def _padded(gain, problem):
        return None if gain is None else np.pad(gain, ((0, problem.n_states - gain.shape[0]), (0, 0)))

    @cached_property
    def base_cost(self):
        return 0.5 * sum(float(np.sum(r**2)) for r in self.base_residual)

    # ------------------------------------------------------------ the table
    def prior(self, trial):
        return (NUMBERS if trial.base is not self.fitted else NOTHING) - self.price * len(trial.effects)

    def posterior(self, trial):
        return trial.total + self.prior(trial)

    def add(self, trial):
        if trial is not None and np.isfinite(trial.total):
            self.trials.append(trial)
        return trial

    @property
    def best(self):
        """The most probable of those whose every effect is determined."""
        return max((x for x in self.trials if eligible(x)), key=self.posterior)

    # ------------------------------------------------------------ screening
    def screens(self, fitted, scored, with_numbers):
        """Screens at a model: in plain metric, under its own noise, under that of the best set."""
        numbers = [e for e, _ in self.numbers] if with_numbers else []
        sd = [FITTED_SPREAD * s for _, s in self.numbers] if with_numbers else []
        residual = [r for r, _ in fitted.blocks()]
        made = lambda w, weights=None, ratio=0.0: Screen(fitted, scored, numbers, sd, w, ratio, self.motion, weights)  # noqa: E731
        plain = made(Whitener.fit(residual, order=0))
        found = [plain]
        own = noise_of(residual, measured(fitted.problem), self.steps)
        if any(own.whitener.orders) or any(np.ptp(w) > 0 for w in own.weights):
            found.append(made(own.whitener, own.weights))
        best = plain.beam(self.most, True, self.price, usable=self.is_law)[0]
        left = plain.left(best[1], True)
        sizes = [r.size for r in residual]
        if len(left) == sum(sizes):
            parts = np.split(left, np.cumsum(sizes)[:-1])
            shaped = [part.reshape(r.shape) for part, r in zip(parts, residual, strict=True)]
            third = noise_of(shaped, measured(fitted.problem), self.steps)
            if any(third.whitener.orders) and third.whitener.orders != own.whitener.orders:
                found.append(made(third.whitener))
        if self.strong and 1.0 in (scored[0].columns if scored else ()):
            blocks = fitted.blocks(1.0)
            found.append(made(Whitener.fit([r for r, _ in blocks]), None, 1.0))
        return found

    @cached_property
    def strong(self):
        return bool(self.fitted.problem.in_time and self.trials[0].fit.min() < STRONG)

    @staticmethod
    def is_law(group):
        return not is_number(group.effect)

    # ------------------------------------------------------------ the search
    def run(self):
        t = time.process_time()
        case = self.case
        self.add(self.empty(self.fitted))
        ratios = (0.0, 1.0) if self.strong else (0.0,)
        scored = candidate_columns(self.fitted, case.library, self.motion, ratios)
        self.clock("columns", t)
        if self.floated is not None:
            self.add(self.empty(self.floated))
        t = time.process_time()
        screens = self.screens(self.fitted, scored, bool(self.numbers))
        singles = [s.beam(1, False, self.price) for s in screens]
        sets = [s.beam(self.most, True, self.price, usable=self.is_law) for s in screens]
        self.clock("screen", t)
        t = time.process_time()
        done = set()
        for screen, ranked in zip(screens, singles, strict=True):
            rank = 0
            for _, groups in ranked:
                if not groups or rank >= self.singles:
                    continue
                rank += 1
                self.single(groups[0].effect, screens, done)
        place = {e.place for e in self.best.effects}
        for g in screens[0].groups:  # relatives
            if g.effect.place in place:
                self.single(g.effect, screens, done)
        self.clock("singles", t)
        t = time.process_time()
        base = self.floated or self.fitted
        tried = set()
        # the leading single effects beside the parameters
        order = sorted((x for x in self.trials if len(x.effects) == 1 and x.base is self.fitted), key=self.posterior)
        for trial in order[::-1][:3]:
            if not is_number(trial.effects[0]) and base is not self.fitted:
                tried.add(frozenset(trial.effects))
                self.add(self.beside(trial, base))
        self.clock("beside", t)
        self.polish()
        if self.tested(self.best)[0] < case.significance:
            t = time.process_time()
            for screen, ranked in zip(screens, sets, strict=True):
                rank = 0
                for _, groups in ranked:
                    if not groups or rank >= self.sets:
                        continue
                    rank += 1
                    self.set(groups, screen, base, tried)
            self.clock("sets", t)
            self.cores()
            self.polish()
        for _ in range(self.rounds):
            if self.tested(self.best)[0] >= case.significance:
                break
            before = self.posterior(self.best)
            self.relinearized(self.best, tried)
            self.cores()
            self.polish()
            if self.posterior(self.best) <= before + 1.0:
                break
        self.prune()
        self.names()
        self.polish()
        self.p_value, self.tests = self.tested(self.best)
        return self

    def single(self, effect, screens, done):
        """One effect in the model as it is."""
        if effect in done:
            return
        done.add(effect)
        starts = []
        for screen in screens:
            own = [g for g in screen.groups if g.effect == effect]
            own = sorted(own, key=lambda g: -screen.solve([g], False)[0])
            starts += [screen.start([g], False, self.fitted) for g in own[: 2 if len(screens) < 3 else 1]]
        if starts:
            self.add(self.refit((effect,), self.fitted, starts[::-1], led=self.strong))

    def set(self, groups, screen, base, tried):
        effects = tuple(g.effect for g in groups)
        key = frozenset(effects)
        if key in tried:
            return
        tried.add(key)
        start = screen.start(groups, base is not self.fitted, base)
        self.add(self.refit(effects, base, [start], led=self.strong))

    def beside(self, trial, base):
        """A trial of the model as it is, beside the parameters."""
        own, _ = trial.own
        problem, _ = base.extended(list(trial.effects), self.motion)
        p0 = base.problem.n_theta
        theta = base.problem.prior_mean.copy()
        old, starts = trial.problem.unpack(trial.point)
        theta[: self.n_base] = old[: self.n_base]
        point = problem.pack(np.concatenate([theta, own]), starts)
        floated = problem.pack(np.concatenate([base.theta, own]), starts)
        return self.refit(trial.effects, base, [], known=[problem.inside(point), problem.inside(floated)])

    def relinearized(self, trial, tried):
        """More effects about the winner."""
        t = time.process_time()
        fitted = as_fitted(trial)
        rest = not_held(self.case.library, fitted.structure.effects)
        rest = [e for e in rest if not is_number(e)]
        scored = candidate_columns(fitted, rest, self.motion, (0.0,))
        numbers = [] if trial.base is not self.fitted else [e for e, _ in self.numbers]
        base = self.floated or self.fitted
        sd = [FITTED_SPREAD * s for _, s in self.numbers] if numbers else []
        residual = [r for r, _ in fitted.blocks()]
        own = noise_of(residual, measured(fitted.problem), self.steps)
        for whitener, weights in ((Whitener.fit(residual, order=0), None), (own.whitener, own.weights)):
            screen = Screen(fitted, scored, numbers, sd, whitener, 0.0, self.motion, weights)
            rank = 0
            for _, groups in screen.beam(2, True, self.price):
                if not groups or rank >= 3:
                    continue
                rank += 1
                effects = (*trial.effects, *(g.effect for g in groups))
                if frozenset(effects) in tried or len(effects) > 5:
                    continue
                if not all(compatible([Named(e) for e in trial.effects], g) for g in groups):
                    continue
                tried.add(frozenset(effects))
                values, _, _ = screen.start(groups, False, fitted)
                problem, absent = base.extended(list(effects), self.motion)
                structure = problem.structure
                first = len(structure.effects) - len(groups)
                theta, starts = trial.problem.unpack(trial.point)
                p0 = base.problem.n_theta
                full = problem.unpack(absent)[0].copy()
                shift = p0 - trial.base.problem.n_theta
                if shift:
                    full[: self.n_base] = theta[: self.n_base]
                    full[self.n_base : p0] = base.problem.prior_mean[self.n_base :]
                else:
                    full[:p0] = theta[:p0]
                full[p0 : p0 + len(theta) - trial.base.problem.n_theta] = theta[trial.base.problem.n_theta :]
                points = []
                for share in (1.0, 0.3):
                    new = full.copy()
                    for (i, name), value in values.items():
                        at = structure.position(first + i, name)
                        if at >= 0:
                            spec = structure.effects[first + i].spec
                            new[at] = value if name in spec.shaping or spec.secant else share * value
                    padded = np.pad(starts, ((0, 0), (0, problem.n_states - starts.shape[1])))
                    points.append(problem.inside(problem.pack(new, padded)))
                self.add(self.refit(effects, base, [], known=points))
        self.clock("relinearized", t)

    def cores(self):
        """Of the leading sets that hold undetermined members: the members that are determined."""
        t = time.process_time()
        for trial in sorted(self.trials, key=self.posterior)[::-1][:4]:
            if eligible(trial) or len(trial.effects) < 2:
                continue
            sure = np.array(trial.surest()) >= 3.0
            for kept in (np.flatnonzero(sure), *(np.delete(np.arange(len(sure)), i) for i in np.flatnonzero(~sure))):
                if len(kept):
                    self.without(trial, list(kept))
        self.clock("cores", t)

    def without(self, trial, kept):
        """A trial with some of its effects, from where it stands."""
        effects = tuple(trial.effects[k] for k in kept)
        key = frozenset(effects), trial.base is self.fitted, id(trial)
        if key in self._pruned or not effects:
            return None
        self._pruned.add(key)
        problem, absent = trial.base.extended(list(effects), self.motion)
        theta, starts = trial.problem.unpack(trial.point)
        p0 = trial.base.problem.n_theta
        first = len(trial.problem.structure.effects) - len(trial.effects)
        own = [theta[k] for i in kept for k, q in enumerate(trial.problem.structure.parameters) if q.effect == first + i]
        full = np.concatenate([theta[:p0], own])
        states = np.zeros((len(problem.records), problem.n_states))
        states[:, : trial.base.problem.n_states] = starts[:, : trial.base.problem.n_states]
        if len(full) != problem.n_theta:
            return None
        same = [x for x in self.trials if frozenset(x.effects) == key[0] and x.base is trial.base]
        again = self.refit(effects, trial.base, [], known=[problem.inside(problem.pack(full, states)), absent], evaluations=(10, 10))
        if again is None or (same and self.posterior(again) <= max(self.posterior(x) for x in same)):
            return None
        return self.add(again)

    def prune(self):
        """The winner without each of its effects."""
        t = time.process_time()
        for _ in range(3):
            best = self.best
            if len(best.effects) < 2:
                break
            for i in np.argsort(best.surest())[:2]:
                self.without(best, [k for k in range(len(best.effects)) if k != i])
            if self.best is best:
                break
        self.clock("prune", t)

    def names(self):
        """The winner with each force replaced by other laws at its place that imitate it."""
        t = time.process_time()
        for _ in range(2):
            best = self.best
            for i, effect in enumerate(best.effects):
                self.imitations(best, i, effect)
            if self.best is best:
                break
        self.clock("names", t)

    def imitations(self, trial, i, effect):
        found = force_of(trial, i)
        if found is None:
            return
        d, v, w, force = found
        structure = trial.problem.structure
        held = {(e.kind, e.place) for e in trial.effects}
        options = []
        for other in self.case.library:
            if other.place != effect.place or (other.kind, other.place) in held or is_number(other):
                continue
            if (key := (frozenset(trial.effects), i, other)) in self._pruned:
                continue
            self._pruned.add(key)
            one = Structure(structure.model, [other])
            shapes = []
            for start in shape_starts(one, one.start(), self.motion):
                shape = {q.name: float(start[k]) for k, q in enumerate(one.parameters) if q.name in other.spec.shaping}
                shapes += [shape] if shape not in shapes else []
            for shape in shapes:
                columns = unit_forces(other, d, v, [shape], w, resting(structure, other.place))
                free = [n for n in other.free if n not in shape]
                if not columns or len(columns) != len(free):
                    continue
                F = np.array(columns).T
                levels = np.linalg.lstsq(F, force, rcond=1e-10)[0]
                left = float(np.sum((force - F @ levels) ** 2) / np.sum(force**2))
                if np.isfinite(left):
                    options.append((left, other, {**shape, **dict(zip(free, levels, strict=True))}))
        options.sort(key=lambda o: o[0])
        seen = []
        for left, other, values in options:
            if other in seen or left > 0.6 or len(seen) >= 3:
                continue
            seen.append(other)
            effects = tuple(other if k == i else e for k, e in enumerate(trial.effects))
            problem, absent = trial.base.extended(list(effects), self.motion)
            theta, starts = trial.problem.unpack(trial.point)
            p0, own = trial.base.problem.n_theta, []
            first = len(trial.problem.structure.effects) - len(trial.effects)
            for k, e in enumerate(effects):
                names = [q.name for q in problem.structure.parameters if q.effect == first + k]
                if k == i:
                    own += [values.get(n, 0.0) for n in names]
                else:
                    own += [theta[j] for j, q in enumerate(trial.problem.structure.parameters) if q.effect == first + k]
            full = np.concatenate([theta[:p0], own])
            if len(full) != problem.n_theta:
                continue
            states = np.zeros((len(problem.records), problem.n_states))
            states[:, : trial.base.problem.n_states] = starts[:, : trial.base.problem.n_states]
            self.add(self.refit(effects, trial.base, [], known=[problem.inside(problem.pack(full, states))], evaluations=(10, 10)))

    # ------------------------------------------------------------ polish
    def polished(self, trial):
        """The trial at its minimum, with the substeps and widths that the record asks for."""
        problem, point, base = trial.problem, trial.point, trial.base
        gain = self._padded(base.gain(0.0), problem)
        noise = trial.noise

        def descended(problem, point, evaluations, tolerance=1e-7):
            return self._descended(problem, point, noise, gain, evaluations, tolerance)

        run = descended(problem, point, 8)
        if not problem.structure.is_linear and problem.in_time:
            for _ in range(3):
                finer = problem.like(substeps=2 * problem.substeps)
                if step_matters(problem, finer, run.point) < 0.25:
                    break
                problem = finer
                self.substeps = max(self.substeps, problem.substeps)
                run = descended(problem, run.point, 6)
        structure = problem.structure
        first = len(structure.effects) - len(trial.effects)
        for k in range(first, len(structure.effects)):
            effect = structure.effects[k]
            if not effect.spec.jumps or "width" in effect.fixed:
                continue
            price = 0.5 * np.log(problem.n_points)
            for factor in (0.5, 2.0, 1 / 1.4, 1.4):
                for _ in range(4):
                    constants = {**problem.structure.constants, k: factor * problem.structure.constants[k]}
                    other = problem.like(Structure(structure.model, structure.effects, constants=constants))
                    again = descended(other, run.point, 5)
                    if not again.cost < run.cost - price:
                        break
                    problem, run, price = other, again, 1.0
        if not np.isfinite(run.cost):
            return None
        return self.scored(Trial(trial.effects, base, problem, run.point, run.blocks(problem)))

    def polish(self, most=5, near=60.0):
        """Polish the leaders until the order among them holds."""
        t = time.process_time()
        for _ in range(most):
            top = self.posterior(self.best)
            todo = [x for x in self.trials if x.effects and eligible(x) and id(x) not in self._polished and self.posterior(x) > top - near]
            if not todo:
                break
            trial = max(todo, key=self.posterior)
            better = self.polished(trial)
            self._polished.add(id(trial))
            if better is not None and self.posterior(better) > self.posterior(trial) - 1.0:
                self.trials.remove(trial)
                self.trials.append(better)
                self._polished.add(id(better))
                self._kept.append(trial)
        self.clock("polish", t)

    # ------------------------------------------------------------ criticism
    def tested(self, trial):
        """Smallest p-value of the residual tests, corrected, and the tests."""
        if id(trial) not in self._tested:
            self._tested[id(trial)] = self._tests_of(trial)
        return self._tested[id(trial)]

    def _tests_of(self, trial):
        t = time.process_time()
        fitted = as_fitted(trial)
        rest = not_held(self.case.library, fitted.structure.effects)
        motions = [estimated_motion(fitted.structure, fitted.theta, m.data) for m in self.case.motions]
        scored = candidate_columns(fitted, rest, motions[0], (0.0,))
        battery = TestedResidual(fitted)
        tests = run_tests(battery, scored, motions)
        odds = -np.inf  # of a force of no law at the places of the effects, over the laws
        if self.fitted.problem.in_time and overall(tests) >= self.case.significance:
            for place in dict.fromkeys(e.place for e in trial.effects):
                size = force_at(trial, place)
                if size is not None:
                    beside = Beside(battery, place)
                    tests += beside.tests()
                    odds = np.logaddexp(odds, beside.odds(size))
        self.odds[id(trial)] = float(odds)
        self.clock("tests", t)
        return overall(tests), tests

    def table(self):
        """Best trial of each set of effects and kind of base, with its log posterior."""
        rows = {}
        for trial in self.trials:
            key = frozenset(trial.effects), trial.base is not self.fitted
            value = self.posterior(trial)
            if key not in rows or rows[key][0] < value:
                rows[key] = value, trial
        return sorted(rows.values(), key=lambda row: -row[0])


class Named:
    """An effect where a group is expected."""

    def __init__(self, effect):
        self.effect = effect


def as_fitted(trial: Trial) -> FittedModel:
    """A trial as a fitted model that can be tested and added to."""
    old, problem = trial.base.refinement, trial.problem
    theta, starts = problem.unpack(trial.point)
    n = len(problem.structure.effects) - len(old.effects)
    errors = np.concatenate([b / problem.weights[:, None] for b, _ in trial.blocks], axis=1)
    refinement = replace(
        old,
        effects=problem.structure.effects,
        roles=(*old.roles, *("effect",) * n),
        constants=dict(problem.structure.constants),
        theta=theta.copy(),
        initial_states=starts.copy(),
        substeps=problem.engines[0].substeps,
        fit=trial.fit,
        rmse=np.sqrt(np.mean(errors**2, axis=1)),
    )
    weights = trial.noise.weights if trial.noise is not None else []
    blocks = trial.blocks
    if any(np.ptp(w) > 0 for w in weights):
        plain, problem = problem, problem.like()
        problem.judged = lambda theta: [j * w for j, w in zip(plain.judged(theta), weights, strict=True)]
        blocks = [(w * r, w[:, :, None] * j) for w, (r, j) in zip(weights, blocks, strict=True)]
    found = FittedModel(refinement, problem, trial.point, trial.base.tolerance, trial.base.force_at)
    found._blocks[0.0] = blocks
    return found


def force_at(trial, place):
    """Force of all effects of a trial at a port, along the motion (N,); None where it is none."""
    problem, structure = trial.problem, trial.problem.structure
    if place not in [port.name for port in structure.model.ports]:
        return None
    first = len(structure.effects) - len(trial.effects)
    theta, starts = problem.unpack(trial.point)
    rest, parts = forces_at_rest(structure, theta), []
    for engine, start in zip(problem.engines, starts, strict=True):
        run = engine.run(theta, start, sensitivity=False, histories=True, check=False)
        total = np.zeros(run.outputs.shape[1])
        d, v = sensed(structure.model, place, run.states, engine.data.inputs)
        for k, effect in enumerate(structure.effects[first:], first):
            if effect.place != place:
                continue
            if k in structure.port_effects:
                at = list(structure.port_effects).index(k)
                total = total + run.forces[at] - rest[at]
            elif effect.spec.is_element:
                unit = unit_forces(effect, d, v, [], rest=resting(structure, place))
                if unit:
                    total = total + theta[structure.position(k, effect.coefficients[0])] * unit[0]
        parts.append(total)
    found = np.concatenate(parts)
    return found if np.isfinite(found).all() and found.any() else None


def force_of(trial, i):
    """Motion at the place of one effect, inputs and its force, all records joined; None where it is no force."""
    problem, structure = trial.problem, trial.problem.structure
    k = len(structure.effects) - len(trial.effects) + i
    if k not in structure.port_effects:
        return None
    theta, starts = problem.unpack(trial.point)
    rest, rows = forces_at_rest(structure, theta), []
    at = list(structure.port_effects).index(k)
    for engine, start in zip(problem.engines, starts, strict=True):
        run = engine.run(theta, start, sensitivity=False, histories=True, check=False)
        d, v = sensed(structure.model, structure.effects[k].place, run.states, engine.data.inputs)
        rows.append((d, v, engine.data.inputs, run.forces[at] - rest[at]))
    d, v, w, force = (np.concatenate(parts, axis=-1) for parts in zip(*rows, strict=True))
    return (d, v, w, force) if np.isfinite([d, v, force]).all() and force.any() else None
