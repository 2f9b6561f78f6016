"""Observer of the healthy model that keeps its state between blocks."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...effects.compiled import raise_pending
from ...engine.inputs import InputSignal
from ...engine.kernels import march
from ...engine.point import field_numbers
from ...engine.setting import PIECES
from ...engine.simulation import structure_of
from ...engine.structure import Structure
from ...exceptions import DivergenceError, ModelError
from ...models.operating_point import check_stream_hold, refuse_discrete
from ...systems.linear import Array

__all__ = ["Observer", "Pace", "as_base", "pace_of"]


def as_base(model: Any, hold: str) -> tuple[Structure, Array, int]:
    """Return structure, coefficients and substeps of the healthy model.

    Raises
    ------
    ModelError
        If the model is discrete, was found to have another hold, or holds what needs the future.
    """
    refuse_discrete(model)
    structure, theta, substeps = structure_of(model)
    check_stream_hold(structure.model, hold)
    if structure.output_delays:
        raise ModelError(
            f"{structure.effects[structure.output_delays[0][0]].label}: a delay at an output cannot be "
            "estimated on a stream; refine with an input_delay or an output_lag"
        )
    return structure, np.asarray(theta, dtype=float), int(substeps)


@dataclass(frozen=True, slots=True)
class Pace:
    """Time scale of the model in samples.

    Attributes
    ----------
    period : int
        Samples in a period of the first mode; where nothing swings, in two time constants of the
        slowest state.
    word : str
        What that is.
    """

    period: int
    word: str


def pace_of(structure: Structure, theta: Array, dt: float) -> Pace:
    """Return the period of the first mode in samples.

    Without a mode the slowest state decides. The result is kept between 8 and 100 000.
    """
    poles = np.linalg.eigvals(structure.matrices(theta).A.astype(float))
    swinging = np.abs(poles[np.abs(poles.imag) > 0.2 * np.abs(poles)])
    if swinging.size:
        return Pace(int(np.clip(round(2 * math.pi / swinging.min() / dt), 8, 100_000)), "first mode")
    rates = np.abs(poles)
    rates = rates[rates > 1e-6 * rates.max(initial=0.0)]
    slowest = float(rates.min()) if rates.size else 2 / (50 * dt)
    return Pace(int(np.clip(round(2 / slowest / dt), 8, 100_000)), "slowest state")


class Observer:
    """Steady observer of a structure, advanced block by block.

    Parameters
    ----------
    structure : Structure
        Model with its effects.
    theta : ndarray, shape (p,)
        Their coefficients.
    dt : float
        Sampling time [s].
    hold : {"zoh", "foh"}
        The input between samples.
    substeps : int
        Substeps per sample.
    gain : ndarray, shape (n, n_y)
        Gain of ``x = x + gain (y - y_model)``.
    """

    def __init__(
        self, structure: Structure, theta: Array, dt: float, hold: str, substeps: int, gain: Array
    ) -> None:
        s = self.structure = structure
        self.theta, self.dt, self.hold, self.substeps = theta, dt, hold, substeps
        self.gain = np.ascontiguousarray(gain)
        step = dt / substeps
        disc = s.discretize(theta, step, derivatives=False)
        self._pieces = PIECES if s.jumps else 1
        fine = s.discretize(theta, step / self._pieces, derivatives=False) if s.jumps else disc
        self._disc, self._Ms = disc, np.stack([disc.M, fine.M])
        self._dMs = np.stack([disc.dM, fine.dM])
        codes, values, columns, widths = s.laws(theta)
        self._laws = codes, values, np.full_like(columns, -1), widths
        outcodes, outvalues, outcolumns = s.output_laws(theta)
        self._out = outcodes, outvalues, np.full_like(outcolumns, -1)
        delays = [
            float(s.value(theta, i, s.effects[i].coefficients[0]))
            for i, _ in s.input_statics
            if s.effects[i].spec.delays
        ]
        turning = [s.effects[i].label for i, _ in s.input_statics if s.effects[i].spec.inner_states]
        if turning:
            raise ModelError(
                f"{turning[0]}: an input effect with an inner state cannot be part of the healthy "
                "model of a monitor; leave it out, or name it among the candidates"
            )
        self.lag = 1 + (math.ceil(sum(delays) / dt) + 2 if delays else 0)

    def begin(self, x0: Array) -> dict[str, Array]:
        """Memory before the first sample."""
        s = self.structure
        inner = np.zeros(s.n_ports + s.n_outputs * s.remembers)
        return {"x": np.array(x0, dtype=float), "z": inner, "w": np.zeros((0, s.n_inputs))}

    def advance(
        self,
        memory: Mapping[str, Array],
        W: Array,
        Y: Array,
        use: NDArray[np.uint8],
        first: int,
    ) -> tuple[dict[str, Array], Array, Array]:
        """Advance over a block.

        Parameters
        ----------
        memory : mapping
            From `begin` or the last call; left as it is.
        W, Y : ndarray, shape (N, n_w), (N, n_y)
            Samples, finite.
        use : ndarray of uint8, shape (N, n_y)
            Which outputs correct the state.
        first : int
            Samples before, for messages.

        Returns
        -------
        memory : dict
            Memory after the block.
        outputs : ndarray, shape (N, n_y)
            Predicted outputs.
        states : ndarray, shape (N, n)
            States after the correction.
        """
        s, disc = self.structure, self._disc
        past = memory["w"]
        before = min(len(past), 1)  # the sample before, from which the first step starts
        whole = np.concatenate([past, W])
        N, ny, n, m = W.shape[0] + before, s.n_outputs, s.n_states, s.n_ports
        signal = InputSignal(np.ascontiguousarray(whole.T), self.dt, self.hold, self.substeps)
        drive = signal.drive(s, self.theta)
        skip = len(whole) - N
        measured, flags = np.zeros((N, ny)), np.zeros((N, ny), dtype=np.uint8)
        measured[before:], flags[before:] = Y, use
        x, z = memory["x"].copy(), memory["z"].copy()
        Yout, SY = np.full((N, ny), np.nan), np.zeros((N, ny, 0))
        X, F = np.full((N, n), np.nan), np.full((N if m else 0, m), np.nan)
        none = np.zeros((0, 1, s.n_inputs + 1))
        limit = 1e12 * (1.0 + float(np.abs(x).max(initial=0.0) + np.abs(Y).max() + np.abs(W).max()))
        blew_up = march(
            self._Ms, self._dMs, self._pieces, disc.linear, disc.O, disc.dO, disc.P, disc.dP, *self._laws,
            np.ascontiguousarray(drive.W[skip * self.substeps * max(drive.course, 1) :]), drive.course,
            np.ascontiguousarray(drive.Wout[skip:]), none, none, np.zeros(0, dtype=np.int64),
            measured, flags, self.gain, np.zeros((0, 0)), *self._out, x, z, np.zeros((0, n)), self.substeps,
            Yout, SY, X, F, limit, np.full(ny, np.inf), *field_numbers(s, self.theta),
        )  # fmt: skip
        raise_pending()
        if blew_up >= 0:
            raise DivergenceError(
                f"the observer of the healthy model left all bounds at sample {first + blew_up - before}; "
                "check the model, the units of the samples, or raise disturbance"
            )
        after = {"x": x, "z": z, "w": whole[-self.lag :].copy()}
        return after, Yout[before:], X[before:]
