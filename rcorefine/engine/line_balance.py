"""Harmonic balance over all lines of a frequency response at once.

The equations are those of `harmonic_balance.Balance`, which takes one sine at a time and determines how
stable its solution is. Here all lines take their Newton steps together. Of several solutions for one sine the
one nearest to the measured point counts, so no direction of a sweep needs to be known.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..data.response_record import ResponseRecord
from ..effects.formula import InputLaw, OutputLaw
from ..systems.linear import Array
from .kernels import law_over_period
from .structure import Structure

Complex = NDArray[np.complex128]
_HARMONICS, _HARMONICS_FOR_JUMPS = 5, 9
_TIMES, _TIMES_FOR_JUMPS = 48, 256
_SAMPLES_PER_JUMP = 1.5
_LEAK = 1e-7
_ITERATIONS, _HALVINGS, _TOLERANCE = 20, 4, 1e-8
_FAR, _FAR_SHARE = 5.0, 0.1  # standard deviations and share of a point, beyond which another answer is sought
_MOST_OFF = 0.3  # share of such lines, above which another answer would not help
_RIDGE = 1e-12
_STEP = 1e-6  # of a coefficient, for differences


def remembering(structure: Structure) -> list[str]:
    """Return the effects that have an inner state.

    Their responses to a sine are not balanced here.
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


