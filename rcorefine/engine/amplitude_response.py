"""Frequency response of a nonlinear model at stated input amplitudes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import control as ct
import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..arguments import as_choice, as_vector, as_whole, shown
from ..data.measurement import Measurement
from ..exceptions import ModelError
from ..models.operating_point import refuse_point
from ..results import Result
from ..systems.linear import Array
from .controlled import open_loop
from .engine import Engine
from .harmonic_balance import Balance, SteadyState
from .simulation import structure_of

__all__ = ["AmplitudeResponse", "frequency_response_at"]

_HARMONICS = 15
_MOST_HARMONICS = 1000
_AFAR, _APPROACH = 0.3, 30
_UNSTABLE = 1.001
_PERIODS, _PER_PERIOD = 200, 64


@dataclass(frozen=True, slots=True, eq=False)
class AmplitudeResponse(Result):
    """Response to sines of stated amplitudes.

    Attributes
    ----------
    omega : ndarray, shape (n_omega,)
        Frequencies in rad/s.
    amplitude : ndarray, shape (n_levels,)
        Peaks of the input sine, in its unit.
    response : complex ndarray, shape (n_levels, n_y, n_omega)
        Fundamental of each output over the input sine; NaN where no steady state was found.
    distortion : ndarray, shape (n_levels, n_y, n_omega)
        Root mean square of the higher harmonics of each output over its fundamental.
    mean : ndarray, shape (n_levels, n_y, n_omega)
        Mean of each output, in its unit.
    forces : ndarray, shape (n_levels, m, n_omega)
        Peaks of the fundamental of the port forces.
    converged : ndarray of bool, shape (n_levels, n_omega)
        Whether forces and motion agree.
    stable : ndarray of bool, shape (n_levels, n_omega)
        Whether small disturbances of the steady state die out; where they do not, the
        system answers otherwise (jumps, subharmonics), and the curve is not what is seen.
    input_label : str
        Input that is driven.
    output_labels : tuple of str
        Outputs.
    input_unit : str
        Unit of the amplitude, "" where unknown.
    name : str
        Name of the model.
    """

    omega: Array
    amplitude: Array
    response: NDArray[np.complex128]
    distortion: Array
    mean: Array
    forces: Array
    converged: NDArray[np.bool_]
    stable: NDArray[np.bool_]
    input_label: str
    output_labels: tuple[str, ...]
    input_unit: str
    name: str


def frequency_response_at(
    model: Any,
    omega: ArrayLike,
    amplitude: float | Sequence[float] | Array,
    *,
    source: int | str = 0,
    harmonics: int = _HARMONICS,
    sweep: str = "up",
) -> AmplitudeResponse:
    """Frequency response of a model with its effects at stated amplitudes.

    The describing function of the whole loop: the steady answer to a sine, all harmonics up
    to a number balanced between the linear part and the laws at its ports.

    Parameters
    ----------
    model : StateSpace, PhysicalModel or Refinement
        Model in continuous time; a Refinement with its nonlinear effects.
    omega : array_like of shape (n_omega,)
        Frequencies in rad/s, positive, in any order.
    amplitude : float or sequence of float
        Peaks of the sine, in the unit of the input, positive.
    source : int or str
        Input that is driven, by number or label; the others rest.
    harmonics : int
        Harmonics that are balanced; jumping forces (dry friction) need more for more digits.
    sweep : {"up", "down"}
        Direction in which the frequencies are visited. Where several steady states exist, as
        beside the resonance of a hardening spring, the one nearest to the last frequency is found.

    Returns
    -------
    AmplitudeResponse
        Arrays over level, output and frequency; prints as a table.

    Raises
    ------
    ModelError
        If a frequency or amplitude is not positive, or the model is not in continuous time.
    control.ControlArgument
        If an argument is of the wrong kind.

    Notes
    -----
    Effects at inputs and outputs (dead zone, saturation, delay, rectification) are in it,
    nuisance offsets too, except behind an integrator, where they have no steady answer. Where a small
    disturbance of the answer would grow (Floquet), a simulation shows where it settles, and that
    is balanced in its place.

    References
    ----------
    Cameron and Griffin, An alternating frequency/time domain method for calculating the
    steady-state response of nonlinear dynamic systems, J. Appl. Mech. 56 (1989) 149-154.

    Examples
    --------
    >>> import numpy as np, rcorefine as rco
    >>> spring = rco.mass_spring_damper([1.0], [0.2], [100.0])
    >>> linear = rco.frequency_response_at(spring, [5.0], [0.1, 10.0])
    >>> bool(np.allclose(linear.response[:, 0, 0], 1 / (75 + 1j)))
    True
    """
    points = as_vector(omega, "omega", above=0.0, error=ModelError)
    levels = as_vector(amplitude, "amplitude", above=0.0, error=ModelError)
    harmonics = as_whole(harmonics, "harmonics", least=1, most=_MOST_HARMONICS)
    as_choice(sweep, "sweep", ("up", "down"))
    structure, theta, _ = structure_of(model)
    linear = refuse_point(open_loop(structure).model, "frequency_response_at").linear
    channel = _channel(source, linear.input_labels)
    balance = Balance(open_loop(structure), theta, channel, int(harmonics))
    order = np.argsort(points, kind="stable")[:: 1 if sweep == "up" else -1]
    shape = (levels.size, linear.n_outputs, points.size)
    response = np.full(shape, np.nan, dtype=complex)
    distortion, mean = np.full(shape, np.nan), np.full(shape, np.nan)
    forces = np.full((levels.size, structure.n_ports, points.size), np.nan)
    converged = np.zeros((levels.size, points.size), dtype=bool)
    stable = np.zeros((levels.size, points.size), dtype=bool)
    for level, peak in enumerate(levels):
        starts: list[Array] = []
        for k in order:
            state = balance.solve(float(points[k]), float(peak), starts)
            if not state.converged:
                state = _approach(balance, float(points[k]), float(peak), sweep)
            if not state.converged or state.growth > _UNSTABLE:
                state = _settled(balance, float(points[k]), float(peak), state)
            converged[level, k] = state.converged
            stable[level, k] = state.converged and state.growth <= _UNSTABLE
            if not state.converged:
                continue
            starts = [state.forces]
            first = state.outputs[:, 1]
            response[level, :, k] = first / peak
            higher = np.sqrt(np.sum(np.abs(state.outputs[:, 2:]) ** 2, axis=1))
            distortion[level, :, k] = np.divide(
                higher, np.abs(first), out=np.zeros_like(higher), where=np.abs(first) > 0
            )
            mean[level, :, k] = state.outputs[:, 0].real
            forces[level, :, k] = np.hypot(state.forces[:, 1], state.forces[:, 2])
    units = structure.model.input_units
    return AmplitudeResponse(
        points,
        levels,
        response,
        distortion,
        mean,
        forces,
        converged,
        stable,
        linear.input_labels[channel],
        linear.output_labels,
        units[channel] if units else "",
        linear.name,
    )


def _approach(balance: Balance, omega: float, peak: float, sweep: str) -> SteadyState:
    """Sweep to a frequency from afar, where the answer is plain."""
    starts: list[Array] = []
    afar = _AFAR if sweep == "up" else 1.0 / _AFAR
    for frequency in np.geomspace(afar * omega, omega, _APPROACH):
        state = balance.solve(float(frequency), peak, starts)
        if state.converged:
            starts = [state.forces]
    return state


def _settled(balance: Balance, omega: float, peak: float, state: SteadyState) -> SteadyState:
    """Simulate from rest, and balance what the motion settles at."""
    structure = balance.structure
    n = _PERIODS * _PER_PERIOD
    signal = np.zeros((structure.n_inputs, n))
    signal[balance.channel] = peak * np.cos(2 * np.pi * np.arange(n) / _PER_PERIOD)
    signal[balance.channel, 0] *= 1.1
    blank = Measurement(
        signal, np.zeros((structure.n_outputs, n)), dt=2 * np.pi / omega / _PER_PERIOD, hold="foh"
    )
    run = Engine(structure, blank, substeps=4).run(
        balance.theta, sensitivity=False, histories=True, check=False
    )
    last = run.forces[:, -_PER_PERIOD:]
    if run.blew_up >= 0 or not np.isfinite(last).all():
        return state
    found = balance.solve(omega, peak, [balance.coded(last)])
    return found if found.converged and found.growth <= _UNSTABLE else state


def _channel(source: int | str, labels: tuple[str, ...]) -> int:
    if isinstance(source, str) and source in labels:
        return labels.index(source)
    if isinstance(source, (int, np.integer)) and not isinstance(source, bool) and 0 <= source < len(labels):
        return int(source)
    raise ct.ControlArgument(f"source: there is no input {shown(source)}; there are {', '.join(labels)}")
