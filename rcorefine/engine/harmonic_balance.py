"""Harmonic balance: steady response of a nonlinear model to a sine.

The unknowns are the Fourier coefficients of the forces at the places only, however large the model: forces
drive the linear part, harmonic by harmonic, and the motion that follows must give these forces back through
their force laws, sample by sample.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..effects.formula import InputLaw, OutputLaw
from ..systems.discretization import exponential
from ..systems.linear import Array
from .kernels import law_over_period, memory_over_period
from .structure import Structure

_LEAK = 1e-7  # of the frequency: an integrator leaks that much, so that its mean is defined
_TIMES_FOR_JUMPS = 512
_SAMPLES_PER_JUMP = 1.5  # a jumping force is spread over as many samples, so that its slope is seen
_ITERATIONS = 40
_TOLERANCE = 1e-8
_UNSTABLE = 1.001
# how a solution is approached: (spread of a jumping force, strength of all laws) from step to step
_Plan = tuple[tuple[float, float], ...]
_AT_ONCE: _Plan = ((1.0, 1.0),)
_NARROWING: _Plan = ((64.0, 1.0), (16.0, 1.0), (4.0, 1.0), (1.0, 1.0))
_GROWING: _Plan = tuple((1.0, strength) for strength in (0.1, 0.25, 0.4, 0.55, 0.7, 0.85, 1.0))
_SLOWLY: _Plan = tuple((1.0, float(strength)) for strength in np.linspace(0.025, 1.0, 40))
Complex = NDArray[np.complex128]


@dataclass(frozen=True, slots=True, eq=False)
class SteadyState:
    """Periodic answer to a sine.

    Attributes
    ----------
    outputs : complex ndarray, shape (n_y, K + 1)
        Fourier coefficients of the outputs: y = Re sum_k Y_k exp(j k omega t).
    forces : ndarray, shape (m, 2 K + 1)
        Coefficients of the port forces, mean, cosines and sines in turn: a start for the next one.
    converged : bool
        Whether forces and motion agree.
    growth : float
        Largest Floquet multiplier: what a small disturbance has become after one period;
        above 1 the answer is not the one that is seen. 0 where it was not looked at (memory).
    """

    outputs: Complex
    forces: Array
    converged: bool
    growth: float

    @property
    def stable(self) -> bool:
        """Return whether small disturbances of the solution decay."""
        return self.converged and self.growth <= _UNSTABLE


class Balance:
    """Harmonic balance of a structure driven by a sine at one input.

    Parameters
    ----------
    structure : Structure
        Model and effects, continuous time.
    theta : ndarray, shape (p,)
        Coefficients.
    channel : int
        Input that is driven.
    harmonics : int
        Harmonics that are balanced.
    """

    def __init__(self, structure: Structure, theta: Array, channel: int, harmonics: int) -> None:
        self.structure, self.theta, self.channel, self.harmonics = structure, theta, channel, harmonics
        self.matrices = structure.matrices(theta.astype(float))
        self.codes, self.values, _, self.widths = structure.laws(theta)
        self.laws = [structure.effects[index].spec for index in structure.port_effects]
        fewest = _TIMES_FOR_JUMPS if structure.jumps else 8 * harmonics + 8
        self.n_times = 1 << int(np.ceil(np.log2(max(fewest, 8 * harmonics + 8))))
        turn = 2 * np.pi * np.arange(self.n_times) / self.n_times
        order = np.arange(1, harmonics + 1)
        waves = np.stack([np.cos(np.outer(turn, order)), np.sin(np.outer(turn, order))], axis=2)
        self.turn = turn
        self._spread, self._strength = 1.0, 1.0
        self.basis = np.hstack([np.ones((turn.size, 1)), waves.reshape(turn.size, -1)])
        self.analysis = self.basis.T * (2.0 / turn.size)
        self.analysis[0] /= 2.0

    def coded(self, period: Array) -> Array:
        """Return the Fourier coefficients of signals sampled over one period.

        Each row is a signal; the order is that of `SteadyState.forces`.
        """
        spectrum = np.fft.rfft(period, axis=1) / period.shape[1]
        found = np.zeros((period.shape[0], self.harmonics + 1), complex)
        count = min(found.shape[1], spectrum.shape[1] - 1)
        found[:, :count] = spectrum[:, :count]
        found[:, 1:] *= 2.0
        return _coded(found)

    # ------------------------------------------------------------------ one sine
    def solve(self, omega: float, amplitude: float, starts: list[Array]) -> SteadyState:
        """Steady state under w = amplitude cos(omega t).

        Parameters
        ----------
        omega, amplitude : float
            Frequency in rad/s and peak of the sine.
        starts : list of ndarray of shape (m, 2 K + 1)
            Forces to start from, the most likely first.

        Returns
        -------
        SteadyState
        """
        s, matrices = self.structure, self.matrices
        m, K, n = s.n_ports, self.harmonics, s.n_states
        w = self._input(omega, amplitude)
        self._inputs = np.ascontiguousarray(self.basis @ _coded(w).T)
        A = matrices.A
        unit = np.eye(n)
        drive = np.zeros((s.n_inputs + 1, K + 1), complex)
        drive[:-1] = w
        sizes = np.linalg.svd(A, compute_uv=False)
        # behind an integrator a constant input has no steady answer
        drive[-1, 0] = 0.0 if n and sizes[-1] < 1e-12 * max(sizes[0], omega) else 1.0
        toward = np.empty((K + 1, n, m), complex)  # states per force
        moved = np.empty((n, K + 1), complex)  # states by the inputs
        for k in range(K + 1):
            shift = 1j * k * omega if k else _LEAK * omega
            solved = np.linalg.solve(
                shift * unit - A, np.hstack([matrices.E, (matrices.B @ drive[:, k])[:, None]])
            )
            toward[k], moved[:, k] = solved[:, :m], solved[:, m]
        free = matrices.P[:, :n] @ moved + matrices.P[:, n:] @ drive
        maps = [_real_map(matrices.P[:, :n] @ toward[k], k) for k in range(K + 1)]
        forces, converged = np.zeros((m, 2 * K + 1)), True
        if m:
            forces, converged = self._balance(_assemble(maps, m, K), _coded(free), starts)
        F = _phasors(forces)
        X = moved + np.einsum("knm,mk->nk", toward, F)
        Y = matrices.C @ X + matrices.D @ drive + matrices.G @ F
        growth = self._growth(omega, matrices.P[:, :n] @ X + matrices.P[:, n:] @ drive) if m else 0.0
        return SteadyState(self._sensors(Y, omega), forces, converged, growth)

    def _growth(self, omega: float, sensed: Complex) -> float:
        """Size of the largest Floquet multiplier of the motion at the ports."""
        m, n = self.structure.n_ports, self.structure.n_states
        if any(law.inner_states for law in self.laws):
            return 0.0
        self._spread, self._strength = 1.0, 1.0
        times = _coded(sensed) @ self.basis.T
        rates = np.repeat(self.matrices.A[None], self.n_times, axis=0)
        for j in range(m):
            _, by_d, by_v = self._law(j, times[j], times[m + j])
            for by, row in ((by_d, j), (by_v, m + j)):
                if by is not None and by.any():
                    rates += by[:, None, None] * np.outer(self.matrices.E[:, j], self.matrices.P[row, :n])
        steps = exponential(rates * (2 * np.pi / omega / self.n_times))
        turn = np.eye(n)
        for step in steps:
            turn = step @ turn
        return float(np.abs(np.linalg.eigvals(turn)).max()) if np.isfinite(turn).all() else np.inf

    def _input(self, omega: float, amplitude: float) -> Complex:
        """Return the Fourier coefficients of the inputs that act on the model.

        Dead zones, saturations and delays are included.
        """
        w = np.zeros((self.structure.n_inputs, self.harmonics + 1), complex)
        signal = amplitude * np.cos(self.turn)
        delay = 0.0
        for index, channel in self.structure.input_statics:
            if channel != self.channel:
                continue
            law = self.structure.effects[index].spec
            assert isinstance(law, InputLaw)
            values = self.structure.law_values(self.theta, index)
            if law.delays:
                delay = values[0]
            else:
                # with memory, the second of two turns has forgotten where it began
                step = 2 * np.pi / omega / signal.size
                signal = law.through(np.tile(signal, 2), *values, step=step)[0][signal.size :]
        order = np.arange(self.harmonics + 1)
        w[self.channel] = _phasors(signal @ self.analysis.T) * np.exp(-1j * order * omega * delay)
        return w

    def _sensors(self, Y: Complex, omega: float) -> Complex:
        """Outputs behind the static laws and the delays of their sensors."""
        for index, channel in self.structure.output_statics:
            law = self.structure.effects[index].spec
            assert isinstance(law, OutputLaw)
            y = np.tile(self.basis @ _coded(Y[channel]), 2)
            y = law.through(y, *self.structure.law_values(self.theta, index))[0][y.size // 2 :]
            Y[channel] = _phasors(y @ self.analysis.T)
        for index, channel in self.structure.output_delays:
            law = self.structure.effects[index].spec
            assert isinstance(law, OutputLaw)
            value = self.structure.law_values(self.theta, index)[0]
            Y[channel] *= law.response(omega * np.arange(self.harmonics + 1.0), value)[0]
        return Y

    # -------------------------------------------------------------- Newton steps
    def _balance(self, motion: Array, free: Array, starts: list[Array]) -> tuple[Array, bool]:
        """Forces that agree with the motion they cause.

        motion : (2 m, 2 K + 1, m, 2 K + 1), free : (2 m, 2 K + 1), both real-coded.
        """
        m, size = self.structure.n_ports, 2 * self.harmonics + 1
        matrix = motion.reshape(2 * m * size, m * size)
        best: tuple[float, Array] = (np.inf, np.zeros((m, size)))
        rest = np.zeros((m, size))
        plans: list[tuple[Array, _Plan]] = [(start, _AT_ONCE) for start in [*starts, rest]]
        plans += [(start, _NARROWING) for start in [*starts, rest]] + [(rest, _GROWING), (rest, _SLOWLY)]
        for start, plan in plans:
            point = start
            for self._spread, self._strength in plan:
                point, error = self._newton(matrix, free, point)
            if error < best[0]:
                best = error, point
            if error < _TOLERANCE:
                return point, True
        return best[1], False

    def _newton(self, matrix: Array, free: Array, start: Array) -> tuple[Array, float]:
        """Damped Newton steps; returns the relative error where they end."""
        point = start.copy()
        error, rest, slope = self._mismatch(matrix, free, point)
        for _ in range(_ITERATIONS):
            if error < _TOLERANCE:
                break
            step = np.linalg.lstsq(slope, -rest.ravel(), rcond=None)[0].reshape(point.shape)
            share = 1.0
            for _ in range(12):
                trial = self._mismatch(matrix, free, point + share * step)
                if trial[0] < error * (1 - 0.1 * share):
                    break
                share *= 0.5
            else:
                break
            point = point + share * step
            error, rest, slope = trial
        return point, error

    def _mismatch(self, matrix: Array, free: Array, point: Array) -> tuple[float, Array, Array]:
        """Return relative size, value and derivative of the force mismatch.

        The derivative is taken with respect to the forces.
        """
        m, size = point.shape
        sensed = free + (matrix @ point.ravel()).reshape(2 * m, size)
        times = sensed @ self.basis.T
        slope = np.eye(m * size)
        rest = np.empty_like(point)
        scale = 0.0
        for j in range(m):
            f, by_d, by_v = self._law(j, times[j], times[m + j])
            hat = self._strength * (self.analysis @ f)
            rest[j] = point[j] - hat
            scale = max(scale, float(np.abs(hat).max()), float(np.abs(point[j]).max()))
            rows = slice(j * size, (j + 1) * size)
            for by, row in ((by_d, j), (by_v, m + j)):
                if by is None:
                    continue
                waves = by[:, None] * self.basis if by.ndim == 1 else by @ self.basis
                slope[rows] -= (
                    self._strength * (self.analysis @ waves) @ matrix[row * size : (row + 1) * size]
                )
        return float(np.abs(rest).max()) / (scale or 1.0), rest, slope

    def _law(self, j: int, d: Array, v: Array) -> tuple[Array, Array | None, Array | None]:
        """Return a force over one period, and its derivatives.

        They are taken with respect to displacement and velocity at the samples.
        """
        code, row = int(self.codes[j]), self.values[j : j + 1]
        if self.laws[j].inner_states:
            return *self._memory(code, row, d, v), None
        width = float(self.widths[j])
        if self.laws[j].jumps:
            rate = float(np.ptp(v)) * np.pi / self.n_times
            width = max(width, _SAMPLES_PER_JUMP * rate) * self._spread
        f, by_d, by_v = law_over_period(code, d, v, self._inputs, row, width)
        return f, by_d, by_v

    def _memory(self, code: int, row: Array, d: Array, v: Array) -> tuple[Array, Array]:
        """Return a periodic force with an inner state, and its derivatives.

        After one period the inner state returns to its starting value.
        """
        # after a turn the inner state is affine in its start: here is where it returns to itself
        w = self._inputs
        _, _, end, slope, left = memory_over_period(code, d, v, w, row, 0.0, np.zeros(d.size))
        lost = 1.0 - left
        start, slope = (end / lost, slope / lost) if lost > 1e-12 else (0.0, np.zeros(d.size))
        f, by, *_ = memory_over_period(code, d, v, w, row, start, slope)
        return f, by


def _coded(values: Complex) -> Array:
    """Return complex Fourier coefficients in real form.

    The last axis holds mean, cosine, sine, cosine and so on.
    """
    pairs = np.stack([values[..., 1:].real, -values[..., 1:].imag], axis=-1)
    return np.concatenate([values[..., :1].real, pairs.reshape(*values.shape[:-1], -1)], axis=-1)


def _phasors(coded: Array) -> Complex:
    """The reverse of `_coded`."""
    mean = coded[..., :1].astype(complex)
    return np.concatenate([mean, coded[..., 1::2] - 1j * coded[..., 2::2]], axis=-1)


def _real_map(h: Complex, k: int) -> Array:
    """Return complex gains as real matrices between cosines and sines.

    The shape is (rows, columns, 2, 2), for the mean (rows, columns, 1, 1).
    """
    if k == 0:
        return np.real(h)[:, :, None, None]
    return np.moveaxis(np.array([[h.real, h.imag], [-h.imag, h.real]]), (0, 1), (2, 3))


def _assemble(maps: list[Array], m: int, harmonics: int) -> Array:
    """Motion per force over all harmonics: (2 m, 2 K + 1, m, 2 K + 1)."""
    full = np.zeros((2 * m, 2 * harmonics + 1, m, 2 * harmonics + 1))
    for k, block in enumerate(maps):
        place = slice(0, 1) if k == 0 else slice(2 * k - 1, 2 * k + 1)
        full[:, place, :, place] = np.moveaxis(block, 2, 1)
    return full
