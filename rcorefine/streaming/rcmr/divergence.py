"""Why a correction diverged, in words: when, the zeros of the path, the place, the scaling."""

from __future__ import annotations

import numpy as np

from .arrays import Plant
from .path import markov_parameters, path_zeros

__all__ = ["explain"]

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
