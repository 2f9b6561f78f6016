"""pytest plugin for runs without numba: a test that plain Python is too slow for is skipped, and says so.

RCOREFINE_TEST_SECONDS=3 python -m pytest -p tests.time_limit
"""

from __future__ import annotations

import os
import signal
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import pytest

#: s; 0: no limit
LIMIT = float(os.environ.get("RCOREFINE_TEST_SECONDS", "0"))
_AGAIN = 2.0  # s


def pytest_configure(config: pytest.Config) -> None:
    """A finalizer that is interrupted, or finds a file that a skipped test left half written, is no fault."""
    config.addinivalue_line("filterwarnings", "ignore::pytest.PytestUnraisableExceptionWarning")


@contextmanager
def _limited() -> Iterator[None]:
    """End what runs longer; the exception is no `Exception`, so nothing takes it for a failed fit."""

    def stop(number: int, frame: Any) -> None:
        pytest.skip(f"longer than {LIMIT:g} s in plain Python")

    before = signal.signal(signal.SIGALRM, stop)
    # again and again: in a finalizer the interpreter swallows it
    signal.setitimer(signal.ITIMER_REAL, LIMIT, _AGAIN)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0)
        signal.signal(signal.SIGALRM, before)


@pytest.hookimpl(wrapper=True)
def pytest_runtest_setup(item: pytest.Item) -> Iterator[Any]:
    """Fixtures of a module may be slow as well."""
    with _limited():
        return (yield)


@pytest.hookimpl(wrapper=True)
def pytest_runtest_call(item: pytest.Item) -> Iterator[Any]:
    """The test itself."""
    with _limited():
        return (yield)
