"""The ways into a `Measurement` from files and objects of other packages."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator, Sequence
from os import PathLike
from pathlib import Path
from typing import TYPE_CHECKING, Any, Self

import control as ct
import numpy as np

from ..arguments import as_choice, as_list, as_path, as_whole
from ..exceptions import DataError
from ..extras import needed
from ..systems.linear import Array
from .apart import damaged
from .columns import Columns, names_of, read_npz, wanted_columns
from .extra_formats import read_hdf5, read_mat, read_tdms, read_uff
from .resampling import Stamped, as_stamps, checked_grid, regular
from .signals import check_finite, is_irregular
from .units import seconds_per

__all__ = ["FileReaders", "LabReaders", "read_rosbag"]


class FileReaders:
    """Class methods of `Measurement` that read files of named vectors."""

    __slots__ = ()

    if TYPE_CHECKING:

        def __init__(self, inputs: Any, outputs: Any, **options: Any) -> None: ...

        @classmethod
        def from_timestamps(cls, timepts: Any, inputs: Any, outputs: Any, **options: Any) -> Self:
            """As `RecordReaders` has it."""

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
        """Read vectors from a MATLAB file (of version 7.3 with h5py).

        Parameters
        ----------
        path : str or path
            MATLAB file.
        inputs, outputs : str or sequence of str
            Variables of shape (N, 1) or (1, N), which become the labels; the
            field of a structure as "data.voltage".
        time, dt, **options
            As in `from_csv`.

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
        return cls._read(read_mat, path, inputs, outputs, time, dt, options)

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
        time, dt, **options
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
        return cls._read(read_npz, path, inputs, outputs, time, dt, options)

    @classmethod
    def _read(
        cls,
        reader: Callable[..., Columns],
        path: str | PathLike[str],
        inputs: str | Sequence[str],
        outputs: str | Sequence[str],
        time: str | None,
        dt: float | None,
        options: dict[str, Any],
        **how: Any,
    ) -> Self:
        """Read the record of a file, and name the record after the file.

        Arguments are checked before the file is opened.
        """
        path, names = as_path(path), wanted_columns(inputs, outputs, time, dt, options)
        columns = reader(path, names, **how)
        return cls._from_columns(columns, inputs, outputs, time, dt, {"name": Path(path).stem} | options)

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
        if times is not None and dt is not None and is_irregular(times):
            return cls.from_timestamps(times, *signals, dt=dt, **(own | options))
        return cls(*signals, dt=dt, timepts=times, **(own | options))


_PART = re.compile(r"(\w+)(?:\[([^\]]+)\])?")


def read_rosbag(
    path: Any, names: Sequence[str], by_header: bool
) -> tuple[dict[str, tuple[Array, Array]], tuple[str, ...]]:
    """Read times and values of signals of a ROS bag.

    A signal is named "/topic/field/part[2]".

    Parameters
    ----------
    path : str or path
        File or folder.
    names : sequence of str
        Signals.
    by_header : bool
        Whether messages count at the time that they bear, or at that of the recorder.

    Returns
    -------
    signals : dict of tuple
        Times in s from the beginning of the bag, and values, both of shape (N,).
    said : tuple of str
        Which topics bear no time.

    Raises
    ------
    DataError
        No such topic or field, or no bag.
    """
    needed("rosbags", "formats", "from_rosbag")
    from rosbags.highlevel import AnyReader
    from rosbags.typesys import Stores, get_typestore

    if not Path(path).is_dir():
        with open(path, "rb"):  # whether it is there is the system's message
            pass
    with damaged(path, "is no ROS bag that rosbags can read, or it is damaged"):
        with AnyReader([Path(path)], default_typestore=get_typestore(Stores.LATEST)) as bag:
            wanted = _by_topic(path, names, {c.topic: c.msgtype for c in bag.connections})
            found: dict[str, tuple[Array, Array]] = {}
            logged = []
            for topic, fields in wanted.items():
                chosen = bag.messages(connections=[c for c in bag.connections if c.topic == topic])
                messages = ((stamp, bag.deserialize(raw, c.msgtype)) for c, stamp, raw in chosen)
                times, columns, own = _signals(path, fields, messages, by_header)
                found |= {name: ((times - bag.start_time) / 1e9, column) for name, column in columns.items()}
                logged += [] if own or not by_header else [topic]
    said = f"{', '.join(logged)}: messages bear no time of their own and count when they were recorded"
    return found, (said,) if logged else ()


