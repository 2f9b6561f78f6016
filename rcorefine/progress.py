"""Progress bar, and the map that runs the steps.

The number of steps becomes known on the way.
"""

from __future__ import annotations

import math
import os
import sys
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from functools import cache
from time import monotonic
from types import TracebackType
from typing import Any, TypeVar

from tqdm import tqdm

from .arguments import as_flag, as_mapper
from .jit import NUMBA

_DELAY = 1.0  # s of work before a bar appears unasked
_SLOW = (
    "rcorefine: numba is not used, so models run in plain Python: a diagnosis takes minutes, not seconds. "
    "Install the extra fast: pip install 'rcorefine[fast]'"
)

Task = TypeVar("Task")
Result = TypeVar("Result")


class Progress:
    """Runner and counter of the steps of a computation.

    The steps run on an executor if one is given.

    The number of steps is not known when a computation begins: each part announces its own,
    and rounds that are still expected count as the mean of those that were done.

    Parameters
    ----------
    show : bool or None
        Whether to draw a bar on standard error. None: in a terminal or a notebook, after a second, unless the
        environment variable RCOREFINE_PROGRESS is 0. Unless it is False, one line names the extra "fast"
        where numba is missing.
    executor : concurrent.futures.Executor or dask.distributed.Client, optional
        Where `map` runs; in this process by default.
    """

    def __init__(self, show: bool | None = False, executor: Any = None) -> None:
        self._map: Callable[..., Iterable[Any]] = as_mapper(executor)
        shown = _is_watched() if show is None else as_flag(show, "progress")
        self._delay = _DELAY if show is None else 0.0 if shown else math.inf
        self._bar = tqdm(
            total=0,
            unit="step",
            file=sys.stderr,
            disable=not shown,
            delay=self._delay,
            leave=show is not None,
        )
        self._announced = self._rounds = self._ahead = 0
        self._begun = monotonic()

    def __enter__(self) -> Progress:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if kind is None:
            self.round(0)  # what was expected and did not come is no step
        self._bar.close()

    def map(self, function: Callable[[Task], Result], tasks: Sequence[Task], what: str) -> list[Result]:
        """Results of a function, each task one step.

        Parameters
        ----------
        function : callable
            Takes one task.
        tasks : sequence
            What to do.
        what : str
            What the bar says meanwhile.

        Returns
        -------
        list
            In the order of the tasks.
        """
        return list(self._counted(self._map(function, tasks), len(tasks), what))

    def over(self, items: Sequence[Task], what: str) -> Iterable[Task]:
        """The items, each one step of a loop; what the loop leaves out is no step.

        Parameters
        ----------
        items : sequence
            What to go through.
        what : str
            What the bar says meanwhile.

        Returns
        -------
        iterable
        """
        return self._counted(items, len(items), what)

    @contextmanager
    def counted(self, count: int, what: str) -> Iterator[Callable[[int], object]]:
        """Steps that are done elsewhere, some at a time.

        Parameters
        ----------
        count : int
            How many there are.
        what : str
            What the bar says meanwhile.

        Yields
        ------
        callable
            To be told how many more are done.
        """
        self._announced += count
        self._bar.set_description(what, refresh=False)
        self._refresh()
        yield self._bar.update

    @contextmanager
    def step(self, what: str) -> Iterator[None]:
        """One step.

        Parameters
        ----------
        what : str
            What the bar says meanwhile.
        """
        for _ in self.over((None,), what):
            yield

    def round(self, ahead: int) -> None:
        """Say that a round of steps begins.

        Parameters
        ----------
        ahead : int
            Rounds that are expected after it.
        """
        self._rounds, self._ahead = self._rounds + 1, ahead
        self._refresh()

    def _counted(self, results: Iterable[Result], count: int, what: str) -> Iterator[Result]:
        left = count
        with self.counted(count, what) as done:
            try:
                for result in results:
                    yield result
                    left -= 1
                    done(1)
            finally:
                self._announced -= left
                self._refresh()

    def _refresh(self) -> None:
        self._bar.total = self._announced + round(self._ahead * self._announced / max(self._rounds, 1))
        if monotonic() - self._begun >= self._delay:
            _say_why_slow()
            self._bar.refresh()


@cache
def _say_why_slow() -> None:
    """Say once per process that numba is missing, where progress may be said."""
    if not NUMBA and sys.stderr is not None and os.environ.get("RCOREFINE_PROGRESS") != "0":
        tqdm.write(_SLOW, sys.stderr)


def _is_watched() -> bool:
    """Return whether standard error is a terminal or a notebook."""
    if os.environ.get("RCOREFINE_PROGRESS") == "0":
        return False
    stream = sys.stderr
    in_notebook = "ipykernel" in sys.modules and type(stream).__module__.startswith("ipykernel")
    return in_notebook or bool(stream is not None and stream.isatty())
