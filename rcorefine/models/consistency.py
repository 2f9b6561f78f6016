"""Consistency checks of the parts of a physical model."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, Any

import control as ct
import numpy as np

from ..arguments import as_array, as_instance, as_list, as_texts, shown
from ..exceptions import ModelError
from .controller import Controller
from .operating_point import OperatingPoint, refuse_point
from .ports import Port

if TYPE_CHECKING:
    from .physical_model import PhysicalModel

__all__ = ["check_outputs", "check_places", "check_sizes", "check_stream_hold", "refuse_discrete"]


def check_sizes(model: PhysicalModel) -> None:
    """Bring arrays and units of a model under construction into shape.

    Parameters
    ----------
    model : PhysicalModel
        Model whose fields are as they were given.

    Raises
    ------
    control.ControlDimension
        If a size does not fit the matrices.
    ModelError
        If a name is none for python-control.
    """
    linear, store = model.linear, object.__setattr__
    for name in (linear.name, *linear.input_labels, *linear.output_labels, *linear.state_labels):
        if "." in name:
            raise ModelError(
                f"python-control allows no '.' in a name; {name!r} can be {name.replace('.', '_')!r}"
            )
    shapes = {
        "output_state": (linear.n_outputs, linear.n_states),
        "output_rate": (linear.n_outputs, linear.n_states),
        "output_input": (linear.n_outputs, linear.n_inputs),
    }
    for key, shape in shapes.items():
        array = np.atleast_2d(as_array(getattr(model, key), key, error=ModelError))
        if array.shape != shape:
            raise ct.ControlDimension(f"{key} has shape {array.shape}, expected {shape}")
        array.setflags(write=False)
        store(model, key, array)
    for key, size, what in (
        ("input_units", linear.n_inputs, "inputs"),
        ("output_units", linear.n_outputs, "outputs"),
        ("state_units", linear.n_states, "states"),
    ):
        units = as_texts(getattr(model, key), key) or ("",) * size
        if len(units) != size:
            raise ct.ControlDimension(f"{key} has {len(units)} entries for {size} {what}")
        store(model, key, units)
    for key, kind in (("operating_point", OperatingPoint), ("controller", Controller)):
        if getattr(model, key) is not None:
            as_instance(getattr(model, key), kind, f"{key}, where there is one,")
    store(model, "ports", tuple(as_list(model.ports, "ports", "Port objects")))
    store(model, "parameters", tuple(as_list(model.parameters, "parameters", "nominal parameters")))


def check_outputs(model: PhysicalModel) -> None:
    """Check that the parts of the output add up to C and D.

    Parameters
    ----------
    model : PhysicalModel
        Model to check.

    Raises
    ------
    ModelError
        If they do not.
    """
    linear = model.linear
    for name, key, other, whole, direct, rate in (
        ("C", "output_state", "A", linear.C, model.output_state, model.output_rate @ linear.A),
        ("D", "output_input", "B", linear.D, model.output_input, model.output_rate @ linear.B),
    ):
        scale = np.abs(whole) + np.abs(direct) + np.abs(rate)
        limit = 1e-9 * scale.max(axis=1, keepdims=True, initial=0.0)
        wrong = np.argwhere(np.abs(direct + rate - whole) > limit)
        if wrong.size:
            raise ModelError(
                f"{name} of output {linear.output_labels[wrong[0][0]]!r} is not its row of "
                f"{key} + output_rate @ {other}; the parts must add up"
            )


def check_places(model: PhysicalModel) -> None:
    """Check ports against the matrices, and names for uniqueness.

    Parameters
    ----------
    model : PhysicalModel
        Model to check; ports that were made without inputs get rows of the right length.

    Raises
    ------
    control.ControlDimension
        If a port is for another number of states or inputs.
    ModelError
        If two ports or two parameters have one name.
    """
    linear = model.linear
    ports = []
    for port in model.ports:
        if not isinstance(port, Port):
            raise ct.ControlArgument(f"ports must hold Port, not {type(port).__name__}")
        if port.act.size != linear.n_states:
            raise ct.ControlDimension(
                f"port {port.name!r} is for {port.act.size} states, the model has {linear.n_states}"
            )
        if port.output.size not in (0, linear.n_outputs):
            raise ct.ControlDimension(
                f"output of port {port.name!r} has {port.output.size} entries for {linear.n_outputs} outputs"
            )
        if port.velocity_input.size != linear.n_inputs:
            if port.velocity_input.any() or port.position_input.any() or port.acceleration_input.any():
                raise ct.ControlDimension(
                    f"port {port.name!r} is for {port.velocity_input.size} inputs, "
                    f"the model has {linear.n_inputs}"
                )
            none = np.zeros(linear.n_inputs)
            port = replace(port, position_input=none, velocity_input=none, acceleration_input=none)
        ports.append(port)
    object.__setattr__(model, "ports", tuple(ports))
    for item in model.parameters:
        if not hasattr(item, "kind") or not hasattr(item, "place"):
            raise ct.ControlArgument(f"parameters must hold NominalParameter, not {shown(item)}")
    for what, labels in (
        ("port", [port.name for port in ports]),
        ("parameter", [item.name for item in model.parameters]),
    ):
        twice = sorted({label for label in labels if labels.count(label) > 1})
        if twice:
            raise ModelError(f"{what} names must be unique, but {twice[0]!r} occurs more than once")


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
