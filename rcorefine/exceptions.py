"""Errors, warnings, settings of the arithmetic, optional packages.

An error says what was wrong, where, and what to do.

::

    RCOError
    |-- DataError            (ValueError)    the measured record
    |-- ModelError           (ValueError)    the model or an effect in it
    |-- DivergenceError      (ArithmeticError)  an estimate that blew up
    `-- MissingExtraError    (ImportError)   an optional dependency
    RCOWarning
    |-- ConversionWarning    discrete <-> continuous conversion is not unique
    |-- ExcitationWarning    the record does not excite what is asked of it
    `-- IdentifiabilityWarning  a combination of parameters that the data cannot see

Sizes that do not fit raise `control.ControlDimension` and wrong types
`control.ControlArgument`, as python-control itself does.
"""

import importlib
import os
import sys
import warnings
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from contextvars import ContextVar
from threading import Lock, get_ident
from typing import Any

import numpy as np


class RCOError(Exception):
    """Base class of the errors that rcorefine raises of its own."""


class DataError(RCOError, ValueError):
    """The measured record cannot be used as it is."""


class ModelError(RCOError, ValueError):
    """The model, a port or an effect cannot be used as it is."""


class DivergenceError(RCOError, ArithmeticError):
    """An estimate diverged; the message says when, why and what to change."""


class MissingExtraError(RCOError, ImportError):
    """An optional dependency is not installed; the message names the extra."""


class RCOWarning(UserWarning):
    """Base class of the warnings that rcorefine emits."""


class ConversionWarning(RCOWarning):
    """The conversion between discrete and continuous time is not unique."""


class ExcitationWarning(RCOWarning):
    """The record does not excite what is asked of it."""


class IdentifiabilityWarning(RCOWarning):
    """The data cannot see a combination of the parameters."""


_HERE = os.path.dirname(os.path.abspath(__file__)) + os.sep
_UNHEARD: ContextVar[tuple[type[RCOWarning], ...]] = ContextVar("unheard", default=())


@contextmanager
def unheard(category: type[RCOWarning] = RCOWarning) -> Iterator[None]:
    """Suppress warnings of a category in this thread.

    The result contains what they say.

    `warnings.catch_warnings` would change the filters of all threads, and leave them changed where two of
    its contexts overlap.
    """
    before = _UNHEARD.set((*_UNHEARD.get(), category))
    try:
        yield
    finally:
        _UNHEARD.reset(before)


def warn(message: str, category: type[Warning]) -> None:
    """Warn at the line that called the package.

    It works as `warnings.warn`, unless `unheard` suppresses the category.
    """
    if not issubclass(category, _UNHEARD.get()):
        level, frame = 1, sys._getframe()
        while frame.f_back is not None and frame.f_code.co_filename.startswith(_HERE):
            level, frame = level + 1, frame.f_back
        warnings.warn(message, category, stacklevel=level)


def needed(module: str, extra: str, what: str) -> Any:
    """A module that not everybody has.

    Parameters
    ----------
    module : str
        Name, as it is imported.
    extra : str
        Extra of this package that installs it.
    what : str
        What needs it.

    Raises
    ------
    MissingExtraError
        If it is not installed.
    """
    try:
        return importlib.import_module(module)
    except ImportError as error:
        raise MissingExtraError(
            f'{what} needs {module}; install the extra "{extra}": pip install "rcorefine[{extra}]"'
        ) from error


@contextmanager
def own_arithmetic() -> Iterator[None]:
    """Apply NumPy's default error settings, and use one thread of BLAS.

    A weight that underflows is zero, and raises no error. With small matrices, other threads of BLAS only
    wait: the answer takes as long, and a third to a half of the CPU time is lost.
    """
    with np.errstate(divide="warn", over="warn", invalid="warn", under="ignore"), ONE_THREAD:
        yield


class _OneThread:
    """Context with one thread of BLAS, where threadpoolctl is installed.

    The last of several callers at once restores the number. The libraries are looked up once, which takes
    1.5 ms; to set and restore the number takes 16 us.
    """

    lock, inside, controller, limit = Lock(), list[int](), None, None

    def __enter__(self) -> None:
        with self.lock, suppress(ImportError):
            self.inside.append(get_ident())
            if len(self.inside) == 1:
                if self.controller is None:
                    from threadpoolctl import ThreadpoolController

                    self.controller = ThreadpoolController()
                self.limit = self.controller.limit(limits=1, user_api="blas")

    def __exit__(self, *_: object) -> None:
        with self.lock:
            self.inside.remove(get_ident())
            if self.limit and not self.inside:
                self.limit = self.limit.restore_original_limits()

    def in_child(self) -> None:
        # other threads of the parent are none of the child's
        self.lock.release()
        self.inside = [get_ident(), *filter(get_ident().__eq__, self.inside)]
        self.__exit__()


ONE_THREAD = _OneThread()
getattr(os, "register_at_fork", dict)(  # where there is fork
    before=ONE_THREAD.lock.acquire,
    after_in_parent=ONE_THREAD.lock.release,
    after_in_child=ONE_THREAD.in_child,
)
