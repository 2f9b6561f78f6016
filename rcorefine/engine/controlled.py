"""Free runs, cut into windows where needed, and closed loops.

A closed loop has the states of the controller as additional ones.

The states of the controller jump at the samples. The recorded input contains the noise of the sensors:
u = K (r, y). The loop of the model gives u + K (0, y_model - y), so the controller acts as an observer does,
through the input and on the error of the outputs. Its states are those of K, of that difference, and what its
outputs hold over the sample.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from itertools import pairwise, product, starmap
from typing import TYPE_CHECKING, Any

import control as ct
import numpy as np
from numpy.typing import NDArray

from ..arguments import as_number
from ..data.measurement import Measurement
from ..exceptions import DataError, ModelError
from ..models.physical_model import PhysicalModel
from ..systems.discretization import discretize
from ..systems.linear import Array, LinearModel

if TYPE_CHECKING:
    from .structure import Structure


def own_states(structure: Structure) -> NDArray[np.int64]:
    """Indices of the states that are not a controller's."""
    return np.delete(np.arange(structure.n_states), structure.loop)


def open_loop(structure: Structure) -> Structure:
    """Return the structure without its controller.

    The model and the effects stay the same.
    """
    if structure.model.controller is None:
        return structure
    model = replace(structure.model, controller=None)
    return type(structure)(model, structure.effects, constants=structure.constants)


def sample_jumps(structure: Structure, dt: float) -> Array:
    """Return the matrix that updates the states at a sample, (n, n).

    It acts before the sample corrects the states. Without a controller its shape is (0, 0).
    """
    controller = structure.model.controller
    if controller is None:
        return np.zeros((0, 0))
    A, _, C, _ = controller.at(dt)
    jumps, loop = np.eye(structure.n_states), structure.loop
    inner = slice(loop.start, loop.start + A.shape[0])
    held = slice(inner.stop, loop.stop)
    # controller at a sample: x_c <- A x_c, held output <- C x_c
    jumps[inner, inner], jumps[held, inner], jumps[held, held] = A, C, 0.0
    return jumps


def loop_gain(structure: Structure, dt: float) -> Array:
    """Return the gain from output errors to states at a sample, (n, n_y).

    The error is the measured output minus that of the model.
    """
    controller = structure.model.controller
    gain = np.zeros((structure.n_states, structure.n_outputs))
    if controller is not None:
        _, B, _, D = controller.fed_back(dt, structure.n_outputs)
        # the error y - y_model enters the controller with a minus sign: x_c by B, held output by D
        gain[structure.loop] = -np.vstack([B, D])
    return gain


def closes_loop(structure: Structure, gain: Array | None) -> bool:
    """Return whether a gain (n, n_y) on the output errors is that of a loop."""
    return structure.model.controller is not None and gain is not None and bool(gain[structure.loop].any())


def start_columns(structure: Structure, count: int) -> Array:
    """Return the derivatives (count, n) of the states at the start.

    The rows belong to the parameters and, last, to the initial states. Where the record holds the output of
    the controller, the states of the loop are zero at the start.
    """
    n, controller = structure.n_states, structure.model.controller
    # dx(0)/dx0 is the identity, after the rows of the parameters
    found = np.eye(count, n, n - count)
    if controller is not None and controller.recorded:
        found[:, structure.loop] = 0.0
    return found


def as_it_runs(model: PhysicalModel, record: Measurement) -> LinearModel:
    """Return the linear model, or its sampled closed loop.

    Its stability decides whether there is a free run.

    Raises
    ------
    ModelError
        If the loop is unstable over the record.
    """
    controller, linear = model.controller, model.linear
    if controller is None:
        return linear
    # sampled plant under zero-order hold: x(k+1) = Phi x + Gamma u
    Phi, Gamma, _ = discretize(linear.A, linear.B[:, list(controller.driven)], record.dt)
    A, B, C, D = controller.fed_back(record.dt, linear.n_outputs)
    through = linear.D[:, list(controller.driven)]
    # algebraic loop u = C_c x_c + D_c y, y = C x + D u, solved for u over the states [x, x_c]
    back = np.linalg.solve(np.eye(len(controller.driven)) - D @ through, np.hstack([D @ linear.C, C]))
    seen = np.hstack([linear.C, np.zeros((linear.n_outputs, A.shape[0]))]) + through @ back
    n, k = linear.n_states, A.shape[0]
    # state matrix of the closed loop from sample to sample
    moves = np.block([[Phi, np.zeros((n, k))], [np.zeros((k, n)), A]]) + np.vstack([Gamma @ back, B @ seen])
    loop = linear.with_arrays(
        A=moves, B=np.zeros((n + k, linear.n_inputs)), C=seen, dt=record.dt,
        state_labels=(*linear.state_labels, *(f"controller {i}" for i in range(k))),
    )  # fmt: skip
    if runs_away(loop, record):
        radius = float(np.abs(np.linalg.eigvals(moves)).max())
        raise ModelError(
            f"the loop of model {linear.name!r} and controller {controller.linear.name!r} is unstable "
            f"(spectral radius {radius:.4g} from sample to sample): look at the sign of the feedback (joined "
            "by names it stands in the controller, as in control.interconnect; without names it is "
            "negative), or leave the controller out, and the model is judged one sample ahead"
        )
    return loop


