"""Search of hypotheses: first-order screening, refits, and residual tests."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import replace
from itertools import product
from typing import Any, NamedTuple

import numpy as np

from ..comparison.black_box import output_error
from ..data import HOLDS
from ..data.records import at_rest
from ..effects.effect import Effect
from ..exceptions import DivergenceError, ModelError
from ..inference.f_tests import FTest
from ..inference.fitted import FittedModel
from ..inference.sensitivities import Candidate, candidate_columns
from ..inference.starts import estimated_motion
from ..inference.whitening import innovations
from .beside import Beside, FreeStiffness
from .case import Case, not_held
from .hypothesis import Hypothesis, Start, Trial
from .nuisances import (
    Hold,
    NoisyInputs,
    Nuisance,
    Parameters,
    UnmeasuredForce,
    between_steps,
    likely_forces,
    parameters_of,
)
from .refits import Fitter, Starts, imitations
from .residual_tests import in_race, passed_without_library, run_tests
from .screening import Group, Metric, Screen, compatible

FITTED_SPREAD = 0.2  # prior standard deviation of re-estimated parameters, relative to their size
_SOUGHT, _BATCH = 4, 2  # effects of each ranking sought in another local minimum; of them at a time
_STRONG = 75.0  # fit in percent below which columns along the estimated motion are used, too
_SINGLES, _SETS, MOST = 6, 4, 4  # refits per screen: single effects, sets; most effects of a screened set
_PAIRS, _ALONE = 2, 3  # pairs and single effects that are added to the best set
_REFITS = 120  # fits of a search; then only the names of the best set are asked for
_ROUNDS = 2  # linearizations at the best set
_NEAR = 60.0  # log evidence below the best within which a trial is polished
_POLISHED = 4
_RIVALS = 10.0  # log evidence below the best within which an unmeasured force is tried
_LEADERS = 4  # trials whose laws are simplified
_FORCE = 3.0  # least gain in log-likelihood for an unmeasured force to be tried


_MORE = "further effects beside the best ones"


class Criticism(NamedTuple):
    """Results of the residual tests of a trial.

    Attributes
    ----------
    passed : bool
        Whether the residual is noise, and no free force is clearly more probable than the effects.
    tests : list of FTest
        Residual tests; empty if a test without the candidates failed.
    odds : float
        Log odds of a free force at the places of the effects against these effects.
    """

    passed: bool
    tests: list[FTest]
    odds: float


class Search:
    """Search for the effects that a fitted model lacks.

    Parameters
    ----------
    case : Case
        Fitted model, records and candidate effects.
    most : int
        Maximum number of effects of a set.
    colored : bool
        Whether noise may be other than white and normal. If so, other holds, noise of the inputs and
        unmeasured forces are tried, too.

    Attributes
    ----------
    trials : list of Trial
        Fitted hypotheses, one fit each.
    opened : frozenset of Nuisance
        The nuisance of re-estimated parameters, if there are any.
    """

    def __init__(self, case: Case, most: int = MOST + 1, *, colored: bool = True) -> None:
        self.case, self.most, self.colored = case, most, colored
        self.step = case.progress.step
        self.fitted, self.motion = case.fitted, case.motions[0]
        self.fitter = Fitter(case.fitted, case.motions[0], colored)
        self.trials: list[Trial] = []
        #: parameters of the model with their prior standard deviations
        self.numbers = {effect: FITTED_SPREAD * size for effect, size in parameters_of(case)}
        self.opened = frozenset[Nuisance]([Parameters(FITTED_SPREAD)] if self.numbers else [])
        # a parameter that is no candidate may still be the only wrong one
        self.library = [*case.library, *not_held(list(self.numbers), case.library)]
        self.price = float(np.log(max(len(self.library), 2)))
        # a free decay has no input that could be held or noisy, and no force by its definition: the
        # predictor of an unmeasured force takes the error of any model there for that force
        self.driven = case.in_time and not at_rest(case.ordered)
        self._bases: dict[frozenset[Nuisance], FittedModel] = {frozenset(): self.fitted}
        self._criticism: dict[Trial, Criticism] = {}
        self._columns: dict[Any, tuple[Trial, list[Candidate]]] = {}  # of candidates, by hypothesis
        self._done: set[Any] = set()
        self._polished: dict[Trial, int] = {}  # substeps that sufficed then
        self._spare: dict[Trial, bool] = {}
        self._refits, self._skipped = 0, list[str]()

    def base(self, nuisances: frozenset[Nuisance]) -> FittedModel:
        """Return the model fitted with these nuisances."""
        if nuisances not in self._bases:
            fitted, order = self.fitted, [Hold, NoisyInputs, Parameters, UnmeasuredForce]
            for one in sorted(nuisances, key=lambda one: order.index(type(one))):
                fitted = one.base(self.case, fitted)
            self._bases[nuisances] = fitted
        return self._bases[nuisances]

    # ------------------------------------------------------------------ the table
    def posterior(self, trial: Trial) -> float:
        """Return the log evidence plus the log prior of a trial."""
        return trial.total + trial.hypothesis.log_prior(len(self.library))

    def ranked(self, trials: Iterable[Trial] | None = None) -> list[Trial]:
        """Return trials (default all), the most probable first."""
        return sorted(self.trials if trials is None else trials, key=self.posterior)[::-1]

    def determined(self, trial: Trial) -> bool:
        """Return whether the data determine every effect of a trial, and need it."""
        return trial.determined(self.case.levels.moved) and not self.spare(trial)

    def spare(self, trial: Trial) -> bool:
        """Return whether a trial adds a state that the record does not need.

        A black box without that state reaches the same error: other entries of the matrices explain the
        record as well. Not at a mechanical place, where entries that are zero follow from the kinematics.
        """
        if trial not in self._spare:
            # linear effects that add states at places other than mechanical ones
            ports = {port.name: port.kind for port in trial.problem.structure.model.ports}
            stores = [e for e in trial.effects if ports.get(e.place, "mechanical") != "mechanical"]
            added = sum(e.spec.inner_states for e in stores if e.spec.linear)
            judged = self.driven and added and trial.is_linear and not trial.hypothesis.ratio
            order = trial.problem.structure.n_states - added
            whole = all(record.there is None for record in trial.problem.records)  # a black box needs that
            self._spare[trial] = bool(judged and order and whole and self._box_suffices(trial, order))
        return self._spare[trial]

    def _box_suffices(self, trial: Trial, order: int) -> bool:
        """Return whether a black box of some order is as likely as a trial.

        Both have the noise of the trial: signals and residuals are whitened by its filters.
        """
        gain = 0.0
        records, residuals = trial.problem.records, [r for r, _ in trial.blocks]
        # output-error black box per output, whitened as the trial
        for i, a in enumerate(trial.noise.whitener.filters):
            own = [innovations(a, r[i])[a.size - 1 :] for r in residuals]
            boxes = []
            for record in records:
                y, *w = (innovations(a, row)[a.size - 1 :] for row in (record.outputs[i], *record.inputs))
                boxes.append(trial.problem.weights[i] * output_error(y, np.array(w), order)[1])
            # log-likelihood ratio of black box and trial
            left, size = float(sum(r @ r for r in own)), sum(r.size for r in own)
            gain += 0.5 * size * float(np.log(max(float(np.square(boxes).sum()), 1e-300) / max(left, 1e-300)))
        return gain < 0.5 * self.case.levels.rival

    @property
    def best(self) -> Trial:
        """Return the most probable trial whose effects are all determined."""
        return self.ranked(x for x in self.trials if self.determined(x))[0]

    def add(self, trial: Trial | None, *, instead: bool = False) -> Trial | None:
        """Add a trial to the table, and return the kept fit of its hypothesis.

        The fit of higher evidence is kept. With `instead`, a fit with finer substeps replaces the old one in
        any case: coarser steps may have a spuriously high evidence. None if the trial failed.
        """
        self._refits += 1
        if trial is None or not np.isfinite(trial.total):
            return None
        # one trial per hypothesis: the likelier fit, or the one with finer substeps
        for i, other in enumerate(self.trials):
            if other.hypothesis.key == trial.hypothesis.key:
                if trial.total > other.total or (instead and trial.problem.substeps > other.problem.substeps):
                    self.trials[i] = trial
                return self.trials[i]
        self.trials.append(trial)
        return trial

    def try_(
        self,
        effects: Sequence[Effect],
        nuisances: frozenset[Nuisance],
        starts: Sequence[Start],
        **options: Any,
    ) -> Trial | None:
        """Fit a hypothesis and add it to the table."""
        base = self.base(nuisances)
        return self.add(self.fitter.fit(Hypothesis(tuple(effects), nuisances), base, starts, **options))

    def again(self, trial: Trial, nuisances: frozenset[Nuisance]) -> Trial | None:
        """Refit a trial with other nuisances, from its point."""
        if not trial.effects:
            return self.empty(nuisances)
        return self.try_(trial.effects, nuisances, [trial.start], noise=trial.noise)

    def empty(self, nuisances: frozenset[Nuisance]) -> Trial | None:
        """Add the model with these nuisances and no effect; None if it diverges."""
        try:
            return self.add(self.fitter.empty(Hypothesis((), nuisances), self.base(nuisances)))
        except DivergenceError:
            return None

    def is_open(self, effect: Effect) -> bool:
        """Return whether a candidate can be added to re-estimated parameters.

        A parameter of the model cannot: it is re-estimated already. An entry of B, C or D can that is zero.
        """
        held = {(e.kind, e.place) for e in self.numbers}
        beside = is_gain(effect) or _of_signals(effect)
        return not is_number(effect) or (beside and (effect.kind, effect.place) not in held)

    def affords(self, what: str) -> bool:
        """Return whether refits are left; otherwise remember what is skipped."""
        left = self._refits < _REFITS * self.case.effort
        if not left and what not in self._skipped:
            self._skipped.append(what)
        return left

    @property
    def not_afforded(self) -> str:
        """Return a sentence on what was skipped, or an empty string."""
        if not self._skipped:
            return ""
        more, skipped = 2.0 * self.case.effort or 1.0, " and ".join(self._skipped)
        return f"The search ended after {self._refits} refits. Not tried: {skipped}; effort={more:g} goes on."

    def first_time(self, *key: Any) -> bool:
        """Return whether a key is new, and remember it."""
        new = key not in self._done
        self._done.add(key)
        return new

    # ------------------------------------------------------------------ the search
    def run(self) -> Search:
        """Run the search, fill the table, and return the search."""
        # model as it is, then with re-estimated parameters
        with self.step("the model and its parameters"):
            nothing = self.empty(frozenset())
            if self.opened:
                self.empty(self.opened)
        assert nothing is not None
        strong = self._strong(nothing)
        # first-order screening of the candidates, then single fits
        with self.step("first look at every effect"):
            near = in_race(self.fitted, self.library, (0.0, 1.0) if strong else (0.0,))
            screens = self._screens(self.fitted, near, strong)
        self._singles(screens, strong or not self.case.in_time)
        # the best single effects together with the parameters
        with self.step("effects beside the parameters"):
            self._beside_parameters()
        self.polish()
        # do the effects need the re-estimated parameters?
        self._without_parameters()
        if not self.passed(self.best) or self.best.hypothesis.floated:
            self._holds()
        # sets of effects only if no single effect passes the tests
        if not self.passed(self.best):
            if self.most > 1:
                self._sets([*screens, *self._screens_beside(near)])
            self._cores(self.ranked()[:4])
            self.polish()
        self._further()
        self._disturbances()
        # fewer effects, other effects with the same force, then special cases
        with self.step("other names"):
            for _ in self._improving(_ROUNDS):
                self._without_parameters()
                self._prune()
                self._names()
        self.polish()
        if self.passed(self.best):  # a special case leaves no smaller residual
            self._simplify()
        return self

    def _disturbances(self) -> None:
        """Refit the best trials with noise in the inputs and process noise."""
        if not (self.colored and self.driven):
            return
        passed = self.passed(self.best)
        if (passed and not self.best.effects) or not (passed or self.affords("unmeasured forces")):
            return
        with self.step("noise of the inputs, unmeasured forces"):
            self._noisy_inputs()
            self._forces()
        self.polish()

    def _improving(self, most: int) -> Iterator[Trial]:
        """Yield the best trial before each round, while rounds improve it."""
        for _ in range(most):
            before = self.best
            yield before
            if self.best is before:
                return

    def _further(self) -> None:
        """Add effects to the best set while it fails its tests and improves."""
        for before in self._improving(_ROUNDS):
            if self.passed(before) or len(before.effects) >= self.most or not self.affords(_MORE):
                return
            with self.step("effects beside the best ones"):
                self.relinearized(before)
            self._cores(self.ranked()[:4])
            self.polish()

    def _screens(self, fitted: FittedModel, effects: Sequence[Effect], strong: bool) -> list[Screen]:
        """Return screens at a model in up to four metrics.

        These are white noise, the noise of its residual, and the noise that the best set leaves. With
        `strong`, a screen along the estimated motion is added (observer ratio 1).
        """
        # white noise, then the noise of the residual, then what the best set leaves
        scored = candidate_columns(fitted, effects, self.motion, (0.0, 1.0) if strong else (0.0,))
        residual, noise = fitted.residuals(), self.fitter.noise_of
        numbers = self.numbers if fitted is self.fitted else {}  # else the model has them already

        def made(metric: Metric) -> Screen:
            return Screen(fitted, scored, numbers, metric, self.motion)

        plain, own = made(Metric(fitted.problem.whitener(residual, 0))), noise(residual)
        found = [plain]
        if any(own.whitener.orders) or own.uneven:
            found.append(made(Metric(own.whitener, own.weights)))
        best = plain.beam(MOST, True, self.price, self.is_open)[0]
        # what the best set leaves, in the rows that were measured
        rest = np.concatenate([r.ravel() for r in residual])
        rest[~np.isnan(rest)] = plain.left(best[1], True)
        parts = np.split(rest, np.cumsum([r.size for r in residual])[:-1])
        other = noise([part.reshape(r.shape) for part, r in zip(parts, residual, strict=True)])
        if any(other.whitener.orders) and other.whitener.orders != own.whitener.orders:
            found.append(made(Metric(other.whitener)))
        if strong:
            found.append(made(Metric(fitted.problem.whitener(fitted.residuals(1.0)), None, 1.0)))
        return found

    def _screens_beside(self, near: Sequence[Effect]) -> list[Screen]:
        """Return screens at the model with re-estimated parameters.

        Empty unless the parameters raise the log evidence by at least `_NEAR`: only then the columns differ.
        """
        empty = {x.hypothesis.nuisances: x for x in self.trials if not x.effects}
        nothing, opened = empty.get(frozenset()), empty.get(self.opened)
        if not self.opened or nothing is None or opened is None or opened.total < nothing.total + _NEAR:
            return []
        with self.step("first look beside the parameters"):
            return self._screens(opened.base, [e for e in near if self.is_open(e)], self._strong(opened))

    def _strong(self, trial: Trial) -> bool:
        """Return whether a fit misses so much that the estimated motion counts."""
        return self.case.in_time and bool(trial.model.refinement.fit.min() < _STRONG)

    def _singles(self, screens: Sequence[Screen], far: bool) -> None:
        """Fit the likeliest single effects, and others at the best place.

        With `far`, the best ones are also sought in another local minimum, until one passes its tests. An
        effect that strong is confused only with effects at the same place, and `_names` tries these.
        """
        # first-order ranking of single effects in each screen
        likely = [screen.beam(1, False, self.price)[: _SINGLES + 1] for screen in screens]
        effects = [groups[0].effect for ranked in likely for _, groups in ranked if groups]
        self._each(effects, screens)
        self._each(self._relatives(screens[0]), screens)
        # the fit without the effect may be in another local minimum
        # the screen along the estimated motion is not bound to this minimum
        nearest = [groups[0].effect for _, groups in likely[-1] if groups][:_SOUGHT]
        nearest += [x.effects[0] for x in self.ranked() if len(x.effects) == 1][:_SOUGHT]
        if far:
            self._elsewhere(list(dict.fromkeys(nearest)))

    def _elsewhere(self, effects: Sequence[Effect]) -> None:
        """Fit effects in other local minima until one passes its tests.

        They are fitted to the model as it is, and then together with re-estimated parameters.
        """
        # other local minima, two effects at a time
        todo = [(Hypothesis((effect,)), self.fitted) for effect in effects]
        if self.opened and self.case.in_time:
            base = self.base(self.opened)
            todo += [(Hypothesis((effect,), self.opened), base) for effect in effects if self.is_open(effect)]
        while todo and not (self.best.effects and self.passed(self.best)):
            if not self.affords("other local minima"):
                break
            batch, todo = todo[:_BATCH], todo[_BATCH:]
            for trial in self.case.progress.map(self.fitter.sought, batch, "from another valley"):
                self.add(trial)

    def _relatives(self, screen: Screen) -> list[Effect]:
        """Return the effects at the places of the best set.

        If it has a linear effect at a channel, the linear effects of all channels are included. At either end
        of a signal path they act in the same way.
        """
        places = {e.place for e in self.best.effects}
        channel = any(map(_of_channel, self.best.effects))
        effects = [g.effect for g in screen.groups]
        return [e for e in effects if e.place in places or (channel and _of_channel(e))]

    def _each(self, effects: Sequence[Effect], screens: Sequence[Screen]) -> None:
        """Fit single effects in the model as it is, each only once."""
        tasks = []
        for effect in dict.fromkeys(effects):
            if not self.first_time("single", effect):
                continue
            # starts from the linear solutions of all screens
            starts = []
            for screen in screens[::-1]:
                own = [g for g in screen.groups if g.effect == effect]
                own.sort(key=lambda g: -screen.solve([g], False)[0])
                starts += [screen.start([g], False, self.fitted) for g in own[:2]]
            if is_gain(effect):  # initial states distorted by a wrong unit lead into another minimum
                gains = [1.0 + sum(start.values[0].values()) for start in starts]
                starts += [
                    replace(start, states=start.states / gain)
                    for start, gain in zip(starts, gains, strict=True)
                    if gain
                ]
            tasks.append((effect, starts))
        for trial in self.case.progress.map(self.fitter.single, tasks, "one effect at a time"):
            self.add(trial)

    def _sets(self, screens: Sequence[Screen]) -> None:
        """Fit sets of effects with the parameters; refit the best four longer."""
        base, tasks = self.base(self.opened), []
        # beam search in each screen, then a short fit of each set
        for screen in screens:
            # an effect that parameters hide is seen beside them only, alone as well as in sets
            for most in (min(MOST, self.most), 1):
                sets = [groups for _, groups in screen.beam(most, True, self.price, self.is_open) if groups]
                for groups in sets[:_SETS]:
                    effects = tuple(g.effect for g in groups)
                    if self.first_time("set", frozenset(effects)):
                        start = screen.start(groups, bool(self.opened), base)
                        tasks.append((Hypothesis(effects, self.opened), base, start))
        begun = self.case.progress.map(self.fitter.together, tasks, "sets of effects")
        known = [trial for trial in begun if trial is not None]
        # a longer fit of the best four
        for trial in known:
            self.add(trial)
        for trial in self.ranked(known)[:4]:
            self.try_(trial.effects, trial.hypothesis.nuisances, [trial.start])

    def _beside_parameters(self) -> None:
        """Refit the best three single effects with re-estimated parameters."""
        alone = [x for x in self.ranked() if len(x.effects) == 1 and self.is_open(x.effects[0])]
        base, n = self.base(self.opened), self.fitted.problem.n_theta
        for trial in alone[:3] if self.opened else ():
            if self.first_time("set", frozenset(trial.effects)):
                # parameters at their prior means, and as fitted alone
                thetas = (np.concatenate([trial.start.theta[:n], base.problem.prior_mean[n:]]), base.theta)
                starts = [replace(trial.start, theta=theta) for theta in thetas]
                self.try_(trial.effects, self.opened, starts)

    def _without_parameters(self) -> None:
        """Refit the best trial with the parameters held, from its point."""
        best, n = self.best, self.fitted.problem.n_theta
        held = best.hypothesis.nuisances - self.opened
        floated = best.effects and best.hypothesis.floated
        if floated and self.first_time("held", frozenset(best.effects), held):
            start = replace(best.start, theta=best.start.theta[:n])
            self.try_(best.effects, held, [start], noise=best.noise)
            self.polish()

    def relinearized(self, trial: Trial) -> list[Trial]:
        """Fit further effects by linearizing at a trial; return the new trials.

        The parameters are re-estimated, too. There are none if an effect of the trial is such a parameter.
        """
        known = len(self.trials)
        if any(not self.is_open(effect) for effect in trial.effects):  # it is re-estimated with all others
            return []
        # the parameters that the trial holds start at their prior means
        nuisances, here = trial.hypothesis.nuisances | self.opened, trial.start
        mean = self.base(nuisances).problem.prior_mean[len(here.theta) :]
        here = replace(here, theta=np.concatenate([here.theta, mean]))
        for screen, groups in self._additions(trial):
            effects = (*trial.effects, *(g.effect for g in groups))
            fine = len(effects) <= self.most and all(compatible(trial.effects, g.effect) for g in groups)
            if fine and self.affords(_MORE) and self.first_time("set", frozenset(effects)):
                values = screen.start(groups, False, trial.model).values
                weaker = [{n: 0.3 * v for n, v in own.items()} for own in values]
                starts = [replace(here, values=[*here.values, *more]) for more in (values, weaker)]
                self.try_(effects, nuisances, starts, noise=trial.noise)
        return self.trials[known:]

    def _additions(self, trial: Trial) -> Iterator[tuple[Screen, list[Group]]]:
        """Yield the effects that explain most of a trial's residual.

        They are pairs and single effects of two screens: under white noise, and under that of the residual.
        """
        fitted = trial.model
        rest = [e for e in not_held(self.case.library, fitted.structure.effects) if self.is_open(e)]
        scored = candidate_columns(fitted, rest, self.motion, (0.0,))
        numbers = {} if trial.hypothesis.floated else self.numbers
        residual = fitted.residuals()
        own = self.fitter.noise_of(residual)
        for metric in (Metric(fitted.problem.whitener(residual, 0)), Metric(own.whitener, own.weights)):
            screen = Screen(fitted, scored, numbers, metric, self.motion)
            ranked = [groups for _, groups in screen.beam(2, True, self.price)]
            pairs, alone = ([groups for groups in ranked if len(groups) == n] for n in (2, 1))
            yield from ((screen, groups) for groups in [*pairs[:_PAIRS], *alone[:_ALONE]])

    def climbed(self, trial: Trial) -> None:
        """Fit further effects at a trial, and their determined subsets."""
        self._cores(self.relinearized(trial))

    def _holds(self) -> None:
        """Fit the model and the best two sets with each hold that is not declared.

        The parameters are held, and re-estimated. Nothing is done if the records declare several holds, or if
        no input changes.
        """
        model = self.case.base.physical_model
        holds = {model.hold or record.hold for record in self.case.records}
        if not (self.colored and self.driven) or len(holds) > 1:
            return
        others = [Hold(hold) for hold in HOLDS if hold not in holds]
        with self.step("holds of the input"):
            # each other hold with and without re-estimated parameters
            for hold, more in product(others, dict.fromkeys((frozenset[Nuisance](), self.opened))):
                nuisances = frozenset([hold, *more])
                trial = self.empty(nuisances)
                if trial is None or self.posterior(trial) < self.posterior(self.best) - _NEAR:
                    continue
                floated = trial.hypothesis.floated
                leaders = [x for x in self.ranked() if x.effects and x.hypothesis.floated == floated]
                for other in leaders[:2]:
                    self.again(other, nuisances)

    def _leaders(self) -> list[Trial]:
        """Return the best trial, two with fewer effects, and those with none."""
        best = self.best
        fewer = [x for x in self.trials if 0 < len(x.effects) < len(best.effects) and self.determined(x)]
        nothing = [x for x in self.trials if not x.effects]
        return list(dict.fromkeys([best, *self.ranked(fewer)[:2], *nothing]))

    def _noisy_inputs(self) -> None:
        """Refit the best trials without the noise of stepwise inputs."""
        noisy = NoisyInputs()
        if all(np.array_equal(between_steps(r.inputs), r.inputs) for r in self.fitted.problem.records):
            return
        for trial in self._leaders():
            self.again(trial, trial.hypothesis.nuisances | {noisy})

    def _forces(self) -> None:
        """Refit the most probable trials with an unmeasured force."""
        # likely trials, refitted with the Kalman predictor
        near = [x for x in self.ranked() if self.posterior(x) > self.posterior(self.best) - _RIVALS]
        for trial in dict.fromkeys([*self._leaders(), *near[:4]]):
            if trial.hypothesis.ratio:
                continue
            likely = likely_forces(trial, _FORCE, self.case.levels)
            for one in likely[:1]:
                force = UnmeasuredForce(one.fitted.force_at, one.ratio)
                led = self.again(trial, trial.hypothesis.nuisances | {force})
                if trial.effects and led is not None and led is self.best:  # it may be at a better minimum
                    self.try_(trial.effects, trial.hypothesis.nuisances, [led.start], noise=led.noise)

    def _without(self, trial: Trial, kept: Iterable[int]) -> None:
        """Fit a subset of the effects of a trial, from its point."""
        kept = list(kept)
        effects = tuple(trial.effects[k] for k in kept)
        if not effects or not self.first_time("without", frozenset(effects), trial):
            return
        start, nuisances = trial.start, trial.hypothesis.nuisances
        start = replace(start, values=[start.values[k] for k in kept])
        self.try_(effects, nuisances, [start], noise=trial.noise, evaluations=10)

    def _cores(self, trials: Iterable[Trial]) -> None:
        """Fit subsets and special cases of trials with undetermined effects.

        The subsets are the determined effects, and all effects but one of the undetermined ones.
        """
        for trial in trials:
            if not trial.effects or self.determined(trial):
                continue
            self._special_cases(trial)  # a shape that the data leave open is a simpler law
            if len(trial.effects) < 2:
                continue
            # drop all undetermined effects at once, then one by one
            sure = np.array(trial.surest) >= self.case.levels.moved
            self._without(trial, np.flatnonzero(sure))
            for k in np.flatnonzero(~sure):
                self._without(trial, np.delete(np.arange(len(sure)), k))

    def _prune(self) -> None:
        """Refit the best set without each of its effects.

        All are tried: a limit at the end of the record is far from zero, and still limits nothing.
        """
        for best in self._improving(MOST):
            if len(best.effects) < 2:
                return
            for i in np.argsort(best.surest):
                self._without(best, [k for k in range(len(best.effects)) if k != i])

    def _names(self) -> None:
        """Refit the best set with each force replaced by effects that imitate it."""
        for best in self._improving(2):
            # other effects in the place of one or several
            here = best.start
            for gone in _groups(best.effects):
                for other, values in self._imitations(best, gone):
                    kept = [i for i in range(len(best.effects)) if i not in gone]
                    effects = (*(best.effects[i] for i in kept), other)
                    own = [*(here.values[i] for i in kept), values]
                    starts = [replace(here, values=own)]
                    if is_gain(other):  # gain of an output in place of an input, or vice versa
                        gain = 1.0 + sum(values.values())
                        starts += [
                            replace(here, values=own, states=here.states * q) for q in (gain, 1.0 / gain)
                        ]
                    self.try_(effects, best.hypothesis.nuisances, starts, noise=best.noise, evaluations=10)

    def _simplify(self) -> None:
        """Refit the special cases of the leading laws.

        Each starts from the optimum of the general law. At a limit of its shape a law equals a simpler one.
        The evidence compares the two only if both are fitted in the same valley.
        """
        with self.step("simpler laws"):
            for before in self._improving(_ROUNDS):
                least = self.posterior(before) - _RIVALS
                for trial in [x for x in self.ranked() if self.posterior(x) > least][:_LEADERS]:
                    self._special_cases(trial)
                self.polish()

    def _special_cases(self, trial: Trial) -> None:
        """Fit a trial with each special case of its effects."""
        for (i, effect), other in product(enumerate(trial.effects), self.library):
            if other.place == effect.place and other.kind in effect.spec.special_cases:
                if other not in trial.effects:
                    self._special_case(trial, i, other)

    def _special_case(self, trial: Trial, i: int, other: Effect) -> None:
        """Fit a trial with a special case of one of its effects.

        Nothing is done if that fits as well already.
        """
        effects = (*trial.effects[:i], other, *trial.effects[i + 1 :])
        nuisances, start = trial.hypothesis.nuisances, trial.start
        if is_number(other) and trial.hypothesis.floated:  # the parameters are held, except this one
            nuisances, n = nuisances - self.opened, self.fitted.problem.n_theta
            start = replace(start, theta=start.theta[:n])
        # only if the special case has no better fit already
        known = [x.total for x in self.trials if x.hypothesis.key == (frozenset(effects), nuisances)]
        if not self.first_time("special", trial, i, other) or max(known, default=-np.inf) > trial.total:
            return
        values = {n: start.values[i].get(n, 0.0) for n in other.free}
        if trial.force(i) is not None:
            alike = dict(imitations(trial, [i], [other], self.motion, special=True))
            values = alike.get(other, values)
        start = replace(start, values=[*start.values[:i], values, *start.values[i + 1 :]])
        self.try_(effects, nuisances, [start], noise=trial.noise, evaluations=10)

    def _one_signal_effect(self, trial: Trial, which: Sequence[int]) -> Starts:
        """Return the linear effects of channels that may stand for several.

        They start at the sum of the delays; the smoothing r(k) = a r(k-1) + (1 - a) y(k) delays a slow signal
        by a / (1 - a) samples.
        """
        dt, seconds = self.case.motions[0].data.dt, 0.0
        # sum of the delays; a smoothing delays by a / (1 - a) samples
        for i in which:
            (c,), (value,) = trial.effects[i].spec.coefficients, trial.start.values[i].values()
            seconds += value if c.unit_rule == "s" else value / (1.0 - value) * dt
        key = ("name", trial.hypothesis.key, tuple(which))
        return [
            (other, dict.fromkeys(other.coefficients, seconds))
            for other in self.case.library
            if _of_channel(other) and _is_late(other) and not other.prior and self.first_time(*key, other)
        ]

    def _at_other_ends(self, trial: Trial, i: int) -> Starts:
        """Return the same linear effect at the other channels.

        Of an entry of B, C or D those are the others: an input at another store looks like a sensor of it.
        """
        first, of_signals = trial.effects[i], _of_signals(trial.effects[i])
        linear = [e for e in self.case.library if (_of_signals if of_signals else _of_channel)(e)]
        ends = [e for e in linear if e.place != first.place and e.coefficients == first.coefficients]
        key = ("name", trial.hypothesis.key, i)
        fresh = [e for e in ends if first in linear and self.first_time(*key, e)]
        values = dict.fromkeys(first.coefficients, 0.0) if of_signals else trial.start.values[i]
        return [(other, values) for other in fresh]

    def _imitations(self, trial: Trial, which: Sequence[int]) -> Starts:
        """Return the effects that imitate some effects best.

        An effect that is no force is moved to the other channels instead.
        """
        first, key = trial.effects[which[0]], trial.hypothesis.key
        if trial.force(which[0]) is None:
            if len(which) > 1 and all(_is_late(trial.effects[i]) for i in which):
                return self._one_signal_effect(trial, which)
            return self._at_other_ends(trial, which[0])
        held = [e.kind for e in trial.effects if e.place == first.place]
        others = (
            other
            for other in self.case.library
            if other.place == first.place and other.kind not in held and not is_number(other)
            if self.first_time("name", key, tuple(which), other)
        )
        return imitations(trial, which, others, self.motion)

    def polish(self) -> None:
        """Polish the fits close to the best one, at most `_POLISHED` of them."""
        with self.step("polishing"):
            # refine one fit after the other, the most probable first
            for _ in range(_POLISHED):
                best = self.posterior(self.best)
                done = [x for x, n in self._polished.items() if x.is_linear or n >= self.fitter.substeps]
                todo = [x for x in self.trials if x.effects and x not in done and self.determined(x)]
                todo = [x for x in todo if self.posterior(x) > best - _NEAR]
                if not todo:
                    return
                trial = self.ranked(todo)[0]
                better = self.fitter.polished(trial)
                self._polished |= {trial: self.fitter.substeps, better: self.fitter.substeps}
                self.add(better, instead=True)

    # ------------------------------------------------------------------ criticism
    def passed(self, trial: Trial) -> bool:
        """Return whether a trial passes the residual tests (see `Criticism`)."""
        return self.criticized(trial).passed

    def settled(self, trials: Sequence[Trial]) -> list[Trial]:
        """Return trials with the substeps that the coefficients of one need.

        What the tests said of each trial is kept: its residual hardly changes.
        """
        found = list(trials)
        with self.step("substeps"):
            for _ in range(2):  # the first may need what only a later one asks for
                for i, trial in enumerate(found):
                    # the same substeps for all, so that they compare
                    least = max(one.problem.substeps for one in found)
                    found[i] = self.fitter.settled(trial, least)
        known, pairs = self._criticism, zip(found, trials, strict=True)
        known |= {settled: known[trial] for settled, trial in pairs if trial in known}
        return found

    def criticized(self, trial: Trial) -> Criticism:
        """Return the results of the residual tests of a trial, computed once."""
        if trial not in self._criticism:
            with self.step("tests"):
                try:
                    self._criticism[trial] = self._criticize(trial)
                except ModelError:  # the model diverges within one sample, or no observer exists
                    self._criticism[trial] = Criticism(False, [], -np.inf)
        return self._criticism[trial]

    def tests(self, trial: Trial) -> tuple[FTest, ...]:
        """Return the residual tests of a trial, even if the first have decided."""
        known = self.criticized(trial)
        if not known.tests:
            known = self._criticism[trial] = known._replace(tests=self.all_tests(trial))
        return tuple(known.tests)

    def _criticize(self, trial: Trial) -> Criticism:
        case, fitted = self.case, trial.model
        # tests without candidates are cheap and come first
        others = passed_without_library(trial.tested, self._motions(trial), case.significance)
        if others is None and not case.passes([], fitted):  # a response may be solved up to rounding
            return Criticism(False, [], -np.inf)
        tests = self.all_tests(trial, others)
        odds = -np.inf
        # free forces at the places of the effects, only if all else passes
        for place in dict.fromkeys(e.place for e in trial.effects if case.passes(tests, fitted)):
            more, against = self._beside(trial, place)
            tests += more
            odds = float(np.logaddexp(odds, against))
        excluded = 2 * odds > case.levels.rival
        return Criticism(case.passes(tests, fitted) and not excluded, tests, odds)

    def _beside(self, trial: Trial, place: str) -> tuple[list[FTest], float]:
        """Return tests and log odds of a free force or curve at a place."""
        if not self.case.in_time:
            free = FreeStiffness(trial.tested, place)
            return free.tests(), free.odds(trial.base)
        beside = Beside(trial.tested, place)
        size = trial.size if beside.at_channel else trial.force_at(place)
        return (beside.tests(), beside.odds(size)) if size > 0 else ([], -np.inf)

    def _motions(self, trial: Trial) -> list[Any]:
        """Return the motion of each record, estimated with a trial."""
        fitted = trial.model
        return [estimated_motion(fitted.structure, fitted.theta, m.data) for m in self.case.motions]

    def all_tests(self, trial: Trial, others: Sequence[FTest] | None = None) -> list[FTest]:
        """Return all residual tests of a trial except those of free forces."""
        # score tests of the candidates that the trial does not hold
        fitted, ratio, motions = trial.model, trial.hypothesis.ratio, self._motions(trial)
        rest = not_held(self.case.library, fitted.structure.effects)
        if fitted.problem.dwells:  # a harmonic balance of two nonlinear effects is slow
            rest = [e for e in rest if e.spec.linear or e.spec.delays]
        known, scored = self._columns.get(trial.hypothesis.key, (None, []))
        if known is None or not trial.near(known):
            scored = candidate_columns(fitted, in_race(fitted, rest, (ratio,)), motions[0], (ratio,))
            self._columns[trial.hypothesis.key] = trial, scored
        return run_tests(trial.tested, scored, motions, len(rest) - len(scored), others)


def _groups(effects: Sequence[Effect]) -> list[list[int]]:
    """Return positions of effects that one other effect may replace.

    These are each effect, those of a place, and the delays and lags of the channels: a delay and a smoothing
    of a sensor look like the lag of an actuator.
    """
    places: dict[str, list[int]] = {}
    for i, effect in enumerate(effects):
        places.setdefault(effect.place, []).append(i)
    late = [i for i, effect in enumerate(effects) if _is_late(effect)]
    return [[i] for i in range(len(effects))] + [some for some in (*places.values(), late) if len(some) > 1]


def _of_channel(effect: Effect) -> bool:
    """Return whether an effect is a linear one at an input or an output."""
    return bool(effect.spec.at_channel and effect.spec.linear)


def _is_late(effect: Effect) -> bool:
    """Return whether a channel follows its signal with a delay or a lag."""
    rules = {coefficient.unit_rule for coefficient in effect.spec.coefficients}
    return effect.spec.at_channel and (rules == {"s"} or (rules == {"1"} and effect.spec.inner_states > 0))


def _of_signals(effect: Effect) -> bool:
    """Return whether an effect is an entry of B, C or D."""
    return "any" in effect.spec.where and not effect.place.startswith("A")


def is_number(effect: Effect) -> bool:
    """Return whether an effect changes a single parameter of a linear model."""
    return effect.spec.is_parameter or effect.spec.relative


def is_gain(effect: Effect) -> bool:
    """Return whether an effect is the relative gain of a channel."""
    return bool(effect.spec.relative and effect.spec.at_channel)
