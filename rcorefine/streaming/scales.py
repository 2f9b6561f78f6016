"""Sizes of signals, path of a correction, and why one diverges."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, NamedTuple

import control as ct
import numpy as np

from ..arguments import as_array
from ..engine.linear import state_power
from ..exceptions import DataError, ModelError
from ..systems.linear import Array
from .samples import Complex


class Plant(NamedTuple):
    """Discrete model: x+ = A x + B w + B_u u, y = C x + D w + D_u u."""

    A: Array
    B: Array
    Bu: Array
    C: Array
    D: Array
    Du: Array


# A Markov parameter counts as zero below this share of the largest |C| |A^(i-1) B_u| of its entry
# over the first n + 1 samples: what is left of an exact cancellation after rounding.
TOLERANCE = 1e-10


def markov_parameters(plant: Plant, count: int) -> Array:
    """H_0 = D_u and H_i = C A^(i-1) B_u, shape (count, n_y, l_u)."""
    values = np.empty((count, *plant.Du.shape))
    # H_i = C A^(i-1) B_u
    values[0] = plant.Du
    power = plant.Bu
    for i in range(1, count):
        values[i] = plant.C @ power
        power = plant.A @ power
    return values


def first_responses(plant: Plant) -> tuple[int, Array]:
    """Return when corrections first show in the outputs, and how.

    Returns
    -------
    delay : int
        Index d of the first Markov parameter that is not zero; with feedthrough 0.
    first : ndarray of shape (n_y, l_u)
        First nonzero Markov parameter of each correction.

    Raises
    ------
    ModelError
        If a correction reaches no output.
    """
    # by Cayley and Hamilton's theorem: if these are zero, all are
    count = plant.A.shape[0] + 2
    values = markov_parameters(plant, count)
    # bound of each entry without cancellation
    bound, power = np.abs(plant.Du), plant.Bu
    for _ in range(1, count):
        bound = np.maximum(bound, np.abs(plant.C) @ np.abs(power))
        power = plant.A @ power
    reached = (np.abs(values) > TOLERANCE * bound).any(axis=1)
    dead = ~reached.any(axis=0)
    if dead.all():
        raise ModelError(
            "the correction reaches no output: every Markov parameter D_u, C A^i B_u is zero; "
            "choose correction_input (B_u) so that it drives a state that the outputs see"
        )
    if dead.any():
        raise ModelError(
            f"correction {int(np.argmax(dead))} (column of B_u, D_u) reaches no output; "
            "leave the column out, or measure where it acts"
        )
    # column c of the first H_i that is not zero for correction c
    first = np.argmax(reached, axis=0)
    return int(first.min()), np.stack([values[i, :, c] for c, i in enumerate(first)], axis=1)


def _path_zeros(plant: Plant) -> Complex:
    """Return the finite zeros of the path u -> y.

    They are invariant zeros if the path is square, otherwise the zeros of every single path.
    """
    path = ct.ss(plant.A, plant.Bu, plant.C, plant.Du, True)
    if path.ninputs == path.noutputs:
        return np.asarray(path.zeros(), dtype=complex)
    alone = [path[r, c].zeros() for r in range(path.noutputs) for c in range(path.ninputs)]
    return np.concatenate(alone, dtype=complex)


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
    # A, B, C, D of signals divided by their scales: S_x^-1 A S_x and so on
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
    # stationary: rms of the second half at most three times that of the first
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
    # rms of the measured signals
    inputs = np.sqrt(np.mean(w**2, axis=1))
    outputs = np.sqrt(np.mean(y**2, axis=1))
    corrections = _correction_scales(plant, outputs)
    # rms of the model states in a simulation from rest
    with np.errstate(over="ignore", invalid="ignore"):
        power = state_power(plant.A, plant.B, np.ascontiguousarray(w[:, :-1].T))
    power = _finite(power, n_samples) * ((n_samples - 1) / n_samples)
    states = _fill_scales(np.sqrt(power), plant, corrections, n_samples)
    return Scales(inputs, outputs, states, corrections)


def declared_scales(plant: Plant, scale: Any, n_samples: int) -> Scales | None:
    """Return the scales that the user declares, None for those to be measured.

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
    if isinstance(scale, str) and scale == "auto":
        return None
    if not isinstance(scale, Mapping):
        raise ct.ControlArgument(
            f"scale must be 'auto' or a mapping such as {{'inputs': 1.0, 'outputs': 0.1}}, not {scale!r}"
        )
    sizes = {
        "inputs": plant.B.shape[1],
        "outputs": plant.C.shape[0],
        "states": plant.A.shape[0],
        "corrections": plant.Bu.shape[1],
    }
    # check names and signs
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
        states = _fill_scales(states, plant, corrections, n_samples)
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
    return np.asarray(1.0 / np.linalg.norm(first_responses(plant)[1] / outputs[:, None], axis=0))


