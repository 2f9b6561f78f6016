"""Checks of samples and records against the model.

They cover lengths, channels, finite values, excitation, hold and dt.
"""

from __future__ import annotations

from typing import Any

import control as ct
import numpy as np
from numpy.typing import ArrayLike

from ..data.records import as_record
from ..data.signals import LARGEST, SMALLEST
from ..exceptions import DataError
from ..systems.conversion import to_discrete
from ..systems.linear import Array, LinearModel
from .checks import as_block, check_samples
from .rcmr.setup import Sampled

__all__ = ["checked_block", "checked_record"]


def checked_block(
    model: LinearModel, step: float | None, w: ArrayLike, y: ArrayLike, first: int
) -> tuple[Array, Array]:
    """Inputs and outputs of one sample or a block as (N, signals).

    Parameters
    ----------
    model : LinearModel
        Model with its labels.
    step : float or None
        Sampling time in s, for the messages.
    w, y : array_like
        As in `RCORefiner.update`.
    first : int
        Number of samples taken before, for the messages.
    """
    if (  # one sample as it comes from a loop: the checks below would take longer than to learn from it
        type(w) is np.ndarray
        and type(y) is np.ndarray
        and w.shape == (model.n_inputs,)
        and y.shape == (model.n_outputs,)
        and w.dtype == y.dtype == np.float64
        and sum(sizes := [abs(value) for value in (*w.tolist(), *y.tolist())]) < LARGEST  # and no NaN
        and min(size or 1.0 for size in sizes) >= SMALLEST
    ):
        return w[None].copy(), y[None].copy()
    inputs, outputs = as_block(model, w, y)
    check_samples(inputs, model.input_labels, "input", first, step)
    check_samples(outputs, model.output_labels, "output", first, step)
    return np.ascontiguousarray(inputs.T), np.ascontiguousarray(outputs.T)


def checked_record(setup: Sampled, data: Any, hold: str) -> tuple[Array, Array]:
    """Return inputs and outputs of a record as (N, signals).

    They are in the order of the model's channels.
    """
    model = setup.initial
    data = as_record(data)
    from ..data.channels import match_channels

    if setup.step is not None:
        to_discrete(setup.discrete, data.dt)
    if model.is_continuous and data.hold != hold:
        raise DataError(
            f"record {data.name!r} has hold={data.hold!r}, but the refiner takes hold={hold!r}; pass "
            f"RCORefiner(..., hold=...) or Measurement(..., hold={hold!r})"
        )
    if not data.n_inputs:
        raise DataError(
            f"record {data.name!r} has no input: retrospective cost optimization learns from what an input "
            "drives; use refine or improve for a free decay"
        )
    channels = match_channels(model, data)
    if -1 in channels.outputs:
        missing = model.output_labels[channels.outputs.index(-1)]
        raise ct.ControlDimension(
            f"output {missing!r} of the model is not in record {data.name!r}; measure it, or give a model "
            "without it"
        )
    if data.n_samples < model.n_states:
        raise DataError(
            f"record {data.name!r} has {data.n_samples} sample(s) for a model of {model.n_states} "
            "states; give a longer record, or a smaller model"
        )
    inputs, outputs = data.inputs[list(channels.inputs)], data.outputs[list(channels.outputs)]
    for signal, label in zip(inputs, model.input_labels, strict=True):
        if np.ptp(signal) == 0.0:
            raise DataError(
                f"input {label!r} is constant ({signal[0]:g}) from sample 0 to {data.n_samples - 1}: nothing "
                "can be learned from it. Give a stretch where it varies, or leave it out of the model"
            )
    return np.ascontiguousarray(inputs.T), np.ascontiguousarray(outputs.T)
