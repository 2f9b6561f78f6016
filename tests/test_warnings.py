"""Warnings that are not to be heard: in the thread that says so, and in no other."""

import threading
import warnings

import pytest

import rcorefine as rco
from rcorefine import exceptions


def nested() -> None:
    with exceptions.unheard(rco.IdentifiabilityWarning):
        exceptions.warn("hidden", rco.IdentifiabilityWarning)
        exceptions.warn("other", rco.ConversionWarning)
        with exceptions.unheard():
            exceptions.warn("hidden", rco.ConversionWarning)
        exceptions.warn("other", rco.RCOWarning)


def test_categories_and_nesting():
    with pytest.warns(rco.RCOWarning, match="other") as heard:
        nested()
    assert [str(one.message) for one in heard] == ["other", "other"]
    assert heard[0].filename == __file__  # where it was called, not where it stands
    with pytest.warns(rco.IdentifiabilityWarning, match="again"):
        exceptions.warn("again", rco.IdentifiabilityWarning)


def test_another_thread_is_heard_and_filters_stay():
    """Two that overlap, the first one ending first: catch_warnings would leave its filters to all."""
    before, first, second = list(warnings.filters), threading.Event(), threading.Event()

    def quiet() -> None:
        with exceptions.unheard():
            first.set()
            second.wait(10)
            exceptions.warn("hidden", rco.RCOWarning)

    thread = threading.Thread(target=quiet)
    thread.start()
    first.wait(10)
    with pytest.warns(rco.RCOWarning, match="said"):
        exceptions.warn("said", rco.RCOWarning)
    with exceptions.unheard():
        second.set()
        thread.join()
    assert list(warnings.filters) == before
