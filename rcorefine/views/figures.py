"""Shared parts of all plots: settings, axes, line styles, legend.

Every plot returns a `ControlPlot`.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any, NamedTuple

import control as ct
import matplotlib as mpl
import matplotlib.pyplot as plt
import numpy as np
from matplotlib.axes import Axes
from matplotlib.legend import Legend
from matplotlib.mathtext import MathTextParser
from matplotlib.text import Text
from matplotlib.ticker import LogFormatter
from numpy.typing import ArrayLike

from ..arguments import as_choice, as_flag, as_mapping, as_text, as_texts, printable, shown
from ..systems.linear import Array

MEASURED = "0.15"
BAND = "0.78"
_WIDTH = 7.0


class Style(NamedTuple):
    """Color, dashes and width of a line.

    The dashes alone distinguish the curves in grayscale.
    """

    color: str
    linestyle: Any
    linewidth: float


_STYLES = (
    Style("#1f4e9c", "--", 1.5),
    Style("#b5400a", "-", 1.3),
    Style("#1b7837", "-.", 1.5),
    Style("#7b3294", ":", 1.8),
    Style("#00798c", (0, (6, 1.5, 1, 1.5, 1, 1.5)), 1.4),
    Style("#8c510a", (0, (9, 3)), 1.4),
)


def style(index: int) -> Style:
    """Line style of curve `index`."""
    return _STYLES[index % len(_STYLES)]


def look_of(index: int, label: str, **more: Any) -> dict[str, Any]:
    """Style and label of curve `index`, as `Axes.plot` takes them."""
    return {**style(index)._asdict(), "label": label, "zorder": 3, **more}


@dataclass(frozen=True, kw_only=True)
class Frame:
    """Axes, labels, settings and legends of one plot.

    They come from the options that all plots share.

    Parameters
    ----------
    ax, label, title, legend_loc, rcParams, show_legend
        As in python-control's plots; checked before anything is drawn.
    """

    ax: Any = None
    label: str | Sequence[str] | None = None
    title: str | None = None
    legend_loc: str | bool | None = None
    rcParams: Mapping[str, Any] | None = None
    show_legend: bool | None = None

    def __post_init__(self) -> None:
        given = [] if self.ax is None else list(np.ravel(np.asarray(self.ax, dtype=object)))
        if not all(isinstance(item, Axes) for item in given) or (self.ax is not None and not given):
            raise ct.ControlArgument(f"ax must hold matplotlib axes and nothing else, not {shown(self.ax)}")
        if self.label is not None and not isinstance(self.label, str):
            object.__setattr__(self, "label", as_texts(self.label, "label"))  # an iterator is read once
        if self.title is not None:
            as_text(self.title, "title")
        if self.legend_loc is not None and self.legend_loc is not False:
            as_choice(self.legend_loc, "legend_loc", Legend.codes)
        if self.show_legend is not None:
            as_flag(self.show_legend, "show_legend")
        try:
            mpl.RcParams(as_mapping(self.rcParams, "rcParams", "matplotlib's settings"))
        except (KeyError, ValueError) as error:
            raise ct.ControlArgument(f"rcParams: {' '.join(str(error).split())}") from error

    @property
    def legends(self) -> bool:
        """Return whether legends are drawn."""
        return bool(self.show_legend or (self.show_legend is None and self.legend_loc is not False))

    @contextmanager
    def settings(self) -> Iterator[None]:
        """Matplotlib settings: python-control's, then the caller's."""
        changed: Any = {**ct.rcParams, **(self.rcParams or {})}
        with plt.rc_context(changed):
            yield
            live = mpl.is_interactive()
        # the first figure loads the backend, and that of a notebook shows figures by themselves from then on
        mpl.interactive(live)

    @contextmanager
    def axes(self, ratios: Sequence[float], n_columns: int, **layout: Any) -> Iterator[tuple[Any, Any]]:
        """Yield the axes, new or given, and an empty list of lines for each.

        Both are arrays of shape (rows, columns).

        Parameters
        ----------
        ratios : sequence of float
            Heights of the rows.
        n_columns : int
            Number of columns.
        **layout
            What `matplotlib.pyplot.subplots` is to be told otherwise, where axes are new.

        Raises
        ------
        control.ControlDimension
            If `ax` has another shape than the picture needs.
        """
        shape = (len(ratios), n_columns)
        with self.settings():
            if self.ax is None:
                width = max(_WIDTH, 3.2 * n_columns)
                height = min(max(0.9 + 1.15 * sum(ratios), 3.0), 24.0)
                usual = {"sharex": "col", "figsize": (width, height), "height_ratios": list(ratios)}
                _, axes = plt.subplots(*shape, squeeze=False, layout="constrained", **(usual | layout))
            else:
                axes = np.atleast_1d(np.asarray(self.ax, dtype=object))
                if axes.size != shape[0] * shape[1] or (axes.ndim == 2 and axes.shape != shape):
                    raise ct.ControlDimension(
                        f"ax holds {axes.shape} axes; this picture needs {shape} (rows, columns)"
                    )
                axes = axes.reshape(shape)
            lines = np.empty(shape, dtype=object)
            for place in np.ndindex(shape):
                lines[place] = []
                axis: Any = axes[place]
                axis.grid(True, alpha=0.3)
                axis.set_axisbelow(True)
            yield axes, lines

    def labels(self, defaults: Sequence[str]) -> list[str]:
        """Labels of the curves: those given, or the defaults."""
        if self.label is None:
            return list(defaults)
        labels = [self.label] if isinstance(self.label, str) else list(self.label)
        if len(labels) != len(defaults):
            raise ct.ControlDimension(f"label: {len(labels)} given for {len(defaults)} curve(s)")
        return [str(text) for text in labels]

    def finish(
        self, axes: Any, lines: Any, title: str | None = None, legends: Sequence[Any] | None = None
    ) -> ct.ControlPlot:
        """Set title and legends and wrap up as `control.ControlPlot`.

        Parameters
        ----------
        axes, lines
            2-D arrays of axes and of lists of lines.
        title : str, optional
            The picture's own title: where none was given, and not in a figure of the caller's.
        legends : sequence of Axes, optional
            Axes that get a legend unless it is switched off; default the first.
        """
        legend = None
        legends = axes.flat[:1] if legends is None else legends
        for axis in legends if self.legends else ():
            handles, labels = axis.get_legend_handles_labels()
            if labels:
                place = self.legend_loc if isinstance(self.legend_loc, str) else "best"
                shown = axis.legend(handles, labels, loc=place, framealpha=0.85)
                legend = shown if legend is None else legend
        figure = axes.flat[0].figure
        heading = title if self.title is None and self.ax is None else self.title
        if heading is not None:
            figure.suptitle(heading)
        return ct.ControlPlot(lines, axes, figure, legend)


class _Short(LogFormatter):
    """Labels as numbers, where matplotlib would label at all."""

    def __call__(self, x: float, pos: int | None = None) -> str:
        return f"{x:g}" if super().__call__(x, pos) else ""


def log_labels(axis: Any) -> None:
    """Set short labels between the decades of a logarithmic axis.

    They read 0.02 and not 2 x 10^-2.
    """
    axis.set_minor_formatter(_Short())


def spell_out(figure: Any) -> None:
    """Show texts literally that are not valid mathtext.

    Texts with control characters are escaped too. Matplotlib would fail to draw the figure otherwise.
    """
    for text in figure.findobj(Text):
        words = str(text.get_text())
        if "$" in words and not _is_mathtext(words):
            words = plain(words.replace(r"\$", "$"))
        if words != text.get_text() or not words.isprintable():
            text.set_text("\n".join(map(printable, words.split("\n"))))


def _is_mathtext(words: str) -> bool:
    try:
        MathTextParser("path").parse(words)
    except ValueError:
        return False
    return True


def plain(text: str) -> str:
    """Text in which dollar signs are kept from mathtext."""
    return text.replace("$", r"\$")


def write_at(axis: Any, text: str, at: Any, offset: tuple[float, float], **look: Any) -> None:
    """Write a text beside a point, so many letter points away."""
    axis.annotate(text, at, xytext=offset, textcoords="offset points", **look)


def unit_text(label: str, unit: str) -> str:
    """Axis label with its unit."""
    return plain(f"{label} [{unit}]" if unit else label)


_TURNS = 200  # crossings of its middle above which a line fills the picture
_CELLS = 120  # of a band
_SHOWN = 50  # crossings in a stretch


def trace(axis: Any, times: Array, values: Array, **look: Any) -> list[Any]:
    """Draw a signal as a line, or as a band if it is too dense.

    The band lies between the extremes of the signal.

    Parameters
    ----------
    axis : Axes
        Where.
    times, values : ndarray of shape (n,)
        The signal; NaN breaks the line.
    **look
        Of the line, as `Axes.plot` takes it.

    Returns
    -------
    list of Line2D
        The line with its arrays, not visible where the band stands for it.
    """
    drawn: list[Any] = axis.plot(times, values, **look)
    if _crossings(values) <= _TURNS:
        return drawn
    starts = np.unique(np.linspace(0, len(values) - 1, _CELLS + 1).astype(int))
    low, high = np.fmin.reduceat(values, starts), np.fmax.reduceat(values, starts)
    line = drawn[0]
    axis.fill_between(
        times[starts], low, high, step="post", alpha=0.8, lw=0.6,
        color=line.get_color(), zorder=line.get_zorder(), label=line.get_label(),
    )  # fmt: skip
    line.set(visible=False, label="_")
    return drawn


def busiest_stretch(times: Array, outputs: Array, residuals: ArrayLike) -> tuple[float, float] | None:
    """Return the stretch of a record where it differs most from the models.

    The stretch is as long as a picture has room for.

    Parameters
    ----------
    times : ndarray of shape (n,)
        Times in s.
    outputs : ndarray of shape (n_y, n)
        What is drawn as lines.
    residuals : array_like of shape (n_models, n_y, n)
        What the models leave.

    Returns
    -------
    tuple of float or None
        Its first and last time in s; None where there is room for all.

    Examples
    --------
    >>> t = np.arange(1000) * 0.01
    >>> busiest_stretch(t, np.sin(t)[None], [[0 * t]]) is None
    True
    """
    turns = max(_crossings(y) for y in outputs)
    if turns <= _TURNS:
        return None
    length = max(int(len(times) * _SHOWN / turns), 2)
    with np.errstate(over="ignore", invalid="ignore"):
        energy = np.sum(np.nan_to_num(np.asarray(residuals)) ** 2, axis=(0, 1))
        total = np.concatenate([[0.0], np.cumsum(energy)])
        first = int(np.argmax(np.nan_to_num(total[length:] - total[:-length])))
    return float(times[first]), float(times[first + length - 1])


def _crossings(values: Array) -> int:
    """Count how often a signal crosses its median."""
    known = values[np.isfinite(values)]
    return int(np.count_nonzero(np.diff(known > np.median(known)))) if known.size else 0
