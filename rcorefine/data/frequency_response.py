"""Measured frequency response with coherence and standard deviation.

The class extends that of python-control.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from os import PathLike
from pathlib import Path
from typing import Any, Self, Unpack

import control as ct
import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..arguments import (
    as_array,
    as_choice,
    as_labels,
    as_list,
    as_number,
    as_path,
    as_text,
    as_texts,
    as_vector,
    as_whole,
    shown,
)  # fmt: skip
from ..exceptions import DataError
from ..results import Options, Result, picture, show
from ..systems.linear import Array
from ..writing import damaged
from . import HOLDS
from .formats import names_of, read_uff_responses
from .record import FrequencyRecord
from .signals import default_labels
from .tables import read_csv

_UNITS: dict[str, dict[str, float]] = {
    "frequency_unit": {"Hz": 2e0 * np.pi, "kHz": 2e3 * np.pi, "rad/s": 1.0, "rpm": np.pi / 30.0},
    "magnitude_unit": {"1": 1.0, "dB": 1.0},
    "phase_unit": {"deg": np.pi / 180.0, "°": np.pi / 180.0, "rad": 1.0},
}
_CHECKS: dict[str, Callable[[Any, str], Any]] = {
    "amplitude": lambda value, name: as_vector(value, name, above=0.0),
    "n_averages": lambda value, name: as_number(value, name, above=0.0, error=DataError),
    "dt": lambda value, name: as_number(value, name, least=0.0, what="a time in seconds", error=DataError),
    "hold": lambda value, name: as_choice(value, name, HOLDS),
    "name": lambda value, name: as_text(value, name, empty=False),
    **dict.fromkeys(("input_labels", "output_labels"), names_of),
    **dict.fromkeys(("input_units", "output_units"), as_texts),
    **{key: lambda value, name: as_choice(value, name, _UNITS[name]) for key in _UNITS},
}
_LEAST_COHERENCE = 1e-6  # below it a line says nothing, and its error is no number


def _as_points(response: Any) -> NDArray[np.complex128]:
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


def _as_deviation(values: ArrayLike, shape: tuple[int, ...]) -> Array:
    """Numbers that are not negative, one for all points or one each."""
    array = as_array(values, "std")
    if array.ndim not in (0, 3) and not (array.ndim == 1 and shape[:2] == (1, 1)):
        raise ct.ControlDimension(f"std has shape {array.shape}; the response has {shape}")
    if array.ndim and array.shape not in (shape, shape[2:]):
        raise ct.ControlDimension(f"std has shape {array.shape}; the response has {shape}")
    if array.size and array.min() < 0:
        raise DataError(f"std holds {array.min():g}; it cannot be negative")
    return np.array(np.broadcast_to(array, shape))


def _as_coherence(values: ArrayLike, n_y: int, n: int) -> Array:
    """Shares from 0 to 1, of shape (n_y, n)."""
    array = np.atleast_2d(as_array(values, "coherence"))
    if array.shape != (n_y, n):
        raise ct.ControlDimension(f"coherence has shape {array.shape}; expected {(n_y, n)}")
    if array.min() < 0 or array.max() > 1:
        raise DataError(f"coherence runs from {array.min():g} to {array.max():g}; it lies between 0 and 1")
    return array


def _order(omega: Array, n: int) -> NDArray[np.intp]:
    """Return the numbers of `n` frequencies in rising order."""
    if omega.size != n:
        raise ct.ControlDimension(f"response has {n} points and omega {omega.size}")
    order = np.argsort(omega, kind="stable")
    if (again := np.diff(omega[order]) <= 0).any():
        twice = omega[order][:-1][again][0]
        raise DataError(f"omega holds {twice:g} rad/s twice; keep one, or their mean")
    return order


def _as_amplitude(value: Any, n: int, order: NDArray[np.intp]) -> Array | None:
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


class FrequencyResponse(Result, FrequencyRecord, ct.FrequencyResponseData):  # type: ignore[misc]
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
        values, points = _as_points(response), as_vector(omega, "omega", above=0.0)
        n_y, n_w, n = values.shape
        order = _order(points, n)
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
        self.amplitude = _as_amplitude(amplitude, n, order)
        self.coherence = None if coherence is None else _as_coherence(coherence, n_y, n)[:, order]
        self.std = None if std is None else _as_deviation(std, values.shape)[:, :, order]
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

    @classmethod
    def from_csv(
        cls,
        path: str | PathLike[str],
        frequency: str,
        magnitude: str | Sequence[str] | None = None,
        phase: str | Sequence[str] | None = None,
        *,
        real: str | Sequence[str] | None = None,
        imag: str | Sequence[str] | None = None,
        coherence: str | Sequence[str] | None = None,
        std: str | Sequence[str] | None = None,
        frequency_unit: str | None = None,
        magnitude_unit: str | None = None,
        phase_unit: str | None = None,
        delimiter: str | None = None,
        decimal: str | None = None,
        header: Sequence[str] | None = None,
        **options: Any,
    ) -> Self:
        r"""Read a text file as analyzers and labs write it.

        Parameters
        ----------
        path : str or path
            Text file, as in `Measurement.from_csv`.
        frequency : str
            Column of the frequencies.
        magnitude, phase : str or sequence of str, optional
            Columns of magnitude and phase, of one output or of several (with one input).
        real, imag : str or sequence of str, optional
            Columns of real and imaginary part, in place of these.
        coherence, std : str or sequence of str, optional
            Columns of the coherence, and of the standard deviation of the magnitude (not in dB).
        frequency_unit : {"Hz", "kHz", "rad/s", "rpm"}, optional
            Default: what the header says.
        magnitude_unit : {"dB", "1"}, optional
            Default: "dB" where the header says so, else the plain ratio "1".
        phase_unit : {"deg", "rad"}, optional
            Default: what the header says.
        delimiter, decimal, header
            As in `Measurement.from_csv`.
        **options
            `amplitude`, `n_averages`, `input_labels`, `output_labels`, units, `dt`, `hold`, `name` as in
            `FrequencyResponse`.

        Returns
        -------
        FrequencyResponse
            Named after the file.

        Raises
        ------
        DataError
            No such column, a cell that is no number, a unit that stands nowhere.
        control.ControlArgument
            If neither magnitude and phase nor real and imaginary part are named, or both.

        Examples
        --------
        >>> import pathlib, tempfile
        >>> path = pathlib.Path(tempfile.mkdtemp()) / "shaker.csv"
        >>> _ = path.write_text("f [Hz];H [dB];phase [deg]\n1,0;20,0;0\n2,0;0,0;-90\n")
        >>> measured = rco.FrequencyResponse.from_csv(path, "f", "H", "phase")
        >>> print(measured.response[0, 0].round(6), (measured.omega / np.pi).round(6), measured.name)
        [10.+0.j  0.-1.j] [2. 4.] shaker
        """
        given = {"frequency_unit": frequency_unit, "magnitude_unit": magnitude_unit, "phase_unit": phase_unit}
        _check(options | given)
        named = [one is not None for one in (magnitude, phase, real, imag)]
        polar = named == [True, True, False, False]
        pair = {"magnitude": magnitude, "phase": phase} if polar else {"real": real, "imag": imag}
        if not polar and named != [False, False, True, True]:
            raise ct.ControlArgument(
                "name the columns of magnitude and phase, or those of real and imag: both of one pair"
            )
        f = as_text(frequency, "frequency", empty=False)
        columns = _columns(pair | {"coherence": coherence, "std": std})
        a, b = pair
        first = columns[a]
        path = as_path(path)
        wanted = list(dict.fromkeys([f, *(name for names in columns.values() for name in names)]))
        read, units, _ = read_csv(path, wanted, delimiter=delimiter, decimal=decimal, header=header)
        rows = {what: np.array([read[name] for name in names]) for what, names in columns.items()}
        one, two = rows[a], rows[b]
        if polar:
            in_dB = (magnitude_unit or ("dB" if "dB" in map(units.get, first) else "1")) == "dB"
            size = 10.0 ** (one / 20.0) if in_dB else one
            values = size * np.exp(1j * _factor("phase_unit", phase_unit, units, columns[b][0]) * two)
        else:
            values = one + 1j * two
        own = {
            "name": Path(path).stem,
            "coherence": rows.get("coherence"),
            "std": rows["std"][:, None] if "std" in rows else None,
            "output_labels": first if len(first) > 1 else None,
        }
        omega = read[f] * _factor("frequency_unit", frequency_unit, units, f)
        return cls(values[:, None], omega, **(own | options))

    @classmethod
    def from_uff(cls, path: str | PathLike[str], sets: Sequence[int] | None = None, **options: Any) -> Self:
        r"""Read the frequency responses of a universal file (data sets of type 58).

        Parameters
        ----------
        path : str or path
            Universal file; needs pyuff.
        sets : sequence of int, optional
            Which data sets of the file, counted from 0; default all that are frequency responses. Those
            of one reference and one response each make the matrix.
        **options
            As in `from_csv`; labels are "node:direction" of the file.

        Returns
        -------
        FrequencyResponse
            Named after the file; with the coherence where the file holds it for each output.

        Raises
        ------
        DataError
            No frequency response (the types of all sets are listed), sets that do not fill a matrix, other
            frequencies in one of them. Modes (type 55) are no response: the message says what to do.
        MissingExtraError
            If the extra "formats" is not installed.

        Examples
        --------
        >>> import importlib.util, pathlib, tempfile
        >>> path = pathlib.Path(tempfile.mkdtemp()) / "hammer.uff"
        >>> rest = f"{0:10d}{0:5d}{0:5d}{0:5d} {'NONE':20s} {'NONE':20s}"
        >>> _ = path.write_text("\n".join([
        ...     "    -1", "    58", *["NONE"] * 5,
        ...     f"{4:5d}{0:10d}{1:5d}{0:10d} {'NONE':10s}{7:10d}{3:4d} {'NONE':10s}{1:10d}{3:4d}",
        ...     f"{5:10d}{2:10d}{1:10d}{1.0:13.5e}{0.5:13.5e}{0.0:13.5e}", *[rest] * 4,
        ...     f"{1.0:13.5e}{0.0:13.5e}{2.0:13.5e}{1.0:13.5e}", "    -1", "",
        ... ]))
        >>> if importlib.util.find_spec("pyuff"):
        ...     measured = rco.FrequencyResponse.from_uff(path)
        ...     assert (measured.output_labels, measured.input_labels) == (("7:3",), ("1:3",))
        ...     assert np.allclose(measured.omega, 2 * np.pi * np.array([1.0, 1.5]))
        """
        path = as_path(path)
        _check(options)
        listed = None
        if sets is not None:
            listed = [as_whole(k, "sets", least=0) for k in as_list(sets, "sets", "numbers of data sets")]
            if not listed:
                raise ct.ControlArgument("sets names no data set; give at least one number, or leave it out")
        with damaged(path):
            found = read_uff_responses(path, listed)
        own = {"name": Path(path).stem}
        return cls(found.pop("response"), found.pop("omega"), **(own | found | options))

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
    def n_balances(self) -> int:
        """Number of frequencies that may need a harmonic balance."""
        return 0 if self.amplitude is None else self.omega.size

    @property
    def n_inputs(self) -> int:
        """Number of inputs."""
        return int(self.ninputs)

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


def _check(options: Mapping[str, Any]) -> None:
    """Check the other options before a file is opened."""
    unknown = options.keys() - _CHECKS.keys()
    if unknown:
        raise TypeError(f"unrecognized keyword(s): {', '.join(map(repr, sorted(unknown)))}")
    for name, value in options.items():
        if value is not None:
            _CHECKS[name](value, name)


def _columns(asked: Mapping[str, str | Sequence[str] | None]) -> dict[str, list[str]]:
    """Return the columns of what is asked for, one for each response."""
    found: dict[str, list[str]] = {}
    for what, names in asked.items():
        if names is not None:
            found[what] = list(as_texts(names, f"{what} (column names)"))
            if not found[what] or "" in found[what]:
                raise ct.ControlArgument(f"{what} names no column: {shown(names)}")
    count = len(next(iter(found.values())))
    for what, listed in found.items():
        if len(listed) != count:
            raise ct.ControlDimension(f"{what} names {len(listed)} column(s) for {count} response(s)")
    return found


def _factor(name: str, given: str | None, units: Mapping[str, str], column: str) -> float:
    """Return what one unit of a column is in rad/s or rad."""
    written = units.get(column)
    unit, known = str(given or written), _UNITS[name]
    if unit not in known:
        said = f"its header says {written!r}" if written else "its header says none"
        raise DataError(
            f"the unit of column {column!r} is not known ({said}); give {name}=, one of {', '.join(known)}"
        )
    return known[unit]