_WINDOWS = 10  # windows of a record whose model integrates
_GROWTH = 3.0  # log of the growth of an unstable mode, and of an error of the initial state, in a free run


def checked_horizon(horizon: Any, known_start: bool = False) -> float | None:
    """The horizon as a number of seconds, None for the default.

    Raises
    ------
    control.ControlArgument
        If it is no positive time, or stands beside a given initial state.
    """
    if horizon is None:
        return None
    seconds = as_number(horizon, "horizon", above=0.0, what="a time in seconds")
    if known_start:
        raise ct.ControlArgument("a given x0 holds for one start only; leave horizon or x0 out")
    return seconds


def integrates(linear: LinearModel, record: Measurement) -> bool:
    """Return whether an output drifts under a constant input.

    The drift must last as long as the record.
    """
    if linear.n_states == 0:
        return False
    poles, right = np.linalg.eig(linear.A)
    # integrators: |s| dt or |z - 1| is zero over the length of the record
    turned = np.abs(poles) * record.dt if linear.is_continuous else np.abs(poles - 1.0)
    slow = turned * record.n_samples < 1e-3
    if not slow.any():
        return False
    # an integrator counts only where it reaches an output
    step = np.linalg.norm(linear.C, axis=0) @ np.abs(right[:, slow])
    return bool(np.any(step > 1e-9 * np.linalg.norm(linear.C)))


def runs_away(linear: LinearModel, record: Measurement) -> bool:
    """Return whether an unstable mode rules out a free run.

    The mode grows too much over the length of the record.
    """
    poles = np.linalg.eigvals(linear.A) if linear.n_states else np.zeros(0)
    with np.errstate(divide="ignore"):
        # growth per sample: exp(Re(s) dt) or |z|
        rates = poles.real * record.dt if linear.is_continuous else np.log(np.abs(poles))
    return bool(rates.max(initial=0.0) * record.n_samples > _GROWTH)


def free_runs(
    models: Sequence[LinearModel],
    records: Sequence[Measurement],
    horizon: float | None = None,
    known_start: bool = False,
) -> tuple[list[list[slice]], str]:
    """Windows of each record, every one with an initial state of its own.

    Parameters
    ----------
    models : sequence of LinearModel
        Models that run in the same windows.
    records : sequence of Measurement
        Records.
    horizon : float, optional
        Length in s. Each record is cut in the whole number of equal windows that comes
        nearest. Default: the whole record; one tenth of the longest where a model integrates,
        for a free run then drifts without bound. An unstable model has no free run: it is led by an
        observer, over the whole record.
    known_start : bool
        Whether the initial state is given: there is one start then.

    Returns
    -------
    windows : list of list of slice
        Per record.
    note : str
        Why there are windows that nobody asked for, or no free run; empty otherwise.

    Raises
    ------
    control.ControlArgument
        If `horizon` is no positive time, or stands beside a given start.
    DataError
        If a window is too short to estimate a state in.
    """
    seconds, note, least = checked_horizon(horizon, known_start), "", 1
    n_states = max(model.n_states for model in models)
    # default horizon: the whole record, unless the model is unstable or integrates
    if seconds is None:
        whole = [[slice(0, record.n_samples)] for record in records]
        kinds = {(record.dt, record.n_samples): record for record in records}
        pairs = list(product(models, kinds.values()))
        if any(model.is_continuous and runs_away(model, record) for model, record in pairs):
            return whole, (
                "The model is unstable and has no free run: it is judged by what it predicts one sample "
                "ahead, with process noise (Kalman predictor) (horizon= gives short free runs)."
            )
        if known_start or not any(starmap(integrates, pairs)):
            return whole, note
        seconds = max(record.n_samples * record.dt for record in records) / _WINDOWS
        least = 4 * n_states + 4
        note = (
            f"The model integrates, so free runs are cut into windows of {seconds:.3g} s "
            "with an initial state each (horizon=)."
        )
    return [_cut(record, seconds, least, n_states) for record in records], note


def _cut(record: Measurement, seconds: float, least: int, n_states: int) -> list[slice]:
    """Cut a record in equal windows whose length is closest to the horizon."""
    n, n_outputs = record.n_samples, record.outputs.shape[0]
    count = min(max(1, round(n * record.dt / seconds)), max(1, n // least))
    if count > 1 and n // count * n_outputs <= n_states:
        raise DataError(
            f"a window of horizon = {seconds:g} s holds {n // count} samples of {n_outputs} output(s), "
            f"too few to estimate {n_states} initial states from and to judge by; give a longer one"
        )
    edges = np.linspace(0, n, count + 1).round().astype(int)
    return [slice(int(a), int(b)) for a, b in pairwise(edges)]
