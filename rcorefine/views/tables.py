"""Tables as text of at most 80 columns and as HTML, every name escaped."""

from __future__ import annotations

import math
import textwrap
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from html import escape
from itertools import zip_longest
from typing import Any

WIDTH = 80
_LEAST = 8  # letters to which a column may be narrowed


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


def clip(text: str, width: int) -> str:
    """Return a text on one line, cut to at most `width` characters.

    A cut is marked by three dots.
    """
    text = " ".join(text.split())
    return text if len(text) <= width else text[: max(width - 3, 0)] + "..."


@dataclass(frozen=True, slots=True)
class TextTable:
    """Table of text cells, with notes on their meaning below.

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

    Examples
    --------
    >>> print(TextTable(["model", "fit"], [["plant", "41.2"]], notes=["fit in percent."]).text())
    model   fit
    -----  ----
    plant  41.2
    fit in percent.
    >>> "&lt;b&gt;" in TextTable(["model"], [["<b>"]]).html()
    True
    """

    headers: Sequence[str]
    rows: Sequence[Sequence[str]]
    title: str | None = None
    notes: Sequence[str] = ()
    left: int = 1

    def text(self) -> str:
        """Return plain text of at most 80 columns.

        To fit, text that stands in every row is told above, and the widest text columns take several lines.
        Without rows, it holds only the title and the notes.
        """
        if not self.rows:
            return "\n".join(wrapped([self.title or "", *self.notes]))
        table = [[str(cell) for cell in row] for row in (self.headers, *self.rows)]
        # what stands in every row is told once, before any name is cut
        columns = range(1, self.left if len(table) > 2 and _too_wide(_sizes(table)) else 0)
        once = [i for i in columns if len({row[i] for row in table[1:]}) == 1]
        alike = ", ".join(f"{table[0][i]}: {table[1][i]}" for i in once)
        table = [[cell for i, cell in enumerate(row) if i not in once] for row in table]
        left = self.left - len(once)
        widths = _narrowed(_sizes(table), left)
        lines = _printed(table, widths, left)
        above = wrapped([*(self.title or "").split("\n"), alike])
        return "\n".join([*above, *lines, *wrapped(self.notes, "  ")])

    def html(self) -> str:
        """Return one ``div`` element.

        Names from files may hold anything, so all is escaped.
        """

        def line(row: Sequence[str], tag: str) -> str:
            cells = ""
            for i, cell in enumerate(row):
                side = "left" if i < self.left else "right"
                cells += f'<{tag} style="text-align:{side}">{escape(str(cell))}</{tag[:2]}>'
            return f"<tr>{cells}</tr>"

        head = line(self.headers, 'th scope="col"')
        body = "".join(line(row, "td") for row in self.rows)
        caption = "" if self.title is None else f"<caption>{escape(self.title)}</caption>"
        below = "".join(f"<p>{escape(note)}</p>" for note in self.notes)
        return (
            f'<div class="rcorefine"><table>{caption}<thead>{head}</thead>'
            f"<tbody>{body}</tbody></table>{below}</div>"
        )


def _sizes(table: Sequence[Sequence[str]]) -> list[int]:
    """Return the width of each column that holds its longest cell."""
    return [max(map(len, column)) for column in zip(*table, strict=True)]


def _too_wide(widths: Sequence[int]) -> bool:
    """Return whether columns with two spaces between them are too wide."""
    return sum(widths) + 2 * (len(widths) - 1) > WIDTH


def _narrowed(widths: list[int], left: int) -> list[int]:
    """Return widths that fit the page: names break rather than figures."""
    while _too_wide(widths) and max(widths) > _LEAST:
        wide = [i for i, size in enumerate(widths) if size > _LEAST]
        widths[max(wide, key=lambda i: (i < left, widths[i]))] -= 1
    return widths


def _printed(table: Sequence[Sequence[str]], widths: Sequence[int], left: int) -> Iterator[str]:
    """Yield the lines of a table, with dashes below its first row.

    Names stay whole; a word that is too long is broken.
    """
    for k, row in enumerate(table):
        cells = [
            textwrap.wrap(" ".join(cell.split()), max(size, 1), break_on_hyphens=False) or [""]
            for cell, size in zip(row, widths, strict=True)
        ]
        for parts in zip_longest(*cells, fillvalue=""):
            sized = enumerate(zip(parts, widths, strict=True))
            yield "  ".join(f"{part:{'<' if i < left else '>'}{size}}" for i, (part, size) in sized).rstrip()
        if k == 0:
            yield "  ".join("-" * size for size in widths)


def wrapped(sentences: Sequence[str], indent: str = "") -> list[str]:
    """Lines of at most 80 columns, the first of a sentence not set in."""
    return [line for text in sentences for line in textwrap.wrap(text, WIDTH, subsequent_indent=indent)]
