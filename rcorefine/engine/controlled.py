"""Simulation of a closed loop, with the controller as additional states.

The states of the controller jump at the samples. The recorded input contains the noise of the sensors:
u = K (r, y). The loop of the model gives u + K (0, y_model - y), so the controller acts as an observer does,
through the input and on the error of the outputs. Its states are those of K, of that difference, and what its
outputs hold over the sample.
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from ..data.measurement import Measurement
from ..exceptions import ModelError
from ..models.physical_model import PhysicalModel
from ..systems.discretization import discretize
from ..systems.linear import Array, LinearModel
from .free_runs import runs_away

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
        gain[structure.loop] = -np.vstack([B, D])
    return gain


def start_columns(structure: Structure, count: int) -> Array:
    """Return the derivatives (count, n) of the states at the start.

    The rows belong to the parameters and, last, to the initial states. Where the record holds the output of
    the controller, the states of the loop are zero at the start.
    """
    n, controller = structure.n_states, structure.model.controller
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
    Phi, Gamma, _ = discretize(linear.A, linear.B[:, list(controller.driven)], record.dt)
    A, B, C, D = controller.fed_back(record.dt, linear.n_outputs)
    through = linear.D[:, list(controller.driven)]
    back = np.linalg.solve(np.eye(len(controller.driven)) - D @ through, np.hstack([D @ linear.C, C]))
    seen = np.hstack([linear.C, np.zeros((linear.n_outputs, A.shape[0]))]) + through @ back
    n, k = linear.n_states, A.shape[0]
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
