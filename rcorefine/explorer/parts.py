"""Texts, buttons and pictures as the explorer's page has them."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Sequence
from html import escape
from typing import Any

import panel as pn
from bokeh.models import PrintfTickFormatter

from .look import TEXT, WIDGET

__all__ = [
    "button", "column", "download", "folded", "paragraphs", "picture", "select", "slider", "text", "title",
]  # fmt: skip


def text(html: str) -> Any:
    """HTML in which every name is escaped already."""
    return pn.pane.HTML(html, stylesheets=[TEXT], sizing_mode="stretch_width", margin=(2, 8))


def title(words: str) -> Any:
    """A heading."""
    return text(f"<h2>{escape(words)}</h2>")


def folded(words: str, html: str) -> str:
    """HTML of a table that is shown when asked for."""
    return f'<details><summary>{words}</summary><div class="scroll">{html}</div></details>'


def paragraphs(sentences: Iterable[str]) -> str:
    """HTML of sentences, escaped."""
    return "".join(f"<p>{escape(sentence)}</p>" for sentence in sentences)


def picture(figure: Any) -> Any:
    """A figure of bokeh."""
    return pn.pane.Bokeh(figure, sizing_mode="stretch_width", margin=(2, 8))


def _plain(words: str) -> str:
    """Return a label in which no characters begin a formula.

    A word joiner, which has no width, separates marks such as $$.
    Where bokeh finds a formula in a label it makes HTML of the whole, and names come from strangers' files.
    """
    return re.sub(r"\$(?=\$)|\\(?=[\[\](){}])", "\\g<0>\N{WORD JOINER}", words)


def button(words: str, do: Callable[[], None], *, wide: bool = True, chosen: bool = False) -> Any:
    """A button; across its column where it is one of a list."""
    look = {"sizing_mode": "stretch_width"} if wide else {}
    kind = "primary" if chosen else "default"
    made = pn.widgets.Button(
        name=_plain(words), button_type=kind, stylesheets=[WIDGET], margin=(3, 8), **look
    )
    made.on_click(lambda _: do())
    return made


def select(words: str, labels: Sequence[str], choose: Callable[[int], None] | None = None) -> Any:
    """A choice by number."""
    options = {_plain(label): i for i, label in enumerate(labels)}
    made = pn.widgets.Select(name=_plain(words), options=options, stylesheets=[WIDGET], margin=(3, 8))
    if choose is not None:
        made.param.watch(lambda event: choose(event.new), "value")
    return made


def slider(words: str, start: float, end: float, value: float) -> Any:
    """A slider in two hundred steps."""
    return pn.widgets.FloatSlider(
        format=PrintfTickFormatter(format="%.4g"),
        name=_plain(words), start=start, end=end, value=value, step=(end - start) / 200, stylesheets=[WIDGET],
        sizing_mode="stretch_width", margin=(4, 18),
    )  # fmt: skip


def download(name: str, words: str, make: Callable[[], Any]) -> Any:
    """A button that hands a file over."""
    return pn.widgets.FileDownload(
        callback=make, filename=name, label=_plain(words), stylesheets=[WIDGET], margin=(3, 8)
    )


def column(*parts: Any) -> Any:
    """Parts below each other."""
    return pn.Column(*parts, sizing_mode="stretch_width", margin=0)
