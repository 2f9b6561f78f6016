"""Nested laws: the simplest one that does is named, and what merely contains it is no rival."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ..effects.effect import Effect
from ..inference.descent import descend
from ..inference.fitted import FittedModel
from ..inference.sensitivities import Candidate
from ..inference.whitening import Whitener
from ..systems.linear import Array
from .candidate_fit import LACK, CandidateFit, price
from .starts import gain_for, imitated

__all__ = [
    "below_special_cases",
    "contains",
    "hosts",
    "in_families",
    "merged",
    "said_of_families",
    "start_from",
]


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


def hosts(rivals: Sequence[CandidateFit], alike: Sequence[int]) -> dict[int, int]:
    """Rivals among those alike that merely contain another one of them, and that one.

    Parameters
    ----------
    rivals : sequence of CandidateFit
        The most likely first.
    alike : sequence of int
        Those that the record does not tell from the first.

    Returns
    -------
    dict
        ``{index of the containing law: index of the most likely one that it contains}``. What
        is likelier than each law that it contains, the price of its coefficients paid, is a rival.
    """
    found = {}
    for i in alike:
        inside = [j for j in alike if j < i and contains(rivals[i].effect, rivals[j].effect)]
        if inside:
            found[i] = inside[0]
    return {i: found.get(j, j) for i, j in found.items()}


def merged(probabilities: Array, held: dict[int, int]) -> Array:
    """Probabilities with those of containing laws counted where they belong.

    Parameters
    ----------
    probabilities : ndarray, shape (n,)
    held : dict
        As `hosts` gives it.

    Returns
    -------
    ndarray, shape (n,)
    """
    found = np.array(probabilities)
    for i, j in held.items():
        found[j] += found[i]
        found[i] = 0.0
    return found


def said_of_families(rivals: Sequence[CandidateFit], held: dict[int, int]) -> list[str]:
    """What contains a law that is as likely: a sentence each."""
    return [
        f"{rivals[i].effect.label} contains {rivals[j].effect.kind} and gains no more than its further "
        "coefficients cost: no rival."
        for i, j in held.items()
    ]


def below_special_cases(
    rivals: Sequence[CandidateFit], samples: int
) -> list[tuple[CandidateFit, CandidateFit]]:
    """Laws that fit worse than one that they contain: stuck, whatever their gradient says.

    Parameters
    ----------
    rivals : sequence of CandidateFit
        With their likelihoods.
    samples : int
        By which coefficients were priced.

    Returns
    -------
    list of (CandidateFit, CandidateFit)
        The law, and the best of those that it contains.
    """
    found = []
    for rival in rivals:
        inside = [r for r in rivals if contains(rival.effect, r.effect)]
        gain = {r: r.log_likelihood + price(r, samples) for r in [rival, *inside]}
        best = max(gain, key=lambda r: gain[r])
        if gain[best] > gain[rival] + LACK:
            found.append((rival, best))
    return found


def start_from(
    fitted: FittedModel, rival: CandidateFit, special: CandidateFit, ratio: float, whitener: Whitener
) -> None:
    """Put a law where one that it contains ended, with its width, if that is better.

    Parameters
    ----------
    fitted : FittedModel
        Model without them.
    rival, special : CandidateFit
        The law, which is changed, and the one that it contains.
    ratio : float
        Unmeasured force that is allowed for.
    whitener : Whitener
        Metric.
    """
    candidate = rival.candidate
    if rival.effect.spec.jumps and special.effect.spec.jumps and "width" not in rival.effect.fixed:
        candidate = candidate.with_width(special.candidate.width / candidate.width)
    gain = gain_for(fitted, candidate, ratio)
    for point in imitated(special.candidate, special.descent.point, candidate):
        again = descend(candidate.problem, point, gain=gain, whitener=whitener, evaluations=8)
        if again.cost < rival.descent.cost:
            rival.candidate, rival.descent = candidate, again
