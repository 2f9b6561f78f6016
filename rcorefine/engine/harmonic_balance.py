"""Harmonic balance: steady responses of a nonlinear model to sines.

The unknowns are the Fourier coefficients of the forces at the places only, however large the model: forces
drive the linear part, harmonic by harmonic, and the motion that follows must give these forces back through
their force laws, sample by sample (Cameron and Griffin, J. Appl. Mech. 56, 1989, 149-154). All sines, the
lines, take their Newton steps together.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..data.response_record import ResponseRecord
from ..effects.formula import InputLaw, OutputLaw
from ..systems.discretization import exponential
from ..systems.linear import Array
from .kernels import law_over_period, memory_over_period
from .structure import Structure

Complex = NDArray[np.complex128]
_LEAK = 1e-7  # share of the frequency by which an integrator leaks, so that its mean is defined
_SAMPLES_PER_JUMP = 1.5  # a jumping force is smoothed over them, so that its slope enters the Jacobian
_TOLERANCE = 1e-8
_RIDGE = 1e-12
_UNSTABLE = 1.001
# harmonics and samples for all lines of a measured response
_HARMONICS, _HARMONICS_FOR_JUMPS = 5, 9
_TIMES, _TIMES_FOR_JUMPS = 48, 256
_FAR, _FAR_SHARE = 5.0, 0.1  # standard deviations, share of a point, above which another solution is tried
_MOST_OFF = 0.3  # share of such lines above which the model is wrong, and not the chosen solution
_STEP = 1e-6  # relative step of a coefficient for finite differences
# samples for one sine at a time
_TIMES_OF_ONE_FOR_JUMPS = 512
# how a solution is approached: (spread of a jumping force, strength of all laws) from step to step
_Plan = tuple[tuple[float, float], ...]
_AT_ONCE: _Plan = ((1.0, 1.0),)
_NARROWING: _Plan = ((64.0, 1.0), (16.0, 1.0), (4.0, 1.0), (1.0, 1.0))
_GROWING: _Plan = tuple((1.0, strength) for strength in (0.1, 0.25, 0.4, 0.55, 0.7, 0.85, 1.0))
_SLOWLY: _Plan = tuple((1.0, float(strength)) for strength in np.linspace(0.025, 1.0, 40))


def remembering(structure: Structure) -> list[str]:
    """Return the effects that have an inner state.

    Their responses to a sine are not fitted to measured ones.
    """
    channels = [*structure.input_statics, *structure.output_statics]
    nonlinear = [*structure.port_effects, *(index for index, _ in channels)]
    return [structure.effects[i].label for i in nonlinear if structure.effects[i].spec.inner_states]


class _Maps(NamedTuple):
    """Gains from forces and inputs to motions and outputs, line by line.

    The motions are those at the places.
    """

    sensed: Complex  #: (L, 2 m, m, K + 1)
    free: Complex  #: (L, 2 m, K + 1)
    outputs: Complex  #: (L, n_y, m, K + 1)
    through: Complex  #: (L, n_y, K + 1)
    inputs: Array  #: (L, T, n_w), over a period


class Balance:
    """Harmonic balance of a structure that sines drive, each at one input.

    Parameters
    ----------
    structure : Structure
        Model and effects, continuous time.
    omega, peaks : ndarray, shape (L,)
        Frequencies in rad/s, and peaks of the sines.
    channels : ndarray of int, shape (L,)
        Inputs that are driven.
    harmonics, times : int
        Harmonics that are balanced, and samples of a period.
    """

    iterations, halvings = 20, 4

    def __init__(
        self,
        structure: Structure,
        omega: Array,
        peaks: Array,
        channels: NDArray[np.intp],
        harmonics: int,
        times: int,
    ) -> None:
        self.structure, self.harmonics = structure, harmonics
        self.omega, self.peaks, self.channels = omega, peaks, channels
        self.laws = [structure.effects[index].spec for index in structure.port_effects]
        # Fourier basis over one period: complex (T, K + 1), and real [1, cos, sin, cos 2, ...] (T, 2 K + 1)
        turn, order = 2 * np.pi * np.arange(times) / times, np.arange(1, harmonics + 1)
        self.waves = np.exp(1j * np.outer(turn, np.arange(harmonics + 1)))  # (T, K + 1)
        pairs = np.stack([np.cos(np.outer(turn, order)), np.sin(np.outer(turn, order))], axis=2)
        self.basis = np.hstack([np.ones((times, 1)), pairs.reshape(times, -1)])
        # Fourier analysis: samples (..., T) to coefficients (..., 2 K + 1)
        self.analysis = self.basis.T * (2.0 / times)
        self.analysis[0] /= 2.0
        self.spread, self.strength = 1.0, 1.0  # smoothing of a jumping force, strength of all laws

    # ------------------------------------------------------------------ linear part
    def maps(self, theta: Array) -> _Maps:
        """Gains of the linear part, and the motion without forces."""
        s, M = self.structure, self.structure.matrices(theta.astype(float))
        n, m, K = s.n_states, s.n_ports, self.harmonics + 1
        sines = self._sines(theta)  # (L, K)
        # s = j k omega of each line and harmonic, (L, K + 1)
        shift = 1j * np.outer(self.omega, np.arange(K))
        shift[:, 0] = _LEAK * self.omega
        right = np.empty((self.omega.size, K, n, m + 2), complex)
        right[..., :m] = M.E[:, :m]
        right[..., m] = M.B[:, self.channels].T[:, None, :]
        right[..., m + 1] = M.B[:, -1]
        # (s I - A)^-1 times the columns of the forces, of the driven input and of the constant
        states = np.linalg.solve(shift[..., None, None] * np.eye(n) - M.A, right)
        sensed = np.einsum("in,lknm->limk", M.P[:, :n], states)
        outputs = np.einsum("in,lknm->limk", M.C, states)
        # motion and outputs that the sine alone causes
        free = (sensed[:, :, m] + M.P[:, n:][:, self.channels].T[:, :, None]) * sines[:, None, :]
        through = (outputs[:, :, m] + M.D[:, self.channels].T[:, :, None]) * sines[:, None, :]
        sizes = np.linalg.svd(M.A, compute_uv=False)
        # behind an integrator a constant input has no steady answer
        settles = np.ones(self.omega.size)
        if n:
            settles[sizes[-1] < 1e-12 * np.maximum(sizes[0], self.omega)] = 0.0
        free[:, :, 0] += settles[:, None] * (sensed[:, :, m + 1, 0] + M.P[:, -1])
        through[:, :, 0] += settles[:, None] * (outputs[:, :, m + 1, 0] + M.D[:, -1])
        inputs = np.zeros((self.omega.size, len(self.waves), s.n_inputs))
        inputs[np.arange(self.omega.size), :, self.channels] = np.real(sines @ self.waves.T)
        return _Maps(sensed[:, :, :m], free, outputs[:, :, :m] + M.G[None, :, :m, None], through, inputs)

    def _sines(self, theta: Array) -> Complex:
        """Return the Fourier coefficients of the driven input, (L, K + 1).

        Dead zones, saturations and delays are included.
        """
        s = self.structure
        # a cosine over one period; static laws act in time, the delay on the phase
        signal = self.peaks[:, None] * self.basis[:, 1]
        order, late = np.arange(self.harmonics + 1), np.zeros(self.omega.size)
        for index, channel in s.input_statics:
            law = s.effects[index].spec
            assert isinstance(law, InputLaw)
            values = s.law_values(theta, index)
            for line in np.flatnonzero(self.channels == channel):
                if law.delays:
                    late[line] += values[0]
                else:
                    step = 2 * np.pi / self.omega[line] / signal.shape[1]
                    signal[line] = _through_law(law, signal[line], values, step=step)
        late_by = np.exp(-1j * np.outer(self.omega * late, order))
        return np.asarray(_phasors(signal @ self.analysis.T) * late_by)

    def outputs(self, theta: Array, maps: _Maps, forces: Array) -> Complex:
        """Fourier coefficients of the outputs, (L, n_y, K + 1).

        Static laws and delays of the sensors are included.
        """
        s = self.structure
        Y = maps.through + np.einsum("limk,lmk->lik", maps.outputs, _phasors(forces))
        for index, channel in s.output_statics:
            law = s.effects[index].spec
            assert isinstance(law, OutputLaw)
            # law of the sensor: synthesis, law in time, Fourier analysis
            values = s.law_values(theta, index)
            times = np.real(Y[:, channel] @ self.waves.T)
            seen = np.array([_through_law(law, row, values) for row in times])
            Y[:, channel] = _phasors(seen @ self.analysis.T)
        for index, channel in s.output_delays:
            law = s.effects[index].spec
            assert isinstance(law, OutputLaw)
            # delay tau of the sensor: harmonic k times exp(-j k omega tau)
            at = np.outer(self.omega, np.arange(self.harmonics + 1.0))
            late = law.response(at.ravel(), s.law_values(theta, index)[0])[0]
            Y[:, channel] *= late.reshape(at.shape)
        return np.asarray(Y)

    # ------------------------------------------------------------------ Newton steps
    def newton(self, theta: Array, maps: _Maps, start: Array, lines: NDArray[np.intp]) -> tuple[Array, Array]:
        """Solve the balance of some lines by damped Newton steps.

        The forces of all lines and the relative error of each are returned.
        """
        forces, error = start.copy(), np.zeros(len(start))
        active = lines
        rest, slope, wrong = self.mismatch(theta, maps, forces, active, slopes=True)
        error[active] = wrong
        for _ in range(self.iterations):
            # lines that have not converged
            open_ = wrong > _TOLERANCE
            if not open_.any():
                break
            active, rest, slope, wrong = active[open_], rest[open_], slope[open_], wrong[open_]
            # Newton step
            step = -_solve_each(slope, rest.reshape(len(rest), -1, 1))[..., 0].reshape(rest.shape)
            share, todo = np.ones(active.size), np.arange(active.size)
            trial = forces[active]
            # damping: halve the step of each line until its mismatch decreases
            for _ in range(self.halvings):
                trial[todo] = forces[active[todo]] + share[todo, None, None] * step[todo]
                now = self.mismatch(theta, maps, trial, active, at=todo)[2]
                worse = ~(now < wrong[todo] * (1 - 0.1 * share[todo]))
                todo = todo[worse]
                if not todo.size:
                    break
                share[todo] *= 0.5
            better = np.ones(active.size, dtype=bool)
            better[todo] = False  # a line without a decrease keeps its forces
            active, trial = active[better], trial[better]
            if not active.size:
                break
            forces[active] = trial
            rest, slope, wrong = self.mismatch(theta, maps, forces, active, slopes=True)
            error[active] = wrong
        return forces, error

    def mismatch(
        self,
        theta: Array,
        maps: _Maps,
        forces: Array,
        lines: Any = None,
        *,
        at: Any = None,
        slopes: bool = False,
    ) -> tuple[Array, Array, Array]:
        """Return value, derivative and relative size of the force mismatch.

        The mismatch is the forces minus those of the force laws; the derivative is by the forces. Of all
        lines, of some (`lines`), or of some among rows of forces for these (`at`).
        """
        where = slice(None) if lines is None else lines
        F = forces[where] if at is None else forces[at]
        where = where if at is None else lines[at]
        sensed = maps.sensed[where]
        m, size = F.shape[1:]
        # alternating frequency/time: forces to motion by harmonics, then motion in time
        motion = maps.free[where] + np.einsum("limk,lmk->lik", sensed, _phasors(F))
        times = np.real(motion @ self.waves.T)  # (L, 2 m, T)
        rest, slope = F.copy(), np.zeros((0, 0, 0))
        if slopes:
            slope = np.tile(np.eye(m * size), (len(F), 1, 1))
        scale = np.abs(F).max(axis=(1, 2))
        for j in range(m):
            # force of the law in time, back to Fourier coefficients
            f, *by = self.law(theta, j, times[:, j], times[:, m + j], maps.inputs[where])
            hat = self.strength * (f @ self.analysis.T)
            rest[:, j] -= hat
            scale = np.maximum(scale, np.abs(hat).max(axis=1))
            for row, one in zip((j, m + j), by, strict=True):
                if not slopes or not one.any():
                    continue
                # chain rule: slope of the law times motion per Fourier coefficient of force i
                for i in range(m):
                    waves = sensed[:, row, i, None, :] * self.waves  # (L, T, K + 1)
                    real = np.empty((*waves.shape[:2], size))
                    real[..., 0], real[..., 1::2], real[..., 2::2] = (
                        waves[..., 0].real, waves[..., 1:].real, waves[..., 1:].imag,
                    )  # fmt: skip
                    moved = one[..., None] * real if one.ndim == 2 else one @ real
                    rows, columns = slice(j * size, (j + 1) * size), slice(i * size, (i + 1) * size)
                    slope[:, rows, columns] -= self.strength * (self.analysis @ moved)
        return rest, slope, np.abs(rest).max(axis=(1, 2)) / np.where(scale > 0, scale, 1.0)

    def law(self, theta: Array, j: int, d: Array, v: Array, w: Array) -> tuple[Array, Array, Array]:
        """Return a force over one period (L, T), and its derivatives.

        They are taken with respect to displacement and velocity; (L, T, T) where a law remembers.
        """
        codes, values, _, widths = self.structure.laws(theta)
        code, row, width, law = int(codes[j]), values[j : j + 1], float(widths[j]), self.laws[j]
        if law.inner_states:
            found = [_periodic_with_memory(code, row, *line) for line in zip(d, v, w, strict=True)]
            force, by = (np.array(part) for part in zip(*found, strict=True))
            return force, by, np.zeros(d.shape)
        if not law.jumps:
            flat = law_over_period(code, d.ravel(), v.ravel(), w.reshape(d.size, -1), row, width)
            force, by, by_rate = flat.reshape(3, *d.shape)
            return force, by, by_rate
        # smooth a jump over 1.5 samples at the largest acceleration (of a sine, ptp(v) pi / T a sample)
        widest = _SAMPLES_PER_JUMP * np.ptp(v, axis=1) * np.pi / d.shape[1]
        spread = np.maximum(width, widest) * self.spread
        each = np.array(
            [law_over_period(code, *line) for line in zip(d, v, w, [row] * len(d), spread, strict=True)]
        )
        return each[:, 0], each[:, 1], each[:, 2]


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


class SineBalance(Balance):
    """One sine after the other, each with the stability of its solution.

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

    iterations, halvings = 40, 12

    def __init__(self, structure: Structure, theta: Array, channel: int, harmonics: int) -> None:
        fewest = max(_TIMES_OF_ONE_FOR_JUMPS if structure.jumps else 0, 8 * harmonics + 8)
        one = np.ones(1)
        times = 1 << int(np.ceil(np.log2(fewest)))
        super().__init__(structure, one, one, np.array([channel]), harmonics, times)
        self.theta, self.channel = theta, channel

    def coded(self, period: Array) -> Array:
        """Return the Fourier coefficients of signals sampled over one period.

        Each row is a signal; the order is that of `SteadyState.forces`.
        """
        # coefficients of cosines and sines from the real FFT
        spectrum = np.fft.rfft(period, axis=1) / period.shape[1]
        found = np.zeros((period.shape[0], 2 * self.harmonics + 1))
        count = min(self.harmonics, spectrum.shape[1] - 2)
        found[:, 0] = spectrum[:, 0].real
        found[:, 1 : 2 * count : 2] = 2.0 * spectrum[:, 1 : count + 1].real
        found[:, 2 : 2 * count + 1 : 2] = -2.0 * spectrum[:, 1 : count + 1].imag
        return found

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
        self.omega, self.peaks = np.array([omega]), np.array([amplitude])
        maps, m = self.maps(self.theta), self.structure.n_ports
        rest = np.zeros((1, m, self.basis.shape[1]))
        best, error = rest, 0.0 if m == 0 else np.inf
        # initial guesses at once, then with jumps that become sharper, last with laws that grow from zero
        begun = [start[None] for start in starts] + [rest]
        plans = [(start, _AT_ONCE) for start in begun] + [(start, _NARROWING) for start in begun]
        for point, plan in [*plans, (rest, _GROWING), (rest, _SLOWLY)]:
            if error < _TOLERANCE:
                break
            reached = point
            for self.spread, self.strength in plan:
                reached, (left,) = self.newton(self.theta, maps, reached, np.zeros(1, dtype=np.intp))
            if left < error:
                best, error = reached, left
        self.spread, self.strength = 1.0, 1.0
        growth = self._growth(omega, maps, best) if m else 0.0
        Y = self.outputs(self.theta, maps, best)[0]
        return SteadyState(Y, best[0], bool(error < _TOLERANCE), growth)

    def _growth(self, omega: float, maps: _Maps, forces: Array) -> float:
        """Size of the largest Floquet multiplier of the motion at the ports."""
        m, n, count = self.structure.n_ports, self.structure.n_states, len(self.waves)
        if any(law.inner_states for law in self.laws):
            return 0.0
        # linearization about the periodic motion: A(t) = A + sum_j E_j (df/dd P_d + df/dv P_v)
        motion = maps.free + np.einsum("limk,lmk->lik", maps.sensed, _phasors(forces))
        times = np.real(motion @ self.waves.T)
        M = self.structure.matrices(self.theta.astype(float))
        rates = np.repeat(M.A[None], count, axis=0)
        for j in range(m):
            _, *by = self.law(self.theta, j, times[:, j], times[:, m + j], maps.inputs)
            for one, row in zip(by, (j, m + j), strict=True):
                rates += one[0][:, None, None] * np.outer(M.E[:, j], M.P[row, :n])
        # monodromy matrix over one period; its eigenvalues are the Floquet multipliers
        turn = np.eye(n)
        for step in exponential(rates * (2 * np.pi / omega / count)):
            turn = step @ turn
        return float(np.abs(np.linalg.eigvals(turn)).max()) if np.isfinite(turn).all() else np.inf


