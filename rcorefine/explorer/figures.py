"""Plots of the explorer: time, Bode, missing force, error per step.

Names from files stand in `PlainText` or not at all: bokeh reads formulas in other texts.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import zip_longest
from typing import TYPE_CHECKING, Any

import control as ct
import numpy as np
from bokeh.models import ColumnDataSource, FixedTicker, PlainText, Range1d
from bokeh.plotting import figure

from rcorefine import FrequencyResponse, Measurement

from ..arguments import Array
from ..exceptions import DataError
from .exploration import Exploration, ExplorationStep
from .look import PICTURE

if TYPE_CHECKING:
    from ..comparison.failure_map.state import ResidualForce
    from ..refinement.by_hand import Addition

_RECORD, _INITIAL, _PRESENT = "#8a8f96", "#1f4e9c", "#b5400a"
_LAWS = ("#b5400a", "#1b7837", "#7b3294")
_MOST_DRAWN = 20_000  # points of a curve
_SHOWN = 600  # samples of the stretch that is shown first
_DOTS = 1500  # of the force against the motion
_CELLS = 25


def thinned(t: Array, y: Array, most: int = _MOST_DRAWN) -> tuple[Array, Array]:
    """Reduce a curve to a given number of points.

    Each stretch keeps its least and its largest value at their positions.

    Examples
    --------
    >>> t = np.arange(100.0)
    >>> few, values = thinned(t, np.where(t == 57, 5.0, 0.0), 10)
    >>> few.size <= 10, values.max()
    (True, np.float64(5.0))
    """
    if y.size <= most:
        return t, y
    cells = np.array_split(np.arange(y.size), most // 2)
    kept = np.unique([i for c in cells for i in (c[np.argmin(y[c])], c[np.argmax(y[c])])])
    return t[kept], y[kept]


def _figure(height: int, x: str, y: str, **options: Any) -> Any:
    options |= {"sizing_mode": "stretch_width", "tools": "pan,box_zoom,wheel_zoom,reset"}
    made = figure(height=height, x_axis_label=x, min_border_right=12, **options)
    made.yaxis.axis_label = PlainText(text=y)
    made.axis.axis_label_text_font_style = "normal"
    made.axis.axis_label_text_font_size = made.axis.major_label_text_font_size = "13px"
    made.stylesheets = [PICTURE]
    made.toolbar.update(logo=None, autohide=True)
    return made


def _legend(made: Any, place: str = "top_right") -> None:
    look = {"background_fill_alpha": 0.8, "label_text_font_size": "13px", "padding": 4, "margin": 4}
    made.legend[0].update(location=place, orientation="horizontal", **look)


def _unit(name: str, unit: str) -> str:
    return f"{name} [{unit}]" if unit else name


class TimePicture:
    """Plot of the record, both models and the residual over time.

    The upper axes show the record with the initial and the present model over a stretch of time. The lower
    axes show the residual of the present model.
    """

    def __init__(self, explored: Exploration) -> None:
        self._explored, data = explored, explored.record
        self.output = 0
        names = ("record", "initial", "present", "left")
        self.sources = {name: ColumnDataSource({"t": [], "y": []}) for name in names}
        last = float(data.timepts[min(_SHOWN, data.n_samples) - 1])
        self.x_range = Range1d(float(data.timepts[0]), last)
        self.upper = _figure(300, "time [s]", "", x_range=self.x_range)
        self.lower = _figure(160, "time [s]", "", x_range=self.x_range)
        for name, color, width, dash, where in (
            ("record", _RECORD, 3.5, "solid", self.upper),
            ("initial", _INITIAL, 1.5, "dashed", self.upper),
            ("present", _PRESENT, 1.5, "solid", self.upper),
            ("left", _PRESENT, 1.0, "solid", self.lower),
        ):
            look = {"color": color, "line_width": width, "line_dash": dash}
            text = {} if name == "left" else {"legend_label": name if name == "record" else f"{name} model"}
            where.line("t", "y", source=self.sources[name], **look, **text)
        for made in (self.upper, self.lower):
            made.y_range.only_visible = True
        _legend(self.upper)
        self.show_output(0)

    @property
    def stretch(self) -> float:
        """Length in s of the stretch that is shown first."""
        return float(self.x_range.end - self.x_range.start)

    def begin_at(self, time: float) -> None:
        """Show as long a stretch from another time on."""
        length = self.stretch
        self.x_range.start, self.x_range.end = time, time + length

    def show_output(self, output: int) -> None:
        """Draw another output."""
        self.output, data = output, self._explored.record
        name, unit = data.output_labels[output], data.output_units[output]
        self.upper.yaxis.axis_label = PlainText(text=_unit(name, unit))
        self.lower.yaxis.axis_label = PlainText(text=_unit("residual", unit))
        self._put("record", data.outputs[output])
        self._put("initial", self._explored.steps[0].runs[output])
        self.show(self._explored.steps[-1].runs)

    def show(self, runs: Array) -> None:
        """Draw a run (n_y, N) as that of the present model."""
        self._put("present", runs[self.output])
        self._put("left", self._explored.record.outputs[self.output] - runs[self.output])

    def _put(self, name: str, y: Array) -> None:
        t, y = thinned(self._explored.record.timepts, y)
        self.sources[name].data = {"t": t, "y": y}


class BodePicture:
    """Measured response with its band, and those of the models."""

    def __init__(self, explored: Exploration) -> None:
        self._explored = explored
        self.output = self.input = 0
        x: dict[str, Any] = {"x": "frequency [rad/s]", "x_axis_type": "log"}
        self.upper = _figure(240, y="magnitude", y_axis_type="log", **x)
        x["x_range"] = self.upper.x_range
        self.lower = _figure(170, y="phase [deg]", y_range=Range1d(-190.0, 190.0), **x)
        self.lower.yaxis.ticker = [-180, -90, 0, 90, 180]
        empty: dict[str, list[float]] = {k: [] for k in ("w", "size", "phase", "low", "high")}
        self.sources = {name: ColumnDataSource(empty) for name in _BODE_WORDS}
        measured = self.sources["measured"]
        self.upper.varea("w", "low", "high", source=measured, color=_RECORD, fill_alpha=0.4)
        for made, y in ((self.upper, "size"), (self.lower, "phase")):
            named = {n: {"legend_label": t} if y == "size" else {} for n, t in _BODE_WORDS.items()}
            made.scatter("w", y, source=measured, color=_RECORD, size=4, **named["measured"])
            for name, color, dash in (("initial", _INITIAL, "dashed"), ("present", _PRESENT, "solid")):
                look = {"color": color, "line_width": 1.6, "line_dash": dash}
                made.line("w", y, source=self.sources[name], **look, **named[name])
        _legend(self.upper, "bottom_left")
        self.measured: FrequencyResponse | None = None
        self.why = ""
        try:
            self.measured = explored.record.frequency_response()
        except DataError as error:
            self.why = f"No measured response: {error}"
        self.show()

    def show(self) -> None:
        """Draw the measured response, the initial and the present model."""
        if self.measured is None:
            return
        w, i, j = self.measured.omega, self.output, self.input
        self.upper.xaxis.ticker = self.lower.xaxis.ticker = _ticks(w)
        G, std = self.measured.response[i, j], self.measured.std
        spread = 2.0 * std[i, j] if std is not None else np.zeros(w.size)
        self._put("measured", w, G, spread)
        for name, step in (("initial", self._explored.steps[0]), ("present", self._explored.steps[-1])):
            self._put(name, *_response(self._explored.record, step, self.measured, i, j))

    def _put(self, name: str, w: Array, G: Any, spread: Any = 0.0) -> None:
        size = np.abs(G)
        low = np.maximum(size - spread, 0.05 * size)
        phase = np.degrees(np.angle(G))
        self.sources[name].data = {
            "w": w, "size": size, "phase": phase, "low": low, "high": size + spread
        }  # fmt: skip


def _ticks(w: Array) -> FixedTicker:
    """Return the ticks of a logarithmic axis, at powers of ten.

    If there are few powers, ticks at 2 and 5 lie between them.
    """
    w = w[w > 0]
    first, last = int(np.floor(np.log10(w[0]))), int(np.ceil(np.log10(w[-1])))
    between = (1.0, 2.0, 5.0) if last - first <= 3 else (1.0,)
    powers = 10.0 ** np.arange(first, last + 1)
    ticks, minor = (np.outer(powers, of).ravel().tolist() for of in (between, range(2, 10)))
    return FixedTicker(ticks=ticks, minor_ticks=minor)


_BODE_WORDS = {"measured": "measured, ± 2 std", "initial": "initial model", "present": "present model"}


def _response(
    record: Measurement, step: ExplorationStep, measured: FrequencyResponse, i: int, j: int
) -> tuple[Array, Any]:
    """Return the frequency response of a model, and its frequencies.

    A linear model gives its own response, sampled like the record. The response of any other is estimated
    from its simulation, as that of the record is.
    """
    model = step.refinement
    if all(effect.is_linear for effect in model.effects) or len(model.initial_states) > 1:
        w = np.geomspace(measured.omega[0], min(measured.omega[-1], np.pi / record.dt), 600)
        held = measured.hold in ("zoh", "foh")  # the samples see the plant with its hold
        system = ct.sample_system(model.system, record.dt, measured.hold) if held else model.system
        return w, system(np.exp(1j * w * record.dt) if held else 1j * w, squeeze=False)[i, j]
    run = Measurement(record.inputs, step.runs, dt=record.dt, hold=record.hold).frequency_response()
    return run.omega, run.response[i, j]


class ForcePicture:
    """Plot of the missing force against the motion at a place.

    The force laws of candidate effects are drawn over it.
    """

    def __init__(self) -> None:
        self.figure = _figure(
            300, "", "missing force", x_range=Range1d(-1.0, 1.0), y_range=Range1d(-1.0, 1.0)
        )
        self.dots, self.means, *self.laws = (
            ColumnDataSource({"x": [], "f": []}) for _ in range(2 + len(_LAWS))
        )
        self.figure.scatter("x", "f", source=self.dots, color=_RECORD, size=3, alpha=0.6)
        self.figure.scatter("x", "f", source=self.means, color="#1b1e22", size=7)
        self.lines = [
            self.figure.line("x", "f", source=source, color=color, line_width=2.2)
            for source, color in zip(self.laws, _LAWS, strict=True)
        ]

    def show(self, force: ResidualForce, found: Sequence[Addition]) -> None:
        """Draw the force over the signal that the best law goes by."""
        drawn = [one for one in found if one.curve is not None][: len(_LAWS)]
        x = self._show_axis(force, drawn)
        self.figure.yaxis.axis_label = PlainText(text=_unit("missing force", force.force_unit))
        # samples in the order of the motion, without the ends of the record
        edge = x.size // 50
        order = edge + np.argsort(x[edge : x.size - edge], kind="stable")
        few = order[:: max(order.size // _DOTS, 1)]
        level = float(force.force[order].mean())  # a constant force passes for the offset
        self.dots.data = {"x": x[few], "f": force.force[few] - level}
        for scale, values in ((self.figure.x_range, x[few]), (self.figure.y_range, force.force[few] - level)):
            low, high = np.quantile(values, [0.002, 0.998])
            scale.update(start=low - 0.1 * (high - low), end=high + 0.1 * (high - low) or 1.0)
        # median of the force, and means of the laws, over cells of the motion
        self.means.data = _over_cells(x, force.force - level, np.array_split(order, _CELLS), np.median)
        cells = np.array_split(order, min(200, order.size))
        for source, one in zip_longest(self.laws, drawn):  # one line, also where a law remembers
            curve = x[:0] if one is None or one.curve is None else one.curve - one.curve[order].mean()
            source.data = _over_cells(x, curve, cells if curve.size else [], np.mean)

    def _show_axis(self, force: ResidualForce, drawn: Sequence[Addition]) -> Array:
        """Name the axis of the motion, and return the motion along it."""
        by_place = bool(drawn) and "position" in drawn[0].effect.spec.needs
        over_d = bool(np.ptp(force.position)) and (by_place or not np.ptp(force.velocity))
        what = ("displacement" if over_d else "velocity") if force.mechanical else "state"
        units = force.position_unit if over_d else force.velocity_unit
        self.figure.xaxis.axis_label = PlainText(text=_unit(f"{what} at {force.place}", units))
        return force.position if over_d else force.velocity


def _over_cells(x: Array, f: Array, cells: Sequence[Any], middle: Any) -> dict[str, list[float]]:
    return {"x": [x[c].mean() for c in cells], "f": [middle(f[c]) for c in cells]}


class Staircase:
    """The error after each step."""

    def __init__(self) -> None:
        self.source = ColumnDataSource({"x": [], "error": [], "text": []})
        self.figure = _figure(
            210, "step", "error [%]", x_range=Range1d(-0.6, 3.6), y_range=Range1d(0.0, 100.0)
        )
        self.figure.vbar("x", width=0.8, top="error", source=self.source, color=_INITIAL, fill_alpha=0.75)
        self.figure.text(
            "x", "error", text="text", source=self.source, text_align="center", text_font_size="13px",
            y_offset=-2,
        )  # fmt: skip
        self.figure.xaxis.ticker = [0]

    def show(self, steps: Sequence[ExplorationStep]) -> None:
        """Draw the steps."""
        errors = [step.error for step in steps]
        x = list(range(len(steps)))
        self.figure.xaxis.ticker = x
        self.figure.x_range.update(start=-0.6, end=max(len(steps), 4) - 0.4)
        self.figure.y_range.end = 1.25 * (max(errors) or 1.0)
        self.source.data = {
            "x": x, "error": errors, "text": [f"{e:.3g} %" for e in errors]
        }  # fmt: skip
