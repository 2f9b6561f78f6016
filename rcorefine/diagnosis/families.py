"""Nested laws: the simplest one that does is named, and what merely contains it is no rival."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ..effects.effect import Effect
from ..inference.descent import descend
from ..inference.fitted import FittedModel
from ..inference.levels import Levels
from ..inference.problem import Problem
from ..inference.sensitivities import Candidate
from ..inference.whitening import Whitener
from ..systems.linear import Array
from .candidate_fit import LACK, CandidateFit, price
from .starts import force_along, gain_for, imitated

__all__ = ["contains", "hosts", "in_families", "said_of_families", "start_from", "stuck_fits"]

_MOVING = 0.98  # of the samples: friction turns over in the others


def contains(general: Effect, special: Effect) -> bool:
    """Whether one effect is a special case of another one."""
    return general.place == special.place and special.kind in general.spec.contains


def in_families(candidates: Sequence[Candidate]) -> tuple[list[Candidate], list[Candidate]]:
    """Candidates that contain none of the others, and those that do.

    Parameters
    ----------
    candidates : sequence of Candidate

    Returns
    -------
    simple, general : list of Candidate
    """
    general = [c for c in candidates if any(contains(c.effect, other.effect) for other in candidates)]
    return [c for c in candidates if c not in general], general


def hosts(rivals: Sequence[CandidateFit], alike: Sequence[int], levels: Levels) -> dict[int, int]:
    """Rivals among those alike that merely contain another one of them, and that one.

    Parameters
    ----------
    rivals : sequence of CandidateFit
        The most likely first.
    alike : sequence of int
        Those that the record does not tell from the first.
    levels : Levels
        Of the difference of forces.

    Returns
    -------
    dict
        ``{index of the containing law: index of the most likely one that it contains}``. What
        is likelier than each law that it contains, the price of its coefficients paid, is a
        rival, and so is what ends at another force.
    """
    found = {}
    for i in alike:
        inside = [j for j in alike if j < i and contains(rivals[i].effect, rivals[j].effect)]
        if inside and _same_force(rivals[inside[0]], rivals[i], levels.same_force):
            found[i] = inside[0]
    return found


def _same_force(special: CandidateFit, general: CandidateFit, level: float) -> bool:
    """Whether two rivals are one force, but for a constant, which an offset may hold for either.

    The few moments of turning are left out: a law of two levels holds its constant nowhere else.
    """
    if special.effect.spec.at_channel:  # no force at all: what its further coefficients gain has decided
        return True
    simple, more = (force_along(r.candidate, r.descent.point) for r in (special, general))
    if simple is None or more is None:  # what it does to the outputs tells, where no force is known
        without, one, other = (
            _outputs(special.candidate.fitted.problem, special.candidate.fitted.point),
            _outputs(special.candidate.problem, special.descent.point),
            _outputs(general.candidate.problem, general.descent.point),
        )
        return bool(np.linalg.norm(other - one) <= level * np.linalg.norm(one - without))
    one, other = (force - np.median(force) for *_, force in (simple, more))
    apart = np.sort(np.abs(other - one - np.median(other - one)))[: int(_MOVING * one.size)]
    return bool(np.linalg.norm(apart) <= level * np.linalg.norm(one))


def _outputs(problem: Problem, point: Array) -> Array:
    """What a model does at a point, all records and outputs in units of their noise."""
    theta, starts = problem.unpack(point)
    runs = [
        engine.run(theta, start, sensitivity=False, check=False).outputs * problem.weights[:, None]
        for engine, start in zip(problem.engines, starts, strict=True)
    ]
    return np.concatenate([run.ravel() for run in runs])


def said_of_families(rivals: Sequence[CandidateFit], held: dict[int, int]) -> list[str]:
    """What contains a law that is as likely: a sentence each."""
    return [
        f"{rivals[i].effect.label} contains {rivals[j].effect.label} and gains no more than its further "
        "coefficients cost: no rival."
        for i, j in held.items()
    ]


def stuck_fits(
    rivals: Sequence[CandidateFit], samples: int, simpler: bool
) -> list[tuple[CandidateFit, CandidateFit]]:
    """Laws that fit worse than one that they contain, whatever their gradient says.

    Parameters
    ----------
    rivals : sequence of CandidateFit
        With their likelihoods.
    samples : int
        By which coefficients were priced.
    simpler : bool
        Whether to add what the best rival contains: it may do the same with fewer coefficients.

    Returns
    -------
    list of (CandidateFit, CandidateFit)
        The law, and the one that it may start from.
    """
    gain = {r: r.log_likelihood + price(r, samples) for r in rivals}
    leader = max(rivals, key=lambda r: r.log_likelihood)
    found = [(r, leader) for r in rivals if simpler and contains(leader.effect, r.effect)]
    for rival in rivals:
        best = max(
            (r for r in rivals if r is rival or contains(rival.effect, r.effect)), key=gain.__getitem__
        )
        if gain[best] > gain[rival] + LACK:
            found.append((rival, best))
    return found


def start_from(
    fitted: FittedModel, rival: CandidateFit, giver: CandidateFit, ratio: float, whitener: Whitener
) -> bool:
    """Put a law where another one of its family ended, with its width; whether that is better.

    Parameters
    ----------
    fitted : FittedModel
        Model without them.
    rival, giver : CandidateFit
        The law, which is changed, and the other one.
    ratio : float
        Unmeasured force that is allowed for.
    whitener : Whitener
        Metric.

    Returns
    -------
    bool
    """
    candidate, better = rival.candidate, False
    if rival.effect.spec.jumps and giver.effect.spec.jumps and "width" not in rival.effect.fixed:
        candidate = candidate.with_width(giver.candidate.width / candidate.width)
    gain = gain_for(fitted, candidate, ratio)
    for point in imitated(giver.candidate, giver.descent.point, candidate):
        again = descend(candidate.problem, point, gain=gain, whitener=whitener, evaluations=8)
        if again.cost < rival.descent.cost:
            rival.candidate, rival.descent, better = candidate, again, True
    return better
