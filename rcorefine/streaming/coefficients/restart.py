"""The first samples gone over again, from the coefficients found so far.

The state at the start and the first coefficients are wrong together; a filter that starts at
better coefficients does not have to unlearn what the wrong ones said about the state.
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from ...systems.conversion import to_discrete
from ...systems.linear import Array
from ..free_run import state_power
from .memory import CoefficientMemory
from .setup import DOUBT
from .stage import advanced

if TYPE_CHECKING:
    from .entries import EntriesSetup

__all__ = ["go_over"]


def go_over(setup: EntriesSetup, memory: CoefficientMemory) -> CoefficientMemory:
    """Memory after the first samples, gone over again from the present coefficients.

    Where that diverges, the filter goes on as it was.
    """
    lay = setup.layout
    memory = _sized(setup, memory)
    packed = np.zeros(lay.size)
    theta = lay.view(memory.packed, "theta").copy()
    lay.view(packed, "theta")[:] = theta
    lay.view(packed, "Pb")[:] = np.diag(memory.states**2)
    lay.view(packed, "Pt")[:] = setup.prior_covariance(memory.spread)
    lay.view(packed, "level")[:] = memory.sizes[-lay.ny :] ** 2
    lay.view(packed, "count")[:] = DOUBT
    about = replace(
        memory,
        packed=packed,
        counters=setup.counters(),
        centre=theta,
        rounds=memory.rounds + 1,
        kernel=None,
        doubted=0,
    )
    found, done = advanced(setup, about, about.first, lay.record(0))
    if done == len(about.inputs) and np.isfinite(found.packed).all():
        return found
    if memory.rounds == 0:  # from now on sample by sample: the guard says where it fails
        return about
    return replace(memory, rounds=memory.rounds + 1, kernel=None)


def _sized(setup: EntriesSetup, memory: CoefficientMemory) -> CoefficientMemory:
    """Memory with the sizes of signals and states, and the prior that goes with them."""
    count = np.maximum(memory.use.sum(axis=0), 1)
    outputs = np.sqrt(np.sum(np.where(memory.use, memory.outputs, 0.0) ** 2, axis=0) / count)
    outputs = np.where(outputs > 0, outputs, 1.0)
    inputs = np.sqrt(np.mean(memory.inputs**2, axis=0))
    states = _state_sizes(setup, memory.inputs, outputs)
    spread = setup.prior(states, inputs, outputs)
    return replace(memory, sizes=np.concatenate([inputs, outputs]), states=states, spread=spread)


def _state_sizes(setup: EntriesSetup, inputs: Array, outputs: Array) -> Array:
    """Rms of the initial model's states on these inputs, or what the outputs show of them.

    An unstable model is followed no longer than it takes to grow twentyfold: under a
    controller its states do not leave that range either.
    """
    discrete = to_discrete(setup.base, setup.settings.dt, setup.settings.hold)
    poles = np.abs(np.linalg.eigvals(discrete.A)) if discrete.n_states else np.zeros(0)
    growth = np.log(max(float(poles.max(initial=0.0)), 1.0))
    span = len(inputs) if growth * len(inputs) < 3.0 else max(int(3.0 / growth), 1)
    shown = np.abs(np.linalg.pinv(discrete.C)) @ outputs
    sizes = np.hypot(np.sqrt(state_power(discrete.A, discrete.B, inputs[:span])), shown)
    return np.where(sizes > 0, sizes, 1.0)
