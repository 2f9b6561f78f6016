"""Description of the offsets and parameters that the base fit changed.

The base fit comes before any effect is added.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from ..inference.levels import levels
from ..inference.refinement import EstimatedParameter, Refinement
from ..words import with_error

__all__ = ["determined", "far_numbers", "numbers_that_moved", "percent", "what_was_absorbed"]

_MOST = 6  # numbers that are listed
_TOLD = 0.1  # of the standard deviation of its prior, below which a parameter is determined alone
_ALONE = 0.1  # of its variance that is left where others are known, below which only products are determined
_POWER = 0.05  # of a parameter in a product, below which it takes no part


def what_was_absorbed(base: Refinement) -> str:
    """Describe the changes of offsets and parameters in the base fit.

    With these changes, no effect is missing from the model.

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
        said.append(f"{len(moved) - _MOST} more parameters")
    return (
        f"The fit includes {', '.join(said)}: that increases the fit of the simulation from "
        f"{percent(base.initial_fit)} to {percent(base.fit)}."
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
        return "No single parameter changed significantly; together they explain the residual."
    more = f" and {len(sure) - _MOST} more" if len(sure) > _MOST else ""
    far = far_numbers(sure)
    doubt = (
        f" The change of {', '.join(far[:_MOST])} is so large that an effect may be missing at a place that "
        "the model does not show: declare its links with physical(...)."
    )
    return f"Significant changes, if the sensors are right: {', '.join(said)}{more}.{doubt if far else ''}"


def determined(model: Refinement) -> list[EstimatedParameter]:
    """Return the parameters, or their products, that the data determine.

    Parameters
    ----------
    model : Refinement
        Its linear parameters were estimated, each with a prior.

    Returns
    -------
    list of EstimatedParameter
        A parameter that the data determine only in relation to others is replaced by its product with
        powers of as few of them as possible, as a multiple of nominal.
    """
    prior = {(e.kind, e.place): sd for e in model.effects for sd in e.prior.values()}
    at = [i for i, r in enumerate(model.parameters) if r.role == "linear" and (r.kind, r.place) in prior]
    rows = [model.parameters[i] for i in at]
    size = np.abs([row.value for row in rows])  # of logarithms: products of parameters are sums
    widths = np.array([prior[row.kind, row.place] for row in rows]) / size
    C = model.covariance[np.ix_(at, at)] / np.outer(size, size)
    left, held = C, list[int]()
    while True:
        sds = np.sqrt(np.maximum(np.diag(left), 1e-300))
        alike = np.sum((left / np.outer(sds, sds)) ** 2 > 1.0 - _ALONE, axis=0) * (sds > _TOLD * widths)
        if np.max(alike, initial=0) < 2:  # itself
            break
        held.append(int(np.argmax(alike)))  # known, it would determine the most others
        taken = left[:, held[-1]]
        left = left - np.outer(taken, taken) / taken[held[-1]]
        left[held[-1]] = left[:, held[-1]] = 0.0
    powers = -np.linalg.lstsq(C[np.ix_(held, held)], C[held], rcond=None)[0]
    found = []
    for i, row in enumerate(rows):
        if left[i, i] > _ALONE * C[i, i] or C[i, i] < (_TOLD * widths[i]) ** 2:
            found.append(row)
        elif i not in held:
            name, ratio = row.name, row.value / row.initial
            for k, power in zip(held, powers[:, i], strict=True):
                if abs(power) > _POWER:
                    written = "" if abs(abs(power) - 1.0) < _POWER else f"^{abs(power):.2g}"
                    name += f" {'*' if power > 0 else '/'} {rows[k].name}{written}"
                    ratio *= abs(rows[k].value / rows[k].initial) ** power
            std = abs(ratio) * float(np.sqrt(max(left[i, i], 0.0)))
            found.append(replace(row, name=name, initial=1.0, value=ratio, coefficient=ratio - 1.0, std=std))
    return found


def far_numbers(rows: Sequence[EstimatedParameter]) -> list[str]:
    """Return the names of parameters that changed implausibly much.

    Such a change is certain, and larger than the error of somebody who knows the plant.
    """
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
