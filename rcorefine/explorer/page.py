"""The page of one visitor: a thin view of an `Exploration`."""

from __future__ import annotations

import io
import logging
import re
import secrets
import tempfile
import time
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from html import escape
from pathlib import Path
from typing import TYPE_CHECKING, Any

import control as ct
import panel as pn
from bokeh.models import PrintfTickFormatter
from bokeh.server.auth_provider import NullAuth
from bokeh.util.token import check_token_signature, get_token_payload
from tornado.httputil import HTTPHeaders, HTTPServerRequest
from tornado.web import HTTPError, OutputTransform, RequestHandler

from rcorefine import Check, Diagnosis, Effect

from ..exceptions import RCOError, unheard
from .exploration import Exploration, ExplorationStep
from .figures import BodePicture, ForcePicture, Staircase, TimePicture
from .look import GRID, TEXT, WIDGET

if TYPE_CHECKING:
    from ..comparison.failure_map.search import Failure, FailureMap
    from ..refinement.by_hand import Addition


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
    made = pn.widgets.Button(
        name=_plain(words),
        button_type="primary" if chosen else "default",
        stylesheets=[WIDGET],
        margin=(3, 8),
        **look,
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


#: What wrong values and records raise; anything else is a fault of the program.
EXPECTED = (RCOError, ct.ControlArgument, ct.ControlDimension, OSError)

#: Searches, verdicts and reports of all visitors, one at a time: matplotlib is one for all.
LOOKING = ThreadPoolExecutor(1, "rcorefine-explorer")


class Background:
    """The work of one visitor.

    Attributes
    ----------
    doing : Executor
        Where steps are done, in their order.
    status : panel.pane.HTML
        What is being done, or what went wrong.
    """

    def __init__(self) -> None:
        self.doing = ThreadPoolExecutor(1, "rcorefine-exploration")
        self.status = text("")
        self._doc = pn.state.curdoc
        self._busy: list[str] = []

    @property
    def _served(self) -> bool:
        return self._doc is not None and self._doc.session_context is not None

    def begin(self, work: Callable[[], None]) -> None:
        """Begin when the page is there: what changes before would be lost."""

        def loaded() -> None:
            self._busy.clear()
            work()

        self._busy.append("opening")
        self.say()
        pn.state.onload(loaded)

    def soon(self, work: Callable[[], None]) -> None:
        """Do something quick after a moment, on the thread of the page."""
        if self._served:
            self._doc.add_timeout_callback(work, _PAUSE)
        else:
            work()

    def later(
        self, lane: ThreadPoolExecutor, words: str, work: Callable[[], Any], then: Callable[[Any], None]
    ) -> None:
        """Do work that takes long, say so meanwhile, and show what it found."""

        def run() -> None:
            result, wrong = None, ""
            try:
                with unheard():  # they stand in the results, too
                    result = work()
            except EXPECTED as error:
                wrong = str(error)
            except Exception as error:
                logging.getLogger(__name__).exception(words)
                wrong = f"a fault of the program: {error}"

            def done() -> None:
                self._busy.remove(words)
                if not wrong:
                    then(result)
                self.say(f"{words}: {wrong}" if wrong else "")

            if self._served:  # the page is changed on its own thread
                self._doc.add_next_tick_callback(done)
            else:
                done()

        self._busy.append(words)
        self.say()
        lane.submit(run)

    def say(self, wrong: str = "") -> None:
        """Show what is running and what went wrong."""
        doing = f'<p class="busy">{escape("; ".join(self._busy))} …</p>' if self._busy else ""
        failed = f'<p class="wrong">{escape(wrong)}</p>' if wrong else ""
        self.status.object = f'<div role="status">{failed}{doing or "<p>&nbsp;</p>"}</div>'


_BUTTONS = 6  # candidates that have a button of their own
_PAUSE = 30  # ms in which moves of a slider are taken together


class ExplorerPage:
    """Page of one visitor, with its controls.

    Parameters
    ----------
    explored : Exploration
        State of this visitor, and of nobody else.

    Attributes
    ----------
    root : panel.viewable.Viewable
        The page.
    """

    def __init__(self, explored: Exploration) -> None:
        self.explored = explored
        self._work = Background()
        self._row: Failure | None = None
        self._map: FailureMap | None = None
        self._searched: ExplorationStep | None = None
        self._moving: tuple[Effect, str, float] | None = None
        self._make()
        self._show_step()

        def begin() -> None:
            self._search()
            self._work.later(LOOKING, "checking the record", explored.check, show)

        def show(found: Check) -> None:
            odd = [f"{row.status.upper()}: {row.sentence}" for row in found.looks]
            self._checked.object = paragraphs(odd or ["Nothing odd was found."]) + folded(
                "All checks", found._repr_html_()
            )

        self._work.begin(begin)

    # ------------------------------------------------------------------ what there is
    def _make(self) -> None:
        explored, data = self.explored, self.explored.record
        self._time, self._bode = TimePicture(explored), BodePicture(explored)
        self._force, self._stairs = ForcePicture(), Staircase()
        size = f"{data.n_samples} samples, {data.duration:.3g} s, dt = {data.dt:.4g} s"
        heading = text(
            f"<h1>Model {escape(explored.physical.name)} and record {escape(data.name)}</h1>"
            f'<p class="soft">{size}. {escape(explored.note)}</p>'
        )
        self._error = text("")
        self._fit = button(
            "Fit all added effects",
            partial(self._change, "fitting all added effects", explored.fit),
            wide=False,
        )
        self._undo = button("Undo", partial(self._change, "undo", explored.undo), wide=False)
        self._effects, self._steps = column(), text("")
        self._rows, self._about_row = column(), text('<p class="soft">Search in progress …</p>')
        self._found = column()
        self._verdict, self._checked, self._files = text(""), text(""), column()
        styles = (("curves", self._curves()), ("causes", self._causes()), ("answers", self._answers()))
        for area, part in styles:
            part.styles = {"grid-area": area, "min-width": "0"}
        body = column(*(part for _, part in styles))
        body.stylesheets = [GRID]
        self.root = pn.Column(
            heading, self._error, self._work.status, body, sizing_mode="stretch_width", margin=10
        )

    def _curves(self) -> Any:
        data, time, bode = self.explored.record, self._time, self._bode
        first, last = float(data.timepts[0]), float(data.timepts[-1])
        begin = slider("show from [s]", first, max(last - time.stretch, first + data.dt), first)
        begin.param.watch(lambda event: time.begin_at(event.new), "value")

        def choose(channel: str, index: int) -> None:
            setattr(bode, channel, index)
            if channel == "output":
                time.show_output(index)
            bode.show()

        channels = {"output": data.output_labels, "input of the frequency response": data.input_labels}
        choices = [
            select(words, labels, partial(choose, words.split()[0]))
            for words, labels in channels.items()
            if len(labels) > 1
        ]
        responses = [] if bode.measured is None else [picture(bode.upper), picture(bode.lower)]
        return column(
            title("Record and model in time"), *choices, picture(time.upper), picture(time.lower), begin,
            title("Effects added"), self._effects, pn.Row(self._fit, self._undo, margin=0),
            title("Frequency response"), *responses,
            text(f'<p class="soft">{escape(bode.why or _BODE_NOTE)}</p>'),
        )  # fmt: skip

    def _causes(self) -> Any:
        return column(
            title("Error after each step"), picture(self._stairs.figure), self._steps,
            title("Where the model fails"), self._about_row, self._rows,
            button("Search again with the present model", self._search, wide=False),
            title("Missing force at this place, and candidate effects fitted to it"),
            picture(self._force.figure), self._found,
        )  # fmt: skip

    def _answers(self) -> Any:
        report = button("Make the report", self._report, wide=False)
        code = download("exploration.py", "Python script", lambda: io.StringIO(self.explored.script()))
        return column(
            title("Is anything still missing?"),
            button("Diagnose the present model (some seconds)", self._diagnose, wide=False), self._verdict,
            title("Is anything odd about the record?"), self._checked,
            title("Take it with you"), pn.Row(report, code, margin=0), self._files,
        )  # fmt: skip

    # ------------------------------------------------------------------ steps
    def _show_step(self, rebuild: bool = True) -> None:
        """The present step everywhere; sliders stay where one of them was moved."""
        steps = self.explored.steps
        self._time.show(steps[-1].runs)
        self._bode.show()
        self._stairs.show(steps)
        self._say_error(steps[-1].error)
        rows = "".join(
            f"<tr><td>{k}</td><td>{escape(step.name)}</td><td>{step.error:.3g} %</td></tr>"
            for k, step in enumerate(steps)
        )
        table = f"<table><tr><th>step</th><th>change</th><th>error</th></tr>{rows}</table>"
        said = paragraphs(steps[-1].refinement.warnings)
        self._steps.object = f'<div class="scroll">{table}</div>{said}'
        self._fit.disabled, self._undo.disabled = not self.explored.effects, len(steps) == 1
        if rebuild:
            self._build_sliders()

    def _say_error(self, error: float, words: str = "") -> None:
        first = self.explored.steps[0].error
        verb = "falls" if error < first else "rises"
        if len(self.explored.steps) == 1:
            words = "Error of the initial model:"
        said = f"{words or f'The error {verb} from {first:.3g} % to'} <b>{error:.3g} %</b>"
        self._error.object = f'<p class="error">{said}</p><p class="soft">{_ERROR_NOTE}</p>'

    def _build_sliders(self) -> None:
        parts = []
        for effect in self.explored.effects:
            parts.append(text(f"<p><b>{escape(effect.label)}</b> {escape(effect.explanation)}</p>"))
            units = self.explored.units(effect)
            for name, value in self.explored.coefficients(effect).items():
                words = name if units[name] in ("", "1") else f"{name} [{units[name]}]"
                made = slider(words, *self.explored.reach(effect, name), value)
                made.param.watch(partial(self._moved, effect, name), "value")
                made.param.watch(partial(self._let_go, effect, name, made), "value_throttled")
                parts.append(made)
        self._effects.objects = parts

    def _moved(self, effect: Effect, name: str, event: Any) -> None:
        """Follow a slider: of the moves within a moment the last one counts."""
        waiting, self._moving = self._moving is not None, (effect, name, float(event.new))
        if not waiting:
            self._work.soon(self._preview)

    def _preview(self) -> None:
        if self._moving is None:
            return
        (effect, name, value), self._moving = self._moving, None
        try:
            runs, error = self.explored.preview(effect, **{name: value})
        except EXPECTED as wrong:
            self._work.say(str(wrong))
            return
        self._time.show(runs)
        self._say_error(error, f"The error was {self.explored.error:.3g} %. With this value it is")

    def _let_go(self, effect: Effect, name: str, made: Any, event: Any) -> None:
        value = float(event.new)
        if self.explored.coefficients(effect).get(name) == value:
            return

        def then(_: ExplorationStep) -> None:
            made.start, made.end = self.explored.reach(effect, name)
            self._stepped(rebuild=False)

        self._work.later(
            self._work.doing,
            "estimating offset and initial state",
            partial(self.explored.move, effect, **{name: value}),
            then,
        )

    def _stepped(self, rebuild: bool = True) -> None:
        self._show_step(rebuild)
        self._look_at(self._row)

    def _change(self, words: str, work: Callable[[], ExplorationStep]) -> None:
        self._work.later(self._work.doing, words, work, lambda _: self._stepped())

    def _add(self, one: Addition) -> None:
        work = partial(self.explored.add, one.effect, **one.coefficients)
        self._change(f"adding {one.effect.label}", work)

    # ------------------------------------------------------------------ where it fails
    def _search(self) -> None:
        step, number_of = self.explored.steps[-1], len(self.explored.steps) - 1
        words = f"searching where the model of step {number_of} fails"

        def show(found: FailureMap) -> None:
            self._map, self._searched = found, step
            self._look_at(next(iter(found), None))

        self._work.later(LOOKING, words, lambda: self.explored.comparison.failures, show)

    def _show_rows(self) -> None:
        rows = list(self._map or ())
        self._rows.objects = [
            button(
                f"{row.mark} {row.dimension}: {row.where} ({row.measure}), "
                f"{100 * row.share:.0f} % of the error",
                partial(self._look_at, row),
                chosen=row is self._row,
            )
            for row in rows
        ]
        said = (
            self._row.sentence if self._row is not None else "No significant failure of the model was found."
        )
        sentences = [said]
        if self._searched is not self.explored.steps[-1]:
            sentences.append("This list is from before the last step. The force below is up to date.")
        self._about_row.object = paragraphs(sentences)

    def _look_at(self, row: Failure | None) -> None:
        """Show the force and the candidates of a row."""
        self._row = row
        if self._map is not None:
            self._show_rows()

        def look() -> tuple[Any, Sequence[Addition], Sequence[Addition]]:
            force = self.explored.force(row)
            return force, self.explored.candidates(row, force), self.explored.candidates()

        self._work.later(
            self._work.doing, "fitting effects to the missing force", look, self._show_candidates
        )

    def _show_candidates(self, found: tuple[Any, Sequence[Addition], Sequence[Addition]]) -> None:
        force, here, every = found
        if force is not None:
            self._force.show(force, here)
        said = _CHANNEL_NOTE if force is None else _FORCE_NOTE
        buttons = []
        for k, one in enumerate(here[:_BUTTONS]):
            share = where = ""
            if one.curve is not None:
                share = f": explains {100 * one.share:.0f} % of this force"
                where = f" ({_COLORS[k]} line)" if k < 3 else ""
            units = {name: unit.removeprefix("1") for name, unit in self.explored.units(one.effect).items()}
            values = [f"{n} {v:.3g} {units[n]}".rstrip() for n, v in one.coefficients.items()]
            words = f"Add {one.effect.label}{share}{where}, {', '.join(values)}"
            buttons.append(button(words, partial(self._add, one)))
        other = select("any other effect", [one.effect.label for one in every])
        add = button("Add it", lambda: self._add(every[other.value]), wide=False)
        rest = [pn.Row(other, add, margin=0)] if every else []
        self._found.objects = [text(f'<p class="soft">{said}</p>'), *buttons, *rest]

    # ------------------------------------------------------------------ verdict, check, files
    def _diagnose(self) -> None:
        def show(found: Diagnosis) -> None:
            said = paragraphs(found.sentences()) + folded("Ranking and tests", found._repr_html_())
            self._verdict.object = f"<p><b>{found.verdict.upper()}</b></p>{said}"

        self._verdict.object = '<p class="busy">testing the residual and refitting candidates …</p>'
        self._work.later(LOOKING, "diagnosing", self.explored.diagnose, show)

    def _report(self) -> None:
        def make() -> bytes:
            with tempfile.TemporaryDirectory() as folder:
                return self.explored.report(Path(folder, "report.html")).read_bytes()

        def show(content: bytes) -> None:
            words = f"Download the report of step {len(self.explored.steps) - 1}"
            self._files.objects = [download("report.html", words, partial(io.BytesIO, content))]

        self._work.later(LOOKING, "making the report", make, show)


_ERROR_NOTE = (
    "Error of the simulation from the initial state (free run), relative to the spread of the outputs: "
    "100 % minus the fit. Offset and initial state are estimated."
)
_COLORS = ("orange", "green", "violet")
_CHANNEL_NOTE = "No force acts at an input or an output, so none is plotted. These effects are possible:"
_FORCE_NOTE = (
    "Small dots: force estimated from the record, smoothed because of the sensor noise. Large dots: its "
    "median. The percentage refers to the plotted force. Use the diagnosis to identify the effect, not this "
    "plot."
)
_BODE_NOTE = (
    "If the present model has nonlinear effects, its response is estimated from its simulation, like that of "
    "the record."
)


class Visitors(NullAuth):  # type: ignore[misc]
    """Access control that admits only visitors of the server's addresses.

    It acts before anything is built for the request.
    A page of another origin is refused, whether it fetches, embeds or loads this one as a picture; so is a
    name that leads here but is none of the server's (DNS rebinding), and a session that the address names.

    Parameters
    ----------
    hosts : sequence of str
        Names of the server, with its port.
    """

    login_url = "/"  # asked for where visitors are looked at

    def __init__(self, hosts: Sequence[str]) -> None:
        self._hosts = hosts
        super().__init__()

    async def get_user_async(self, asking: RequestHandler) -> str:
        """Return the name of a visitor who may enter.

        bokeh awaits it before it answers a request.
        """
        request = asking.request
        host, headers = request.host, request.headers
        origin, site = headers.get("Origin", f"http://{host}"), headers.get("Sec-Fetch-Site", "none")
        clicked = headers.get("Sec-Fetch-Mode") == "navigate" and headers.get("Sec-Fetch-User") == "?1"
        own = host in self._hosts and origin.removeprefix("http://") in self._hosts
        if not own or not (clicked or site in ("none", "same-origin")):
            raise HTTPError(403, reason="the page is not for other pages; open its own address")
        if any(name.startswith("bokeh-") for name in (*request.arguments, *map(str.lower, headers))):
            raise HTTPError(403, reason="a session is not taken from a request; open the bare address")
        if request.path == "/ws":  # bokeh opens the socket first, and then fails at what is no token of it
            try:
                token = re.fullmatch("bokeh, (.*)", headers["Sec-WebSocket-Protocol"])[1]  # type: ignore[index]
                late = get_token_payload(token)["session_expiry"] <= time.time()
                key = asking.application.secret_key  # type: ignore[attr-defined]
                known = not late and check_token_signature(token, key, True)
            except Exception:  # it may be any text
                known = False
            if not known:
                raise HTTPError(400, reason="the page is no longer known; load it again")
        return "visitor"


class Policy(OutputTransform):
    """Refusal of strange requests, and content security policy of the pages.

    It tells the browser what a page may load and run: files of the server, and the scripts in the page.
    """

    def __init__(self, request: HTTPServerRequest) -> None:
        self._request, self._method = request, request.method
        # tornado fails at a zero byte in the name of a file, but not where it does not know the method
        if request.method not in ("GET", "HEAD") or "%00" in request.path:
            request.method = "REFUSED"

    def transform_first_chunk(
        self, status_code: int, headers: HTTPHeaders, chunk: bytes, finishing: bool
    ) -> tuple[int, HTTPHeaders, bytes]:
        """Add the policy to the headers, and its nonce to the page's scripts."""
        self._request.method = self._method  # an answer to HEAD has no body
        nonce = secrets.token_urlsafe(16)
        if headers.get("Content-Type", "").startswith("text/html"):
            chunk = re.sub(rb"<script\b", f'<script nonce="{nonce}"'.encode(), chunk)
            headers["Content-Length"] = str(len(chunk))
        headers["Content-Security-Policy"] = (
            f"default-src 'none'; script-src 'self' blob: 'nonce-{nonce}'; style-src 'self' 'unsafe-inline'; "
            f"connect-src 'self' ws://{self._request.host}; img-src 'self' data: blob:; "
            "font-src 'self' data:; base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
        )
        headers["X-Content-Type-Options"], headers["Referrer-Policy"] = "nosniff", "no-referrer"
        return status_code, headers, chunk
