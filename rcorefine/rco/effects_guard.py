"""Why the physical stage failed, or may not be trusted, in words."""

from __future__ import annotations

import numpy as np

from ..exceptions import DivergenceError
from .effects_memory import EffectsMemory
from .effects_setup import EffectsSetup

__all__ = ["explain_divergence"]


def explain_divergence(setup: EffectsSetup, memory: EffectsMemory, sample: int) -> DivergenceError:
    """Error that says when the state left all bounds, and why."""
    theta = setup.layout.view(memory.packed, "theta")
    s = setup.structure(memory.widths)
    sentences = [
        f"the physical stage diverged at sample {sample} (t = {sample * setup.dt:.6g} s); "
        "the state before is readable."
    ]
    if np.isfinite(theta).all():
        poles = np.linalg.eigvals(s.matrices(theta).A)
        worst = poles[np.argmax(poles.real)]
        if worst.real > 0:
            sentences.append(
                f"Refined model: unstable, with a pole at {worst:.4g} rad/s. A wrong place can drive it "
                "there; choose other effects, give a start, or a prior about it."
            )
    return DivergenceError(" ".join(sentences))
