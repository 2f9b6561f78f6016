"""Locks of streams: one thread at a time, and forks that leave none taken."""

from __future__ import annotations

import inspect
import os
from collections.abc import Iterator
from contextlib import contextmanager
from copy import deepcopy
from functools import wraps
from threading import Condition, Lock, get_ident
from typing import Any

import numpy as np

from ..exceptions import ONE_THREAD

_change = Condition()  # of what follows
_calls = dict[object, tuple[int, int]]()  # that run: object and thread of each
_forking = Lock()  # taken from before a fork until after it


def _before_fork() -> None:
    _forking.acquire()
    _change.acquire()
    _change.wait_for(lambda: all(user == get_ident() for _, user in _calls.values()))


def _after_fork() -> None:
    # parent and child
    _forking.release()
    _change.notify_all()
    _change.release()


getattr(os, "register_at_fork", dict)(  # where there is fork
    before=_before_fork, after_in_parent=_after_fork, after_in_child=_after_fork
)


class Locked:
    """Object that one thread at a time uses, whatever is asked of it.

    Every function and property that is not private runs alone, those of base classes and the special
    ones (`repr`, pickles, copies) included. A subclass states nothing.

    No lock is stored, so pickles and copies hold none. A fork waits until no other thread is in a call, and
    lets none begin: a child never gets an object half changed, or one that a thread of its parent holds.
    """

    def __init_subclass__(cls, **options: Any) -> None:
        super().__init_subclass__(**options)
        for name in dir(cls):
            member = inspect.getattr_static(cls, name)
            if name.startswith("_") and not name.endswith("_"):
                continue
            if isinstance(member, property):
                setattr(cls, name, member.getter(_alone(member.fget)))
            elif inspect.isfunction(member):
                setattr(cls, name, _alone(member))

    def __getstate__(self) -> dict[str, Any]:
        # a pickle is written after this call: copy what the next update changes
        return deepcopy(vars(self))

    @property
    @contextmanager
    def _lock(self) -> Iterator[None]:
        """Context in which no other thread uses this object."""
        call, me, thread = object(), id(self), get_ident()

        def may_begin() -> bool:
            # a thread that is in a call finishes it before a fork
            others = [one for one, user in _calls.values() if user != thread]
            return me not in others and (len(others) < len(_calls) or not _forking.locked())

        try:
            with _change:
                _change.wait_for(may_begin)
                _calls[call] = me, thread
            yield
        finally:
            with _change:
                _calls.pop(call, None)
                _change.notify_all()


def _alone(method: Any) -> Any:
    """Let only one thread at a time run a method, with one thread of BLAS.

    The kernels notice what overflows themselves; as plain Python they are as silent about it as compiled.
    """
    if "alone" in vars(method):
        return method

    @wraps(method)
    def alone(self: Any, *args: Any, **kwargs: Any) -> Any:
        with self._lock, np.errstate(all="ignore"), ONE_THREAD:
            return method(self, *args, **kwargs)

    vars(alone)["alone"] = True
    return alone
