"""Learning from a stream of samples.

Samples are held back until the scales are known.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from ...exceptions import DivergenceError
from ...systems.linear import Array
from .arrays import Plant, Record
from .kernels import advance
from .memory import Memory, Tuned, in_units, tuned
from .path import markov_parameters, path_zeros
from .scaling import Scales, is_settled, measured_scales
from .setup import Setup

__all__ = ["Diverged", "explain", "take", "take_until"]

# Signals that still grow are held back until there are this many times as many samples.
LONGEST_WARM_UP = 16


class Diverged(DivergenceError):
    """Divergence after `done` sound samples.

    Samples that were held back are included. `found` holds the scales.
    """

    def __init__(self, message: str, done: int = 0, found: Tuned | None = None) -> None:
        super().__init__(message)
        self.done = done
        self.found = found


def take(
    setup: Setup, memory: Memory, inputs: Array, outputs: Array, *, keep: bool = False, last: bool = False
) -> tuple[Memory, Record | None, Array]:
    """Memory after some samples, and what they leave behind for a history.

    Parameters
    ----------
    setup, memory
        The refiner; `memory` stays as it is.
    inputs, outputs : ndarray of shape (N, n_w), (N, n_y)
        Samples.
    keep : bool
        Whether to record every sample.
    last : bool
        Whether the record ends here, so that no sample is held back.

    Raises
    ------
    Diverged
        If a correction diverges.
    """
    n_samples = memory.n_samples + inputs.shape[0]
    if memory.tuned is None:
        inputs = np.concatenate([memory.inputs, inputs])
        outputs = np.concatenate([memory.outputs, outputs])
        scales = found_scales(setup, inputs, outputs, memory.inputs.shape[0], last)
        if scales is None:
            waiting = replace(memory, inputs=inputs, outputs=outputs, n_samples=n_samples)
            return waiting, None, outputs[:0]
        memory = replace(
            memory,
            inputs=inputs[:0].copy(),
            outputs=outputs[:0].copy(),
            tuned=tuned(setup.plant, scales, setup.delay, setup.settings),
        )
    memory = memory.copied(n_samples)
    record = _advanced(setup, memory, inputs, outputs, n_samples - inputs.shape[0], keep)
    return memory, record, outputs


def take_until(
    setup: Setup, memory: Memory, inputs: Array, outputs: Array, error: Diverged, *, keep: bool = False
) -> tuple[Memory, Record | None, Array]:
    """Take the samples that were sound before these diverged."""
    inputs = np.concatenate([memory.inputs, inputs])[: error.done]
    outputs = np.concatenate([memory.outputs, outputs])[: error.done]
    memory = replace(
        memory,
        inputs=inputs[:0].copy(),
        outputs=outputs[:0].copy(),
        n_samples=memory.n_samples - len(memory.inputs),
        tuned=error.found,
    )
    return take(setup, memory, inputs, outputs, keep=keep)


def found_scales(setup: Setup, inputs: Array, outputs: Array, before: int, last: bool) -> Scales | None:
    """Return the scales as soon as the samples determine them.

    They do not depend on how the stream is cut into blocks.
    """
    labels = (setup.initial.input_labels, setup.initial.output_labels)
    count = setup.warm_up
    longest = count * LONGEST_WARM_UP
    while count <= longest and count <= inputs.shape[0]:
        if count > before:
            w, y = inputs[:count].T, outputs[:count].T
            if count == longest or (is_settled(w) and is_settled(y)):
                return measured_scales(setup.plant, w, y, labels)
        count *= 2
    return measured_scales(setup.plant, inputs.T, outputs.T, labels) if last else None


def _advanced(
    setup: Setup, memory: Memory, inputs: Array, outputs: Array, first: int, keep: bool
) -> Record | None:
    """Run both stages over the block in place.

    With `keep`, return the history of every sample.
    """
    assert memory.tuned is not None
    scales, plant, designs = memory.tuned.scales, memory.tuned.plant, memory.tuned.designs
    stages = memory.stages
    kept = inputs.shape[0] if keep else 0
    record = Record(
        z1=np.empty((kept, outputs.shape[1])),
        z2=np.empty((kept, outputs.shape[1])),
        theta1=np.empty((kept, stages[0].theta.size)),
        theta2=np.empty((kept, stages[1].theta.size)),
        x=np.empty((kept, plant.A.shape[0])),
    )
    with np.errstate(all="ignore"):  # a divergence is reported below, in words
        done, stage = advance(
            plant,
            *designs,
            *stages,
            memory.peak,
            memory.levels,
            memory.recent_theta,
            inputs / scales.inputs,
            outputs / scales.outputs,
            setup.estimated,
            record,
        )
    if stage:
        raise Diverged(_explained(setup, memory, first + done, stage), done, memory.tuned)
    if not keep:
        return None
    return Record(
        record.z1 * scales.outputs,
        record.z2 * scales.outputs,
        in_units(record.theta1, scales, setup.settings[0].order),
        in_units(record.theta2, scales, setup.settings[1].order),
        record.x * scales.states,
    )


def _explained(setup: Setup, memory: Memory, sample: int, stage: int) -> str:
    assert memory.tuned is not None
    settings = setup.settings[stage - 1]
    time = "" if setup.step is None else f" (t = {sample * setup.step:.6g} s)"
    return explain(
        memory.tuned.plant,
        setup.delay,
        settings.markov,
        settings.learning_rate,
        stage,
        f"sample {sample}{time}",
        float(memory.peak[0]),
    )


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
    prefix = "" if stage == 1 else "static_"
    sentences = [
        f"stage {stage} diverged at {where}; the state before is readable.",
        _zeros(plant, f"{prefix}markov", markov),
        _place(plant, delay),
        _model(plant),
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
        zeros = path_zeros(plant)
    except np.linalg.LinAlgError:  # numbers hundreds of decades apart
        return "Zeros: those of the path from the correction to the outputs cannot be computed."
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


def _model(plant: Plant) -> str:
    largest = float(np.abs(np.linalg.eigvals(plant.A)).max()) if plant.A.size else 0.0
    if largest <= 1.0 + 1e-9:
        return ""
    return f"Model: the initial model is unstable (largest |pole| = {largest:.6g}); start from a stable one."
