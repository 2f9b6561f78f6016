"""Other forms of a `Measurement`: parts, other hold, filtered, joined."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any, Self

import numpy as np
from scipy.signal import butter, detrend, sosfiltfilt, zpk2sos

from ..arguments import as_choice, as_instance, as_mapping, as_number, as_share, as_vector, as_whole
from ..exceptions import DataError
from ..systems.linear import Array
from .resampling import decimated
from .signals import HOLDS

__all__ = ["FIELDS", "UNDRIVEN", "RecordParts"]

FIELDS = (
    "inputs", "outputs", "dt", "timepts", "hold", "input_labels", "output_labels",
    "input_units", "output_units", "name", "notes", "origin", "elapsed",
)  # fmt: skip


_FADED = 1e-3  # share of a transient that is as good as gone
UNDRIVEN = object()  #: In place of inputs: nothing drives the system.


class RecordParts:
    """Methods of `Measurement` that return a part or another form of it."""

    __slots__ = ()

    if TYPE_CHECKING:
        inputs: Array
        outputs: Array
        dt: float
        timepts: Array
        hold: str
        input_labels: tuple[str, ...]
        output_labels: tuple[str, ...]
        name: str
        notes: tuple[str, ...]
        origin: Array
        elapsed: float

        def __init__(self, inputs: Any, outputs: Any, **options: Any) -> None: ...

        @property
        def n_samples(self) -> int: ...  # noqa: D102

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
            new = rows.mean(axis=1) + old if level is None else as_vector(level, name, old.size)
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
        sos = zpk2sos(zeros, poles, gain)
        w, y = (sosfiltfilt(sos, rows) if rows.size else rows for rows in (self.inputs, self.outputs))
        said = f"{kind} filter of order {order}, {' to '.join(f'{e:.4g}' for e in edges)} rad/s, zero phase"
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
        n, m = self.inputs.shape[0], other.inputs.shape[0]
        origin = [self.origin[:n], other.origin[:m], self.origin[n:], other.origin[m:]]
        fields = ("input_labels", "output_labels", "input_units", "output_units", "notes")
        both = {field: (*getattr(self, field), *getattr(other, field)) for field in fields}
        signals = {
            field: np.vstack([getattr(self, field), getattr(other, field)]) for field in ("inputs", "outputs")
        }
        return self._changed(**both, **signals, origin=np.concatenate(origin))

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
        found = decimated(self.inputs, self.outputs, self.dt, self.timepts, self.hold, int(factor))
        kept = {"notes": (*self.notes, *found.notes), "elapsed": self.elapsed + found.elapsed}
        return self._changed(**found._asdict() | kept)

    def _part(self, where: slice, hold: str | None = None) -> Self:
        return self._changed(
            inputs=self.inputs[:, where],
            outputs=self.outputs[:, where],
            timepts=self.timepts[where],
            hold=hold or self.hold,
            elapsed=self.elapsed + self.dt * range(self.n_samples)[where][0],
        )

    def _changed(self, **changes: Any) -> Self:
        """The record with some of its fields otherwise."""
        values = {name: getattr(self, name) for name in FIELDS} | changes
        if np.shape(values["inputs"])[0] == 0:
            values["inputs"] = UNDRIVEN
        return type(self)(**values)
