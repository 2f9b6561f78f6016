"""Choice of the effects of a free decay by its smaller motion."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from ..data.records import at_rest
from ..effects.effect import Effect
from ..exceptions import DataError
from ..inference.f_tests import FTest
from ..inference.refinement import Refinement
from ..refinement.refine import base_fit
from .case import Case, common_horizon, not_held, split_in_parts
from .error_shares import ErrorShare, found_share
from .held_out import HeldOutPath
from .hypothesis import Trial
from .nuisances import about_hold, with_offsets
from .result import Diagnosis, RankedEffect
from .search import Search
from .verdict import close_models, estimates, special, table

_MOST = 4  # effects that are added to a decay


def by_smaller_motion(found: Diagnosis, case: Case, model: Any) -> Diagnosis:
    """Return the diagnosis of decays by what holds for smaller motion, too.

    What only imitates a law where the motion is large fails where it is small. A decay offers both: effects
    are fitted to its first part, chosen on the next one and judged on the last. The diagnosis is returned as
    it is if no set of named effects leaves too little to matter.

    Parameters
    ----------
    found : Diagnosis
        Diagnosis; where it names an effect that passes its tests, or needs none, it is returned.
    case : Case
        Records and settings. If inputs move, the diagnosis is returned.
    model : StateSpace, PhysicalModel or Refinement
        Initial model.

    Returns
    -------
    Diagnosis
    """
    inexact = found.verdict == "unexplained" or np.isfinite(found.adequate_to)
    if not (found.ranking and inexact and case.in_time and at_rest(case.ordered)):
        return found
    try:
        parts = split_in_parts(case.records, None)
    except DataError:  # too short for three parts
        return found
    # one horizon for the three parts of the decay
    horizon, _ = common_horizon(case.base.physical_model, case.ordered, case.settings["horizon"])
    settings = case.options | {"horizon": horizon}
    # search on the first part, with the largest motion
    start, part = case_of_part(case, model, parts.fit, settings)
    search = Search(part, _MOST).run()
    # choose on the smaller one
    path = HeldOutPath(parts, settings, case.levels.matters, case.progress)
    close = sorted(close_models(search), key=lambda trial: path.log_error(trial.model.refinement))
    if not close or not close[0].effects or any(e.spec.needs_law for e in close[0].effects):
        return found
    chosen = close[0]
    path.found = found_share(chosen.tested, search.tests(chosen), case.significance)
    # judge on the smallest
    tied = _tied_effects(chosen, search)
    path.follow(start, None, chosen.model.refinement, chosen.effects, "effect", tied)
    if path.back() or not path.is_close:
        return found
    # errors on the last part, and the ranking with the chosen set first
    left = path.errors_on(parts.judge, path.steps[-1].refinement)
    own = _ranked(chosen.effects, path.steps[-1].refinement, found)
    return _renamed(found, own, tied, left, search.tests(chosen), about_hold(chosen, search))


def _renamed(
    found: Diagnosis,
    own: RankedEffect,
    tied: Mapping[Effect, Sequence[Effect]],
    left: tuple[ErrorShare, ...],
    tests: tuple[FTest, ...],
    notes: Sequence[str],
) -> Diagnosis:
    """Return a diagnosis that names other effects."""
    alike = tuple(one for effect, others in tied.items() if others for one in (effect, *others))
    said = "The effects were fitted to the first part of each decay and chosen on the next, smaller one."
    rest = (replace(row, alike=False, probability=np.nan) for row in found.ranking)
    return replace(
        found, verdict="ambiguous" if alike else "effect", ranking=(own, *rest), open_law=None,
        ambiguous=alike, winner_tests=tests, error_shares=left, none_of_these=np.nan,
        adequate_to=max(one.model for one in left), notes=(said, *notes),
    )  # fmt: skip


def case_of_part(
    case: Case, model: Any, records: Sequence[Any], settings: dict[str, Any]
) -> tuple[Refinement, Case]:
    """Return the initial model on a part of the records, and its case.

    Parameters
    ----------
    case : Case
        Case of the whole records.
    model : StateSpace, PhysicalModel or Refinement
        Initial model.
    records : sequence of Measurement
        Part of the records.
    settings : dict
        tolerance, offset, noise and horizon.

    Returns
    -------
    start : Refinement
    part : Case
        With offsets at all channels.
    """
    # the initial model fitted to this part, with its own offsets
    start = base_fit(model, records, free=case.settings["free"], **settings)
    asked = settings | {"free": (), "matters": case.levels.matters}
    library = not_held(case.library, start.effects)
    base = with_offsets(start, records, asked)
    return start, Case(base, records, library, asked, case.significance, case.progress, case.effort)


def _tied_effects(chosen: Trial, search: Search) -> dict[Effect, list[Effect]]:
    """Return the effects that the first part cannot distinguish from each one."""
    near = search.posterior(chosen) - 0.5 * search.case.levels.rival
    ties: dict[Effect, list[Effect]] = {effect: [] for effect in chosen.effects}
    for row in table(search):
        sets = [set(trial.effects) for trial in (row.trials[0], *row.same)]
        # a law that contains it is no other explanation
        if set(chosen.effects) in sets or special(chosen.effects, row.effects):
            continue
        gone, new = set(chosen.effects) - set(row.effects), set(row.effects) - set(chosen.effects)
        if row.value > near and len(gone) == len(new) == 1:
            ties[gone.pop()].append(new.pop())
    return ties


def _ranked(effects: Sequence[Effect], model: Refinement, found: Diagnosis) -> RankedEffect:
    """Return effects and the model that holds them as a row of a ranking."""
    first, *beside = effects
    rows = estimates(model, first)
    values = {name: row.coefficient for name, row in rows.items()}
    std = {name: row.std for name, row in rows.items()}
    p_value = next((row.p_value for row in found.ranking if row.effect == first), np.nan)
    figures = float(np.mean(found.base.fit)), float(np.mean(model.fit)), p_value, np.nan, np.nan
    return RankedEffect(first, values, std, *figures, model, tuple(beside), alike=True)
