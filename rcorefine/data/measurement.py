"""Measured record: inputs, outputs, time, behavior between samples."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Self, Unpack

import control as ct
import numpy as np
from scipy.signal import butter, detrend, sosfiltfilt, zpk2sos

from ..arguments import (
    as_choice,
    as_instance,
    as_labels,
    as_mapping,
    as_number,
    as_share,
    as_text,
    as_texts,
    as_vector,
    as_whole,
)  # fmt: skip
from ..exceptions import DataError, ExcitationWarning, warn
from ..results import Options, Result, counted, picture, show
from ..systems.linear import Array
from . import HOLDS
from .readers import RecordReaders
from .record import TimeRecord
from .resampling import decimated
from .signals import (
    as_signals,
    as_time_grid,
    check_finite,
    check_sizes,
    check_whole,
    default_labels,
    over_time,
)

if TYPE_CHECKING:
    from .frequency_response import FrequencyResponse


_HELD, _TOP = 0.95, 0.998  # shares of the largest excursion: above them a system may still be held
_ARRAYS = ("inputs", "outputs", "timepts", "origin")
_FIELDS = (
    "inputs", "outputs", "dt", "timepts", "hold", "input_labels", "output_labels",
    "input_units", "output_units", "name", "notes", "origin", "elapsed", "missing",
)  # fmt: skip
_FADED = 1e-3  # share of a transient that is as good as gone
_UNDRIVEN = object()  # in place of inputs: nothing drives the system


@dataclass(frozen=True, slots=True, eq=False, init=False, repr=False)
class Measurement(Result, RecordReaders, TimeRecord):
    """Measured inputs and outputs on a regular time grid.

    The record keeps read-only copies: nothing that you do to your arrays
    afterwards, and nothing that rcorefine does, changes it.

    Parameters
    ----------
    inputs : array_like of shape (N,) or (n_w, N)
        What drove the system; one row per signal, time last. `free_decay` makes a record without inputs.
    outputs : array_like of shape (N,) or (n_y, N)
        What was measured.
    dt : float, optional
        Sampling time in s. Either `dt` or `timepts` must be given.
    timepts : array_like of shape (N,), optional
        Times in s, or dates. They must lie on a regular grid; rounding up to
        2 % of a sample is accepted and the regular grid is held.
    hold : {"zoh", "foh", "bandlimited"}
        How the input runs between samples: constant (a D/A converter),
        straight lines, or band-limited (an analog input behind an
        anti-aliasing filter). It matters more than most physical effects.
    input_labels, output_labels : str or sequence of str, optional
        Signal names; default ``u[0], ...`` and ``y[0], ...`` as in
        python-control. `compare` matches named channels by name.
    input_units, output_units : str or sequence of str, optional
        Units for labels of plots and tables.
    name : str, optional
        Name of the record, default "measured".
    notes : sequence of str
        How the record came about: what a reader of files assumed, how it was
        resampled. They stand below its table.
    origin : array_like of shape (n_w + n_y,), optional
        What was taken off each input, then each output, before (`deviation`); default nothing.
    elapsed : float
        Seconds from where the recording began to the first sample; default 0, and parts keep count. Clocks
        that run apart (`clocks_apart`) agree where it began, whatever the times themselves count from.
    missing : {"raise", "hold-out"}
        With "hold-out" outputs may be NaN or masked where they were not measured, one at a time: in a gap,
        or between the samples of a slow sensor. These samples do not count anywhere, and nothing is
        interpolated. Inputs must be whole.

    Attributes
    ----------
    inputs, outputs : ndarray of shape (n_w, N) and (n_y, N)
        The signals, read-only, float64.
    dt : float
        Sampling time in s.
    timepts : ndarray of shape (N,)
        Times in s, read-only.

    Raises
    ------
    DataError
        NaN or Inf (signal and sample are named), no sample, no or
        contradictory time, irregular time (place and size are named).
    control.ControlDimension
        Unequal lengths, transposed arrays, wrong number of labels.
    control.ControlArgument
        Complex values, text, an unknown hold.

    Notes
    -----
    A constant input is legitimate (a free decay), so it is accepted here.
    Functions that judge or estimate what the input drives call
    `check_excitation`, which emits `ExcitationWarning`.

    Examples
    --------
    >>> import numpy as np
    >>> data = Measurement(np.ones(50), np.arange(50.0), dt=0.1, input_labels="force")
    >>> data.n_samples, data.inputs.shape
    (50, (1, 50))
    >>> train, test = data.split(0.7)
    >>> float(test.timepts[0])
    3.5
    """

    inputs: Array
    outputs: Array
    dt: float
    timepts: Array
    hold: str
    input_labels: tuple[str, ...]
    output_labels: tuple[str, ...]
    input_units: tuple[str, ...]
    output_units: tuple[str, ...]
    name: str
    notes: tuple[str, ...]
    origin: Array
    elapsed: float
    missing: str

    def __init__(
        self,
        inputs: Any,
        outputs: Any,
        *,
        dt: float | None = None,
        timepts: Any = None,
        hold: str = "zoh",
        input_labels: str | Sequence[str] | None = None,
        output_labels: str | Sequence[str] | None = None,
        input_units: str | Sequence[str] | None = None,
        output_units: str | Sequence[str] | None = None,
        name: str | None = None,
        notes: Sequence[str] = (),
        origin: Any = None,
        elapsed: float = 0.0,
        missing: str = "raise",
    ) -> None:
        holds_out = as_choice(missing, "missing", ("raise", "hold-out")) == "hold-out"
        if holds_out and np.ma.isMaskedArray(outputs):
            outputs = np.ma.filled(outputs.astype(float), np.nan)
        y = as_signals(outputs, "outputs")
        n_samples = y.shape[1]
        w = np.zeros((0, n_samples)) if inputs is _UNDRIVEN else as_signals(inputs, "inputs")
        if w.shape[1] != n_samples:
            raise ct.ControlDimension(
                f"inputs have {w.shape[1]} samples and outputs {n_samples}; give both over the same time "
                "(nothing is cut for you)"
            )
        as_choice(hold, "hold", HOLDS)
        if name is not None:
            as_text(name, "name", empty=False)
        w_labels = as_labels(input_labels, "input_labels", default_labels("u", w.shape[0]))
        y_labels = as_labels(output_labels, "output_labels", default_labels("y", y.shape[0]))
        step, times = as_time_grid(dt, timepts, n_samples)
        check_finite(w, w_labels, times, "input")
        check_finite(np.where(np.isnan(y), 0.0, y) if holds_out else y, y_labels, times, "output")
        check_sizes(w, w_labels, "input")
        check_sizes(y, y_labels, "output")
        count = w.shape[0] + y.shape[0]
        taken = np.zeros(count) if origin is None else as_vector(origin, "origin", count).copy()
        for array in (w, y, times, taken):
            array.setflags(write=False)
        w_units = _units(input_units, "input_units", w.shape[0])
        y_units = _units(output_units, "output_units", y.shape[0])
        said = as_texts(notes, "notes")
        passed = as_number(elapsed, "elapsed", what="a time in seconds")
        values = (
            w, y, step, times, hold, w_labels, y_labels, w_units, y_units, name or "measured", said, taken,
            passed, missing,
        )  # fmt: skip
        for field, value in zip(_FIELDS, values, strict=True):
            object.__setattr__(self, field, value)

    @classmethod
    def free_decay(
        cls,
        outputs: Any,
        *,
        dt: float | None = None,
        timepts: Any = None,
        output_labels: str | Sequence[str] | None = None,
        output_units: str | Sequence[str] | None = None,
        name: str | None = None,
        release: float | None = None,
        missing: str = "raise",
    ) -> Self:
        """Make a record of a free decay.

        The system was released, and no input acts on it. All inputs of a model are zero there. Several
        releases are several records, each with an initial state of its own.

        Parameters
        ----------
        outputs : array_like of shape (N,) or (n_y, N)
            Measured outputs from the release on.
        dt : float, optional
            Sampling time in s. Either `dt` or `timepts` must be given.
        timepts : array_like of shape (N,), optional
            Times in s, or dates.
        output_labels, output_units : str or sequence of str, optional
            Names and units of the signals.
        name : str, optional
            Name of the record, default "measured".
        release : float, optional
            Time of the release in s. What is before it is left out, and `notes` says so. By default it is
            found: the end of the first excursion that comes within 5 % of the largest.
        missing : {"raise", "hold-out"}
            As in `Measurement`.

        Returns
        -------
        Measurement
            A record without inputs, from the release on.

        Raises
        ------
        DataError, control.ControlDimension, control.ControlArgument
            As the class raises them.

        Examples
        --------
        >>> t = np.arange(500) * 0.02
        >>> swing = Measurement.free_decay(np.exp(-0.1 * t) * np.cos(5 * t), dt=0.02, output_units="rad")
        >>> swing.n_inputs
        0
        """
        options: dict[str, Any] = {"output_labels": output_labels, "output_units": output_units, "name": name}
        whole = cls(_UNDRIVEN, outputs, dt=dt, timepts=timepts, missing=missing, **options)
        if release is None:
            first = released(whole.outputs)
        else:
            release = as_number(release, "release", what="a time in seconds")
            first = int(np.searchsorted(whole.timepts, release - 1e-6 * whole.dt))
        if not 0 <= first < whole.n_samples:
            raise DataError(
                f"release = {release} s is not in the record; it runs from {whole.timepts[0]:g} to "
                f"{whole.timepts[-1]:g} s"
            )
        at, before = whole.timepts[first], counted(first, "sample")
        said = f"from the release at {at:.6g} s on; {before} before it left out"
        return whole._part(slice(first, None))._changed(notes=(said,)) if first else whole

    def _restore(self, state: dict[str, Any]) -> None:
        for field in _FIELDS:  # neither pickle nor deepcopy keeps the read-only flag of an array
            if field in _ARRAYS:
                state[field].setflags(write=False)
            object.__setattr__(self, field, state[field])

    @property
    def n_samples(self) -> int:
        """Number of samples N."""
        return int(self.timepts.size)

    @property
    def n_inputs(self) -> int:
        """Number of inputs n_w."""
        return int(self.inputs.shape[0])

    @property
    def n_outputs(self) -> int:
        """Number of outputs n_y."""
        return int(self.outputs.shape[0])

    @property
    def duration(self) -> float:
        """Length of the record in s, N dt."""
        return self.n_samples * self.dt

    def check_excitation(self, purpose: str = "the record") -> tuple[str, ...]:
        """Warn about inputs that never change, and name them.

        Parameters
        ----------
        purpose : str
            What the record is used for, opens the message.

        Returns
        -------
        tuple of str
            Labels of the constant inputs.

        Warns
        -----
        ExcitationWarning
            If an input is constant: a free decay still shows how the system
            settles, but nothing of what that input drives.
        """
        as_text(purpose, "purpose")
        still = tuple(
            label
            for label, row in zip(self.input_labels, self.inputs, strict=True)
            if np.ptp(row) == 0.0 and self.n_samples > 1
        )
        if still:
            values = ", ".join(
                f"{label!r} = {self.inputs[self.input_labels.index(label), 0]:g}" for label in still
            )
            warn(
                f"{purpose}: constant over all {self.n_samples} samples: {values}. The record shows how the "
                "system settles (a free decay), not what this input drives; vary the input to learn that",
                ExcitationWarning,
            )
        return still

    def to_response(self) -> ct.TimeResponseData:
        """The record as `control.TimeResponseData`, labels and times kept.

        Returns
        -------
        TimeResponseData
            Copies; plots with its inputs.

        Examples
        --------
        >>> data = Measurement(np.ones(4), np.arange(4.0), dt=0.5, output_labels="speed")
        >>> data.to_response().output_labels
        ['speed']
        """
        return ct.TimeResponseData(
            self.timepts.copy(),
            self.outputs.copy(),
            inputs=self.inputs.copy(),
            output_labels=list(self.output_labels),
            input_labels=list(self.input_labels),
            issiso=self.n_inputs == self.n_outputs == 1,
            sysname=self.name,
            plot_inputs=True,
        )

    def frequency_response(
        self,
        *,
        segment_length: int | None = None,
        overlap: float = 0.5,
        window: str | tuple[Any, ...] = "hann",
    ) -> FrequencyResponse:
        """Measured frequency response with coherence and standard deviation.

        Parameters
        ----------
        segment_length : int, optional
            Samples per averaged segment; default about N/8.
        overlap : float
            Share of a segment that the next one repeats, 0 <= overlap < 1.
        window : str or tuple
            Window, as for `scipy.signal.get_window`.

        Returns
        -------
        FrequencyResponse
            Holds `omega`, `response`, `coherence`, `std`, and as `frd` the
            named `control.FrequencyResponseData`.

        Raises
        ------
        DataError
            If an input is constant, inputs run together, or the record is
            too short.

        See Also
        --------
        rcorefine.data.welch.estimate_frequency_response : The formulas.
        """
        from .welch import estimate_frequency_response

        return estimate_frequency_response(
            self, segment_length=segment_length, overlap=overlap, window=window
        )

    def split(self, fraction: float) -> tuple[Self, Self]:
        """Cut in two: the first part to learn from, the rest to judge by.

        Parameters
        ----------
        fraction : float
            Share of the samples in the first part, between 0 and 1.

        Returns
        -------
        first, second : Measurement
            Both keep their true times.

        Raises
        ------
        DataError
            If a part would be without samples.

        Examples
        --------
        >>> train, test = rco.Measurement(np.zeros(10), np.arange(10.0), dt=1.0).split(0.7)
        >>> train.n_samples, float(test.timepts[0])
        (7, 7.0)
        """
        cut = round(as_share(fraction, "fraction", error=DataError) * self.n_samples)
        if not 0 < cut < self.n_samples:
            raise DataError(
                f"fraction = {fraction} of {self.n_samples} samples leaves a part empty; "
                "take one between 0 and 1"
            )
        return self._part(slice(0, cut)), self._part(slice(cut, None))

    def segment(self, start: float | None = None, stop: float | None = None) -> Self:
        """Stretch of the record from `start` up to, not including, `stop`.

        Parameters
        ----------
        start, stop : float, optional
            Seconds on the record's own time axis (`timepts`); default its
            beginning and its end. Adjoining segments do not overlap.

        Returns
        -------
        Measurement
            The samples with start <= t < stop; times are kept.

        Raises
        ------
        DataError
            If no sample lies in between.

        Examples
        --------
        >>> data = rco.Measurement(np.zeros(10), np.arange(10.0), dt=0.5)
        >>> data.segment(1.0, 2.0).timepts
        array([1. , 1.5])
        """
        slack = 1e-6 * self.dt
        inside = np.ones(self.n_samples, dtype=bool)
        for name, bound, after in (("start", start, True), ("stop", stop, False)):
            if bound is None:
                continue
            bound = as_number(bound, name, infinite=True, what="a time in seconds", error=DataError)
            inside &= (self.timepts >= bound - slack) == after
        found = np.flatnonzero(inside)
        if found.size == 0:
            raise DataError(
                f"no sample lies between start = {start} and stop = {stop} s; "
                f"the record runs from {self.timepts[0]:g} to {self.timepts[-1]:g} s"
            )
        return self._part(slice(int(found[0]), int(found[-1]) + 1))

    def with_hold(self, hold: str) -> Self:
        """Return the record with another input behavior between samples.

        Parameters
        ----------
        hold : {"zoh", "foh", "bandlimited"}
            Held, linear, or interpolated without content above half the sampling rate.

        Returns
        -------
        Measurement

        Examples
        --------
        >>> rco.Measurement(np.ones(4), np.arange(4.0), dt=0.5).with_hold("foh").hold
        'foh'
        """
        as_choice(hold, "hold", HOLDS)
        return self if hold == self.hold else self._part(slice(None), hold)

    def deviation(self, inputs: Any = None, outputs: Any = None) -> Self:
        """Return the deviations of the record from an operating point.

        Parameters
        ----------
        inputs, outputs : array_like of shape (n_w,) and (n_y,), optional
            Levels in units of the signals, as in the record that was measured; default the means.

        Returns
        -------
        Measurement
            Its `origin` says what was taken off: a model with an `operating_point` adds it again for laws
            that feel absolute values.

        Examples
        --------
        >>> data = rco.Measurement([300.0, 310.0], [24.0, 26.0], dt=0.1)
        >>> data.deviation().outputs, data.deviation(outputs=24).outputs
        (array([[-1.,  1.]]), array([[0., 2.]]))
        """
        n = self.inputs.shape[0]
        was = self.origin[:n], self.origin[n:]
        parts = []
        for level, rows, old, name in zip(
            (inputs, outputs), (self.inputs, self.outputs), was, ("inputs", "outputs"), strict=True
        ):
            new = over_time(np.mean, rows) + old if level is None else as_vector(level, name, old.size)
            parts.append((rows + (old - new)[:, None], new))
        (w, above), (y, over) = parts
        return self._changed(inputs=w, outputs=y, origin=np.concatenate([above, over]))

    def detrend(self) -> Self:
        """Return the record without its mean and linear trend.

        The straight line of least squares is subtracted from each input and output
        (`scipy.signal.detrend`). Use `deviation` for a known operating point.

        Returns
        -------
        Measurement

        Examples
        --------
        >>> data = rco.Measurement([1.0, 2.0, 3.0], [0.0, 1.0, 5.0], dt=0.1)
        >>> data.detrend().outputs.round(6)
        array([[ 0.5, -1. ,  0.5]])
        """
        check_whole(self, "detrend")
        w, y = (detrend(rows) if rows.size else rows for rows in (self.inputs, self.outputs))
        return self._changed(inputs=w, outputs=y, notes=(*self.notes, "mean and linear trend removed"))

    def filter(self, low: float | None = None, high: float | None = None, *, order: int = 4) -> Self:
        """Return the record with inputs and outputs filtered alike.

        Parameters
        ----------
        low, high : float, optional
            Edges of the passband in rad/s: a high-pass filter above `low`, a low-pass filter below `high`,
            or a band-pass filter.
        order : int
            Order of the Butterworth filter, which runs forward and backward (zero phase).

        Returns
        -------
        Measurement
            Shorter at either end by the samples that the transient of the filter spoils.

        Raises
        ------
        DataError
            If an edge is not below the Nyquist frequency pi / dt, or the record is too short.

        Notes
        -----
        The same filter on inputs and outputs leaves the parameters of a linear model unchanged. It does not
        commute with friction, stops and other nonlinear effects: look for these in the unfiltered record.

        Examples
        --------
        >>> t = np.arange(500) * 0.01
        >>> data = rco.Measurement(np.sin(2 * t), np.cos(2 * t) + np.cos(200 * t), dt=0.01)
        >>> slow = data.filter(high=20.0)
        >>> slow.n_samples, bool(np.abs(slow.outputs - np.cos(2 * slow.timepts)).max() < 0.01)
        (318, True)
        """
        edges = [as_number(w, name, above=0.0, error=DataError) for name, w in (("low", low), ("high", high))
                 if w is not None]  # fmt: skip
        order = as_whole(order, "order", least=1, most=12)
        kind = "bandpass" if len(edges) == 2 else "highpass" if high is None else "lowpass"
        if not edges or max(edges) >= np.pi / self.dt or (kind == "bandpass" and edges[0] >= edges[1]):
            raise DataError(
                f"give low or high in rad/s, or both with low < high, below the Nyquist frequency "
                f"{np.pi / self.dt:.4g} rad/s; not low = {low}, high = {high}"
            )
        edge = edges if len(edges) == 2 else edges[0]
        zeros, poles, gain = butter(order, edge, kind, fs=2 * np.pi / self.dt, output="zpk")
        cut = int(np.ceil(np.log(_FADED) / np.log(np.abs(poles).max())))
        if self.n_samples <= 3 * cut:
            raise DataError(
                f"the record has {self.n_samples} samples; the filter needs more than {3 * cut}, since it "
                f"spoils {cut} at either end"
            )
        check_whole(self, "filter")
        sos = zpk2sos(zeros, poles, gain)
        w, y = (sosfiltfilt(sos, rows) if rows.size else rows for rows in (self.inputs, self.outputs))
        said = f"{kind} filter of order {order}, {' to '.join(f'{e:.4g}' for e in edges)} rad/s, zero phase"
        said += f"; {cut} of {self.n_samples} samples left out at either end, which its transient spoils"
        return self._changed(inputs=w, outputs=y, notes=(*self.notes, said))._part(slice(cut, -cut))

    def rename(self, labels: Mapping[str, str] | None = None, *, name: str | None = None) -> Self:
        """Return the record with other names of its signals.

        Parameters
        ----------
        labels : mapping of str to str, optional
            New label of each signal that gets one, by its present label.
        name : str, optional
            New name of the record.

        Returns
        -------
        Measurement

        Raises
        ------
        DataError
            If the record has no such signal.

        Examples
        --------
        >>> rco.Measurement([0.0, 1.0], [0.0, 1.0], dt=1.0).rename({"u[0]": "voltage"}).input_labels
        ('voltage',)
        """
        new = as_mapping(labels, "labels", "texts")
        for old in set(new) - {*self.input_labels, *self.output_labels}:
            known = ", ".join((*self.input_labels, *self.output_labels))
            raise DataError(f"the record has no signal {old!r}; its signals are {known}")
        return self._changed(
            input_labels=[new.get(old, old) for old in self.input_labels],
            output_labels=[new.get(old, old) for old in self.output_labels],
            name=self.name if name is None else name,
        )

    def join(self, other: Self) -> Self:
        """Return the signals of two recordings of the same motion as one record.

        Parameters
        ----------
        other : Measurement
            Record over the same time, with signals of other labels.

        Returns
        -------
        Measurement

        Raises
        ------
        DataError
            If the times, the holds or the labels do not permit it.

        Examples
        --------
        >>> first = rco.Measurement([0.0, 1.0], [0.0, 1.0], dt=1.0)
        >>> second = rco.Measurement([2.0, 3.0], [5.0, 5.0], dt=1.0, input_labels="wind", output_labels="T")
        >>> first.join(second).input_labels, first.join(second).output_labels
        (('u[0]', 'wind'), ('y[0]', 'T'))
        """
        other = as_instance(other, type(self), "other")
        if self.n_samples != other.n_samples or not np.allclose(
            self.timepts, other.timepts, rtol=0, atol=1e-6 * self.dt
        ):
            raise DataError(
                f"{self.name!r} and {other.name!r} must have the same times to be joined; cut them with "
                "segment(), or resample with from_timestamps()"
            )
        if self.hold != other.hold:
            raise DataError(
                f"{self.name!r} has hold {self.hold!r}, {other.name!r} {other.hold!r}: use with_hold()"
            )
        n, m = self.n_inputs, other.n_inputs
        origin = [self.origin[:n], other.origin[:m], self.origin[n:], other.origin[m:]]
        fields = ("input_labels", "output_labels", "input_units", "output_units", "notes")
        both = {field: (*getattr(self, field), *getattr(other, field)) for field in fields}
        w, y = np.vstack([self.inputs, other.inputs]), np.vstack([self.outputs, other.outputs])
        missing = max(self.missing, other.missing, key=("raise", "hold-out").index)
        return self._changed(**both, missing=missing, inputs=w, outputs=y, origin=np.concatenate(origin))

    def decimate(self, factor: int) -> Self:
        """Every `factor`-th sample, behind a filter that keeps the model true.

        Parameters
        ----------
        factor : int
            How many times slower, at least 2.

        Returns
        -------
        Measurement
            With ``dt * factor`` and ``hold="bandlimited"``, shorter by 20 of
            its samples at either end; its `notes` name the filter.

        Raises
        ------
        DataError
            If the record is too short for the filter.

        Notes
        -----
        Inputs, as their hold says they ran, and outputs pass the same
        zero-phase low-pass (a sinc under Kaiser's window, 80 dB). Filtering
        commutes with every linear time-invariant system, so the model's
        side has the filter too, and nothing is to be added to it: parameters
        keep their values. A law that is not linear does not commute: jumps
        of friction, stops and kinks lose what lies above the new Nyquist
        frequency. Where such a law is asked for, keep the record fast.

        Examples
        --------
        >>> t = np.arange(1000) * 0.001
        >>> data = rco.Measurement(np.sin(20 * t), np.cos(20 * t), dt=0.001, hold="bandlimited")
        >>> slow = data.decimate(5)
        >>> slow.dt, bool(np.allclose(slow.outputs, np.cos(20 * slow.timepts), atol=1e-4))
        (0.005, True)
        """
        as_whole(factor, "factor", least=2, most=10_000)
        check_whole(self, "decimate")
        found = decimated(self.inputs, self.outputs, self.dt, self.timepts, self.hold, int(factor))
        kept = {"notes": (*self.notes, *found.notes), "elapsed": self.elapsed + found.elapsed}
        return self._changed(**found._asdict() | kept)

    @property
    def error_units(self) -> tuple[str, ...]:
        """Units of the error of each output."""
        return self.output_units

    def _part(self, where: slice, hold: str | None = None) -> Self:
        return self._changed(
            inputs=self.inputs[:, where],
            outputs=self.outputs[:, where],
            timepts=self.timepts[where],
            hold=hold or self.hold,
            elapsed=self.elapsed + self.dt * range(self.n_samples)[where][0],
        )

    def _changed(self, kind: Any = None, **changes: Any) -> Self:
        """The record with other fields, or as one of another class."""
        values = {name: getattr(self, name) for name in _FIELDS} | changes
        if np.shape(values["inputs"])[0] == 0:
            values["inputs"] = _UNDRIVEN
        return type(self)(**values) if kind is None else kind(**values)

    @picture
    def plot(self, **options: Unpack[Options]) -> ct.ControlPlot:
        """Plot outputs over inputs, one row per signal.

        Parameters
        ----------
        ax : array of Axes, optional
            Axes to draw in, shape (n_y + n_w, 1).
        label : str, optional
            Label of the curves; default the record's name.
        show_legend : bool, optional
            Force the legend on or off; default: off for one record.

        Returns
        -------
        ControlPlot
            Lines, axes, figure.
        """
        return show(self, "plot", **options)

    def __repr__(self) -> str:
        return (
            f"<Measurement {self.name!r}: {self.n_inputs} input(s), {self.n_outputs} output(s), "
            f"{self.n_samples} samples, dt={self.dt:g}, hold={self.hold!r}>"
        )


def block_of_stream(inputs: Array, outputs: Array, dt: float, hold: str) -> Measurement:
    """Return samples that were checked as they came in, however few.

    A record of fewer samples than signals would be refused as transposed.
    """
    (n_w, n_samples), n_y, made = inputs.shape, len(outputs), object.__new__(Measurement)
    labels = default_labels("u", n_w), default_labels("y", n_y)
    values = (
        inputs, outputs, dt, dt * np.arange(n_samples), hold, *labels, ("",) * n_w, ("",) * n_y, "measured",
        (), np.zeros(n_w + n_y), 0.0, "raise",
    )  # fmt: skip
    for field, value in zip(_FIELDS, values, strict=True):
        object.__setattr__(made, field, value)
    return made


def released(outputs: Array) -> int:
    """Return the sample at which a free decay begins.

    It is the end of the first large excursion of any output. Excursions are measured from the median of the
    last fifth, relative to the largest one of that output.
    """
    rest = over_time(np.median, outputs[:, -max(outputs.shape[1] // 5, 1) :])
    away = np.nan_to_num(np.abs(outputs - rest[:, None]))  # a missing sample is no excursion
    firsts = []
    for row in away[away.any(axis=1)]:
        held = row >= _HELD * row.max()
        peak = int(np.argmax(held))
        below = np.flatnonzero(~held[peak:])
        swing = row[peak : peak + int(below[0])] if below.size else row[peak:]
        firsts.append(peak + int(np.flatnonzero(swing >= _TOP * swing.max())[-1]))
    return min(firsts, default=0)


def _units(values: Any, what: str, count: int) -> tuple[str, ...]:
    return ("",) * count if values is None else as_texts(values, what, count)


Measurement.__getstate__ = lambda self: {f: getattr(self, f) for f in _FIELDS}  # type: ignore
Measurement.__setstate__ = Measurement._restore  # type: ignore  # Python < 3.11.4 takes none from the body