class LineBalance(Balance):
    """All lines of a measured frequency response, each input driven in turn.

    Of several solutions for one sine the one nearest to the measured point counts, so no direction of a sweep
    needs to be known.

    Parameters
    ----------
    structure : Structure
        Model and effects without memory.
    record : ResponseRecord
        Response whose amplitude is known.
    """

    def __init__(self, structure: Structure, record: ResponseRecord) -> None:
        n, n_w, jumps = record.omega.size, record.n_inputs, structure.jumps
        super().__init__(
            structure, np.tile(record.omega, n_w), np.tile(record.inputs[0, :n], n_w),
            np.repeat(np.arange(n_w), n), _HARMONICS_FOR_JUMPS if jumps else _HARMONICS,
            _TIMES_FOR_JUMPS if jumps else _TIMES,
        )  # fmt: skip
        self.record = record
        measured = record.measured.response
        self.measured = np.moveaxis(measured, 0, -1).reshape(n_w * n, -1) * self.peaks[:, None]
        noise = np.abs(record.points(np.ones(record.noise.shape)))
        self.noise = np.moveaxis(noise, 0, -1).reshape(n_w * n, -1) * self.peaks[:, None]
        self._forces: Array | None = None
        self._kept: tuple[bytes, _Maps] | None = None

    def maps(self, theta: Array) -> _Maps:
        """Gains of the linear part; the last ones are kept."""
        key = theta.tobytes()
        if self._kept is None or self._kept[0] != key:
            self._kept = key, super().maps(theta)
        return self._kept[1]

    def begin(self, other: LineBalance | None) -> None:
        """Set the starting forces from a model without the last effects.

        They are zero if that model is linear.
        """
        size = self.basis.shape[1]
        forces = np.zeros((self.omega.size, self.structure.n_ports, size))
        # harmonics that both models have
        if other is not None and other._forces is not None:
            common = min(size, other._forces.shape[2])
            forces[:, : other._forces.shape[1], :common] = other._forces[:, :, :common]
        self._forces = forces

    # ------------------------------------------------------------------ the answers
    def response(self, theta: Array, *, derivatives: bool = True) -> tuple[Complex, list[Complex]]:
        """Return the frequency response of the fundamental, and its derivatives.

        It is the fundamental of the outputs over the sine of the input, shape (n_y, n_w, n_omega).
        """
        maps = self.maps(theta)
        forces = self._solve_forces(theta, maps)
        outputs = self._fundamental(theta, maps, forces)
        slopes = []
        if derivatives:
            slope = np.zeros((0, 0, 0))
            if forces.size:
                slope = self.mismatch(theta, maps, forces, slopes=True)[1]
            for k in range(theta.size):
                slopes.append(self._slope(theta, k, forces, outputs, slope))
        return self._as_response(outputs), slopes

    def _slope(self, theta: Array, k: int, forces: Array, outputs: Complex, slope: Array) -> Complex:
        """Return the derivative of the response by one coefficient.

        The forces follow so that they still agree with the motion that they cause.
        """
        step = _STEP * max(abs(theta[k]), self._size(k))
        ahead = theta.copy()
        ahead[k] += step
        maps = self.maps(ahead)
        moved = forces
        if forces.size:
            # implicit function theorem: dF/dtheta = -(dR/dF)^-1 dR/dtheta, R(F, theta) the mismatch
            rest = self.mismatch(ahead, maps, forces)[0]
            flat = rest.reshape(len(rest), -1, 1)
            moved = forces - _solve_each(slope, flat)[..., 0].reshape(forces.shape)
        return self._as_response((self._fundamental(ahead, maps, moved) - outputs) / step)

    def _size(self, k: int) -> float:
        """A size of a coefficient that is zero."""
        parameter = self.structure.parameters[k]
        effect = self.structure.effects[parameter.effect]
        port = next((p for p in self.structure.model.ports if p.name == effect.place), None)
        return 1.0 if port is None else 1.0 / max(float(np.abs(port.act).max()), 1e-12)

    def _fundamental(self, theta: Array, maps: _Maps, forces: Array) -> Complex:
        return self.outputs(theta, maps, forces)[:, :, 1]

    def _as_response(self, lines: Complex) -> Complex:
        n_y = lines.shape[1]
        points = (lines / self.peaks[:, None]).reshape(self.record.n_inputs, -1, n_y)
        return np.asarray(np.moveaxis(points, -1, 0))

    def _solve_forces(self, theta: Array, maps: _Maps) -> Array:
        """Return forces that agree with the motion that they cause.

        Their shape is (L, m, 2 K + 1). Of several solutions, the one nearest to the measured points is taken.
        """
        shape = (self.omega.size, self.structure.n_ports, self.basis.shape[1])
        if not self.structure.n_ports:
            return np.zeros(shape)
        fresh = self._forces is None
        best = self._from_measured(theta, maps) if self._forces is None else self._forces
        # Newton's method from the last forces
        best, error = self.newton(theta, maps, best, np.arange(shape[0]))
        off = self._distance(theta, maps, best)
        if not fresh and np.mean(off > 1.0) > _MOST_OFF:
            off[:] = 0.0  # the model is wrong, and not the chosen solution
        # another initial guess for lines that did not converge or lie far from the measured point
        for start in (self._from_measured(theta, maps), np.zeros(shape))[: 2 if fresh else 1]:
            again = np.flatnonzero((error > _TOLERANCE) | (off > 1.0))
            if not again.size:
                break
            tried, left = self.newton(theta, maps, start, again)
            # accept it where it converged and is nearer to the measured point
            nearer = (left[again] <= np.maximum(error[again], _TOLERANCE)) & (
                (error[again] > _TOLERANCE) | (self._distance(theta, maps, tried)[again] < off[again])
            )
            taken = again[nearer]
            best[taken], error[taken] = tried[taken], left[taken]
            off = self._distance(theta, maps, best)
        self._forces = best
        return best

    def _distance(self, theta: Array, maps: _Maps, forces: Array) -> Array:
        """Return the scaled distance of each line from its measured point.

        Above 1, another solution is worth a try.
        """
        limit = np.maximum(_FAR * self.noise, _FAR_SHARE * np.abs(self.measured))
        return np.asarray(
            (np.abs(self._fundamental(theta, maps, forces) - self.measured) / limit).max(axis=1)
        )

    def _from_measured(self, theta: Array, maps: _Maps) -> Array:
        """Return the forces for the motion that gives the measured outputs."""
        # least-squares forces at the fundamental that give the measured outputs
        rest = self.measured - maps.through[:, :, 1]
        first = _least_squares(maps.outputs[..., 1], rest[..., None])[..., 0]
        forces = np.zeros((len(first), first.shape[1], self.basis.shape[1]))
        forces[:, :, 1], forces[:, :, 2] = first.real, -first.imag
        # forces of the laws for that motion
        return forces - self.mismatch(theta, maps, forces)[0]


