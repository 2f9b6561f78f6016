"""Report as one HTML file without scripts or external resources.

All text in it is escaped.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from datetime import UTC, datetime
from html import escape
from os import PathLike
from pathlib import Path
from typing import Any, TypeVar
from urllib.parse import quote

from ...arguments import as_flag, as_path, as_text
from ...results import shows
from ...version import __version__
from ...writing import replacing
from ..tables import Table, html_table
from .pictures import Picture
from .style import STYLE

__all__ = [
    "Facts",
    "Links",
    "Listing",
    "Page",
    "Paragraphs",
    "Section",
    "check_target",
    "reports",
    "write_page",
]

_GENERATOR = '<meta name="generator" content="rcorefine'
# the browser itself refuses whatever would leave the page
_POLICY = "default-src 'none'; img-src data:; style-src 'unsafe-inline'"


_Make = TypeVar("_Make", bound="Callable[..., Page]")


@dataclass(frozen=True, slots=True)
class Paragraphs:
    """Sentences, one paragraph each."""

    texts: Sequence[str]

    def html(self) -> str:
        """Escaped paragraphs."""
        return "".join(f"<p>{escape(text)}</p>" for text in self.texts)


@dataclass(frozen=True, slots=True)
class Listing:
    """Program text."""

    code: str

    def html(self) -> str:
        """Escaped, in a box that scrolls; on paper its lines are broken."""
        return f'<pre tabindex="0"><code>{escape(self.code)}</code></pre>'


@dataclass(frozen=True, slots=True)
class Facts:
    """Names and values."""

    rows: Sequence[tuple[str, str]]

    def html(self) -> str:
        """Escaped list of definitions."""
        return "<dl>" + "".join(f"<dt>{escape(k)}</dt><dd>{escape(v)}</dd>" for k, v in self.rows) + "</dl>"


@dataclass(frozen=True, slots=True)
class Links:
    """Texts, each with a page in the same folder."""

    rows: Sequence[tuple[str, str]]

    def html(self) -> str:
        """Escaped list."""
        items = (
            f'<li><a href="{escape(quote(page), quote=True)}">{escape(text)}</a></li>'
            for text, page in self.rows
        )
        return f"<ul>{''.join(items)}</ul>"


@dataclass(frozen=True, slots=True)
class Section:
    """A heading and what stands under it."""

    title: str
    parts: Sequence[Table | Paragraphs | Links | Listing | Facts | Picture]

    def html(self) -> str:
        """The section, empty parts left out."""
        parts = "".join(_boxed(part) if isinstance(part, Table) else part.html() for part in self.parts)
        return f"<section><h2>{escape(self.title)}</h2>{parts}</section>"


def _boxed(table: Table) -> str:
    """Return a table in a box that scrolls in narrow windows."""
    inner = html_table(table.headers, table.rows, title=table.title, left=table.left)
    notes = "".join(f"<p>{escape(note)}</p>" for note in table.notes)
    label = escape(table.title or "Table", quote=True)
    return (
        f'<div class="scroll" role="region" tabindex="0" aria-label="{label}">{inner}</div>'
        f'<div class="notes">{notes}</div>'
    )


@dataclass(frozen=True, slots=True)
class Page:
    """Content of a report, in the order of the page.

    Parameters
    ----------
    title : str
        Heading.
    about : str
        What was looked at, one line.
    answer : sequence of str
        The answer, three sentences.
    fine : bool
        Whether nothing was found (colors the answer).
    sections : sequence of Section
        Pictures, tables, code, origin.
    """

    title: str
    about: str
    answer: Sequence[str]
    fine: bool
    sections: Sequence[Section] = field(default_factory=tuple)

    def html(self) -> str:
        """The whole document.

        Returns
        -------
        str
            HTML 5, self-contained.
        """
        answer = "".join(f"<p>{escape(sentence)}</p>" for sentence in self.answer)
        body = "".join(section.html() for section in self.sections if section.parts)
        when = datetime.now(UTC).strftime("%Y-%m-%d %H:%M UTC")
        return (
            '<!doctype html>\n<html lang="en">\n<head>\n<meta charset="utf-8">\n'
            '<meta name="viewport" content="width=device-width, initial-scale=1">\n'
            '<meta name="color-scheme" content="light dark">\n'
            f'<meta http-equiv="Content-Security-Policy" content="{_POLICY}">\n'
            f'{_GENERATOR} {escape(__version__)}">\n<link rel="icon" href="data:,">\n'
            f"<title>{escape(self.title)}</title>\n<style>{STYLE}</style>\n</head>\n<body>\n<main>\n"
            f'<header><h1>{escape(self.title)}</h1><p class="about">{escape(self.about)}</p></header>\n'
            f'<section class="answer {"fine" if self.fine else "found"}" aria-label="The answer">{answer}'
            f"</section>\n{body}\n<footer>Written by rcorefine {escape(__version__)} on {when}. "
            "This file holds everything it shows and asks the network for nothing.</footer>\n"
            "</main>\n</body>\n</html>\n"
        )


def write_page(page: Page, path: str | PathLike[str], *, overwrite: bool = False) -> Path:
    """Write a report.

    Parameters
    ----------
    page : Page
        What to write.
    path : str or path
        File. An older report of rcorefine there is replaced; any other file only with
        `overwrite`.
    overwrite : bool
        Replace whatever file is there.

    Returns
    -------
    Path
        The file that was written, absolute.

    Raises
    ------
    FileNotFoundError
        If the folder does not exist.
    FileExistsError
        If a file is there that is no report of rcorefine.
    IsADirectoryError
        If `path` is a folder.
    """
    target = check_target(path, overwrite=overwrite)
    # names may hold what no text can (lone surrogates); it is shown as an escape
    content = page.html().encode("utf-8", errors="backslashreplace")
    with replacing(target) as stream:
        stream.write(content)
    return target


def check_target(
    path: str | PathLike[str],
    *,
    title: str | None = None,
    code: str | None = None,
    overwrite: bool = False,
) -> Path:
    """Absolute path of a report to be written; raises where that must not be.

    Parameters
    ----------
    path : str or path
        File to write.
    title, code : str, optional
        What it is to say, checked with it before the work begins.
    overwrite : bool
        Whether any file there may be replaced.

    Returns
    -------
    Path
        Absolute.

    Raises
    ------
    FileNotFoundError, FileExistsError, IsADirectoryError
        As `write_page`.
    """
    for name, text in (("title", title), ("code", code)):
        if text is not None:
            as_text(text, name)
    as_flag(overwrite, "overwrite")
    target = _home(as_path(path)).absolute()
    if target.is_dir():
        raise IsADirectoryError(f"{target} is a folder; give the name of a file in it, such as report.html")
    if not target.parent.is_dir():
        raise FileNotFoundError(f"the folder {target.parent} does not exist; make it first")
    if target.is_file() and not overwrite:
        with target.open("rb") as file:
            head = file.read(2000)
        if head and _GENERATOR.encode() not in head:  # an empty file holds nothing to lose
            raise FileExistsError(
                f"{target} exists and is no report of rcorefine; choose another name or say overwrite=True"
            )
    return target


def _home(path: Path) -> Path:
    try:
        return path.expanduser()
    except RuntimeError:  # a tilde that is nobody's home is a name like any other
        return path


def reports(kind: type) -> Callable[[_Make], _Make]:
    """Register the function that builds the report of a result class.

    The report is written only if the file may be written.
    """

    def enter(make: _Make) -> _Make:
        def report(
            result: Any, path: Any, *, title: str | None, code: str | None, overwrite: bool, **more: Any
        ) -> Path:
            target = check_target(path, title=title, code=code, overwrite=overwrite)
            return write_page(make(result, title=title, code=code, **more), target, overwrite=overwrite)

        shows(kind, "report")(report)
        return make

    return enter
