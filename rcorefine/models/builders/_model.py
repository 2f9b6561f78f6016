"""Physical model that a builder returns.

It consists of matrices, readout, places and signal names.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from ...arguments import as_text
from ...systems.linear import Array, LinearModel
from ..parameters import NominalParameter
from ..physical_model import PhysicalModel
from ..ports import Port
from ._checks import as_labels

#: Arguments `inputs`, `outputs`, `states` and `name` of a builder, as they were given.
Given = tuple[Any, Any, Any, Any]


def built(
    A: Array,
    B: Array,
    readout: tuple[Array, Array, Array],
    given: Given,
    *,
    labels: tuple[Sequence[str], Sequence[str], Sequence[str]],
    units: tuple[Sequence[str], Sequence[str], Sequence[str]],
    ports: Sequence[Port],
    parameters: Sequence[NominalParameter],
) -> PhysicalModel:
    """Return the physical model of these matrices, places and parameters.

    Its outputs are ``state @ x + rate @ dx/dt + direct @ w``. `labels` are used where the user gave
    none.
    """
    state, rate, direct = readout
    inputs, outputs, states = (
        as_labels(own, what, default)
        for own, what, default in zip(given, ("inputs", "outputs", "states"), labels, strict=False)
    )
    linear = LinearModel(
        A, B, state + rate @ A, direct + rate @ B, 0,
        input_labels=inputs, output_labels=outputs, state_labels=states, name=as_text(given[3], "name"),
    )  # fmt: skip
    return PhysicalModel(
        linear, state, rate, direct, tuple(ports), tuple(parameters),
        input_units=tuple(units[0]), output_units=tuple(units[1]), state_units=tuple(units[2]),
    )  # fmt: skip
