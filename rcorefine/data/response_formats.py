"""Readers of a `FrequencyResponse` from text and universal files."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from os import PathLike
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple, Self

import control as ct
import numpy as np

from ..arguments import as_choice, as_list, as_number, as_path, as_text, as_texts, as_vector, as_whole, shown
from ..exceptions import DataError
from ..results import Result
from ..systems.linear import Array
from .apart import damaged
from .columns import Columns, names_of
from .extra_formats import read_uff_responses
from .signals import HOLDS
from .tables import read_csv

__all__ = ["ResponseReaders"]

_TURNS = {"Hz": 2e0 * np.pi, "kHz": 2e3 * np.pi, "rad/s": 1.0, "rpm": np.pi / 30.0}
_PHASES = {"deg": np.pi / 180.0, "°": np.pi / 180.0, "rad": 1.0}
_SIZES = ("1", "dB")
_CHECKS: dict[str, Callable[[Any, str], Any]] = {
    "amplitude": lambda value, name: as_vector(value, name, above=0.0),
    "n_averages": lambda value, name: as_number(value, name, above=0.0, error=DataError),
    "dt": lambda value, name: as_number(value, name, least=0.0, what="a time in seconds", error=DataError),
    "hold": lambda value, name: as_choice(value, name, HOLDS),
    "name": lambda value, name: as_text(value, name, empty=False),
    **dict.fromkeys(("input_labels", "output_labels"), names_of),
    **dict.fromkeys(("input_units", "output_units"), as_texts),
}


class ResponseReaders(Result):
    """Class methods of `FrequencyResponse` that read files."""

    if TYPE_CHECKING:

        def __init__(self, response: Any, omega: Any, **options: Any) -> None: ...

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
        units = _Units(frequency_unit, magnitude_unit, phase_unit).checked()
        _known(options)
        polar = real is None and imag is None
        given = (magnitude, phase) if polar else (real, imag)
        if any(c is None for c in given) or not (polar or (magnitude is None and phase is None)):
            raise ct.ControlArgument(
                "name the columns of magnitude and phase, or those of real and imag: both of one pair"
            )
        f = as_text(frequency, "frequency", empty=False)
        first, second = (
            _columns(c, w)
            for c, w in zip(given, ("magnitude", "phase") if polar else ("real", "imag"), strict=True)
        )
        certainty = {"coherence": _columns(coherence, "coherence"), "std": _columns(std, "std")}
        for what, names in {"phase" if polar else "imag": second, **certainty}.items():
            if names and len(names) != len(first):
                raise ct.ControlDimension(f"{what} names {len(names)} column(s) for {len(first)} response(s)")
        path, wanted = as_path(path), [f, *first, *second, *certainty["coherence"], *certainty["std"]]
        read = read_csv(
            path, list(dict.fromkeys(wanted)), delimiter=delimiter, decimal=decimal, header=header
        )
        if polar:
            values = units.magnitude(read, first) * np.exp(1j * units.phase(read, second))
        else:
            values = _rows(read, first) + 1j * _rows(read, second)
        own: dict[str, Any] = {"name": Path(path).stem}
        own |= {what: _rows(read, names) for what, names in certainty.items() if names}
        if "std" in own:
            own["std"] = own["std"][:, None]
        if len(first) > 1:
            own["output_labels"] = first
        return cls(values[:, None], units.omega(read, f), **(own | options))

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
        _known(options)
        listed = None
        if sets is not None:
            listed = [as_whole(k, "sets", least=0) for k in as_list(sets, "sets", "numbers of data sets")]
            if not listed:
                raise ct.ControlArgument("sets names no data set; give at least one number, or leave it out")
        with damaged(path):
            found = read_uff_responses(path, listed)
        own = {"name": Path(path).stem}
        return cls(found.pop("response"), found.pop("omega"), **(own | found | options))


def _known(options: Mapping[str, Any]) -> None:
    """Check the other options before a file is opened."""
    unknown = options.keys() - _CHECKS.keys()
    if unknown:
        raise TypeError(f"unrecognized keyword(s): {', '.join(map(repr, sorted(unknown)))}")
    for name, value in options.items():
        if value is not None:
            _CHECKS[name](value, name)


def _columns(names: str | Sequence[str] | None, what: str) -> list[str]:
    """Names of columns; none where none is asked for."""
    if names is None:
        return []
    found = list(as_texts(names, f"{what} (column names)"))
    if not found or "" in found:
        raise ct.ControlArgument(f"{what} names no column: {shown(names)}")
    return found


def _rows(read: Columns, names: Sequence[str]) -> Array:
    return np.array([read.values[name] for name in names])


class _Units(NamedTuple):
    """Units that were given; what a header says where none was."""

    frequency_unit: str | None
    magnitude_unit: str | None
    phase_unit: str | None

    def checked(self) -> Self:
        """Itself, if these are units."""
        for name, known in (("frequency_unit", _TURNS), ("magnitude_unit", _SIZES), ("phase_unit", _PHASES)):
            if getattr(self, name) is not None:
                as_choice(getattr(self, name), name, known)
        return self

    def _factor(self, name: str, known: Mapping[str, float], read: Columns, column: str) -> float:
        given, written = getattr(self, name), read.units.get(column)
        unit = str(given or written)
        if unit not in known:
            said = f"its header says {written!r}" if written else "its header says none"
            listed = ", ".join(known)
            raise DataError(
                f"the unit of column {column!r} is not known ({said}); give {name}=, one of {listed}"
            )
        return known[unit]

    def omega(self, read: Columns, column: str) -> Array:
        """Frequencies in rad/s."""
        return np.asarray(read.values[column] * self._factor("frequency_unit", _TURNS, read, column))

    def magnitude(self, read: Columns, columns: Sequence[str]) -> Array:
        """Magnitudes as ratios."""
        sizes = _rows(read, columns)
        written = "dB" if "dB" in (read.units.get(name) for name in columns) else "1"
        return 10.0 ** (sizes / 20.0) if (self.magnitude_unit or written) == "dB" else sizes

    def phase(self, read: Columns, columns: Sequence[str]) -> Array:
        """Phases in rad."""
        return _rows(read, columns) * self._factor("phase_unit", _PHASES, read, columns[0])
