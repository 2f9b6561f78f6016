"""Where zero is: laws know it, a linear model and its constant offsets do not."""

from __future__ import annotations

import numpy as np

from ..inference.assembly import offsets_everywhere
from ..inference.refinement import Refinement
from ..refinement.refine import refit
from .asking import Ask, Unanswered
from .case import Case
from .judging import Judged
from .without_a_law import Answer, gains

__all__ = ["with_zeros_sought"]


def with_zeros_sought(first: Unanswered, again: Ask) -> Answer | Unanswered | None:
    """The same asked with offsets wherever laws want them.

    Parameters
    ----------
    first : Unanswered
        The best candidate failed its tests.
    again : callable
        The same asked of the model fitted otherwise.

    Returns
    -------
    Answer, Unanswered or None
        An answer only if it says more; None where zero is not in doubt.
    """
    base = _zeros_sought(first.case, first.judged)
    if base is None:
        return None
    answer = again(base, first.case.thorough)
    if isinstance(answer, Unanswered):
        return answer
    explains = answer.found.verdict != "unexplained"
    return answer if explains or gains(first.case, first.judged, answer.race) else None


def _zeros_sought(case: Case, judged: Judged) -> Refinement | None:
    """The model with a constant offset at every input and output, where zero is doubtful.

    Behind a linear model an offset of a sensor is one of an input, or an initial state: it is fitted where
    that is likelier. A law that then acts about the wrong zero is not recognized.

    Parameters
    ----------
    case : Case
        What is asked.
    judged : Judged
        The best candidate, which failed its tests.

    Returns
    -------
    Refinement or None
        None where no output stands off zero, or offsets are everywhere already.
    """
    nuisances = [e for e, role in zip(case.base.effects, case.base.roles, strict=True) if role == "offset"]
    if not (case.in_time and judged.tests and nuisances) or any(e.prior for e in nuisances):
        return None
    y = np.concatenate([record.outputs for record in case.ordered], axis=1)
    if not np.any(np.abs(y.mean(axis=1)) > case.levels.zero * y.std(axis=1)):
        return None  # a zero that is off by as little is not what the laws fail by
    offsets = offsets_everywhere(case.base.physical_model, case.ordered)
    with case.progress.step("offsets elsewhere"):
        return refit(case.base, case.records, offsets=offsets, elsewhere=False, **case.options)
