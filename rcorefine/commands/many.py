"""Command `survey`: a folder of records, on processes or on a cluster."""

from __future__ import annotations

import signal
from argparse import ArgumentTypeError, Namespace
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor
from contextlib import contextmanager
from dataclasses import asdict
from multiprocessing import resource_tracker
from multiprocessing.context import SpawnContext, SpawnProcess
from pathlib import Path
from typing import Any

import rcorefine as rco

from ..exceptions import needed
from .analysis import reading, taken, wanted_candidates
from .output import check_targets, finish


def survey(
    folder: Path,
    /,
    *,
    arguments: Namespace,
    model: Path,
    task: str = "diagnose",
    compare: str = "common",
    scheduler: str | None = None,
    jobs: int | None = None,
    conditions: Path | None = None,
) -> int:
    """Examine every record of a folder, and compare the machines.

    It says which effects are common, which belong to one machine, and which grow with time. A record that
    fails does not stop the survey.

    Parameters
    ----------
    folder : Path
        Each file in it is the record of a machine of that name, each folder a machine with its records in
        order of their names.
    arguments : Namespace
        Parsed command line.
    model : Path
        Model: .toml, .npz or .mat, or a folder with one per machine.
    task : {"diagnose", "improve", "localize", "refine"}
        Task for each record; refine needs --candidates.
    compare : {"common", "own"}
        common: each effect that is found in any record is estimated in all.
    scheduler : str, optional
        Dask scheduler, such as tcp://10.0.0.1:8786.
    jobs : int, optional
        Processes on this machine.
    conditions : Path, optional
        TOML: conditions to keep; the exit code is 1 if one is not kept.

    Returns
    -------
    int
        With conditions 1 where one is not kept; without, 1 where anything was found or failed. Interrupted,
        what was done is printed, and 130 returned.
    """
    check_targets(arguments)
    if scheduler is not None and jobs is not None:
        raise ArgumentTypeError("argument --jobs: not allowed with argument --scheduler")
    options = _options(arguments, model, task)
    given = taken(rco.survey, arguments) | {"effects": compare}
    try:
        with _workers(scheduler, jobs) as executor:
            given |= {"executor": executor, "options": options, "reading": reading(arguments)}
            found, code = rco.survey(model, folder, **given), None
    except KeyboardInterrupt as stop:
        if not getattr(stop, "survey", None):
            raise
        found, code = stop.survey, 130  # type: ignore[attr-defined]
    if code is None and len(found.failed) == len(found.rows):
        first = found.failed[0]
        raise rco.DataError(
            f"no record could be examined; the first was {first.record} of {first.machine}: {first.error}"
        )
    broken = found.breaches(conditions) if conditions else ()
    if code is None:
        code = int(bool(broken) if conditions else found.finds)
    lines = [f"NOT KEPT {b.condition}: {': '.join(filter(None, (b.machine, b.sentence)))}" for b in broken]
    content = found.to_dict() | {"breaches": [asdict(b) for b in broken]}
    text = "\n".join([str(found), *lines])
    return finish(arguments, code, found.sentences(), found, text=text, content=content)


def _options(arguments: Namespace, model: Path, task: str) -> dict[str, Any]:
    """Return the options of the task, with effects of the first model."""
    words, arguments.candidates = arguments.candidates, None
    options = taken(rco.localize_damage if task == "localize" else getattr(rco, task), arguments)
    options.pop("progress", None)
    files = sorted(model.iterdir()) if model.is_dir() else [model]
    effects = wanted_candidates(rco.read_model(files[0]), words) if words else None
    return options | ({"effects": effects or []} if task == "refine" else {"candidates": effects})


@contextmanager
def _workers(scheduler: str | None, jobs: int | None) -> Iterator[Any]:
    """A client of the scheduler, a pool of processes, or None."""
    if scheduler is not None:
        Client = needed("distributed", "distributed", "--scheduler").Client
        with Client(scheduler, set_as_default=False) as client:
            yield client
    elif jobs is not None and jobs > 1:
        resource_tracker.ensure_running()  # where it is started later, signals are let through again
        with ProcessPoolExecutor(jobs, _Quiet()) as pool:
            try:
                yield pool
            except KeyboardInterrupt:
                for worker in list((pool._processes or {}).values()):  # nobody waits for what they do
                    worker.terminate()
                raise
    else:
        yield None


class _Worker(SpawnProcess):
    """Worker process that Ctrl-C does not interrupt.

    A terminal sends Ctrl-C to all its processes; the process that started the worker ends it.
    """

    def start(self) -> None:
        if not hasattr(signal, "pthread_sigmask"):
            return super().start()
        before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})  # which the new process inherits
        try:
            super().start()
        finally:
            signal.pthread_sigmask(signal.SIG_SETMASK, before)


class _Quiet(SpawnContext):
    Process = _Worker
