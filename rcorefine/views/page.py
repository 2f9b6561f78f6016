"""Report as one HTML file without scripts or external resources.

All text in it is escaped.
"""

from __future__ import annotations

import base64
import hashlib
import io
import platform
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from datetime import UTC, datetime
from html import escape
from importlib.metadata import PackageNotFoundError, version
from os import PathLike
from pathlib import Path
from typing import Any, BinaryIO
from urllib.parse import quote

import control as ct
import matplotlib.pyplot as plt
import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.gridspec import GridSpec
from matplotlib.text import Text

from ..data.frequency_response import FrequencyResponse
from ..exceptions import DataError
from ..jit import NUMBA
from ..systems.linear import Array
from ..version import __version__
from ..writing import REPORT, check_target, replacing
from .tables import TextTable, number

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


# the browser itself refuses whatever would leave the page
_POLICY = "default-src 'none'; img-src data:; style-src 'unsafe-inline'"


#: Name of a picture, what draws it, what it shows.
Picture = tuple[str, Callable[[], ct.ControlPlot], str]


def paragraphs(texts: Iterable[str]) -> str:
    """Sentences as HTML, one paragraph each, escaped."""
    return "".join(f"<p>{escape(text)}</p>" for text in texts)


def listing(code: str) -> str:
    """Return program text as HTML, in a box that scrolls.

    On paper its lines are broken.
    """
    return f'<pre tabindex="0"><code>{escape(code)}</code></pre>'


def facts(rows: Iterable[tuple[str, str]]) -> str:
    """Names and values as an HTML list of definitions, escaped."""
    return "<dl>" + "".join(f"<dt>{escape(k)}</dt><dd>{escape(v)}</dd>" for k, v in rows) + "</dl>"


def links(rows: Iterable[tuple[str, str]]) -> str:
    """Texts, each with a page in the same folder, as an HTML list."""
    items = (f'<li><a href="{escape(quote(page))}">{escape(text)}</a></li>' for text, page in rows)
    return f"<ul>{''.join(items)}</ul>"


def boxed(tables: Iterable[TextTable | Sequence[str]]) -> list[str]:
    """Tables that have rows, in boxes that scroll, and sentences between them."""
    return [
        f'<div class="scroll" role="region" tabindex="0" aria-label="{escape(table.title or "Table")}">'
        f"{replace(table, notes=()).html()}</div>"
        f'<div class="notes">{paragraphs(table.notes)}</div>'
        if isinstance(table, TextTable)
        else paragraphs(table)
        for table in tables
        if not isinstance(table, TextTable) or table.rows
    ]


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
    pictures : sequence of Picture
        Pictures; if the record does not allow one, the reason takes its place.
    tables : sequence of TextTable or of sentences
        Tables, and sentences between them.
    more : dict
        More sections: pieces of HTML by heading.
    code : str
        Code that makes the result again.
    records : sequence of Measurement, or of FrequencyResponse
        What the result rests on.
    """

    title: str
    about: str
    answer: Sequence[str]
    fine: bool
    pictures: Sequence[Picture] = ()
    tables: Sequence[TextTable | Sequence[str]] = ()
    more: Mapping[str, Sequence[str]] = field(default_factory=dict)
    code: str = ""
    records: Sequence[Any] = ()

    def html(self) -> str:
        """The whole document.

        Returns
        -------
        str
            HTML 5, self-contained.
        """
        body = "".join(
            f"<section><h2>{escape(heading)}</h2>{''.join(parts)}</section>"
            for heading, parts in self._sections().items()
            if parts
        )
        when = datetime.now(UTC).strftime("%Y-%m-%d %H:%M UTC")
        return (
            '<!doctype html>\n<html lang="en">\n<head>\n<meta charset="utf-8">\n'
            '<meta name="viewport" content="width=device-width, initial-scale=1">\n'
            '<meta name="color-scheme" content="light dark">\n'
            f'<meta http-equiv="Content-Security-Policy" content="{_POLICY}">\n'
            f'{REPORT} {escape(__version__)}">\n<link rel="icon" href="data:,">\n'
            f"<title>{escape(self.title)}</title>\n<style>{STYLE}</style>\n</head>\n<body>\n<main>\n"
            f'<header><h1>{escape(self.title)}</h1><p class="about">{escape(self.about)}</p></header>\n'
            f'<section class="answer {"fine" if self.fine else "found"}" aria-label="The answer">'
            f"{paragraphs(self.answer)}"
            f"</section>\n{body}\n<footer>Written by rcorefine {escape(__version__)} on {when}. "
            "This file holds everything it shows and asks the network for nothing.</footer>\n"
            "</main>\n</body>\n</html>\n"
        )

    def _sections(self) -> dict[str, Sequence[str]]:
        """Return the sections below the answer, by heading."""
        how = (
            "Save the record as an .npz file (or read your own), give its name below, and run it with Python."
        )
        how = how if "record.npz" in self.code else "Run it with Python."
        origin = [facts(version_facts())]
        if self.records:
            known = "The fingerprints are those of the arrays as little-endian float64, signal by signal."
            origin = [facts(record_facts(self.records)), paragraphs([known]), *origin]
        return {
            "Pictures": [_drawn(*wanted) for wanted in self.pictures],
            "Tables": boxed(self.tables),
            **self.more,
            "Code to reproduce this result": [paragraphs([how]), listing(self.code)] if self.code else [],
            "Record and versions" if self.records else "Versions": origin,
        }


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
    FileNotFoundError, FileExistsError, IsADirectoryError
        As `check_target`.
    """
    target = check_target(path, overwrite=overwrite)
    # names may hold what no text can (lone surrogates); it is shown as an escape
    content = page.html().encode("utf-8", errors="backslashreplace")
    with replacing(target) as stream:
        stream.write(content)
    return target


