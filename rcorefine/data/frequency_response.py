"""Measured frequency response with coherence and standard deviation.

The class extends that of python-control.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Unpack

import control as ct
import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..arguments import as_array, as_choice, as_labels, as_number, as_text, as_texts, as_vector, as_whole
from ..exceptions import DataError
from ..results import Options, picture, show
from ..systems.linear import Array
from .response_formats import ResponseReaders
from .signals import HOLDS, default_labels

__all__ = ["FrequencyResponse", "as_amplitude", "as_coherence", "as_deviation", "as_points"]


def as_points(response: Any) -> NDArray[np.complex128]:
    """Complex response of shape (n_y, n_w, n_omega)."""
    try:
        values = np.array(response, subok=False)
    except (ValueError, TypeError, RecursionError):
        values = np.zeros(0, dtype=object)
    if values.dtype.kind != "c":
        values = as_array(response, "response", finite=False)
    elif np.ma.isMaskedArray(response) and np.ma.getmaskarray(response).any():
        raise DataError("response is masked; leave those points out")
    if values.ndim == 1:
        values = values[None, None]
    if values.ndim != 3 or not values.size:
        raise ct.ControlDimension(
            f"response has shape {np.shape(response)}; give (outputs, inputs, frequencies), or (frequencies,)"
        )
    if not np.isfinite(values).all():
        i, j, k = np.argwhere(~np.isfinite(values))[0]
        raise DataError(f"response[{i}, {j}, {k}] is not finite; leave that frequency out")
    return values.astype(np.complex128)


def as_deviation(values: ArrayLike, shape: tuple[int, ...]) -> Array:
    """Numbers that are not negative, one for all points or one each."""
    array = as_array(values, "std")
    if array.ndim not in (0, 3) and not (array.ndim == 1 and shape[:2] == (1, 1)):
        raise ct.ControlDimension(f"std has shape {array.shape}; the response has {shape}")
    if array.ndim and array.shape not in (shape, shape[2:]):
        raise ct.ControlDimension(f"std has shape {array.shape}; the response has {shape}")
    if array.size and array.min() < 0:
        raise DataError(f"std holds {array.min():g}; it cannot be negative")
    return np.array(np.broadcast_to(array, shape))


def as_coherence(values: ArrayLike, n_y: int, n: int) -> Array:
    """Shares from 0 to 1, of shape (n_y, n)."""
    array = np.atleast_2d(as_array(values, "coherence"))
    if array.shape != (n_y, n):
        raise ct.ControlDimension(f"coherence has shape {array.shape}; expected {(n_y, n)}")
    if array.min() < 0 or array.max() > 1:
        raise DataError(f"coherence runs from {array.min():g} to {array.max():g}; it lies between 0 and 1")
    return array


def as_amplitude(value: Any, n: int, order: NDArray[np.intp]) -> Array | None:
    """Return the input peaks in the order of the sorted frequencies.

    None if they are not known.
    """
    if value is None:
        return None
    peaks = as_vector(value, "amplitude", above=0.0)
    if peaks.size not in (1, n):
        raise ct.ControlDimension(
            f"amplitude has {peaks.size} entries; give one, or one for each of {n} frequencies"
        )
    return np.broadcast_to(peaks, (n,))[order].copy()


_LEAST_COHERENCE = 1e-6  # below it a line says nothing, and its error is no number


class FrequencyResponse(ResponseReaders, ct.FrequencyResponseData):  # type: ignore[misc]
    """Measured frequency response, with its uncertainty.

    It passes wherever python-control takes a `FrequencyResponseData`; what is computed
    from it there is a plain one. `compare`, `refine`, `diagnose` and `improve` take it, or a list
    of them at several amplitudes, in place of a record in time.

    Parameters
    ----------
    response : array_like of shape (n_y, n_w, n_omega), or (n_omega,)
        Complex response, outputs per input.
    omega : array_like of shape (n_omega,)
        Frequencies in rad/s, positive, each once; they are sorted.
    std : array_like of the shape of `response`, or float, optional
        Standard deviation of the magnitude in its unit, which is that of the real and of the
        imaginary part. Default: from coherence and `n_averages` where both are given, else not known.
    coherence : array_like of shape (n_y, n_omega), or (n_omega,), optional
        Share of each output's power that all inputs together explain, from
        0 to 1 (with one input the ordinary coherence).
    amplitude : float or array_like of shape (n_omega,), optional
        Peak of the sine at the input, in its unit: what nonlinear effects need.
    input_labels, output_labels : str or sequence of str, optional
        Names; dots, which python-control does not allow in names, become underscores.
    input_units, output_units : str or sequence of str, optional
        Units.
    n_averages : float, optional
        Number of independent averages behind each point.
    segment_length : int
        Samples per segment where it was estimated from a record, 0 for none.
    n_omitted : int
        Frequencies left out because an input holds no power there.
    dt : float
        Sampling time of the record in s, 0 where the response is that of continuous signals.
    hold : {"zoh", "foh", "bandlimited"}, optional
        How the inputs ran between samples; default "zoh" with a sampling time, else "bandlimited".
    name : str
        Name.

    Raises
    ------
    DataError
        If a point is not finite, a frequency not positive or there twice, a coherence not between 0 and 1.
    control.ControlDimension
        If sizes do not fit.

    Notes
    -----
    The standard deviation holds the random error (noise, and whatever is not
    linear in the inputs). It does not hold the bias of too short segments: a
    resonance narrower than the resolution `resolution` is flattened. From coherence,
    ``std = |G| sqrt((1 - c) / (2 n c))`` (Bendat and Piersol, Random Data, ch. 9).

    Examples
    --------
    >>> omega = np.linspace(1.0, 10.0, 5)
    >>> measured = rco.FrequencyResponse(1 / (1j * omega + 2), omega, std=0.01, amplitude=3.0)
    >>> measured.response.shape, float(measured.std[0, 0, 0]), float(measured.amplitude[0])
    ((1, 1, 5), 0.01, 3.0)
    >>> _ = ct.bode_plot(measured)
    """

    omega: Array
    dt: float
    name: str

    def __init__(
        self,
        response: ArrayLike,
        omega: ArrayLike,
        *,
        std: ArrayLike | None = None,
        coherence: ArrayLike | None = None,
        amplitude: ArrayLike | None = None,
        input_labels: str | Sequence[str] | None = None,
        output_labels: str | Sequence[str] | None = None,
        input_units: str | Sequence[str] | None = None,
        output_units: str | Sequence[str] | None = None,
        n_averages: float | None = None,
        segment_length: int = 0,
        n_omitted: int = 0,
        dt: float = 0.0,
        hold: str | None = None,
        name: str = "measured",
    ) -> None:
        values, points = as_points(response), as_vector(omega, "omega", above=0.0)
        n_y, n_w, n = values.shape
        if points.size != n:
            raise ct.ControlDimension(f"response has {n} points and omega {points.size}")
        order = np.argsort(points, kind="stable")
        if n > 1 and not np.diff(points[order]).min() > 0:
            twice = points[order][:-1][np.diff(points[order]) <= 0][0]
            raise DataError(f"omega holds {twice:g} rad/s twice; keep one, or their mean")
        dt = as_number(dt, "dt", least=0.0, what="a time in seconds", error=DataError)
        super().__init__(
            values[:, :, order],
            points[order],
            dt=dt,
            name=_undotted(as_text(name, "name", empty=False)),
            inputs=[_undotted(x) for x in as_labels(input_labels, "input_labels", default_labels("u", n_w))],
            outputs=[
                _undotted(x) for x in as_labels(output_labels, "output_labels", default_labels("y", n_y))
            ],
        )
        self.hold = as_choice(hold, "hold", HOLDS) if hold is not None else "zoh" if dt else "bandlimited"
        self.input_units, self.output_units = (
            ("",) * count if units is None else as_texts(units, what, count)
            for units, what, count in ((input_units, "input_units", n_w), (output_units, "output_units", n_y))
        )
        self.n_averages = (
            float("nan")
            if n_averages is None
            else as_number(n_averages, "n_averages", above=0.0, error=DataError)
        )
        self.segment_length = as_whole(segment_length, "segment_length", least=0)
        self.n_omitted = as_whole(n_omitted, "n_omitted", least=0)
        self.amplitude = as_amplitude(amplitude, n, order)
        self.coherence = None if coherence is None else as_coherence(coherence, n_y, n)[:, order]
        self.std = None if std is None else as_deviation(std, values.shape)[:, :, order]
        if self.std is None and self.coherence is not None and np.isfinite(self.n_averages) and n_w == 1:
            known = np.maximum(self.coherence, _LEAST_COHERENCE)[:, None]
            self.std = self.magnitude * np.sqrt((1.0 - known) / (2.0 * self.n_averages * known))

    @classmethod
    def from_frd(
        cls, response: ct.FrequencyResponseData, *, hold: str | None = None, **options: Any
    ) -> FrequencyResponse:
        """Take a measured response of python-control.

        Parameters
        ----------
        response : FrequencyResponseData
            Measured response with positive frequencies.
        hold : {"zoh", "foh", "bandlimited"}, optional
            How the inputs ran between samples; default "zoh" where the
            response has a sampling time, else "bandlimited" (continuous).
        **options
            `std`, `coherence`, `amplitude`, `n_averages`, `input_units`, `output_units`, `name`
            as in `FrequencyResponse`.

        Returns
        -------
        FrequencyResponse
            Without `std` and `coherence` where they are not given.

        Raises
        ------
        control.ControlArgument
            If `response` is something else.
        DataError
            If a point is not finite or a frequency not positive.

        Examples
        --------
        >>> frd = ct.frd([1.0, 0.5], [1.0, 2.0], name="analyzer")
        >>> rco.FrequencyResponse.from_frd(frd, std=0.1).name
        'analyzer'
        """
        if not isinstance(response, ct.FrequencyResponseData):
            raise ct.ControlArgument(
                f"a measured response is a FrequencyResponse or control.FrequencyResponseData, "
                f"not {type(response).__name__}; from a record take data.frequency_response()"
            )
        if not (np.asarray(response.omega) > 0).all():
            raise DataError(
                f"response {response.name!r} holds frequencies that are not positive; leave them out"
            )
        sampled = response.dt not in (None, True) and response.dt > 0
        own: dict[str, Any] = {
            "dt": float(response.dt) if sampled else 0.0,
            "input_labels": list(response.input_labels),
            "output_labels": list(response.output_labels),
            "name": str(response.name),
        }
        return cls(response.frdata, response.omega, hold=hold, **(own | options))

    # python-control looks the points of a measured response up by their frequency, on the imaginary
    # axis; on the unit circle, where a sampling time would send it, it knows none of them.
    def isctime(self, strict: bool = False) -> bool:
        """Return True: each point is given by its frequency in rad/s.

        Parameters
        ----------
        strict : bool
            As of python-control's systems; makes no difference.

        Returns
        -------
        bool
        """
        return True

    def isdtime(self, strict: bool = False) -> bool:
        """Return False: no point is given by its place on the unit circle.

        Parameters
        ----------
        strict : bool
            As of python-control's systems; makes no difference.

        Returns
        -------
        bool
        """
        return False

    @property
    def response(self) -> NDArray[np.complex128]:
        """Complex response of shape (n_y, n_w, n_omega)."""
        values: NDArray[np.complex128] = self.frdata
        return values

    @property
    def input_labels(self) -> tuple[str, ...]:
        """Names of the inputs."""
        return tuple(self.input_index)

    @property
    def output_labels(self) -> tuple[str, ...]:
        """Names of the outputs."""
        return tuple(self.output_index)

    @property
    def magnitude(self) -> Array:
        """Magnitude of shape (n_y, n_w, n_omega), output unit per input unit."""
        size: Array = np.abs(self.response)
        return size

    @property
    def phase(self) -> Array:
        """Phase of shape (n_y, n_w, n_omega) in rad, within -pi and pi."""
        return np.angle(self.response)

    @property
    def phase_std(self) -> Array | None:
        """Standard deviation of the phase in rad.

        It is at most that of a uniform phase; None where it is not known.
        """
        if self.std is None:
            return None
        size = self.magnitude
        ratio = np.divide(self.std, size, out=np.full_like(self.std, np.inf), where=size > 0)
        limited: Array = np.minimum(ratio, np.pi / np.sqrt(3.0))
        return limited

    @property
    def resolution(self) -> float:
        """Distance between the frequency lines of the segments, in rad/s.

        NaN if there were no segments.
        """
        if self.segment_length == 0:
            return float("nan")
        return 2.0 * np.pi / (self.segment_length * self.dt)

    @property
    def frd(self) -> ct.FrequencyResponseData:
        """Response alone, as a plain `control.FrequencyResponseData`.

        It keeps dt, name and labels.
        """
        return ct.frd(
            self.response.copy(),
            self.omega.copy(),
            dt=self.dt,
            name=self.name,
            inputs=list(self.input_labels),
            outputs=list(self.output_labels),
        )

    def __repr__(self) -> str:
        return (
            f"<FrequencyResponse {self.name!r}: {self.ninputs} input(s), {self.noutputs} output(s), "
            f"{self.omega.size} frequencies, dt={self.dt:g}>"
        )

    @picture
    def plot(self, **options: Unpack[Options]) -> ct.ControlPlot:
        """Bode plot with the band of two standard deviations, and the coherence.

        Parameters
        ----------
        ax : array of Axes, optional
            Axes to draw in, of the shape that a call without it returns.
        label : str, optional
            Label of the curve; default the record's name.

        Returns
        -------
        ControlPlot
            Lines, axes (3 rows per output: magnitude, phase, coherence), figure.
        """
        return show(self, "plot", **options)


def _undotted(name: str) -> str:
    return name.replace(".", "_")
