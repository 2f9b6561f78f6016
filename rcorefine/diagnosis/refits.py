"""Fits of sets of effects, each with its own noise model."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from itertools import product
from typing import Any, NamedTuple

import numpy as np

from ..data.measurement import Measurement
from ..data.signals import difference
from ..effects.effect import Effect, unit_forces
from ..engine.point import resting
from ..engine.structure import Structure
from ..inference.fitted import FittedModel
from ..inference.problem import Descent, Problem, descend
from ..inference.search import search
from ..inference.starts import Motion, shape_starts
from ..systems.linear import Array
from .hypothesis import Hypothesis, Start, Trial, evidence, likeliest_noise, weighted
from .noise import Noise

_SHARES = (1.0, 0.4, 0.1)  # shares of the starting sizes: the linear solution may diverge
_SEARCHED = 2  # substeps of all later trials at most: finer ones are a matter of the few that lead
_STEP = 1.0  # log evidence that halving the substep may change, of an answer
_RANKED_STEP = 3.0  # of a ranking: by one it changes with where in a substep forces jump
_WIDTHS = (0.5, 2.0, 1 / 1.4, 1.4)  # factors on the width over which a jump is smoothed
_NOISE_ROUNDS, _FINER, _WIDER = 3, 3, 4
_HOPE = 3.0  # times the predicted gain of the next step, that a descent may still gain
_IMITATED, _IMITATIONS = 0.6, 3  # most share of a force that an imitation leaves; imitations tried


#: Effects, each with the values of its coefficients.
Starts = list[tuple[Effect, dict[str, float]]]


class Fitter:
    """Fitter of hypotheses about one model and its records.

    Parameters
    ----------
    fitted : FittedModel
        The model without effects.
    motion : Motion
        Estimated motion.
    colored : bool
        Whether noise may be other than white and normal. A noise filter can whiten model errors, too; with
        white noise, the error of the free run itself counts.

    Attributes
    ----------
    substeps : int
        Substeps per sample of new trials: 1, or 2 once an effect needed more.
    """

    def __init__(self, fitted: FittedModel, motion: Motion, colored: bool = True) -> None:
        self.fitted, self.motion, self.substeps = fitted, motion, 1
        self.before = fitted.residuals()
        self.cost = 0.5 * sum(float(np.sum(r**2)) for r in self.before)
        self.noise_of = likeliest_noise(fitted.problem, colored)

    def scored(self, trial: Trial) -> Trial:
        """Return a trial with its noise and evidence."""
        ratio = trial.hypothesis.ratio
        before = trial.base.residuals(ratio) if ratio else self.before
        return evidence(trial, before, self.noise_of, self.fitted.problem.n_theta)

    def empty(self, hypothesis: Hypothesis, base: FittedModel) -> Trial:
        """Return the trial of a base without effects, with its own noise."""
        gain = _gain(base, base.problem, hypothesis.ratio)
        run = descend(base.problem, base.point, gain=gain, evaluations=1)
        return self._under_own_noise(Trial(hypothesis, base, base.problem, run), gain, 8)

    def placed(
        self, effects: Sequence[Effect], base: FittedModel, starts: Sequence[Start]
    ) -> list[tuple[Problem, Array]]:
        """Return the problem of effects at a base, with each of several starts.

        Starts with the same widths share one problem.
        """
        # coefficients of the effects behind those of the base; equal widths share a problem
        problem, absent = base.extended(list(effects), self.motion)
        if self.substeps > problem.substeps and not problem.structure.is_linear:
            problem = problem.like(substeps=self.substeps)
        whole, first = problem.structure, len(problem.structure.effects) - len(effects)
        made, found = [problem], []
        for start in starts:
            known = {
                k: start.widths.get(whole.effects[k].place, w) if k >= first else w
                for k, w in whole.constants.items()
            }
            problem = next((one for one in made if one.structure.constants == known), None) or problem.like(
                Structure(whole.model, whole.effects, constants=known)
            )
            made.append(problem)
            theta = problem.unpack(absent)[0].copy()
            theta[: len(start.theta)] = start.theta
            for i, values in enumerate(start.values):
                for name, value in values.items():
                    if (at := problem.structure.position(first + i, name)) >= 0:
                        theta[at] = value
            states = np.zeros((len(problem.records), problem.n_states))
            states[:, : base.problem.n_states] = start.states[:, : base.problem.n_states]
            found.append((problem, problem.inside(problem.pack(theta, states))))
        return found

    def fit(
        self,
        hypothesis: Hypothesis,
        base: FittedModel,
        starts: Sequence[Start],
        *,
        shared: bool = False,
        noise: Noise | None = None,
        evaluations: int = 8,
    ) -> Trial | None:
        """Fit a hypothesis from the best of several starts.

        Parameters
        ----------
        hypothesis : Hypothesis
            Effects and nuisances.
        base : FittedModel
            The model with these nuisances.
        starts : sequence of Start
            Starting values.
        shared : bool
            Whether starts with reduced sizes of the effects are tried, too.
        noise : Noise, optional
            Noise of the first descent, usually that of the trial that gave the start; default plain weights.
        evaluations : int
            Evaluations of each descent at most.

        Returns
        -------
        Trial or None
            None if the model diverges from every start.
        """
        effects = hypothesis.effects
        # reduced starts: the linear solution may lie beyond the region of convergence
        absent = Start([], *base.problem.unpack(base.point))
        shares = _SHARES if shared else (1.0,)
        reduced = [start.shared(effects, absent, share) for start in starts for share in shares]
        if not reduced:
            return None
        lowest = np.inf
        placed = self.placed(effects, base, reduced)
        problem, nearest = placed[0]
        gain = _gain(base, problem, hypothesis.ratio)
        # keep the start with the lowest cost, stop at a clearly good one
        for k in range(0, len(placed), len(shares)):
            for other, point in placed[k : k + len(shares)]:
                cost = plain_cost(other, point, gain)
                if cost < lowest:
                    lowest, problem, nearest = cost, other, point
                if cost < 0.3 * self.cost:
                    break
        if not np.isfinite(lowest):
            return None
        run = _descended(problem, nearest, noise, gain, evaluations, 1e-4 if noise is None else 1e-6)
        if not np.isfinite(run.cost):
            return None
        return self._under_own_noise(Trial(hypothesis, base, problem, run), gain, evaluations)

    def single(self, task: tuple[Effect, Sequence[Start]]) -> Trial | None:
        """Fit one effect in the model as it is, from several starts."""
        return self.fit(Hypothesis((task[0],)), self.fitted, task[1], shared=True)

    def together(self, task: tuple[Hypothesis, FittedModel, Start]) -> Trial | None:
        """Fit a set of effects at a base, with few evaluations."""
        return self.fit(task[0], task[1], [task[2]], shared=True, evaluations=5)

    def sought(self, task: tuple[Hypothesis, FittedModel]) -> Trial | None:
        """Fit one effect at a base, from the search of `refine`.

        A strong effect moves the resonances. The fit without it is then in another local minimum, which holds
        every start nearby. The search leaves it by observers that follow the record, and by free runs of
        growing length.
        """
        hypothesis, base = task
        problem, _ = base.extended(list(hypothesis.effects), self.motion)

        # free runs of growing length by the search of `refine`
        def build(records: Sequence[Measurement], steps: int, unknown_start: bool = False) -> Problem:
            return problem.like(records=records, substeps=steps)

        structure, theta = problem.structure, base.theta
        theta = np.concatenate([theta, structure.start()[theta.size :]])
        starts = shape_starts(structure, theta, self.motion, len(base.structure.effects))
        try:
            with np.errstate(over="ignore", invalid="ignore"):  # some trial points run away
                point, steps = search(build, structure, problem.records, starts, problem.substeps)
        except (np.linalg.LinAlgError, ValueError):  # no observer exists for this model
            return None
        problem = problem.like(substeps=max(steps, problem.substeps))
        gain = _gain(base, problem, 0.0)
        run = descend(problem, point, gain=gain, evaluations=8)
        if not np.isfinite(run.cost):
            return None
        return self._under_own_noise(Trial(hypothesis, base, problem, run), gain, 8)

    def _under_own_noise(self, trial: Trial, gain: Array | None, evaluations: int) -> Trial:
        """Refit a trial under its own noise while the evidence rises.

        There are at most three rounds, and one if all samples are equally noisy.
        """
        # iterate: noise model from the residual, fit under its weights
        best = self.scored(trial)
        for _ in range(_NOISE_ROUNDS if best.problem.size else 0):
            again = self._after(best, best.problem, best.noise, gain, evaluations)
            if again is None:
                break
            gained = again.total - best.total
            best = again if gained > 0 else best
            if gained < 1.0 or not best.noise.uneven:
                break
        return best

    def _after(
        self,
        trial: Trial,
        problem: Problem,
        noise: Noise,
        gain: Array | None,
        most: int,
        tolerance: float = 1e-6,
    ) -> Trial | None:
        """Return a trial after a descent on a problem, None if it diverges."""
        run = _descended(problem, trial.run, noise, gain, most, tolerance)
        return self.scored(replace(trial, problem=problem, run=run)) if np.isfinite(run.cost) else None

    def in_free_run(self, trial: Trial) -> Trial:
        """Return the trial at the minimum of its error, with plain weights."""
        gain = _gain(trial.base, trial.problem, trial.hypothesis.ratio)
        run = descend(trial.problem, trial.point, gain=gain, evaluations=20, tolerance=1e-6)
        return self.scored(replace(trial, run=run)) if np.isfinite(run.cost) else trial

    def polished(self, trial: Trial) -> Trial:
        """Return the trial at its minimum, with refined substeps and widths."""
        base, ratio = trial.base, trial.hypothesis.ratio
        problem, gain = trial.problem, _gain(base, trial.problem, ratio)
        # finer substeps for force laws that jump
        if problem.stepped and problem.substeps < self.substeps:
            problem = problem.like(substeps=self.substeps)
            trial = self._after(trial, problem, trial.noise, gain, 8) or trial
        # far from the minimum the weights treat model errors as outliers: one descent without weights
        plain = _descended(problem, trial.run, None, gain, 20, 1e-6)
        if np.isfinite(plain.cost):
            again = self._under_own_noise(replace(trial, run=plain), gain, 8)
            trial = again if again.total > trial.total else trial
        nearest = self._after(trial, problem, trial.noise, gain, 8, 1e-7)
        return trial if nearest is None else self._widths(self.settled(nearest, ranked=True), gain)

    def settled(self, trial: Trial, least: int = 1, *, ranked: bool = False) -> Trial:
        """Return the trial with substeps that no longer matter, but at least some.

        Half of them must not change the log evidence by `_STEP`. Where the trial is only `ranked` they must
        not do so by `_RANKED_STEP`, with the coefficients that they ask for.
        """
        gain = _gain(trial.base, trial.problem, trial.hypothesis.ratio)
        # compare the log evidence at half the substep
        for _ in range(_FINER if trial.problem.stepped else 0):
            finer = trial.problem.like(substeps=2 * trial.problem.substeps)
            run = descend(finer, trial.point, gain=gain, evaluations=1)
            if not np.isfinite(run.cost):
                break
            again = self.scored(replace(trial, problem=finer, run=run))
            change = again.total - trial.total + ranked * (again.lack - trial.lack)
            if finer.substeps > least and abs(change) < (_RANKED_STEP if ranked else _STEP):
                break
            trial = self._after(again, finer, trial.noise, gain, 6, 1e-7) or again
            if ranked:
                self.substeps = max(self.substeps, min(finer.substeps, _SEARCHED))
        return trial

    def _widths(self, trial: Trial, gain: Array | None) -> Trial:
        """Return the trial with the widths of jumps that the evidence prefers."""
        structure = trial.problem.structure
        for k in range(len(structure.effects) - len(trial.effects), len(structure.effects)):
            effect, price = structure.effects[k], 0.5 * float(np.log(trial.problem.n_points))
            if not effect.spec.jumps or "width" in effect.fixed:
                continue
            # widths: halved, doubled, then in small steps, as long as the evidence rises
            for factor in _WIDTHS:
                for _ in range(_WIDER):
                    widths = trial.problem.structure.constants
                    widths = {**widths, k: factor * widths[k]}
                    other = trial.problem.like(
                        Structure(structure.model, structure.effects, constants=widths)
                    )
                    again = trial
                    for most in (1, 5):  # one evaluation; a descent only if that can still win
                        run = _descended(other, trial.point, trial.noise, gain, most, 1e-7)
                        if not np.isfinite(run.cost):
                            break
                        again = self.scored(replace(trial, problem=other, run=run))
                        if not again.total + _HOPE * run.lack > trial.total + price:
                            break
                    if not again.total > trial.total + price:
                        break
                    trial, price = again, 1.0
        return trial


def plain_cost(problem: Problem, point: Array, gain: Array | None) -> float:
    """Return half the sum of squares at a point, infinite after divergence."""
    theta, starts = problem.unpack(problem.inside(point))
    total = 0.0
    for engine, start in zip(problem.engines, starts, strict=True):
        run = engine.run(theta, start, sensitivity=False, gain=gain, check=False)
        error = problem.weights[:, None] * difference(run.outputs, engine.data.outputs)
        if run.blew_up >= 0 or not np.isfinite(error).all():
            return np.inf
        total += 0.5 * float(np.sum(error**2))
    return total


def _gain(base: FittedModel, problem: Problem, ratio: float) -> Array | None:
    """Return the predictor gain at a base, padded for the states of a problem.

    None for the free run of a stable model.
    """
    gain = base.gain(ratio)
    return None if gain is None else np.pad(gain, ((0, problem.n_states - gain.shape[0]), (0, 0)))


def _descended(
    problem: Problem, start: Array | Descent, noise: Noise | None, gain: Array | None, most: int,
    tolerance: float = 1e-6,
) -> Descent:  # fmt: skip
    """Descend in the metric of a noise, or of plain weights.

    The evaluation has plain weights.
    """
    # residual and Jacobian of the start are known in this metric
    known = start.known(problem, gain) if isinstance(start, Descent) else None
    point = start.point if isinstance(start, Descent) else start
    given: dict[str, Any] = {"gain": gain, "tolerance": tolerance}
    given["whitener"] = None if noise is None else noise.whitener
    if noise is None or not noise.uneven:
        return descend(problem, point, evaluations=most, known=known, **given)
    run = descend(weighted(problem, noise), point, evaluations=most, **given)
    return descend(problem, run.point, gain=gain, evaluations=1) if np.isfinite(run.cost) else run


def _shapes_of(
    effect: Effect, structure: Structure, given: Mapping[Effect, dict[str, float]], motion: Motion
) -> list[dict[str, float]]:
    """Return shaping coefficients, also those that imitate given effects."""
    one = Structure(structure.model, [effect])
    names, shaping = [q.name for q in one.parameters], effect.spec.shaping
    shapes = []
    # shapes from the motion, then those at which the law equals a given one
    for start in shape_starts(one, one.start(), motion):
        values = zip(names, map(float, start), strict=True)
        shapes.append({name: value for name, value in values if name in shaping})
    for other, known in given.items():
        if other.kind in effect.spec.contains:
            limit = effect.spec.contains[other.kind]
            shapes += [{n: limit.get(n, v) for n, v in shapes[0].items()}]
        if effect.kind in other.spec.special_cases:  # the gap of a stop is the distance to one of its limits
            alike = product(effect.spec.shaping, other.spec.shaping & known.keys())
            for name, its in alike:
                if effect.spec.coefficient(name).unit_rule == other.spec.coefficient(its).unit_rule:
                    low, high = effect.bounds(name)
                    near = float(np.clip(known[its] if low < 0 else abs(known[its]), low, high))
                    shapes += [{**shapes[0], name: near}]
    return shapes


def imitations(
    trial: Trial, which: Sequence[int], others: Iterable[Effect], motion: Motion, *, special: bool = False
) -> Starts:
    """Return the effects that imitate the force of some effects best.

    Each comes with its coefficients. At most `_IMITATIONS` effects are returned, none that leaves more than
    `_IMITATED` of the force. Where parameters are re-estimated they take the linear part of the force, unless
    one of the other effects is such a parameter. With `special`, the others are special cases: none is too
    far, and offsets and initial states take a constant force.
    """
    # force of the given effects along the motion; other laws by least squares
    along = [one for one in map(trial.force, which) if one is not None]
    if len(along) < len(which):
        return []
    d, v, w, force = along[0]
    force = force + sum(one[-1] for one in along[1:])
    # re-estimated parameters take the linear part
    others = list(others)
    beside = trial.hypothesis.floated and not any(other.spec.is_parameter for other in others)
    linear = np.array([d, v][: 2 * beside] + [np.ones(d.size)][: int(special)]).reshape(-1, d.size)
    structure, place = trial.problem.structure, trial.effects[which[0]].place
    target = _Force(d, v, w, force, linear, resting(structure, place))
    # share of the force that each law leaves at each shape
    whole, given = target.left_by(linear.T)[0], {trial.effects[i]: trial.start.values[i] for i in which}
    options = [
        (left / whole, other, values)
        for other in others
        for left, values in target.imitated(other, _shapes_of(other, structure, given, motion))
    ]
    best: dict[Effect, dict[str, float]] = {}
    for left, other, values in sorted(options, key=lambda one: one[0]):
        if (special or left < _IMITATED) and len(best) < _IMITATIONS:
            best.setdefault(other, values)
    return list(best.items())


class _Force(NamedTuple):
    """Force along a motion, which another effect may imitate.

    Attributes
    ----------
    d, v, w : ndarray
        Motion at its place, and the inputs.
    force : ndarray, shape (N,)
        Force.
    linear : ndarray, shape (k, N)
        What else may take a part of it.
    rest : tuple of float
        Motion at rest.
    """

    d: Array
    v: Array
    w: Array
    force: Array
    linear: Array
    rest: Any

    def left_by(self, columns: Any) -> tuple[float, Array]:
        """Return the sum of squares that columns leave, and their sizes."""
        sizes = np.linalg.lstsq(columns, self.force, rcond=1e-10)[0]
        return float(np.sum((self.force - columns @ sizes) ** 2)), sizes

    def imitated(
        self, other: Effect, shapes: Iterable[dict[str, float]]
    ) -> Iterator[tuple[float, dict[str, float]]]:
        """Yield what an effect leaves at each shape, and its coefficients."""
        for shape in shapes:
            free = [n for n in other.free if n not in shape]
            columns = unit_forces(other, self.d, self.v, [shape], self.w, self.rest)
            if columns and len(columns) == len(free):
                left, sizes = self.left_by(np.column_stack([*columns, *self.linear]))
                yield left, {**shape, **dict(zip(free, map(float, sizes), strict=False))}
