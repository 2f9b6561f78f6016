"""Which places stay in the race: at each, one test of a force of any form."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ..effects.effect import Effect
from ..inference.fitted import FittedModel
from .residual_tests import TestedResidual

__all__ = ["in_race"]

_MOST = 8  # places up to which none is left out: their laws cost less than a choice that errs
_BEST = 3  # that each residual keeps


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
        In the order of the library. Effects at inputs, outputs and entries of A are all kept, and those
        with a motion of their own, which no force along the motion stands for.
    """
    ports = {port.name for port in fitted.structure.model.ports}
    places = {effect.place for effect in library if effect.place in ports}
    if len(places) <= _MOST:
        return list(library)
    kept: set[str] = set()
    for ratio in ratios:
        kept.update(_best(TestedResidual(fitted, ratio), places))
    return [
        effect
        for effect in library
        if effect.place not in ports or effect.place in kept or effect.spec.secant
    ]


def _best(battery: TestedResidual, places: set[str]) -> list[str]:
    names, blocks = battery.generic
    tests = []
    for place in dict.fromkeys(names):
        if place in places:
            mine = np.array([name == place for name in names])
            tests.append(battery.test(place, [block[:, :, mine] for block in blocks]))
    return [t.name for t in sorted(tests, key=lambda t: (t.p_value, -t.statistic))[:_BEST]]