def _by_topic(path: Any, names: Sequence[str], topics: dict[str, str]) -> dict[str, dict[str, str]]:
    """Fields by topic and name: the longest topic that a name begins with."""
    found: dict[str, dict[str, str]] = {}
    for name in names:
        held = [t for t in topics if name.startswith((f"{t}/", f"{t}."))]
        if not held:
            listed = ", ".join(f"{t} ({kind})" for t, kind in sorted(topics.items())) or "none"
            raise DataError(
                f"{path} has no topic of {name!r}; name a signal as TOPIC/FIELD. Topics: {listed}"
            )
        topic = max(held, key=len)
        found.setdefault(topic, {})[name] = name[len(topic) + 1 :].replace("/", ".")
    return found


def _signals(
    path: Any, fields: dict[str, str], messages: Iterator[tuple[int, Any]], by_header: bool
) -> tuple[Array, dict[str, Array], bool]:
    """Read times in ns and values of one topic.

    The flag is True if all messages of the topic contain their time.
    """
    stamps: list[tuple[int, int | None]] = []
    columns: dict[str, list[float]] = {name: [] for name in fields}
    for count, (logged, message) in enumerate(messages):
        own = getattr(getattr(message, "header", None), "stamp", None)
        stamps.append((logged, None if own is None else own.sec * 10**9 + own.nanosec))
        for name, field in fields.items():
            columns[name].append(_value(path, message, name, field, count))
    borne = bool(stamps) and all(own for _, own in stamps)  # a stamp of 0 was never filled in
    # whole numbers, of which floats would lose the last digits
    times: Any = np.array([own if by_header and borne else logged for logged, own in stamps], dtype=np.int64)
    return times, {name: np.array(column) for name, column in columns.items()}, borne


def _value(path: Any, message: Any, name: str, field: str, count: int) -> float:
    """Return one value of a message.

    An entry is given by its index, or by its name in the list `name` of the same message.
    """
    value: Any = message
    where = f"{path}: message {count} of {name!r}"
    for part in field.split("."):
        match, owner = _PART.fullmatch(part), value
        known = [k for k in getattr(owner, "__dataclass_fields__", {}) if not k.startswith("_")]
        if match is None or match[1] not in known:
            raise DataError(f"{where} has no field {part!r}; there are: {', '.join(known) or 'none'}")
        value, key = getattr(owner, match[1]), match[2]
        if key is None:
            continue
        labels = [str(label) for label in getattr(owner, "name", [])]
        index = labels.index(key) if key in labels else int(key) if key.isdecimal() else -1
        if not 0 <= index < np.size(value):
            raise DataError(
                f"{where} has no entry {key!r} in {match[1]!r}; it has {np.size(value)}"
                + (f": {', '.join(labels)}" if labels else "")
            )
        value = value[index]
    if isinstance(value, bool | int | float | np.number | np.bool_):
        return float(value)
    if np.size(value) == 1 and np.asarray(value).dtype.kind in "fiub":
        return float(np.asarray(value).ravel()[0])
    raise DataError(f"{where} is {type(value).__name__}, no number; name a part of it (x, [0], ...)")


