"""Warnings that are not to be heard: in the thread that says so, and in no other."""

import threading
import warnings

import pytest

import rcorefine as rco
from rcorefine.exceptions import unheard, warn


def nested() -> None:
    with unheard(rco.IdentifiabilityWarning):
        warn("hidden", rco.IdentifiabilityWarning)
        warn("other", rco.ConversionWarning)
        with unheard():
            warn("hidden", rco.ConversionWarning)
        warn("other", rco.RCOWarning)


def test_categories_and_nesting():
    with pytest.warns(rco.RCOWarning, match="other") as heard:
        nested()
    assert [str(one.message) for one in heard] == ["other", "other"]
    assert heard[0].filename == __file__  # where it was called, not where it stands
    with pytest.warns(rco.IdentifiabilityWarning, match="again"):
        warn("again", rco.IdentifiabilityWarning)


def test_another_thread_is_heard_and_filters_stay():
    """Two that overlap, the first one ending first: catch_warnings would leave its filters to all."""
    before, first, second = list(warnings.filters), threading.Event(), threading.Event()

    def quiet() -> None:
        with unheard():
            first.set()
            second.wait(10)
            warn("hidden", rco.RCOWarning)

    thread = threading.Thread(target=quiet)
    thread.start()
    first.wait(10)
    with pytest.warns(rco.RCOWarning, match="said"):
        warn("said", rco.RCOWarning)
    with unheard():
        second.set()
        thread.join()
    assert list(warnings.filters) == before
