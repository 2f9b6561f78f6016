"""The ways into a `Measurement` from files and objects of other packages."""

from __future__ import annotations

from collections.abc import Sequence
from os import PathLike
from pathlib import Path
from typing import Any, Self

import control as ct
import numpy as np

from ..arguments import as_choice, as_list, as_path, as_whole
from .apart import damaged
from .columns import names_of, wanted_columns
from .extra_formats import read_hdf5, read_tdms, read_uff
from .formats import FileReaders
from .resampling import Stamped, as_stamps, checked_grid, regular
from .rosbags import read_rosbag
from .signals import check_finite

__all__ = ["LabReaders"]


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
