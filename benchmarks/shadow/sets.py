"""Shadow of the comparison over sets of effects: hypotheses, one evidence, one table."""

from __future__ import annotations

import time
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np

from rcorefine.diagnosis import floating as _floating
from rcorefine.diagnosis.case import Case
from rcorefine.diagnosis.starts import plain_cost
from rcorefine.engine.observer import existing_gain
from rcorefine.inference.autoregression import autoregression, highest_order
from rcorefine.inference.basis import Basis, project
from rcorefine.inference.descent import descend
from rcorefine.inference.fitted import FittedModel, evaluated, fitted_from
from rcorefine.inference.sensitivities import Candidate, _shapes, candidate_columns, parameter_columns
from rcorefine.inference.whitening import Whitener
from rcorefine.refinement.base_fit import base_fit

ORDERS = (0, 1, 2, 3, 4, 6, 8, 12, 16, 20)
SPREADS = {0.05: 0.6, 0.2: 0.3, 1.0: 0.1}


# ---------------------------------------------------------------- noise
def own_filter(blocks):
    """Filter of a residual, order of each output by Schwarz's criterion, and its log likelihood."""
    joined = np.concatenate(blocks, axis=1)
    n = joined.shape[1]
    filters, scales, total = [], [], 0.0
    for row in joined:
        best = None
        for order in ORDERS:
            if order > highest_order(n):
                break
            a, variance = autoregression(row, order=order)
            if not variance > 0:
                variance = 1e-300
            value = -0.5 * n * np.log(variance) - 0.5 * order * np.log(n)
            if best is None or value > best[0]:
                best = (value, a, variance)
        total += best[0]
        filters.append(best[1])
        scales.append(np.sqrt(best[2]))
    return Whitener(tuple(filters), np.array(scales)), total


# ---------------------------------------------------------------- evidence
def evidence(problem, point, blocks, *, effect_at, sd, base_residual, added_states=0):
    """Log marginal likelihood (Laplace) under the filter of its own residual.

    effect_at: indices of coefficients of effects; sd: prior sd of every coefficient (inf: flat).
    """
    whitener, level = own_filter([r for r, _ in blocks])
    theta, starts = problem.unpack(point)
    p = problem.n_theta
    white = [whitener.apply([j]) for _, j in blocks]
    left = whitener.apply([r for r, _ in blocks])
    before = whitener.apply(base_residual)
    size2 = max(float(before @ before) - float(left @ left), float(len(effect_at) or 1))
    sd = sd.copy()
    common = np.concatenate([j[:, :p] for j in white])
    norms = np.linalg.norm(common, axis=0)
    shaping = np.zeros(p, bool)
    for i in effect_at:
        q = problem.structure.parameters[i]
        shaping[i] = q.name in problem.structure.effects[q.effect].spec.shaping
        sd[i] = np.sqrt(size2) / norms[i] if norms[i] > 0 else 0.0
    flat = ~np.isfinite(sd)
    n_own = problem.n_states - added_states
    flat_basis = Basis.of([j[:, :p][:, flat] for j in white], [j[:, p : p + n_own] for j in white])
    informed = [common[:, ~flat] * sd[~flat]]
    at = 0
    for j in white:  # the start of each own state
        for k in range(added_states):
            column = np.zeros(len(common))
            column[at : at + len(j)] = j[:, p + n_own + k]
            norm = np.linalg.norm(column)
            if norm > 0:
                informed.append((column * np.sqrt(size2) / norm)[:, None])
        at += len(j)
    C = project(np.hstack(informed), flat_basis)
    occam = 0.5 * np.linalg.slogdet(np.eye(C.shape[1]) + C.T @ C)[1]
    counted = ~flat & (sd > 0) & ~shaping
    mean = np.where(np.isfinite(problem.prior_mean), problem.prior_mean, 0.0)
    pull = (theta - mean)[counted] / sd[counted]
    return level - 0.5 * float(pull @ pull) - float(occam), whitener


# ---------------------------------------------------------------- columns
@dataclass
class Group:
    """One shape of one candidate: its white columns at a slice of the Gram matrix."""

    candidate: Candidate
    values: dict  # coefficients that shape it (or all, of a secant)
    names: list  # coefficients of the columns
    at: slice
    secant: bool = False


