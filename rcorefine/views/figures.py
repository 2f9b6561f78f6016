"""What all pictures share: settings, axes, line styles, legend, `ControlPlot`."""

from __future__ import annotations

import functools
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import Any, NamedTuple, ParamSpec

import control as ct
import matplotlib as mpl
import matplotlib.pyplot as plt
import numpy as np
from matplotlib.axes import Axes
from matplotlib.legend import Legend
from matplotlib.ticker import LogFormatter

from ..arguments import as_choice, as_flag, as_mapping, as_text, as_texts, shown

__all__ = [
    "BAND",
    "MEASURED",
    "Style",
    "curve_labels",
    "finish",
    "log_labels",
    "make_axes",
    "only_axes",
    "picture",
    "settings",
    "style",
    "unit_text",
]

MEASURED = "0.15"
BAND = "0.78"
_WIDTH = 7.0
_OPTIONS = ("ax", "title", "legend_loc", "rcParams", "show_legend")

Parameters = ParamSpec("Parameters")


class Style(NamedTuple):
    """Color, dashes and width; the dashes alone tell curves apart in grayscale."""

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


def picture(draw: Callable[Parameters, ct.ControlPlot]) -> Callable[Parameters, ct.ControlPlot]:
    """Check the options that all pictures share before anything is drawn."""

    @functools.wraps(draw)
    def checked(*args: Parameters.args, **options: Parameters.kwargs) -> ct.ControlPlot:
        label = options.get("label")
        if label is not None and not isinstance(label, str):
            options["label"] = as_texts(label, "label")  # an iterator is read once
        _check_options(**{name: options.get(name) for name in _OPTIONS})
        return draw(*args, **options)

    return checked


def _check_options(ax: Any, title: Any, legend_loc: Any, rcParams: Any, show_legend: Any) -> None:
    given = [] if ax is None else list(np.ravel(np.asarray(ax, dtype=object)))
    if not all(isinstance(item, Axes) for item in given) or (ax is not None and not given):
        raise ct.ControlArgument(f"ax must hold matplotlib axes and nothing else, not {shown(ax)}")
    if title is not None:
        as_text(title, "title")
    if legend_loc is not None and legend_loc is not False:
        as_choice(legend_loc, "legend_loc", Legend.codes)
    if show_legend is not None:
        as_flag(show_legend, "show_legend")
    try:
        mpl.RcParams(as_mapping(rcParams, "rcParams", "matplotlib's settings"))
    except (KeyError, ValueError) as error:
        raise ct.ControlArgument(f"rcParams: {' '.join(str(error).split())}") from error


@contextmanager
def settings(rcParams: dict[str, Any] | None) -> Iterator[None]:
    """Matplotlib settings: python-control's, then the caller's."""
    changed: Any = {**ct.rcParams, **(rcParams or {})}
    with plt.rc_context(changed):
        yield


def make_axes(ax: Any, ratios: Sequence[float], n_columns: int) -> tuple[Any, Any]:
    """Figure and (rows, columns) array of axes, new or those given.

    Raises
    ------
    control.ControlDimension
        If `ax` has another shape than the picture needs.
    """
    shape = (len(ratios), n_columns)
    if ax is None:
        width = max(_WIDTH, 3.2 * n_columns)
        height = min(max(0.9 + 1.15 * sum(ratios), 3.0), 24.0)
        figure, axes = plt.subplots(
            *shape,
            squeeze=False,
            sharex="col",
            figsize=(width, height),
            layout="constrained",
            gridspec_kw={"height_ratios": list(ratios)},
        )
        return figure, axes
    axes = np.atleast_1d(np.asarray(ax, dtype=object))
    if axes.size != shape[0] * shape[1] or (axes.ndim == 2 and axes.shape != shape):
        raise ct.ControlDimension(f"ax holds {axes.shape} axes; this picture needs {shape} (rows, columns)")
    axes = axes.reshape(shape)
    return axes[0, 0].figure, axes


def only_axes(ax: Any) -> Any:
    """The one axes that a picture of one panel is drawn in."""
    given = np.ravel(np.asarray(ax, dtype=object))
    if given.size != 1:
        raise ct.ControlDimension(f"ax holds {given.size} axes; this picture needs one")
    return given[0]


def curve_labels(label: str | Sequence[str] | None, defaults: Sequence[str]) -> list[str]:
    """Labels of the curves: those given, or the defaults."""
    if label is None:
        return list(defaults)
    labels = [label] if isinstance(label, str) else list(label)
    if len(labels) != len(defaults):
        raise ct.ControlDimension(f"label: {len(labels)} given for {len(defaults)} curve(s)")
    return [str(text) for text in labels]


def finish(
    figure: Any,
    axes: Any,
    lines: Any,
    *,
    title: str | None,
    legends: Sequence[Any],
    legend_loc: str | bool | None,
    show_legend: bool | None,
) -> ct.ControlPlot:
    """Set title and legends and wrap up as `control.ControlPlot`.

    Parameters
    ----------
    figure, axes, lines
        Figure, 2-D array of axes, 2-D object array of lists of lines.
    title : str or None
        Title of the figure; none where None.
    legends : sequence of Axes
        Axes that get a legend unless it is switched off.
    legend_loc, show_legend
        As in python-control's plots.
    """
    legend = None
    if show_legend or (show_legend is None and legend_loc is not False):
        place = legend_loc if isinstance(legend_loc, str) else "best"
        for axis in legends:
            handles, labels = axis.get_legend_handles_labels()
            if labels:
                shown = axis.legend(handles, labels, loc=place, framealpha=0.85)
                legend = shown if legend is None else legend
    if title is not None:
        figure.suptitle(title)
    return ct.ControlPlot(lines, axes, figure, legend)


class _Short(LogFormatter):
    """Labels as numbers, where matplotlib would label at all."""

    def __call__(self, x: float, pos: int | None = None) -> str:
        return f"{x:g}" if super().__call__(x, pos) else ""


def log_labels(axis: Any) -> None:
    """Short labels between the decades of a logarithmic x or y axis: 0.02 and not 2 x 10^-2."""
    axis.set_minor_formatter(_Short())


def unit_text(label: str, unit: str) -> str:
    """Axis label with its unit, dollar signs kept from mathtext."""
    text = f"{label} [{unit}]" if unit else label
    return text.replace("$", r"\$")
