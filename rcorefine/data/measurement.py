"""Measured record: inputs, outputs, time, behavior between samples."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Self, Unpack

import control as ct
import numpy as np

from ..arguments import as_choice, as_labels, as_number, as_text, as_texts, as_vector
from ..exceptions import DataError, ExcitationWarning, warn
from ..results import Options, Result, picture, show
from ..systems.linear import Array
from ..words import counted
from .parts import FIELDS, UNDRIVEN, RecordParts
from .reading import RecordReaders
from .signals import HOLDS, as_signals, as_time_grid, check_finite, check_sizes, default_labels

if TYPE_CHECKING:
    from .frequency_response import FrequencyResponse

__all__ = ["HOLDS", "Measurement"]

_HELD, _TOP = 0.95, 0.998  # shares of the largest excursion: above them a system may still be held
_ARRAYS = ("inputs", "outputs", "timepts", "origin")


@dataclass(frozen=True, slots=True, eq=False, init=False, repr=False)
class Measurement(Result, RecordReaders, RecordParts):
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
    ) -> None:
        y = as_signals(outputs, "outputs")
        n_samples = y.shape[1]
        w = np.zeros((0, n_samples)) if inputs is UNDRIVEN else as_signals(inputs, "inputs")
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
        check_finite(y, y_labels, times, "output")
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
            passed,
        )  # fmt: skip
        for field, value in zip(FIELDS, values, strict=True):
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
        whole = cls(
            UNDRIVEN, outputs, dt=dt, timepts=timepts, output_labels=output_labels, output_units=output_units,
            name=name,
        )  # fmt: skip
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
        for field in FIELDS:  # neither pickle nor deepcopy keeps the read-only flag of an array
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


def released(outputs: Array) -> int:
    """Return the sample at which a free decay begins.

    It is the end of the first large excursion of any output. Excursions are measured from the median of the
    last fifth, relative to the largest one of that output.
    """
    rest = np.median(outputs[:, -max(outputs.shape[1] // 5, 1) :], axis=1, keepdims=True)
    away = np.abs(outputs - rest)
    largest = away.max(axis=1)
    if not largest.any():
        return 0
    firsts = []
    for row, top in zip(away[largest > 0], largest[largest > 0], strict=True):
        peak = int(np.argmax(row >= _HELD * top))
        below = np.flatnonzero(row[peak:] < _HELD * top)
        swing = row[peak : peak + int(below[0])] if below.size else row[peak:]
        firsts.append(peak + int(np.flatnonzero(swing >= _TOP * swing.max())[-1]))
    return min(firsts)


def _units(values: Any, what: str, count: int) -> tuple[str, ...]:
    return ("",) * count if values is None else as_texts(values, what, count)


Measurement.__getstate__ = lambda self: {f: getattr(self, f) for f in FIELDS}  # type: ignore
Measurement.__setstate__ = Measurement._restore  # type: ignore  # Python < 3.11.4 takes none from the body