def groups_of(candidate, ratio):
    """Columns of a candidate by shape: list of (values, names, blocks)."""
    effect, law = candidate.effect, candidate.effect.spec
    blocks = candidate.columns[ratio]
    k = blocks[0].shape[2]
    problem = candidate.problem
    p = candidate.fitted.problem.n_theta
    own = [q.name for q in problem.structure.parameters[p:]]
    found = []
    if law.secant:
        for i, start in enumerate(candidate.starts[:k]):
            values = dict(zip(own, start[p : p + len(own)], strict=True))
            found.append((values, [], [b[:, :, i : i + 1] for b in blocks], True))
        return found
    if k == len(own) * len(candidate.starts):
        each, shapes = len(own), []
        for start in candidate.starts:
            shapes.append({n: v for n, v in zip(own, start[p : p + len(own)], strict=True) if n in law.shaping})
        names = own
        if len(candidate.starts) > 1 or not law.shaping:
            pass
    else:
        names = [n for n in law.coefficient_names if n not in law.shaping]
        each = len(names)
        shapes = _shapes(candidate)
    if law.shaping and k != len(own) * len(candidate.starts):
        shapes = _shapes(candidate)
    count = k // max(each, 1)
    for i in range(count):
        values = shapes[i] if i < len(shapes) else {}
        found.append((values, names, [b[:, :, i * each : (i + 1) * each] for b in blocks], False))
    return found


