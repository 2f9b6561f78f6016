"""Tables as text of at most 80 columns and as HTML, every name escaped."""

from __future__ import annotations

import math
import textwrap
from collections.abc import Sequence
from dataclasses import dataclass
from html import escape
from itertools import zip_longest
from typing import Any

import numpy as np

WIDTH = 80


def number(value: float, digits: int = 4) -> str:
    """Figure with `digits` significant digits; "-" where there is none.

    Examples
    --------
    >>> number(0.123456), number(float("nan")), number(-12.0)
    ('0.1235', '-', '-12')
    """
    value = float(value)
    if math.isnan(value):
        return "-"
    return f"{value:.{digits}g}"


def cells(row: Any, columns: str) -> list[str]:
    """Attributes of an object as the cells of a row.

    Parameters
    ----------
    row : object
        What the row shows.
    columns : str
        Names of attributes, each with its format behind a colon if it is not text; "-" stands for NaN.

    Examples
    --------
    >>> cells(rco.Effect("damping", "link1"), "kind place start")
    ['damping', 'link1', '{}']
    >>> cells(1.5j, "imag:.3f")
    ['1.500']
    """
    texts = {column: f"{{0.{column}}}".format(row) for column in columns.split()}
    return ["-" if ":" in column and text == "nan" else text for column, text in texts.items()]


def root_mean_square(values: Any) -> float:
    """Of the errors of one output, or over those of several."""
    return float(np.sqrt(np.mean(np.asarray(values) ** 2)))


def clip(text: str, width: int) -> str:
    """Return a text on one line, cut to at most `width` characters.

    A cut is marked by three dots.
    """
    text = " ".join(text.split())
    return text if len(text) <= width else text[: max(width - 3, 0)] + "..."


def text_table(
    headers: Sequence[str],
    rows: Sequence[Sequence[str]],
    *,
    title: str | None = None,
    notes: Sequence[str] = (),
    left: int = 1,
) -> str:
    """Table in plain text of at most 80 columns.

    To fit, text that stands in every row is told above, and the widest text columns take several lines.

    Parameters
    ----------
    headers : sequence of str
        One per column.
    rows : sequence of sequence of str
        Cells, formatted.
    title : str, optional
        Line(s) above.
    notes : sequence of str
        Sentences below, wrapped.
    left : int
        That many columns from the left are text, set left; the others are
        set right.

    Returns
    -------
    str
        Lines joined by newlines.

    Examples
    --------
    >>> print(text_table(["model", "fit"], [["plant", "41.2"]], notes=["fit in percent."]))
    model   fit
    -----  ----
    plant  41.2
    fit in percent.
    """
    table = [list(headers), *[[str(cell) for cell in row] for row in rows]]
    alike: list[str] = []
    if len(rows) > 1 and sum(max(map(len, column)) + 2 for column in zip(*table, strict=True)) - 2 > WIDTH:
        # what stands in every row is told once, before any name is cut
        for i in range(left - 1, 0, -1):
            if len({row[i] for row in table[1:]}) == 1:
                left -= 1
                header, cell = [row.pop(i) for row in table][:2]
                alike.insert(0, f"{header}: {cell}")
    widths = [max(len(row[i]) for row in table) for i in range(len(table[0]))]
    while sum(widths) + 2 * (len(widths) - 1) > WIDTH:
        # names take several lines rather than figures
        widest = max(range(len(widths)), key=lambda i: (i < left, widths[i]) if widths[i] > 8 else (False, 0))
        if widths[widest] <= 8:
            break
        widths[widest] -= 1
    lines = []
    for index, row in enumerate(table):
        cells = [_lines(cell, size) for cell, size in zip(row, widths, strict=True)]
        for parts in zip_longest(*cells, fillvalue=""):
            lines.append(
                "  ".join(
                    part.ljust(size) if i < left else part.rjust(size)
                    for i, (part, size) in enumerate(zip(parts, widths, strict=True))
                ).rstrip()
            )
        if index == 0:
            lines.append("  ".join("-" * size for size in widths))
    titles = ([] if title is None else title.split("\n")) + ([", ".join(alike)] if alike else [])
    above = [line for part in titles for line in textwrap.wrap(part, WIDTH)]
    below = [line for note in notes for line in textwrap.wrap(note, WIDTH, subsequent_indent="  ")]
    return "\n".join([*above, *lines, *below])


def _lines(cell: str, size: int) -> list[str]:
    """Wrap a cell to lines of at most `size` characters.

    Names stay whole; a word that is too long is broken.
    """
    return textwrap.wrap(" ".join(cell.split()), max(size, 1), break_on_hyphens=False) or [""]


def html_table(
    headers: Sequence[str],
    rows: Sequence[Sequence[str]],
    *,
    title: str | None = None,
    notes: Sequence[str] = (),
    left: int = 1,
) -> str:
    """Table in HTML; names from files may hold anything, so all is escaped.

    Parameters
    ----------
    headers, rows, title, notes, left
        As in `text_table`.

    Returns
    -------
    str
        One ``div`` element.

    Examples
    --------
    >>> "&lt;b&gt;" in html_table(["model"], [["<b>"]])
    True
    """

    def align(index: int) -> str:
        return ' style="text-align:left"' if index < left else ' style="text-align:right"'

    head = "".join(f'<th scope="col"{align(i)}>{escape(str(cell))}</th>' for i, cell in enumerate(headers))
    body = "".join(
        "<tr>" + "".join(f"<td{align(i)}>{escape(str(cell))}</td>" for i, cell in enumerate(row)) + "</tr>"
        for row in rows
    )
    caption = "" if title is None else f"<caption>{escape(title)}</caption>"
    below = "".join(f"<p>{escape(note)}</p>" for note in notes)
    return (
        f'<div class="rcorefine"><table>{caption}<thead><tr>{head}</tr></thead>'
        f"<tbody>{body}</tbody></table>{below}</div>"
    )


@dataclass(frozen=True, slots=True)
class TextTable:
    """Table of text cells, with notes on their meaning below.

    The fields are the arguments of `text_table`.
    """

    headers: Sequence[str]
    rows: Sequence[Sequence[str]]
    title: str | None = None
    notes: Sequence[str] = ()
    left: int = 1

    def text(self) -> str:
        """Return plain text of at most 80 columns.

        Without rows, it holds only the title and the notes.
        """
        if not self.rows:
            return "\n".join(wrapped([*([self.title] if self.title else []), *self.notes]))
        return text_table(self.headers, self.rows, title=self.title, notes=self.notes, left=self.left)

    def html(self) -> str:
        """Return the table as HTML."""
        return html_table(self.headers, self.rows, title=self.title, notes=self.notes, left=self.left)


def wrapped(sentences: Sequence[str]) -> list[str]:
    """Lines of at most 80 columns."""
    return [line for sentence in sentences for line in textwrap.wrap(sentence, WIDTH)]
