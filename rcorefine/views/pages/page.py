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

__all__ = [
    "STYLE",
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

#: Pictures are drawn dark on white. In the dark they are inverted and their hues turned back, so that
#: one picture serves both and curves keep their color.
STYLE = """
:root {
  color-scheme: light dark;
  --page: #ffffff; --text: #1b1e22; --soft: #565d66; --line: #d5d9de; --card: #f5f6f8;
  --accent: #1f4e9c; --found: #9a3b07; --fine: #1b6b34;
}
* { box-sizing: border-box; }
html { -webkit-text-size-adjust: 100%; text-size-adjust: 100%; }
body {
  margin: 0; background: var(--page); color: var(--text);
  font: 17px/1.55 system-ui, -apple-system, "Segoe UI", Roboto, "Liberation Sans", Arial, sans-serif;
  overflow-wrap: break-word;
}
main { max-width: 62rem; margin: 0 auto; padding: 1.6rem 1.2rem 3rem; }
h1 { font-size: 1.7rem; line-height: 1.2; margin: 0 0 .3rem; }
h2 {
  font-size: 1.2rem; margin: 2.4rem 0 .6rem; padding-bottom: .25rem; border-bottom: 1px solid var(--line);
}
p { margin: .55rem 0; max-width: 46rem; }
.about { color: var(--soft); margin: 0; }
.answer {
  margin: 1.2rem 0 0; padding: .9rem 1.2rem; background: var(--card);
  border-left: .35rem solid var(--accent); border-radius: .3rem;
}
.answer.found { border-color: var(--found); }
.answer.fine { border-color: var(--fine); }
.answer p { max-width: none; }
.answer p:first-child { font-size: 1.15rem; font-weight: 600; }
figure { margin: 1.4rem 0; }
figure img { display: block; width: 100%; max-width: 56rem; height: auto; border-radius: .3rem; }
figcaption { color: var(--soft); font-size: .94rem; margin-top: .4rem; max-width: 46rem; }
.scroll { overflow-x: auto; margin: .8rem 0; }
table { border-collapse: collapse; font-size: .94rem; font-variant-numeric: tabular-nums; }
caption { text-align: left; font-weight: 600; padding: .2rem 0 .4rem; }
th, td { padding: .28rem .8rem .28rem 0; border-bottom: 1px solid var(--line); vertical-align: top; }
th { font-weight: 600; border-bottom-color: var(--soft); white-space: nowrap; }
td { min-width: 3.5rem; }
td[style*=right] { white-space: nowrap; }
.notes p { color: var(--soft); font-size: .94rem; }
pre {
  margin: .8rem 0; padding: .8rem 1rem; background: var(--card); border-radius: .3rem; overflow-x: auto;
  font: .84rem/1.45 ui-monospace, "SFMono-Regular", Menlo, Consolas, "Liberation Mono", monospace;
  max-height: 34rem; overflow-y: auto;
}
code { font-family: ui-monospace, "SFMono-Regular", Menlo, Consolas, "Liberation Mono", monospace; }
dl {
  display: grid; grid-template-columns: max-content 1fr; gap: .25rem 1.2rem;
  font-size: .94rem; margin: .8rem 0;
}
dt { color: var(--soft); }
dd { margin: 0; min-width: 0; overflow-wrap: anywhere; }
footer { margin-top: 2.6rem; color: var(--soft); font-size: .88rem; }
@media (max-width: 640px) {
  body { font-size: 16px; }
  main { padding: 1.1rem .8rem 2rem; }
  h1 { font-size: 1.4rem; }
  dl { grid-template-columns: 1fr; gap: 0; }
  dd { margin-bottom: .5rem; }
}
@media screen and (prefers-color-scheme: dark) {
  :root {
    --page: #14171b; --text: #e4e7ea; --soft: #a3abb5; --line: #363c44; --card: #1f242a;
    --accent: #7fa8ec; --found: #ef9a63; --fine: #74c68c;
  }
  figure img { filter: invert(.92) hue-rotate(180deg); }
}
@media print {
  @page { margin: 15mm; }
  body { font-size: 10.5pt; }
  main { max-width: none; padding: 0; }
  figure, tr, .answer { break-inside: avoid; }
  h2 { break-after: avoid; }
  pre { white-space: pre-wrap; overflow-wrap: anywhere; max-height: none; overflow: visible; }
  .scroll { overflow: visible; }
  table { font-size: 9pt; }
}
"""


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
