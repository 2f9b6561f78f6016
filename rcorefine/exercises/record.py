"""Simulated record of a model with effects that the model lacks.

The simulation is finer than that of any estimator.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from ..data.measurement import Measurement
from ..effects.effect import Effect
from ..engine.engine import Engine
from ..engine.structure import Structure
from ..models.physical_model import PhysicalModel
from ..systems.linear import Array

__all__ = ["hidden_outputs", "noisy", "record_of"]

_SUBSTEPS = 16


def record_of(
    model: PhysicalModel, inputs: Array, outputs: Array | None = None, *, dt: float, name: str = "record"
) -> Measurement:
    """Return a record with the labels and units of the model.

    The inputs have shape (n_w, N), the outputs (n_y, N); by default they are zero.
    """
    linear = model.linear
    return Measurement(
        inputs,
        np.zeros((linear.n_outputs, np.shape(inputs)[-1])) if outputs is None else outputs,
        dt=dt,
        input_labels=linear.input_labels,
        output_labels=linear.output_labels,
        input_units=model.input_units or None,
        output_units=model.output_units or None,
        name=name,
    )


def hidden_outputs(
    model: PhysicalModel,
    hidden: Mapping[Effect, Sequence[float]],
    record: Measurement,
    widths: Mapping[int, float] | None = None,
) -> Array:
    """Outputs of a model from rest with effects in it.

    Parameters
    ----------
    model : PhysicalModel
        Linear model; about its operating point where it has one.
    hidden : mapping of Effect to sequence of float
        Effects and their coefficients.
    record : Measurement
        Inputs, absolute.
    widths : mapping of int to float, optional
        By the number of the effect: over which velocity its sgn(v) is smoothed.

    Returns
    -------
    ndarray, shape (n_y, N)
        Without noise.

    Raises
    ------
    DivergenceError
        If the plant runs away.
    """
    point = model.operating_point
    data = record if point is None else record.deviation(point.inputs, point.outputs)
    structure = Structure(model, list(hidden), constants=dict(widths or {}))
    values = np.concatenate([np.zeros(0), *(np.asarray(list(c), dtype=float) for c in hidden.values())])
    run = Engine(structure, data, substeps=_SUBSTEPS).run(values, sensitivity=False)
    return run.outputs if point is None else run.outputs + point.outputs[:, None]


def noisy(outputs: Array, noise: float, rng: np.random.Generator) -> Array:
    """Outputs with white noise of a share of the standard deviation of each."""
    added: Array = noise * outputs.std(axis=1, keepdims=True) * rng.standard_normal(outputs.shape)
    return outputs + added
