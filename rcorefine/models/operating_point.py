"""Operating point of a model, and records in its terms."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import control as ct
import numpy as np

from ..arguments import as_mapping, as_number, as_state, as_vector
from ..data.response_record import ordered
from ..effects.right_hand_side import Field
from ..exceptions import ModelError
from ..systems.linear import Array, LinearModel
from .controller import completed

if TYPE_CHECKING:
    from .physical_model import PhysicalModel


@dataclass(frozen=True, slots=True, eq=False)
class OperatingPoint:
    """Operating point about which a model holds.

    The matrices of the model describe deviations from it.

    Parameters
    ----------
    inputs, states, outputs : ndarray
        In the order and the units of the model's signals, shapes (n_w,), (n,), (n_y,).
    field : Field, optional
        What the linear model leaves out of a nonlinear one. Without it the plant rests at the point:
        what an effect gives there is in the point already, and only the rest of it is added.
    """

    inputs: Array
    states: Array
    outputs: Array
    field: Field | None = None

    @property
    def parameters(self) -> tuple[str, ...]:
        """Names of the numbers in the right-hand side of a nonlinear model."""
        return () if self.field is None else self.field.functions.names


def as_operating_point(given: Any, linear: LinearModel) -> OperatingPoint:
    """Return the operating point that a user gave in order or by signal name.

    Raises
    ------
    ModelError
        If a name is no signal of the model, a size does not fit, or inputs or states are missing.
    control.ControlArgument
        If a value is no finite number.
    """
    # parts: inputs, states, outputs
    parts = dict(as_mapping(given, "operating_point", "values"))
    labels = {"inputs": linear.input_labels, "states": linear.state_labels, "outputs": linear.output_labels}
    for key in parts:
        if key not in labels:
            raise ModelError(f"operating_point names {key!r}; it has 'inputs', 'states' and 'outputs'")
    for key in ("inputs", "states"):
        if key not in parts and labels[key]:
            raise ModelError(f"operating_point lacks {key!r}: {', '.join(labels[key])}")
    inputs, states = (_values(key, parts.get(key, ()), labels[key]) for key in ("inputs", "states"))
    # outputs of the linear model at the point, unless given
    outputs = linear.C @ states + linear.D @ inputs
    if "outputs" in parts:
        outputs = _values("outputs", parts["outputs"], labels["outputs"])
    return OperatingPoint(inputs, states, outputs)


def _values(what: str, given: Any, labels: Sequence[str]) -> Array:
    name = f"{what} of operating_point"
    # numbers in order, or by name
    if not isinstance(given, Mapping):
        return as_vector(given, name, len(labels)) if labels else np.zeros(0)
    for label in given:
        if label not in labels:
            raise ModelError(f"{name} names {label!r}; there are {', '.join(labels)}")
    missing = [label for label in labels if label not in given]
    if missing:
        raise ModelError(f"{name} lacks {', '.join(missing)}")
    return np.array([as_number(given[label], f"{label!r} in {name}") for label in labels])


def refuse_point(model: PhysicalModel, what: str) -> PhysicalModel:
    """Return the model if it has no operating point and no controller.

    `what` supports neither of them.

    Raises
    ------
    ModelError
        If it does.
    """
    if model.controller is not None:
        raise ModelError(
            f"{what} takes no controller yet: give it the model alone, the .system of what was found"
        )
    if model.operating_point is not None and model.operating_point.field is not None:
        raise ModelError(
            f"{what} takes no nonlinear model yet: give it a linearization, the .system of "
            "physical(system, operating_point=...), or Refinement.linearize(states, inputs)"
        )
    if model.operating_point is not None:
        raise ModelError(
            f"{what} takes no operating point yet: leave it out of physical(...) and give what the signals "
            "have above it, Measurement.deviation(); laws then see that too, not absolute values"
        )
    return model


def ordered_record(model: PhysicalModel, data: Any) -> Any:
    """Return the record in the model's order, relative to the operating point.

    A frequency response becomes a record of its points.
    """
    # time record: channels in the order of the model
    record = ordered(completed(model, data), model.linear)
    point = model.operating_point
    if point is None:
        return record
    known = [record.output_labels[i] for i in range(record.n_outputs)]
    outputs = point.outputs
    if len(known) < outputs.size:  # some outputs were not measured
        outputs = outputs[[model.linear.output_labels.index(label) for label in known]]
    # deviations from the operating point
    return record.deviation(point.inputs, outputs)


def start_above(model: PhysicalModel, x0: Any) -> Array | None:
    """Return the user's initial state relative to the operating point.

    None means that the initial state is estimated.
    """
    start = as_state(x0, model.linear.n_states)
    # zero and an estimate are deviations already
    if start is None or isinstance(x0, str) or model.operating_point is None:
        return start
    return start - model.operating_point.states


def sensed(model: PhysicalModel, place: str, states: Array, inputs: Array) -> tuple[Array, Array]:
    """Return the absolute displacement and velocity (N,) at a port.

    `states` and `inputs` are deviations from the operating point.
    """
    port, point = model.port(place), model.operating_point
    # a port senses absolute values
    x = states[: port.act.size]
    if point is not None:
        x, inputs = x + point.states[:, None], inputs + point.inputs[:, None]
    return port.position @ x + port.position_input @ inputs, port.velocity @ x + port.velocity_input @ inputs


def check_stream_hold(model: PhysicalModel, hold: str) -> None:
    """Check that a stream is held as the model was found to take its inputs.

    Parameters
    ----------
    model : PhysicalModel
        Model.
    hold : str
        Hold of the stream.

    Raises
    ------
    ModelError
        If the model has a hold of its own that is another one, or an operating point.
    """
    refuse_point(model, "a stream")
    if model.hold not in (None, hold):
        raise ModelError(
            f"model {model.name!r} was found to take its inputs with hold={model.hold!r}, and the stream has "
            f"hold={hold!r}; give that hold, or a model without one of its own "
            "(dataclasses.replace(physical_model, hold=None)) that was fitted to a record of the stream"
        )


def refuse_discrete(model: Any) -> None:
    """Check that a model, whatever counts as one, is none in discrete time.

    Raises
    ------
    ModelError
        If it is.
    """
    given = getattr(model, "system", model)
    if isinstance(given, ct.StateSpace) and given.dt != 0:
        raise ModelError(
            f"model {given.name!r} is discrete, and physical effects live in continuous time; "
            "give the continuous model, or convert it with rcorefine.d2c"
        )