# ------------------------------------------------------------------ pictures, for wide and for narrow windows
_DPI = 150
_NARROW = 4.3  # inch: at 380 pixels letters of 10 pt are then 12 pixels high
_SWITCH = 640  # pixels of the window below which the narrow picture is shown


def _drawn(name: str, plot: Callable[[], ct.ControlPlot], caption: str) -> str:
    """Return a picture as HTML, or why the record does not allow it."""
    try:
        return draw(plot, caption, caption)
    except DataError as error:
        return paragraphs([f"No picture {name!r}: {error}."])


def draw(plot: Callable[[], ct.ControlPlot], alt: str, caption: str) -> str:
    """Draw a picture in two widths and embed both as HTML.

    Parameters
    ----------
    plot : callable
        Draws and returns the `ControlPlot`; the figure is closed afterwards.
    alt, caption : str
        What is to be seen, for those who do not see it, and what it means.

    Raises
    ------
    DataError
        If the record does not allow this picture.
    """
    before = set(plt.get_fignums())
    try:
        figure = plot().figure
        width, height = (round(float(side) * _DPI) for side in figure.get_size_inches())
        wide = _png(figure)
        _make_narrow(figure)
        return (
            f'<figure><picture><source media="screen and (max-width: {_SWITCH}px)" '
            f'srcset="{_png(figure)}"><img src="{wide}" width="{width}" height="{height}" '
            f'alt="{escape(alt)}"></picture><figcaption>{escape(caption)}</figcaption></figure>'
        )
    finally:
        for number_of in set(plt.get_fignums()) - before:
            plt.close(number_of)


def _png(figure: Any) -> str:
    """Return a figure as an address that holds the PNG."""
    buffer = io.BytesIO()
    write_png(figure, buffer, _DPI)
    return "data:image/png;base64," + base64.b64encode(buffer.getvalue()).decode("ascii")


def write_png(figure: Any, stream: BinaryIO, dpi: float) -> None:
    """Draw a figure on white and write it as PNG.

    `savefig` would draw the figure a second time to lay it out.

    Parameters
    ----------
    figure : matplotlib.figure.Figure
        Figure; it keeps the resolution.
    stream : binary file
        Where the PNG goes.
    dpi : float
        Pixels per inch.
    """
    figure.set_dpi(dpi)
    figure.set_facecolor("white")
    # without the software's name and date the same result gives the same file
    FigureCanvasAgg(figure).print_png(stream, metadata={"Software": None})


def _make_narrow(figure: Any) -> None:
    """Resize a figure for a narrow window.

    Letters keep their size; columns of axes are placed below each other.
    """
    width, height = figure.get_size_inches()
    if width <= _NARROW:
        return
    stacked = _stack(figure)
    height = max(0.8 * height, min(height, _NARROW)) if stacked is None else 1.15 * stacked
    figure.set_size_inches(_NARROW, height)
    for axis in figure.axes:
        legend = axis.get_legend()
        if legend is not None:
            for text in legend.get_texts():
                text.set_fontsize(7)
    for text in figure.findobj(Text):
        if len(text.get_text()) > 40 and not text.get_rotation():
            text.set_wrap(True)


