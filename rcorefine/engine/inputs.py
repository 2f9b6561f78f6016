"""Inputs between the samples: hold, static effects, delay, clock drift."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.signal import firwin, upfirdn

from ..effects.formula import InputLaw
from ..systems.linear import Array

if TYPE_CHECKING:
    from .structure import Structure


BAND_LIMITED_FACTOR = 4
_HALF_LENGTH = 48  # taps of the sinc, in samples each side


def interpolate_band_limited(w: Array, factor: int) -> Array:
    """Band-limited interpolation of each row by `factor`, the samples kept.

    Parameters
    ----------
    w : ndarray, shape (n_w, N)
        Samples.
    factor : int
        Points per sampling interval.

    Returns
    -------
    ndarray, shape (n_w, (N - 1) * factor + 1)
        The windowed-sinc interpolation (Kaiser, 48 samples each side). The ends
        are continued by point reflection, which keeps level and slope.
    """
    n = w.shape[1]
    half = min(_HALF_LENGTH, n - 1)
    # windowed-sinc low-pass filter with its cutoff at the Nyquist frequency of the samples
    taps = firwin(2 * half * factor + 1, 1.0 / factor, window=("kaiser", 9.0)) * factor
    # continue both ends by point reflection
    left = 2 * w[:, :1] - w[:, half:0:-1]
    right = 2 * w[:, -1:] - w[:, -2 : -half - 2 : -1]
    padded = np.hstack([left, w, right])
    # insert zeros between the samples and filter; then cut off the delay of the filter
    fine = np.stack([upfirdn(taps, row, up=factor) for row in padded])
    start = 2 * half * factor
    fine = fine[:, start : start + (n - 1) * factor + 1]
    fine[:, ::factor] = w
    return np.ascontiguousarray(fine)


class Drive(NamedTuple):
    """Inputs over all substeps, values at the samples, and their derivatives.

    `course` says how a substep finds its own in W, as `march` takes it: 0 held, a row each; 1 straight from
    its row to the next; 2 straight between two rows of its own.
    """

    W: Array
    course: int
    Wout: Array
    dW: Array
    dWout: Array
    driven: NDArray[np.int64]

    @property
    def with_ends(self) -> Drive:
        """Return the drive with both ends of each substep, without derivatives."""
        W = self.W
        if self.course < 2:
            W = np.repeat(W, 2, axis=0) if self.course == 0 else np.repeat(W, 2, axis=0)[1:-1]
        return self.held._replace(W=W, course=2)

    @property
    def held(self) -> Drive:
        """Return the drive without its derivatives."""
        return self._replace(dW=self.dW[:0], dWout=self.dWout[:0], driven=self.driven[:0])


class InputSignal:
    """Input signals between the samples.

    Parameters
    ----------
    inputs : ndarray, shape (n_w, N)
        Samples.
    dt : float
        Sampling time in seconds.
    hold : {"zoh", "foh", "bandlimited"}
        How the input runs between its samples.
    substeps : int
        Substeps per sampling interval; a multiple of 4 for "bandlimited".
    at_rest : bool
        Whether the input was zero before the first sample; else a delay brings in its
        first value, for want of a better one.
    begin : float
        Seconds from where the recording began to the first sample: clocks that run apart agree there.
    past : int
        Samples at the start that belong to the time before the record.
    """

    def __init__(
        self,
        inputs: Array,
        dt: float,
        hold: str,
        substeps: int,
        at_rest: bool = False,
        begin: float = 0.0,
        past: int = 0,
    ) -> None:
        self.inputs, self.dt, self.hold, self.substeps = inputs, dt, hold, substeps
        self.begin, self.past = begin, past
        self.before = 0.0 if at_rest else 1.0  # input before the record over its first value
        n = inputs.shape[1]
        self._fine: Array | None = None
        if hold == "bandlimited":
            coarse = interpolate_band_limited(inputs, BAND_LIMITED_FACTOR)
            # linear interpolation between the nodes loses (omega h)^2 / 12 of a sine: correct for it
            coarse[:, 1:-1] -= np.diff(coarse, 2) / 12.0
            self._fine = straight_lines(coarse, substeps // BAND_LIMITED_FACTOR)
        elif hold == "foh":
            self._fine = straight_lines(inputs, substeps)
        rows = n - 1
        held = np.repeat(inputs[:, :rows], substeps, axis=1) if self._fine is None else self._fine
        # last column: the constant input 1 of operating points and offsets
        self._base = np.ascontiguousarray(np.vstack([held, np.ones((1, held.shape[1]))]).T)
        self._base_out = np.ascontiguousarray(np.vstack([inputs, np.ones((1, n))]).T)
        empty, none = np.zeros((0, *self._base.shape)), np.zeros((0, *self._base_out.shape))
        given = (int(self._fine is not None), self._base_out, empty, none, np.zeros(0, dtype=np.int64))
        self._course, self._as_given = given[0], self._recorded(Drive(self._base, *given))

    def drive(self, structure: Structure, theta: Array) -> Drive:
        """Input nodes with the structure's dead zones, saturations and delays."""
        statics = structure.input_statics
        drifts = structure.drifts
        if not statics and not drifts:
            return self._as_given
        laws = [structure.effects[index].spec for index, _ in statics]
        moving = self._fine is None and any(getattr(law, "moves_on", False) for law in laws)
        W, Wout = np.repeat(self._base, 2 if moving else 1, axis=0), self._base_out.copy()
        # derivatives by the free coefficients: column in theta, input, values at nodes and samples
        slopes: list[tuple[int, int, Array, Array]] = []
        for channel in range(len(self.inputs)) if drifts else sorted({c for _, c in statics}):
            acting, derivatives = self._acting(structure, theta, channel, moving)
            W[:, channel], Wout[:, channel] = acting
            slopes += [(which, channel, fine, rough) for which, fine, rough in derivatives if which >= 0]
        dW, dWout = np.zeros((len(slopes), *W.shape)), np.zeros((len(slopes), *Wout.shape))
        for k, (_, channel, fine, rough) in enumerate(slopes):
            dW[k, :, channel], dWout[k, :, channel] = fine, rough
        driven = np.array([which for which, *_ in slopes], dtype=np.int64)
        return self._recorded(Drive(W, 2 if moving else self._course, Wout, dW, dWout, driven))

    def _recorded(self, drive: Drive) -> Drive:
        """Leave out what acts before the record."""
        if not self.past:
            return drive
        rows = self.past * self.substeps * max(drive.course, 1)
        W, Wout = drive.W[rows:], drive.Wout[self.past :]
        dW, dWout = (np.ascontiguousarray(one) for one in (drive.dW[:, rows:], drive.dWout[:, self.past :]))
        return drive._replace(W=W, Wout=Wout, dW=dW, dWout=dWout)

    def _acting(
        self, structure: Structure, theta: Array, channel: int, moving: bool
    ) -> tuple[tuple[Array, Array], list[tuple[int, Array, Array]]]:
        """Return what one input does, at the nodes and at the samples.

        Its derivatives follow, each with its column in theta.
        """
        # effects of this input: static laws first, then delay and clock drift
        here = [index for index, c in structure.input_statics if c == channel]
        samples = self.inputs[channel] if self._fine is None else self._fine[channel]
        signal, slopes = self._statics(structure, theta, here, channel, samples)
        (delay, column), (drift, drifts) = _delay(structure, theta, here), clock_drift(structure, theta)
        signals, times = np.array([signal, *slopes.values()]), list[tuple[int, Array, Array]]()
        # shift in time, with the derivatives by the delay and by the drift
        if delay or drift or drifts or column >= 0 or moving:
            at_nodes, at_samples, by_delay, by_drift = self._shift(signals, delay, drift, moving)
            times = [(column, *by_delay), *((which, *by_drift) for which in drifts)]
        elif self._fine is None:
            at_nodes, at_samples = np.repeat(signals[:, :-1], self.substeps, axis=1), signals
        else:
            at_nodes, at_samples = signals, signals[:, :: self.substeps]
        by_laws = zip(slopes, at_nodes[1:], at_samples[1:], strict=True)
        return (at_nodes[0], at_samples[0]), [*by_laws, *times]

    def _statics(
        self, structure: Structure, theta: Array, effects: list[int], channel: int, signal: Array
    ) -> tuple[Array, dict[int, Array]]:
        """The laws in turn, and the derivative by each free coefficient."""
        columns: list[int] = []
        point = structure.model.operating_point
        value = signal
        held = self._fine is None
        step = self.dt / (1 if held else self.substeps)
        lead = int(point is not None)
        settled = lead + (self.before > 0)
        if point is not None:  # laws see absolute values; before the record the input stood at the point
            level = point.inputs[channel]
            value = np.concatenate([[level], signal + level])
        slopes = np.zeros((0, value.size))
        # laws in series: each takes the output of the one before, with its derivatives
        for index in effects:
            law = structure.effects[index].spec
            if law.delays or not isinstance(law, InputLaw):
                continue
            if held and law.moves_on and step == self.dt:  # from here on two values per substep
                spread = np.repeat([1, 2 * self.substeps], [lead, value.size - lead])
                value, slopes = np.repeat(value, spread), np.repeat(slopes, spread, axis=1)
                step /= 2 * self.substeps
            values = structure.law_values(theta, index)
            value, own, slopes = law.through(
                value, *values, slopes=slopes, step=step, held=held, settled=settled
            )
            found = structure.law_columns(index)
            free = [c for c, column in enumerate(found) if column >= 0]
            slopes = np.vstack([slopes, own[free]])
            columns += [found[c] for c in free]
        # back to deviations from the operating point
        if point is not None:
            value = value[1:] - (value[0] if structure.balanced else level)
            slopes = slopes[:, 1:] - (slopes[:, :1] if structure.balanced else 0.0)
        return value, dict(zip(columns, slopes, strict=True))

    def _shift(
        self, signals: Array, delay: float, drift: float, moving: bool
    ) -> tuple[Array, Array, tuple[Array, Array], tuple[Array, Array]]:
        """Return delayed and drifting signals at nodes and samples.

        The signals have shape (k, points). The derivatives of the first signal are returned as well. At time
        t of the record they are what they were at t - delay + drift t. The derivatives are those by the delay
        and by the drift, at the nodes and at the samples.
        """
        if self._fine is None:
            return self._means(signals, delay, drift, moving)
        step = self.dt / self.substeps
        grid = np.arange(signals.shape[1]) * step
        # time at which each node reads the input
        shifted = grid - delay + drift * (self.begin + grid)
        at_nodes = np.array([np.interp(shifted, grid, s, left=self.before * s[0]) for s in signals])
        # rate of the input there: derivative by the delay with a minus sign
        cell = np.clip(np.floor(shifted / step + 1e-9).astype(int), 0, len(grid) - 2)
        known = (shifted >= 0) & (shifted <= grid[-1])
        rate = np.where(known, np.diff(signals[0])[cell] / step, 0.0)
        by_delay, by_drift = ((r, r[:: self.substeps]) for r in (-rate, rate * (self.begin + grid)))
        return at_nodes, at_nodes[:, :: self.substeps], by_delay, by_drift

    def _means(
        self, signals: Array, delay: float, drift: float, moving: bool
    ) -> tuple[Array, Array, tuple[Array, Array], tuple[Array, Array]]:
        """As `_shift`, of held signals: the means over the substeps.

        So no impulse is lost where a delayed edge falls inside a substep. Where an actuator is `moving`
        they are straight lines with the means of both halves of the substep, which a ramp is itself.
        """
        n, size = self.inputs.shape[1], signals.shape[1]  # size: of samples, or of halves of substeps
        # edges of the substeps, and samples, on the time axis of the inputs
        parts = self.substeps * (2 if moving else 1)
        grid: NDArray[Any] = np.arange((n - 1) * parts + 1) * (self.dt / parts)
        samples, edges = (t - delay + drift * (self.begin + t) for t in (np.arange(n) * self.dt, grid))
        span, width = self.dt * n / size, self.dt / parts * (1.0 + drift)
        knots = np.arange(size + 1) * span
        means = np.empty((len(signals), edges.size - 1))
        # mean over a substep: difference of the integral of the held signal
        for mean, signal in zip(means, signals, strict=True):
            integral = np.interp(edges, knots, np.concatenate([[0.0], np.cumsum(signal) * span]))
            integral += np.minimum(edges, 0.0) * self.before * signal[0]
            integral += np.maximum(edges - knots[-1], 0.0) * signal[-1]
            mean[:] = np.diff(integral) / width
        levels = np.hstack([self.before * signals[:, :1], signals])  # before the record, then each sample

        def cell(when: Array) -> NDArray[np.int64]:
            return np.asarray(np.clip(np.floor(when / span + 1e-9), -1, size - 1) + 1, dtype=np.int64)

        held, at_edges = levels[:, cell(samples)], levels[0][cell(edges)]
        # the mean changes with the delay by the difference between both edges
        by_delay = -np.diff(at_edges) / width
        by_drift = np.diff(at_edges * (self.begin + grid)) / width - means[0] / (1.0 + drift)
        if moving:
            means, by_delay, by_drift = _lines(means), _lines(by_delay), _lines(by_drift)
            if size > n:  # an actuator with a rate limit does not jump
                held = np.hstack([means[:, ::parts], means[:, -1:]])
        return means, held, (by_delay, np.zeros(n)), (by_drift, np.zeros(n))


