"""Command `rcorefine survey`: examine a folder of records.

The survey runs here or on a cluster. Its result is printed, reported, and held to conditions.
"""

from __future__ import annotations

import inspect
import signal
import sys
from argparse import Namespace
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor
from contextlib import contextmanager
from dataclasses import asdict
from multiprocessing import resource_tracker
from multiprocessing.context import SpawnContext, SpawnProcess
from typing import Any

from ..exceptions import DataError
from ..extras import needed
from ..fleet.pieces import model_for
from ..fleet.result import Survey
from ..fleet.survey import ASKED, survey
from .analysis import check_folders, finish, fit_options, reading, wanted_candidates


def run_survey(arguments: Namespace) -> int:
    """Examine a folder of records.

    Parameters
    ----------
    arguments : Namespace
        Parsed command line.

    Returns
    -------
    int
        With conditions 1 where one is not kept; without, 1 where anything was found or failed. Interrupted,
        what was done is printed, and 130 returned.
    """
    check_folders(arguments)
    try:
        with _workers(arguments) as executor:
            found = survey(
                arguments.model,
                arguments.folder,
                arguments.task,
                executor=executor,
                effects=arguments.compare,
                options=_options(arguments),
                reading=reading(arguments),
                significance=arguments.significance,
                progress=sys.stderr.isatty() and not arguments.json,
            )
    except KeyboardInterrupt as stop:
        if not getattr(stop, "survey", None):
            raise
        return _say(arguments, stop.survey, 130)  # type: ignore[attr-defined]
    if len(found.failed) == len(found.rows):
        first = found.failed[0]
        raise DataError(
            f"no record could be examined; the first was {first.record} of {first.machine}: {first.error}"
        )
    return _say(arguments, found, None)


def _say(arguments: Namespace, found: Survey, code: int | None) -> int:
    broken = found.breaches(arguments.conditions) if arguments.conditions else ()
    if code is None:
        code = int(bool(broken) if arguments.conditions else found.finds)
    lines = [f"NOT KEPT {b.condition}: {': '.join(filter(None, (b.machine, b.sentence)))}" for b in broken]
    content = found.to_dict() | {"breaches": [asdict(b) for b in broken]}
    text = "\n".join([str(found), *lines])
    return finish(arguments, code, found.sentences(), found, text=text, content=content)


def _options(arguments: Namespace) -> dict[str, Any]:
    """Those of the task, as far as it has them."""
    candidates = None
    if arguments.candidates:
        candidates = wanted_candidates(model_for(arguments.model), arguments.candidates)
    given = {"candidates": candidates, "effects": candidates or [], "significance": arguments.significance}
    given |= fit_options(arguments)
    return {key: given[key] for key in inspect.signature(ASKED[arguments.task]).parameters if key in given}


@contextmanager
def _workers(arguments: Namespace) -> Iterator[Any]:
    """A client of the scheduler, a pool of processes, or None."""
    if arguments.scheduler is not None:
        Client = needed("distributed", "distributed", "--scheduler").Client
        with Client(arguments.scheduler, set_as_default=False) as client:
            yield client
    elif arguments.jobs > 1:
        resource_tracker.ensure_running()  # where it is started later, signals are let through again
        with ProcessPoolExecutor(arguments.jobs, _Quiet()) as pool:
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
