"""Where a fit to a frequency response starts: by the logarithms of the points, which peaks draw from afar.

A resonance that lies beside that of the model by more than its width has no slope towards it in the
points themselves. In their logarithm it has: the flanks are as good as the peak (Sidman, DeAngelis and
Verghese, IEEE Trans. Automat. Control 36 (1991) 1065).
"""

from __future__ import annotations

import numpy as np

from ..engine.response_engine import ResponseEngine
from ..gauss_newton import Rows, gauss_newton
from ..systems.linear import Array
from .problem import Problem

__all__ = ["by_logarithms"]

_FLOOR = 0.1  # relative error that no point falls below here: all count, whatever their noise
_POINTS = 400  # of each response
_EVALUATIONS = 25


def by_logarithms(problem: Problem, point: Array, evaluations: int = _EVALUATIONS) -> Array:
    """Least squares of the logarithms of the points, from a point.

    Parameters
    ----------
    problem : Problem
        On frequency responses.
    point : ndarray
        Start.
    evaluations : int
        Responses at most.

    Returns
    -------
    ndarray
        Where it ended; the start, where the logarithm is no number.
    """
    if not problem.size:
        return point
    engines = [_thinned(engine) for engine in problem.engines if isinstance(engine, ResponseEngine)]
    measured = [engine.data.measured.response for engine in engines]
    weights = []
    for engine, g in zip(engines, measured, strict=True):
        noise = np.abs(engine.data.points(np.ones(engine.data.noise.shape))) / np.sqrt(2.0)
        weights.append(1.0 / np.hypot(noise / np.maximum(np.abs(g), 1e-300), _FLOOR))
    low, high = problem.box()

    def rows(box: Array) -> Rows:
        theta = problem.unpack(problem.from_box(box))[0]
        residuals, slopes = [problem.prior_rows(theta)[0]], [problem.prior_rows(theta)[1]]
        for engine, g, weight in zip(engines, measured, weights, strict=True):
            with np.errstate(all="ignore"):
                model, by = engine.response(theta)
                residuals.append(_parts(weight * np.log(model / g)))
                slopes.append(
                    np.array([_parts(weight * slope / model) for slope in by]).reshape(len(by), -1).T
                )
        r, J = np.concatenate(residuals), problem.columns_in_box(np.concatenate(slopes))
        return Rows(r if np.isfinite(r).all() and np.isfinite(J).all() else np.full(1, np.inf), J)

    start = problem.to_box(problem.inside(point))
    run = gauss_newton(
        rows, start, lower=low, upper=high, sizes=problem.sizes, evaluations=evaluations, tolerance=1e-4
    )
    return problem.from_box(run.point)


def _thinned(engine: ResponseEngine) -> ResponseEngine:
    count = engine.data.omega.size
    if count <= _POINTS:
        return engine
    kept = np.unique(np.linspace(0, count - 1, _POINTS).astype(int))
    return ResponseEngine(engine.structure, engine.data.lines(kept))


def _parts(values: np.ndarray) -> Array:
    return np.concatenate([values.real.ravel(), values.imag.ravel()])