def _through_law(law: InputLaw | OutputLaw, signal: Array, values: Any, step: float = 1.0) -> Array:
    """Return a period behind a law.

    With memory, the second of two turns has forgotten where it began.
    """
    turns = 1 + (law.inner_states > 0)
    return np.asarray(law.through(np.tile(signal, turns), *values, step=step)[0][-signal.size :])


def _periodic_with_memory(code: int, row: Array, d: Array, v: Array, w: Array) -> tuple[Array, Array]:
    """Return a periodic force with an inner state, and its derivatives.

    After one period the inner state returns to its starting value.
    """
    # the inner state after one period is affine in its initial value: solve for the fixed point
    _, _, end, slope, left = memory_over_period(code, d, v, w, row, 0.0, np.zeros(d.size))
    lost = 1.0 - left
    start, slope = (end / lost, slope / lost) if lost > 1e-12 else (0.0, np.zeros(d.size))
    force, by, *_ = memory_over_period(code, d, v, w, row, start, slope)
    return force, by


def _phasors(coded: Array) -> Complex:
    """Return real Fourier coefficients in complex form.

    The last axis of `coded` holds the mean, then cosines and sines in turn.
    """
    mean = coded[..., :1].astype(complex)
    return np.concatenate([mean, coded[..., 1::2] - 1j * coded[..., 2::2]], axis=-1)


def _solve_each(slope: Array, right: Array) -> NDArray[Any]:
    """Solutions of many small systems; a singular one takes the shortest step."""
    try:
        return np.asarray(np.linalg.solve(slope, right))
    except np.linalg.LinAlgError:
        return _least_squares(slope, right)


def _least_squares(matrices: NDArray[Any], right: NDArray[Any]) -> NDArray[Any]:
    """Least squares of many small systems, along what they see."""
    # normal equations with a small ridge
    turned = np.swapaxes(matrices.conj(), 1, 2)
    normal = turned @ matrices
    ridge = _RIDGE * np.trace(normal, axis1=1, axis2=2).real[:, None, None] + 1e-300
    return np.asarray(np.linalg.solve(normal + ridge * np.eye(normal.shape[1]), turned @ right))
