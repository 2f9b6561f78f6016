"""Which hold of the input suits a record: it outweighs most effects, so it is tested before them."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from ..exceptions import DivergenceError
from ..measurement import HOLDS, Measurement
from ..refinement.refine import refit
from ..refinement.refinement import Refinement

__all__ = ["best_hold", "hold_errors"]

_MATTERS = 0.05  # log of the error by which another hold must be better
_NAMES = {"zoh": "zero-order hold", "foh": "first-order hold", "bandlimited": "band-limited input"}


def hold_errors(
    model: Refinement, records: Sequence[Measurement], settings: dict[str, Any]
) -> dict[str, float]:
    """Mean log error of the free run under each hold, the model fitted again under it.

    Parameters
    ----------
    model : Refinement
        Where each fit starts.
    records : sequence of Measurement
        Records.
    settings : dict
        tolerance, offset and noise as in `refine`.

    Returns
    -------
    dict
        ``{hold: log error}``, holds under which the model runs away left out.
    """
    found = {}
    for hold in HOLDS:
        try:
            fitted = refit(model.with_hold(hold), records, **settings)
        except DivergenceError:
            continue
        found[hold] = float(np.mean(np.log(fitted.rmse + 1e-300)))
    return found


def best_hold(model: Refinement, records: Sequence[Measurement], settings: dict[str, Any]) -> tuple[str, str]:
    """The hold to use, and a sentence where it is not the declared one.

    Parameters
    ----------
    model, records, settings
        As in `hold_errors`.

    Returns
    -------
    hold : str
        The declared one (the model's own where it has one) unless another lowers the error by
        more than 5 %; records that declare different holds are taken at their word.
    sentence : str
        What was found, empty where the declared hold is right.
    """
    declared = model.hold or records[0].hold
    if model.hold is None and any(record.hold != declared for record in records):
        return declared, ""  # several holds were declared on purpose
    errors = hold_errors(model, records, settings)
    best = min(errors, key=lambda hold: errors[hold], default=declared)
    if declared in errors and errors[declared] - errors[best] < _MATTERS:
        return declared, ""
    figures = ", ".join(f"{hold} {np.exp(value):.4g}" for hold, value in errors.items())
    said = "the record declares" if model.hold is None else "the model was fitted with"
    return best, (
        f"The hold matters more than most effects: {said} hold={declared!r}, a {_NAMES[best]} "
        f"(hold={best!r}) fits better (error {figures})."
    )
