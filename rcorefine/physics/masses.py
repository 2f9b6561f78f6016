"""Masses from the symmetry of the stiffness matrix and from the inputs."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from ..systems.linear import Array, LinearModel

if TYPE_CHECKING:
    from .detection import Displacement

__all__ = ["MassScale", "relative_masses"]

_ASYMMETRY = 0.05  # ratios that differ by more are not those of one set of masses


@dataclass(frozen=True, slots=True, eq=False)
class MassScale:
    """Masses of the velocity states, as far as the matrices tell them.

    Parameters
    ----------
    mass : ndarray of shape (n,)
        Mass that belongs to each state, 1 where nothing is known.
    origin : tuple of str
        Where each comes from, in words.
    links : frozenset of tuple of int
        Pairs of velocity states (lower index first) with a two-sided link.
    base_acceleration : ndarray of shape (n_w,)
        1 for the input that is the acceleration of the base, otherwise 0.
    """

    mass: Array
    origin: tuple[str, ...]
    links: frozenset[tuple[int, int]]
    base_acceleration: Array

    def linked(self, one: int, two: int) -> bool:
        """Whether a two-sided link joins two velocity states."""
        return (min(one, two), max(one, two)) in self.links


def relative_masses(
    linear: LinearModel, displacements: Sequence[Displacement], tolerance: float
) -> MassScale:
    """Masses that make the couplings in A symmetric, scaled by an input where one tells.

    Parameters
    ----------
    linear : LinearModel
        Continuous-time model.
    displacements : sequence of Displacement
        Its displacement states.
    tolerance : float
        Relative size below which an entry counts as zero.

    Returns
    -------
    MassScale
        Masses, links and the base input.
    """
    n, labels = linear.n_states, linear.state_labels
    ratios = _ratios(linear.A, displacements, tolerance)
    states = sorted({s for item in displacements for s in (item.moving, item.other) if s is not None})
    logs, kept, group = _solve(states, ratios)
    base = _base_acceleration(linear, states)
    mass = np.ones(n)
    origin = [f"forces are per unit mass of {label}" for label in labels]
    anchors = _anchors(linear, base, tolerance)
    for members in group:
        known = [state for state in members if state in anchors]
        anchor = min(known, key=lambda state: anchors[state][1]) if known else members[0]
        size = anchors[anchor][0] if known else 1.0
        for state in members:
            mass[state] = size * np.exp(logs[state] - logs[anchor])
            if known:
                source = linear.input_labels[anchors[anchor][1]]
                origin[state] = f"mass {mass[state]:.4g} from the input {source}"
                if state != anchor:
                    origin[state] += " and the symmetry of A"
            else:
                origin[state] = f"forces are per unit mass of {labels[anchor]}"
    for state, (value, column) in anchors.items():
        if state not in states:  # a store that an input fills
            mass[state] = value
            origin[state] = f"mass {value:.4g} from the input {linear.input_labels[column]}"
    return MassScale(mass, tuple(origin), frozenset(kept), base)


def _ratios(
    A: Array, displacements: Sequence[Displacement], tolerance: float
) -> dict[tuple[int, int], float]:
    """log(m_j / m_i) of each pair of velocity states that are coupled both ways."""
    found: dict[tuple[int, int], float] = {}
    absolute = [item for item in displacements if item.absolute]
    stiffness = np.abs([[A[a.moving, b.state] for b in absolute] for a in absolute]) if absolute else None
    largest = stiffness.max(axis=1) if stiffness is not None else np.zeros(0)
    for row, one in enumerate(absolute):
        for column in range(row + 1, len(absolute)):
            two = absolute[column]
            assert one.moving is not None and two.moving is not None
            # d = scale * velocity: a force along d enters through the same mass
            forth = A[one.moving, two.state] * one.scale
            back = A[two.moving, one.state] * two.scale
            weak = abs(A[one.moving, two.state]) <= tolerance * largest[row]
            weak |= abs(A[two.moving, one.state]) <= tolerance * largest[column]
            if weak and not (forth and back):
                # no spring between them: a damper tells the same ratio
                if abs(forth) > tolerance * largest[row] or abs(back) > tolerance * largest[column]:
                    continue  # one-way coupling is not a link
                forth = A[one.moving, two.moving] / two.scale * one.scale
                back = A[two.moving, one.moving] / one.scale * two.scale
            if forth * back > 0:
                pair = (min(one.moving, two.moving), max(one.moving, two.moving))
                ratio = float(np.log(forth / back))
                found[pair] = ratio if pair[0] == one.moving else -ratio
    for item in displacements:
        if not item.absolute and item.moving is not None and item.other is not None:
            pair = (min(item.moving, item.other), max(item.moving, item.other))
            ratio = float(np.log(-A[item.moving, item.state] / A[item.other, item.state]))
            found.setdefault(pair, ratio if pair[0] == item.moving else -ratio)
    return found


def _solve(
    states: list[int], ratios: dict[tuple[int, int], float]
) -> tuple[dict[int, float], set[tuple[int, int]], list[list[int]]]:
    """Log masses that fit all ratios; pairs that do not fit are dropped, the worst first."""
    kept = dict(ratios)
    index = {state: k for k, state in enumerate(states)}
    while True:
        logs = np.zeros(len(states))
        if kept:
            rows = np.zeros((len(kept), len(states)))
            for k, (one, two) in enumerate(kept):
                rows[k, index[one]], rows[k, index[two]] = -1.0, 1.0
            target = np.array(list(kept.values()))
            logs = np.linalg.lstsq(rows, target, rcond=None)[0]
            misfit = np.abs(rows @ logs - target)
            worst = int(np.argmax(misfit))
            if misfit[worst] > _ASYMMETRY:
                del kept[list(kept)[worst]]
                continue
        return {state: float(logs[index[state]]) for state in states}, set(kept), _groups(states, kept)


def _groups(states: list[int], pairs: dict[tuple[int, int], float]) -> list[list[int]]:
    """Connected components, in the order of the states."""
    root = {state: state for state in states}
    for one, two in pairs:
        old, new = max(root[one], root[two]), min(root[one], root[two])
        root = {state: new if top == old else top for state, top in root.items()}
    return [[s for s in states if root[s] == top] for top in sorted(set(root.values()))]


def _base_acceleration(linear: LinearModel, states: list[int]) -> Array:
    """1 for an input with -1 on every velocity state and 0 elsewhere."""
    base = np.zeros(linear.n_inputs)
    if states:
        pattern = np.zeros(linear.n_states)
        pattern[states] = -1.0
        for j in range(linear.n_inputs):
            base[j] = float(np.allclose(linear.B[:, j], pattern, rtol=0, atol=1e-9))
    return base


def _anchors(linear: LinearModel, base: Array, tolerance: float) -> dict[int, tuple[float, int]]:
    """Mass 1/|B| and input of each state that exactly one input drives, that input driving it alone."""
    B = np.abs(linear.B)
    B = np.where(B > tolerance * B.max(axis=0, initial=0.0, keepdims=True), B, 0.0)
    found: dict[int, tuple[float, int]] = {}
    for i in range(linear.n_states):
        inputs = np.flatnonzero(B[i])
        if inputs.size == 1:
            j = int(inputs[0])
            if np.count_nonzero(B[:, j]) == 1 and not base[j]:
                found[i] = (float(1.0 / B[i, j]), j)
    return found
