"""Units in which alpha means something: every signal scaled to unit size.

Scales come from the first samples, never from later ones: the stream stays
causal, and it does not matter how it is cut into blocks.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import control as ct
import numpy as np

from ...arguments import as_array
from ...exceptions import DataError, ModelError
from ...systems.linear import Array
from .arrays import Plant
from .path import column_delays

__all__ = ["Scales", "declared_scales", "is_settled", "measured_scales", "scaled_plant"]

# Signals count as settled when the second half of a stretch is at most this much larger than the first.
GROWTH = 3.0


@dataclass(frozen=True, slots=True, eq=False)
class Scales:
    """Size of each signal in its own unit.

    A signal divided by it has unit size.

    Parameters
    ----------
    inputs, outputs, states, corrections : ndarray
        Shapes (n_w,), (n_y,), (n,), (l_u,).
    """

    inputs: Array
    outputs: Array
    states: Array
    corrections: Array


def scaled_plant(plant: Plant, scales: Scales) -> Plant:
    """Same system in scaled signals."""
    x, y = scales.states[:, None], scales.outputs[:, None]
    return Plant(
        A=np.ascontiguousarray(plant.A * scales.states / x),
        B=np.ascontiguousarray(plant.B * scales.inputs / x),
        Bu=np.ascontiguousarray(plant.Bu * scales.corrections / x),
        C=np.ascontiguousarray(plant.C * scales.states / y),
        D=np.ascontiguousarray(plant.D * scales.inputs / y),
        Du=np.ascontiguousarray(plant.Du * scales.corrections / y),
    )


def is_settled(signals: Array) -> bool:
    """Return whether every signal varies and no longer grows.

    `signals` is a stretch of shape (n, N).
    """
    if (np.ptp(signals, axis=1) == 0.0).any():
        return False
    half = signals.shape[1] // 2
    first = np.sqrt(np.mean(signals[:, :half] ** 2, axis=1))
    second = np.sqrt(np.mean(signals[:, half:] ** 2, axis=1))
    return bool((second <= GROWTH * first).all())


def measured_scales(
    plant: Plant, w: Array, y: Array, labels: tuple[tuple[str, ...], tuple[str, ...]]
) -> Scales:
    """Return the scales from the first samples, (n_w, N) and (n_y, N).

    They are the rms of inputs, outputs and model states.

    Raises
    ------
    DataError
        If an input is constant or an output is zero throughout.
    ModelError
        If the initial model grows beyond floating point on these inputs.
    """
    n_samples = w.shape[1]
    for signal, label in zip(w, labels[0], strict=True):
        if np.ptp(signal) == 0.0:
            raise DataError(
                f"input {label!r} is constant ({signal[0]:g}) from sample 0 to {n_samples - 1}: nothing can "
                "be learned from it. Excite it, leave it out of the model, or declare scale={...}"
            )
    for signal, label in zip(y, labels[1], strict=True):
        if not signal.any():
            raise DataError(
                f"output {label!r} is zero from sample 0 to {n_samples - 1}: check the sensor, "
                "or declare scale={...}"
            )
    inputs = np.sqrt(np.mean(w**2, axis=1))
    outputs = np.sqrt(np.mean(y**2, axis=1))
    corrections = _correction_scales(plant, outputs)
    x = np.zeros(plant.A.shape[0])
    total = np.zeros_like(x)
    with np.errstate(over="ignore", invalid="ignore"):
        for k in range(n_samples):
            total += x**2
            x = plant.A @ x + plant.B @ w[:, k]
    states = _filled(np.sqrt(_finite(total, n_samples) / n_samples), plant, corrections, n_samples)
    return Scales(inputs, outputs, states, corrections)


def declared_scales(plant: Plant, scale: Mapping[str, Any], n_samples: int) -> Scales:
    """Return the scales that the user declares.

    Those of states and corrections may be left out.

    Raises
    ------
    control.ControlArgument
        If a name is unknown, or inputs or outputs are missing.
    control.ControlDimension
        If a scale has the wrong length.
    ModelError
        If a scale is not positive and finite.
    """
    sizes = {
        "inputs": plant.B.shape[1],
        "outputs": plant.C.shape[0],
        "states": plant.A.shape[0],
        "corrections": plant.Bu.shape[1],
    }
    if unknown := set(scale) - set(sizes):
        raise ct.ControlArgument(
            f"scale: {sorted(unknown)[0]!r} is unknown; give {', '.join(map(repr, sizes))}"
        )
    for name in ("inputs", "outputs"):
        if name not in scale:
            raise ct.ControlArgument(f"scale: {name!r} is missing; give the typical size of {name}")
    given = {name: _positive(name, value, sizes[name]) for name, value in scale.items()}
    corrections = given.get("corrections")
    if corrections is None:
        corrections = _correction_scales(plant, given["outputs"])
    states = given.get("states")
    if states is None:
        # rms response to white inputs of the declared size over the first samples, from rest
        states = np.sqrt(_power(plant.A, plant.B * given["inputs"], n_samples))
        states = _filled(states, plant, corrections, n_samples)
    return Scales(given["inputs"], given["outputs"], states, corrections)


def _positive(name: str, value: Any, size: int) -> Array:
    array = as_array(value, f"scale: {name}", error=ModelError)
    if array.ndim > 1 or (array.ndim == 1 and array.size != size):
        raise ct.ControlDimension(f"scale: {name} has shape {array.shape}; give one number, or {size}")
    if not (array > 0).all():
        raise ModelError(f"scale: {name} must be positive and finite, not {value!r}")
    return np.full(size, array, dtype=float) if array.ndim == 0 else array.astype(float)


def _correction_scales(plant: Plant, outputs: Array) -> Array:
    """Return the scales of the corrections.

    A correction of unit size moves the outputs by their unit size at its first response.

    So alpha means the same whatever the unit of the correction and however
    fast the sampling.
    """
    return np.asarray(1.0 / np.linalg.norm(column_delays(plant) / outputs[:, None], axis=0))


def _power(a: Array, b: Array, n_samples: int) -> Array:
    """Return the mean square of the states under white inputs.

    The states start from rest. Inputs of unit size act through b.
    """
    total = np.zeros(a.shape[0])
    step = b
    with np.errstate(over="ignore", invalid="ignore"):
        for k in range(1, n_samples):
            total += (step**2).sum(axis=1) * ((n_samples - k) / n_samples)
            step = a @ step
    return _finite(total, n_samples)


def _finite(total: Array, n_samples: int) -> Array:
    if not np.isfinite(total).all():
        raise ModelError(
            f"the initial model grows beyond floating point within {n_samples} samples: it is unstable. "
            "Declare scale={...} with states, or start from a stable model"
        )
    return total


def _filled(states: Array, plant: Plant, corrections: Array, n_samples: int) -> Array:
    """Return the scales of the states with missing ones filled in.

    States that the inputs do not move get their scale from the correction.
    """
    still = states == 0.0
    if still.any():
        moved = np.sqrt(_power(plant.A, plant.Bu * corrections, n_samples))
        states = np.where(still, moved, states)
    return np.where(states == 0.0, 1.0, states)
