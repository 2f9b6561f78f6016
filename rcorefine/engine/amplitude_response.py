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

_HARMONICS = 15
_MOST_HARMONICS = 1000
_AFAR, _APPROACH = 0.3, 30
_STEP, _SMALL, _FINEST = 0.1, 0.05, 2e-5  # change of the answer in one step; of the largest; least step
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
    peak_gain : ndarray, shape (n_levels, n_y)
        Largest magnitude of the response, also between the frequencies in `omega`.
    peak_omega : ndarray, shape (n_levels, n_y)
        Frequency of this peak in rad/s.
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
    peak_gain: Array
    peak_omega: Array
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
        beside the resonance of a hardening spring, the branch of the last frequency is followed.

    Returns
    -------
    AmplitudeResponse
        Arrays over level, output and frequency, and the peaks; prints as a table.

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
    gain, where = np.full((2, levels.size, linear.n_outputs), np.nan)
    for level, peak in enumerate(levels):
        way: list[tuple[float, SteadyState]] = []
        for k in order:
            state = _onward(balance, float(points[k]), float(peak), sweep, way)
            converged[level, k] = state.converged
            stable[level, k] = state.stable
            if not state.converged:
                continue
            way.append((float(points[k]), state))
            first = state.outputs[:, 1]
            response[level, :, k] = first / peak
            higher = np.sqrt(np.sum(np.abs(state.outputs[:, 2:]) ** 2, axis=1))
            distortion[level, :, k] = np.divide(
                higher, np.abs(first), out=np.zeros_like(higher), where=np.abs(first) > 0
            )
            mean[level, :, k] = state.outputs[:, 0].real
            forces[level, :, k] = np.hypot(state.forces[:, 1], state.forces[:, 2])
        if way:
            sizes = np.array([np.abs(state.outputs[:, 1]) for _, state in way])
            gain[level] = sizes.max(axis=0) / peak
            where[level] = np.array([at for at, _ in way])[sizes.argmax(axis=0)]
    unit = (structure.model.input_units or [""] * (channel + 1))[channel]
    found = (response, distortion, mean, forces, converged, stable, gain, where)
    labels = (linear.input_labels[channel], linear.output_labels, unit, linear.name)
    return AmplitudeResponse(points, levels, *found, *labels)


def _onward(
    balance: Balance, omega: float, peak: float, sweep: str, way: list[tuple[float, SteadyState]]
) -> SteadyState:
    """Return the steady state at the next frequency of a sweep.

    The states on the way there are appended to `way`. Steps are halved while the response changes much: long
    steps miss peaks, and leave a branch before it ends.
    """
    if not way:
        return _settled(balance, omega, peak, sweep, balance.solve(omega, peak, []))
    at, last = way[-1]
    least = _SMALL * np.max([np.abs(state.outputs[:, 1]) for _, state in way], axis=0)
    step, there = omega - at, omega
    while True:
        state = balance.solve(there, peak, [last.forces])
        if last.stable and state.converged and abs(step) > _FINEST * omega:
            one, two = last.outputs[:, 1], state.outputs[:, 1]
            scale = np.max([np.abs(one), np.abs(two), least], axis=0)
            if not state.stable or (np.abs(two - one) > _STEP * scale).any():
                step /= 2
                there = at + step
                continue
        if there == omega or not state.stable:
            break
        way.append((there, state))
        at, last = there, state
        step = min(2 * step, omega - at, key=abs)
        there = omega if step == omega - at else at + step
    if there != omega:
        state = balance.solve(omega, peak, [last.forces])
    return _settled(balance, omega, peak, sweep, state)


def _settled(balance: Balance, omega: float, peak: float, sweep: str, state: SteadyState) -> SteadyState:
    """Return a stable steady state, if one is found.

    If `state` is not stable, sweep to it from a distant frequency, then simulate from rest.
    """
    starts: list[Array] = []
    afar = _AFAR if sweep == "up" else 1.0 / _AFAR
    for frequency in [] if state.converged else np.geomspace(afar * omega, omega, _APPROACH):
        state = balance.solve(float(frequency), peak, starts)
        if state.converged:
            starts = [state.forces]
    if state.stable:
        return state
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
    return found if found.stable else state


def _channel(source: int | str, labels: tuple[str, ...]) -> int:
    if isinstance(source, str) and source in labels:
        return labels.index(source)
    if isinstance(source, (int, np.integer)) and not isinstance(source, bool) and 0 <= source < len(labels):
        return int(source)
    raise ct.ControlArgument(f"source: there is no input {shown(source)}; there are {', '.join(labels)}")
