"""Why the physical stage failed, or may not be trusted, in words."""

from __future__ import annotations

import numpy as np

from ..exceptions import DivergenceError
from .effects_memory import EffectsMemory
from .effects_setup import EffectsSetup

__all__ = ["cautions", "explain_divergence"]

_UNLEARNED = 0.5  # of its prior deviation: a coefficient that is no better known has not been seen
_UNEXPLAINED = 0.3  # of the rms of an output left in the innovations: the effects do not explain it
_ALIKE = 0.995  # correlation of two estimates that the sensors can hardly tell apart


def explain_divergence(setup: EffectsSetup, memory: EffectsMemory, sample: int) -> DivergenceError:
    """Error that says when the state left all bounds, and why."""
    sentences = [
        f"the physical stage diverged at sample {sample} (t = {sample * setup.dt:.6g} s); "
        "the state before is readable.",
        *_poles(setup, memory),
        *_bounds(setup, memory),
        "Place: choose other effects, give them a start or a prior, or declare the noise of the sensors.",
    ]
    return DivergenceError(" ".join(sentences))


def cautions(setup: EffectsSetup, memory: EffectsMemory) -> list[str]:
    """What speaks against trusting the coefficients."""
    if memory.rounds == 0 or not memory.spread.size:
        return []
    lay = setup.layout
    names = [q.label for q in setup.bare.parameters]
    P = lay.view(memory.packed, "Pt")
    std = np.sqrt(np.maximum(np.diag(P), 0.0))
    found = [*_poles(setup, memory), *_bounds(setup, memory)]
    blind = [
        name for name, one, prior in zip(names, std, memory.spread, strict=True) if one > _UNLEARNED * prior
    ]
    if blind:
        found.append(
            f"Not excited: the samples say next to nothing about {', '.join(blind)}; excite or omit it."
        )
    with np.errstate(divide="ignore", invalid="ignore"):
        correlation = np.abs(P) / np.outer(std, std)
    pairs = [
        f"{names[i]} and {names[j]}"
        for i in range(len(names))
        for j in range(i)
        if correlation[i, j] > _ALIKE
    ]
    if pairs:
        found.append(f"Hardly told apart by these sensors: {'; '.join(pairs[:3])}.")
    level = np.sqrt(lay.view(memory.packed, "level")[1])
    size = memory.sizes[-lay.ny :]
    for label, left, whole, declared in zip(setup.model.output_labels, level, size, setup.noise, strict=True):
        if declared > 0 and left > 2.0 * declared:
            found.append(
                f"Not explained: {label} is missed by {left:.3g}, the declared noise is {declared:.3g}; "
                "another effect or place is at work."
            )
        elif declared == 0 and left > _UNEXPLAINED * whole:
            found.append(
                f"Not explained: {label} is missed by {100 * left / whole:.3g} % of its size; unless that is "
                "noise, another effect or place is at work (rcorefine.diagnose ranks them)."
            )
    slowest = -float(np.max(np.linalg.eigvals(setup.bare.matrices(lay.view(memory.packed, "theta")).A).real))
    if slowest > 0 and memory.n_samples * setup.dt * slowest < 1.0 and memory.counters[1] > 0:
        found.append(
            f"Not decayed: the slowest mode takes {1 / slowest:.3g} s to fade and the stream is "
            f"{memory.n_samples * setup.dt:.3g} s long; the unknown initial state still matters."
        )
    return found


def _poles(setup: EffectsSetup, memory: EffectsMemory) -> list[str]:
    theta = setup.layout.view(memory.packed, "theta")
    if not np.isfinite(theta).all():
        return []
    before = np.linalg.eigvals(setup.model.A).real.max(initial=-np.inf)
    poles = np.linalg.eigvals(setup.bare.matrices(theta).A)
    worst = poles[np.argmax(poles.real)]
    if worst.real <= max(before, 0.0) + 1e-9 * np.abs(poles).max():
        return []
    return [
        f"Unstable: the refined model has a pole at {worst:.4g} rad/s; a wrong place, or an effect that is "
        "missing, can drive it there."
    ]


def _bounds(setup: EffectsSetup, memory: EffectsMemory) -> list[str]:
    theta = setup.layout.view(memory.packed, "theta")
    lower, upper = setup.bounds
    held = [
        q.label
        for q, value, low, high in zip(setup.bare.parameters, theta, lower, upper, strict=True)
        if (value <= low and value != 0) or (value >= high and value != 0)
    ]
    return [f"At its bound: {', '.join(held)}."] if held else []
