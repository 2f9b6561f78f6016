"""Pictures embedded in a page, for wide and for narrow windows."""

from __future__ import annotations

import base64
import io
from collections.abc import Callable
from dataclasses import dataclass
from html import escape
from typing import Any, BinaryIO

import control as ct
import matplotlib.pyplot as plt
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.gridspec import GridSpec
from matplotlib.text import Text

from ...exceptions import DataError

__all__ = ["Picture", "draw", "write_png"]

_DPI = 150
_NARROW = 4.3  # inch: at 380 pixels letters of 10 pt are then 12 pixels high
_SWITCH = 640  # pixels of the window below which the narrow picture is shown


@dataclass(frozen=True, slots=True)
class Picture:
    """A picture in two widths as PNG, with what it shows in words.

    Parameters
    ----------
    wide, narrow : bytes
        PNG files.
    size : tuple of int
        Width and height of the wide one in pixels.
    alt : str
        What is to be seen, for those who do not see it.
    caption : str
        What it means.
    """

    wide: bytes
    narrow: bytes
    size: tuple[int, int]
    alt: str
    caption: str

    def html(self) -> str:
        """The ``figure`` element, pictures inside, texts escaped."""
        width, height = self.size
        return (
            f'<figure><picture><source media="screen and (max-width: {_SWITCH}px)" '
            f'srcset="{_uri(self.narrow)}"><img src="{_uri(self.wide)}" width="{width}" height="{height}" '
            f'alt="{escape(self.alt, quote=True)}"></picture>'
            f"<figcaption>{escape(self.caption)}</figcaption></figure>"
        )


def draw(plot: Callable[[], ct.ControlPlot], alt: str, caption: str) -> Picture | str:
    """Draw a picture, or say why there is none.

    Parameters
    ----------
    plot : callable
        Draws and returns the `ControlPlot`; the figure is closed afterwards.
    alt, caption : str
        What is to be seen, and what it means.

    Returns
    -------
    Picture or str
        The reason in words, where the record does not allow this picture.
    """
    before = set(plt.get_fignums())
    try:
        figure = plot().figure
        wide, size = _png(figure)
        _make_narrow(figure)
        narrow, _ = _png(figure)
        return Picture(wide, narrow, size, alt, caption)
    except DataError as error:
        return str(error)
    finally:
        for number in set(plt.get_fignums()) - before:
            plt.close(number)


def _png(figure: Any) -> tuple[bytes, tuple[int, int]]:
    buffer = io.BytesIO()
    write_png(figure, buffer, _DPI)
    width, height = (round(float(side) * _DPI) for side in figure.get_size_inches())
    return buffer.getvalue(), (width, height)


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


def _uri(png: bytes) -> str:
    return "data:image/png;base64," + base64.b64encode(png).decode("ascii")
