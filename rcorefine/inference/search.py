"""Global search for the minimum of a fit, then optimization.

The search uses observer fits, simulations of growing length and scans over decades.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from itertools import pairwise

import numpy as np

from ..data.measurement import Measurement
from ..engine.amplitude_response import ResponseEngine, is_linear
from ..engine.engine import Engine
from ..engine.initial_state import estimate_initial_state
from ..engine.observer import observer_gain
from ..engine.structure import Structure
from ..gauss_newton import Rows, gauss_newton
from ..systems.linear import Array
from .covariance import parameter_uncertainty, pseudo_inverse
from .problem import Problem, descend
from .starts import far_starts

_FLOOR = 0.1  # least relative error of a point, so that all points count
_POINTS, _FEW_POINTS = 400, 60  # points of each response, for linear and for nonlinear effects
_EVALUATIONS, _FEW_EVALUATIONS = 25, 6


def by_logarithms(problem: Problem, point: Array) -> Array:
    """Least squares of the logarithms of the points, from a point.

    Parameters
    ----------
    problem : Problem
        On frequency responses.
    point : ndarray
        Start.

    Returns
    -------
    ndarray
        Where it ended; the start, where the logarithm is no number.
    """
    if not problem.size:
        return point
    nonlinear = not is_linear(problem.structure)
    # fewer points where each needs a harmonic balance
    most = _FEW_POINTS if nonlinear else _POINTS
    engines = [_thin(engine, most) for engine in problem.engines]
    measured = [engine.data.measured.response for engine in engines]
    weights = []
    # weight: one over the relative noise, with a floor so that all points count
    for engine, g in zip(engines, measured, strict=True):
        noise = np.abs(engine.data.points(np.ones(engine.data.noise.shape))) / np.sqrt(2.0)
        weights.append(1.0 / np.hypot(noise / np.maximum(np.abs(g), 1e-300), _FLOOR))
    low, high = problem.box()
    loudest = np.argsort([float(engine.data.inputs.max()) for engine in engines], kind="stable")
    chosen = engines

    # residual log(model / measured): gain and phase errors as ratios, then the priors
    def rows(box: Array) -> Rows:
        theta = problem.coordinates.point(box)  # a frequency response has no initial state
        residuals, slopes = ([part] for part in problem.prior_rows(theta))
        for engine, g, weight in zip(engines, measured, weights, strict=True):
            if engine not in chosen:
                continue
            with np.errstate(all="ignore"):
                model, by = engine.response(theta)
                residuals.append(_parts(weight * np.log(model / g)))
                slopes.append(
                    np.array([_parts(weight * slope / model) for slope in by]).reshape(len(by), -1).T
                )
        r, J = np.concatenate(residuals), problem.coordinates.columns(np.concatenate(slopes), theta)
        return Rows(r if np.isfinite(r).all() and np.isfinite(J).all() else np.full(1, np.inf), J)

    start, count = (
        problem.coordinates.of(problem.inside(point)),
        _FEW_EVALUATIONS if nonlinear else _EVALUATIONS,
    )
    # nonlinear: the response of the smallest amplitude first, whose peak has moved least
    for k in range(1, len(engines) + 1) if nonlinear else (len(engines),):
        chosen = [engines[i] for i in loudest[:k]]
        start = gauss_newton(
            rows, start, lower=low, upper=high, sizes=problem.sizes_at, evaluations=count, tolerance=1e-4
        ).point
    return problem.coordinates.point(start)


def _thin(engine: ResponseEngine, most: int) -> ResponseEngine:
    count = engine.data.omega.size
    if count <= most:
        return engine
    kept = np.unique(np.linspace(0, count - 1, most).astype(int))
    return ResponseEngine(engine.structure, engine.data.lines(kept))


def _parts(values: np.ndarray) -> Array:
    return np.concatenate([values.real.ravel(), values.imag.ravel()])


_ROUGHLY = 1e-6  # relative decrease of the cost that ends an optimization
_RATIOS = (1.0, 0.1, 0.01)  # observer gains of the first pass, high to low
_START_SAMPLES = 4000  # samples for the first pass
_POLISHED = 3  # starting points that are optimized
_FAIR, _POOR = 1e-3, 0.02  # cost over that of no model, above which other starting points are tried
_FIRST_WINDOWS = 32  # free runs into which a difficult record is cut
_SHORTEST_WINDOW = 60  # samples of the shortest window
_STEP_SHARE = 0.5  # change of a coefficient by halved substeps, in standard deviations
_MOST_SUBSTEPS = 256

ProblemOf = Callable[..., Problem]


def search(
    problem: ProblemOf,
    structure: Structure,
    windows: Sequence[Measurement],
    starts: Sequence[Array],
    steps: int,
) -> tuple[Array, int]:
    """Point from which to polish.

    Parameters
    ----------
    problem : callable
        ``problem(segments, substeps, unknown_start=False)`` builds the estimation problem;
        unknown_start: estimate initial states even where the record's first one is known.
    structure : Structure
        Model with the effects.
    windows : sequence of Measurement
        Segments of the record.
    starts : sequence of ndarray, shape (p,)
        Coefficients where to begin.
    steps : int
        Substeps per sample.

    Returns
    -------
    point : ndarray
        Point of ``problem(windows, steps)``.
    steps : int
        Substeps that it takes.
    """
    # short problem: a part of the record, on which all starting values are tried
    short = _shorten(windows)
    trial = problem(short, steps)
    outcomes: list[tuple[float, Array]] = []
    # first pass: observer fits from every starting value
    for candidate in starts:
        outcomes += _first_pass(trial, structure, short, candidate)
    outcomes.sort(key=lambda pair: pair[0])
    level = trial.level
    # optimize the best of them on the free run
    polished = _polish_each(trial, outcomes, steps)
    seen: list[float] = []

    def grow(enough: float) -> None:
        for _, point in outcomes[:_POLISHED]:
            if min(entry[0] for entry in polished) < enough * level:
                break
            found = _grow(problem, short, steps, point[: structure.n_parameters], _POOR * level, seen)
            if found is not None:
                polished.append(found)

    # nonlinear and not yet a good fit: simulations of growing length
    if trial.stepped:
        grow(_FAIR)
    # poor fit: starting values over decades
    if min(entry[0] for entry in polished) > _POOR * level:
        far: list[tuple[float, Array]] = []
        for candidate in far_starts(trial, structure, outcomes[0][1][: structure.n_parameters]):
            far += _first_pass(trial, structure, short, candidate)
        far.sort(key=lambda pair: pair[0])
        if far:
            polished += _polish_each(trial, far, steps)
        outcomes = sorted(outcomes + far, key=lambda pair: pair[0])
        if trial.in_time:
            grow(_POOR)
    # best of all, with initial states on the whole record
    _, best, steps = min(polished, key=lambda entry: entry[0])
    whole = problem(windows, steps)
    theta = best[: structure.n_parameters]
    if whole.size == best.size and [r.n_samples for r in short] == [r.n_samples for r in windows]:
        return best, steps
    return whole.pack(theta, starting_states(whole, theta)), steps


def _polish_each(
    trial: Problem, outcomes: list[tuple[float, Array]], steps: int
) -> list[tuple[float, Array, int]]:
    """Optimize the best starting points on the simulation.

    No further points are tried after a good fit.
    """
    polished: list[tuple[float, Array, int]] = []
    for _, point in outcomes[:_POLISHED]:
        result = descend(trial, point, evaluations=25, tolerance=_ROUGHLY)
        polished.append((result.cost, result.point, steps))
        if result.cost < _FAIR * trial.level:
            break
    return polished


def _grow(
    problem: ProblemOf,
    windows: list[Measurement],
    steps: int,
    theta: Array,
    poor: float,
    seen: list[float],
) -> tuple[float, Array, int] | None:
    """Fit many short simulations together, then lengthen them.

    The phase error then never exceeds a period.

    Each run starts from the initial state of the shorter run before it; a state estimated
    anew over a long run can itself end in a wrong valley. The result is None where not even the
    short runs fit, or where they fit as they did from another start.
    """
    n = min(record.n_samples for record in windows)
    count = 2 ** int(np.log2(np.clip(n / _SHORTEST_WINDOW, 1, _FIRST_WINDOWS)))
    starts: Array | None = None
    while True:
        # cut the windows into pieces, each with an initial state of its own
        pieces = [piece for record in windows for piece in _cut(record, count)]
        part = problem(pieces, steps, True)
        # shortest pieces: initial states from an observer
        if starts is None:
            states = _observed_states(part, windows, theta, count)
            result = descend(part, part.pack(theta, states), evaluations=15, tolerance=_ROUGHLY)
            known = any(abs(result.cost - other) < 1e-3 * other for other in seen)
            seen.append(result.cost)
            if known or result.cost > poor:
                return None
        # longer pieces start from the states of the shorter ones
        else:
            result = descend(part, part.pack(theta, starts), evaluations=15, tolerance=_ROUGHLY)
        # are the substeps still sufficient?
        finer = sufficient_steps(problem, pieces, part, result.point)
        if finer != steps:
            steps = finer
            part = problem(pieces, steps, True)
            result = descend(part, result.point, evaluations=15, tolerance=_ROUGHLY)
        theta, starts = part.unpack(result.point)
        if count == 1:
            break
        # pairs of pieces join: every second initial state remains
        starts, count = starts[::2], count // 2
    # last, the windows as they are
    trial = problem(windows, steps)
    point = result.point if trial.free_start else trial.pack(theta, starts)
    result = descend(trial, point, evaluations=25, tolerance=_ROUGHLY)
    return result.cost, result.point, steps


def _observed_states(part: Problem, windows: list[Measurement], theta: Array, count: int) -> Array:
    """Initial states of the pieces as an observer along the record sees them."""
    found = []
    for record in windows:
        # observer of high gain along the record
        gain = observer_gain(part.structure, theta, record, _RATIOS[0])
        engine = Engine(part.structure, record, substeps=part.substeps)
        run = engine.run(theta, sensitivity=False, gain=gain, histories=True, check=False)
        edges = np.linspace(0, record.n_samples, _FIRST_WINDOWS + 1).astype(int)[:: _FIRST_WINDOWS // count]
        found.append(run.states[:, edges[:-1]].T)
    states = np.concatenate(found)
    return states if np.isfinite(states).all() else starting_states(part, theta)


def _cut(record: Measurement, count: int) -> list[Measurement]:
    """Nested windows: those of half the count are pairs of these."""
    edges = np.linspace(0, record.n_samples, _FIRST_WINDOWS + 1).astype(int)[:: _FIRST_WINDOWS // count]
    return [record._part(slice(int(a), int(b))) for a, b in pairwise(edges)]


def sufficient_steps(
    problem: ProblemOf, segments: Sequence[Measurement], coarse: Problem, point: Array
) -> int:
    """Return the number of substeps that the accuracy requires.

    With these, no coefficient shifts by more than half a standard deviation.

    Parameters
    ----------
    problem : callable
        As in `search`.
    segments : sequence of Measurement
        Segments of `coarse`.
    coarse : Problem
        Problem with the present substeps.
    point : ndarray
        Where to judge.

    Returns
    -------
    int
        The present number where it suffices; otherwise the number that the order of the integration asks for
        (to be judged again), 8 times as many at most.
    """
    steps = coarse.substeps
    if not coarse.stepped or steps >= _MOST_SUBSTEPS:
        return steps
    # relative shift of the result by halving the substep
    shift = step_matters(coarse, problem(segments, 2 * steps, coarse.free_start), point)
    if shift < _STEP_SHARE:
        return steps
    # the error of the integration falls with step^order
    order = 2 * coarse.structure.stages
    factor = 2 ** int(np.ceil(np.log2(shift / _STEP_SHARE) / order)) if np.isfinite(shift) else 2
    return steps * min(max(factor, 2), 8)


def _shorten(windows: Sequence[Measurement]) -> list[Measurement]:
    if not windows[0].in_time:
        return list(windows)
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
    # frequency response: logarithms of the points first
    if not problem.in_time:
        near = problem.inside(by_logarithms(problem, point))
        return [(cost, p) for cost, p in [*outcomes, (problem.cost(near), near)] if np.isfinite(cost)]
    current = point
    # observers from high to low gain; each result is judged by its free run
    for ratio in _RATIOS:
        gain = observer_gain(structure, current[: structure.n_parameters], windows[0], ratio)
        if not np.isfinite(gain).all():
            continue
        current = descend(problem, current, gain=gain, evaluations=12, tolerance=_ROUGHLY).point
        theta = current[: structure.n_parameters]
        free = problem.inside(problem.pack(theta, starting_states(problem, theta)))
        outcomes.append((problem.cost(free), free))
    return [pair for pair in outcomes if np.isfinite(pair[0])]


def starting_states(problem: Problem, theta: Array) -> Array:
    """Return the initial state of each segment for given coefficients.

    The shape is (segments, n).
    """
    if not problem.free_start:
        return np.zeros((len(problem.records), problem.n_states))
    low, high = problem.bounds()
    # coefficients within their bounds
    theta = np.clip(theta, low[: theta.size], high[: theta.size])
    return np.array([estimate_initial_state(engine, theta, problem.weights) for engine in problem.engines])


def step_matters(coarse: Problem, fine: Problem, point: Array) -> float:
    """Return the relative change that halving the substep causes.

    It is the largest change of a coefficient in its standard deviations, or of the outputs relative to the
    residual.
    """
    evaluation = coarse.evaluate(point)
    finer = fine.evaluate(point)
    if not (evaluation.finite and finer.finite):
        return (
            np.inf if evaluation.finite or finer.finite else 0.0
        )  # if both diverge, the substeps are not the reason
    # change of the residual by the finer integration, as a Gauss-Newton step
    n = len(evaluation.residual) - len(evaluation.prior)
    difference = finer.residual[:n] - evaluation.residual[:n]
    normal, slope = evaluation.normal(difference)
    scale = np.sqrt(np.diag(normal))
    scale[scale == 0] = 1.0
    inverse, _, _ = pseudo_inverse(normal / np.outer(scale, scale))
    shift = inverse @ (slope / scale)
    # standard deviations of the coefficients, for comparison
    residuals, slopes, columns = zip(*coarse.own_blocks(point), strict=True)
    unsure = parameter_uncertainty(residuals, slopes, np.zeros(coarse.size), columns=columns)
    spread = np.sqrt(np.maximum(np.diag(unsure.covariance), 1e-300)) * scale
    noise = np.sqrt(np.sum(evaluation.residual[:n] ** 2) / coarse.n_points)
    change = np.sqrt(np.sum(difference**2) / coarse.n_points)
    return float(
        max(np.max(np.abs(shift / spread)[: coarse.n_theta], initial=0.0), change / max(noise, 1e-300))
    )