def _power(a: Array, b: Array, n_samples: int) -> Array:
    """Return the mean square of the states under white inputs.

    The states start from rest. Inputs of unit size act through b.
    """
    # sum over k of |A^(k-1) B|^2, weighted by the samples that an input had time to act
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


def _fill_scales(states: Array, plant: Plant, corrections: Array, n_samples: int) -> Array:
    """Return the scales of the states with missing ones filled in.

    States that the inputs do not move get their scale from the correction.
    """
    # states that no input excites: as large as a unit correction makes them
    still = states == 0.0
    if still.any():
        moved = np.sqrt(_power(plant.A, plant.Bu * corrections, n_samples))
        states = np.where(still, moved, states)
    return np.where(states == 0.0, 1.0, states)


# Samples of the impulse response that the first Markov parameter is compared with.
_SPAN = 50


def explain(
    plant: Plant, delay: int, markov: int, learning_rate: float, stage: int, where: str, largest: float
) -> str:
    """Message of a `DivergenceError`.

    Parameters
    ----------
    plant : Plant
        Scaled model.
    delay : int
        First Markov parameter that is not zero, d.
    markov, learning_rate : int, float
        mu and alpha of the stage.
    stage : {1, 2}
        Which stage.
    where : str
        Sample and time.
    largest : float
        Largest scaled measured output so far.
    """
    # the causes of divergence in the order of their frequency
    prefix = "" if stage == 1 else "static_"
    radius = float(np.abs(np.linalg.eigvals(plant.A)).max()) if plant.A.size else 0.0
    sentences = [
        f"stage {stage} diverged at {where}; the state before is readable.",
        _zeros(plant, f"{prefix}markov", markov),
        _place(plant, delay),
        f"Model: the initial model is unstable (largest |pole| = {radius:.6g}); start from a stable one."
        if radius > 1.0 + 1e-9
        else "",
        f"Scaling: {prefix}learning_rate is {learning_rate:g} in scaled units; raise it tenfold to learn "
        "more slowly.",
    ]
    if largest > 10.0:
        sentences.append(
            f"Outputs have grown to {largest:.3g} times their scale; declare scale={{...}} with the size "
            "that signals reach."
        )
    return " ".join(sentence for sentence in sentences if sentence)


def _zeros(plant: Plant, markov_name: str, markov: int) -> str:
    try:
        zeros = _path_zeros(plant)
    except (np.linalg.LinAlgError, ValueError):  # numbers hundreds of decades apart
        return "Zeros: those of the path from the correction to the outputs cannot be computed."
    # retrospective cost inverts the path: zeros outside the unit circle become unstable poles
    outside = zeros[np.abs(zeros) >= 1.0 - 1e-9]
    if not outside.size:
        largest = float(np.abs(zeros).max()) if zeros.size else 0.0
        return (
            "Zeros: those of the path from the correction to the outputs lie inside the unit circle "
            f"(largest |z| = {largest:.4g}), so they are not the cause by themselves."
        )
    worst = outside[np.argmax(np.abs(outside))]
    value = f"{worst.real:.4g}" if abs(worst.imag) < 1e-9 * abs(worst) else f"{worst:.4g}"
    return (
        f"Zeros: the path from the correction to the outputs has {outside.size} zero(s) on or outside the "
        f"unit circle (largest at {value}, |z| = {abs(worst):.4g}), which the method tries to invert unless "
        f"the Markov parameters show them. Raise {markov_name} (now {markov}, up to the length of the "
        "impulse response), or bring correction_input and sensor closer together."
    )


def _place(plant: Plant, delay: int) -> str:
    # first Markov parameter against the largest one
    values = np.abs(markov_parameters(plant, delay + _SPAN)).max(axis=(1, 2))
    share = float(values[delay] / values.max())
    if delay <= 1 and share >= 0.1:
        return (
            "Place: the correction shows in the outputs at once; if it acts elsewhere in the true system, "
            "choose another correction_input."
        )
    return (
        f"Place: a correction shows first after {delay} sample(s), with {share:.2g} of its largest effect; "
        "let correction_input act closer to a sensor, or sample more slowly."
    )
