"""Find masses, springs and stores in the matrices of a plain StateSpace."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import combinations

import numpy as np

from ..systems.linear import Array, LinearModel
from .masses import MassScale, relative_masses
from .physical_model import NominalParameter
from .ports import Port

__all__ = ["Displacement", "find_displacements", "find_ports", "find_rate_sensors", "is_companion"]


@dataclass(frozen=True, slots=True)
class Displacement:
    """A state whose derivative is a velocity or a difference of two.

    Parameters
    ----------
    state : int
        Index of the displacement.
    moving, other : int or None
        Velocity states: d' = scale x_moving - scale x_other + input part.
    absolute : bool
        Whether the state belongs to one mass (and not to a link, an elongation).
    scale : float
        1 unless displacement and velocity have different units.
    """

    state: int
    moving: int | None
    other: int | None
    absolute: bool
    scale: float


def is_companion(A: Array, tolerance: float = 1e-9) -> bool:
    """Whether A is a companion matrix, as in the canonical forms.

    Parameters
    ----------
    A : ndarray of shape (n, n)
        State matrix, the states in any order.
    tolerance : float, optional
        Relative size below which an entry counts as zero.

    Returns
    -------
    bool
        True for n >= 3 if all of A but one row or one column is a chain of ones.
        (With two states the controllable form is that of a mass on a spring.)
    """
    n = A.shape[0]
    if n < 3:
        return False
    for matrix in (A, A.T):
        for free in range(n):
            chain = matrix.copy()
            chain[:, free] = 0.0
            chain[np.abs(chain) <= tolerance] = 0.0
            rest = np.delete(chain, free, axis=1)
            if (np.count_nonzero(rest, axis=0) != 1).any() or not np.allclose(rest.sum(axis=0), 1.0):
                continue
            # nilpotent of full index = one path through all the states
            if np.any(np.linalg.matrix_power(chain, n - 1)):
                return True
    return False


def _significant(A: Array, tolerance: float) -> Array:
    """A with the entries that are noise in both their row and their column set to zero."""
    size = np.abs(A)
    limit = tolerance * np.minimum(size.max(axis=1, keepdims=True), size.max(axis=0, keepdims=True))
    return np.where(size > limit, A, 0.0)


def find_displacements(linear: LinearModel, tolerance: float = 1e-9) -> list[Displacement]:
    """Displacement states of a continuous-time model.

    Parameters
    ----------
    linear : LinearModel
        Continuous-time model.
    tolerance : float, optional
        Relative size below which an entry counts as zero.

    Returns
    -------
    list of Displacement
        In the order of the states; empty for canonical forms.
    """
    A, B = linear.A, linear.B
    n = linear.n_states
    if is_companion(A, tolerance):
        return []
    columns = np.abs(B).max(axis=0, initial=0.0)
    driven = [bool((np.abs(B[i]) > tolerance * np.maximum(columns, 1e-300)).any()) for i in range(n)]
    entries = [np.flatnonzero(np.abs(A[i]) > tolerance * np.abs(A[i]).max()) for i in range(n)]

    single = {
        i: int(entries[i][0])
        for i in range(n)
        if entries[i].size == 1 and entries[i][0] != i and not driven[i]
    }
    found: list[Displacement] = []
    for i, j in single.items():
        scale = float(A[i, j])
        # another unit (or an LC pair) is believed only if a spring acts back
        if not (abs(scale - 1.0) <= 10 * tolerance or (scale > 0 and A[j, i] < 0)):
            continue
        if single.get(j, i) != i:
            continue  # integral of a displacement, or an inner state of a chain
        if any(k != i and single.get(k) == i and k in entries[j] for k in single):
            continue  # the chain of integrators closes on itself: coordinates without a meaning
        if any(item.moving == j for item in found):
            continue  # a second integral of the same velocity
        found.append(Displacement(i, j, None, True, scale))

    taken = {item.state for item in found}
    for i in range(n):
        if i not in taken and i not in single:
            link = _elongation(A, i, entries[i], taken, driven[i], tolerance)
            if link is not None:
                found.append(link)
    moving = {item.moving for item in found} | {item.other for item in found}
    return sorted((item for item in found if item.state not in moving), key=lambda item: item.state)


def _elongation(
    A: Array, i: int, entries: Array, taken: set[int], driven: bool, tolerance: float
) -> Displacement | None:
    """State whose derivative is v_j - v_k, v_j - w or w - v_k, with a spring acting back."""
    if i in entries or any(int(j) in taken for j in entries):
        return None
    if not (entries.size == 2 or (entries.size == 1 and driven)):
        return None
    plus = [int(j) for j in entries if A[i, j] > 0]
    minus = [int(j) for j in entries if A[i, j] < 0]
    if len(plus) > 1 or len(minus) > 1:
        return None
    scale = float(np.abs(A[i, entries]).max())
    if np.ptp(np.abs(A[i, entries])) > 1e-6 * scale:
        return None
    if any(A[j, i] >= 0 for j in plus) or any(A[k, i] <= 0 for k in minus):
        return None
    return Displacement(i, plus[0] if plus else None, minus[0] if minus else None, False, scale)


def find_ports(
    linear: LinearModel, tolerance: float = 1e-9
) -> tuple[tuple[Port, ...], tuple[NominalParameter, ...]]:
    """Ports and nominal parameters of a plain model.

    Parameters
    ----------
    linear : LinearModel
        Continuous-time model.
    tolerance : float, optional
        Relative size below which an entry counts as zero.

    Returns
    -------
    ports : tuple of Port
        Absolute ports in the order of the states, then relative ones.
    parameters : tuple of NominalParameter
        Nonzero stiffness, damping and coefficients, and the input gains.
    """
    displacements = find_displacements(linear, tolerance)
    masses = relative_masses(linear, displacements, tolerance)
    mechanical = [_mechanical_port(linear, item, masses) for item in displacements]
    between = [
        _between_masses(linear, first, second, masses)
        for first, second in combinations([item for item in displacements if item.absolute], 2)
        if first.moving is not None and second.moving is not None
        if masses.linked(first.moving, second.moving)
    ]
    used = {item.state for item in displacements}
    used |= {item.moving for item in displacements if item.absolute and item.moving is not None}
    rest = [i for i in range(linear.n_states) if i not in used]
    simple = [_first_order_port(linear, i, masses) for i in rest]
    exchange = _exchange_ports(linear, rest, tolerance, canonical=is_companion(linear.A, tolerance))

    names = linear.state_labels
    order = {names[item.state]: item.state for item in displacements} | {names[i]: i for i in rest}
    absolute = sorted(mechanical + simple, key=lambda port: order[port.name])
    found = (*absolute, *between, *exchange)
    return found, _parameters(linear, displacements, masses, between, tolerance)


def _mechanical_port(linear: LinearModel, item: Displacement, masses: MassScale) -> Port:
    act = np.zeros(linear.n_states)
    words = []
    for state, sign in ((item.moving, -1.0), (item.other, 1.0)):
        if state is not None:
            act[state] = sign * item.scale / masses.mass[state]
            words.append(masses.origin[state])
    position = np.zeros(linear.n_states)
    position[item.state] = 1.0
    velocity = np.zeros(linear.n_states)
    for state, sign in ((item.moving, 1.0), (item.other, -1.0)):
        if state is not None:
            velocity[state] = sign * item.scale
    if item.absolute:
        # virtual work: f acts along d, so through the mass of x_moving only
        act[item.moving] = -1.0 / masses.mass[item.moving]  # type: ignore[index]
    labels = linear.state_labels
    speed = " - ".join(labels[s] for s in (item.moving, item.other) if s is not None)
    if item.absolute:
        description = f"displacement {labels[item.state]}, velocity {speed}; {words[0]}"
    else:
        description = f"elongation {labels[item.state]}, its rate from {speed}; {'; '.join(words)}"
    base = masses.base_acceleration
    return Port(
        labels[item.state],
        "mechanical",
        act=act,
        position=position,
        position_input=np.zeros(linear.n_inputs),
        velocity=velocity,
        velocity_input=np.zeros(linear.n_inputs) if item.absolute else linear.B[item.state].copy(),
        acceleration_input=base.copy() if item.absolute else np.zeros(linear.n_inputs),
        description=description,
    )


def _between_masses(
    linear: LinearModel, first: Displacement, second: Displacement, masses: MassScale
) -> Port:
    one, two = first.moving, second.moving
    assert one is not None and two is not None
    n, labels = linear.n_states, linear.state_labels
    act, position, velocity = np.zeros(n), np.zeros(n), np.zeros(n)
    act[one], act[two] = -1.0 / masses.mass[one], 1.0 / masses.mass[two]
    position[first.state], position[second.state] = 1.0, -1.0
    velocity[one], velocity[two] = first.scale, -second.scale
    name = f"{labels[first.state]}-{labels[second.state]}"
    ratio = masses.mass[two] / masses.mass[one]
    return Port(
        name,
        "mechanical",
        act=act,
        position=position,
        velocity=velocity,
        position_input=np.zeros(linear.n_inputs),
        velocity_input=np.zeros(linear.n_inputs),
        acceleration_input=np.zeros(linear.n_inputs),
        description=(
            f"between {labels[first.state]} and {labels[second.state]} (d = {name}); "
            f"mass ratio {ratio:.4g} from the symmetry of A; {masses.origin[one]}"
        ),
    )


def _first_order_port(linear: LinearModel, i: int, masses: MassScale) -> Port:
    labels = linear.state_labels
    act, velocity = np.zeros(linear.n_states), np.zeros(linear.n_states)
    act[i], velocity[i] = -1.0 / masses.mass[i], 1.0
    return Port(
        labels[i],
        "first_order",
        act=act,
        position=np.zeros(linear.n_states),
        velocity=velocity,
        position_input=np.zeros(linear.n_inputs),
        velocity_input=np.zeros(linear.n_inputs),
        acceleration_input=np.zeros(linear.n_inputs),
        description=f"state {labels[i]}; {masses.origin[i].replace('mass', 'storage')}",
    )


def _exchange_ports(linear: LinearModel, states: list[int], tolerance: float, canonical: bool) -> list[Port]:
    """What flows between two stores: both ways (temperatures) or one way (tanks)."""
    if canonical:
        return []
    A = _significant(linear.A, tolerance)
    stores = [i for i in states if A[i, i] < 0 and all(A[i, j] >= 0 for j in states if j != i)]
    found = []
    for i, j in combinations(stores, 2):
        if A[i, j] > 0 and A[j, i] > 0:
            if A[i, j] <= -A[i, i] * (1 + 1e-6) and A[j, i] <= -A[j, j] * (1 + 1e-6):
                found.append(_exchange_port(linear, i, j, A[j, i] / A[i, j], "-"))
        elif A[j, i] > 0:
            found.append(_exchange_port(linear, i, j, A[j, i] / -A[i, i], "->"))
        elif A[i, j] > 0:
            found.append(_exchange_port(linear, j, i, A[i, j] / -A[j, j], "->"))
    return found


def _exchange_port(linear: LinearModel, source: int, sink: int, ratio: float, arrow: str) -> Port:
    labels = linear.state_labels
    act, velocity = np.zeros(linear.n_states), np.zeros(linear.n_states)
    act[source], act[sink] = -1.0, ratio
    velocity[source] = 1.0
    if arrow == "-":
        velocity[sink] = -1.0
        words = f"exchange between {labels[source]} and {labels[sink]}, in proportion to their difference"
    else:
        words = f"flow from {labels[source]} to {labels[sink]}, if all that leaves the one reaches the other"
    return Port(
        f"{labels[source]}{arrow}{labels[sink]}",
        "first_order",
        act=act,
        position=np.zeros(linear.n_states),
        velocity=velocity,
        position_input=np.zeros(linear.n_inputs),
        velocity_input=np.zeros(linear.n_inputs),
        acceleration_input=np.zeros(linear.n_inputs),
        description=f"{words}; per unit storage of {labels[source]}",
    )


def _parameters(
    linear: LinearModel,
    displacements: list[Displacement],
    masses: MassScale,
    between: list[Port],
    tolerance: float,
) -> tuple[NominalParameter, ...]:
    """Stiffness and damping by place, whatever else is in A, and the input gains.

    The link parameters are taken off a copy of A one by one; what is left over
    (first-order states, one-way couplings) is listed entry by entry.
    """
    A = _significant(linear.A, tolerance)
    left, scale = A.copy(), np.abs(A)
    labels = linear.state_labels
    found: list[NominalParameter] = []

    def take(port: Port, kind: str, row: int, column: int, act: float) -> None:
        """Read the coefficient that explains the rest of one entry, and take all its part off."""
        sensed = port.position if kind == "stiffness" else port.velocity
        value = left[row, column] / (act * sensed[column])
        if abs(left[row, column]) > 1e-9 * scale[row, column]:
            letter = "k" if kind == "stiffness" else "c"
            found.append(NominalParameter(f"{letter}[{port.name}]", float(value), "", kind, port.name, False))
            left[:] -= value * np.outer(port.act, sensed)
            left[np.abs(left) <= 1e-9 * scale] = 0.0
            left[row, column] = 0.0

    velocity_of = {labels[item.state]: item for item in displacements if item.absolute}
    for port in between:  # the off-diagonal entries first: they belong to one link each
        row, other = np.flatnonzero(port.act)
        columns = {"stiffness": np.flatnonzero(port.position), "damping": np.flatnonzero(port.velocity)}
        partner = {
            "stiffness": next(
                int(c) for c in columns["stiffness"] if _velocity_state(displacements, int(c)) == other
            ),
            "damping": int(other),
        }
        for kind, column in partner.items():
            take(port, kind, int(row), column, float(port.act[row]))
    for item in displacements:
        if not item.absolute:
            port = _mechanical_port(linear, item, masses)
            row = item.moving if item.moving is not None else item.other
            assert row is not None
            take(port, "stiffness", row, item.state, float(port.act[row]))
            if item.moving is not None and item.other is not None:
                take(port, "damping", row, item.other, float(port.act[row]))
    for item in velocity_of.values():
        port, row = _mechanical_port(linear, item, masses), item.moving
        assert row is not None
        take(port, "stiffness", row, item.state, float(port.act[row]))
        take(port, "damping", row, row, float(port.act[row]))
    kinematic = {item.state for item in displacements}
    for i, j in np.argwhere(left):
        if int(i) not in kinematic:
            place = f"A[{i},{j}]"
            # an entry only partly explained by a link keeps its whole value as the nominal one
            found.append(NominalParameter(place, float(linear.A[i, j]), "", "coefficient", place, False))
    base = masses.base_acceleration
    found.extend(
        NominalParameter(f"gain[{label}]", 1.0, "1", "input_gain", label, False)
        for label, is_base, column in zip(linear.input_labels, base, linear.B.T, strict=True)
        if column.any() and not is_base
    )
    return tuple(found)


def _velocity_state(displacements: list[Displacement], state: int) -> int | None:
    for item in displacements:
        if item.state == state:
            return item.moving
    return None


def find_rate_sensors(linear: LinearModel, tolerance: float = 1e-9) -> Array:
    """Part of the outputs that reads rates of velocity states (accelerometers).

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
    candidates = []
    for index, row in enumerate(A):  # a single accelerometer is the plainest reading
        if row.any():
            weights = np.zeros(len(rows))
            weights[index] = (c @ row) / (row @ row)
            candidates.append(weights)
    candidates.sort(key=lambda weights: abs(abs(weights).max() - 1.0))
    candidates.append(np.linalg.lstsq(A.T, c, rcond=None)[0])
    for weights in candidates:
        weights = np.where(np.abs(weights) > 1e-9 * np.abs(weights).max(), weights, 0.0)
        if np.abs(weights @ A - c).max() > max(10 * tolerance, 1e-9) * np.abs(c).max():
            continue
        used = np.flatnonzero(weights)
        unit = bool(np.allclose(np.abs(weights[used]), 1.0, rtol=1e-6))
        direct = weights @ B
        agrees = bool(direct.any()) and bool(
            np.allclose(direct, d, rtol=1e-6, atol=1e-9 * np.abs(direct).max())
        )
        damped = bool(np.any(c[rows]))
        shorter = used.size < np.count_nonzero(np.abs(c) > tolerance * np.abs(c).max())
        if agrees or (unit and (shorter or used.size == 1)) or (damped and shorter):
            return np.asarray(weights)
    return None