def _lines(means: Array) -> Array:
    """Return both ends of straight lines with given half-interval means.

    `means`, shape (..., 2 k), holds the means over both halves of each interval.
    """
    first, second = means[..., ::2], means[..., 1::2]
    return np.stack([1.5 * first - 0.5 * second, 1.5 * second - 0.5 * first], axis=-1).reshape(means.shape)


def straight_lines(w: Array, factor: int) -> Array:
    """Linear interpolation of each row by an integer factor."""
    points = np.arange((w.shape[1] - 1) * factor + 1) / factor
    return np.stack([np.interp(points, np.arange(w.shape[1]), row) for row in w])


def _delay(structure: Structure, theta: Array, effects: list[int]) -> tuple[float, int]:
    """Total delay of the channel in seconds, and its column in theta."""
    for index in effects:
        law = structure.effects[index].spec
        if law.delays:
            (name,) = law.coefficient_names
            return float(structure.value(theta, index, name)), structure.position(index, name)
    return 0.0, -1


def clock_drift(structure: Structure, theta: Array) -> tuple[float, list[int]]:
    """Return the relative drift of the input clock, and its columns in theta.

    It is positive where the clock of the inputs runs ahead of the clock of the record.

    Parameters
    ----------
    structure : Structure
        Model with effects.
    theta : ndarray, shape (p,)
        Coefficients.
    """
    value = sum(float(structure.value(theta, index, name)) for index, name in structure.drifts)
    return value, [structure.position(index, name) for index, name in structure.drifts]
