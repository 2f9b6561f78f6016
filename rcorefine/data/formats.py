"""Construction of a `Measurement` from files of named vectors.

The named columns become the channels of the record.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from os import PathLike
from pathlib import Path
from typing import TYPE_CHECKING, Any, Self

import control as ct
import numpy as np

from ..arguments import as_path
from .columns import Columns, names_of, read_npz, wanted_columns
from .extra_formats import read_mat
from .signals import is_irregular
from .units import seconds_per

__all__ = ["FileReaders"]


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
