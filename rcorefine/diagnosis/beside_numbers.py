"""A law is missing and the numbers of the model are off besides: every law again while they float."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from ..exceptions import ModelError
from ..inference.f_tests import FTest
from ..inference.refinement import Refinement
from ..refinement.refine import refit
from .absorbed import determined, numbers_that_moved, percent
from .asking import Ask, Unanswered
from .case import Case, not_held
from .result import Diagnosis
from .without_a_law import Answer, gains, parameters

__all__ = ["beside_numbers", "gains_by_numbers", "told_beside"]

_MATTERS = 0.2  # of what numbers are off by: those that move less take up what a law lacks in form


def beside_numbers(first: Unanswered, again: Ask) -> Answer | Unanswered | None:
    """The same asked while all numbers float: the name that a law then has, if it explains clearly more.

    Numbers that hardly move are not off: they take up what that law lacks, as a cubic spring in place of
    a sine, and it is not named.

    Parameters
    ----------
    first : Unanswered
        The best candidate failed its tests.
    again : callable
        The same asked of the model fitted otherwise.

    Returns
    -------
    Answer, Unanswered or None
        An answer that names nothing is open, too; None where nothing is gained.
    """
    case, floated = first.case, first.floated
    if floated is None or not not_held(case.library, floated.effects):
        return None
    try:
        answer = again(floated, False)
    except ModelError:  # floated to where no observer leads it, or it runs away within a sample
        return None
    if isinstance(answer, Unanswered):
        return answer
    found, race = answer.found, answer.race
    if found.verdict == "unexplained":
        return answer
    if found.verdict not in ("effect", "ambiguous") or found.best is None:
        return None
    least, sure = _MATTERS * case.levels.off, case.levels.moved  # a parameter deviates by what matters
    rows = determined(found.best.refinement)
    off = any(abs(r.coefficient) > max(sure * r.std, least * abs(r.initial)) for r in rows)
    if not (off and gains(case, first.judged, race)):
        return None
    further = _with_a_gain(case, found)
    if further is not None:
        return Answer(parameters(case, further, found.winner_tests, first.tests), race)
    return Answer(_told(found, first.tests), race)


def gains_by_numbers(found: Diagnosis, beside: Answer | Unanswered) -> bool:
    """Whether the numbers of the model take more from the error than any law, or force without one."""
    if found.verdict != "unexplained" or not found.ranking:
        return False
    fits = [float(np.mean(row.refinement.fit)) for row in found.ranking]
    fits += [found.open_law.fit_after] if found.open_law is not None else []
    base = beside.case.base if isinstance(beside, Unanswered) else beside.found.base
    return bool(np.mean(base.fit) > max(fits))


def told_beside(found: Diagnosis, beside: Answer | Unanswered) -> Answer:
    """What `beside_numbers` left open, with the tests of the model as it is."""
    if isinstance(beside, Unanswered):
        beside = replace(beside, case=replace(beside.case, thorough=True)).told()
    return Answer(_told(beside.found, found.tests), beside.race)


def _with_a_gain(case: Case, found: Diagnosis) -> Refinement | None:
    """The model whose numbers float, where a gain is all that it lacks: that is one more of its numbers."""
    # where all parameters are estimated, a record may leave open which of two sensors has the gain
    alike = all(effect.spec.relative for effect in found.ambiguous)
    if found.best is None or not found.best.effect.spec.relative or not alike:
        return None
    model, gain = found.best.refinement, found.best.effect
    roles = ["linear" if e == gain else role for e, role in zip(model.effects, model.roles, strict=True)]
    return refit(replace(model, roles=tuple(roles)), case.records, elsewhere=False, **case.options)


def _told(found: Diagnosis, tests: Sequence[FTest]) -> Diagnosis:
    """The diagnosis, with what is said where a law is sought while all parameters are estimated."""
    said = "No law alone explains the record, nor do the numbers of the model: these float beside every law."
    before, after = (percent(fit) for fit in (found.base.initial_fit, found.base.fit))
    more = f"The numbers alone take the fit from {before} to {after}."
    if found.verdict in ("effect", "ambiguous") and found.best is not None:
        more = numbers_that_moved(determined(found.best.refinement))
    return replace(found, tests=tuple(tests), notes=(f"{said} {more}", *found.notes))
