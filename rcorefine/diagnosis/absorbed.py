"""What a fit took up before nothing was missing: offsets and parameters, in words."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ..inference.levels import levels
from ..inference.refinement import EstimatedParameter, Refinement
from ..words import with_error

__all__ = ["far_numbers", "numbers_that_moved", "percent", "what_was_absorbed"]

_MOST = 6  # numbers that are listed


def what_was_absorbed(base: Refinement) -> str:
    """What lies between the model as it was given and one from which nothing is missing.

    Parameters
    ----------
    base : Refinement
        The model with its nuisances and free parameters fitted.

    Returns
    -------
    str
        One sentence, empty where no number moved by more than chance.
    """
    moved = [row for row in base.parameters if row.role != "effect" and _moved(row)]
    if not moved:
        return ""
    moved.sort(key=lambda row: -abs(row.value - row.initial) / max(row.std, 1e-300))
    said = [_one(row) for row in moved[:_MOST]]
    if len(moved) > _MOST:
        said.append(f"{len(moved) - _MOST} numbers more")
    return (
        f"To get there the fit absorbed {', '.join(said)}: the fit of the free run is "
        f"{percent(base.initial_fit)} as the model was given, {percent(base.fit)} with that."
    )


def numbers_that_moved(rows: Sequence[EstimatedParameter]) -> str:
    """The numbers of a model that are off, as multiples of what it says.

    Parameters
    ----------
    rows : sequence of EstimatedParameter
        Numbers that were fitted.

    Returns
    -------
    str
        One sentence.
    """
    sure = sorted((r for r in rows if _moved(r)), key=lambda r: -abs(r.coefficient) / max(r.std, 1e-300))
    said = [
        f"{row.name} {with_error(row.value / row.initial, row.std / abs(row.initial))} times nominal"
        for row in sure[:_MOST]
    ]
    if not said:
        return "No single number moved for certain; together they explain the residual."
    more = f" and {len(sure) - _MOST} more" if len(sure) > _MOST else ""
    far = far_numbers(sure)
    doubt = (
        f" {', '.join(far[:_MOST])} moved so far that {'it' if len(far) == 1 else 'they'} may stand in for a "
        "law at a place that the model does not show: declare its links with physical(...)."
    )
    return (
        f"Moved by more than chance, if the sensors are as the model has them: {', '.join(said)}{more}."
        f"{doubt if far else ''}"
    )


def far_numbers(rows: Sequence[EstimatedParameter]) -> list[str]:
    """Names of numbers that moved, for certain, further than people are off who know their plant."""
    sure, far = levels().moved, levels().moved_far
    return [row.name for row in rows if abs(row.coefficient) - sure * row.std > far * abs(row.initial)]


def _moved(row: EstimatedParameter) -> bool:
    return abs(row.coefficient) > levels().moved * row.std


def _one(row: EstimatedParameter) -> str:
    unit = f" {row.unit}" if row.unit else ""
    if row.role == "offset":
        return f"an offset of {row.value:.3g}{unit} at {row.place}"
    change = f" ({100 * (row.value / row.initial - 1):+.3g} %)" if row.initial else ""
    return f"{row.name} from {row.initial:.4g} to {row.value:.4g}{unit}{change}"


def percent(fit: np.ndarray) -> str:
    """The fit of each output [%]."""
    return " / ".join(f"{value:.4g} %" for value in np.atleast_1d(fit))
