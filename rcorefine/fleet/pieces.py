"""Records and models of each machine, and their evaluation by workers.

A worker turns one record into one row.
"""

from __future__ import annotations

import re
import time
import warnings
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from os import PathLike
from pathlib import Path
from typing import Any

import control as ct

from rcorefine import Effect, Measurement, Refinement, physical, read_model, read_record

from ..arguments import as_path, shown
from ..exceptions import DataError, ModelError
from .comparison import SurveyRow
from .tasks import TASKS, estimate_again

#: Files of a folder that are taken for models, and for records.
_MODELS = (".toml", ".npz", ".mat")
_RECORDS = (".csv", ".tsv", ".txt", ".lvm", ".log", ".mat", ".npz", ".h5", ".hdf5")
_PREFIX = "rcorefine."


@dataclass(frozen=True, slots=True)
class Piece:
    """One record with all that a worker needs.

    Attributes
    ----------
    machine, number
        As in `SurveyRow`.
    model : PhysicalModel, Refinement or Path
        Model, or the file that it is in.
    record : Measurement or Path
        Record, or the file that it is in.
    task : str
        What is asked.
    options, reading : dict
        Of the task, and of the reader of files.
    levels : dict
        Levels that the session has changed in ``control.config.defaults``.
    """

    machine: str
    number: int
    model: Any
    record: Any
    task: str
    options: dict[str, Any]
    reading: dict[str, Any]
    levels: dict[str, Any] = field(default_factory=dict)

    @property
    def name(self) -> str:
        """Name of the record."""
        return self.record.name if isinstance(self.record, Measurement) else self.record.stem

    def failed(self, why: str) -> SurveyRow:
        """The row where there is no answer."""
        return SurveyRow(self.machine, self.name, self.number, error=" ".join(why.split()))

    def read(self) -> tuple[Any, Measurement]:
        """Model and record, out of their files where they are not here yet."""
        model = self.model
        if isinstance(model, Path):
            model = physical(read_model(model))
        record = self.record
        if not isinstance(record, Measurement):
            record = read_record(record, model, **self.reading)
        return model, record


def examine(pieces: tuple[Piece, ...]) -> list[SurveyRow]:
    """Rows of some records: what a worker does. One that fails stops nothing."""
    return [_row(piece, TASKS[piece.task], piece.options) for piece in pieces]


def again(pieces: tuple[tuple[Piece, SurveyRow, tuple[Effect, ...]], ...]) -> list[SurveyRow]:
    """Return the rows with the coefficients of all effects of the fleet.

    They replace the coefficients of the effects that were named.
    """
    rows = []
    for piece, row, effects in pieces:
        done = _row(piece, estimate_again, effects, piece.options, row.verdict == "parameters")
        said = row.sentences if done.error is None else (*row.sentences, f"Not compared: {done.error}")
        seconds = row.seconds + done.seconds
        rows.append(replace(row, estimates=done.estimates, sentences=said, seconds=seconds))
    return rows


def _row(piece: Piece, answer: Callable[..., dict[str, Any]], *given: Any) -> SurveyRow:
    """Return the row with what a function answers about the record."""
    begin = time.perf_counter()
    try:
        with warnings.catch_warnings(), _with_levels(piece.levels):
            warnings.simplefilter("ignore")  # what they say is in the result
            model, data = piece.read()
            about = piece.machine, piece.name, piece.number, float(data.timepts[0])
            row = SurveyRow(*about, **answer(model, data, *given))
    except Exception as error:
        row = piece.failed(f"{type(error).__name__}: {error}")
    return replace(row, seconds=time.perf_counter() - begin)


@contextmanager
def _with_levels(levels: Mapping[str, Any]) -> Iterator[None]:
    """The levels of decisions as they were where the survey was asked for."""
    known = ct.config.defaults
    before = {key: known.get(key) for key, value in levels.items() if known.get(key) != value}
    known.update({key: levels[key] for key in before})
    try:
        yield
    finally:
        for key, value in before.items():
            if value is None:
                known.pop(key, None)
            else:
                known[key] = value


