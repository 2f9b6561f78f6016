"""Records for a model: channels matched by name, otherwise by position."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass

import control as ct
import numpy as np

from ..systems.linear import LinearModel
from .frequency_response import FrequencyResponse
from .measurement import Measurement

_DEFAULT = re.compile(r"[uyx]\[\d+\]")


@dataclass(frozen=True, slots=True)
class Channels:
    """Places of a model's channels in a record.

    Parameters
    ----------
    inputs : tuple of int
        For each input of the model its row in the record.
    outputs : tuple of int
        For each output of the model its row in the record; -1 where it was
        not measured.
    notes : tuple of str
        What a user should know: reordered, or left out.
    at_rest : tuple of str
        Labels of the model's inputs if the record has none (a free decay): they are zero there.
    """

    inputs: tuple[int, ...]
    outputs: tuple[int, ...]
    notes: tuple[str, ...]
    at_rest: tuple[str, ...] = ()


def match_channels(model: LinearModel, data: Measurement | FrequencyResponse) -> Channels:
    """Find the channels of a model in a record.

    Parameters
    ----------
    model : LinearModel
        Model with its labels.
    data : Measurement or FrequencyResponse
        Record with its labels.

    Returns
    -------
    Channels
        By name where the names are found, in any order; by position where
        model or record have the default names ``u[0]``, ``y[0]``.

    Raises
    ------
    control.ControlDimension
        If a name is missing in the record, or the numbers of channels differ.
    """
    notes: list[str] = []
    driven = not isinstance(data, Measurement) or data.n_inputs > 0
    inputs = _places("input", model, data, notes) if driven else tuple(range(model.n_inputs))
    outputs = _places("output", model, data, notes)
    return Channels(inputs, outputs, tuple(notes), () if driven else tuple(model.input_labels))


def _places(
    what: str, model: LinearModel, data: Measurement | FrequencyResponse, notes: list[str]
) -> tuple[int, ...]:
    """Return the rows of a record for the inputs or outputs of a model.

    Outputs may be missing in the record, inputs not.
    """
    wanted, present = (list(getattr(one, f"{what}_labels")) for one in (model, data))
    missing = [name for name in wanted if name not in present]
    by_position = any(map(_DEFAULT.fullmatch, [*wanted, *present]))
    if not missing or (what == "output" and len(missing) < len(wanted) and not by_position):
        notes += _about_order(what, model.name, wanted, present)
        return tuple(present.index(name) if name in present else -1 for name in wanted)
    if by_position and len(wanted) == len(present):
        return tuple(range(len(wanted)))
    if by_position:
        raise ct.ControlDimension(
            f"model {model.name!r} has {len(wanted)} {what}(s) ({', '.join(wanted)}) and record "
            f"{data.name!r} {len(present)} ({', '.join(present)}); name both alike, or give as many"
        )
    raise ct.ControlDimension(
        f"record {data.name!r} has no {what} {', '.join(map(repr, missing))} of model {model.name!r}; it has "
        f"{', '.join(map(repr, present))}. Name them alike: Measurement(..., {what}_labels=[...]) or "
        f"control.ss(..., {what}s=[...])"
    )


def _about_order(what: str, model: str, wanted: Sequence[str], present: Sequence[str]) -> list[str]:
    """Return notes on the channels of a model that a record holds otherwise."""
    found, inside = (
        [name for name in one if name in other] for one, other in ((wanted, present), (present, wanted))
    )
    told = {
        f"{what}s of {model!r} were reordered by name": found if found != inside else [],
        "not measured, so not compared": [name for name in wanted if name not in present],
        f"{what}s of the record that {model!r} does not have": [x for x in present if x not in wanted],
    }
    return [f"{said}: {', '.join(names)}" for said, names in told.items() if names]


def record_for(data: Measurement, channels: Channels) -> Measurement:
    """Return the record in the order of the model's channels.

    Unmeasured outputs of the model are left out.
    """
    data, rows = resting_inputs(data, channels.at_rest), list(channels.inputs)
    columns = [place for place in channels.outputs if place >= 0]
    return _selected(data, rows, columns)


def resting_inputs(data: Measurement, labels: Sequence[str]) -> Measurement:
    """Return the record of a free decay with zero inputs of given names."""
    if data.n_inputs or not labels:
        return data
    return data._changed(
        inputs=np.zeros((len(labels), data.n_samples)),
        input_labels=list(labels),
        input_units=[""] * len(labels),
        origin=np.concatenate([np.zeros(len(labels)), data.origin]),
    )


def aligned(model: LinearModel, channels: Channels, data: Measurement, outputs: Sequence[int]) -> LinearModel:
    """Return the model with the record's channels, in the record's order.

    The model gets the record's inputs and the compared outputs. An input of the record that the model does
    not have gets a column of zeros.
    """
    B = np.zeros((model.n_states, data.n_inputs))
    rows = [channels.outputs.index(place) for place in outputs]
    D = np.zeros((len(rows), data.n_inputs))
    for index, place in enumerate(channels.inputs):
        B[:, place] = model.B[:, index]
        D[:, place] = model.D[rows, index]
    return model.with_arrays(
        B=B,
        C=model.C[rows],
        D=D,
        input_labels=data.input_labels,
        output_labels=tuple(data.output_labels[place] for place in outputs),
    )


def _selected(data: Measurement, inputs: Sequence[int], outputs: Sequence[int]) -> Measurement:
    if list(inputs) == list(range(data.n_inputs)) and list(outputs) == list(range(data.n_outputs)):
        return data
    return data._changed(
        inputs=data.inputs[list(inputs)],
        outputs=data.outputs[list(outputs)],
        input_labels=[data.input_labels[i] for i in inputs],
        output_labels=[data.output_labels[i] for i in outputs],
        input_units=[data.input_units[i] for i in inputs],
        output_units=[data.output_units[i] for i in outputs],
        origin=data.origin[[*inputs, *(data.n_inputs + i for i in outputs)]],
    )


def with_outputs(data: Measurement, outputs: Sequence[int]) -> Measurement:
    """The record with some of its outputs, all of its inputs."""
    return _selected(data, range(data.n_inputs), outputs)
