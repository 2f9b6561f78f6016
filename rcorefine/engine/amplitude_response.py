"""Frequency responses of linear and nonlinear models.

The response of a nonlinear model belongs to the amplitude of the input.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import control as ct
import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..arguments import as_choice, as_vector, as_whole, shown
from ..data.measurement import Measurement
from ..data.response_record import ResponseRecord, coded
from ..effects.formula import FormulaLaw
from ..exceptions import DivergenceError, ModelError
from ..models.operating_point import refuse_point
from ..models.ports import felt
from ..results import Result
from ..systems.linear import Array, LinearModel
from .controlled import open_loop
from .engine import Engine, Trajectory
from .harmonic_balance import LineBalance, SineBalance, SteadyState, remembering
from .observer import leading_gain
from .setting import TINY_STEP, tiny_steps
from .simulation import structure_of
from .structure import Structure

_HARMONICS = 15
_MOST_HARMONICS = 1000
# a sweep that approaches a frequency from afar: its start over the frequency, and its number of steps
_AFAR, _APPROACH = 0.3, 30
# continuation: relative change of the response per step, size of a small response, shortest step
_STEP, _SMALL, _FINEST = 0.1, 0.05, 2e-5
# simulation until the motion is steady: periods of the sine, samples per period
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
    balance = SineBalance(open_loop(structure), theta, channel, int(harmonics))
    # where several steady states exist, the order of the frequencies decides which branch is followed
    order = np.argsort(points, kind="stable")[:: 1 if sweep == "up" else -1]
    shape = (levels.size, linear.n_outputs, points.size)
    response = np.full(shape, np.nan, dtype=complex)
    distortion, mean = np.full(shape, np.nan), np.full(shape, np.nan)
    forces = np.full((levels.size, structure.n_ports, points.size), np.nan)
    converged = np.zeros((levels.size, points.size), dtype=bool)
    stable = np.zeros((levels.size, points.size), dtype=bool)
    gain, where = np.full((2, levels.size, linear.n_outputs), np.nan)
    # one sweep over the frequencies for each amplitude
    for level, peak in enumerate(levels):
        way: list[tuple[float, SteadyState]] = []
        for k in order:
            state = _next_state(balance, float(points[k]), float(peak), sweep, way)
            converged[level, k] = state.converged
            stable[level, k] = state.stable
            if not state.converged:
                continue
            way.append((float(points[k]), state))
            # describing function: fundamental of each output over the peak of the input, (n_y,)
            first = state.outputs[:, 1]
            response[level, :, k] = first / peak
            # distortion: rms of the higher harmonics over the fundamental
            higher = np.sqrt(np.sum(np.abs(state.outputs[:, 2:]) ** 2, axis=1))
            distortion[level, :, k] = np.divide(
                higher, np.abs(first), out=np.zeros_like(higher), where=np.abs(first) > 0
            )
            mean[level, :, k] = state.outputs[:, 0].real
            forces[level, :, k] = np.hypot(state.forces[:, 1], state.forces[:, 2])
        # peak of the response over all states of the sweep, also between the asked frequencies
        if way:
            sizes = np.array([np.abs(state.outputs[:, 1]) for _, state in way])
            gain[level] = sizes.max(axis=0) / peak
            where[level] = np.array([at for at, _ in way])[sizes.argmax(axis=0)]
    unit = (structure.model.input_units or [""] * (channel + 1))[channel]
    found = (response, distortion, mean, forces, converged, stable, gain, where)
    labels = (linear.input_labels[channel], linear.output_labels, unit, linear.name)
    return AmplitudeResponse(points, levels, *found, *labels)


def _next_state(
    balance: SineBalance, omega: float, peak: float, sweep: str, way: list[tuple[float, SteadyState]]
) -> SteadyState:
    """Return the steady state at the next frequency of a sweep.

    The states on the way there are appended to `way`. Steps are halved while the response changes much: long
    steps miss peaks, and leave a branch before it ends.
    """
    # first frequency of the sweep: there is no neighbor to continue from
    if not way:
        return _stable(balance, omega, peak, sweep, balance.solve(omega, peak, []))
    at, last = way[-1]
    # small responses count relative to the largest one so far, so that they need no short steps
    least = _SMALL * np.max([np.abs(state.outputs[:, 1]) for _, state in way], axis=0)
    step, there = omega - at, omega
    while True:
        # continuation: the forces at the last frequency are the initial guess at the next
        state = balance.solve(there, peak, [last.forces])
        if last.stable and state.converged and abs(step) > _FINEST * omega:
            before, after = last.outputs[:, 1], state.outputs[:, 1]
            scale = np.max([np.abs(before), np.abs(after), least], axis=0)
            # halve the step where the response jumps or the branch loses its stability
            if not state.stable or (np.abs(after - before) > _STEP * scale).any():
                step /= 2
                there = at + step
                continue
        if there == omega or not state.stable:
            break
        # accept the point and double the step
        way.append((there, state))
        at, last = there, state
        step = min(2 * step, omega - at, key=abs)
        there = omega if step == omega - at else at + step
    # the branch ended on the way: solve at the wanted frequency itself
    if there != omega:
        state = balance.solve(omega, peak, [last.forces])
    return _stable(balance, omega, peak, sweep, state)


def _stable(balance: SineBalance, omega: float, peak: float, sweep: str, state: SteadyState) -> SteadyState:
    """Return a stable steady state, if one is found.

    If `state` is not stable, sweep to it from a distant frequency, then simulate from rest.
    """
    # Newton did not converge: continuation from a distant frequency, where the response is small
    starts: list[Array] = []
    afar = _AFAR if sweep == "up" else 1.0 / _AFAR
    for frequency in [] if state.converged else np.geomspace(afar * omega, omega, _APPROACH):
        state = balance.solve(float(frequency), peak, starts)
        if state.converged:
            starts = [state.forces]
    if state.stable:
        return state
    # unstable steady state: simulate the sine to see where the motion settles
    structure = balance.structure
    n = _PERIODS * _PER_PERIOD
    signal = np.zeros((structure.n_inputs, n))
    signal[balance.channel] = peak * np.cos(2 * np.pi * np.arange(n) / _PER_PERIOD)
    # a disturbance at the start makes the simulation leave an unstable solution
    signal[balance.channel, 0] *= 1.1
    blank = Measurement(
        signal, np.zeros((structure.n_outputs, n)), dt=2 * np.pi / omega / _PER_PERIOD, hold="foh"
    )
    run = Engine(structure, blank, substeps=4).run(
        balance.theta, sensitivity=False, histories=True, check=False
    )
    # the forces of the last period are the initial guess of the harmonic balance
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


Complex = NDArray[np.complex128]
_PHASES = 16  # samples of a period of a sine
_BATCH = 4_000_000  # complex numbers in memory at once (64 MB)


def engine_on(
    structure: Structure,
    data: Any,
    *,
    substeps: int = 1,
    initial: Array | None = None,
) -> Engine | ResponseEngine:
    """Return the engine for a time record or for a frequency response."""
    if not data.in_time:
        return ResponseEngine(structure, data, substeps=substeps)
    return Engine(structure, data, substeps=substeps, initial=initial, lead=leading_gain(structure, data))


def is_linear(structure: Structure) -> bool:
    """Return whether the response to a sine is independent of amplitude.

    This is so with linear effects and delays alone.
    """
    channels = [*structure.input_statics, *structure.output_statics]
    return not structure.n_ports and all(structure.effects[index].spec.delays for index, _ in channels)


class ResponseEngine:
    """A structure at the frequencies of a measured response.

    Parameters
    ----------
    structure : Structure
        Model and effects.
    data : ResponseRecord
        Response; its channels stand in the order of the model's.
    substeps : int, optional
        Of no meaning here; kept.

    Raises
    ------
    ModelError
        If an effect is nonlinear and the amplitude of the sines is not known, or the model itself is.
    """

    lead: Array | None = None  #: no observer leads a response

    def __init__(self, structure: Structure, data: ResponseRecord, *, substeps: int = 1) -> None:
        self.structure, self.data, self.substeps = structure, data, substeps
        if structure.field is not None:
            raise ModelError(
                "a frequency response is that of a linear model with effects; give a linearization of the "
                "nonlinear one (Refinement.linearize, control.linearize)"
            )
        if structure.model.controller is not None:
            raise ModelError(
                "a frequency response is that of the model alone; leave the controller out, or close the "
                "loop with control.feedback"
            )
        drifting = [effect.label for effect in structure.effects if effect.spec.drifts]
        if drifting:
            raise ModelError(f"{drifting[0]} shows in records in time, and in no response; leave it out")
        self._balance = None if is_linear(structure) else _line_balance(structure, data)

    def run(self, theta: Array, x0: Array | None = None, *, sensitivity: bool = True, **_: Any) -> Trajectory:
        """Return the response in rows as those of the data, with derivatives.

        There are no states and no observer.

        Parameters
        ----------
        theta : ndarray, shape (p,)
            Free coefficients.
        x0 : ndarray, optional
            Of no meaning here.
        sensitivity : bool
            Whether to carry derivatives by theta.

        Returns
        -------
        Trajectory
            `blew_up` is 0 where a pole lies on a frequency, or the matrices are no numbers; else -1.
        """
        noise = self.data.noise
        try:
            response, slopes = self.response(theta, derivatives=sensitivity)
        except DivergenceError:
            lost = np.full(self.data.outputs.shape, np.inf)
            free = self.structure.n_parameters if sensitivity else 0
            return Trajectory(lost, np.zeros((*lost.shape, free)), lost[:0], lost[:0], 0)
        # real and imaginary parts as rows, over the standard deviation of the noise
        rows = coded(response) / noise
        columns = np.empty((*rows.shape, len(slopes)))
        for k, slope in enumerate(slopes):
            columns[:, :, k] = coded(slope) / noise
        empty = np.zeros((0, rows.shape[1]))
        return Trajectory(rows, columns, empty, empty, -1 if np.isfinite(rows).all() else 0)

    def begin(self, other: ResponseEngine) -> None:
        """Start from the answers of a model without the last laws."""
        if self._balance is not None:
            self._balance.begin(other._balance)

    def judged(self, theta: Array) -> NDArray[np.bool_]:
        """No point is hidden."""
        return np.ones(self.data.outputs.shape, dtype=bool)

    def push(self, theta: Array, place: str) -> Complex | None:
        """Return the change of the response by a unit of complex stiffness.

        The stiffness acts at a place; the change has shape (n_y, n_w, n_omega). At a channel, the change is
        that by a unit of a factor on it. The result is None where `place` is neither.
        """
        s = self.structure
        labels = s.linear_model.input_labels, s.linear_model.output_labels
        # channel: a factor on it multiplies its column or row of the response
        if place in labels[0] or place in labels[1]:
            response = self.response(theta, derivatives=False)[0]
            through = np.zeros(response.shape, complex)
            where = np.s_[:, labels[0].index(place)] if place in labels[0] else np.s_[labels[1].index(place)]
            through[where] = response[where]
            return through
        port = next((port for port in s.model.ports if port.name == place), None)
        if port is None:
            return None
        m, n, nw = s.matrices(theta.astype(float)), s.n_states, s.n_inputs
        n0 = s.linear_model.n_states
        # place: row that senses its motion, column by which a force acts there
        seen = "position" if port.has_position else "velocity"
        sense, direct = getattr(port, seen), getattr(port, f"{seen}_input")
        row, act = np.pad(sense, (0, n - n0))[None], np.pad(port.act, (0, n - n0))[:, None]
        out = felt(port, s.model.output_rate)
        points = 1j * self.data.omega
        # G_dw from the inputs to the motion, G_yf from a force there to the outputs, at s = i omega
        to, _ = _transfer([(m.A, m.B[:, :nw], row, direct[None])], points)
        back, _ = _transfer([(m.A, act, m.C, out[:, None])], points)
        late = self._delay(theta, np.ones((s.n_outputs, nw, points.size), complex), [])[0]
        # a unit of stiffness gives the force -d, hence the change -G_yf G_dw of the outputs
        return np.asarray(-back * to * late)

    # ------------------------------------------------------------------ linear
    def response(self, theta: Array, *, derivatives: bool = True) -> tuple[Complex, list[Complex]]:
        """Return the complex frequency response, and its derivatives.

        Its shape is (n_y, n_w, n_omega); there is one derivative for each free coefficient.

        Raises
        ------
        DivergenceError
            If the matrices are no numbers.
        """
        if self._balance is not None:
            return self._balance.response(theta, derivatives=derivatives)
        s, omega, data = self.structure, self.data.omega, self.data.measured
        columns = s.absorbed if derivatives else np.zeros(0, dtype=np.int64)
        sets = self._matrices(theta, columns)
        if not all(np.isfinite(block).all() for block in sets[0]):
            raise DivergenceError("the model with these effects is no number; start from other coefficients")
        sampled = data.dt > 0 and data.hold != "bandlimited"
        # frequencies on the unit circle, z = exp(i omega dt), or on the imaginary axis
        points = np.exp(1j * omega * data.dt) if sampled else 1j * omega
        G, found = _transfer(sets, points)
        slopes = [np.zeros(G.shape, complex)] * (s.n_parameters if derivatives else 0)
        for column, slope in zip(columns, found, strict=True):
            slopes[column] = slope
        return self._delay(theta, G, slopes)

    def _matrices(self, theta: Array, columns: NDArray[np.int64]) -> list[tuple[Array, ...]]:
        """Return A, B, C, D of the response, then their derivatives.

        They are discrete-time if the response is sampled. The derivatives are by the given coefficients.
        """
        s, data = self.structure, self.data.measured
        nw = s.n_inputs
        # continuous time: derivatives by complex steps
        if not data.dt or data.hold == "bandlimited":
            m = tiny_steps(s, theta, columns)
            blocks = m.A, m.B[:, :, :nw], m.C, m.D[:, :, :nw]
            slopes = zip(*(block[: columns.size].imag / TINY_STEP for block in blocks), strict=True)
            return [tuple(block[0].real for block in blocks), *slopes]
        disc = s.discretize(theta, data.dt, derivatives=columns.size > 0)
        n, drive = s.n_states, nw + 1
        found: list[tuple[Array, ...]] = []
        ends = disc.M[0, -n:], *disc.dM[0, :, -n:]  # end of the substep, for either formula
        for M, O in zip(ends, (disc.O, *disc.dO), strict=True):
            # x(k+1) = Phi x(k) + first w(k) + second w(k+1), y = C x + D w
            Phi, first, second = M[:, :n], M[:, n : n + nw], M[:, n + drive : n + drive + nw]
            C, D = O[:, :n], O[:, n : n + nw]
            if data.hold == "zoh":
                found.append((Phi, first + second, C, D))
            elif not found:  # foh: the new state x(k) - second w(k) removes w(k+1)
                found.append((Phi, first + Phi @ second, C, D + C @ second))
                whole = Phi, second, C
            else:  # derivatives of the line above, by the product rule
                B = first + Phi @ whole[1] + whole[0] @ second
                found.append((Phi, B, C, D + C @ whole[1] + whole[2] @ second))
        return found

    def _delay(self, theta: Array, G: Complex, slopes: list[Complex]) -> tuple[Complex, list[Complex]]:
        """With the delays of inputs and outputs."""
        s = self.structure
        late: list[tuple[int, Any]] = [(index, np.s_[:, channel]) for index, channel in s.input_statics]
        late += [(index, np.s_[channel]) for index, channel in s.output_delays]
        G, slopes = G.copy(), [one.copy() for one in slopes]
        for index, where in late:
            law = s.effects[index].spec
            assert isinstance(law, FormulaLaw)
            # delay tau: its channel times exp(-i omega tau)
            factor, slope = law.response(self.data.omega, s.law_values(theta, index)[0])
            column = s.position(index, s.effects[index].coefficients[0])
            if column >= 0 and slopes:
                slopes[column][where] = G[where] * slope
            for one in (G, *(other for k, other in enumerate(slopes) if k != column)):
                one[where] *= factor
        return G, slopes


def _line_balance(structure: Structure, data: ResponseRecord) -> LineBalance:
    """The harmonic balance of nonlinear effects at the lines of a response.

    Raises
    ------
    ModelError
        If the amplitude is not known, a law remembers, or the points are those of held signals.
    """
    named = ", ".join(e.label for e in structure.effects if not e.spec.linear)
    if data.measured.amplitude is None:
        raise ModelError(
            f"{named}: the response depends on the amplitude of the sine; give the response amplitude="
        )
    if memory := remembering(structure):
        listed = ", ".join(memory)
        raise ModelError(f"{listed}: laws with memory take records in time, no frequency responses yet")
    if data.measured.dt and data.measured.hold != "bandlimited":
        raise ModelError(f"{named}: held inputs are no sines; give the response of continuous signals (dt=0)")
    refuse_point(structure.model, "a frequency response with nonlinear effects")
    return LineBalance(structure, data)


@np.errstate(over="ignore", invalid="ignore")  # overflow far from the minimum is noticed by the callers
def _transfer(sets: list[tuple[Array, ...]], points: NDArray[Any]) -> tuple[Complex, list[Complex]]:
    """Return C (z - A)^-1 B + D at every point, and its derivatives.

    They follow from the derivatives of A, B, C, D.
    """
    A, B, C, D = sets[0]
    n, n_y, n_w = A.shape[0], *D.shape
    G = np.empty((n_y, n_w, points.size), complex)
    slopes = [np.empty(G.shape, complex) for _ in sets[1:]]
    # blocks of frequencies bound the memory
    batch = max(1, _BATCH // max(1, n * (n + n_w + n_y)))
    for start in range(0, points.size, batch):
        part = slice(start, start + batch)
        shifted = points[part, None, None] * np.eye(n) - A
        try:
            # X = (z - A)^-1 B and Z = C (z - A)^-1, at all frequencies of the block
            X = np.linalg.solve(shifted, np.broadcast_to(B.astype(complex), (len(shifted), n, n_w)))
            left = np.broadcast_to(C.T.astype(complex), (len(shifted), n, n_y))
            Z = np.swapaxes(np.linalg.solve(np.swapaxes(shifted, 1, 2), left), 1, 2)
        except np.linalg.LinAlgError:  # a pole lies on a point
            G[:, :, part] = np.nan
            for slope in slopes:
                slope[:, :, part] = np.nan
            continue
        G[:, :, part] = np.moveaxis(C @ X + D, 0, -1)
        for slope, (dA, dB, dC, dD) in zip(slopes, sets[1:], strict=True):
            # dG = Z (dA X + dB) + dC X + dD, since d(z - A)^-1 = (z - A)^-1 dA (z - A)^-1
            changed = Z @ (dA @ X + dB) + dC @ X + dD
            slope[:, :, part] = np.moveaxis(changed, 0, -1)
    return G, slopes


def port_phasors(
    structure: Structure, theta: Array, data: ResponseRecord, place: str
) -> tuple[Complex, Complex]:
    """Return the phasors of displacement and velocity at a place.

    The inputs are sines; each result has shape (n_w n_omega,).
    """
    m, nw = structure.matrices(theta.astype(float)), structure.n_inputs
    port, added = structure.model.port(place), structure.n_states - structure.linear_model.n_states
    rows = np.pad(np.array([port.position, port.velocity]), ((0, 0), (0, added)))
    through = np.array([port.position_input, port.velocity_input])
    G, _ = _transfer([(m.A, m.B[:, :nw], rows, through)], 1j * data.omega)
    # motion = transfer function times the peak of the input sine; a pole on the line gives zero
    d, v = np.nan_to_num(G) * data.inputs[0, : data.omega.size]
    return d.ravel(), v.ravel()


def sampled(phasors: Complex) -> Array:
    """A period of each sine, one after the other."""
    turns = np.exp(2j * np.pi * np.arange(_PHASES) / _PHASES)
    return np.asarray(np.real(phasors[:, None] * turns).ravel())


def channel_signal(linear: LinearModel, data: ResponseRecord, place: str, at_input: bool) -> Array:
    """A period of each sine at an input or output."""
    peaks = data.inputs[0, : data.omega.size]
    if at_input:
        return sampled(peaks.astype(complex))
    points = data.measured.response[linear.output_labels.index(place)] * peaks
    return sampled(points.ravel())
