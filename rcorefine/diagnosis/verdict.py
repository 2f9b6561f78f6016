"""From tests, likelihoods and levels to a verdict: pure functions that a reader can follow."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ..inference.f_tests import FTest
from ..inference.levels import Levels

__all__ = ["keeps_name", "overall", "passes", "probabilities", "tied", "verdict"]


def overall(tests: Sequence[FTest], equal: bool = False) -> float:
    """Smallest p-value, corrected for the number of tests.

    Parameters
    ----------
    tests : sequence of FTest
        Tests of one residual; those without a degree of freedom do not count.
    equal : bool
        Whether to take all samples as equally noisy.

    Returns
    -------
    float
        0 where nothing could be tested: what was not tested has not passed.
    """
    valid = [t.p_equal if equal else t.p_value for t in tests if t.dof]
    return min(1.0, min(valid) * len(valid)) if valid else 0.0


def passes(tests: Sequence[FTest], excess: float, significance: float, levels: Levels) -> bool:
    """Whether a residual is noise: no test fires, and it is no larger than the declared noise.

    Parameters
    ----------
    tests : sequence of FTest
        Tests of the residual.
    excess : float
        Residual over the declared noise, 0 where none was declared.
    significance : float
        Level of the tests together.
    levels : Levels
        Of the excess.

    Returns
    -------
    bool
    """
    return overall(tests) >= significance and excess <= levels.noise_excess


def probabilities(log_likelihoods: Sequence[float]) -> np.ndarray:
    """Probability of each candidate if one of them is right and all were as likely before, (n,)."""
    weights = np.exp(np.asarray(log_likelihoods) - max(log_likelihoods))
    return np.asarray(weights / weights.sum())


def tied(log_likelihoods: Sequence[float], lacks: Sequence[float], levels: Levels) -> list[int]:
    """Candidates that the record does not tell from the first one.

    Parameters
    ----------
    log_likelihoods : sequence of float
        Of the candidates, the best one first.
    lacks : sequence of float
        What each would still gain in log-likelihood by fitting on, 0 at a minimum.
    levels : Levels
        Of rivals.

    Returns
    -------
    list of int
        The first one among them.
    """
    best = log_likelihoods[0]
    both = zip(log_likelihoods, lacks, strict=True)
    return [i for i, (value, lack) in enumerate(both) if 2 * (best - value) <= levels.rival + 2 * lack]


def keeps_name(single: float, numbers: float, levels: Levels) -> bool:
    """Whether one effect is named where all the parameters of the model together explain a record too.

    Parameters
    ----------
    single : float
        Log-likelihood of the best single effect.
    numbers : float
        Log-likelihood averaged over the prior of the parameters.
    levels : Levels
        Of rivals.

    Returns
    -------
    bool
    """
    return 2 * (numbers - single) <= levels.rival


def verdict(passed: bool, agreement: float, ties: int, levels: Levels, beside: float = -np.inf) -> str:
    """What is said of a model that is not adequate.

    Parameters
    ----------
    passed : bool
        Whether the residual of the best candidate is noise.
    agreement : float
        p-value that all amplitudes ask for the same coefficients of it; 1 where there is one.
    ties : int
        Candidates that the record does not tell apart, the best one included.
    levels : Levels
        Of the agreement, and of a force of no law.
    beside : float
        Log of the odds of a force of no law over the best candidate.

    Returns
    -------
    str
        "unexplained", "effect" or "ambiguous".
    """
    if not passed or agreement < levels.disagree or 2 * beside > levels.rival:
        return "unexplained"
    return "effect" if ties == 1 and beside <= levels.departs else "ambiguous"
