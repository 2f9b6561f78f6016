"""Remarks of a diagnosis: amplitudes, motion without reversal, bounds."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ..data.records import amplitude
from ..effects.effect import Effect
from ..inference.covariance import wald
from ..inference.descent import descend
from ..inference.fitted import FittedModel, coefficient_covariance
from ..inference.levels import Levels
from ..systems.linear import Array
from ..words import chance, with_error

__all__ = ["amplitude_test", "remarks"]

_OTHER_AMPLITUDE = 1.3  # amplitude over that of another record


def amplitude_test(fitted: FittedModel, added: int, levels: Levels) -> tuple[float, str]:
    """Test whether records of different amplitude have the same coefficients.

    An effect that only approximates the true one has other coefficients at another amplitude.

    Parameters
    ----------
    fitted : FittedModel
        Model with the effects, on several records.
    added : int
        Number of tested effects, the last ones of the model.
    levels : Levels
        Levels of the decision.

    Returns
    -------
    p_value : float
        p-value of the Wald test; 1 if all amplitudes are similar.
    sentence : str
        Result of the comparison in words; empty without one.
    """
    structure = fitted.structure
    sizes = [amplitude(record) for record in fitted.problem.records]
    low, high = int(np.argmin(sizes)), int(np.argmax(sizes))
    if sizes[high] <= _OTHER_AMPLITUDE * max(sizes[low], 1e-300):
        return 1.0, ""
    first = len(structure.effects) - added
    own = np.flatnonzero([q.effect >= first for q in structure.parameters])
    (one, C1), (two, C2) = (_alone(fitted, i) for i in (low, high))
    spread = np.diag((levels.same_value * fitted.theta[own]) ** 2)
    p_value = wald((one - two)[own], (C1 + C2)[np.ix_(own, own)] + spread)
    p, name = own[0], structure.effects[first].label
    values = " and ".join(with_error(e[p], np.sqrt(C[p, p])) for e, C in ((one, C1), (two, C2)))
    sentence = (
        f"Fitted alone at the smallest and the largest amplitude, {name} is {values} "
        f"({'they disagree' if p_value < levels.disagree else 'they agree'}, {chance(p_value, 'p')})."
    )
    return p_value, sentence


def _alone(fitted: FittedModel, record: int) -> tuple[Array, Array]:
    """Return coefficients and covariance, estimated from one record alone."""
    whole = fitted.problem
    theta, starts = whole.unpack(fitted.point)
    problem = whole.like(records=[whole.records[record]])
    whitener = whole.whitener([fitted.residuals()[record]])
    run = descend(
        problem,
        problem.pack(theta, starts[record : record + 1]),
        whitener=whitener,
        evaluations=15,
        tolerance=1e-8,
    )
    C = coefficient_covariance(problem, run.blocks(problem), whitener)
    return problem.unpack(run.point)[0].copy(), C


def remarks(fitted: FittedModel, effects: Sequence[Effect]) -> list[str]:
    """Return warnings about a fit with effects.

    They name friction without reversal of the motion, and coefficients at a bound.
    """
    ports, said = {port.name for port in fitted.structure.model.ports}, []
    for effect in effects:
        if not (effect.spec.turns and effect.place in ports and fitted.problem.in_time):
            continue
        v = np.concatenate([fitted.port(effect.place, 0.0, i)[1] for i in range(len(fitted.problem.records))])
        if v.min() >= 0 or v.max() <= 0:
            said.append(
                f"The motion at {effect.place} never changes direction: friction there cannot be told from a "
                "constant force."
            )
    bound = fitted.refinement.message.partition(" At its bound: ")[2]
    return [*said, *([f"At its bound, and so no estimate: {bound}"] if bound else [])]
