"""The memory of one stage: plain arrays, made, copied and given back their units."""

from __future__ import annotations

import numpy as np

from ...systems.linear import Array
from .arrays import PADDING, Design, Stage
from .scaling import Scales

__all__ = ["copied", "in_units", "regressor_length", "regressor_scale", "start"]


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
    """Coefficients (..., m) with padding, as (..., l_u, l_psi) in the units of the signals."""
    units = regressor_scale(scales.states, scales.inputs, scales.corrections, order)
    l_u, q = scales.corrections.size, units.size
    plain = theta[..., : l_u * q].reshape(*theta.shape[:-1], l_u, q)
    return np.asarray(plain * scales.corrections[:, None] / units)
