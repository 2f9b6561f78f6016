"""Operating point and controller of a model, and records in its terms."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import control as ct
import numpy as np

from ..arguments import as_mapping, as_number, as_state, as_vector
from ..data.channels import match_channels, record_for
from ..data.measurement import Measurement
from ..data.response_record import ResponseRecord, in_frequency
from ..effects.right_hand_side import Field
from ..exceptions import ModelError
from ..systems.discretization import discretize
from ..systems.linear import Array, LinearModel

if TYPE_CHECKING:
    from .physical_model import PhysicalModel


_DEFAULT = re.compile(r"[uyx]\[\d+\]")


@dataclass(frozen=True, slots=True, eq=False)
class Controller:
    """Linear controller of a model.

    It computes inputs of the model from outputs of the model and from recorded references.

    Parameters
    ----------
    linear : LinearModel
        ``u = K [outputs and references]``, its own signs inside.
    fed : tuple of int
        For each of its inputs the output of the model that it reads, -1 for a reference.
    driven : tuple of int
        For each of its outputs the input of the model that it drives.
    recorded : bool
        Whether the records hold what it drives: what it begins with is then no unknown.
    """

    linear: LinearModel
    fed: tuple[int, ...]
    driven: tuple[int, ...]
    recorded: bool = True

    @property
    def n_states(self) -> int:
        """States in a loop: its own, then what each output holds over a sample."""
        return self.linear.n_states + len(self.driven)

    @property
    def sampled(self) -> bool:
        """Return whether the controller acts at samples and holds its outputs."""
        return not self.linear.is_continuous

    def at(self, dt: float) -> tuple[Array, Array, Array, Array]:
        """Return the discrete-time matrices A, B, C, D for one sample.

        The inputs of a continuous-time controller are taken as linear between samples.

        Raises
        ------
        ModelError
            If its sampling time is another one.
        """
        A, B, C, D = (getattr(self.linear, key) for key in "ABCD")
        own = self.linear.dt
        if self.sampled:
            if own not in (None, True) and not np.isclose(float(own), dt, rtol=1e-9):
                raise ModelError(
                    f"controller {self.linear.name!r} has dt = {own:g} s and the record {dt:g} s; give it at "
                    "the sampling time of the record (a continuous one for .sample(dt)), or the record at its"
                )
            return A, B, C, D
        Phi, G0, G1 = discretize(A, B, dt, "foh")
        return Phi, G0 + Phi @ G1, C, D + C @ G1

    def fed_back(self, dt: float, n_outputs: int) -> tuple[Array, Array, Array, Array]:
        """A, B, C, D from all outputs of the model alone, references left out."""
        A, B, C, D = self.at(dt)
        pick = self.reads(n_outputs)
        return A, B @ pick, C, D @ pick

    def reads(self, n_outputs: int) -> Array:
        """Its inputs by the outputs of the model."""
        pick = np.zeros((len(self.fed), n_outputs))
        for row, output in enumerate(self.fed):
            if output >= 0:
                pick[row, output] = 1.0
        return pick


def as_controller(given: Any, model: LinearModel) -> Controller:
    """Return the user's controller with its signals matched to the model.

    Signals are matched by name, otherwise by position.

    Parameters
    ----------
    given : StateSpace or TransferFunction
        Controller. Inputs that bear names of the model's outputs read them, others are references of the
        record; outputs bear names of the model's inputs (as `control.interconnect` joins them, no sign
        added). Without any names it is taken as in ``control.feedback(model, given)``: all outputs in
        order, negative feedback.
    model : LinearModel
        What it acts on.

    Raises
    ------
    control.ControlArgument
        If it is no linear system.
    control.ControlDimension
        If signals do not fit.
    ModelError
        If there is an algebraic loop.
    """
    if not isinstance(given, (ct.StateSpace, ct.TransferFunction)):
        raise ct.ControlArgument(
            f"controller must be a control.StateSpace from outputs to inputs of the model, not "
            f"{type(given).__name__}; a gain is control.ss([], [], [], K, dt)"
        )
    linear = LinearModel.from_statespace(given)
    inputs, outputs = linear.input_labels, linear.output_labels
    if all(_DEFAULT.fullmatch(label) for label in (*inputs, *outputs)) and not (
        set(outputs) <= set(model.input_labels)
    ):
        if (len(inputs), len(outputs)) != (model.n_outputs, model.n_inputs):
            raise ct.ControlDimension(
                f"controller {linear.name!r} has {len(inputs)} unnamed input(s) and {len(outputs)} output(s)"
                f", and model {model.name!r} {model.n_outputs} output(s) and {model.n_inputs} input(s); name "
                "them: control.ss(..., inputs=[outputs of the model, references], outputs=[its inputs])"
            )
        linear = linear.with_arrays(B=-linear.B, D=-linear.D)
        controller = Controller(linear, tuple(range(len(inputs))), tuple(range(len(outputs))))
    else:
        strange = [label for label in outputs if label not in model.input_labels]
        if strange or len(set(outputs)) < len(outputs):
            raise ct.ControlDimension(
                f"controller {linear.name!r} drives {', '.join(strange or outputs)}; model {model.name!r} "
                f"has the inputs {', '.join(model.input_labels)}. Name the outputs of the controller as these"
            )
        fed = tuple(model.output_labels.index(q) if q in model.output_labels else -1 for q in inputs)
        if max(fed, default=-1) < 0:
            raise ct.ControlDimension(
                f"controller {linear.name!r} reads {', '.join(inputs) or 'nothing'}, and no output of model "
                f"{model.name!r} ({', '.join(model.output_labels)}). Name what it is fed as these"
            )
        controller = Controller(linear, fed, tuple(model.input_labels.index(label) for label in outputs))
    if (linear.D @ controller.reads(model.n_outputs) @ model.D[:, list(controller.driven)]).any():
        raise ModelError(
            f"controller {linear.name!r} answers at once to an output that its own input reaches at once: an "
            "algebraic loop. A sampled controller acts one sample after what it measured: put the delay in it"
        )
    return controller


def unrecorded(controller: Controller, model: LinearModel, data: Any) -> list[str]:
    """Inputs that it drives and that a record does not hold."""
    if not isinstance(data, Measurement):
        return []
    if all(_DEFAULT.fullmatch(q) for q in data.input_labels) and data.n_inputs == model.n_inputs:
        return []  # by position
    driven = [model.input_labels[i] for i in controller.driven]
    return [label for label in driven if label not in data.input_labels]


def answer(controller: Controller, model: LinearModel, data: Measurement) -> tuple[Array | None, list[str]]:
    """Return the controller's outputs (n_u, N) for a record, or None.

    The controller starts at zero. The second value lists the signals that the record lacks.
    """
    signals = np.vstack([data.inputs, data.outputs]) + data.origin[:, None]
    labels = [*data.input_labels, *data.output_labels]
    if data.n_outputs == model.n_outputs and all(_DEFAULT.fullmatch(q) for q in data.output_labels):
        labels[data.n_inputs :] = model.output_labels
    names = [
        model.output_labels[i] if i >= 0 else name
        for i, name in zip(controller.fed, controller.linear.input_labels, strict=True)
    ]
    missing = [name for name in names if name not in labels]
    if missing:
        return None, missing
    A, B, C, D = controller.at(data.dt)
    read = signals[[labels.index(name) for name in names]]
    given, pushed, x = D @ read, B @ read, np.zeros(A.shape[0])
    for k in range(data.n_samples):
        given[:, k] += C @ x
        x = A @ x + pushed[:, k]
    if not np.isfinite(given).all():
        raise ModelError(f"what controller {controller.linear.name!r} makes of the record leaves all bounds")
    return given, []


def completed(model: PhysicalModel, data: Measurement) -> Measurement:
    """Return the record with the unrecorded outputs of the controller added.

    The initial state of the controller is unknown and set to zero here. The closed loop has its own one.

    Raises
    ------
    control.ControlDimension
        If the record holds neither an input nor what the controller made it from.
    """
    controller, linear = model.controller, model.linear
    lacking = [] if controller is None else unrecorded(controller, linear, data)
    if controller is None or not lacking:
        return data
    given, missing = answer(controller, linear, data)
    if given is None:
        raise ct.ControlDimension(
            f"record {data.name!r} holds neither {', '.join(lacking)}, which controller "
            f"{controller.linear.name!r} drives, nor {', '.join(missing)}, which it reads; it has "
            f"{', '.join((*data.input_labels, *data.output_labels))}. Name the reference as the controller "
            "does, or give the input as recorded"
        )
    rows = [i for i, where in enumerate(controller.driven) if linear.input_labels[where] in lacking]
    straight = not controller.sampled and data.hold == "zoh"
    return data._changed(
        inputs=np.vstack([data.inputs, given[rows]]),
        input_labels=[*data.input_labels, *(linear.input_labels[controller.driven[i]] for i in rows)],
        input_units=[*data.input_units, *[""] * len(rows)],
        origin=np.insert(data.origin, data.n_inputs, np.zeros(len(rows))),
        hold="foh" if straight else data.hold,
    )


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
    parts = dict(as_mapping(given, "operating_point", "values"))
    labels = {"inputs": linear.input_labels, "states": linear.state_labels, "outputs": linear.output_labels}
    for key in parts:
        if key not in labels:
            raise ModelError(f"operating_point names {key!r}; it has 'inputs', 'states' and 'outputs'")
    for key in ("inputs", "states"):
        if key not in parts and labels[key]:
            raise ModelError(f"operating_point lacks {key!r}: {', '.join(labels[key])}")
    inputs, states = (_values(key, parts.get(key, ()), labels[key]) for key in ("inputs", "states"))
    outputs = linear.C @ states + linear.D @ inputs
    if "outputs" in parts:
        outputs = _values("outputs", parts["outputs"], labels["outputs"])
    return OperatingPoint(inputs, states, outputs)


def _values(what: str, given: Any, labels: Sequence[str]) -> Array:
    name = f"{what} of operating_point"
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
    if in_frequency(data):
        return data if isinstance(data, ResponseRecord) else ResponseRecord.of(data, model.linear)
    data = completed(model, data)
    record = record_for(data, match_channels(model.linear, data))
    point = model.operating_point
    if point is None:
        return record
    known = [record.output_labels[i] for i in range(record.n_outputs)]
    outputs = point.outputs
    if len(known) < outputs.size:  # some were not measured
        outputs = outputs[[model.linear.output_labels.index(label) for label in known]]
    return record.deviation(point.inputs, outputs)


def start_above(model: PhysicalModel, x0: Any) -> Array | None:
    """Return the user's initial state relative to the operating point.

    None means that the initial state is estimated.
    """
    start = as_state(x0, model.linear.n_states)
    if start is None or isinstance(x0, str) or model.operating_point is None:
        return start
    return start - model.operating_point.states


def sensed(model: PhysicalModel, place: str, states: Array, inputs: Array) -> tuple[Array, Array]:
    """Return the absolute displacement and velocity (N,) at a port.

    `states` and `inputs` are deviations from the operating point.
    """
    port, point = model.port(place), model.operating_point
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
