"""Exact discretization, and arguments of the simulation loop.

They are computed once for all records that need them.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from ..systems.discretization import exponential, power_of_two
from ..systems.linear import Array
from .linear import Substep, unit_responses
from .march import Discretized, FieldLaw, PortLaws, SensorLaws
from .point import field_numbers

if TYPE_CHECKING:
    from .matrices import Matrices
    from .structure import Structure


GRADES = 3  # where a friction force jumps: a substep, a quarter of it, and a quarter of that


@dataclass(frozen=True, slots=True, eq=False)
class Setting:
    """Arguments of the march that do not hang on the record.

    Attributes
    ----------
    model : Discretized
        Matrices with their derivatives, and laws.
    finite : bool
        Whether the matrices are numbers.
    """

    model: Discretized
    finite: bool

    def decay(self, substeps: int, gain: Array, samples: int) -> Array:
        """Return the linear response to unit initial states, (N, n_y, n).

        At every sample the outputs correct the states by a gain (n, n_y).
        """
        M, O = self.model.at.M[0], self.model.at.O
        n = len(M)
        with np.errstate(all="ignore"):  # overflow is detected by the callers
            # transition with correction: x(k+1) = Phi (x - K C x)
            ahead = np.linalg.matrix_power(M[:, :n], substeps)
            ahead = ahead - (ahead @ gain) @ O[:, :n]
        return unit_responses(ahead, O[:, :n], samples)


def setting(structure: Structure, theta: Array, step: float, derivatives: bool) -> Setting:
    """Return the arguments of `march` at given coefficients.

    Parameters
    ----------
    structure : Structure
        Model with effects.
    theta : ndarray, shape (p,)
        Coefficients.
    step : float
        Substep in seconds.
    derivatives : bool
        Whether derivatives by the coefficients are carried.

    Returns
    -------
    Setting
    """

    def made() -> Setting:
        substep = structure.discretize(theta, step, derivatives=derivatives, pieces=structure.jumps)
        codes, values, columns, widths = structure.laws(theta)
        outcodes, outvalues, outcolumns = structure.output_laws(theta)
        field, fvalues, fcolumns = field_numbers(structure, theta)
        if not derivatives:
            columns, outcolumns, fcolumns = (np.full_like(one, -1) for one in (columns, outcolumns, fcolumns))
        ports, sensors = PortLaws(codes, values, columns, widths), SensorLaws(outcodes, outvalues, outcolumns)
        model = Discretized(substep, ports, sensors, FieldLaw(field, fvalues, fcolumns))
        return Setting(model, bool(np.isfinite(substep.M).all()))

    return structure.kept(("setting", theta.tobytes(), step, derivatives), made)


def _amid_and_end(
    Phi: NDArray[Any], level: NDArray[Any], slope: NDArray[Any], bend: NDArray[Any], nw: int
) -> NDArray[Any]:
    """Return the matrices of a substep for its middle and its end.

    Parameters
    ----------
    Phi : ndarray, shape (2, k, n, n)
        Transitions over the substep, and over half of it.
    level, slope : ndarray, shape (2, k, n, n_w + m)
        What inputs and forces add, and what their slopes add: the derivative by the share of the time.
    bend : ndarray, shape (2, k, n, m)
        What the second derivatives of the forces add.
    nw : int
        Number of inputs.

    Returns
    -------
    ndarray, shape (1, k, 2 n, n + 2 n_w + 3 m)
        Behind state and inputs stand the forces at the start, amid the substep and at its end.
    """
    # the parabola through f0, fm, f1 has the slope - 3 f0 + 4 fm - f1 and the bend 4 f0 - 8 fm + 4 f1;
    # half the time halves the slope and quarters the bend
    parts = []
    for which, share in ((1, 0.5), (0, 1.0)):
        by_level, by_slope, by_bend = level[which], share * slope[which], share**2 * bend[which]
        inputs = [by_level[..., :nw] - by_slope[..., :nw], by_slope[..., :nw]]
        f_level, f_slope = by_level[..., nw:], by_slope[..., nw:]
        forces = [f_level - 3 * f_slope + 4 * by_bend, 4 * f_slope - 8 * by_bend, 4 * by_bend - f_slope]
        parts.append(np.concatenate([Phi[which], *inputs, *forces], axis=2))
    return np.concatenate(parts, axis=1)[None]


TINY_STEP = 1e-30  #: imaginary part of complex steps


def discretized(
    structure: Structure, theta: Array, step: float, *, derivatives: bool = True, pieces: bool = False
) -> Substep:
    """One substep of length `step` seconds and, where asked for, its pieces.

    They are exact for the linear part. Inputs run linearly over each; a held input is the special case of
    equal ends. Forces run linearly, too, or as parabolas through those amid the substep: see `march`.
    """
    linear = structure.absorbed if derivatives else np.zeros(0, dtype=np.int64)
    at = tiny_steps(structure, theta, linear)
    n, drive = structure.n_states, structure.n_inputs + 1 + structure.n_forces
    nw, parabolas = structure.n_inputs + 1, structure.stages == 2
    size = n + 2 * drive + parabolas * structure.n_forces
    grades = 1 + parabolas if not pieces else GRADES
    blocks = np.zeros((grades, len(at.A), size, size), at.A.dtype)
    # units of inputs, outputs and forces must not cost digits of A
    states = _inner_scale(structure, at.A[0].real)[:, None]
    pushes = states * np.concatenate([at.B, at.E], axis=2)
    columns = power_of_two(np.abs(pushes[0].real).max(axis=0, initial=0.0))
    steps = step / (2.0 if parabolas else 4.0) ** np.arange(grades)[:, None, None, None]
    # exponential of [A B 0; 0 0 I; 0 0 0]: transition, response to a step, response to a ramp (Van Loan)
    blocks[:, :, :n, :n] = states * at.A / states.T * steps
    blocks[:, :, :n, n : n + drive] = pushes / columns * steps
    blocks[:, :, n : n + drive, n + drive : n + 2 * drive] = np.eye(drive)
    if parabolas:  # parabolas: forces have a second derivative
        blocks[:, :, n + drive + nw : n + 2 * drive, n + 2 * drive :] = np.eye(structure.n_forces)
    with np.errstate(over="ignore", invalid="ignore"):  # the engine reports divergence
        found = exponential(blocks.reshape(-1, size, size))
        exponentials = found.reshape(blocks.shape)[:, :, :n] / states
        Phi = exponentials[..., :n] * states.T
        level = exponentials[..., n : n + drive] * columns
        slope = exponentials[..., n + drive : n + 2 * drive] * columns
        bend = exponentials[..., n + 2 * drive :] * columns[nw : nw + parabolas * structure.n_forces]
    if parabolas:
        M = _amid_and_end(Phi, level, slope, bend, nw)
    else:
        # inputs and forces at the start (level less slope) and at the end of the substep (slope)
        first = level - slope
        M = np.concatenate([Phi, first[..., :nw], slope[..., :nw], first[..., nw:], slope[..., nw:]], axis=3)
    O = np.concatenate([at.C, at.D, at.G], axis=2)
    with np.errstate(over="ignore"):
        # derivatives by complex steps
        dM = M[:, : len(linear)].imag / TINY_STEP
        dO, dP = (part[: len(linear)].imag / TINY_STEP for part in (O, at.P))
    if not dP.any():
        dP = np.zeros((0, *at.P.shape[1:]))
    parts = (M[:, 0].real, dM, linear, O[0].real, dO, at.P[0].real, dP)
    return Substep(*(np.ascontiguousarray(part) for part in parts))


def tiny_steps(structure: Structure, theta: Array, linear: NDArray[np.int64]) -> Matrices:
    """Return the matrices a tiny imaginary step away from `theta`.

    There is one step along each parameter that enters them. Their real parts are those at `theta`; without
    such parameters it is the only point.
    """
    if not len(linear):
        return structure.matrix_stack(theta[None].astype(float))
    points = np.repeat(theta[None].astype(complex), len(linear), axis=0)
    points[np.arange(len(linear)), linear] += 1j * TINY_STEP
    return structure.matrix_stack(points)


def _inner_scale(structure: Structure, A: NDArray[Any]) -> Array:
    """Return scales that bring the states of effects to the model's size.

    The scales are powers of two; the states of effects are in units of a signal.
    """
    scale = np.ones(structure.n_states)
    for j in range(structure.linear_model.n_states, structure.n_states):
        others = np.arange(structure.n_states) != j
        # entries to and from this state become equally large
        up, down = np.abs(A[others, j]).max(initial=0.0), np.abs(A[j, others]).max(initial=0.0)
        if up > 0 or down > 0:
            scale[j] = np.sqrt(up / down) if up > 0 and down > 0 else up or 1.0 / down
    return power_of_two(scale)
