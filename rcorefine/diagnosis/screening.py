"""First-order comparison of sets of effects by one Gram matrix."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from ..effects.effect import Effect
from ..inference.f_tests import Basis, project
from ..inference.fitted import FittedModel
from ..inference.sensitivities import Candidate, _shapes, parameter_columns
from ..inference.starts import Motion
from ..inference.whitening import Whitener
from ..systems.linear import Array
from .hypothesis import Start

_FLAT = 1e-4  # least share of a column outside the span of parameters, offsets and initial states
_NOTHING = 0.01  # variance of a white residual that is below the resolution: that of an exact record
_WIDTH = 6  # sets that each round of the beam search extends
_MOST_RECORDS = 8  # most records whose initial states are solved for together


@dataclass(eq=False)
class Group:
    """Columns of an effect with given shaping coefficients.

    Attributes
    ----------
    effect : Effect
        Effect.
    values : dict
        Known coefficients, those that shape the effect.
    names : list of str
        Coefficient of each column.
    at : slice
        Positions of the columns.
    """

    effect: Effect
    values: dict[str, float]
    names: list[str]
    at: slice


#: A set of groups with its log evidence.
Ranked = tuple[float, list[Group]]


class Metric(NamedTuple):
    """Metric of residuals: filters, weights and observer ratio.

    Attributes
    ----------
    whitener : Whitener
        Whitening filter of each output.
    weights : list of ndarray, shape (n_y, N), or None
        One over the relative standard deviation of each sample.
    ratio : float
        Observer ratio (process noise) of the columns, 0 for the free run.
    """

    whitener: Whitener
    weights: list[Array] | None = None
    ratio: float = 0.0


class Screen:
    """First-order comparison of sets of effects at a fitted model.

    Coefficients with a flat prior (offsets, initial states) are projected out of all columns.

    Parameters
    ----------
    fitted : FittedModel
        Point of the linearization.
    candidates : sequence of Candidate
        Candidate effects with their columns.
    numbers : dict
        Prior standard deviation of each parameter that may be re-estimated together with the effects.
    metric : Metric
        Metric of residuals.
    motion : Motion
        Estimated motion.
    """

    def __init__(
        self,
        fitted: FittedModel,
        candidates: Sequence[Candidate],
        numbers: dict[Effect, float],
        metric: Metric,
        motion: Motion,
    ) -> None:
        self.fitted, self.metric, self.number_sd = fitted, metric, np.array(list(numbers.values()))
        # whitened Jacobian of the fit; offsets and initial states have no prior
        blocks, problem = fitted.blocks(metric.ratio), fitted.problem
        p, sd = problem.n_theta, problem.prior_sd
        self._judged = problem.judged(fitted.theta)
        jacobian = [self._white([j], [w]) for w, (_, j) in zip(self._weights(), blocks, strict=True)]
        self.flat = ~np.isfinite(sd)
        self.jacobian, held = jacobian, ~self.flat
        self.basis = Basis.of([j[:, :p][:, self.flat] for j in jacobian], [j[:, p:] for j in jacobian])
        self.held_sd = sd[held]
        # residual at the prior means: what priors hold back belongs to the data
        r = self._white([b for b, _ in blocks], self._weights())
        columns = np.concatenate([j[:, :p][:, held] for j in jacobian]) * self.held_sd
        at_prior = (fitted.theta[held] - problem.prior_mean[held]) / self.held_sd
        parts = [(r - columns @ at_prior)[:, None], columns]
        self.n_held, self.n_numbers = columns.shape[1], len(numbers)
        # columns of re-estimated parameters, in prior standard deviations
        if numbers:
            found = parameter_columns(fitted, list(numbers), motion, metric.ratio)
            parts.append(self.white(found) * self.number_sd)
        self.n_parameters = self.n_held + self.n_numbers
        self.groups: list[Group] = []
        at = 1 + self.n_parameters
        # columns of each candidate; those in the span of the flat directions show nothing
        for candidate in candidates:
            for group, blocks_of in _groups_of(candidate, metric.ratio):
                w = self.white(blocks_of)
                size = np.linalg.norm(w, axis=0)
                if not (np.isfinite(size).all() and (size > 0).all()):
                    continue
                if np.linalg.norm(project(w / size, self.basis), axis=0).max() < _FLAT:
                    continue
                group.at = slice(at, at + w.shape[1])
                self.groups.append(group)
                parts.append(w)
                at += w.shape[1]
        # Gram matrix of residual, parameters and candidates, flat directions projected out
        self.raw = np.hstack(parts)
        self.scale = np.linalg.norm(self.raw, axis=0)
        self.scale[self.scale == 0] = 1.0
        self.scale[: 1 + self.n_parameters] = 1.0
        self.X = project(self.raw / self.scale, self.basis)
        self.G = self.X.T @ self.X
        self.n = max(len(r) - self.basis.rank, 10)
        self._left = max(float(self.G[0, 0]), _NOTHING * self.n)  # power of the residual

    def _weights(self) -> list[Array]:
        """Return the weights of the samples by their noise."""
        return self.metric.weights or [np.ones_like(j) for j in self._judged]

    def _white(self, blocks: Sequence[Array], weights: Sequence[Array]) -> Array:
        weighed = [(w[:, :, None] if b.ndim == 3 else w) * b for w, b in zip(weights, blocks, strict=True)]
        return self.metric.whitener.apply(weighed)

    def white(self, blocks: Sequence[Array]) -> Array:
        """Return whitened columns of arrays (n_y, N, k); 0 for unjudged samples."""
        both = [w * j for w, j in zip(self._weights(), self._judged, strict=True)]
        return self._white(blocks, both)

    def _columns(self, groups: Sequence[Group], open_: bool) -> tuple[int, list[int]]:
        """Return the number of parameters, and the columns of these and of a set."""
        m = self.n_parameters if open_ else self.n_held
        return m, [*range(1, 1 + m), *(i for g in groups for i in range(g.at.start, g.at.stop))]

    def solve(self, groups: Sequence[Group], open_: bool) -> tuple[float, Array]:
        """Return the log evidence of a set, and its coefficients.

        The variance of the noise is estimated. The coefficients are in units of the scaled columns, those of
        the parameters first. With `open_` the parameters of the model are re-estimated, too.
        """
        # Bayesian linear regression with unknown noise variance, by fixed-point iteration
        m, columns = self._columns(groups, open_)
        rr = self._left
        if not columns:
            return -0.5 * self.n * float(np.log(rr / self.n)), np.zeros(0)
        G, b = self.G[np.ix_(columns, columns)], self.G[columns, 0]
        # unit prior for the parameters; for effects as large as the residual
        precision = np.r_[np.ones(m), np.full(len(columns) - m, 1.0 / rr)]
        variance, u = rr / self.n, np.zeros(0)
        for _ in range(3):
            u = np.linalg.solve(G / variance + np.diag(precision), -b / variance)
            rest = max(rr + 2 * float(b @ u) + float(u @ G @ u), 1e-12 * rr)
            variance = rest / self.n
        # Occam factor: log det of posterior over prior precision
        A = G / variance + np.diag(precision)
        occam = float(np.linalg.slogdet(A)[1]) - float(np.sum(np.log(precision)))
        value = -0.5 * (self.n * float(np.log(variance)) + float(u @ (precision * u)) + occam)
        return value, u

    def next_scores(self, chosen: Sequence[Group], open_: bool) -> Array:
        """Return approximate gains in log evidence by each further group."""
        # score of each further group: one Gram-Schmidt step in the metric of the present solution
        m, columns = self._columns(chosen, open_)
        rr = self._left
        value = self.solve(chosen, open_)[0]
        variance = max(float(np.exp(-2.0 * value / self.n)), 1e-12 * rr / self.n)
        S = self.G / variance
        # Schur complement: what the chosen columns already explain
        if columns:
            precision = np.r_[np.ones(m), np.full(len(columns) - m, 1.0 / rr)]
            A = self.G[np.ix_(columns, columns)] / variance + np.diag(precision)
            B = self.G[columns, :] / variance
            S = S - B.T @ np.linalg.solve(A, B)
        # gain in residual, then the price of the prior volume
        total = max(float(S[0, 0]), 1e-300)
        scores = np.full(len(self.groups), -np.inf)
        for i, g in enumerate(self.groups):
            block = S[g.at, g.at]
            eye = np.eye(len(block))
            gain = float(S[g.at, 0] @ np.linalg.solve(block + (1e-9 / variance + 1.0 / rr) * eye, S[g.at, 0]))
            price = float(np.linalg.slogdet(eye + block * rr)[1])
            scores[i] = -0.5 * self.n * np.log(max(total - gain, 1e-9 * total) / total) - 0.5 * price
        return scores

    def beam(
        self,
        most: int,
        open_: bool,
        price: float,
        usable: Callable[[Effect], bool] = lambda _: True,
    ) -> list[Ranked]:
        """Return sets of groups by first-order evidence, the best first.

        Parameters
        ----------
        most : int
            Maximum number of groups in a set.
        open_ : bool
            Whether the parameters are re-estimated together with the effects.
        price : float
            Penalty per effect in log evidence.
        usable : callable
            Function that tells whether an effect may be in a set.

        Returns
        -------
        list of (float, list of Group)
            Penalized log evidence and groups of each set; the empty set is included.
        """
        # beam search: widen each set by the groups of highest score
        start = self.solve([], open_)[0]
        found: dict[tuple[int, ...], Ranked] = {(): (start, [])}
        beam: list[Ranked] = [(start, [])]
        for _ in range(most):
            fresh: dict[tuple[int, ...], Ranked] = {}
            for _, chosen in beam:
                for group in self._likely(chosen, open_, 2 * _WIDTH, usable):
                    more = [*chosen, group]
                    key = tuple(sorted(id(x) for x in more))
                    if key not in found and key not in fresh:
                        fresh[key] = (self.solve(more, open_)[0] - price * len(more), more)
            if not fresh:
                break
            # rank by evidence with a price per effect; keep the best sets
            ranked = sorted(fresh.items(), key=lambda item: -item[1][0])
            beam = [one for _, one in ranked[:_WIDTH]]
            found |= dict(ranked[: 3 * _WIDTH])
        return sorted(found.values(), key=lambda one: -one[0])

    def _likely(
        self, chosen: Sequence[Group], open_: bool, most: int, usable: Callable[[Effect], bool]
    ) -> list[Group]:
        """Return the best group of each effect that adds most to a set."""
        scores, found = self.next_scores(chosen, open_), dict[Effect, Group]()
        # in order of the score, one group per effect
        for i in np.argsort(scores)[::-1]:
            group = self.groups[i]
            if not np.isfinite(scores[i]) or len(found) >= most:
                break
            fits = compatible([g.effect for g in chosen], group.effect)
            if group.effect not in found and usable(group.effect) and fits:
                found[group.effect] = group
        return list(found.values())

    def left(self, groups: Sequence[Group], open_: bool) -> Array:
        """Return the white residual of the linear solution of a set."""
        u, columns = self.solve(groups, open_)[1], self._columns(groups, open_)[1]
        return np.asarray(self.X[:, 0] + self.X[:, columns] @ u)

    def start(self, groups: Sequence[Group], open_: bool, target: FittedModel) -> Start:
        """Return the linear solution of a set as a start at a base.

        The target is the model of the screen, or the base with its re-estimated parameters.
        """
        # coefficients back in the units of the columns
        u, (m, columns) = self.solve(groups, open_)[1], self._columns(groups, open_)
        values, at = [], m
        for g in groups:
            k = g.at.stop - g.at.start
            own = u[at : at + k] / self.scale[g.at]
            at += k
            values.append({**g.values, **{n: float(v) for n, v in zip(g.names, own, strict=False)}})
        # parameters at their linear estimate, others as in the fit
        problem, mine = target.problem, self.fitted.theta
        theta, finite = problem.prior_mean.copy(), np.isfinite(problem.prior_sd)
        theta[: len(mine)] = mine
        if target is self.fitted and m:
            theta[finite] = problem.prior_mean[finite] + u[:m] * problem.prior_sd[finite]
        elif target is not self.fitted and open_ and finite.sum() == m:
            sd = np.concatenate([self.held_sd, self.number_sd])
            theta[finite] = problem.prior_mean[finite] + u[:m] * sd
        # offsets and initial states that go with the linear solution
        states = self.fitted.problem.unpack(self.fitted.point)[1].copy()
        rest = self.raw[:, 0] + (self.raw[:, columns] / self.scale[columns]) @ u
        if len(self.jacobian) <= _MOST_RECORDS and self.fitted.problem.free_start:
            self._settle(rest, theta, states)
        return Start(values, theta, states)

    def _settle(self, rest: Array, theta: Array, states: Array) -> None:
        """Correct offsets and initial states in place by least squares of `rest`."""
        p, width, n = self.fitted.problem.n_theta, int(self.flat.sum()), states.shape[1]
        # block Jacobian: common offsets, and initial states of each record
        J = np.zeros((len(rest), width + n * len(self.jacobian)))
        first = 0
        for k, j in enumerate(self.jacobian):
            rows = slice(first, first + len(j))
            J[rows, :width] = j[:, :p][:, self.flat]
            J[rows, width + k * n : width + (k + 1) * n] = j[:, p:]
            first += len(j)
        size = np.linalg.norm(J, axis=0)
        size[size == 0] = 1.0
        step = -np.linalg.lstsq(J / size, rest, rcond=1e-8)[0] / size
        theta[np.flatnonzero(self.flat)] += step[:width]
        states += step[width:].reshape(states.shape)


#: Known coefficients, names of the columns, and positions of the columns.
_Columns = list[tuple[dict[str, float], list[str], Any]]


def _groups_of(candidate: Candidate, ratio: float) -> list[tuple[Group, list[Array]]]:
    """Return the groups of a candidate with their blocks (n_y, N, k)."""
    if ratio not in candidate.columns:
        return []
    law, blocks, p = candidate.effect.spec, candidate.columns[ratio], candidate.fitted.problem.n_theta
    k, own = blocks[0].shape[2], [q.name for q in candidate.problem.structure.parameters[p:]]
    starts = [dict(zip(own, map(float, start[p : p + len(own)]), strict=True)) for start in candidate.starts]
    sizes = [name for name in own if name not in law.shaping]
    found: _Columns
    if law.secant:  # one column for each start as a whole
        found = [(start, [], slice(i, i + 1)) for i, start in enumerate(starts[:k])]
    elif k == len(own) * len(starts) and (law.at_channel or not law.shaping or sizes == own):
        found = _by_coefficient(own, sizes or own, starts)
    else:
        found = _by_shape(candidate, k, sizes)
    return [
        (Group(candidate.effect, values, names, slice(0, 0)), [b[:, :, pick] for b in blocks])
        for values, names, pick in found
    ]


def _by_coefficient(own: Sequence[str], kept: list[str], starts: Sequence[dict[str, float]]) -> _Columns:
    """Return a group for each start: a column for each size, the shape known."""
    found = []
    for i, start in enumerate(starts):
        shape = {name: value for name, value in start.items() if name not in kept}
        found.append((shape, kept, [i * len(own) + own.index(name) for name in kept]))
    return found


def _by_shape(candidate: Candidate, k: int, sizes: list[str]) -> _Columns:
    """Return a group for each shape, with equal parts of the k columns."""
    shapes = _shapes(candidate)
    each = max(k // max(len(shapes), 1), 1)
    names = sizes if len(sizes) == each else []
    parts = [list(range(i, i + each)) for i in range(0, k - each + 1, each)]
    return [(shape, names, part) for shape, part in zip(shapes, parts, strict=False)]


def _argument(effect: Effect) -> str:
    """Return the argument of a static force law, or an empty string.

    Several force laws of one argument at one place add up to one curve.
    """
    law = effect.spec
    if law.at_channel:
        return "signal" if not (law.delays or law.linear) else ""
    if law.inner_states or not law.needs:
        return ""
    if law.needs == {"velocity"}:
        return "jump" if law.jumps else "velocity"
    return "position" if law.needs == {"position"} else ""


def compatible(chosen: Sequence[Effect], more: Effect) -> bool:
    """Return whether an effect may be added to a set.

    A set holds one curve per argument and place, and one delay. It holds no effect together with a special
    case of it.

    Parameters
    ----------
    chosen : sequence of Effect
        Effects of a set.
    more : Effect
        Further effect.
    """

    def late(effect: Effect) -> bool:
        law = effect.spec
        return bool(law.delays or (law.at_channel and any(c.unit_rule == "s" for c in law.coefficients)))

    # one curve per argument and place, one delay, no law with its special case
    for other in chosen:
        if other.place == more.place:
            contained = other.kind in more.spec.contains or more.kind in other.spec.contains
            if other.kind == more.kind or contained:
                return False
            if _argument(more) and _argument(more) == _argument(other):
                return False
        if late(more) and late(other):
            return False
    return True