class Screen:
    """Gram matrix of residual, parameters and candidates at a base, flat directions projected out."""

    def __init__(self, fitted, candidates, numbers, number_sd, whitener, ratio=0.0, motion=None):
        self.fitted, self.ratio = fitted, ratio
        blocks = fitted.blocks(ratio)
        p = fitted.problem.n_theta
        self.whitener = whitener
        white = [whitener.apply([j]) for _, j in blocks]
        sd = fitted.problem.prior_sd
        flat = ~np.isfinite(sd)
        self.own_params = np.flatnonzero(~flat)
        common = [j[:, :p] for j in white]
        self.basis = Basis.of([c[:, flat] for c in common], [j[:, p:] for j in white])
        r = whitener.apply([b for b, _ in blocks])
        parts = [r[:, None]]
        held = np.concatenate([c[:, ~flat] for c in common]) * sd[~flat]
        theta, mean = fitted.theta[~flat], fitted.problem.prior_mean[~flat]
        self.n_held = held.shape[1]
        # residual as if the held parameters stood at their prior mean
        parts[0] = parts[0] - (held @ ((theta - mean) / sd[~flat]))[:, None]
        parts.append(held)
        judged = fitted.problem.judged(fitted.theta)
        self.n_numbers = 0
        self.numbers = numbers
        if numbers:
            columns = parameter_columns(fitted, numbers, motion, ratio)
            parts.append(whitener.apply(self._weighted(columns, judged)) * number_sd)
            self.n_numbers = len(numbers)
        self.groups = []
        at = 1 + self.n_held + self.n_numbers
        self.params = list(range(1, at))
        for candidate in candidates:
            if ratio not in candidate.columns:
                continue
            for values, names, columns, secant in groups_of(candidate, ratio):
                w = whitener.apply(self._weighted(columns, judged))
                size = np.linalg.norm(w, axis=0)
                if not np.isfinite(size).all() or not (size > 0).any():
                    continue
                k = w.shape[1]
                self.groups.append(Group(candidate, values, names, slice(at, at + k), secant))
                parts.append(w)
                at += k
        X = np.hstack(parts)
        self.scale = np.linalg.norm(X, axis=0)
        self.scale[self.scale == 0] = 1.0
        self.scale[: 1 + self.n_held + self.n_numbers] = 1.0
        X = project(X / self.scale, self.basis)
        self.X = X
        self.G = X.T @ X
        self.n = max(len(r) - self.basis.rank, 10)

    def _weighted(self, columns, judged):
        if all(np.all(j == 1.0) for j in judged):
            return columns
        return [j[:, :, None] * c for j, c in zip(judged, columns, strict=True)]

    def solve(self, groups, with_params):
        """(log evidence, coefficients, residual) of a set of groups."""
        held = self.params if with_params else self.params[: self.n_held]
        columns = [*held, *(i for g in groups for i in range(g.at.start, g.at.stop))]
        rr = float(self.G[0, 0])
        if not columns:
            return -0.5 * self.n * np.log(rr / self.n), np.zeros(0), columns
        G = self.G[np.ix_(columns, columns)]
        b = self.G[columns, 0]
        m = len(held)
        s2 = rr / self.n
        for _ in range(4):
            # prior precision over noise precision: params have sd 1 (white units); effects sd sqrt(rr)
            lam = np.concatenate([np.full(m, 1.0), np.full(len(columns) - m, 1.0 / max(rr, 1e-300))])
            A = G / s2 + np.diag(lam)
            u = np.linalg.solve(A, -b / s2)
            rss = rr + 2 * float(b @ u) + float(u @ G @ u)
            rss = max(rss, 1e-12 * rr)
            s2 = rss / self.n
        lam = np.concatenate([np.full(m, 1.0), np.full(len(columns) - m, 1.0 / max(rr, 1e-300))])
        A = G / s2 + np.diag(lam)
        sign, logdet = np.linalg.slogdet(A)
        value = -0.5 * self.n * np.log(s2) - 0.5 * float(u @ (lam * u)) - 0.5 * (logdet - np.sum(np.log(lam)))
        return value, u, columns

    def left(self, groups, with_params):
        """White residual of the linear solution of a set."""
        _, u, columns = self.solve(groups, with_params)
        return self.X[:, 0] + self.X[:, columns] @ u if columns else self.X[:, 0]

    def compatible(self, chosen, group):
        e = group.candidate.effect
        lags = e.spec.delays or "lag" in e.kind or "smoothing" in e.kind
        for g in chosen:
            o = g.candidate.effect
            if o.kind == e.kind and o.place == e.place:
                return False
            if o.place == e.place and (o.kind in e.spec.contains or e.kind in o.spec.contains):
                return False
            if lags and (o.spec.delays or "lag" in o.kind or "smoothing" in o.kind):
                return False
        return True

    def beam(self, most, with_params, penalty, width=6, keep=12, usable=None):
        """Sets of groups by first-order evidence, best first."""
        usable = usable or (lambda g: True)
        start = self.solve([], with_params)[0]
        found = {(): (start, [])}
        beam = [(start, [])]
        for _ in range(most):
            fresh = {}
            for _, chosen in beam:
                scores = self.next_scores(chosen, with_params)
                order = np.argsort(scores)[::-1]
                taken, per_effect = 0, set()
                for i in order:
                    g = self.groups[i]
                    key_e = g.candidate.effect
                    if not np.isfinite(scores[i]) or key_e in per_effect or not usable(g):
                        continue
                    if not self.compatible(chosen, g):
                        continue
                    per_effect.add(key_e)
                    more = [*chosen, g]
                    key = tuple(sorted(id(x) for x in more))
                    if key not in found and key not in fresh:
                        value = self.solve(more, with_params)[0] - penalty * len(more)
                        fresh[key] = (value, more)
                    taken += 1
                    if taken >= 2 * width:
                        break
            if not fresh:
                break
            beam = sorted(fresh.values(), key=lambda t: -t[0])[:width]
            found |= dict(sorted(fresh.items(), key=lambda t: -t[1][0])[: 2 * width])
        return sorted(found.values(), key=lambda t: -t[0])

    def next_scores(self, chosen, with_params):
        """First-order gain of adding each group to a set (fixed noise), for the order only."""
        held = self.params if with_params else self.params[: self.n_held]
        columns = [*held, *(i for g in chosen for i in range(g.at.start, g.at.stop))]
        rr = float(self.G[0, 0])
        s2 = np.exp(-2.0 * self.solve(chosen, with_params)[0] / self.n)
        if columns:
            m = len(held)
            lam = np.concatenate([np.full(m, 1.0), np.full(len(columns) - m, 1.0 / rr)])
            A = self.G[np.ix_(columns, columns)] / s2 + np.diag(lam)
            B = self.G[columns, :] / s2
            S = self.G / s2 - B.T @ np.linalg.solve(A, B)
        else:
            S = self.G / s2
        scores = np.full(len(self.groups), -np.inf)
        total = S[0, 0]
        for i, g in enumerate(self.groups):
            k = g.at
            block = S[k, k]
            ridge = np.eye(block.shape[0]) * (1e-9 * np.trace(self.G[k, k]) / s2 + 1.0 / rr)
            b = S[k, 0]
            gain = float(b @ np.linalg.solve(block + ridge, b))
            rest = max(total - gain, 1e-12 * max(total, 1e-300))
            det = np.linalg.slogdet(np.eye(block.shape[0]) + block * rr)[1]
            scores[i] = -0.5 * self.n * np.log(rest / max(total, 1e-300)) - 0.5 * det
        return scores


