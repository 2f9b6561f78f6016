"""Find the valley: observer-held fits, growing free runs, scans over decades; then polish."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from ..measurement import Measurement
from ..physics.observer import observer_gain
from ..physics.simulation import estimate_initial_state
from ..physics.structure import Structure
from ..systems.linear import Array
from .problem import Problem, residual_blocks
from .starts import Motion, far_starts, shape_starts
from .uncertainty import parameter_uncertainty

__all__ = ["search", "starting_states", "step_matters"]

_RATIOS = (1.0, 0.1, 0.01)  # observer gains of the first pass, high to low
_START_SAMPLES = 4000  # the first pass needs no more
_POLISHED = 3  # starts that are polished

ProblemOf = Callable[[Sequence[Measurement], int], Problem]


def search(
    problem: ProblemOf, structure: Structure, windows: Sequence[Measurement], motion: Motion, steps: int
) -> Array:
    """Point from which to polish.

    Parameters
    ----------
    problem : callable
        ``problem(segments, substeps)`` builds the estimation problem.
    structure : Structure
        Model with the effects.
    windows : sequence of Measurement
        Segments of the record.
    motion : Motion
        Estimated motion at the ports, for the shapes of the laws.
    steps : int
        Substeps per sample.

    Returns
    -------
    ndarray
        Point of ``problem(windows, steps)``.
    """
    short = _shortened(windows)
    trial = problem(short, steps)
    theta = structure.start()
    candidates = shape_starts(structure, theta, motion)
    outcomes: list[tuple[float, Array]] = []
    for candidate in candidates:
        outcomes += _first_pass(trial, structure, short, candidate)
    outcomes.sort(key=lambda pair: pair[0])
    level = 0.5 * sum(float(np.sum((trial.weights[:, None] * r.outputs) ** 2)) for r in short)
    if outcomes[0][0] > 0.01 * level:
        for candidate in far_starts(trial, structure, outcomes[0][1][: structure.n_parameters]):
            outcomes += _first_pass(trial, structure, short, candidate)
        outcomes.sort(key=lambda pair: pair[0])
    polished = []
    for _, point in outcomes[:_POLISHED]:
        result = trial.minimize(point, max_nfev=25)
        polished.append((float(result.cost), result.x))
        if result.cost < 1e-3 * level:
            break
        grown = _grow(problem, short, steps, point[: structure.n_parameters])
        result = trial.minimize(trial.pack(grown, starting_states(trial, grown)), max_nfev=25)
        polished.append((float(result.cost), result.x))
    best = min(polished, key=lambda pair: pair[0])[1][: structure.n_parameters]
    whole = problem(windows, steps)
    return whole.pack(best, starting_states(whole, best))


def _grow(problem: ProblemOf, windows: list[Measurement], steps: int, theta: Array) -> Array:
    """Fit a short free run first and let it grow, so that the phase never slips by a period."""
    n = windows[0].n_samples
    length = max(n // 16, 60)
    while length < n:
        part = problem([windows[0]._part(slice(0, length))], steps)
        result = part.minimize(part.pack(theta, starting_states(part, theta)), max_nfev=10, tol=1e-6)
        theta = result.x[: theta.size]
        length *= 2
    return theta


def _shortened(windows: Sequence[Measurement]) -> list[Measurement]:
    kept: list[Measurement] = []
    total = 0
    for window in windows:
        if total >= _START_SAMPLES:
            break
        kept.append(window._part(slice(0, _START_SAMPLES)) if total == 0 else window)
        total += window.n_samples
    return kept


def _first_pass(
    problem: Problem, structure: Structure, windows: list[Measurement], theta: Array
) -> list[tuple[float, Array]]:
    """Observer-held fits from high to low gain, each judged by its free run."""
    outcomes = []
    point = problem.inside(problem.pack(theta, starting_states(problem, theta)))
    outcomes.append((problem.cost(point), point))
    current = point
    for ratio in _RATIOS:
        gain = observer_gain(structure, current[: structure.n_parameters], windows[0], ratio)
        if not np.isfinite(gain).all():
            continue
        result = problem.minimize(current, max_nfev=12, tol=1e-6, gain=gain)
        current = result.x
        theta = current[: structure.n_parameters]
        free = problem.inside(problem.pack(theta, starting_states(problem, theta)))
        outcomes.append((problem.cost(free), free))
    return [pair for pair in outcomes if np.isfinite(pair[0])]


def starting_states(problem: Problem, theta: Array) -> Array:
    """Initial state of each segment that suits the coefficients, shape (segments, n)."""
    if not problem.free_start:
        return np.zeros((len(problem.records), problem.n_states))
    low, high = problem.bounds()
    theta = np.clip(theta, low[: theta.size], high[: theta.size])
    return np.array([estimate_initial_state(engine, theta, problem.weights) for engine in problem.engines])


def step_matters(coarse: Problem, fine: Problem, point: Array) -> float:
    """What halving the substep changes.

    A coefficient in its standard deviations, or an output in its residual.
    """
    evaluation = coarse.evaluate(point)
    finer = fine.evaluate(point)
    if not (evaluation.finite and finer.finite):
        return np.inf
    n = coarse.n_points
    jacobian = evaluation.jacobian[:n]
    scale = np.linalg.norm(jacobian, axis=0)
    scale[scale == 0] = 1.0
    shift = np.linalg.lstsq(jacobian / scale, finer.residual[:n] - evaluation.residual[:n], rcond=1e-8)[0]
    blocks = residual_blocks(coarse, point)
    unsure = parameter_uncertainty([r for r, _ in blocks], [j for _, j in blocks], np.zeros(coarse.size))
    spread = np.sqrt(np.maximum(np.diag(unsure.covariance), 1e-300)) * scale
    noise = np.sqrt(np.mean(evaluation.residual[:n] ** 2))
    change = np.sqrt(np.mean((finer.residual[:n] - evaluation.residual[:n]) ** 2))
    return float(
        max(np.max(np.abs(shift / spread)[: coarse.n_theta], initial=0.0), change / max(noise, 1e-300))
    )
