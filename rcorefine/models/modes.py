"""Modal coordinates: two states per mode, with frequency and damping."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ..systems.linear import Array, LinearModel
from .bodies import connected
from .displacements import Displacement, significant
from .link_ports import row_of
from .ports import Port

__all__ = ["Mode", "find_modes"]

_SAME = 1e-3  # relative difference of entries that rounding to four digits explains


@dataclass(frozen=True, slots=True, eq=False)
class Mode:
    """A mode of a model in modal coordinates, its modal mass taken as one.

    Parameters
    ----------
    states : tuple of int
        Its two states.
    port : Port
        Its place: the modal displacement, which no input drives at once.
    stiffness, damping : float
        Square of the natural frequency, and twice the damping ratio times the frequency.
    """

    states: tuple[int, int]
    port: Port
    stiffness: float
    damping: float


def find_modes(
    linear: LinearModel, displacements: Sequence[Displacement], tolerance: float = 1e-9
) -> list[Mode]:
    """Modes of a model in modal coordinates.

    Parameters
    ----------
    linear : LinearModel
        Continuous-time model.
    displacements : sequence of Displacement
        Its displacement states.
    tolerance : float, optional
        Relative size below which an entry counts as zero.

    Returns
    -------
    list of Mode
        Empty in physical coordinates.

    Notes
    -----
    Blocks ``[[s, w], [-w, s]]`` are modes. Blocks ``[[0, 1], [-k, -c]]`` may as well be masses on springs of
    their own: they are modes where an input drives, and an output reads, several of them.
    """
    A = significant(linear.A, tolerance)
    owned = {(item.state, item.moving) for item in displacements if item.absolute}
    rotating, oscillators = [], []
    for block in connected((A != 0) | (A != 0).T):
        if len(block) != 2:
            continue
        i, j = block
        spins = abs(A[i, j] + A[j, i]) <= _SAME * abs(A[i, j]) and A[i, j] * A[j, i] < 0
        if spins and abs(A[i, i] - A[j, j]) <= _SAME * abs(A[i, j]) and A[i, i] and A[j, j]:
            rotating.append((i, j))
        elif (i, j) in owned or (j, i) in owned:
            oscillators.append((i, j) if (i, j) in owned else (j, i))
    if not _shared(linear.B.T, oscillators) or not _shared(linear.C, oscillators):
        oscillators = []
    return [_mode(linear, i, j) for i, j in sorted([*rotating, *oscillators])]


def _shared(rows: Array, blocks: Sequence[tuple[int, int]]) -> bool:
    """Return whether one signal belongs to several of the blocks."""
    size = np.abs(rows) > 1e-9 * np.abs(rows).max(axis=1, keepdims=True, initial=0.0)
    return any(sum(bool(row[[i, j]].any()) for i, j in blocks) > 1 for row in size)


def _mode(linear: LinearModel, i: int, j: int) -> Mode:
    pair = [i, j]
    A, B = linear.A[np.ix_(pair, pair)], linear.B[pair]
    drive = np.linalg.svd(B)[0][:, 0] if B.any() else np.array([0.0, 1.0])
    across = np.array([drive[1], -drive[0]])  # what the main input drives only by way of its rate
    across *= np.sign(across[np.argmax(np.abs(across))])
    rate = across @ A
    act = -drive / float(rate @ drive)
    square, twice = float(np.linalg.det(A)), -float(np.trace(A))
    frequency, n = np.sqrt(square), linear.n_states
    labels = linear.state_labels
    port = Port(
        labels[i],
        "mechanical",
        act=row_of(n, dict(zip(pair, act.tolist(), strict=True))),
        position=row_of(n, dict(zip(pair, across.tolist(), strict=True))),
        position_input=np.zeros(linear.n_inputs),
        velocity=row_of(n, dict(zip(pair, rate.tolist(), strict=True))),
        velocity_input=np.where(np.abs(across @ B) > 1e-12 * np.abs(B).max(initial=0.0), across @ B, 0.0),
        description=(
            f"mode of {frequency:.4g} rad/s, damping ratio {twice / 2 / frequency:.3g}, states {labels[i]} "
            f"and {labels[j]}; forces are per modal mass"
        ),
        modal=True,
    )
    return Mode((i, j), port, square, twice)
