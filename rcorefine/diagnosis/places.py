"""Which places stay in the race: at each, one test of a force of any form."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ..effects.effect import Effect
from ..inference.fitted import FittedModel
from .residual_tests import TestedResidual

__all__ = ["in_race", "likely_places"]

_MOST = 8  # places up to which none is left out: their laws cost less than a choice that errs
_BEST = 3  # that each residual keeps; twice as many for what has a motion of its own


def in_race(fitted: FittedModel, library: Sequence[Effect], ratios: Sequence[float]) -> list[Effect]:
    """The candidates at the places where a force of any form explains most.

    Parameters
    ----------
    fitted : FittedModel
        Model at its minimum.
    library : sequence of Effect
        Candidates.
    ratios : sequence of float
        Observer ratios whose residuals are asked, 0 for the free run: the motion without the effect
        is right for weak ones, the estimated motion for strong ones.

    Returns
    -------
    list of Effect
        In the order of the library. Effects at inputs, outputs and entries of A are all kept, and what
        has a motion of its own, which a force along the motion only resembles, at more places.
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


def likely_places(battery: TestedResidual, places: set[str]) -> list[str]:
    """Return places, that first where a force of any form explains most."""
    names, blocks = battery.generic
    tests = []
    for place in dict.fromkeys(names):
        if place in places:
            mine = np.array([name == place for name in names])
            tests.append(battery.test(place, [block[:, :, mine] for block in blocks]))
    return [t.name for t in sorted(tests, key=lambda t: (t.p_value, -t.statistic))]
