"""Parameters and accelerometers in the matrices of a plain StateSpace."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from ..effects.dampers import Damping
from ..effects.entries import Entry
from ..effects.input_path import InputGain
from ..effects.springs import Stiffness
from ..systems.linear import Array, LinearModel
from .displacements import Displacement, find_displacements, significant
from .link_ports import Link
from .masses import MassScale
from .modes import Mode
from .parameters import NominalParameter
from .ports import Port

__all__ = ["find_rate_sensors", "read_parameters"]

_LEFT = 1e-9  # relative size of what cancellation leaves behind
_ROUNDED = 2e-3  # and of what four digits of the entries leave of a coupling


def read_parameters(
    linear: LinearModel,
    displacements: Sequence[Displacement],
    by_state: Mapping[int, Port],
    links: Sequence[Link],
    modes: Sequence[Mode],
    masses: MassScale,
    tolerance: float,
) -> tuple[NominalParameter, ...]:
    """Return stiffness and damping by place, other entries of A, and gains.

    The gains are those of the inputs.

    Parameters
    ----------
    linear : LinearModel
        Continuous-time model.
    displacements : sequence of Displacement
        Its displacement states.
    by_state : mapping of int to Port
        Absolute ports and elongations by their state.
    links : sequence of Link
        Links between displacements.
    modes : sequence of Mode
        Modes, where the coordinates are modal.
    masses : MassScale
        Masses of the velocity states.
    tolerance : float
        Relative size below which an entry counts as zero.

    Returns
    -------
    tuple of NominalParameter
        Those that are not zero.

    Notes
    -----
    The links are taken off a copy of A, then springs and dampers to the ground. What is left over
    (first-order states, one-way couplings) is listed entry by entry.
    """
    rest = _Rest(linear, tolerance)
    for mode in modes:
        rest.off(mode.port, Stiffness.name, mode.stiffness)
        rest.off(mode.port, Damping.name, mode.damping)
        rest.left[list(mode.states)] = 0.0
    for link in links:
        rest.off(link.port, Stiffness.name, link.stiffness)
        rest.off(link.port, Damping.name, link.damping)
    if links:
        rest.round_off([(i.moving, i.state) for i in displacements if i.absolute and i.moving is not None])
    for item in displacements:
        if not item.absolute:
            _take_elongation(rest, by_state[item.state], item)
    for item in displacements:
        if item.absolute and item.moving is not None:
            rest.take(by_state[item.state], Stiffness.name, item.moving, item.state)
            rest.take(by_state[item.state], Damping.name, item.moving, item.moving)
    if masses.shared:
        rest.left[np.abs(rest.left) <= _ROUNDED * rest.scale] = 0.0
    for state, port in by_state.items():
        if port.kind == "mechanical" and not port.has_position:
            rest.take(port, Damping.name, state, state)

    found, kinematic = rest.found, {item.state for item in displacements}
    for i, j in np.argwhere(rest.left):
        if int(i) not in kinematic:
            place = f"A[{i},{j}]"
            found.append(NominalParameter(place, float(linear.A[i, j]), "", Entry.name, place, False))
    found.extend(
        NominalParameter(f"gain[{label}]", 1.0, "1", InputGain.name, label, False)
        for label, base, column in zip(linear.input_labels, masses.base_acceleration, linear.B.T, strict=True)
        if column.any() and not base
    )
    return tuple(found)


class _Rest:
    """Remainder of A while links are subtracted."""

    def __init__(self, linear: LinearModel, tolerance: float) -> None:
        self.B, self.tolerance = linear.B, tolerance
        self.left, self.scale = significant(linear.A, tolerance), np.abs(linear.A)
        self.found: list[NominalParameter] = []

    def take(self, port: Port, kind: str, row: int, column: int) -> None:
        """Find the coefficient that explains the rest of an entry.

        Its contribution to all entries is subtracted.
        """
        sensed = port.position if kind == Stiffness.name else port.velocity
        if abs(self.left[row, column]) > _LEFT * self.scale[row, column]:
            self.off(port, kind, float(self.left[row, column] / (port.act[row] * sensed[column])))

    def take_from_input(self, port: Port, row: int) -> None:
        """A damper whose other end is an input: it shows in B."""
        column = int(np.argmax(np.abs(port.velocity_input)))
        value = float(self.B[row, column] / (port.act[row] * port.velocity_input[column]))
        if abs(self.B[row, column]) > self.tolerance * np.abs(self.B[:, column]).max():
            self.off(port, Damping.name, value)

    def round_off(self, masses: Sequence[tuple[int, int]]) -> None:
        """Set the rounding errors of the links at masses to zero.

        `masses` holds pairs of velocity and displacement states.
        """
        for row, own in masses:
            left = self.left[row]
            rounded = np.abs(left) <= _ROUNDED * self.scale[row]
            rounded[[row, own]] &= left[[row, own]] > 0  # a soft spring to the ground may be there
            left[rounded] = 0.0

    def off(self, port: Port, kind: str, value: float) -> None:
        """Enter a coefficient, and take its part off."""
        if not value:
            return
        letter, sensed = ("k", port.position) if kind == Stiffness.name else ("c", port.velocity)
        self.found.append(
            NominalParameter(f"{letter}[{port.name}]", float(value), "", kind, port.name, False)
        )
        self.left -= value * np.outer(port.act, sensed)
        self.left[np.abs(self.left) <= _LEFT * self.scale] = 0.0


def _take_elongation(rest: _Rest, port: Port, item: Displacement) -> None:
    end = item.moving if item.moving is not None else item.other
    assert end is not None
    rest.take(port, Stiffness.name, end, item.state)
    if item.moving is not None and item.other is not None:
        rest.take(port, Damping.name, end, item.other)
    else:
        rest.take_from_input(port, end)


def find_rate_sensors(linear: LinearModel, tolerance: float = 1e-9) -> Array:
    """Find the outputs that read rates of velocity states (accelerometers).

    Parameters
    ----------
    linear : LinearModel
        Continuous-time model.
    tolerance : float, optional
        Relative size below which an entry counts as zero.

    Returns
    -------
    ndarray of shape (n_y, n)
        Ca with C = Ca A for the outputs that are accelerations, zero rows for others.

    Notes
    -----
    The row of C is an acceleration if it is a combination of rows of A that belong to
    velocity states, and that is the shorter way to say it. In an undamped model
    every displacement is such a combination, so there the weights must be 1 (or the direct
    part of the input must agree).
    """
    displacements = find_displacements(linear, tolerance)
    moving = {item.moving for item in displacements} | {item.other for item in displacements}
    rows = sorted(state for state in moving if state is not None)
    rate = np.zeros((linear.n_outputs, linear.n_states))
    for y, (c, d) in enumerate(zip(linear.C, linear.D, strict=True)):
        weights = _rate_weights(linear, rows, c, d, tolerance)
        if weights is not None:
            rate[y, rows] = weights
    return rate


def _rate_weights(linear: LinearModel, rows: list[int], c: Array, d: Array, tolerance: float) -> Array | None:
    if not rows or not c.any():
        return None
    A, B = linear.A[rows], linear.B[rows]
    candidates: list[Array] = []
    for index, row in enumerate(A):  # a single accelerometer is the plainest reading
        if row.any():
            weights = np.zeros(len(rows))
            weights[index] = (c @ row) / (row @ row)
            candidates.append(weights)
    candidates.sort(key=lambda weights: abs(abs(weights).max() - 1.0))
    candidates.append(np.asarray(np.linalg.lstsq(A.T, c, rcond=None)[0], dtype=np.float64))
    for weights in candidates:
        weights = np.where(np.abs(weights) > 1e-9 * np.abs(weights).max(), weights, 0.0)
        if np.abs(weights @ A - c).max() > max(10 * tolerance, 1e-9) * np.abs(c).max():
            continue
        used = np.flatnonzero(weights)
        unit = bool(np.allclose(np.abs(weights[used]), 1.0, rtol=1e-6))
        direct = weights @ B
        agrees = bool(direct.any() and np.allclose(direct, d, rtol=1e-6, atol=1e-9 * np.abs(direct).max()))
        damped = bool(np.any(c[rows]))
        shorter = used.size < np.count_nonzero(np.abs(c) > tolerance * np.abs(c).max())
        if agrees or (unit and (shorter or used.size == 1)) or (damped and shorter):
            return np.asarray(weights, dtype=np.float64)
    return None
