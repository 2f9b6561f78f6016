"""Decision whether a comparison shows that something is missing.

The report and the command line use this one rule.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from .failure_map.search import FailureMap
    from .result import Comparison

__all__ = ["best_of", "failures_of"]


def failures_of(result: Comparison, index: int = 0) -> FailureMap:
    """Failure map of one of the models; empty where it is adequate.

    Parameters
    ----------
    result : Comparison
        Models beside a record.
    index : int
        Which of the models.

    Returns
    -------
    FailureMap
    """
    found = result.failures
    chosen: FailureMap = found[index] if result.several else found
    return chosen


def best_of(result: Comparison) -> int:
    """Index of the model that fits best, mean over the outputs."""
    fits = np.atleast_2d(result.fit)
    means = np.where(np.isnan(fits).all(axis=1), -np.inf, np.nan_to_num(fits, nan=0.0).mean(axis=1))
    return int(np.argmax(means))
