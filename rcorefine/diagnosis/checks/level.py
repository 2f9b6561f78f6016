"""Whether a record is absolute, or what the signals have above an operating point."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from ...data.measurement import Measurement
from ...models.operating_point import OperatingPoint
from .row import LOOK, OK, CheckRow

__all__ = ["level_rows"]

_FAR = 3.0  # standard deviations of a signal that its mean stands away


def level_rows(data: Measurement, point: OperatingPoint | None) -> Iterator[CheckRow]:
    """Where the outputs stand, and whether that goes with the model.

    Parameters
    ----------
    data : Measurement
        Record, as it was given.
    point : OperatingPoint, optional
        Of the model.

    Yields
    ------
    CheckRow
        One on the first output that does not go with the model's point, else one on all.
    """
    taken = data.origin[data.n_inputs :]
    means, spreads = data.outputs.mean(axis=1) + taken, data.outputs.std(axis=1)
    far = np.abs(means) > _FAR * spreads
    if point is not None:
        for i in np.flatnonzero((np.abs(point.outputs) > _FAR * spreads) & ~far & (taken == 0)):
            yield CheckRow(
                LOOK, "level", data.output_labels[i], f"{means[i]:.4g} +/- {spreads[i]:.2g}",
                f"{data.output_labels[i]} looks like what is above a point, and the model's is at "
                f"{point.outputs[i]:.4g}: give the record as it was measured, or a model without a point.",
            )  # fmt: skip
            return
    if not far.any():
        yield CheckRow(OK, "level", "", "about zero", "The outputs look like deviations from a point.")
    elif point is not None:
        yield CheckRow(OK, "level", "", "absolute", "The outputs look absolute, about the model's point.")
    else:
        yield CheckRow(
            OK, "level", data.output_labels[int(np.argmax(far))], "absolute",
            "The record looks absolute. Where the model is linear about a point, declare that by "
            "physical(model, operating_point=...), or give Measurement.deviation().",
        )  # fmt: skip
