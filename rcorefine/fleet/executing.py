"""Execution of tasks in this process or on an executor.

Tasks that fail are reported; the others are done all the same.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Sequence
from concurrent.futures import (
    FIRST_COMPLETED,
    BrokenExecutor,
    CancelledError,
    Future,
    ProcessPoolExecutor,
    wait,
)
from contextlib import ExitStack
from typing import Any, TypeVar

import control as ct

from ..arguments import shown

Task = TypeVar("Task")
Result = TypeVar("Result")

_AHEAD = 2  # tasks that wait at each worker, so that none is idle
_MANY = 1024  # the same where nobody says how many workers there are, as on a cluster that grows
_AT_ONCE = 1000  # tasks up to which each is sent alone; beyond, so many parcels
_LARGEST = 20  # tasks in a parcel


def as_submitter(executor: Any) -> Any:
    """Return an executor with `submit`, also for a dask client.

    Its futures are those of `concurrent.futures`.

    Raises
    ------
    control.ControlArgument
        If it is neither, nor None.
    """
    if executor is not None and callable(getattr(executor, "get_executor", None)):
        return executor.get_executor(pure=False)  # its own submit returns futures of another kind
    submits = callable(getattr(executor, "submit", None)) and not isinstance(executor, type)
    if executor is None or submits:
        return executor
    raise ct.ControlArgument(
        "executor must be a concurrent.futures.Executor such as ProcessPoolExecutor(4), or a "
        f"dask.distributed.Client, not {shown(executor)}"
    )


def work_off(
    function: Callable[[tuple[Task, ...]], list[Result]],
    tasks: Sequence[Task],
    executor: Any,
    results: dict[int, Result],
    lost: Callable[[Task, BaseException], Result],
    done: Callable[[int], object],
) -> None:
    """Fill in the result of each task.

    A process pool that breaks is replaced by one like it. What was under way when a worker died is done
    once more at the end, one task at a time, so that the one that ends its worker is known.

    Parameters
    ----------
    function : callable
        Takes several tasks and gives their results; it raises nothing.
    tasks : sequence
        What to do.
    executor : object or None
        From `as_submitter`.
    results : dict
        Result by index of the task; filled in as they come, so that an interruption loses none.
    lost : callable
        Makes the result of a task that came to nothing where it was sent.
    done : callable
        Told the number of results that have come.
    """
    if executor is None:
        for i, task in enumerate(tasks):
            results[i] = function((task,))[0]
            done(1)
        return
    _Parcels(function, tasks, results, lost, done).send_to(executor)


class _Parcels:
    """Tasks on their way to workers and back."""

    def __init__(self, function: Any, tasks: Any, results: Any, lost: Any, done: Any) -> None:
        self.function, self.tasks, self.results, self.lost, self.done = function, tasks, results, lost, done
        size = max(1, min(_LARGEST, -(-len(tasks) // _AT_ONCE)))
        every = range(len(tasks))
        self.waiting = deque(tuple(every[i : i + size]) for i in range(0, len(tasks), size))
        self.running: dict[Future[Any], tuple[int, ...]] = {}
        self.suspects: deque[tuple[int, ...]] = deque()  # under way when a worker died
        self.alone: tuple[int, ...] | None = None  # the one of them that has the workers for itself

    def send_to(self, executor: Any) -> None:
        """Do all of them; on other processes like these where they break."""
        with ExitStack() as stack:
            try:
                while (broken := self._until_it_breaks(executor)) is not None:
                    executor = _replacement(executor, stack)
                    if executor is None:
                        for parcel in (*self.suspects, *self.waiting):
                            self._lose(parcel, broken)
                        return
            finally:
                for future in self.running:  # where it is interrupted
                    future.cancel()

    def _until_it_breaks(self, executor: Any) -> BrokenExecutor | None:
        """Keep the workers busy; returns what broke them."""
        workers = getattr(executor, "_max_workers", None)
        most = _MANY if workers is None else _AHEAD * workers
        while self.waiting or self.running or self.suspects:
            try:
                while self.waiting and len(self.running) < most:
                    self._submit(executor, self.waiting)
                if self.suspects and not self.running:
                    self.alone = self._submit(executor, self.suspects)
            except BrokenExecutor as error:
                return self._take_in() or error
            wait(self.running, return_when=FIRST_COMPLETED)
            if broken := self._take_in():
                return broken
        return None

    def _submit(self, executor: Any, queue: deque[tuple[int, ...]]) -> tuple[int, ...]:
        """Send the first of a queue; it stays there where that fails."""
        parcel = queue[0]
        self.running[executor.submit(self.function, tuple(self.tasks[i] for i in parcel))] = parcel
        return queue.popleft()

    def _take_in(self) -> BrokenExecutor | None:
        """Collect the finished results, and return the error of broken workers.

        After such an error nothing runs any more. The result is None if no worker broke.
        """
        broken = None
        for future in [future for future in self.running if future.done()]:
            error = _error_of(future)
            parcel = self.running.pop(future)
            if error is None:
                self._enter(parcel, future.result())
            elif isinstance(error, KeyboardInterrupt):
                raise error
            else:
                self._doubt(parcel, error)
            broken = error if isinstance(error, BrokenExecutor) else broken
        if broken is not None:
            for parcel in self.running.values():
                self._doubt(parcel, broken)
            self.running.clear()
        return broken

    def _doubt(self, parcel: tuple[int, ...], error: BaseException) -> None:
        """Schedule a failed task for a second try, or give it up.

        Another task beside it may be the cause, so it is tried once more, alone.
        """
        if parcel == self.alone:
            self._lose(parcel, error)
        elif len(parcel) > 1:
            self.waiting.extend((i,) for i in parcel)
        else:
            self.suspects.append(parcel)

    def _enter(self, parcel: Sequence[int], found: Sequence[Any]) -> None:
        self.results.update(zip(parcel, found, strict=True))
        self.done(len(parcel))

    def _lose(self, parcel: Sequence[int], error: BaseException) -> None:
        self._enter(parcel, [self.lost(self.tasks[i], error) for i in parcel])


def _error_of(future: Future[Any]) -> BaseException | None:
    """Return the error of a finished task, or None."""
    try:
        return future.exception()
    except CancelledError as error:
        return error


def _replacement(executor: Any, stack: ExitStack) -> ProcessPoolExecutor | None:
    """Return a new process pool with the settings of a broken one.

    It is None if the executor is no process pool, or if the new workers fail too.
    """
    if not isinstance(executor, ProcessPoolExecutor):
        return None
    own: Any = executor
    known = {name: getattr(own, f"_{name}") for name in ("mp_context", "initializer", "initargs")}
    pool = ProcessPoolExecutor(own._max_workers, **known)
    stack.callback(pool.shutdown, cancel_futures=True)
    return None if isinstance(_error_of(pool.submit(int)), BrokenExecutor) else pool
