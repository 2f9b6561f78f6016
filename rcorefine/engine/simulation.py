"""Simulation of a model from a given, zero or estimated initial state."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import control as ct
import numpy as np

from ..arguments import as_state
from ..data.channels import match_channels, record_for, resting_inputs
from ..data.measurement import Measurement
from ..data.records import as_record
from ..data.signals import difference, spreads
from ..effects.effect import Effect, as_effects
from ..exceptions import DivergenceError, ModelError
from ..gauss_newton import Rows, gauss_newton, own_sizes
from ..models.controller import Controller, completed, held_effects
from ..models.conversion import as_model, as_physical, known_physical, under_control
from ..results import Data
from ..systems.linear import Array, LinearModel
from .controlled import loop_gain, own_states
from .engine import Engine
from .initial_state import estimate_initial_state
from .inputs import interpolate_band_limited, straight_lines
from .linear import recursion, unit_responses
from .observer import leading_gain
from .structure import Structure

_TRUE = 16  # substeps of a sample where effects of known size act
_STILL, _MOST_STEPS = 1e-3, 64  # relative change by doubled substeps below which they suffice; most substeps


@dataclass(frozen=True, slots=True, eq=False)
class Simulation(Data):
    """A model on a record.

    Attributes
    ----------
    outputs : ndarray, shape (n_y, N)
        Free-run outputs in the units of the record.
    states : ndarray, shape (n, N)
        States at the samples.
    forces : ndarray, shape (m, N)
        Resisting forces of the nonlinear effects at their ports.
    x0 : ndarray, shape (n,)
        Initial state used.
    """

    outputs: Array
    states: Array
    forces: Array
    x0: Array


def structure_of(model: Any) -> tuple[Structure, Array, int]:
    """Structure, coefficients and substeps of anything that counts as a model.

    Parameters
    ----------
    model : StateSpace, PhysicalModel or Refinement
        Model in continuous time.

    Returns
    -------
    structure : Structure
    theta : ndarray, shape (p,)
    substeps : int
    """
    known = getattr(model, "simulation_structure", None)
    if known is not None:
        structure, theta, substeps = known()
        return structure, theta, substeps
    physical = as_physical(model)
    return Structure(physical, held_effects(physical)), np.zeros(0), 1


def simulate(
    model: Any,
    data: Measurement,
    x0: str | Array = "estimate",
    *,
    effects: Sequence[Effect] = (),
    controller: Controller | ct.StateSpace | None = None,
) -> Simulation:
    """Free run of a model over a record.

    Parameters
    ----------
    model : StateSpace, PhysicalModel or Refinement
        Continuous, or discrete with the sampling time of the record.
    data : Measurement
        Inputs, and the outputs from which the initial state is estimated. In a free decay without inputs
        those of the model are zero.
    x0 : {"estimate", "zero"} or ndarray of shape (n,)
        Initial state.
    effects : sequence of Effect
        Effects that act besides, each with all its coefficients in `Effect.fixed`: simulate a plant that does
        what its model does not. The sign of a velocity is smoothed over the ``"width"`` in `Effect.fixed`, by
        default a small share of the motion without the effects.
    controller : Controller, StateSpace or TransferFunction, optional
        As in `refine`: simulate the model in the loop of this controller. Driven by a reference from
        x0 = "zero" the result hangs on no output of the record.

    Returns
    -------
    Simulation
        Outputs, states, forces and the initial state.

    Raises
    ------
    control.ControlDimension
        If channels or `x0` do not fit.
    ModelError
        If the timebase of a discrete model is not that of the record, or an effect cannot act on the model.
    DivergenceError
        If the free run leaves all bounds.

    Examples
    --------
    >>> import numpy as np, control as ct, rcorefine as rco
    >>> lag = ct.ss([[-1.0]], [[1.0]], [[1.0]], [[0.0]])
    >>> data = rco.Measurement(np.ones(50), 1 - np.exp(-0.1 * np.arange(50)), dt=0.1)
    >>> bool(np.allclose(simulate(lag, data, "zero").outputs, data.outputs))
    True
    >>> chain = rco.mass_spring_damper([1.0], [0.4], [100.0], sensors="displacement")
    >>> friction = rco.Effect("coulomb_friction", "link1", fixed={"force": 0.5})
    >>> blank = rco.Measurement(np.sin(np.arange(500.0)), np.zeros(500), dt=0.02)
    >>> y = simulate(chain, blank, "zero", effects=[friction]).outputs
    >>> bool(np.std(y) < np.std(simulate(chain, blank, "zero").outputs))
    True
    """
    controlled, effects = under_control(model, controller, as_record(data)), as_effects(effects, "effects")
    try:
        return simulated(controlled, data, x0, effects=effects)
    except np.linalg.LinAlgError as error:
        raise ModelError(
            f"the effects leave a state without inertia: {error}; give smaller values"
        ) from error


def simulated(
    model: Any, data: Measurement, x0: str | Array, *, led: bool = False, effects: Sequence[Effect] = ()
) -> Simulation:
    """Simulate as `simulate` does, if needed with an observer.

    With `led`, an observer corrects an unstable model, which has no free run.
    """
    model = as_model(model)
    inner = getattr(model, "system", model)
    # discrete-time model: plain recursion
    if isinstance(inner, ct.StateSpace) and inner.dt != 0:
        if effects:
            raise ModelError(
                f"{effects[0].label} acts in continuous time; convert the model with rcorefine.d2c"
            )
        return _simulate_discrete(LinearModel.from_statespace(inner), data, x0)
    structure, theta, substeps = structure_of(model)
    if structure.model.controller is not None:
        data = completed(structure.model, data)
        data = record_for(data, match_channels(structure.linear_model, data))
    data = resting_inputs(data, structure.linear_model.input_labels)
    check_channels(structure.linear_model, data)
    # further effects, on substeps much finer than those of an estimate
    if effects:
        structure, substeps = _with_effects(model, structure, effects, data), max(substeps, _TRUE)
    # the given initial state is that of the model, without the controller
    own = own_states(structure)
    start, point = as_state(x0, own.size), structure.model.operating_point
    if start is not None:
        start, given = np.zeros(structure.n_states), start
        start[own] = given
    # operating point: the engine works with deviations
    levels = _levels(structure, data)
    if point is not None:
        data = data.deviation(point.inputs, point.outputs)
        start = None if start is None else start - (0.0 if isinstance(x0, str) else levels[1])
    # effects on commands inside a loop: finer samples or substeps
    factor, steps = _finer(structure)
    data, substeps = _on_finer_grid(data, factor), max(substeps, steps)
    # nonlinear model: substeps until the result converges
    if structure.field is not None and model is structure.model:
        substeps = _sufficient_steps(structure, data, start, led)
    engine = Engine(structure, data, substeps=substeps, initial=start, lead=_lead(structure, data, led))
    # initial state by least squares
    if start is None:
        start = estimate_initial_state(engine, theta)
    run = engine.run(theta, start, sensitivity=False, histories=True)
    # absolute values at the samples of the record
    outputs, states = run.outputs + levels[0][:, None], run.states + levels[1][:, None]
    at = slice(None, None, factor)
    return Simulation(outputs[:, at], states[own][:, at], run.forces[:, at], (start + levels[1])[own])


def _with_effects(
    model: Any, structure: Structure, effects: Sequence[Effect], data: Measurement
) -> Structure:
    """Return the structure with further effects of known coefficients."""
    for effect in effects:
        if effect.free:
            raise ModelError(
                f"{effect.label}: give the value of {', '.join(effect.free)} in fixed= of the effect"
            )
    widths = dict(structure.constants)
    plain: Simulation | None = None
    for index, effect in enumerate(effects, len(structure.effects)):
        share = effect.spec.width_share
        if share is not None and "width" not in effect.fixed:
            # motion from rest without the effects
            plain = plain or simulated(model, data, "zero")
            port = structure.model.port(effect.place)
            n = port.velocity.size
            speed = port.velocity @ plain.states[:n] + port.velocity_input @ data.inputs
            widths[index] = share * float(np.sqrt(np.mean(speed**2))) or 1.0
        elif share is not None:
            widths[index] = effect.fixed["width"]
    return Structure(structure.model, (*structure.effects, *effects), constants=widths)


_FINER = 8  # parts of a sample in which a command behind effects may change


def _finer(structure: Structure) -> tuple[int, int]:
    """Return into how many samples and substeps a sample is divided in a loop.

    A continuous controller answers at each of these samples. Between those of a sampled one the edges of a
    delayed command fall on substeps.
    """
    controller = structure.model.controller
    if controller is None or not {at for _, at in structure.input_statics} & set(controller.driven):
        return 1, 1
    return (1, _FINER) if controller.sampled else (_FINER, 1)


def _on_finer_grid(data: Measurement, factor: int) -> Measurement:
    """Return the record with samples between its samples, as its hold says."""
    if factor == 1:
        return data
    if data.hold == "bandlimited":
        inputs = interpolate_band_limited(data.inputs, factor)
    elif data.hold == "foh":
        inputs = straight_lines(data.inputs, factor)
    else:
        inputs = np.repeat(data.inputs, factor, axis=1)[:, : 1 - factor]
    times = straight_lines(data.timepts[None], factor)[0]
    outputs = straight_lines(data.outputs, factor)
    return data._changed(inputs=inputs, outputs=outputs, timepts=times, dt=data.dt / factor)


def _lead(structure: Structure, data: Measurement, led: bool) -> Array | None:
    """Return the gain on the error of the outputs, or None.

    It is that of the controller, or of an observer where one is allowed.
    """
    # controller: its gain closes the loop
    if structure.model.controller is not None:
        return loop_gain(structure, data.dt)
    return leading_gain(structure, data) if led else None


def _sufficient_steps(structure: Structure, data: Measurement, start: Array | None, led: bool) -> int:
    """Return a sufficient number of substeps for a nonlinear model.

    Doubling it no longer changes the free run.
    """
    steps, before, theta = 2, None, np.zeros(0)
    made = partial(Engine, structure, data, lead=_lead(structure, data, led))
    # initial state once, with the coarsest substeps
    if start is None:
        start = estimate_initial_state(made(substeps=steps), theta)
    while steps < _MOST_STEPS:
        # double the substeps until no output changes by more than 0.1 % of its size
        engine = made(substeps=steps, initial=start)
        outputs = engine.run(theta, start, sensitivity=False, check=False).outputs
        if before is not None:
            moved, size = np.abs(outputs - before).max(axis=1), outputs.std(axis=1)
            if bool(np.all(moved <= _STILL * size)):
                break
        steps, before = 2 * steps, outputs
    return steps


def _levels(structure: Structure, data: Measurement) -> tuple[Array, Array]:
    """Return the offsets of outputs and states from those of the engine.

    Added to values of the engine, they give outputs as in the record, and states.
    """
    outputs, states = np.zeros(structure.n_outputs), np.zeros(structure.n_states)
    point = structure.model.operating_point
    if point is not None:
        # outputs of the record may be without their means, `origin`
        outputs = point.outputs - data.origin[data.n_inputs :]
        states[: point.states.size] = point.states
    return outputs, states


def unjudged_samples(model: Any, data: Measurement) -> int:
    """Return the number of first samples that cannot be compared.

    A model with a delay and a free initial state is undetermined there.
    """
    if not hasattr(model, "simulation_structure") and not held_effects(known_physical(model)):
        return 0  # linear models have no delay, which is an effect
    structure, theta, _ = structure_of(model)
    return int(Engine(structure, data).judged(theta).argmax(axis=1).max(initial=0))


def check_channels(model: LinearModel, data: Measurement) -> None:
    """Raise where the numbers of channels differ, and name what is missing."""
    for what, have, need, present, wanted in (
        ("inputs", data.inputs.shape[0], model.n_inputs, data.input_labels, model.input_labels),
        ("outputs", data.outputs.shape[0], model.n_outputs, data.output_labels, model.output_labels),
    ):
        if have != need:
            missing = [label for label in wanted if label not in present]
            named = f" (missing: {', '.join(missing)})" if 0 < len(missing) < len(wanted) else ""
            raise ct.ControlDimension(
                f"record {data.name!r} has {have} {what} and the model {need}{named}; give the record's "
                f"{what} that belong to {model.name!r}, or a model with the {what} that all records share"
            )


def check_records(model: LinearModel, given: Sequence[Any], ordered: Sequence[Any], purpose: str) -> None:
    """Check the channels of records, and warn about inputs that are constant.

    `ordered` are the given records in the order of the model. One without inputs is a free decay.
    """
    for measured, record in zip(given, ordered, strict=True):
        check_channels(model, record)
        if measured.n_inputs:
            record.check_excitation(purpose)


def _simulate_discrete(model: LinearModel, data: Measurement, x0: str | Array) -> Simulation:
    """Free run of a discrete model; its hold is already inside."""
    if model.dt not in (None, True) and not np.isclose(float(model.dt), data.dt, rtol=1e-9):
        raise ModelError(
            f"model {model.name!r} has dt = {model.dt:g} s and the record {data.dt:g} s; resample one of them"
        )
    data = resting_inputs(data, model.input_labels)
    check_channels(model, data)
    start = as_state(x0, model.n_states)
    if start is None and not model.n_states:
        start = np.zeros(0)
    # forced response from zero, and free responses to unit initial states, A^k
    moves = start is None or bool(start.any())
    with np.errstate(over="ignore", invalid="ignore"):
        rest = np.zeros((model.n_states, 1))
        driven = recursion(model.A, rest, (model.B @ data.inputs)[:, :-1, None])
        states = np.hstack([rest, driven[:, :, 0]])
        unit = unit_responses(model.A, np.eye(model.n_states), data.n_samples if moves else 1)
        forced = model.C @ states + model.D @ data.inputs
    if not (np.isfinite(forced).all() and np.isfinite(unit).all()):
        raise DivergenceError(f"its state leaves all bounds within {data.n_samples} samples")
    if start is None:
        # least squares: outputs are affine in the initial state
        weights = 1.0 / spreads(data.outputs)
        slopes = np.einsum("y,yi,kij->ykj", weights, model.C, unit)
        slopes[np.isnan(data.outputs)] = 0.0
        slopes = slopes.reshape(-1, model.n_states)
        error = (weights[:, None] * difference(forced, data.outputs)).ravel()
        start = gauss_newton(
            lambda x: Rows(error + slopes @ x, slopes), np.zeros(model.n_states),
            sizes=own_sizes(np.abs(states).max(axis=1), slopes), evaluations=3, tolerance=1e-8, damping=0.0,
        ).point  # fmt: skip
    if moves:
        # superposition of both responses
        states = states + np.einsum("kij,j->ik", unit, start)
    outputs = model.C @ states + model.D @ data.inputs
    return Simulation(outputs, states, np.zeros((0, data.n_samples)), start)
