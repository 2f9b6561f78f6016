"""pytest plugin for runs without numba: what plain Python is too slow for is skipped, and says so.

RCOREFINE_TEST_SECONDS=2 python -m pytest -p tests.time_limit

Tests that are known to take longer stand in `slow_in_plain_python.txt` and are not begun; a line is a test,
with its parameters or for all of them. What does not stand there is stopped after that many seconds of CPU.
RCOREFINE_TEST_NOTE=1 adds what was stopped to the list.
"""

from __future__ import annotations

import os
import signal
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest

#: s of CPU; 0: no limit
LIMIT = float(os.environ.get("RCOREFINE_TEST_SECONDS", "0"))
NOTE = os.environ.get("RCOREFINE_TEST_NOTE", "0") != "0"
KNOWN = Path(__file__).with_name("slow_in_plain_python.txt")
_TOO_LONG = "too long in plain Python"
_AGAIN = 2.0  # s
_WAITING = 20.0  # times the limit by the clock, for what a test waits for in another process
_TIMERS = {signal.ITIMER_VIRTUAL: signal.SIGVTALRM, signal.ITIMER_REAL: signal.SIGALRM}


def pytest_configure(config: pytest.Config) -> None:
    """A finalizer that is interrupted, or finds a file that a skipped test left half written, is no fault."""
    config.addinivalue_line("filterwarnings", "ignore::pytest.PytestUnraisableExceptionWarning")


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Skip what is known to be slow before anything of it runs."""
    if not LIMIT:
        return
    known = set(KNOWN.read_text().splitlines())
    slow = pytest.mark.skip(reason="plain Python is too slow for it (tests/slow_in_plain_python.txt)")
    for item in items:
        if item.nodeid in known or item.nodeid.split("[")[0] in known:
            item.add_marker(slow)


@contextmanager
def _limited(item: pytest.Item) -> Iterator[None]:
    """End what runs longer; the exception is no `Exception`, so nothing takes it for a failed fit."""

    def stop(number: int, frame: Any) -> None:
        pytest.skip(f"{_TOO_LONG} ({LIMIT:g} s)")

    before = [signal.signal(number, stop) for number in _TIMERS.values()]
    for (timer, _), most in zip(_TIMERS.items(), (LIMIT, _WAITING * LIMIT), strict=True):
        # again and again: in a finalizer the interpreter swallows it
        signal.setitimer(timer, most, _AGAIN)
    try:
        yield
    except pytest.skip.Exception as reason:  # also that of a fixture, which all who ask for it get
        if NOTE and _TOO_LONG in str(reason):
            with KNOWN.open("a") as file:
                file.write(f"{item.nodeid}\n")
        raise
    finally:
        for (timer, number), handler in zip(_TIMERS.items(), before, strict=True):
            signal.setitimer(timer, 0)
            signal.signal(number, handler)


@pytest.hookimpl(wrapper=True)
def pytest_runtest_setup(item: pytest.Item) -> Iterator[Any]:
    """Fixtures of a module may be slow as well."""
    with _limited(item):
        return (yield)


@pytest.hookimpl(wrapper=True)
def pytest_runtest_call(item: pytest.Item) -> Iterator[Any]:
    """The test itself."""
    with _limited(item):
        return (yield)
