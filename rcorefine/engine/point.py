"""Linear models of nonlinear ones: at a point, and along a motion."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from ..effects.compiled import COUNT, evaluate
from ..models.operating_point import sensed
from ..systems.linear import Array

if TYPE_CHECKING:
    from .engine import Trajectory
    from .structure import Structure

_ROUNDING = 1e-9  # share of the largest value at the point
_STEP = 1e-4  # relative step of a coefficient for finite differences of a tangent


def resting(structure: Structure, place: str) -> tuple[float, float] | None:
    """Return displacement and velocity of a place at the operating point.

    They are None if the model does not contain the forces at that point. A velocity that differs from zero by
    rounding alone is returned as zero.
    """
    point = structure.model.operating_point
    if point is None or not structure.balanced:
        return None
    d, v = sensed(
        structure.model, place, np.zeros((structure.n_states, 1)), np.zeros((structure.n_inputs, 1))
    )
    least = _ROUNDING * np.abs([*point.states, *point.inputs]).max(initial=0.0)
    return float(d[0]), float(v[0]) if abs(v[0]) > least else 0.0


def tangents(structure: Structure, theta: NDArray[Any]) -> NDArray[Any]:
    """Return force and slopes of each force law at the operating point.

    The columns, shape (m, 3), are the force and its derivatives by displacement and velocity. A model that is
    linear about the point contains both. At a place at rest friction jumps with the velocity, and a force
    with an inner state depends on the past: there is no tangent. Where theta is complex, the result is
    complex too, with the derivatives.
    """
    found = np.zeros((structure.n_ports, 3), theta.dtype if theta.size else float)
    if not structure.balanced:
        return found
    codes, values, columns, widths = structure.laws(theta.real)
    written = np.zeros((structure.n_ports, COUNT))
    # each law at the displacement and velocity of its place
    for row, index in enumerate(structure.port_effects):
        law, place = structure.effects[index].spec, structure.effects[index].place
        d, v = resting(structure, place) or (0.0, 0.0)
        evaluate(codes[row], d, v, d, 0.0, values, row, widths[row], written[0, :0], written)
        # no tangent: an inner state, or a jump at zero velocity
        jumps = law.inner_states or abs(v) <= (0.0 if law.width_share is None else widths[row])
        found[row] = written[row, :3] * [1, not law.inner_states, not jumps]
    # derivatives by the coefficients: central differences along the imaginary part of theta
    for c in set(columns[columns >= 0]) & set(np.flatnonzero(theta.imag)):
        step = _STEP * (abs(theta[c].real) or 1.0) * np.eye(theta.size)[c]
        change = tangents(structure, theta.real + step) - tangents(structure, theta.real - step)
        found += change / (2.0 * step[c]) * (theta[c] - theta[c].real)
    return found


def field_numbers(structure: Structure, theta: Array) -> tuple[int, Array, NDArray[np.int64]]:
    """Return code, parameters and columns in theta of the nonlinear field.

    They are arguments of `march`.
    """
    field = structure.field
    if field is None:
        return 0, np.zeros((1, 0)), np.zeros(0, dtype=np.int64)
    values, names = field.nominal[None].copy(), field.functions.names
    columns = np.full(len(names), -1, dtype=np.int64)
    for index in structure.number_effects:
        effect = structure.effects[index]
        which = names.index(effect.place)
        values[0, which] += float(structure.value(theta, index, effect.coefficients[0]))
        columns[which] = structure.position(index, effect.coefficients[0])
    return field.code, values, columns


def act_scales(structure: Structure, theta: NDArray[Any]) -> dict[str, Any]:
    """Return how free parameters scale the force at each place.

    The scale is relative to the force with nominal parameters. A place whose force acts like an input is
    measured in units of that input: where the parameters change what the input does, they change what the
    force does.
    """
    field, base = structure.field, structure.linear_model
    if field is None or not structure.number_effects or not base.n_inputs:
        return {}
    _, (values,), columns = field_numbers(structure, theta.real)
    n, free = base.n_states, [c for c in range(columns.size) if columns[c] >= 0]

    # columns of the inputs at the operating point, dx/dt by w
    def gains(p: Array) -> Array:
        return np.asarray(base.B + field.slopes(p, np.zeros(n + base.n_inputs))[:n, n:])

    B = gains(values).astype(theta.dtype if theta.size else float)
    # derivatives by the parameters: central differences
    for c in free if np.iscomplexobj(theta) else ():
        step = 1e-5 * (abs(values[c]) or 1e-2) * np.eye(values.size)[c]
        slope = (gains(values + step) - gains(values - step)) / (2.0 * step[c])
        B = B + slope * (theta[columns[c]] - theta[columns[c]].real)
    found = {}
    # a force that acts like an input column changes with that column
    for port in structure.model.ports:
        row = int(np.argmax(np.abs(port.act)))
        for j, column in enumerate(base.B.T):
            alike = abs(column @ port.act) > (1 - 1e-6) * np.linalg.norm(column) * np.linalg.norm(port.act)
            if alike and column[row] != 0.0:
                found[port.name] = B[row, j] / base.B[row, j]
                break
    return found


def about_point(structure: Structure, theta: Array) -> tuple[Array, Array, Array, Array]:
    """Return A, B, C, D of the model linearized about its operating point.

    The linear effects are included. A model about a declared point keeps its own matrices: effects at places
    add no slope there.
    """
    matrices = structure.matrices(theta)
    A, B, C, D, P = matrices.A, matrices.B, matrices.C, matrices.D, matrices.P
    field, ports, n = structure.field, structure.n_ports, structure.n_states
    E, G = matrices.E[:, :ports], matrices.G[:, :ports]
    # slopes of the force laws times the motion they feel
    slopes = tangents(structure, theta)[:, 1:, None]
    by = slopes[:, 0] * P[:ports] + slopes[:, 1] * P[ports : 2 * ports]
    # or slopes of the nonlinear field at the operating point
    if field is not None:
        table = field.table(field_numbers(structure, theta)[1][0], np.zeros(field.n_signals), 1.0)
        by = table[:, 2 : 2 + field.n_signals] @ P[2 * ports :]
        E, G = matrices.E[:, ports:], matrices.G[:, ports:]
    # A + E df/dx, B + E df/dw, C + G df/dx, D + G df/dw
    return A + E @ by[:, :n], B + E @ by[:, n:], C + G @ by[:, :n], D + G @ by[:, n:]


def linearized(structure: Structure, theta: Array, run: Trajectory, inputs: Array) -> tuple[Array, Array]:
    """Return A and C with nonlinear forces replaced by linear fits.

    Each fit is the best one along the motion.

    Parameters
    ----------
    structure : Structure
        Model with effects.
    theta : ndarray, shape (p,)
        Coefficients.
    run : Trajectory
        Motion, with its histories.
    inputs : ndarray, shape (n_w, N)
        Inputs over the same time.

    Returns
    -------
    A : ndarray, shape (n, n)
    C : ndarray, shape (n_y, n)
    """
    matrices, n, ports = structure.matrices(theta), structure.n_states, structure.n_ports
    A, C = matrices.A.astype(float), matrices.C.astype(float)
    forces, x = np.nan_to_num(run.forces), np.nan_to_num(run.states)
    drive = np.vstack([x, inputs, np.ones((1, x.shape[1]))])
    # regression of each force on displacement and velocity along the motion
    for i in range(ports):
        rows = matrices.P[[i, ports + i]].astype(float)
        motion = (rows @ drive[: rows.shape[1]]).T
        motion = motion - motion.mean(axis=0)
        size = np.sqrt(np.mean(motion**2, axis=0))
        scale = np.where(size > 0, size, 1.0)
        slopes = np.linalg.lstsq(motion / scale, forces[i] - forces[i].mean(), rcond=1e-8)[0]
        along = np.where(size > 0, slopes / scale, 0.0) @ rows[:, :n]
        A = A + np.outer(matrices.E[:, i].astype(float), along)
        C = C + np.outer(matrices.G[:, i].astype(float), along)
    # regression of the rows of the field on their arguments
    if structure.field is not None:
        taken = matrices.P[2 * ports :].astype(float)
        moved = (taken @ drive).T
        moved = moved - moved.mean(axis=0)
        scale = np.sqrt(np.mean(moved**2, axis=0))
        scale = np.where(scale > 0, scale, 1.0)
        rows = forces[ports:] - forces[ports:].mean(axis=1, keepdims=True)
        by = np.linalg.lstsq(moved / scale, rows.T, rcond=1e-8)[0].T / scale @ taken[:, :n]
        A = A + matrices.E[:, ports:].astype(float) @ by
        C = C + matrices.G[:, ports:].astype(float) @ by
    return A, C
