"""The ways into a `Measurement`: CSV, MATLAB, NumPy, data frame, python-control's response."""

from __future__ import annotations

from collections.abc import Sequence
from os import PathLike
from pathlib import Path
from typing import TYPE_CHECKING, Any, Self

import control as ct
import numpy as np

from ..arguments import as_choice, as_path, as_text, as_texts, shown
from ..exceptions import DataError
from .columns import Columns, names_of, read_frame, read_mat, read_npz, wanted_columns
from .tables import read_csv
from .units import seconds_per

__all__ = ["RecordReaders"]


class RecordReaders:
    """Class methods of `Measurement` that read a record from elsewhere."""

    __slots__ = ()

    if TYPE_CHECKING:

        def __init__(self, inputs: Any, outputs: Any, **options: Any) -> None: ...

    @classmethod
    def from_csv(
        cls,
        path: str | PathLike[str],
        inputs: str | Sequence[str],
        outputs: str | Sequence[str],
        *,
        time: str | None = None,
        dt: float | None = None,
        delimiter: str | None = None,
        decimal: str | None = None,
        header: Sequence[str] | None = None,
        **options: Any,
    ) -> Self:
        r"""Read a text file as labs write it (CSV, LabVIEW .lvm, serial logs).

        Parameters
        ----------
        path : str or path
            Text file in UTF-8, or else in Latin-1 (Windows-1252); other
            columns than those named are not looked at. Lines before the
            header are skipped; ``name:value`` pairs and the clock of a serial
            monitor (``12:00:01.250 ->``) are taken off.
        inputs, outputs : str or sequence of str
            Columns by name, which become the signal labels: "F", or
            "F [N]" in full, where the header says ``F [N]``.
        time : str, optional
            Column of times, in s or in the unit that its header names (ms,
            min, ...); else give `dt`.
        dt : float, optional
            Sampling time in s.
        delimiter : str, optional
            Default: what splits the header into the names (comma, semicolon,
            tab, bar, blanks).
        decimal : {".", ","}, optional
            Decimal mark; default: what the numbers tell.
        header : sequence of str, optional
            Names of all columns, for a file without a header line.
        **options
            `hold`, `input_labels`, `output_labels`, `input_units`,
            `output_units`, `name` as in `Measurement`.

        Returns
        -------
        Measurement
            Named after the file, with the units of its header or of the line
            below; its `notes` say what was taken for what.

        Raises
        ------
        DataError
            No such column (those that exist are listed), a missing or
            unreadable cell (line and column are named), or more than one way
            to read the file: numbers such as 1,234 alone, a name that fits
            two columns, a header that two separators cut.

        Examples
        --------
        >>> import pathlib, tempfile
        >>> path = pathlib.Path(tempfile.mkdtemp()) / "motor.csv"
        >>> _ = path.write_text("time;voltage;rpm\n0;1;0\n0.1;1;5\n")
        >>> data = rco.Measurement.from_csv(path, "voltage", "rpm", time="time")
        >>> data.dt, data.output_labels, data.name
        (0.1, ('rpm',), 'motor')
        >>> _ = path.write_text("bench 3\n\nt;U;n\nms;V;rpm\n0;1,5;0\n100;1,5;5\n")
        >>> data = rco.Measurement.from_csv(path, "U", "n", time="t")
        >>> data.dt, data.output_units, data.inputs
        (0.1, ('rpm',), array([[1.5, 1.5]]))
        >>> data.notes[0]
        'motor.csv: header in line 3, units in line 4, cells separated by semicolon, decimal comma'
        """
        if delimiter is not None and len(as_text(delimiter, "delimiter")) != 1:
            raise ct.ControlArgument(f"delimiter must be one character, not {shown(delimiter)}")
        if delimiter is not None and delimiter in '"\r\n':
            raise ct.ControlArgument(f"delimiter must be one character such as ';', not {delimiter!r}")
        if decimal is not None:
            as_choice(decimal, "decimal", (".", ","))
        if header is not None:
            header = as_texts(header, "header")
        path, names = as_path(path), wanted_columns(inputs, outputs, time, dt, options)
        columns = read_csv(path, names, delimiter=delimiter, decimal=decimal, header=header)
        return cls._from_columns(columns, inputs, outputs, time, dt, {"name": Path(path).stem} | options)

    @classmethod
    def from_mat(
        cls,
        path: str | PathLike[str],
        inputs: str | Sequence[str],
        outputs: str | Sequence[str],
        *,
        time: str | None = None,
        dt: float | None = None,
        **options: Any,
    ) -> Self:
        """Read vectors from a MATLAB file (saved with -v7 or older).

        Parameters
        ----------
        path : str or path
            MATLAB file.
        inputs, outputs : str or sequence of str
            Variables of shape (N, 1) or (1, N), which become the labels; the
            field of a structure as "data.voltage".
        time : str, optional
            Variable that holds the times in s; else give `dt`.
        dt : float, optional
            Sampling time in s.
        **options
            As in `from_csv`.

        Returns
        -------
        Measurement
            Named after the file.

        Raises
        ------
        DataError
            No such variable (those that exist are listed with their shapes),
            or a file of version 7.3 (the message says what to do).

        Examples
        --------
        >>> import pathlib, tempfile, scipy.io
        >>> path = pathlib.Path(tempfile.mkdtemp()) / "run1.mat"
        >>> scipy.io.savemat(path, {"V1": np.ones((5, 1)), "V2": np.zeros((1, 5))})
        >>> rco.Measurement.from_mat(path, "V1", "V2", dt=0.1).n_samples
        5
        """
        path, names = as_path(path), wanted_columns(inputs, outputs, time, dt, options)
        columns = read_mat(path, names)
        return cls._from_columns(columns, inputs, outputs, time, dt, {"name": Path(path).stem} | options)

    @classmethod
    def from_npz(
        cls,
        path: str | PathLike[str],
        inputs: str | Sequence[str],
        outputs: str | Sequence[str],
        *,
        time: str | None = None,
        dt: float | None = None,
        **options: Any,
    ) -> Self:
        """Read vectors from a file of `numpy.savez`.

        Parameters
        ----------
        path : str or path
            File of named arrays.
        inputs, outputs : str or sequence of str
            Arrays of shape (N,), (N, 1) or (1, N), which become the labels.
        time : str, optional
            Array that holds the times in s; else give `dt`.
        dt : float, optional
            Sampling time in s.
        **options
            As in `from_csv`.

        Returns
        -------
        Measurement
            Named after the file.

        Raises
        ------
        DataError
            No such array (those that exist are listed with their shapes), or
            not a file of `numpy.savez`.

        Examples
        --------
        >>> import pathlib, tempfile
        >>> path = pathlib.Path(tempfile.mkdtemp()) / "run1.npz"
        >>> np.savez(path, force=np.ones(5), v1=np.zeros(5))
        >>> rco.Measurement.from_npz(path, "force", "v1", dt=0.1).n_samples
        5
        """
        path, names = as_path(path), wanted_columns(inputs, outputs, time, dt, options)
        columns = read_npz(path, names)
        return cls._from_columns(columns, inputs, outputs, time, dt, {"name": Path(path).stem} | options)

    @classmethod
    def from_frame(
        cls,
        frame: Any,
        inputs: str | Sequence[str],
        outputs: str | Sequence[str],
        *,
        time: str | None = None,
        dt: float | None = None,
        **options: Any,
    ) -> Self:
        """Take columns from a data frame.

        Parameters
        ----------
        frame : pandas.DataFrame
            Or anything with named columns that have `to_numpy`; a dict of
            columns needs the extra "pandas".
        inputs, outputs : str or sequence of str
            Columns by name, which become the labels.
        time : str, optional
            Column of times in s; else give `dt`.
        dt : float, optional
            Sampling time in s.
        **options
            As in `from_csv`.

        Returns
        -------
        Measurement
            The index of the frame plays no part.

        Raises
        ------
        DataError
            No such column, or a missing value (column and row are named).
        MissingExtraError
            If pandas is needed and not installed.

        Examples
        --------
        >>> import pandas as pd
        >>> frame = pd.DataFrame({"t": [0.0, 0.1, 0.2], "u": [1, 1, 0], "y": [0, 1, 2]})
        >>> rco.Measurement.from_frame(frame, "u", "y", time="t").dt
        0.1
        """
        columns = read_frame(frame, wanted_columns(inputs, outputs, time, dt, options))
        return cls._from_columns(columns, inputs, outputs, time, dt, options)

    @classmethod
    def from_response(
        cls,
        response: ct.TimeResponseData,
        *,
        dt: float | None = None,
        hold: str = "zoh",
        input_units: str | Sequence[str] | None = None,
        output_units: str | Sequence[str] | None = None,
        name: str | None = None,
    ) -> Self:
        """Take inputs, outputs, times and labels from `control.TimeResponseData`.

        Parameters
        ----------
        response : TimeResponseData
            One trace that holds its inputs.
        dt : float, optional
            Sampling time in s, where the response's times should not tell it.
        hold : {"zoh", "foh", "bandlimited"}
            `control.forced_response` of a continuous model runs on straight
            lines between the samples: "foh".
        input_units, output_units : str or sequence of str, optional
            Units.
        name : str, optional
            Default: the name of the system that the response came from.

        Returns
        -------
        Measurement
            Independent copy.

        Raises
        ------
        control.ControlArgument
            If `response` is something else.
        DataError
            If it holds no inputs, or several traces.

        Examples
        --------
        >>> response = ct.forced_response(ct.tf(1, [1, 1]), [0, 1, 2], [1, 1, 1])
        >>> rco.Measurement.from_response(response, hold="foh").n_samples
        3
        """
        if not isinstance(response, ct.TimeResponseData):
            raise ct.ControlArgument(
                f"from_response takes control.TimeResponseData, not {type(response).__name__}; "
                "for arrays call Measurement(inputs, outputs, dt=...)"
            )
        if response.u is None:
            raise DataError(
                "the response holds no inputs; build it with inputs=, or from control.forced_response"
            )
        if response.ntraces > 1:
            raise DataError(
                f"the response holds {response.ntraces} traces (one per input); take one, e.g. "
                "control.step_response(sys, input=0)"
            )
        n_samples = np.size(response.t)
        return cls(
            np.reshape(response.u, (-1, n_samples)),
            np.reshape(response.y, (-1, n_samples)),
            dt=dt,
            timepts=response.t,
            hold=hold,
            input_labels=response.input_labels,
            output_labels=response.output_labels,
            input_units=input_units,
            output_units=output_units,
            name=(response.sysname or None) if name is None else name,
        )

    @classmethod
    def _from_columns(
        cls,
        columns: Columns,
        inputs: str | Sequence[str],
        outputs: str | Sequence[str],
        time: str | None,
        dt: float | None,
        options: dict[str, Any],
    ) -> Self:
        """The record of named columns: units and notes go with them."""
        values, units, notes = columns
        w_names, y_names = names_of(inputs, "inputs"), names_of(outputs, "outputs")
        lengths = {name: len(column) for name, column in values.items()}
        if len(set(lengths.values())) > 1:
            listed = ", ".join(f"{name!r} {length}" for name, length in lengths.items())
            raise ct.ControlDimension(
                f"the signals differ in length: {listed} samples; nothing is cut for you"
            )
        times = None if time is None else values[time]
        if time is not None and time in units and (step := seconds_per(units[time], time)) != 1.0:
            times = np.asarray(times) * step
            notes = (*notes, f"times of column {time!r} were brought from {units[time]} to s")
        own = {
            "input_labels": w_names,
            "output_labels": y_names,
            "input_units": [units.get(name, "") for name in w_names],
            "output_units": [units.get(name, "") for name in y_names],
            "notes": notes,
        }
        signals = (np.array([values[name] for name in names]) for names in (w_names, y_names))
        return cls(*signals, dt=dt, timepts=times, **(own | options))
