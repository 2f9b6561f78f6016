"""Memory of a refiner as plain arrays.

It is copied before a block, so that a failed block changes nothing.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from ...systems.linear import Array
from ..restoring import check_like, check_range
from .arrays import PADDING, Design, Plant, Stage
from .path import markov_parameters
from .scaling import Scales, scaled_plant

__all__ = [
    "Memory", "Settings", "Tuned", "begin", "in_units", "regressor_length", "regressor_scale",
    "restored_memory", "start", "tuned",
]  # fmt: skip

_GROWN = {"inputs": "samples", "outputs": "samples"}


@dataclass(frozen=True, slots=True)
class Settings:
    """Numbers that shape one stage: n_c, p, mu and alpha."""

    order: int
    window: int
    markov: int
    learning_rate: float


@dataclass(frozen=True, slots=True, eq=False)
class Tuned:
    """Scaled model and designs of both stages for given scales."""

    scales: Scales
    plant: Plant
    designs: tuple[Design, Design]


@dataclass(frozen=True, slots=True, eq=False)
class Memory:
    """State of a refiner between two calls.

    Parameters
    ----------
    stages : tuple of two Stage
        Both stages.
    peak, levels : ndarray of shape (1,), (3, n_y)
        Largest scaled output; mean squares of y, z1 and z2.
    recent_theta : ndarray of shape (average, m)
        Latest coefficients of stage 2, as a ring.
    inputs, outputs : ndarray of shape (K, n_w), (K, n_y)
        First samples, held back until they tell the scales; then empty.
    n_samples : int
        Samples taken, those held back included.
    tuned : Tuned or None
        None while samples are held back.
    """

    stages: tuple[Stage, Stage]
    peak: Array
    levels: Array
    recent_theta: Array
    inputs: Array
    outputs: Array
    n_samples: int
    tuned: Tuned | None

    def static_theta(self) -> Array:
        """Return the coefficients of stage 2, averaged over the latest samples.

        They include padding and are in scaled units.
        """
        learned = int(self.stages[1].counters[4])
        count = min(max(learned, 1), self.recent_theta.shape[0])
        return np.asarray(self.recent_theta[:count].mean(axis=0))

    def copied(self, n_samples: int) -> Memory:
        """Independent copy of what changes in place, for so many samples."""
        first, second = self.stages  # dataclasses.replace takes as long as a stage
        return Memory(
            (copied(first), copied(second)),
            self.peak.copy(),
            self.levels.copy(),
            self.recent_theta.copy(),
            self.inputs,
            self.outputs,
            n_samples,
            self.tuned,
        )


def tuned(plant: Plant, scales: Scales, delay: int, settings: tuple[Settings, Settings]) -> Tuned:
    """Scale the model and cut the Markov parameters that each stage uses."""
    scaled = scaled_plant(plant, scales)
    values = markov_parameters(scaled, delay + max(s.markov for s in settings))
    first, second = (
        Design(np.ascontiguousarray(values[delay : delay + s.markov]), delay, s.order, s.learning_rate)
        for s in settings
    )
    return Tuned(scales, scaled, (first, second))


def begin(
    plant: Plant, delay: int, settings: tuple[Settings, Settings], average: int, scales: Scales | None
) -> Memory:
    """Memory before the first sample."""
    n, n_w = plant.B.shape
    n_y, l_u = plant.Du.shape
    reach = delay + max(s.markov for s in settings)
    first, second = (
        start(
            Design(np.zeros((s.markov, n_y, l_u)), delay, s.order, s.learning_rate), n, n_w, s.window, reach
        )
        for s in settings
    )
    return Memory(
        stages=(first, second),
        peak=np.ones(1),
        levels=np.zeros((3, n_y)),
        recent_theta=np.zeros((average, second.theta.size)),
        inputs=np.zeros((0, n_w)),
        outputs=np.zeros((0, n_y)),
        n_samples=0,
        tuned=None if scales is None else tuned(plant, scales, delay, settings),
    )


def restored_memory(
    found: Memory, plant: Plant, delay: int, settings: tuple[Settings, Settings], average: int
) -> Memory:
    """Return the memory from a file after checking it.

    It is checked against a fresh memory. What follows from the scales is computed again.

    Raises
    ------
    DataError
        If a refiner with these settings cannot have left it.
    """
    check_like(replace(found, tuned=None), begin(plant, delay, settings, average, None), "memory", _GROWN)
    n_y = plant.C.shape[0]
    waiting = len(found.inputs)
    check_range(
        waiting, 0 if found.tuned else found.n_samples, 0 if found.tuned else found.n_samples, "inputs"
    )
    check_range(found.peak, 1.0, np.inf, "peak")
    for stage in found.stages:
        slots, recent = stage.rows.shape[0] // n_y, stage.past_u.shape[0]
        check_range(
            stage.counters, 0, [slots - 1, found.n_samples, 1, recent - 1, found.n_samples], "counters"
        )
    if found.tuned is None:
        return found
    scales = found.tuned.scales
    check_like(
        scales,
        Scales(*(np.ones(size) for size in (plant.B.shape[1], n_y, plant.A.shape[0], plant.Bu.shape[1]))),
        "scales",
    )
    for name in ("inputs", "outputs", "states", "corrections"):
        check_range(getattr(scales, name), np.finfo(float).tiny, np.finfo(float).max, f"scales.{name}")
    return replace(found, tuned=tuned(plant, scales, delay, settings))


def regressor_length(n: int, n_w: int, l_u: int, order: int) -> int:
    """Length of psi: (n_c + 1) (n + n_w) + n_c l_u."""
    return (order + 1) * (n + n_w) + order * l_u


def start(design: Design, n: int, n_w: int, window: int, memory: int) -> Stage:
    """Memory of a stage before the first sample: theta = 0, an empty window.

    Parameters
    ----------
    design : Design
        Settings of the stage.
    n, n_w : int
        Number of states and inputs.
    window : int
        Samples in the sliding window.
    memory : int
        Past samples that Markov parameters reach back to.
    """
    _, n_y, l_u = design.H.shape
    q = regressor_length(n, n_w, l_u, design.order)
    m = -(-l_u * q // PADDING) * PADDING
    return Stage(
        theta=np.zeros(m),
        gain=np.eye(m) / design.alpha,
        pending=np.zeros((2, m)),
        rows=np.zeros((window * n_y, m)),
        offsets=np.zeros(window * n_y),
        psi=np.zeros(q),
        past_psi=np.zeros((memory, q)),
        past_u=np.zeros((memory, l_u)),
        x=np.zeros(n),
        energy=np.zeros(1),
        counters=np.zeros(5, dtype=np.int64),
    )


def copied(stage: Stage) -> Stage:
    """Independent copy, on which a block can fail without harm."""
    return Stage._make(map(np.ndarray.copy, stage))


def regressor_scale(states: Array, inputs: Array, corrections: Array, order: int) -> Array:
    """Units of psi from those of x, w and u."""
    return np.concatenate(
        [np.tile(states, order + 1), np.tile(inputs, order + 1), np.tile(corrections, order)]
    )


def in_units(theta: Array, scales: Scales, order: int) -> Array:
    """Return coefficients in the units of the signals.

    `theta` has shape (..., m) with padding, the result (..., l_u, l_psi).
    """
    units = regressor_scale(scales.states, scales.inputs, scales.corrections, order)
    l_u, q = scales.corrections.size, units.size
    plain = theta[..., : l_u * q].reshape(*theta.shape[:-1], l_u, q)
    return np.asarray(plain * scales.corrections[:, None] / units)
