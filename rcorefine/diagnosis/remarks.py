"""What else a diagnosis noticed: amplitudes that disagree, gains that disagree, motion without reversal."""

from __future__ import annotations

import numpy as np

from ..inference.covariance import wald
from ..inference.descent import descend
from ..inference.fitted import FittedModel, coefficient_covariance
from ..inference.levels import Levels
from ..systems.linear import Array
from ..words import chance, with_error
from .absorbed import percent
from .candidate_fits import CandidateFits
from .ranking import undetermined

__all__ = ["amplitude_test", "fit_remarks", "not_known", "remarks"]

_SHOWN = 8  # rows of the ranking that are printed
_RISEN = 0.02  # of the error: what explains a record does not move the free run away from it
_OTHER_AMPLITUDE = 1.3  # rms of the inputs over that of another record


def amplitude_test(race: CandidateFits, levels: Levels) -> tuple[float, str]:
    """Whether records of different amplitude agree on the coefficients of the winner.

    A law that only mimics the true one needs other coefficients at another amplitude.

    Parameters
    ----------
    race : CandidateFits
        CandidateFits on several records.
    levels : Levels
        Of the agreement.

    Returns
    -------
    p_value : float
        Of the Wald test; 1 where there are no two amplitudes.
    sentence : str
        What was compared, empty where nothing was.
    """
    problem = race.rivals[0].candidate.problem
    sizes = [float(np.sqrt(np.mean(r.inputs**2))) for r in problem.records]
    low, high = int(np.argmin(sizes)), int(np.argmax(sizes))
    if sizes[high] <= _OTHER_AMPLITUDE * max(sizes[low], 1e-300):
        return 1.0, ""
    fitted = race.model()
    p = race.fitted.structure.n_parameters
    estimates = [_alone(fitted, i) for i in (low, high)]
    own = slice(p, fitted.structure.n_parameters)
    difference = estimates[0][0][own] - estimates[1][0][own]
    spread = np.diag((levels.same_value * fitted.theta[own]) ** 2)
    p_value = wald(difference, estimates[0][1][own, own] + estimates[1][1][own, own] + spread)
    values = " and ".join(with_error(e[0][p], np.sqrt(e[1][p, p])) for e in estimates)
    name = race.rivals[0].effect.label
    sentence = (
        f"Fitted alone at the smallest and the largest amplitude, {name} is {values} "
        f"({'they disagree' if p_value < levels.disagree else 'they agree'}, {chance(p_value, 'p')})."
    )
    return p_value, sentence


def _alone(fitted: FittedModel, record: int) -> tuple[Array, Array]:
    """Coefficients and covariance from one record only."""
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


def not_known(race: CandidateFits, levels: Levels) -> str:
    """Why the first candidate gives no estimate though it may pass; empty where it does.

    Parameters
    ----------
    race : CandidateFits
        Fits.
    levels : Levels
        Of what is known.
    """
    effect = race.rivals[0].effect
    refinement = race.model().refinement
    unknown = undetermined(refinement, effect, levels)
    if not unknown:
        fits = np.array([race.fitted.refinement.fit, refinement.fit])
        told = np.isfinite(fits).all(axis=0)
        before, after = np.where(told, fits, 0.0).sum(axis=1) / max(np.count_nonzero(told), 1)
        if race.ratio or 100.0 - after <= (1.0 + _RISEN) * (100.0 - before):
            return ""
        fell = f"the fit decreases from {percent(before)} to {percent(after)} with it"
        return f"{effect.label} would pass, but {fell}: it is not named."
    found = ", ".join(with_error(row.coefficient, row.std) for row in unknown)
    wrong = race.rivals[0].unphysical
    why = "physics asks for a positive value" if wrong else "the record does not determine it"
    return f"{effect.label} would pass, but {why} ({found}): it is not named."


def fit_remarks(race: CandidateFits) -> list[str]:
    """Sentences on fits of the ranking that stand at a bound, or did not reach a minimum."""
    bound, loose = [], []
    for rival in race.rivals[:_SHOWN]:
        run = rival.descent
        bound += run.at_bound(rival.candidate.problem)
        if not rival.settled and rival is not race.rivals[0]:
            loose.append(rival.effect.label)
    said = [f"At its bound, and so no estimate: {', '.join(dict.fromkeys(bound))}."] if bound else []
    best = race.rivals[0]
    if not best.settled:  # it would only win by more
        said.append(f"Not converged, so its numbers are not final: {best.effect.label}.")
    if loose:
        said.append(f"Not converged, so neither named nor excluded for certain: {', '.join(loose)}.")
    return said


def remarks(race: CandidateFits) -> list[str]:
    """Sentences on what should make the reader careful."""
    best, fitted = race.rivals[0].effect, race.model()
    ports = {port.name for port in fitted.structure.model.ports}
    if best.spec.turns and best.place in ports and fitted.problem.in_time:
        v = np.concatenate([fitted.port(best.place, 0.0, i)[1] for i in range(len(fitted.problem.records))])
        if v.min() >= 0 or v.max() <= 0:
            return [
                f"The motion at {best.place} never changes direction: friction there cannot be told from a "
                "constant force."
            ]
    return []
