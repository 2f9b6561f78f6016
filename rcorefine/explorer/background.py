"""Background thread for long tasks of the page.

The thread that serves the page stays free; the page shows what is running.
"""

from __future__ import annotations

import logging
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from html import escape
from typing import Any

import control as ct
import panel as pn

from ..exceptions import RCOError, unheard
from .parts import text

__all__ = ["EXPECTED", "LOOKING", "Background"]

#: What wrong values and records raise; anything else is a fault of the program.
EXPECTED = (RCOError, ct.ControlArgument, ct.ControlDimension, OSError)

#: Searches, verdicts and reports of all visitors, one at a time: matplotlib is one for all.
LOOKING = ThreadPoolExecutor(1, "rcorefine-explorer")


class Background:
    """The work of one visitor.

    Attributes
    ----------
    doing : Executor
        Where steps are done, in their order.
    status : panel.pane.HTML
        What is being done, or what went wrong.
    """

    def __init__(self) -> None:
        self.doing = ThreadPoolExecutor(1, "rcorefine-exploration")
        self.status = text("")
        self._doc = pn.state.curdoc
        self._busy: list[str] = []

    @property
    def _served(self) -> bool:
        return self._doc is not None and self._doc.session_context is not None

    def begin(self, work: Callable[[], None]) -> None:
        """Begin when the page is there: what changes before would be lost."""

        def loaded() -> None:
            self._busy.clear()
            work()

        self._busy.append("opening")
        self.say()
        pn.state.onload(loaded)

    def soon(self, work: Callable[[], None], pause: int) -> None:
        """Do something quick after so many ms, on the thread of the page."""
        if self._served:
            self._doc.add_timeout_callback(work, pause)
        else:
            work()

    def later(
        self, lane: ThreadPoolExecutor, words: str, work: Callable[[], Any], then: Callable[[Any], None]
    ) -> None:
        """Do work that takes long, say so meanwhile, and show what it found."""

        def run() -> None:
            result, wrong = None, ""
            try:
                with unheard():  # they stand in the results, too
                    result = work()
            except EXPECTED as error:
                wrong = str(error)
            except Exception as error:
                logging.getLogger(__name__).exception(words)
                wrong = f"a fault of the program: {error}"

            def done() -> None:
                self._busy.remove(words)
                if not wrong:
                    then(result)
                self.say(f"{words}: {wrong}" if wrong else "")

            if self._served:  # the page is changed on its own thread
                self._doc.add_next_tick_callback(done)
            else:
                done()

        self._busy.append(words)
        self.say()
        lane.submit(run)

    def say(self, wrong: str = "") -> None:
        """Show what is running and what went wrong."""
        doing = f'<p class="busy">{escape("; ".join(self._busy))} …</p>' if self._busy else ""
        failed = f'<p class="wrong">{escape(wrong)}</p>' if wrong else ""
        self.status.object = f'<div role="status">{failed}{doing or "<p>&nbsp;</p>"}</div>'
