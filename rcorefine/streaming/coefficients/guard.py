"""Reasons why the physical stage failed or may not be trusted."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ...exceptions import DivergenceError
from ...systems.linear import LinearModel
from .memory import CoefficientMemory
from .setup import Setup

__all__ = ["cautions", "explain_divergence"]

_UNLEARNED = 0.5  # of its prior deviation: a coefficient that is no better known has not been seen
_UNEXPLAINED = 0.3  # of the rms of an output left in the innovations: the effects do not explain it
_ALIKE = 0.995  # correlation of two estimates that the sensors can hardly tell apart


def explain_divergence(setup: Setup, memory: CoefficientMemory, sample: int) -> DivergenceError:
    """Error that says when the state left all bounds, and why."""
    sentences = [
        f"the static stage diverged at sample {sample} (t = {sample * setup.settings.dt:.6g} s); "
        "the state before is readable.",
        *_unstable(setup, memory),
        *_bounds(setup, memory),
        "Place: choose other effects, give them a start or a prior, or declare the noise of the sensors.",
    ]
    return DivergenceError(" ".join(sentences))


def cautions(setup: Setup, memory: CoefficientMemory) -> list[str]:
    """Return the reasons not to trust the coefficients."""
    if memory.rounds == 0 or not memory.spread.size:
        return []
    lay = setup.layout
    names = setup.labels
    P = lay.view(memory.packed, "Pt")
    std = np.sqrt(np.maximum(np.diag(P), 0.0))
    found = [*_unstable(setup, memory), *_bounds(setup, memory)]
    blind = [
        name for name, one, prior in zip(names, std, memory.spread, strict=True) if one > _UNLEARNED * prior
    ]
    if blind:
        found.append(f"Not excited: the samples hardly determine {', '.join(blind)}; excite or omit it.")
    with np.errstate(divide="ignore", invalid="ignore"):
        correlation = np.abs(P) / np.outer(std, std)
    pairs = [
        f"{names[i]} and {names[j]}"
        for i in range(len(names))
        for j in range(i)
        if correlation[i, j] > _ALIKE
    ]
    if pairs:
        found.append(f"Hardly distinguished by these sensors: {'; '.join(pairs[:3])}.")
    level = np.sqrt(lay.view(memory.packed, "level")[1])
    size = memory.sizes[-lay.ny :]
    for label, left, whole, declared in zip(
        setup.model.output_labels, level, size, setup.settings.noise, strict=True
    ):
        if declared > 0 and left > 2.0 * declared:
            found.append(
                f"Not explained: the prediction error of {label} is {left:.3g}, the declared noise "
                f"{declared:.3g}. An effect is missing or at another place."
            )
        elif declared == 0 and left > _UNEXPLAINED * whole:
            found.append(
                f"Not explained: the prediction error of {label} is {100 * left / whole:.3g} % of its rms. "
                "Unless this is noise, an effect is missing or at another place (rcorefine.diagnose ranks "
                "the candidates)."
            )
    poles = _poles(setup, memory)
    slowest = -float(np.max(poles.real, initial=-np.inf))
    if slowest > 0 and memory.n_samples * setup.settings.dt * slowest < 1.0 and memory.counters[1] > 0:
        found.append(
            f"Not decayed: the slowest mode has a time constant of {1 / slowest:.3g} s and the stream is "
            f"{memory.n_samples * setup.settings.dt:.3g} s long. The unknown initial state still affects "
            "the coefficients."
        )
    return found


def _poles(setup: Setup, memory: CoefficientMemory) -> NDArray[np.complex128]:
    """Return the poles of the present model in rad/s.

    Poles of a discrete model are converted to continuous time.
    """
    theta = setup.layout.view(memory.packed, "theta")
    if not np.isfinite(theta).all():
        return np.zeros(0, dtype=complex)
    return _continuous_poles(setup.system(theta, memory.widths, "refined"), setup.settings.dt)


def _continuous_poles(model: LinearModel, dt: float) -> NDArray[np.complex128]:
    poles = np.linalg.eigvals(model.A).astype(complex)
    if model.is_continuous:
        return poles
    with np.errstate(divide="ignore"):
        return np.asarray(np.log(poles) / dt)


def _unstable(setup: Setup, memory: CoefficientMemory) -> list[str]:
    before = _continuous_poles(setup.model, setup.settings.dt).real.max(initial=-np.inf)
    poles = _poles(setup, memory)
    if not poles.size:
        return []
    worst = poles[np.argmax(poles.real)]
    size = np.abs(poles[np.isfinite(poles)]).max(initial=0.0)
    if worst.real <= max(before, 0.0) + 1e-9 * size:
        return []
    return [
        f"Unstable: the refined model has a pole at {worst:.4g} rad/s. A wrong place or a missing effect "
        "can cause it."
    ]


def _bounds(setup: Setup, memory: CoefficientMemory) -> list[str]:
    theta = setup.layout.view(memory.packed, "theta")
    lower, upper = setup.bounds
    held = [
        label
        for label, value, low, high in zip(setup.labels, theta, lower, upper, strict=True)
        if (value <= low and value != 0) or (value >= high and value != 0)
    ]
    return [f"At its bound: {', '.join(held)}."] if held else []
