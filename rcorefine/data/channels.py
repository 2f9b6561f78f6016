"""Assignment of record channels to model channels.

Channels are matched by name, otherwise by position.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass

import control as ct
import numpy as np

from ..systems.linear import LinearModel
from .frequency_response import FrequencyResponse
from .measurement import Measurement

__all__ = ["Channels", "aligned", "match_channels", "record_for", "resting_inputs", "with_outputs"]

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
    inputs = (
        tuple(range(model.n_inputs))
        if not driven
        else _places(
            "input", model.input_labels, data.input_labels, model.name, data.name, notes, partly=False
        )
    )
    outputs = _places(
        "output", model.output_labels, data.output_labels, model.name, data.name, notes, partly=True
    )
    return Channels(inputs, outputs, tuple(notes), () if driven else tuple(model.input_labels))


def _places(
    what: str,
    wanted: Sequence[str],
    present: Sequence[str],
    model: str,
    record: str,
    notes: list[str],
    *,
    partly: bool,
) -> tuple[int, ...]:
    found = [name for name in wanted if name in present]
    by_position = any(_DEFAULT.fullmatch(name) for name in [*wanted, *present])
    if len(found) == len(wanted) or (partly and found and not by_position):
        places = tuple(present.index(name) if name in present else -1 for name in wanted)
        kept = [place for place in places if place >= 0]
        if kept != sorted(kept):
            notes.append(f"{what}s of {model!r} were reordered by name: {', '.join(found)}")
        if len(found) < len(wanted):
            notes.append(f"not measured, so not compared: {', '.join(n for n in wanted if n not in present)}")
        if len(kept) < len(present):
            left = ", ".join(name for name in present if name not in wanted)
            notes.append(f"{what}s of the record that {model!r} does not have: {left}")
        return places
    if by_position:
        if len(wanted) != len(present):
            raise ct.ControlDimension(
                f"model {model!r} has {len(wanted)} {what}(s) ({', '.join(wanted)}) and record {record!r} "
                f"{len(present)} ({', '.join(present)}); name both alike, or give as many"
            )
        return tuple(range(len(wanted)))
    missing = ", ".join(repr(name) for name in wanted if name not in present)
    raise ct.ControlDimension(
        f"record {record!r} has no {what} {missing} of model {model!r}; it has "
        f"{', '.join(map(repr, present))}. Name them alike: Measurement(..., {what}_labels=[...]) or "
        f"control.ss(..., {what}s=[...])"
    )


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
