"""Construction of a `Measurement` from files and objects."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from os import PathLike
from pathlib import Path
from typing import TYPE_CHECKING, Any, Self

import control as ct
import numpy as np

from ..arguments import as_choice, as_list, as_number, as_path, as_text, as_whole
from ..exceptions import DataError
from ..writing import damaged
from . import HOLDS
from .formats import FileColumns, names_of, read_hdf5, read_mat, read_npz, read_uff
from .resampling import Stamped, as_stamps, regular
from .signals import as_signals, check_finite, default_labels, is_irregular
from .tables import read_csv, read_frame, seconds_per


class RecordReaders:
    """Class methods of `Measurement` that make records."""

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
        r"""Read a text file as labs write it (CSV, LabVIEW .lvm).

        Parameters
        ----------
        path : str or path
            Text file in UTF-8, UTF-16 (with its mark), or else in Latin-1 (Windows-1252); other
            columns than those named are not looked at. Lines before the
            header are skipped.
        inputs, outputs : str or sequence of str
            Columns by name, which become the signal labels: "F", or
            "F [N]" in full, where the header says ``F [N]``.
        time : str, optional
            Column of times, in s or in the unit that its header names (ms,
            min, ...), or of a clock (``10:15:30.250``) with or without the
            date (``2024-03-31``) and the time zone; else give `dt`.
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
            `output_units`, `name`, `missing` as in `Measurement`. With ``missing="hold-out"`` empty cells of
            outputs are samples that were not measured.

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
        kept = _may_be_blank(outputs, options)
        reader = partial(read_csv, delimiter=delimiter, decimal=decimal, header=header, blank=kept)
        return cls._read(reader, path, inputs, outputs, time=time, dt=dt, **options)

    @classmethod
    def from_mat(
        cls,
        path: str | PathLike[str],
        inputs: str | Sequence[str],
        outputs: str | Sequence[str],
        **options: Any,
    ) -> Self:
        """Read vectors from a MATLAB file (of version 7.3 with h5py).

        Parameters
        ----------
        path : str or path
            MATLAB file.
        inputs, outputs : str or sequence of str
            Variables of shape (N, 1) or (1, N), which become the labels; the
            field of a structure as "data.voltage".
        **options
            `time`, `dt`, `hold`, labels, units, `name` as in `from_csv`.

        Returns
        -------
        Measurement
            Named after the file.

        Raises
        ------
        DataError
            No such variable (those that exist are listed with their shapes),
            or a file of version 7.3 where the extra "formats" is not
            installed (the message says what to do).

        Examples
        --------
        >>> import pathlib, tempfile, scipy.io
        >>> path = pathlib.Path(tempfile.mkdtemp()) / "run1.mat"
        >>> scipy.io.savemat(path, {"V1": np.ones((5, 1)), "V2": np.zeros((1, 5))})
        >>> rco.Measurement.from_mat(path, "V1", "V2", dt=0.1).n_samples
        5
        """
        return cls._read(read_mat, path, inputs, outputs, **options)

    @classmethod
    def from_npz(
        cls,
        path: str | PathLike[str],
        inputs: str | Sequence[str],
        outputs: str | Sequence[str],
        **options: Any,
    ) -> Self:
        """Read vectors from a file of `numpy.savez`.

        Parameters
        ----------
        path : str or path
            File of named arrays.
        inputs, outputs : str or sequence of str
            Arrays of shape (N,), (N, 1) or (1, N), which become the labels.
        **options
            `time`, `dt`, `hold`, labels, units, `name` as in `from_csv`.

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
        return cls._read(read_npz, path, inputs, outputs, **options)

    @classmethod
    def from_hdf5(
        cls,
        path: str | PathLike[str],
        inputs: str | Sequence[str],
        outputs: str | Sequence[str],
        **options: Any,
    ) -> Self:
        """Read vectors from an HDF5 file.

        Parameters
        ----------
        path : str or path
            HDF5 file; needs h5py.
        inputs, outputs : str or sequence of str
            Data sets of shape (N,), (N, 1) or (1, N), as "group/name".
        **options
            `time`, `dt`, `hold`, labels, units, `name` as in `from_csv`.

        Returns
        -------
        Measurement
            Named after the file.

        Raises
        ------
        DataError
            No such data set (those that exist are listed), or another file.
        MissingExtraError
            If the extra "formats" is not installed.

        Examples
        --------
        >>> import importlib.util, pathlib, tempfile
        >>> path = pathlib.Path(tempfile.mkdtemp()) / "run1.h5"
        >>> if importlib.util.find_spec("h5py"):
        ...     import h5py
        ...     with h5py.File(path, "w") as file:
        ...         file["rig/u"], file["rig/y"] = np.ones(5), np.zeros(5)
        ...     data = rco.Measurement.from_hdf5(path, "rig/u", "rig/y", dt=0.1)
        ...     assert data.n_samples == 5
        """
        return cls._read(read_hdf5, path, inputs, outputs, **options)

    @classmethod
    def from_frame(
        cls, frame: Any, inputs: str | Sequence[str], outputs: str | Sequence[str], **options: Any
    ) -> Self:
        """Take columns from a data frame.

        Parameters
        ----------
        frame : pandas.DataFrame
            Or anything with named columns that have `to_numpy`; a dict of
            columns needs the extra "pandas".
        inputs, outputs : str or sequence of str
            Columns by name, which become the labels.
        **options
            `time`, `dt`, `hold`, labels, units, `name` as in `from_csv`.

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
        dated = getattr(getattr(index, "dtype", None), "kind", "") in ("m", "M")
        if dated and options.get("time") is None and options.get("dt") is None:
            options["time"] = str(index.name or "time")
            frame = frame.reset_index(names=options["time"])
        reader = partial(read_frame, blank=_may_be_blank(outputs, options))
        return cls._read(reader, frame, inputs, outputs, named=False, **options)

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
        w, y = (np.reshape(rows, (-1, np.size(response.t))) for rows in (response.u, response.y))
        return cls(
            w,
            y,
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
        as_choice(hold, "hold", HOLDS)
        dt, longest_gap = (
            value
            if value is None
            else as_number(value, name, above=0.0, what="a time in seconds", error=DataError)
            for name, value in (("dt", dt), ("longest_gap", longest_gap))
        )
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
        found = regular(Stamped(t_w, w, "inputs"), Stamped(t_y, y, "outputs"), dt, hold, longest_gap)
        notes = (*options.get("notes", ()), *found.notes)
        return cls(**(found._asdict() | options | {"notes": notes}))

    @classmethod
    def from_uff(
        cls,
        path: str | PathLike[str],
        input_set: int | Sequence[int],
        output_set: int | Sequence[int],
        **options: Any,
    ) -> Self:
        r"""Read time histories of a universal file (data sets of type 58).

        Parameters
        ----------
        path : str or path
            Universal file; needs pyuff.
        input_set, output_set : int or sequence of int
            Which data sets of the file, counted from 0.
        **options
            As in `from_csv`; labels are "node:direction" of the file, units
            those of its ordinates.

        Returns
        -------
        Measurement
            Named after the file, with its sampling time.

        Raises
        ------
        DataError
            A data set that is none of type 58 with a time history (the types of all
            are listed), different sampling times, or another file.
        MissingExtraError
            If the extra "formats" is not installed.

        Examples
        --------
        >>> import importlib.util, pathlib, tempfile
        >>> path = pathlib.Path(tempfile.mkdtemp()) / "run1.uff"
        >>> rest = f"{0:10d}{0:5d}{0:5d}{0:5d} {'NONE':20s} {'NONE':20s}"
        >>> record = [
        ...     "    -1", "    58", *["NONE"] * 5,
        ...     f"{1:5d}{0:10d}{1:5d}{0:10d} {'NONE':10s}{7:10d}{3:4d} {'NONE':10s}{1:10d}{3:4d}",
        ...     f"{2:10d}{2:10d}{1:10d}{0.0:13.5e}{0.1:13.5e}{0.0:13.5e}", *[rest] * 4,
        ...     f"{1.0:13.5e}{2.0:13.5e}", "    -1", "",
        ... ]
        >>> _ = path.write_text("\n".join(2 * record))
        >>> if importlib.util.find_spec("pyuff"):
        ...     assert rco.Measurement.from_uff(path, 0, 1).dt == 0.1
        """
        path = as_path(path)
        rows = [_sets(input_set, "input_set"), _sets(output_set, "output_set")]
        n = len(rows[0])
        cls._check(n, len(rows[1]), None, options)
        with damaged(path):
            values, names, units, dt = read_uff(path, [*rows[0], *rows[1]])
        own = {
            "name": Path(path).stem,
            "input_labels": names[:n],
            "output_labels": names[n:],
            "input_units": units[:n],
            "output_units": units[n:],
        }
        return cls(np.array(values[:n]), np.array(values[n:]), dt=dt, **(own | options))

    @classmethod
    def from_benchmark(cls, data: Any, **options: Any) -> Self:
        """Take a record of the package nonlinear_benchmarks.

        Parameters
        ----------
        data : Input_output_data
            Or anything with `u`, `y` of shape (N,) or (N, n) and `sampling_time`.
        **options
            As in `from_csv`.

        Returns
        -------
        Measurement
            Signals turned to (signal, time).

        Raises
        ------
        control.ControlArgument
            If it has none of these.
        DataError
            If it has no sampling time.

        Examples
        --------
        >>> from types import SimpleNamespace
        >>> silverbox = SimpleNamespace(u=np.ones(5), y=np.zeros((5, 2)), sampling_time=0.1)
        >>> rco.Measurement.from_benchmark(silverbox).outputs.shape
        (2, 5)
        """
        missing = [name for name in ("u", "y", "sampling_time") if not hasattr(data, name)]
        if missing:
            raise ct.ControlArgument(
                f"data is a {type(data).__name__} without {', '.join(missing)}; give a record of "
                "nonlinear_benchmarks, or arrays to Measurement"
            )
        own = {"name": getattr(data, "name", None), "dt": data.sampling_time}
        return cls(np.array(data.u).T, np.array(data.y).T, **(own | options))

    @classmethod
    def _check(cls, n_w: int, n_y: int, dt: float | None, options: dict[str, Any]) -> None:
        """Check all other arguments on a blank record, before a file is opened."""
        blank = np.zeros((max(n_w, n_y), n_w + n_y))
        cls(blank[:n_w], blank[:n_y], dt=1.0 if dt is None else dt, **options)

    @classmethod
    def _read(
        cls,
        reader: Callable[..., FileColumns],
        source: Any,
        inputs: str | Sequence[str],
        outputs: str | Sequence[str],
        *,
        time: str | None = None,
        dt: float | None = None,
        named: bool = True,
        **options: Any,
    ) -> Self:
        """Make the record of named columns, with their units and notes.

        Arguments are checked before a file is opened. The record of a file has its name (`named`).
        """
        w_names, y_names = names_of(inputs, "inputs"), names_of(outputs, "outputs")
        times = None if time is None else as_text(time, "time")
        cls._check(len(w_names), len(y_names), dt, options)
        if named:
            source = as_path(source)
            options = {"name": Path(source).stem} | options
        wanted = list(dict.fromkeys((*w_names, *y_names, *(() if times is None else (times,)))))
        values, units, notes = reader(source, wanted)
        lengths = {name: len(column) for name, column in values.items()}
        if len(set(lengths.values())) > 1:
            listed = ", ".join(f"{name!r} {length}" for name, length in lengths.items())
            raise ct.ControlDimension(
                f"the signals differ in length: {listed} samples; nothing is cut for you"
            )
        stamps, said = (None, ()) if times is None else _in_seconds(values[times], times, units.get(times))
        own = {
            "input_labels": w_names,
            "output_labels": y_names,
            "input_units": [units.get(name, "") for name in w_names],
            "output_units": [units.get(name, "") for name in y_names],
            "notes": (*notes, *said),
        }
        w, y = (np.array([values[name] for name in names]) for names in (w_names, y_names))
        if stamps is not None and dt is not None and is_irregular(stamps):
            return cls.from_timestamps(stamps, w, y, dt=dt, **(own | options))
        return cls(w, y, dt=dt, timepts=stamps, **(own | options))


def _may_be_blank(outputs: Any, options: Mapping[str, Any]) -> Sequence[str]:
    """Return the columns in which values may be missing."""
    missing = as_choice(options.get("missing", "raise"), "missing", ("raise", "hold-out"))
    return names_of(outputs, "outputs") if missing == "hold-out" else ()


def _in_seconds(stamps: Any, column: str, unit: str | None) -> tuple[Any, tuple[str, ...]]:
    """Return times in seconds, and what was taken for what."""
    step, times, what = seconds_per(unit or "s", column), np.asarray(stamps), f"times of column {column!r}"
    if step != 1.0:
        return times * step, (f"{what} were brought from {unit} to s",)
    whole = times.dtype.kind in "iuf" and times.size > 1 and np.all(times == np.round(times))
    if unit is None and whole:
        said = "hold whole numbers without a unit, taken as seconds; if they count ms or ns, scale them"
        return stamps, (f"{what} {said}",)
    return stamps, ()


def _sets(values: Any, name: str) -> list[int]:
    """Numbers of data sets."""
    listed = (
        [values] if isinstance(values, int | np.integer) else as_list(values, name, "numbers of data sets")
    )
    if not listed:
        raise ct.ControlArgument(f"{name} names no data set; give at least one number")
    return [as_whole(value, name) for value in listed]
