"""How fast dry friction turns over: a width that is no coefficient, yet must not be wrong."""

from __future__ import annotations

import numpy as np

from ..inference.descent import Descent, descend
from ..inference.sensitivities import Candidate
from ..inference.whitening import Whitener
from ..systems.linear import Array

__all__ = ["settled_width"]

_RATIOS = (2.0, 1.4, 1.2)  # of one width to the next, until nothing is gained
_MOST = 4  # of each
_MORE = 1.0  # log-likelihood that each further one must earn
_WIDEST = 16.0  # times the guess: friction that turns over more gently is no jump


def settled_width(
    candidate: Candidate, run: Descent, gain: Array | None, whitener: Whitener
) -> tuple[Candidate, Descent]:
    """The friction law with the width of sgn(v) that the record asks for.

    The width is chosen as a small share of the motion. Where the record shows another one,
    a law with more coefficients bends them to imitate it, and the plain law loses. To move
    at all must earn the price of a coefficient.

    Parameters
    ----------
    candidate : Candidate
        Any; only dry friction whose width was not given has one to choose.
    run : Descent
        Its minimum.
    gain : ndarray, shape (n, n_y), optional
        Observer gain of the race.
    whitener : Whitener
        Metric of the race.

    Returns
    -------
    candidate : Candidate
    run : Descent
    """
    effect = candidate.effect
    if not effect.spec.jumps or "width" in effect.fixed:
        return candidate, run

    def polished(other: Candidate, point: Array) -> Descent:
        return descend(other.problem, point, gain=gain, whitener=whitener, evaluations=5, tolerance=1e-6)

    best = candidate, polished(candidate, run.point)
    price = 0.5 * np.log(candidate.problem.n_points)
    for ratio in _RATIOS:
        for factor in (1 / ratio, ratio):
            moved = False
            for _ in range(_MOST):
                trial = best[0].with_width(factor)
                if trial.width > _WIDEST * candidate.width:
                    break
                again = polished(trial, best[1].point)
                if not again.cost < best[1].cost - price:
                    break
                best, price, moved = (trial, again), _MORE, True
            if moved:
                break
        if best[0] is candidate:
            break  # the guess is as good as any
    return best