def pieces_of(
    models: Any, records: Any, task: str, options: Mapping[str, Any], reading: Mapping[str, Any]
) -> list[Piece]:
    """One piece per record, machine after machine, in order of time.

    Raises
    ------
    ModelError
        If a machine has no model, or one that is none.
    DataError
        If there is no record.
    """
    machines = _machines(records)
    known = _models(models, list(machines))
    levels = {key: value for key, value in ct.config.defaults.items() if key.startswith(_PREFIX)}
    return [
        Piece(machine, number, known[machine], record, task, dict(options), dict(reading), levels)
        for machine, found in machines.items()
        for number, record in enumerate(found)
    ]


def _machines(records: Any) -> dict[str, list[Any]]:
    """Records or paths of each machine."""
    if isinstance(records, str | PathLike):
        found: dict[str, list[Any]] = _in_folder(as_path(records, "records"), _RECORDS)
    elif isinstance(records, Mapping):
        found = {
            _name(machine, "records"): list(_listed(machine, value)) for machine, value in records.items()
        }
    else:
        raise ct.ControlArgument(
            "records must be a mapping from each machine to its record or list of records, or the path of a "
            f"folder, not {shown(records)}"
        )
    if not any(found.values()):
        raise DataError(f"records hold no record: {shown(records)}")
    return found


def _listed(machine: str, value: Any) -> Iterator[Any]:
    """Records of one machine; paths are not opened here."""
    one = isinstance(value, Measurement | str | PathLike)
    if not one and not isinstance(value, list | tuple):
        raise ct.ControlArgument(f"records[{machine!r}] must be a Measurement, a path, or a list of them")
    for item in [value] if one else value:
        if isinstance(item, str | PathLike):
            yield as_path(item, f"records[{machine!r}]")
        elif isinstance(item, Measurement):
            yield item
        else:
            raise ct.ControlArgument(
                f"records[{machine!r}] holds {shown(item)}; it must hold Measurements or paths"
            )


def _in_folder(folder: Path, suffixes: tuple[str, ...]) -> dict[str, list[Any]]:
    """Return the machines in a folder, with their files.

    Each file is a machine. Each folder in it is a machine whose files are its records, in order of their
    names.
    """
    if not folder.is_dir():
        raise DataError(
            f"{folder} is no folder; give one that holds records, or a mapping from machines to them"
        )
    found: dict[str, list[Any]] = {}
    for entry in sorted(folder.iterdir(), key=_natural):
        if entry.is_dir():
            inside = sorted(entry.iterdir(), key=_natural)
            mine = [path for path in inside if path.suffix.lower() in suffixes]
            if mine:
                found.setdefault(entry.name, []).extend(mine)
        elif entry.suffix.lower() in suffixes:
            found.setdefault(entry.stem, []).append(entry)
    return found


def _natural(path: Path) -> list[tuple[bool, int, str]]:
    """Order of names in which run2 comes before run10."""
    parts = re.findall(r"\d+|\D+", path.name)
    return [(part.isdigit(), int(part) if part.isdecimal() else 0, part) for part in parts]


def _models(models: Any, machines: list[str]) -> dict[str, Any]:
    """Model of each machine, such that it can be sent."""
    if isinstance(models, str | PathLike):
        path = as_path(models, "models")
        models = (
            {name: files[0] for name, files in _in_folder(path, _MODELS).items()} if path.is_dir() else path
        )
    if not isinstance(models, Mapping):
        one = _model(models, "models")
        return dict.fromkeys(machines, one)
    known = {_name(machine, "models"): model for machine, model in models.items()}
    missing = [machine for machine in machines if machine not in known]
    if missing:
        raise ModelError(
            f"no model of {', '.join(map(repr, missing[:5]))}; models holds {', '.join(known) or 'none'}"
        )
    return {machine: _model(known[machine], f"models[{machine!r}]") for machine in machines}


def _model(model: Any, name: str) -> Any:
    """Return a model in a form that can be pickled.

    This is a path, a refinement, or a physical model; a `StateSpace` itself cannot be pickled.
    """
    if isinstance(model, str | PathLike):
        return as_path(model, name)
    if isinstance(model, Refinement):
        return model
    try:
        return physical(model)
    except (ct.ControlArgument, ModelError) as error:
        raise type(error)(f"{name}: {error}") from error


def _name(machine: Any, of: str) -> str:
    if not isinstance(machine, str) or not machine.strip():
        raise ct.ControlArgument(f"{of} must have names of machines as keys, not {shown(machine)}")
    return machine
