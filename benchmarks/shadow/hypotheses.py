"""Hypotheses with their one score: the log marginal likelihood (Laplace) under their own noise."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import numpy as np
from noise import Noise, noise_of, step_of

from rcorefine.effects.bodies import Mass
from rcorefine.effects.effect import Effect
from rcorefine.inference.assembly import nominal_size
from rcorefine.inference.basis import Basis, project
from rcorefine.inference.fitted import FittedModel
from rcorefine.models.library import effect_library

SPREADS = {0.05: 0.6, 0.2: 0.3, 1.0: 0.1}
FITTED_SPREAD = 0.2


def parameters_of(case):
    """Every parameter of the model with its nominal size."""
    physical, structure = case.base.physical_model, case.fitted.structure
    declared = [Effect(q.kind, q.place) for q in physical.parameters]
    masses = [e for e in effect_library(physical) if e.kind == Mass.name]
    held = {(e.kind, e.place) for e in case.base.effects}
    every = {(e.kind, e.place): e for e in [*masses, *declared] if (e.kind, e.place) not in held}
    sized = [(e, nominal_size(structure, e)) for e in every.values()]
    return [(e, s) for e, s in sized if 0.0 < s < np.inf]


def measured(problem):
    """Outputs in units of the weights."""
    return [problem.weights[:, None] * r.outputs for r in problem.records]


def steps_of(problem):
    """Rounding step of each output in units of the weights."""
    rows = np.concatenate([r.outputs for r in problem.records], axis=1)
    return [step_of(row) * w for row, w in zip(rows, problem.weights, strict=True)]


@dataclass(eq=False)
class Trial:
    """A fitted hypothesis: effects beside nuisances, its noise, its score."""

    effects: tuple
    base: FittedModel
    problem: Any
    point: Any
    blocks: list  # residual and Jacobian per record, in units of the weights, no sample weights
    ratio: float = 0.0
    noise: Noise | None = None
    log_evidence: float = -np.inf
    by_spread: dict = field(default_factory=dict)
    sd: Any = None  # standard deviations of all coefficients
    n_numbers: int = 0

    @property
    def total(self):
        if not self.by_spread:
            return self.log_evidence
        return float(np.logaddexp.reduce([v + np.log(SPREADS[s]) for s, v in self.by_spread.items()]))

    @cached_property
    def fit(self):
        from rcorefine.inference.fitted import evaluated

        blocks = self.blocks if self.ratio == 0 else evaluated(self.problem, self.point)
        r = np.concatenate([b / self.problem.weights[:, None] for b, _ in blocks], axis=1)
        y = np.concatenate([rec.outputs for rec in self.problem.records], axis=1)
        return 100 * (
            1 - np.linalg.norm(r, axis=1) / np.linalg.norm(y - y.mean(axis=1, keepdims=True), axis=1)
        )

    @property
    def own(self):
        """Coefficients of the effects, and their standard deviations, in order."""
        p0 = self.base.problem.n_theta
        return self.problem.unpack(self.point)[0][p0:], self.sd[p0:]

    def surest(self):
        """Size over standard deviation of the surest coefficient of each effect."""
        structure, found = self.problem.structure, []
        first = len(structure.effects) - len(self.effects)
        theta = self.problem.unpack(self.point)[0]
        for i in range(len(self.effects)):
            at = [k for k, q in enumerate(structure.parameters) if q.effect == first + i]
            spec = structure.effects[first + i].spec
            sizes = [k for k in at if structure.parameters[k].name not in spec.shaping] or at
            found.append(max((abs(theta[k]) / self.sd[k] if self.sd[k] > 0 else np.inf) for k in sizes))
        return found


def score(trial: Trial, base_residual, steps, n_base, numbers=slice(0, 0)):
    """Fill in noise, log evidence (and by spread of the parameters), and standard deviations."""
    problem, point, blocks = trial.problem, trial.point, trial.blocks
    theta, _ = problem.unpack(point)
    p, p0 = problem.n_theta, n_base
    judged = problem.judged(theta)
    noise = noise_of([r for r, _ in blocks], measured(problem), steps)
    trial.noise = noise
    W = [w * np.sign(j) for w, j in zip(noise.weights, judged, strict=True)]
    apply = noise.whitener.apply
    left = apply([w * r for w, (r, _) in zip(W, blocks, strict=True)])
    before = apply([w * r for w, r in zip(W, base_residual, strict=True)])
    white = [apply([w[:, :, None] * j]) for w, (_, j) in zip(W, blocks, strict=True)]
    scale = np.sqrt(float(left @ left) / len(left)) or 1.0  # weighted residuals of rounding have another size
    left, before, white = left / scale, before / scale, [j / scale for j in white]
    at = list(range(p0, p))
    size2 = max(float(before @ before) - float(left @ left), float(len(at) or 1))
    common = np.concatenate([j[:, :p] for j in white])
    norms = np.linalg.norm(common, axis=0)
    structure = problem.structure
    shaping = np.array(
        [q.name in structure.effects[q.effect].spec.shaping for q in structure.parameters], bool
    )
    fixed_sd = problem.prior_sd.copy()
    for i in at:
        # each may change the output as much as the effect as a whole; to first order, or as far as it went
        fixed_sd[i] = max(np.sqrt(size2) / norms[i], abs(theta[i])) if norms[i] > 0 else 0.0
    flat = ~np.isfinite(fixed_sd)
    added = problem.n_states - trial.base.problem.n_states
    n_own = problem.n_states - added
    basis = Basis.of([j[:, :p][:, flat] for j in white], [j[:, p : p + n_own] for j in white])
    extra, first = [], 0
    for j in white:
        for k in range(added):
            column = np.zeros(len(common))
            column[first : first + len(j)] = j[:, p + n_own + k]
            norm = np.linalg.norm(column)
            if norm > 1e-9:
                extra.append(column * (np.sqrt(size2) / norm))
        first += len(j)
    E = project(np.column_stack(extra), basis) if extra else np.zeros((len(common), 0))
    C = project(common, basis)
    r = project(left, basis)
    mean = np.where(np.isfinite(problem.prior_mean), problem.prior_mean, 0.0)
    informed = np.flatnonzero(~flat & (fixed_sd > 0))

    def value(sd):
        """(log evidence at the point, what the minimum under this prior would gain), to first order."""
        X = np.hstack([C[:, informed] * sd[informed], E])
        u = (theta - mean)[informed] / sd[informed]
        counted = ~shaping[informed]
        A = X.T @ X + np.eye(X.shape[1])
        step = -np.linalg.solve(A, X.T @ r + np.concatenate([u, np.zeros(E.shape[1])]))
        moved = r + X @ step
        occam = 0.5 * float(np.linalg.slogdet(A)[1])
        here = -0.5 * float(u[counted] @ u[counted])
        v = (u + step[: len(informed)])[counted]
        there = -0.5 * (float(moved @ moved) - float(r @ r) + float(v @ v))
        return noise.log_likelihood + here - occam, there - here

    trial.log_evidence, lack = value(fixed_sd)
    span = range(*numbers.indices(p))
    if len(span):
        for s in SPREADS:
            sd = fixed_sd.copy()
            sd[numbers] *= s / FITTED_SPREAD
            here, gain = value(sd)
            # what the fit lacks under its own prior is no gain of another one
            trial.by_spread[s] = here + gain - lack
    precision = np.zeros(p)
    precision[numbers] = fixed_sd[numbers] ** -2.0 if len(span) else 0.0
    E0 = np.hstack([C, E])
    H = E0.T @ E0
    H[:p, :p] += np.diag(precision)
    H += np.diag(np.r_[flat.astype(float), np.zeros(E.shape[1])])  # projected out
    d = np.sqrt(np.diag(H))
    d[d == 0] = 1.0
    inverse = np.linalg.pinv(H / np.outer(d, d), rcond=1e-12, hermitian=True)
    sd = np.sqrt(np.maximum(np.diag(inverse), 0.0)) / d
    sd[np.sqrt(np.diag(H))[: len(sd)] == 0] = np.inf
    trial.sd = sd[:p]
    return trial
