"""Construction of a `Measurement` from files and objects.

The sources are text files, data frames, python-control's responses and stamped samples.
"""

from __future__ import annotations

from collections.abc import Sequence
from os import PathLike
from typing import Any, Self

import control as ct
import numpy as np

from ..exceptions import DataError
from .columns import read_frame, wanted_columns
from .lab_formats import LabReaders
from .resampling import Stamped, as_stamps, checked_grid, regular
from .signals import as_signals, check_finite, default_labels
from .tables import read_csv

__all__ = ["RecordReaders"]


class RecordReaders(LabReaders):
    """Class methods of `Measurement` for text, data frames and responses."""

    __slots__ = ()

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
            Text file in UTF-8, UTF-16 (with its mark), or else in Latin-1 (Windows-1252); other
            columns than those named are not looked at. Lines before the
            header are skipped; ``name:value`` pairs and the clock of a serial
            monitor (``12:00:01.250 ->``) are taken off.
        inputs, outputs : str or sequence of str
            Columns by name, which become the signal labels: "F", or
            "F [N]" in full, where the header says ``F [N]``.
        time : str, optional
            Column of times, in s or in the unit that its header names (ms,
            min, ...), or of a clock (``10:15:30.250 PM``) with or without the
            date and the time zone; else give `dt`.
        dt : float, optional
            Sampling time in s. Beside `time` it is the grid to which jittered, lost or doubled stamps are
            brought, as by `from_timestamps`; regular ones it must not contradict.
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
        >>> _ = path.write_text("t,U,n\n0,1,0\n0.11,1,5\n0.19,1,9\n0.3,1,12\n0.41,1,13\n0.5,1,14\n")
        >>> rco.Measurement.from_csv(path, "U", "n", time="t", dt=0.1).n_samples  # the clock jitters
        6
        """
        return cls._read(
            read_csv, path, inputs, outputs, time, dt, options,
            delimiter=delimiter, decimal=decimal, header=header,
        )  # fmt: skip

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
        time, dt, **options
            As in `from_csv`.

        Returns
        -------
        Measurement
            An index of durations or dates (a MATLAB timetable) gives the times, unless `time` or `dt` does.
            Any other index plays no part.

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
        index: Any = getattr(frame, "index", None)
        if time is None and dt is None and getattr(getattr(index, "dtype", None), "kind", "") in ("m", "M"):
            time = str(index.name or "time")
            frame = frame.reset_index(names=time)
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
    def from_timestamps(
        cls,
        timepts: Any,
        inputs: Any,
        outputs: Any,
        *,
        dt: float | None = None,
        output_timepts: Any = None,
        longest_gap: float | None = None,
        hold: str = "zoh",
        **options: Any,
    ) -> Self:
        """Bring samples that a clock stamped as it could to a regular grid.

        Parameters
        ----------
        timepts : array_like of shape (N,)
            Times in s (or dates), in any order, with jitter, lost and doubled
            stamps; those of inputs and outputs, or of the inputs alone.
        inputs : array_like of shape (N,) or (n_w, N)
            What drove the system.
        outputs : array_like of shape (M,) or (n_y, M)
            What was measured; M = N unless they have their own times.
        dt : float, optional
            Sampling time of the record in s. Default: the usual step of the
            outputs' stamps. A longer one goes through `decimate`, so nothing
            is aliased.
        output_timepts : array_like of shape (M,), optional
            Times of the outputs where they have their own clock, counted
            from the same zero; the stretch that both cover is kept.
        longest_gap : float, optional
            In s; longer ones between stamps are refused. Default: three
            steps. Held inputs may be stamped only when they change.
        hold : {"zoh", "foh", "bandlimited"}
            How the inputs run between their stamps.
        **options
            Labels, units, name as in `Measurement`.

        Returns
        -------
        Measurement
            Its `notes` say what was sorted, merged and interpolated, by which
            rule, and how large the error is.

        Raises
        ------
        DataError
            Gaps (all are listed), stamps that are not finite or all alike, clocks
            without a common stretch, samples that are not finite.
        control.ControlDimension
            Numbers of stamps and samples that differ.

        Notes
        -----
        Stamps that lie closer than a fifth of a step count as doubled: held
        inputs keep the last value, others their mean. Outputs are
        interpolated by a cubic spline, whose rms error is
        bounded by leaving out every other sample (half the bandwidth, so far
        more than the error itself). Held inputs become their mean over each
        step of the grid: a switch between two grid points is shared by two
        samples, so the impulse that the system got is kept, and what is left
        is of second order in the step. Inputs and outputs
        whose clocks run apart stay apart: `diagnose` may name it (`clocks_apart`).

        Examples
        --------
        >>> rng = np.random.default_rng(0)
        >>> t = np.arange(200) * 0.01 + 0.001 * rng.standard_normal(200)
        >>> data = rco.Measurement.from_timestamps(t, np.sign(np.sin(9 * t)), np.sin(5 * t), dt=0.01)
        >>> data.dt, bool(np.abs(data.outputs - np.sin(5 * data.timepts)).max() < 1e-6)
        (0.01, True)
        """
        dt, longest_gap = checked_grid(dt, hold, longest_gap)
        own = "timepts" if output_timepts is None else "output_timepts"
        t_w = as_stamps(timepts, "timepts")
        t_y = t_w if output_timepts is None else as_stamps(output_timepts, "output_timepts")
        w, y = as_signals(inputs, "inputs"), as_signals(outputs, "outputs")
        for rows, stamps, what, clock in ((w, t_w, "inputs", "timepts"), (y, t_y, "outputs", own)):
            if rows.shape[1] != stamps.size:
                raise ct.ControlDimension(
                    f"{what} have {rows.shape[1]} samples and {clock} {stamps.size} times"
                )
            check_finite(rows, default_labels(what[0], len(rows)), stamps, what[:-1])
        clocks = [Stamped(t_w, w, "inputs")], [Stamped(t_y, y, "outputs")]
        found = regular(*clocks, dt, hold, longest_gap)
        return cls(
            found.inputs, found.outputs, dt=found.dt, timepts=found.timepts, hold=found.hold,
            **(options | {"notes": (*options.get("notes", ()), *found.notes)}),
        )  # fmt: skip
