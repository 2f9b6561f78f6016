"""`rcorefine survey`: a folder of records, here or on a cluster, printed, reported, held to conditions."""

from __future__ import annotations

import inspect
import multiprocessing
import sys
from argparse import Namespace
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor
from contextlib import contextmanager
from dataclasses import asdict
from typing import Any

from ..exceptions import DataError, MissingExtraError
from ..fleet.pieces import model_for
from ..fleet.result import Survey
from ..fleet.survey import ASKED, survey
from .analysis import finish, fit_options, wanted_candidates
from .records import reading

__all__ = ["run_survey"]


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
    with _workers(arguments) as executor:
        try:
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
        try:
            from distributed import Client
        except ImportError as error:
            raise MissingExtraError(
                '--scheduler needs dask; install the extra: pip install "rcorefine[distributed]"'
            ) from error
        with Client(arguments.scheduler, set_as_default=False) as client:
            yield client
    elif arguments.jobs > 1:
        with ProcessPoolExecutor(arguments.jobs, multiprocessing.get_context("spawn")) as pool:
            yield pool
    else:
        yield None
