"""First-order comparison: one Gram matrix of residual, parameters and candidates."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from rcorefine.inference.basis import Basis, project
from rcorefine.inference.sensitivities import Candidate, _shapes, parameter_columns


@dataclass(eq=False)
class Group:
    """One shape of one candidate."""

    candidate: Candidate
    values: dict  # coefficients that are known
    names: list  # coefficients of the columns
    at: slice
    secant: bool

    given: object = None

    @property
    def effect(self):
        return self.candidate.effect if self.given is None else self.given

    @classmethod
    def of(cls, effect):
        """An effect where a group is expected."""
        return cls(None, {}, [], slice(0, 0), False, effect)


def groups_of(candidate, ratio):
    """Columns of a candidate by shape: (values, names, blocks, secant)."""
    law, blocks = candidate.effect.spec, candidate.columns[ratio]
    k = blocks[0].shape[2]
    problem, p = candidate.problem, candidate.fitted.problem.n_theta
    own = [q.name for q in problem.structure.parameters[p:]]
    starts = [dict(zip(own, start[p : p + len(own)], strict=True)) for start in candidate.starts]
    if law.secant:
        return [
            (starts[i], [], [b[:, :, i : i + 1] for b in blocks], True) for i in range(min(k, len(starts)))
        ]
    names = [n for n in own if n not in law.shaping]
    if k == len(own) * len(starts) and (law.at_channel or not law.shaping or len(own) == len(names)):
        each, names = len(own), own
        shapes = [{n: v for n, v in s.items() if n in law.shaping} for s in starts]
        linear = [i for i, n in enumerate(own) if n not in law.shaping]
        found = []
        for i, shape in enumerate(shapes):
            pick = [i * each + j for j in (linear or range(each))]
            found.append(
                (
                    shape if linear else {},
                    [own[j] for j in (linear or range(each))],
                    [b[:, :, pick] for b in blocks],
                    False,
                )
            )
        return found
    shapes = _shapes(candidate)
    each = max(k // max(len(shapes), 1), 1)
    names = names if len(names) == each else []
    return [
        (shapes[i], names, [b[:, :, i * each : (i + 1) * each] for b in blocks], False)
        for i in range(min(len(shapes), k // each))
    ]


class Screen:
    """Gram matrix at a fitted model; flat directions are projected out."""

    def __init__(self, fitted, candidates, numbers, number_sd, whitener, ratio, motion, weights=None):
        self.fitted, self.ratio, self.number_sd = fitted, ratio, np.asarray(number_sd)
        blocks = fitted.blocks(ratio)
        p = fitted.problem.n_theta
        judged = fitted.problem.judged(fitted.theta)
        if weights is not None:
            judged = [j * w for j, w in zip(judged, weights, strict=True)]
        plain = all(np.all(j == 1.0) for j in judged)
        own = weights if weights is not None else [np.ones_like(j) for j in judged]

        def white(parts, all_weights=True):
            w = judged if all_weights else own
            if not plain:
                parts = [(a[:, :, None] if b.ndim == 3 else a) * b for a, b in zip(w, parts, strict=True)]
            return whitener.apply(parts)

        self.whitener = whitener
        jac = [white_one for white_one in self._each([j for _, j in blocks], own, whitener, plain)]
        sd = fitted.problem.prior_sd
        flat = ~np.isfinite(sd)
        self.flat = flat
        self.jac = jac
        self.basis = Basis.of([j[:, :p][:, flat] for j in jac], [j[:, p:] for j in jac])
        r = white([b for b, _ in blocks], False)
        self.held_sd = sd[~flat]
        held = np.concatenate([j[:, :p][:, ~flat] for j in jac]) * sd[~flat]
        theta, mean = fitted.theta[~flat], fitted.problem.prior_mean[~flat]
        self.held_at = (theta - mean) / sd[~flat]
        self.r = r
        parts = [(r - held @ self.held_at)[:, None], held]
        self.n_held, self.n_numbers = held.shape[1], len(numbers)
        if numbers:
            parts.append(white(parameter_columns(fitted, numbers, motion, ratio)) * self.number_sd)
        at = 1 + self.n_held + self.n_numbers
        self.params = list(range(1, at))
        self.groups: list[Group] = []
        for candidate in candidates:
            if ratio not in candidate.columns:
                continue
            for values, names, columns, secant in groups_of(candidate, ratio):
                w = white(columns)
                size = np.linalg.norm(w, axis=0)
                if not np.isfinite(size).all() or not (size > 0).all():
                    continue
                left = project(w / size, self.basis)
                if np.linalg.norm(left, axis=0).max() < 1e-4:
                    continue
                self.groups.append(Group(candidate, values, names, slice(at, at + w.shape[1]), secant))
                parts.append(w)
                at += w.shape[1]
        X = np.hstack(parts)
        self.raw = X
        self.scale = np.linalg.norm(X, axis=0)
        self.scale[self.scale == 0] = 1.0
        self.scale[: 1 + self.n_held + self.n_numbers] = 1.0
        self.X = project(X / self.scale, self.basis)
        self.G = self.X.T @ self.X
        self.n = max(len(r) - self.basis.rank, 10)

    @staticmethod
    def _each(blocks, own, whitener, plain):
        for w, j in zip(own, blocks, strict=True):
            yield whitener.apply([j if plain else w[:, :, None] * j])

    def _columns(self, groups, with_params):
        held = self.params if with_params else self.params[: self.n_held]
        return held, [*held, *(i for g in groups for i in range(g.at.start, g.at.stop))]

    def solve(self, groups, with_params):
        """(log evidence, coefficients, columns) of a set of groups, to first order, noise profiled."""
        held, columns = self._columns(groups, with_params)
        rr = float(self.G[0, 0])
        if not columns:
            return -0.5 * self.n * np.log(rr / self.n), np.zeros(0), columns
        G, b = self.G[np.ix_(columns, columns)], self.G[columns, 0]
        lam = np.r_[np.ones(len(held)), np.full(len(columns) - len(held), 1.0 / max(rr, 1e-300))]
        s2 = rr / self.n
        for _ in range(3):
            A = G / s2 + np.diag(lam)
            u = np.linalg.solve(A, -b / s2)
            rss = max(rr + 2 * float(b @ u) + float(u @ G @ u), 1e-12 * rr)
            s2 = rss / self.n
        A = G / s2 + np.diag(lam)
        logdet = np.linalg.slogdet(A)[1] - float(np.sum(np.log(lam)))
        return -0.5 * self.n * np.log(s2) - 0.5 * float(u @ (lam * u)) - 0.5 * logdet, u, columns

    def next_scores(self, chosen, with_params):
        """Gain of adding each group to a set, for the order only."""
        held, columns = self._columns(chosen, with_params)
        rr = float(self.G[0, 0])
        value = self.solve(chosen, with_params)[0]
        s2 = max(np.exp(-2.0 * value / self.n), 1e-12 * rr / self.n)
        S = self.G / s2
        if columns:
            lam = np.r_[np.ones(len(held)), np.full(len(columns) - len(held), 1.0 / rr)]
            A = self.G[np.ix_(columns, columns)] / s2 + np.diag(lam)
            B = self.G[columns, :] / s2
            S = S - B.T @ np.linalg.solve(A, B)
        total = max(S[0, 0], 1e-300)
        scores = np.full(len(self.groups), -np.inf)
        diagonal = np.diag(S)
        for i, g in enumerate(self.groups):
            if g.at.stop - g.at.start == 1:
                k = g.at.start
                gain = S[k, 0] ** 2 / (diagonal[k] + 1e-9 / s2 + 1.0 / rr)
                det = np.log1p(max(diagonal[k], 0.0) * rr)
            else:
                block = S[g.at, g.at]
                gain = float(
                    S[g.at, 0]
                    @ np.linalg.solve(block + (1e-9 / s2 + 1.0 / rr) * np.eye(len(block)), S[g.at, 0])
                )
                det = np.linalg.slogdet(np.eye(len(block)) + block * rr)[1]
            rest = max(total - gain, 1e-9 * total)
            scores[i] = -0.5 * self.n * np.log(rest / total) - 0.5 * det
        return scores

    def beam(self, most, with_params, price, *, width=6, usable=None):
        """Sets of groups by first-order evidence, best first: (value, groups)."""
        start = self.solve([], with_params)[0]
        found = {(): (start, [])}
        beam = [(start, [])]
        for _ in range(most):
            fresh = {}
            for _, chosen in beam:
                scores = self.next_scores(chosen, with_params)
                per_effect, taken = set(), 0
                for i in np.argsort(scores)[::-1]:
                    g = self.groups[i]
                    if not np.isfinite(scores[i]) or taken >= 2 * width:
                        break
                    if g.effect in per_effect or (usable and not usable(g)) or not compatible(chosen, g):
                        continue
                    per_effect.add(g.effect)
                    taken += 1
                    more = [*chosen, g]
                    key = tuple(sorted(id(x) for x in more))
                    if key not in found and key not in fresh:
                        fresh[key] = (self.solve(more, with_params)[0] - price * len(more), more)
            if not fresh:
                break
            beam = sorted(fresh.values(), key=lambda t: -t[0])[:width]
            found |= dict(sorted(fresh.items(), key=lambda t: -t[1][0])[: 3 * width])
        return sorted(found.values(), key=lambda t: -t[0])

    def left(self, groups, with_params):
        """White residual of the linear solution of a set."""
        _, u, columns = self.solve(groups, with_params)
        return self.X[:, 0] + self.X[:, columns] @ u if columns else self.X[:, 0]

    def start(self, groups, with_params, target):
        """The linear solution as a point: values of the effects, and point of the target base."""
        _, u, columns = self.solve(groups, with_params)
        held, _ = self._columns(groups, with_params)
        m, values, pos = len(held), [], len(held)
        for g in groups:
            k = g.at.stop - g.at.start
            own = u[pos : pos + k] / self.scale[g.at]
            pos += k
            values.append({**g.values, **{n: float(v) for n, v in zip(g.names, own, strict=False)}})
        problem = target.problem
        theta = problem.prior_mean.copy()
        finite = np.isfinite(problem.prior_sd)
        mine = self.fitted.theta
        if target is self.fitted:
            theta = mine.copy()
            if m:
                theta[finite] = problem.prior_mean[finite] + u[:m] * problem.prior_sd[finite]
        else:  # parameters that this screen's model holds
            theta[: len(mine)] = mine
            if with_params and finite.sum() == m:
                theta[finite] = problem.prior_mean[finite] + u[:m] * np.concatenate(
                    [self.held_sd, self.number_sd]
                )
        # initial states and offsets: least squares of what is left
        p_old = self.fitted.problem.n_theta
        left = (
            self.raw[:, 0] + (self.raw[:, columns] / self.scale[columns]) @ u if columns else self.raw[:, 0]
        )
        starts = self.fitted.problem.unpack(self.fitted.point)[1].copy()
        first = 0
        if len(self.jac) <= 8 and self.fitted.problem.free_start:
            width = int(self.flat.sum())
            n = starts.shape[1]
            J = np.zeros((len(left), width + n * len(self.jac)))
            for k, j in enumerate(self.jac):
                rows = slice(first, first + len(j))
                J[rows, :width] = j[:, :p_old][:, self.flat]
                J[rows, width + k * n : width + (k + 1) * n] = j[:, p_old:]
                first += len(j)
            size = np.linalg.norm(J, axis=0)
            size[size == 0] = 1.0
            step = -np.linalg.lstsq(J / size, left, rcond=1e-8)[0] / size
            where = np.flatnonzero(self.flat)
            theta[where] += step[:width]
            starts += step[width:].reshape(starts.shape)
        return values, theta, starts


def argument(effect):
    """What a law is a static curve of: laws of one argument at one place are together one curve."""
    spec = effect.spec
    if spec.at_channel:
        return "signal" if not (spec.delays or spec.linear) else ""
    if spec.inner_states or not spec.needs:
        return ""
    if spec.needs == {"velocity"}:
        return "jump" if spec.jumps else "velocity"
    return "position" if spec.needs == {"position"} else ""


def compatible(chosen, group):
    """Whether a group may stand beside others: one curve of an argument at a place, one lag a set."""
    e = group.effect
    lag = e.spec.delays or "lag" in e.kind or "smoothing" in e.kind
    for g in chosen:
        o = g.effect
        if o.place == e.place:
            if o.kind == e.kind or o.kind in e.spec.contains or e.kind in o.spec.contains:
                return False
            if argument(e) and argument(e) == argument(o):
                return False
        if lag and (o.spec.delays or "lag" in o.kind or "smoothing" in o.kind):
            return False
    return True
