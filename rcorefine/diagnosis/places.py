"""Choice of places by one test of a free force at each."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ..effects.effect import Effect
from ..inference.fitted import FittedModel
from .residual_tests import TestedResidual

__all__ = ["in_race", "likely_places"]

_MOST = 8  # up to so many places all are kept: fits cost less than a wrong choice
_BEST = 3  # places kept for each residual; twice as many for effects with a motion of their own


def in_race(fitted: FittedModel, library: Sequence[Effect], ratios: Sequence[float]) -> list[Effect]:
    """Return the candidates at the places where a free force explains most.

    Parameters
    ----------
    fitted : FittedModel
        Model at its minimum.
    library : sequence of Effect
        Candidate effects.
    ratios : sequence of float
        Observer ratios of the tested residuals, 0 for the free run. The free run suits weak effects, the
        estimated motion strong ones.

    Returns
    -------
    list of Effect
        Candidates in the order of the library; all of them for few places or for frequency responses.
        Effects at inputs, outputs and entries of A are always kept. Effects with a motion of their own are
        kept at more places, since a force along the motion only approximates them.
    """
    ports = {port.name for port in fitted.structure.model.ports}
    places = {effect.place for effect in library if effect.place in ports}
    if len(places) <= _MOST or not fitted.problem.in_time:
        return list(library)
    orders = [likely_places(TestedResidual(fitted, ratio), places) for ratio in ratios]
    near, far = ({place for order in orders for place in order[:count]} for count in (_BEST, 2 * _BEST))
    return [
        effect
        for effect in library
        if effect.place not in ports or effect.place in (far if effect.spec.secant else near)
    ]


def likely_places(tested: TestedResidual, places: set[str]) -> list[str]:
    """Return places, first the one where a free force explains most."""
    names, blocks = tested.generic
    tests = []
    for place in dict.fromkeys(names):
        if place in places:
            mine = np.array([name == place for name in names])
            tests.append(tested.test(place, [block[:, :, mine] for block in blocks]))
    return [t.name for t in sorted(tests, key=lambda t: (t.p_value, -t.statistic))]
