"""Controller of a model, and records in the terms of its loop."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import control as ct
import numpy as np

from ..arguments import as_array, as_number
from ..data.measurement import Measurement
from ..data.signals import check_whole
from ..effects.channels import InputDelay, InputRange, InputSaturation
from ..effects.effect import Effect
from ..exceptions import ModelError
from ..systems.discretization import discretize
from ..systems.linear import Array, LinearModel

if TYPE_CHECKING:
    from .physical_model import PhysicalModel


HELD = "known"  #: role of effects whose values the controller declares

_DEFAULT = re.compile(r"[uyx]\[\d+\]")


@dataclass(frozen=True, eq=False)
class Controller:
    """Controller with a dead time and limits of its actuator inside the loop.

    The input of the plant is ``u(t) = clip(command(t - delay), low, high)``, and the command is that of the
    controller. A recorded input of the plant is the command, before delay and limits.

    Parameters
    ----------
    system : float, array_like of shape (n_w, n_y), StateSpace or TransferFunction
        Law of the controller. A gain K [input units per output unit] acts at the samples of the record and
        is held: ``command = K (r - y)``. The references r are the inputs of the record that the model does
        not have, one for each output, in order; where the record holds the inputs of the plant, none is
        needed. A system is joined as in `refine`.
    delay : float
        Dead time [s] between the command and the plant, at least 0.
    limits : (low, high) or sequence of such pairs, optional
        Least and largest input of the plant, in its units: one pair for all outputs of the controller, or
        one for each. ``-inf`` and ``inf`` mean no limit.

    Raises
    ------
    control.ControlArgument
        If the system is neither numbers nor a linear system, the delay is negative, or a lower limit is not
        below the upper one.
    control.ControlDimension
        If a gain has more than two dimensions, or limits are no pairs.

    Notes
    -----
    Delay and limits are the effects `input_delay` and `input_saturation` (`input_range` where the two limits
    differ) at the input, with known values. To estimate one of them, leave it out here and give the effect:
    ``refine(model, data, [Effect("input_delay", "u")], controller=Controller(8.0))``.

    Examples
    --------
    >>> import numpy as np, rcorefine as rco
    >>> motor = rco.dc_motor(gain=2.0, time_constant=0.5, inputs="voltage", outputs="speed")
    >>> labels = {"input_labels": "wanted", "output_labels": "speed"}
    >>> blank = rco.Measurement(np.ones(300), np.zeros(300), dt=0.01, **labels)
    >>> loop = rco.Controller(4.0, delay=0.02, limits=(-1.5, 1.5))
    >>> speed = rco.simulate(motor, blank, "zero", controller=loop).outputs[0]
    >>> round(float(speed[-1]), 3)  # 8 / 9
    0.889
    """

    system: Any
    delay: float = 0.0
    limits: Any = None

    def __post_init__(self) -> None:
        system = self.system
        # a gain: a matrix (n_w, n_y)
        if not isinstance(system, (ct.StateSpace, ct.TransferFunction)):
            if not isinstance(system, (float, int, np.number, np.ndarray, list, tuple)):
                raise ct.ControlArgument(
                    f"system must be a gain, a control.StateSpace or a control.TransferFunction, not "
                    f"{type(system).__name__}"
                )
            system = np.atleast_2d(as_array(system, "system", error=ct.ControlArgument))
            if system.ndim > 2 or not system.size:
                raise ct.ControlDimension(
                    f"system has the shape {system.shape}; a gain is a number, or has a row for each input "
                    "of the model and a column for each output"
                )
            system.setflags(write=False)
        object.__setattr__(self, "system", system)
        object.__setattr__(self, "delay", as_number(self.delay, "delay", least=0.0, what="a time in seconds"))
        # limits: one pair, or one for each input
        if self.limits is not None:
            limits = np.atleast_2d(as_array(self.limits, "limits", finite=False, error=ct.ControlArgument))
            if limits.ndim > 2 or limits.shape[1] != 2:
                raise ct.ControlDimension(
                    f"limits have the shape {limits.shape}; give (low, high), or such a pair for each input"
                )
            if not (limits[:, 0] < limits[:, 1]).all():
                raise ct.ControlArgument(f"limits = {limits.tolist()}: each low must be below its high")
            object.__setattr__(self, "limits", tuple(map(tuple, limits.tolist())))

    def _effects(self, places: Sequence[str]) -> tuple[Effect, ...]:
        """Return delay and limits at the driven inputs, as known effects."""
        # delay first, then the limits
        found = [
            Effect(InputDelay.name, place, fixed={"delay": self.delay}) for place in places if self.delay
        ]
        limits = self.limits or ()
        if len(limits) not in (0, 1, len(places)):
            raise ct.ControlDimension(
                f"limits has {len(limits)} pairs for {len(places)} inputs ({', '.join(places)}); give one "
                "for all of them, or one for each"
            )
        each = limits * len(places) if len(limits) == 1 else limits
        for place, (low, high) in zip(places if each else (), each, strict=True):
            # symmetric limits are a saturation, others a range
            if low == -high:
                found.append(Effect(InputSaturation.name, place, fixed={"limit": high}))
            else:
                found.append(Effect(InputRange.name, place, fixed={"low": low, "high": high}))
        return tuple(found)


@dataclass(frozen=True, slots=True, eq=False)
class JoinedController:
    """Linear controller, joined to a model.

    It computes inputs of the model from outputs of the model and from recorded references.

    Parameters
    ----------
    linear : LinearModel
        ``u = K [outputs and references]``, its own signs inside.
    fed : tuple of int
        For each of its inputs the output of the model that it reads, -1 for a reference.
    driven : tuple of int
        For each of its outputs the input of the model that it drives.
    effects : tuple of Effect
        Delay and limits between it and the model, with known values.
    recorded : bool
        Whether the records hold what it drives: what it begins with is then no unknown.
    """

    linear: LinearModel
    fed: tuple[int, ...]
    driven: tuple[int, ...]
    effects: tuple[Effect, ...] = ()
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
        # sampled controller: its matrices as they are
        A, B, C, D = (getattr(self.linear, key) for key in "ABCD")
        own = self.linear.dt
        if self.sampled:
            if own not in (None, True) and not np.isclose(float(own), dt, rtol=1e-9):
                raise ModelError(
                    f"controller {self.linear.name!r} has dt = {own:g} s and the record {dt:g} s; give it at "
                    "the sampling time of the record (a continuous one for .sample(dt)), or the record at its"
                )
            return A, B, C, D
        # continuous controller: first-order hold of its inputs
        Phi, G0, G1 = discretize(A, B, dt, "foh")
        return Phi, G0 + Phi @ G1, C, D + C @ G1

    def fed_back(self, dt: float, n_outputs: int) -> tuple[Array, Array, Array, Array]:
        """A, B, C, D from all outputs of the model alone, references left out."""
        A, B, C, D = self.at(dt)
        # columns of the outputs that it reads
        pick = self.reads(n_outputs)
        return A, B @ pick, C, D @ pick

    def reads(self, n_outputs: int) -> Array:
        """Its inputs by the outputs of the model."""
        pick = np.zeros((len(self.fed), n_outputs))
        # an input that no output of the model feeds is a reference
        for row, output in enumerate(self.fed):
            if output >= 0:
                pick[row, output] = 1.0
        return pick


def as_controller(given: Any, model: LinearModel, records: Sequence[Any]) -> JoinedController:
    """Return the user's controller with its signals matched to the model.

    Signals are matched by name, otherwise by position.

    Parameters
    ----------
    given : Controller, StateSpace or TransferFunction
        Controller. Inputs that bear names of the model's outputs read them, others are references of the
        record; outputs bear names of the model's inputs (as `control.interconnect` joins them, no sign
        added). Without any names it is taken as in ``control.feedback(model, given)``: all outputs in
        order, negative feedback.
    model : LinearModel
        What it acts on.
    records : sequence of Measurement
        Records, which name the references of a gain.

    Raises
    ------
    control.ControlArgument
        If it is no linear system.
    control.ControlDimension
        If signals do not fit.
    ModelError
        If there is an algebraic loop.
    """
    if not isinstance(given, (Controller, ct.StateSpace, ct.TransferFunction)):
        raise ct.ControlArgument(
            f"controller must be a control.StateSpace from outputs to inputs of the model, or a Controller, "
            f"not {type(given).__name__}; a gain is rcorefine.Controller(K)"
        )
    known = given if isinstance(given, Controller) else Controller(given)
    system = known.system
    linear = LinearModel.from_statespace(
        _of_gain(system, model, records) if isinstance(system, np.ndarray) else system
    )
    # without names: as in control.feedback(model, controller), with a minus sign
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
        controller = JoinedController(linear, tuple(range(len(inputs))), tuple(range(len(outputs))))
    else:
        # with names: outputs drive inputs of the model, inputs read its outputs or are references
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
        controller = JoinedController(
            linear, fed, tuple(model.input_labels.index(label) for label in outputs)
        )
    # algebraic loop: D_controller D_model is not zero
    if (linear.D @ controller.reads(model.n_outputs) @ model.D[:, list(controller.driven)]).any():
        raise ModelError(
            f"controller {linear.name!r} answers at once to an output that its own input reaches at once: an "
            "algebraic loop. A sampled controller acts one sample after what it measured: put the delay in it"
        )
    return replace(controller, effects=known._effects([model.input_labels[i] for i in controller.driven]))


def _of_gain(gain: Array, model: LinearModel, records: Sequence[Any]) -> ct.StateSpace:
    """Return a gain as a system, with the references that the records hold."""
    if gain.shape != (model.n_inputs, model.n_outputs):
        raise ct.ControlDimension(
            f"the gain of the controller has the shape {gain.shape}, and model {model.name!r} has "
            f"{model.n_inputs} input(s) and {model.n_outputs} output(s); name the signals of a "
            "control.StateSpace to use some of them"
        )
    # the record holds the inputs: no reference is needed
    if not any(unrecorded(range(model.n_inputs), model, record) for record in records):
        return ct.ss([], [], [], gain)
    references = [label for label in records[0].input_labels if label not in model.input_labels]
    if len(references) != model.n_outputs:
        raise ct.ControlDimension(
            f"record {records[0].name!r} holds the inputs {', '.join(records[0].input_labels)}; a gain takes "
            f"{', '.join(model.input_labels)}, or one reference for each of {', '.join(model.output_labels)}"
        )
    # command = K (r - y)
    return ct.ss(
        [], [], [], np.hstack([gain, -gain]), inputs=[*references, *model.output_labels],
        outputs=list(model.input_labels),
    )  # fmt: skip


def held_effects(model: PhysicalModel | None) -> tuple[Effect, ...]:
    """Return the effects between the controller of a model and the model."""
    return () if model is None or model.controller is None else model.controller.effects


def unrecorded(driven: Sequence[int], model: LinearModel, data: Any) -> list[str]:
    """Return those of some inputs of the model that a record does not hold."""
    if not isinstance(data, Measurement):
        return []
    # default labels are matched by position
    if all(_DEFAULT.fullmatch(q) for q in data.input_labels) and data.n_inputs == model.n_inputs:
        return []  # by position
    return [label for label in (model.input_labels[i] for i in driven) if label not in data.input_labels]


def answer(
    controller: JoinedController, model: LinearModel, data: Measurement
) -> tuple[Array | None, list[str]]:
    """Return the controller's outputs (n_u, N) for a record, or None.

    The controller starts at zero. The second value lists the signals that the record lacks.
    """
    # signals as recorded, with their means
    signals = np.vstack([data.inputs, data.outputs]) + data.origin[:, None]
    labels = [*data.input_labels, *data.output_labels]
    if data.n_outputs == model.n_outputs and all(_DEFAULT.fullmatch(q) for q in data.output_labels):
        labels[data.n_inputs :] = model.output_labels
    names = [
        model.output_labels[i] if i >= 0 else name
        for i, name in zip(controller.fed, controller.linear.input_labels, strict=True)
    ]
    missing = [name for name in names if name not in labels]
    # the controller read a signal that is not in the record
    if missing:
        return None, missing
    A, B, C, D = controller.at(data.dt)
    read = signals[[labels.index(name) for name in names]]
    if np.isnan(read).any():
        check_whole(data, f"controller {controller.linear.name!r}, whose command is not recorded,")
    # simulate the controller: u(k) = C x(k) + D r(k), x(k+1) = A x(k) + B r(k)
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
    lacking = [] if controller is None else unrecorded(controller.driven, linear, data)
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
    # add the commands that the record lacks
    rows = [i for i, where in enumerate(controller.driven) if linear.input_labels[where] in lacking]
    # a continuous controller's command runs between the samples
    straight = not controller.sampled and data.hold == "zoh"
    return data._changed(
        inputs=np.vstack([data.inputs, given[rows]]),
        input_labels=[*data.input_labels, *(linear.input_labels[controller.driven[i]] for i in rows)],
        input_units=[*data.input_units, *[""] * len(rows)],
        origin=np.insert(data.origin, data.n_inputs, np.zeros(len(rows))),
        hold="foh" if straight else data.hold,
    )
