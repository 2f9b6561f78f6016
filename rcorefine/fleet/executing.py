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
    workers = getattr(executor, "_max_workers", None)
    ahead = _MANY if workers is None else _AHEAD * workers
    size = max(1, min(_LARGEST, -(-len(tasks) // _AT_ONCE)))
    waiting = deque(tuple(range(len(tasks))[i : i + size]) for i in range(0, len(tasks), size))
    suspects: deque[tuple[int, ...]] = deque()  # under way when a worker died

    def enter(parcel: tuple[int, ...], found: Sequence[Result]) -> None:
        results.update(zip(parcel, found, strict=True))
        done(len(parcel))

    def lose(parcel: tuple[int, ...], error: BaseException) -> None:
        enter(parcel, [lost(tasks[i], error) for i in parcel])

    with ExitStack() as stack:
        for queue, most in ((waiting, ahead), (suspects, 1)):
            while queue:
                failed, broken = _send(function, tasks, executor, queue, most, enter)
                for parcel, error in failed:
                    if queue is suspects:
                        lose(parcel, error)
                    else:
                        suspects.extend((i,) for i in parcel)
                executor = executor if broken is None else _replacement(executor, stack)
                if executor is None and broken is not None:
                    for parcel in (*suspects, *waiting):
                        lose(parcel, broken)
                    return


def _send(
    function: Any,
    tasks: Sequence[Any],
    executor: Any,
    queue: deque[tuple[int, ...]],
    most: int,
    enter: Callable[[tuple[int, ...], Any], None],
) -> tuple[list[tuple[tuple[int, ...], BaseException]], BrokenExecutor | None]:
    """Work off a queue until it is empty or the workers break.

    Return the parcels that failed with their errors, and what broke the workers.
    """
    running: dict[Future[Any], tuple[int, ...]] = {}
    failed: list[tuple[tuple[int, ...], BaseException]] = []
    broken: BrokenExecutor | None = None
    try:
        while running or (queue and broken is None):
            while queue and broken is None and len(running) < most:
                try:
                    running[executor.submit(function, tuple(tasks[i] for i in queue[0]))] = queue[0]
                    queue.popleft()
                except BrokenExecutor as error:
                    broken = error
            for future in wait(running, return_when=FIRST_COMPLETED).done:
                parcel, fault = running.pop(future), _error_of(future)
                if fault is None:
                    enter(parcel, future.result())
                elif isinstance(fault, KeyboardInterrupt):
                    raise fault
                else:
                    failed.append((parcel, fault))
                    broken = fault if isinstance(fault, BrokenExecutor) else broken
    finally:
        for future in running:  # where it is interrupted
            future.cancel()
    return failed, broken


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
