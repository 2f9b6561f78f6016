"""Starting point of a fit to a frequency response, from logarithms.

The points themselves give no gradient towards a resonance that lies further than its width from that of
the model. Their logarithms do, because the flanks count as much as the peak (Sidman, DeAngelis and
Verghese, IEEE Trans. Automat. Control 36 (1991) 1065).
"""

from __future__ import annotations

import numpy as np

from ..engine.response_engine import ResponseEngine, is_linear
from ..gauss_newton import Rows, gauss_newton
from ..systems.linear import Array
from .problem import Problem

__all__ = ["by_logarithms"]

_FLOOR = 0.1  # relative error that no point falls below here: all count, whatever their noise
_POINTS, _FEW_POINTS = 400, 60  # of each response, linear or not
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
    most = _FEW_POINTS if nonlinear else _POINTS
    engines = [_thinned(engine, most) for engine in problem.engines]
    measured = [engine.data.measured.response for engine in engines]
    weights = []
    for engine, g in zip(engines, measured, strict=True):
        noise = np.abs(engine.data.points(np.ones(engine.data.noise.shape))) / np.sqrt(2.0)
        weights.append(1.0 / np.hypot(noise / np.maximum(np.abs(g), 1e-300), _FLOOR))
    low, high = problem.box()
    loudest = np.argsort([float(engine.data.inputs.max()) for engine in engines], kind="stable")
    chosen = engines

    def rows(box: Array) -> Rows:
        theta = problem.coordinates.point(box)  # a response has no start
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
    # nonlinear: the quietest response first, for its peak has moved least
    for k in range(1, len(engines) + 1) if nonlinear else (len(engines),):
        chosen = [engines[i] for i in loudest[:k]]
        start = gauss_newton(
            rows, start, lower=low, upper=high, sizes=problem.sizes_at, evaluations=count, tolerance=1e-4
        ).point
    return problem.coordinates.point(start)


def _thinned(engine: ResponseEngine, most: int) -> ResponseEngine:
    count = engine.data.omega.size
    if count <= most:
        return engine
    kept = np.unique(np.linspace(0, count - 1, most).astype(int))
    return ResponseEngine(engine.structure, engine.data.lines(kept))


def _parts(values: np.ndarray) -> Array:
    return np.concatenate([values.real.ravel(), values.imag.ravel()])