class LabReaders(FileReaders):
    """Class methods of `Measurement` for the formats of other packages.

    They need these packages, or take their objects.
    """

    __slots__ = ()

    @classmethod
    def from_hdf5(
        cls,
        path: str | PathLike[str],
        inputs: str | Sequence[str],
        outputs: str | Sequence[str],
        *,
        time: str | None = None,
        dt: float | None = None,
        **options: Any,
    ) -> Self:
        """Read vectors from an HDF5 file.

        Parameters
        ----------
        path : str or path
            HDF5 file; needs h5py.
        inputs, outputs : str or sequence of str
            Data sets of shape (N,), (N, 1) or (1, N), as "group/name".
        time, dt, **options
            As in `from_csv`.

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
        return cls._read(read_hdf5, path, inputs, outputs, time, dt, options)

    @classmethod
    def from_tdms(
        cls,
        path: str | PathLike[str],
        inputs: str | Sequence[str],
        outputs: str | Sequence[str],
        *,
        time: str | None = None,
        dt: float | None = None,
        **options: Any,
    ) -> Self:
        """Read channels of a TDMS file (LabVIEW, DIAdem).

        Parameters
        ----------
        path : str or path
            TDMS file; needs npTDMS.
        inputs, outputs : str or sequence of str
            Channels, as "group/channel" where two groups have one of the name;
            their units are taken along.
        time, dt, **options
            As in `from_csv`.

        Returns
        -------
        Measurement
            Named after the file.

        Raises
        ------
        DataError
            No such channel, or several (all are listed), or another file.
        MissingExtraError
            If the extra "formats" is not installed.

        Examples
        --------
        >>> import importlib.util, pathlib, tempfile
        >>> path = pathlib.Path(tempfile.mkdtemp()) / "run1.tdms"
        >>> if importlib.util.find_spec("nptdms"):
        ...     from nptdms import ChannelObject, TdmsWriter
        ...     columns = [ChannelObject("rig", name, np.arange(5.0)) for name in ("u", "y")]
        ...     with TdmsWriter(str(path)) as file:
        ...         file.write_segment(columns)
        ...     assert rco.Measurement.from_tdms(path, "u", "y", dt=0.1).n_samples == 5
        """
        return cls._read(read_tdms, path, inputs, outputs, time, dt, options)

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
        wanted_columns("u", "y", None, None, options)
        with damaged(path):
            values, names, units, dt = read_uff(path, [*rows[0], *rows[1]])
        n = len(rows[0])
        own = {
            "name": Path(path).stem,
            "input_labels": names[:n],
            "output_labels": names[n:],
            "input_units": units[:n],
            "output_units": units[n:],
        }
        return cls(np.array(values[:n]), np.array(values[n:]), dt=dt, **(own | options))

    @classmethod
    def from_rosbag(
        cls,
        path: str | PathLike[str],
        inputs: str | Sequence[str],
        outputs: str | Sequence[str],
        *,
        dt: float | None = None,
        stamps: str = "header",
        longest_gap: float | None = None,
        hold: str = "zoh",
        **options: Any,
    ) -> Self:
        """Read signals of a ROS bag onto one regular grid.

        The bag is one of ROS 1 or ROS 2, or a single MCAP file.

        Parameters
        ----------
        path : str or path
            File (.bag, .mcap, .db3) or the folder of a ROS 2 bag; needs rosbags.
        inputs, outputs : str or sequence of str
            Signals as "/topic/field/part", with entries of arrays by place
            ("/imu/orientation_covariance[0]") or, where a list of names stands
            beside them, by name ("/joint_states/position[elbow]").
        dt : float, optional
            Sampling time in s. Default: the usual step of the outputs, of the
            slowest where they come from several topics.
        stamps : {"header", "log"}
            When a message counts: at the time that its header bears (at that of
            the recorder where it has none), or at that of the recorder.
        longest_gap, hold, **options
            As in `from_timestamps`.

        Returns
        -------
        Measurement
            Named after the file, with times in s from the beginning of the bag.
            Its `notes` say how it was resampled, and which topics bear no time.

        Raises
        ------
        DataError
            No such topic or field (those that exist are listed), gaps, or another
            file.
        MissingExtraError
            If the extra "formats" is not installed.

        Examples
        --------
        >>> import importlib.util, pathlib, tempfile
        >>> path = pathlib.Path(tempfile.mkdtemp()) / "run1"
        >>> if importlib.util.find_spec("rosbags"):
        ...     from rosbags.rosbag2 import StoragePlugin, Writer
        ...     from rosbags.typesys import Stores, get_typestore
        ...     store, kind = get_typestore(Stores.ROS2_HUMBLE), "std_msgs/msg/Float64"
        ...     with Writer(path, version=9, storage_plugin=StoragePlugin.MCAP) as bag:
        ...         for name in ("/voltage", "/speed"):
        ...             topic = bag.add_connection(name, kind, typestore=store)
        ...             for k in range(5):
        ...                 message = store.serialize_cdr(store.types[kind](k / 5), kind)
        ...                 bag.write(topic, k * 10**8, message)
        ...     data = rco.Measurement.from_rosbag(path, "/voltage/data", "/speed/data")
        ...     assert (data.n_samples, data.dt) == (5, 0.1)
        """
        path, names = as_path(path), wanted_columns(inputs, outputs, None, None, options)
        as_choice(stamps, "stamps", ("header", "log"))
        dt, longest_gap = checked_grid(dt, hold, longest_gap)
        sides = [names_of(inputs, "inputs"), names_of(outputs, "outputs")]
        read, said = read_rosbag(path, names, stamps == "header")
        signals = {}
        for name, (times, values) in read.items():
            signals[name] = Stamped(as_stamps(times, f"the clock of {name!r}"), values[None], name)
            check_finite(values[None], [name], times, "signal")
        w, y = ([signals[name] for name in side] for side in sides)
        grid = regular(w, y, dt, hold, longest_gap)
        own = {
            "name": Path(path).stem,
            "input_labels": sides[0],
            "output_labels": sides[1],
            "notes": (*grid.notes, *said),
        }
        return cls(
            grid.inputs, grid.outputs, dt=grid.dt, timepts=grid.timepts, hold=grid.hold, **(own | options)
        )

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
        wanted_columns("u", "y", None, None, options)
        own = {"name": getattr(data, "name", None)}
        return cls(np.array(data.u).T, np.array(data.y).T, dt=data.sampling_time, **(own | options))


def _sets(values: Any, name: str) -> list[int]:
    """Numbers of data sets."""
    listed = (
        [values] if isinstance(values, int | np.integer) else as_list(values, name, "numbers of data sets")
    )
    if not listed:
        raise ct.ControlArgument(f"{name} names no data set; give at least one number")
    return [as_whole(value, name) for value in listed]