class LineBalance:
    """Harmonic balance of a structure at the lines of a frequency response.

    Each input is driven in turn.

    Parameters
    ----------
    structure : Structure
        Model and effects without memory.
    record : ResponseRecord
        Response whose amplitude is known.
    """

    def __init__(self, structure: Structure, record: ResponseRecord) -> None:
        self.structure, self.record = structure, record
        n, n_w = record.omega.size, record.n_inputs
        self.omega, self.peaks = np.tile(record.omega, n_w), np.tile(record.inputs[0, :n], n_w)
        self.channels = np.repeat(np.arange(n_w), n)
        self.laws = [structure.effects[index].spec for index in structure.port_effects]
        times = _TIMES_FOR_JUMPS if structure.jumps else _TIMES
        self.harmonics = _HARMONICS_FOR_JUMPS if structure.jumps else _HARMONICS
        turn, order = 2 * np.pi * np.arange(times) / times, np.arange(1, self.harmonics + 1)
        self.waves = np.exp(1j * np.outer(turn, np.arange(self.harmonics + 1)))  # (T, K + 1)
        pairs = np.stack([np.cos(np.outer(turn, order)), np.sin(np.outer(turn, order))], axis=2)
        self.basis = np.hstack([np.ones((times, 1)), pairs.reshape(times, -1)])
        self.analysis = self.basis.T * (2.0 / times)
        self.analysis[0] /= 2.0
        measured = record.measured.response
        self.measured = np.moveaxis(measured, 0, -1).reshape(n_w * n, -1) * self.peaks[:, None]
        noise = np.abs(record.points(np.ones(record.noise.shape)))
        self.noise = np.moveaxis(noise, 0, -1).reshape(n_w * n, -1) * self.peaks[:, None]
        self._forces: Array | None = None
        self._kept: tuple[bytes, _Maps] | None = None

    def begin(self, other: LineBalance | None) -> None:
        """Set the starting forces from a model without the last effects.

        They are zero if that model is linear.
        """
        size = self.basis.shape[1]
        forces = np.zeros((self.omega.size, self.structure.n_ports, size))
        if other is not None and other._forces is not None:
            common = min(size, other._forces.shape[2])
            forces[:, : other._forces.shape[1], :common] = other._forces[:, :, :common]
        self._forces = forces

    # ------------------------------------------------------------------ the answers
    def response(self, theta: Array, *, derivatives: bool = True) -> tuple[Complex, list[Complex]]:
        """Return the frequency response of the fundamental, and its derivatives.

        It is the fundamental of the outputs over the sine of the input, shape (n_y, n_w, n_omega).
        """
        maps = self._maps(theta)
        forces = self._answers(theta, maps)
        outputs = self._outputs(theta, maps, forces)
        slopes = []
        if derivatives:
            slope = np.zeros((0, 0, 0))
            if forces.size:
                slope = self._mismatch(theta, maps, forces, slopes=True)[1]
            for k in range(theta.size):
                slopes.append(self._slope(theta, k, forces, outputs, slope))
        return self._shaped(outputs), slopes

    def _slope(self, theta: Array, k: int, forces: Array, outputs: Complex, slope: Array) -> Complex:
        """Return the derivative of the response by one coefficient.

        The forces follow so that they still agree with the motion that they cause.
        """
        step = _STEP * max(abs(theta[k]), self._size(k))
        ahead = theta.copy()
        ahead[k] += step
        maps = self._maps(ahead)
        moved = forces
        if forces.size:
            rest = self._mismatch(ahead, maps, forces)[0]
            flat = rest.reshape(len(rest), -1, 1)
            moved = forces - _solved(slope, flat)[..., 0].reshape(forces.shape)
        return self._shaped((self._outputs(ahead, maps, moved) - outputs) / step)

    def _size(self, k: int) -> float:
        """A size of a coefficient that is zero."""
        parameter = self.structure.parameters[k]
        effect = self.structure.effects[parameter.effect]
        port = next((p for p in self.structure.model.ports if p.name == effect.place), None)
        return 1.0 if port is None else 1.0 / max(float(np.abs(port.act).max()), 1e-12)

    def _shaped(self, lines: Complex) -> Complex:
        n_y = lines.shape[1]
        points = (lines / self.peaks[:, None]).reshape(self.record.n_inputs, -1, n_y)
        return np.asarray(np.moveaxis(points, -1, 0))

    # ------------------------------------------------------------------ linear part
    def _maps(self, theta: Array) -> _Maps:
        key = theta.tobytes()
        if self._kept is None or self._kept[0] != key:
            self._kept = key, self._made(theta)
        return self._kept[1]

    def _made(self, theta: Array) -> _Maps:
        s, M = self.structure, self.structure.matrices(theta.astype(float))
        n, m, K = s.n_states, s.n_ports, self.harmonics + 1
        sines = self._sines(theta)  # (L, K)
        shift = 1j * np.outer(self.omega, np.arange(K))
        shift[:, 0] = _LEAK * self.omega
        right = np.empty((self.omega.size, K, n, m + 1), complex)
        right[..., :m] = M.E[:, :m]
        right[..., m] = M.B[:, self.channels].T[:, None, :]
        states = np.linalg.solve(shift[..., None, None] * np.eye(n) - M.A, right)
        sensed = np.einsum("in,lknm->limk", M.P[:, :n], states)
        outputs = np.einsum("in,lknm->limk", M.C, states)
        direct = M.P[:, n:][:, self.channels].T, M.D[:, self.channels].T
        free = (sensed[:, :, m] + direct[0][:, :, None]) * sines[:, None, :]
        through = (outputs[:, :, m] + direct[1][:, :, None]) * sines[:, None, :]
        return _Maps(sensed[:, :, :m], free, outputs[:, :, :m] + M.G[None, :, :m, None], through)

    def _sines(self, theta: Array) -> Complex:
        """Return the Fourier coefficients of the driven input, (L, K + 1).

        Dead zones, saturations and delays are included.
        """
        s = self.structure
        signal = self.peaks[:, None] * self.basis[:, 1]
        order, late = np.arange(self.harmonics + 1), np.zeros(self.omega.size)
        for index, channel in s.input_statics:
            law, here = s.effects[index].spec, self.channels == channel
            assert isinstance(law, InputLaw)
            values = s.law_values(theta, index)
            if law.delays:
                late[here] += values[0]
            elif here.any():
                signal[here] = law.through(signal[here].ravel(), *values)[0].reshape(-1, signal.shape[1])
        late_by = np.exp(-1j * np.outer(self.omega * late, order))
        return np.asarray(self._phasors(signal @ self.analysis.T) * late_by)

    def _outputs(self, theta: Array, maps: _Maps, forces: Array) -> Complex:
        """Fundamental of each output, (L, n_y)."""
        s = self.structure
        Y = maps.through + np.einsum("limk,lmk->lik", maps.outputs, self._phasors(forces))
        for index, channel in s.output_statics:
            law = s.effects[index].spec
            assert isinstance(law, OutputLaw)
            times = np.real(Y[:, channel] @ self.waves.T)
            seen = law.through(times.ravel(), *s.law_values(theta, index))[0].reshape(times.shape)
            Y[:, channel] = self._phasors(seen @ self.analysis.T)
        found = Y[:, :, 1]
        for index, channel in s.output_delays:
            law = s.effects[index].spec
            assert isinstance(law, OutputLaw)
            found[:, channel] *= law.response(self.omega, s.law_values(theta, index)[0])[0]
        return np.asarray(found)

    @staticmethod
    def _phasors(coded: Array) -> Complex:
        """Return real Fourier coefficients in complex form.

        The last axis of `coded` holds the mean, then cosines and sines in turn.
        """
        mean = coded[..., :1].astype(complex)
        return np.concatenate([mean, coded[..., 1::2] - 1j * coded[..., 2::2]], axis=-1)

    # ------------------------------------------------------------------ Newton steps
    def _answers(self, theta: Array, maps: _Maps) -> Array:
        """Return forces that agree with the motion that they cause.

        Their shape is (L, m, 2 K + 1). Of several solutions, the one nearest to the measured points is taken.
        """
        shape = (self.omega.size, self.structure.n_ports, self.basis.shape[1])
        if not self.structure.n_ports:
            return np.zeros(shape)
        fresh = self._forces is None
        best = self._from_measured(theta, maps) if self._forces is None else self._forces
        best, error = self._newton(theta, maps, best, np.arange(shape[0]))
        off = self._off(theta, maps, best)
        if not fresh and np.mean(off > 1.0) > _MOST_OFF:
            off[:] = 0.0  # the model is wrong, not the answer that was chosen
        for start in (self._from_measured(theta, maps), np.zeros(shape))[: 2 if fresh else 1]:
            again = np.flatnonzero((error > _TOLERANCE) | (off > 1.0))
            if not again.size:
                break
            tried, left = self._newton(theta, maps, start, again)
            nearer = (left[again] <= np.maximum(error[again], _TOLERANCE)) & (
                (error[again] > _TOLERANCE) | (self._off(theta, maps, tried)[again] < off[again])
            )
            taken = again[nearer]
            best[taken], error[taken] = tried[taken], left[taken]
            off = self._off(theta, maps, best)
        self._forces = best
        return best

    def _off(self, theta: Array, maps: _Maps, forces: Array) -> Array:
        """Return the scaled distance of each line from its measured point.

        Above 1, another solution is worth a try.
        """
        limit = np.maximum(_FAR * self.noise, _FAR_SHARE * np.abs(self.measured))
        return np.asarray((np.abs(self._outputs(theta, maps, forces) - self.measured) / limit).max(axis=1))

    def _from_measured(self, theta: Array, maps: _Maps) -> Array:
        """Return the forces for the motion that gives the measured outputs."""
        rest = self.measured - maps.through[:, :, 1]
        first = _shortest(maps.outputs[..., 1], rest[..., None])[..., 0]
        forces = np.zeros((len(first), first.shape[1], self.basis.shape[1]))
        forces[:, :, 1], forces[:, :, 2] = first.real, -first.imag
        return forces - self._mismatch(theta, maps, forces)[0]

    def _newton(
        self, theta: Array, maps: _Maps, start: Array, lines: NDArray[np.intp]
    ) -> tuple[Array, Array]:
        """Solve the balance of some lines by damped Newton steps.

        The forces of all lines and the relative error of each are returned.
        """
        forces, error = start.copy(), np.zeros(len(start))
        active = lines
        rest, slope, wrong = self._mismatch(theta, maps, forces, active, slopes=True)
        error[active] = wrong
        for _ in range(_ITERATIONS):
            open_ = wrong > _TOLERANCE
            if not open_.any():
                break
            active, rest, slope, wrong = active[open_], rest[open_], slope[open_], wrong[open_]
            step = -_solved(slope, rest.reshape(len(rest), -1, 1))[..., 0].reshape(rest.shape)
            share, todo = np.ones(active.size), np.arange(active.size)
            trial = forces[active]
            for _ in range(_HALVINGS):
                trial[todo] = forces[active[todo]] + share[todo, None, None] * step[todo]
                now = self._mismatch(theta, maps, trial, active, at=todo)[2]
                worse = ~(now < wrong[todo] * (1 - 0.1 * share[todo]))
                todo = todo[worse]
                if not todo.size:
                    break
                share[todo] *= 0.5
            forces[active] = trial
            rest, slope, now = self._mismatch(theta, maps, forces, active, slopes=True)
            stuck = ~(now < wrong)
            error[active], wrong = now, np.where(stuck, 0.0, now)
        return forces, error

    def _mismatch(
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
        motion = maps.free[where] + np.einsum("limk,lmk->lik", sensed, self._phasors(F))
        times = np.real(motion @ self.waves.T)  # (L, 2 m, T)
        rest, slope = F.copy(), np.zeros((0, 0, 0))
        if slopes:
            slope = np.tile(np.eye(m * size), (len(F), 1, 1))
        scale = np.abs(F).max(axis=(1, 2))
        for j in range(m):
            f, *by = self._law(theta, j, times[:, j], times[:, m + j])
            hat = f @ self.analysis.T
            rest[:, j] -= hat
            scale = np.maximum(scale, np.abs(hat).max(axis=1))
            for row, one in zip((j, m + j), by, strict=True):
                if not slopes or not one.any():
                    continue
                for i in range(m):
                    waves = sensed[:, row, i, None, :] * self.waves  # (L, T, K + 1)
                    real = np.empty((*waves.shape[:2], size))
                    real[..., 0], real[..., 1::2], real[..., 2::2] = (
                        waves[..., 0].real, waves[..., 1:].real, waves[..., 1:].imag,
                    )  # fmt: skip
                    rows, columns = slice(j * size, (j + 1) * size), slice(i * size, (i + 1) * size)
                    slope[:, rows, columns] -= self.analysis @ (one[..., None] * real)
        return rest, slope, np.abs(rest).max(axis=(1, 2)) / np.where(scale > 0, scale, 1.0)

    def _law(self, theta: Array, j: int, d: Array, v: Array) -> tuple[Array, Array, Array]:
        """Return a force over one period (L, T), and its derivatives.

        They are taken with respect to displacement and velocity.
        """
        codes, values, _, widths = self.structure.laws(theta)
        code, row, width = int(codes[j]), values[j : j + 1], float(widths[j])
        nothing = np.zeros((d.size, self.structure.n_inputs))
        if not self.laws[j].jumps:
            f, by_d, by_v = law_over_period(code, d.ravel(), v.ravel(), nothing, row, width)
            return f.reshape(d.shape), by_d.reshape(d.shape), by_v.reshape(d.shape)
        found = np.empty((3, *d.shape))
        spread = np.maximum(width, _SAMPLES_PER_JUMP * np.ptp(v, axis=1) * np.pi / d.shape[1])
        for line in range(len(d)):
            found[:, line] = law_over_period(code, d[line], v[line], nothing[: d.shape[1]], row, spread[line])
        return found[0], found[1], found[2]


def _solved(slope: Array, right: Array) -> NDArray[Any]:
    """Solutions of many small systems; a singular one takes the shortest step."""
    try:
        return np.asarray(np.linalg.solve(slope, right))
    except np.linalg.LinAlgError:
        return _shortest(slope, right)


def _shortest(matrices: NDArray[Any], right: NDArray[Any]) -> NDArray[Any]:
    """Least squares of many small systems, along what they see."""
    turned = np.swapaxes(matrices.conj(), 1, 2)
    normal = turned @ matrices
    ridge = _RIDGE * np.trace(normal, axis1=1, axis2=2).real[:, None, None] + 1e-300
    return np.asarray(np.linalg.solve(normal + ridge * np.eye(normal.shape[1]), turned @ right))
