"""Simulation of the structure over a record, with exact sensitivities.

One engine serves compare, refine and diagnose: free run, observer (innovation
form), or windows (filter for a while, then run free), by one schedule.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline

from ..data.measurement import Measurement
from ..effects.compiled import raise_pending
from ..effects.formula import InputLaw, OutputLaw
from ..exceptions import DivergenceError
from ..gauss_newton import own_sizes
from ..jit import NUMBA
from ..systems.linear import Array
from .commands import Commands, commands, march_in_loop
from .controlled import closes_loop, sample_jumps, start_columns
from .inputs import BAND_LIMITED_FACTOR, Drive, InputSignal, clock_drift
from .linear import Corrections, simulate_linear
from .march import MarchResult, MarchState, address_of_march, march
from .matrices import continuous_matrices
from .setting import Setting, setting
from .structure import Structure

MOST_SUBSTEPS = 10_000  # substeps per sample, at most

# multiples of the largest output in the record at which a simulation has diverged; a nonlinear right-hand
# side runs away within samples, so that the bound is lower (units may be off by a factor of 1000)
_FAR, _FAR_OF_FIELD = 1e12, 1e5
_RUNS_AWAY = 100.0  # multiple of the record beyond which the motion shows only the growth
_BEYOND = 1e100  # bound of every state, in any unit
_WHOLE = 0.05  # excess in samples with which an estimated delay still counts as a whole number of samples
# share of samples that may depend on the time before the record, in the first and in later windows: with
# more of them an effect could gain by hiding samples
_HIDDEN, _HIDDEN_LATER = 0.5, 0.1
_NODES_FOR_DELAY = 8  # nodes per sample where an output is interpolated, or edges of inputs fall between them


@dataclass(frozen=True, slots=True, eq=False)
class Trajectory:
    """MarchResult of a simulation by the engine.

    Attributes
    ----------
    outputs : ndarray, shape (n_y, N)
        Model outputs at the samples.
    sensitivity : ndarray, shape (n_y, N, p)
        Derivatives by the free coefficients and, where asked for, by the n initial states.
    states : ndarray, shape (n, N)
        States at the samples (after the correction where an observer acts).
    forces : ndarray, shape (m, N)
        Resisting forces of the effects that keep a port, then the rows of a nonlinear model's field.
    blew_up : int
        First sample at which the state left all bounds, -1 if none.
    last : MarchState, optional
        State and memory of the laws at the last sample; the derivatives of the state are there where the
        record is a part of a stream (`Engine(past=...)`).
    """

    outputs: Array
    sensitivity: Array
    states: Array
    forces: Array
    blew_up: int
    last: MarchState | None = None


class Engine:
    """A structure on one record.

    Parameters
    ----------
    structure : Structure
        Model and effects.
    data : Measurement
        Record; its channels stand in the order of the model's. A model with a `hold` of its
        own takes the inputs by that one.
    substeps : int, optional
        Substeps per sampling interval; 1 is exact for linear effects. Rounded up
        to a multiple of 4 for a band-limited input.
    initial : ndarray, shape (n,), optional
        Initial state, where it is known and not to be estimated. Zero means rest: nothing
        acted before the record.
    lead : ndarray of shape (n, n_y), optional
        Gain that acts where `run` is given none: that of an observer (`leading_gain`) or of a controller
        (`loop_gain`).
    past : ndarray of shape (n_w, K), optional
        Inputs at the K samples before the record, which is then a block of a stream: delays and laws with a
        memory reach back into them.
    """

    def __init__(
        self,
        structure: Structure,
        data: Measurement,
        *,
        substeps: int = 1,
        initial: Array | None = None,
        lead: Array | None = None,
        past: Array | None = None,
    ) -> None:
        data = structure.model.held(data)
        self.structure, self.data = structure, data
        self._known_start = initial is not None
        self.lead = lead
        self._resets = sample_jumps(structure, data.dt)
        self._lawless = not (structure.n_forces or structure.output_statics or self._resets.size)
        # delays and clock drift: outputs are interpolated between the samples, inputs between the substeps
        if structure.output_delays or clock_drift(structure, structure.start())[1]:
            substeps = max(substeps, _NODES_FOR_DELAY)
        if data.hold == "bandlimited":
            substeps = BAND_LIMITED_FACTOR * -(-substeps // BAND_LIMITED_FACTOR)
        self.substeps = substeps
        at_rest = initial is not None and not initial.any()
        before = data.inputs[:, :0] if past is None else past
        inputs = np.hstack([before, data.inputs])
        begin, self._streams = data.elapsed - data.dt * before.shape[1], past is not None
        self._signal = InputSignal(inputs, data.dt, data.hold, substeps, at_rest, begin, before.shape[1])
        # a copy: a read-only view would have the march compiled once more
        self._measured = np.array(data.outputs.T, order="C")
        # operating point: sensors read absolute values, the model deviations
        point = structure.model.operating_point
        self._level = np.zeros(structure.n_outputs) if point is None else point.outputs
        self._measured += self._level
        self._largest = np.abs(self._measured).max(axis=0, initial=0.0)
        # an empty record has no size
        far = _FAR if structure.field is None else _FAR_OF_FIELD
        self._far = np.where(self._largest > 0, far * self._largest, np.inf)
        self._nowhere = np.zeros(self._measured.shape, dtype=np.uint8)

    def run(
        self,
        theta: Array,
        x0: Array | None = None,
        *,
        sensitivity: bool = True,
        initial_state: bool = False,
        gain: Array | None = None,
        use: NDArray[np.bool_] | None = None,
        inner: Array | None = None,
        histories: bool = False,
        check: bool = True,
    ) -> Trajectory:
        """Simulate the record.

        Parameters
        ----------
        theta : ndarray, shape (p,)
            Free coefficients in the order of `Structure.parameters`.
        x0 : ndarray, shape (n,), optional
            Initial state, default zero.
        sensitivity : bool
            Whether to carry derivatives by theta.
        initial_state : bool
            Whether to carry derivatives by the initial state too.
        gain : ndarray, shape (n, n_y), optional
            Observer gain; a free run without it (or `lead`).
        use : ndarray of bool, shape (N, n_y), optional
            Where the observer corrects; everywhere by default.
        inner : ndarray, shape (m + n_y,), optional
            Memory of the laws at the first sample, as `Trajectory.last` has it; default at rest.
        histories : bool
            Whether to return states and forces.
        check : bool
            Raise where the simulation leaves all bounds; otherwise say when in `blew_up`.

        Returns
        -------
        Trajectory
            Outputs, derivatives, states and forces.

        Raises
        ------
        DivergenceError
            If a state leaves all bounds.
        """
        s, N = self.structure, self.data.n_samples
        n, ny, p = s.n_states, s.n_outputs, s.n_parameters if sensitivity else 0
        # matrices of one substep, and their derivatives by the coefficients
        at = setting(s, theta, self.data.dt / self.substeps, p > 0)
        drive = self._signal.drive(s, theta)
        if not sensitivity:
            drive = drive.held
        lead = self.lead if gain is None else gain
        observer, loop = self._corrections(lead, use), commands(s, theta, self._signal, lead)
        # linear model: initial states act by superposition, so their derivatives are computed separately
        apart = initial_state and use is None and self._lawless and not self._streams
        S = start_columns(s, p + n) if initial_state and not apart else np.zeros((p, n))
        kept = N * histories
        into = MarchResult(
            np.full((N, ny), np.nan), np.zeros((N, ny, len(S))), np.full((kept, n), np.nan),
            np.full((kept, s.n_forces), np.nan), self._far, _BEYOND, self.substeps,
        )  # fmt: skip
        # state and memory of the laws, changed in place
        course = MarchState(_first(x0, n), _first(inner, s.n_ports + ny), S)
        blew_up = self._march(at, drive, observer, course, into, loop)
        if blew_up >= 0 and check:
            raise self._divergence(at, blew_up)
        outputs, SY = into.outputs, into.sensitivity
        if apart:
            SY = np.concatenate([SY, self._decay(at, theta, observer.gain, blew_up)], axis=2)
        # output delays act after the simulation, by interpolation
        for index, channel in s.output_delays:
            if np.isfinite(outputs[:, channel]).all():  # after divergence there is nothing to delay
                self._delay_output(theta, index, channel, outputs, SY, sensitivity, drive)
        # in `march` time is the first axis; in a trajectory it follows the channels
        signals = (outputs - self._level).T, np.moveaxis(SY, 1, 0), into.states.T, into.forces.T
        Y, SY, X, F = map(np.ascontiguousarray, signals)
        return Trajectory(Y, SY, X, F, blew_up, course)

    def _divergence(self, at: Setting, blew_up: int) -> DivergenceError:
        if not at.finite:
            return DivergenceError(
                "the model with these effects grows beyond all numbers within one sample; start from "
                "other coefficients or bound them"
            )
        return DivergenceError(
            f"the simulation left all bounds at sample {blew_up} (t = {blew_up * self.data.dt:.6g} s): "
            "the model with these effects is unstable; start from other coefficients or bound them"
        )

    def _march(
        self, at: Setting, drive: Drive, observer: Corrections, course: MarchState, into: MarchResult,
        loop: Commands | None,
    ) -> int:  # fmt: skip
        """March over the record, from sample to sample where a loop asks for it.

        Return the first sample at which the state left all bounds, or -1.
        """
        if not at.finite:
            return 0
        if self._lawless and not NUMBA:
            return simulate_linear(at.model.at, drive, observer, course.x, course.S, into)
        with np.errstate(all="ignore"):  # the march detects overflow itself; no warnings, as in compiled code
            if loop is None:
                blew_up: int = march(at.model, drive, observer, course, into)
            else:
                course = course._replace(z=np.append(course.z, np.full(self.structure.n_outputs, np.nan)))
                given = at.model, drive.with_ends, observer, course, into, loop
                blew_up = march_in_loop(address_of_march(), *given)
        raise_pending()
        return blew_up

    def _decay(self, at: Setting, theta: Array, gain: Array, blew_up: int) -> Array:
        """Return the output derivatives by the initial states, (N, n_y, n).

        The model is linear. From the sample `blew_up` on they are zero.
        """
        s, N = self.structure, self.data.n_samples
        longest = 1 << (N - 1).bit_length()  # records of similar length share the result
        key = ("decay", theta[s.absorbed].tobytes(), gain.tobytes(), self.data.dt, self.substeps, longest)
        found = s.kept(key, lambda: at.decay(self.substeps, gain, longest))[:N]
        return found if blew_up < 0 else np.where((np.arange(N) < blew_up)[:, None, None], found, 0.0)

    def _corrections(self, gain: Array | None, use: NDArray[np.bool_] | None) -> Corrections:
        """Return what the observer corrects: in a free run no flag is set."""
        shape = self._measured.shape
        if gain is None:
            none = np.zeros((self.structure.n_states, shape[1]))
            return Corrections(self._measured, self._nowhere, none, self._resets)
        flags = np.ones(shape, dtype=np.uint8) if use is None else use.astype(np.uint8)
        flags *= np.uint8(2 if closes_loop(self.structure, gain) else 1)
        return Corrections(self._measured, flags, np.ascontiguousarray(gain, dtype=float), self._resets)

    def judged(self, theta: Array) -> NDArray[np.bool_]:
        """Return the samples that can be compared with the model, (n_y, N).

        The others depend on unknown inputs or unknown motion: with a delay on those before the record, with a
        clock drift on those after its end. With an initial state that is free nothing else is lost there.
        """
        s, at = self.structure, np.arange(self.data.n_samples)
        if not s.drifts and not any(isinstance(e.spec, InputLaw | OutputLaw) for e in s.effects):
            return np.ones((s.n_outputs, at.size), dtype=bool)
        # sample at which the inputs are read
        past = self._signal.past
        read = at + clock_drift(s, theta)[0] * (self.data.elapsed / self.data.dt + at)
        found = np.tile((read > _WHOLE - 1.0 - past) & (read < at.size - 1 + _WHOLE), (s.n_outputs, 1))
        if found.mean() < 0.5:
            found[:] = True
        for index, effect in enumerate(s.effects):
            law = effect.spec
            if isinstance(law, InputLaw | OutputLaw) and not self._known_start:
                values = [float(s.value(theta, index, name)) for name in law.coefficient_names]
                count = law.unseen(self.data.dt, *values)
                most = 1.0 if self._streams else _HIDDEN_LATER if self.data.elapsed else _HIDDEN
                everywhere = isinstance(law, InputLaw)
                count -= past * everywhere  # inputs before the record are known there
                hidden = at < np.ceil(np.clip(count - _WHOLE, 0.0, most * at.size))
                labels = s.linear_model.output_labels
                found[slice(None) if everywhere else labels.index(effect.place)] &= ~hidden
        return found

    def state_sizes(self, theta: Array) -> Array:
        """Return the typical size of each state, shape (n,).

        It is found without nonlinear forces and serves as the unit of the state.
        """
        # first run without nonlinear forces
        calm = theta.copy()
        if not self.structure.is_linear:
            calm[self.structure.port_columns] = 0.0
        run = self.run(calm, sensitivity=False, histories=True, check=False)
        # leave out what follows after the motion has run away
        outputs, far = run.outputs.T + self._level, np.where(self._largest > 0, self._largest, np.inf)
        away = ~(np.abs(outputs) <= _RUNS_AWAY * far).all(axis=1)
        end = int(away.argmax()) if away.any() else -1
        reached = np.abs(run.states[:, : end if end > 0 else None]).max(axis=1, initial=0.0)
        if (reached > 0).all():
            return np.asarray(reached)
        # states that did not move: the size that moves an output by its own size
        level = self._largest[:, None, None]
        slopes = self.run(calm, sensitivity=False, initial_state=True, check=False).sensitivity
        return own_sizes(reached, (slopes / np.where(level > 0, level, 1.0)).reshape(-1, reached.size))

    def _delay_output(
        self, theta: Array, index: int, channel: int, Y: Array, SY: Array, sensitivity: bool, drive: Drive
    ) -> None:
        """Delay one output, along a spline through the samples.

        The spline does not smooth the corners that a held input makes at the samples.
        """
        law = self.structure.effects[index].spec
        assert isinstance(law, OutputLaw)
        (name,) = law.coefficient_names
        value, column = float(self.structure.value(theta, index, name)), self.structure.position(index, name)
        grid: Array = self.data.dt * np.arange(Y.shape[0], dtype=np.float64)
        corners = self._corners(theta, channel, SY.shape[2] if sensitivity else 0, drive)
        # delay of the output, then of its derivatives, which have corners of their own
        late, slope = law.later(_course(grid, Y[:, channel], corners[..., 0]), value)
        if SY.shape[2]:
            slopes = SY[:, channel]
            seen = np.isfinite(slopes).all(axis=0)  # derivatives may overflow where the motion does not
            own = np.zeros((*corners.shape[:2], slopes.shape[1]))
            own[..., : corners.shape[2] - 1] = corners[..., 1:]
            slopes[:, seen] = law.later(_course(grid, slopes[:, seen], own[..., seen]), value)[0]
            if sensitivity and column >= 0:
                SY[:, channel, column] = slope
        Y[:, channel] = late

    def _corners(self, theta: Array, channel: int, columns: int, drive: Drive) -> Array:
        """Return the slope and the curvature that held inputs give an output.

        They are constant between two samples. The shape is (2, N - 1, 1 + p): first the output, then its
        derivatives by the coefficients. They are zero where the inputs do not jump, and behind a law of the
        output.
        """
        s, N = self.structure, self.data.n_samples
        p = min(columns, s.n_parameters)
        if drive.course or channel in [at for _, at in s.output_statics]:
            return np.zeros((2, N - 1, 1 + p))
        # complex steps give the derivatives of C B (slope per unit of input) and C A B (curvature)
        points = np.vstack([theta, theta + 1e-30j * np.eye(theta.size)[:p]])
        at = continuous_matrices(s, points)
        C = at.C[:, None, channel]
        rows = np.concatenate([C @ at.B, C @ at.A @ at.B], axis=1)
        inputs = [drive.W, *drive.dW]  # inputs over the substeps, and their derivatives
        held, *moved = (W.reshape(N - 1, -1, W.shape[1]).mean(axis=1) for W in inputs)
        weights = np.concatenate([rows[:1].real, rows[1:].imag / 1e-30])
        found = np.einsum("nw,kow->onk", held, weights)
        for column, change in zip(drive.driven, moved, strict=True):
            if column < p:
                found[..., 1 + column] += weights[0] @ change.T
        return np.asarray(found)


def _course(grid: Array, values: Array, corners: Array) -> CubicSpline:
    """Return the spline through values (N, ...) with corners at the samples.

    What has the slopes and curvatures `corners` (2, N - 1, ...) is taken off, and the rest is smooth.
    """
    (slope, bend), h = corners, grid[1] - grid[0]
    # piecewise quadratic with these slopes and curvatures, continuous at the samples
    slope = slope + np.cumsum(bend * h, axis=0) - bend * h
    whole = np.concatenate([0.0 * slope[:1], np.cumsum(slope * h + bend * (h * h / 2), axis=0)])
    course = CubicSpline(grid, values - whole)
    # add the quadratic to the coefficients of the cubic spline, highest power first
    course.c[-3:] += [bend / 2, slope, whole[:-1]]
    return course


def _first(given: Array | None, size: int) -> Array:
    """Return a copy of what a run begins with: by default zeros."""
    return np.zeros(size) if given is None else np.array(given, dtype=float)
