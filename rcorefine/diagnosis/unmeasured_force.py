"""A force that nobody measured, of unknown size, at the inputs or everywhere, as the cause of a residual."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..inference.f_tests import FTest
from ..inference.fitted import FittedModel
from ..inference.levels import Levels
from ..inference.sensitivities import Candidate, candidate_columns
from .case import Case
from .places import in_race
from .residual_tests import TestedResidual, passed_without_library, run_tests
from .verdict import overall

__all__ = ["Explained", "explaining_force", "likely_forces"]

_SIZES = (0.002, 0.004, 0.008, 0.016, 0.032, 0.064, 0.128)  # over the measured force
_AT = ("everywhere", "inputs")


@dataclass(frozen=True, slots=True, eq=False)
class Explained:
    """A residual that an unmeasured force explains.

    Attributes
    ----------
    battery : TestedResidual
        The residual led by the force.
    scored : list of Candidate
        Columns of the candidates on it.
    tests : list of FTest
        What it passed.
    """

    battery: TestedResidual
    scored: list[Candidate]
    tests: list[FTest]


def likely_forces(
    fitted: FittedModel, free_run: TestedResidual, least: float, levels: Levels
) -> list[TestedResidual]:
    """The residual led by each unmeasured force that it may speak of, the likeliest first.

    Parameters
    ----------
    fitted : FittedModel
        Model at its minimum.
    free_run : TestedResidual
        Its residual without such a force.
    least : float
        Log-likelihood that the force must earn.
    levels : Levels
        Of the size.

    Returns
    -------
    list of TestedResidual
        Empty where none earns as much.
    """
    found: list[TestedResidual] = []
    for at in _AT:
        top = -np.inf
        for ratio in _SIZES:
            try:
                led = TestedResidual(fitted.forced(at), ratio)
            except (np.linalg.LinAlgError, ValueError):
                continue
            if np.isfinite(led.log_likelihood):
                found.append(led)
                top = max(top, led.log_likelihood)
            if not led.log_likelihood >= top - 3 * levels.force_size:
                break  # it only falls from here
    best = max((led.log_likelihood for led in found), default=-np.inf)
    if best <= free_run.log_likelihood + least:
        return []
    near = [led for led in found if led.log_likelihood >= best - levels.force_size]
    return sorted(near, key=lambda led: -led.log_likelihood)


def explaining_force(case: Case, free_run: TestedResidual) -> Explained | None:
    """The likeliest unmeasured force beside which every test passes, if one does.

    How strong it is, and where, is not known: it explains the residual if one likely force does.
    """
    if not case.in_time or case.excess(case.fitted) > case.levels.noise_excess:
        return None
    likely = likely_forces(case.fitted, free_run, case.levels.force, case.levels)
    for led in case.progress.over(likely, "unmeasured force"):
        others = passed_without_library(led, case.motions, case.significance)
        if others is None:
            continue  # the library cannot mend what fails without it
        near = in_race(led.fitted, case.library, (led.ratio,))
        scored = candidate_columns(led.fitted, near, case.motions[0], (led.ratio,))
        tests = run_tests(led, scored, case.motions, len(case.library) - len(near), others)
        if overall(tests) >= case.significance:
            return Explained(led, scored, tests)
    return None