# ---------------------------------------------------------------- hypotheses
@dataclass(eq=False)
class Trial:
    """A hypothesis, refitted."""

    effects: tuple
    base: object
    problem: object
    point: np.ndarray
    blocks: list
    whitener: Whitener
    log_evidence: float  # at the prior it was fitted under
    by_spread: dict = field(default_factory=dict)
    gain: object = None
    candidates: tuple = ()

    @property
    def total(self):
        """Log marginal likelihood, the spreads averaged."""
        if not self.by_spread:
            return self.log_evidence
        return float(np.logaddexp.reduce([v + np.log(SPREADS[s]) for s, v in self.by_spread.items()]))

    @cached_property
    def fit(self):
        """Worst fit of the free run (%)."""
        records = self.problem.records
        r = np.concatenate([b / self.problem.weights[:, None] for b, _ in self.blocks], axis=1)
        y = np.concatenate([rec.outputs for rec in records], axis=1)
        return 100 * (1 - np.linalg.norm(r, axis=1) / np.linalg.norm(y - y.mean(axis=1, keepdims=True), axis=1))


class Search:
    """The table of hypotheses of one case."""

    def __init__(self, case: Case):
        self.case = case
        self.fitted = case.fitted
        self.motion = case.motions[0]
        self.log = {}
        self.base_residual = [r for r, _ in self.fitted.blocks()]
        self.trials = []

    def clock(self, name, start):
        self.log[name] = self.log.get(name, 0.0) + time.process_time() - start

    # ---- bases
    @cached_property
    def numbers(self):
        found = _floating._numbers(self.case)
        return found

    @cached_property
    def floated(self):
        """Base with the parameters free, prior spread .2."""
        if not self.numbers:
            return None
        start = time.process_time()
        wide = 0.2 / self.case.levels.off
        loose = [e.replace(prior={n: wide * sd for n, sd in e.prior.items()}) for e in self.numbers]
        problem = self.fitted.problem
        refined = base_fit(self.case.base, self.case.records, free=loose, **self.case.options)
        found = fitted_from(
            refined, problem.records, tolerance=self.case.options["tolerance"], noise=1.0 / problem.weights
        )
        self.clock("floated", start)
        return found

    def empty(self, base):
        """Trial of a base without effects."""
        blocks = base.blocks()
        return self._trial((), base, base.problem, base.point, blocks, 0)

    def _trial(self, effects, base, problem, point, blocks, added, candidates=()):
        p0 = base.problem.n_theta
        at = list(range(p0, problem.n_theta))
        sd = problem.prior_sd.copy()
        value, whitener = evidence(
            problem, point, blocks, effect_at=at, sd=sd, base_residual=self.base_residual, added_states=added
        )
        trial = Trial(effects, base, problem, point, blocks, whitener, value, candidates=candidates)
        if base is not self.fitted and self.floated is base:
            trial.by_spread = self._spreads(trial, at, added)
        return trial

    def _spreads(self, trial, at, added):
        """Evidence under other spreads of the parameters: the minimum moved to first order."""
        problem, point = trial.problem, trial.point
        p0 = self.fitted.problem.n_theta
        pn = self.floated.problem.n_theta
        found = {}
        theta, _ = problem.unpack(point)
        white = [trial.whitener.apply([j]) for _, j in trial.blocks]
        p = problem.n_theta
        basis = Basis.of([j[:, :0] for j in white], [j[:, p:] for j in white])
        r = project(trial.whitener.apply([b for b, _ in trial.blocks]), basis)
        J = project(np.concatenate([j[:, :p] for j in white]), basis)
        for s in SPREADS:
            sd = problem.prior_sd.copy()
            sd[p0:pn] *= s / 0.2
            held = np.isfinite(sd)
            H = J.T @ J
            g = J.T @ r
            lam = np.where(held, 1.0 / sd**2, 0.0)
            g = g + lam * (theta - problem.prior_mean)
            scale = np.sqrt(np.diag(H) + lam)
            scale[scale == 0] = 1
            A = (H + np.diag(lam)) / np.outer(scale, scale)
            step = -np.linalg.lstsq(A, g / scale, rcond=1e-12)[0] / scale
            before = float(r @ r)
            left = r + J @ step
            n = sum(b.shape[1] for b, _ in trial.blocks)
            change = -0.5 * (float(left @ left) - before)
            # penalty and occam at the new prior
            value = trial.log_evidence
            value += change
            old, new = self._prior_part(trial, problem.prior_sd, theta, at, added, J, basis), self._prior_part(
                trial, sd, theta + step, at, added, J, basis
            )
            found[s] = value - old + new
        return found

    def _prior_part(self, trial, sd, theta, at, added, J, basis):
        """Prior cost and Occam factor of the parameters (effects' parts are common)."""
        p0, pn = self.fitted.problem.n_theta, self.floated.problem.n_theta
        own = slice(p0, pn)
        flat = [i for i in range(trial.problem.n_theta) if not (p0 <= i < pn) and i not in at]
        C = project(J[:, own] * sd[own], Basis(np.linalg.qr(J[:, flat])[0])) if flat else J[:, own] * sd[own]
        if at:  # effects are free beside them, each with a unit of its own
            E = J[:, at] / np.maximum(np.linalg.norm(J[:, at], axis=0), 1e-300)
            r = trial.whitener.apply(self.base_residual)
            E = E * np.sqrt(max(float(r @ r), 1.0))
            both = np.hstack([C, E])
            occam = np.linalg.slogdet(np.eye(both.shape[1]) + both.T @ both)[1]
            occam -= np.linalg.slogdet(np.eye(E.shape[1]) + E.T @ E)[1]
        else:
            occam = np.linalg.slogdet(np.eye(C.shape[1]) + C.T @ C)[1]
        pull = (theta[own] - trial.problem.prior_mean[own]) / sd[own]
        return -0.5 * float(pull @ pull) - 0.5 * float(occam)

    # ---- refits
    def refit(self, effects, base, starts, evaluations=(8, 6), known=()):
        """Refit a set: starts are dicts {(effect index, name): value} plus thetas of the base."""
        problem, absent = base.extended(list(effects), self.motion)
        p0 = base.problem.n_theta
        structure = problem.structure
        first = len(structure.effects) - len(effects)
        points = []
        for values, theta in starts:
            point = absent.copy()
            if theta is not None:
                point[:p0] = theta
            for (i, name), value in values.items():
                at = structure.position(first + i, name)
                if at >= 0:
                    point[at] = value
            points.append((point, {structure.position(first + i, n) for (i, n) in values}))
        gain = base.gain(0.0)
        if gain is not None:
            gain = np.pad(gain, ((0, problem.n_states - gain.shape[0]), (0, 0)))
        tried = []
        for point, _ in points:
            for share in (1.0, 0.5, 0.2):
                mixed = absent + share * (point - absent)
                for i, q in enumerate(structure.parameters[p0:], p0):  # shapes stay where they are
                    if q.name in structure.effects[q.effect].spec.shaping or structure.effects[q.effect].spec.secant:
                        mixed[i] = point[i]
                mixed = problem.inside(mixed)
                tried.append((plain_cost(problem, mixed, gain), mixed))
                if share == 1.0 and np.isfinite(tried[-1][0]) and tried[-1][0] < 0.5 * self.base_cost:
                    break
        tried += [(plain_cost(problem, point, gain), point) for point in known]
        cost, best = min(tried, key=lambda t: t[0])
        if not np.isfinite(cost):
            return None
        run = descend(problem, best, gain=gain, evaluations=evaluations[0])
        if not np.isfinite(run.cost):
            return None
        whitener, _ = own_filter([r for r, _ in run.blocks(problem)])
        run2 = descend(
            problem, run.point, gain=gain, whitener=whitener, evaluations=evaluations[1],
            known=run.known(problem, gain), tolerance=1e-5,
        )
        if np.isfinite(run2.cost):
            run = run2
        blocks = run.blocks(problem)
        added = problem.n_states - base.problem.n_states
        return self._trial(tuple(effects), base, problem, run.point, blocks, added)

    @cached_property
    def base_cost(self):
        return 0.5 * sum(float(np.sum(r**2)) for r in self.base_residual)

    def starts_of(self, screen, groups, with_params, target):
        """Linear solution of a set as a start in a base (target): values of the effects, theta of the base."""
        _, u, columns = screen.solve(groups, with_params)
        held = screen.params if with_params else screen.params[: screen.n_held]
        at = len(held)
        values, pos = {}, at
        for i, g in enumerate(groups):
            k = g.at.stop - g.at.start
            own = u[pos : pos + k] / screen.scale[g.at]
            pos += k
            for name, value in g.values.items():
                values[i, name] = value
            if not g.secant:
                for name, value in zip(g.names, own, strict=True):
                    if name not in g.values:
                        values[i, name] = float(value)
        theta = None
        if target is not screen.fitted or screen.n_held:
            theta = target.problem.prior_mean.copy()
            base_theta = screen.fitted.theta
            p0 = self.fitted.problem.n_theta
            theta[:p0] = self.fitted.theta[:p0] if target is not screen.fitted else base_theta[:p0]
            sd = target.problem.prior_sd
            finite = np.isfinite(sd)
            moved = u[:at]
            if finite.sum() == at:
                theta[finite] = target.problem.prior_mean[finite] + moved * (
                    screen.number_sd if screen.fitted is self.fitted else sd[finite]
                )
            # flat ones: least squares of what is left
        return values, theta
