"""Locks of streams: one thread at a time, and forks that leave none taken."""

from __future__ import annotations

import os
import threading
from collections.abc import Callable
from functools import wraps
from typing import Any, TypeVar, cast
from weakref import WeakValueDictionary

import numpy as np

from ..exceptions import ONE_THREAD

_Method = TypeVar("_Method", bound=Callable[..., Any])
_locks: WeakValueDictionary[int, Any] = WeakValueDictionary()  # of all objects that live
_forking, _held = threading.Lock(), list[Any]()


def own_lock() -> threading.RLock:
    """Lock of one object, free in the child of a fork.

    A fork waits until no thread is in a locked method, so a child never gets an object half changed.
    """
    lock = threading.RLock()
    _locks[id(lock)] = lock
    return lock


def _before_fork() -> None:
    # wait until no method of any object runs, then hold all locks over the fork
    _forking.acquire()
    _held.extend(lock for ref in _locks.valuerefs() if (lock := ref()) is not None and lock.acquire())


def _after_fork() -> None:
    # parent and child release them
    while _held:
        _held.pop().release()
    _forking.release()


if hasattr(os, "register_at_fork"):  # where there is fork
    os.register_at_fork(before=_before_fork, after_in_parent=_after_fork, after_in_child=_after_fork)


def alone(method: _Method) -> _Method:
    """Let only one thread at a time run a method, with one thread of BLAS.

    Thus no sample is lost between two threads.

    The kernels notice what overflows themselves; as plain Python they are as silent about it as compiled.
    """

    @wraps(method)
    def locked(self: Any, *args: Any, **kwargs: Any) -> Any:
        with self._lock, np.errstate(all="ignore"), ONE_THREAD:
            return method(self, *args, **kwargs)

    return cast(_Method, locked)