def _stack(figure: Any) -> float | None:
    """Stack axes that are side by side, and return the new height.

    The height is in inches; None if nothing was stacked.
    """
    places = [axis.get_subplotspec() for axis in figure.axes]
    if any(place is None for place in places) or all(place.get_gridspec().ncols == 1 for place in places):
        return None
    # columns that share their x axis or have one heading belong together, other panels are read row by row
    below = [axis for axis, place in zip(figure.axes, places, strict=True) if place.rowspan.start > 0]
    shared = any(len(axis.get_shared_x_axes().get_siblings(axis)) > 1 for axis in figure.axes)
    together = shared or not any(axis.get_title() for axis in below)

    def order(index: int) -> tuple[int, int]:
        row, column = places[index].rowspan.start, places[index].colspan.start
        return (column, row) if together else (row, column)

    total = float(figure.get_size_inches()[1])
    heights = [float(axis.get_tightbbox().height) / figure.dpi for axis in figure.axes]
    heights = [min(max(h, 0.8), total) for h in heights]
    ranks = sorted(range(len(places)), key=order)
    grid = GridSpec(len(ranks), 1, figure=figure, height_ratios=[heights[i] for i in ranks])
    for place, index in enumerate(ranks):
        figure.axes[index].set_subplotspec(grid[place])
    return float(sum(heights))


# ------------------------------------------------------------------ origin: records and versions
_PACKAGES = ("control", "numpy", "scipy", "matplotlib", "numba")


def fingerprint(values: Array) -> str:
    """SHA-256 of an array's numbers: equal records have equal fingerprints.

    Parameters
    ----------
    values : ndarray
        Numbers.

    Returns
    -------
    str
        Of the bytes of the array as little-endian float64, row by row.

    Examples
    --------
    >>> import hashlib, numpy as np
    >>> fingerprint(np.array([1.0])) == hashlib.sha256(bytes.fromhex("000000000000f03f")).hexdigest()
    True
    """
    return hashlib.sha256(np.ascontiguousarray(values, dtype="<f8").tobytes()).hexdigest()


def record_facts(records: Sequence[Any]) -> list[tuple[str, str]]:
    """Names and values that identify the records.

    Parameters
    ----------
    records : sequence of Measurement, or of FrequencyResponse
        What a result rests on.

    Returns
    -------
    list of (str, str)
    """
    if not records[0].in_time:
        return [row for one in records for row in response_facts(one)]
    return [
        fact
        for data in records
        for fact in (
            ("record", data.name),
            ("samples", f"{data.n_samples}, {number(data.dt, 6)} s apart, hold {data.hold!r}"),
            ("time", f"{number(data.timepts[0], 6)} to {number(data.timepts[-1], 6)} s"),
            ("inputs", signal_names(data.input_labels, data.input_units)),
            ("outputs", signal_names(data.output_labels, data.output_units)),
            ("sha256 of the inputs", fingerprint(data.inputs)),
            ("sha256 of the outputs", fingerprint(data.outputs)),
        )
    ]


def response_facts(measured: FrequencyResponse) -> list[tuple[str, str]]:
    """Names and values that identify a measured response."""
    parts, omega = np.stack([measured.response.real, measured.response.imag]), measured.omega
    return [
        ("response", measured.name),
        ("frequencies", f"{omega.size}, {number(omega[0])} to {number(omega[-1])} rad/s"),
        ("inputs", signal_names(measured.input_labels, measured.input_units)),
        ("outputs", signal_names(measured.output_labels, measured.output_units)),
        ("sha256 of the frequencies", fingerprint(measured.omega)),
        ("sha256 of the response", f"{fingerprint(parts)} (real parts, then imaginary parts)"),
    ]


def signal_names(labels: Sequence[str], units: Sequence[str]) -> str:
    """Labels with their units, in one text."""
    return ", ".join(
        f"{label} [{unit}]" if unit else label for label, unit in zip(labels, units, strict=True)
    )


def version_facts() -> list[tuple[str, str]]:
    """Versions of what computed the result.

    Returns
    -------
    list of (str, str)
    """
    rows = [("rcorefine", __version__), ("Python", f"{platform.python_version()} on {platform.system()}")]
    for package in _PACKAGES:
        if package == "numba" and not NUMBA:
            rows.append(("numba", "not used"))
            continue
        try:
            rows.append((package, version(package)))
        except PackageNotFoundError:
            rows.append((package, "version unknown"))
    return rows
