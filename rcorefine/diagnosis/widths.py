"""How fast dry friction turns over: a width that is no coefficient, yet must not be wrong."""

from __future__ import annotations

import numpy as np

from ..physics.laws import JUMPING
from ..systems.linear import Array
from .columns import Candidate
from .descent import Descent, descend
from .whitening import Whitener

__all__ = ["settled_width"]

_MOST = 4  # halvings or doublings
_MORE = 1.0  # log-likelihood that each further one must earn


def settled_width(
    candidate: Candidate, run: Descent, gain: Array | None, whitener: Whitener
) -> tuple[Candidate, Descent]:
    """The friction law with the width of sgn(v), among halves and doubles, that the record asks for.

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
    if effect.kind not in JUMPING or "width" in effect.fixed:
        return candidate, run

    def polished(other: Candidate, point: Array) -> Descent:
        return descend(other.problem, point, gain=gain, whitener=whitener, evaluations=5, tolerance=1e-6)

    best = candidate, polished(candidate, run.point)
    for factor in (0.5, 2.0):
        price = 0.5 * np.log(candidate.problem.n_points)
        for _ in range(_MOST):
            trial = best[0].with_width(factor)
            again = polished(trial, best[1].point)
            if not again.cost < best[1].cost - price:
                break
            best, price = (trial, again), _MORE
        if best[0] is not candidate:
            break
    return best
