"""Where the outputs stand: at zero, where the model puts them, or about a point that it does not know."""

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
_SEEN = 0.05  # of the spread of an output: a level that is worth a word


def level_rows(
    data: Measurement, point: OperatingPoint | None, compared: Comparison | None
) -> Iterator[CheckRow]:
    """Where the outputs stand, and whether that goes with the model.

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
        One on the first output that does not go with the model or its point, else one on all.
    """
    taken = data.origin[data.n_inputs :]
    means, spreads = data.outputs.mean(axis=1) + taken, data.outputs.std(axis=1)
    far = np.abs(means) > _FAR * spreads
    if point is not None:
        for i in np.flatnonzero((np.abs(point.outputs) > _FAR * spreads) & ~far & (taken == 0)):
            yield CheckRow(
                LOOK, "level", data.output_labels[i], with_error(means[i], spreads[i]),
                f"{data.output_labels[i]} looks like what is above a point, and the model's is at "
                f"{point.outputs[i]:.4g}: give the record as it was measured, or a model without a point.",
            )  # fmt: skip
            return
    # where a model integrates or is led, its level is that of its initial state, or of the record
    free = compared is not None and len(compared.starts) == 1 and not compared.led
    for label, level, error, spread in _unexplained(compared) if compared is not None and free else ():
        if _stands(level, error, spread):
            about = ": declare that by physical(model, operating_point=...), or give Measurement.deviation()"
            yield CheckRow(
                LOOK, "level", label, with_error(level, error),
                f"{label} stands {with_error(level, error)} off where the model puts it, with a spread of "
                f"{spread:.3g}: an offset, or a record about an operating point."
                + (f" The record looks absolute{about}." if far.any() and point is None else ""),
            )  # fmt: skip
            return
    if point is not None and far.any():
        yield CheckRow(OK, "level", "", "absolute", "The outputs look absolute, about the model's point.")
    elif far.any():
        yield CheckRow(
            OK, "level", data.output_labels[int(np.argmax(far))], "absolute",
            "The record looks absolute. Where the model is linear about a point, declare that by "
            "physical(model, operating_point=...), or give Measurement.deviation().",
        )  # fmt: skip
    elif any(_stands(y.mean(), _error(y, y.size), y.std()) for y in data.outputs):
        said = "the model explains them." if free else "no free run says whether the model explains them."
        figure = "by the model" if free else "not zero"
        yield CheckRow(OK, "level", "", figure, f"The outputs have means, and {said}")
    else:
        yield CheckRow(OK, "level", "", "about zero", "The outputs look like deviations from a point.")


def _stands(level: float, error: float, spread: float) -> bool:
    """Whether a level is there, and large enough to be worth a word."""
    return abs(level) > max(_SURE * error, _SEEN * spread)


def _unexplained(compared: Comparison) -> Iterator[tuple[str, float, float, float]]:
    """Level that the free run, whatever its gain, leaves of each output; its error; the spread."""
    data = compared.data
    (free,) = settling(compared.models[0], data.dt, [0, data.n_samples])
    for i, (label, y) in enumerate(zip(data.output_labels, data.outputs, strict=True)):
        # what an initial state adds is fitted beside the level, which its estimate took up in part
        run = compared.runs[0, i] - free[i] @ compared.initial_states[0][0]
        others = rank_basis(np.column_stack([run, free[i]]))
        own, left = project(np.ones(y.size), others), project(y, others)
        seen = float(own @ own)  # samples that tell the level from the rest
        level = float(own @ left) / seen
        yield label, level, _error(left - level * own, seen), float(y.std())


def _error(left: Array, seen: float) -> float:
    """Standard error of a mean over so many samples, where what is left of them has a memory."""
    a, variance = autoregression(left)
    return float(np.sqrt(variance / seen) / max(abs(float(np.sum(a))), 1e-12))
