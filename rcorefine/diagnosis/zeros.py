"""Where zero is: laws know it, a linear model and its constant offsets do not."""

from __future__ import annotations

import numpy as np

from ..inference.assembly import offsets_everywhere
from ..inference.refinement import Refinement
from ..refinement.refine import refit
from .candidate_fits import CandidateFits
from .case import Case
from .judging import Judged
from .residual_tests import TestedResidual
from .without_a_law import likelihood

__all__ = ["gains_by_zeros", "zeros_sought"]


def zeros_sought(case: Case, judged: Judged) -> Refinement | None:
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


def gains_by_zeros(case: Case, judged: Judged, other: CandidateFits | None) -> bool:
    """Whether candidates explain more where zero is sought."""
    if other is None:
        return False
    mine, theirs = (likelihood(TestedResidual(j.model(), j.ratio)) for j in (judged.race, other))
    return theirs >= mine + case.levels.force
