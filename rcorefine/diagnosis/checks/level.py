"""Checks of the mean levels of the outputs.

An output is around zero, around the level of the model, or around an unknown operating point.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from ...comparison.result import Comparison
from ...data.measurement import Measurement
from ...inference.autoregression import autoregression
from ...inference.basis import project, rank_basis
from ...models.operating_point import OperatingPoint
from ...systems.linear import Array
from ...words import with_error
from .gains import settling
from .row import LOOK, OK, CheckRow

__all__ = ["level_rows"]

_FAR = 3.0  # standard deviations of a signal that its mean stands away
_SURE = 5.0  # standard errors of a level
_TELLS = 1e-6  # of the samples: with fewer, none tells a level from an initial state
_SEEN = 0.05  # of the spread of an output: a level that is worth a word


def level_rows(
    data: Measurement, point: OperatingPoint | None, compared: Comparison | None
) -> Iterator[CheckRow]:
    """Check the output levels and compare them with the model.

    Parameters
    ----------
    data : Measurement
        Record, as it was given.
    point : OperatingPoint, optional
        Of the model.
    compared : Comparison, optional
        Model on the record, where its free run has bounds.

    Yields
    ------
    CheckRow
        One on each output that does not go with the model or its point; where all do, one on all.
    """
    taken = data.origin[data.n_inputs :]
    means, spreads = data.outputs.mean(axis=1) + taken, data.outputs.std(axis=1)
    levels = {} if compared is None or compared.led else dict(_unexplained(compared))
    # where a model integrates, its level is that of its initial state: any level goes with it
    fixed = np.array([levels.get(label, (0.0,)) is not None for label in data.output_labels])
    far = (np.abs(means) > _FAR * spreads) & fixed
    odd = False
    if point is not None:
        for i in np.flatnonzero((np.abs(point.outputs) > _FAR * spreads) & ~far & fixed & (taken == 0)):
            odd = True
            yield CheckRow(
                LOOK, "level", data.output_labels[i], with_error(means[i], spreads[i]),
                f"{data.output_labels[i]} looks like deviations from an operating point, but in the model "
                f"this point is {point.outputs[i]:.4g}. Give the record as it was measured, or a model "
                "without an operating point.",
            )  # fmt: skip
    # where it is led, or begins anew, its level is that of the record
    free = compared is not None and len(compared.starts) == 1 and not compared.led
    absolute = ": declare this by physical(model, operating_point=...), or give Measurement.deviation()"
    for label, found in levels.items() if free and not odd else ():
        if found is not None and _stands(*found):
            odd = True
            yield CheckRow(
                LOOK, "level", label, with_error(*found[:2]),
                f"{label} differs from the model by a constant {with_error(*found[:2])}, with a spread of "
                f"{found[2]:.3g}: an offset, or a record about an operating point."
                + (f" The outputs look absolute{absolute}." if far.any() and point is None else ""),
            )  # fmt: skip
    if odd:
        return
    if point is not None and far.any():
        yield CheckRow(OK, "level", "", "absolute", "The outputs look like absolute values, as in the model.")
    elif far.any():
        yield CheckRow(
            OK, "level", data.output_labels[int(np.argmax(far))], "absolute",
            "The outputs look like absolute values. If the model is linear about an operating point, "
            "declare it by physical(model, operating_point=...), or give Measurement.deviation().",
        )  # fmt: skip
    elif not fixed.all():
        yield CheckRow(
            OK, "level", "", "any", "The model integrates, so its initial state can explain any level."
        )
    elif any(_stands(y.mean(), _error(y, y.size), y.std()) for y in data.outputs):
        said = "the model explains them." if free else "no simulation shows whether the model explains them."
        figure = "by the model" if free else "not zero"
        yield CheckRow(OK, "level", "", figure, f"The outputs have nonzero means, and {said}")
    else:
        yield CheckRow(
            OK, "level", "", "about zero", "The outputs look like deviations from an operating point."
        )


def _stands(level: float, error: float, spread: float) -> bool:
    """Return whether a level is significant and large enough to report."""
    return abs(level) > max(_SURE * error, _SEEN * spread)


def _unexplained(compared: Comparison) -> Iterator[tuple[str, tuple[float, float, float] | None]]:
    """Yield the level of each output that the simulation does not explain.

    With each level come its standard error and the spread. The gain of the simulation is free. The error has
    no bound where gain and level have the same effect, or an output stands still; None where an initial state
    can hold any level.
    """
    data = compared.data
    (free,) = settling(compared.models[0], data.dt, [0, data.n_samples])
    for i, (label, y) in enumerate(zip(data.output_labels, data.outputs, strict=True)):
        # what an initial state adds is fitted beside the level, which its estimate took up in part
        run = compared.runs[0, i] - free[i] @ compared.initial_states[0][0]
        others = rank_basis(np.column_stack([run, free[i]]))
        own, left = project(np.ones(y.size), others), project(y, others)
        seen = float(own @ own)  # samples that tell the level from the rest
        found = 0.0, np.inf, float(y.std())
        if seen > _TELLS * y.size and np.ptp(y):
            level = float(own @ left) / seen
            found = level, _error(left - level * own, seen), found[2]
        alone = project(np.ones(y.size), rank_basis(free[i]))
        yield label, found if alone @ alone > _TELLS * y.size else None


def _error(left: Array, seen: float) -> float:
    """Return the standard error of a mean under colored noise.

    The mean is over `seen` samples, and `left` is the remainder.
    """
    a, variance = autoregression(left)
    return float(np.sqrt(variance / seen) / max(abs(float(np.sum(a))), 1e-12))
