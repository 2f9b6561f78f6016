"""Parts of a `Measurement`: cut in two, a stretch of time, another hold."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Self

import numpy as np

from ..arguments import as_choice, as_number, as_share, as_vector, as_whole
from ..exceptions import DataError
from ..systems.linear import Array
from .resampling import decimated
from .signals import HOLDS

__all__ = ["FIELDS", "UNDRIVEN", "RecordParts"]

FIELDS = (
    "inputs", "outputs", "dt", "timepts", "hold", "input_labels", "output_labels",
    "input_units", "output_units", "name", "notes", "origin", "elapsed",
)  # fmt: skip


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
