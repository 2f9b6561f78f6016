"""The explorer's page in a browser: what is shown, clicked, typed and dragged."""

from __future__ import annotations

import dataclasses
import http.client
import json
import os
import re
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import control as ct
import numpy as np
import pytest
from cases import slow
from chromium_pipe import CHROMIUM, Browser

import rcorefine as rco
from rcorefine.explorer import Exploration

pytest.importorskip("panel", reason="the extra explore is not installed")

WAIT = 90.0  # s, on a busy machine
EVIL = "<img src=x onerror=alert(1)><script>alert(2)</script>\n$$\\frac{a}{b}$$"


def chain(stiffness=100.0, **options):
    return rco.mass_spring_damper([1.0], [0.4], [stiffness], sensors="displacement", **options)


def record(n=800, stiffness=90.0, seed=0, **names):
    rng = np.random.default_rng(seed)
    force = 10 * rng.standard_normal(n)
    y = rco.simulate(chain(stiffness), rco.Measurement(force, np.zeros(n), dt=0.02), "zero").outputs[0]
    given = {"input_labels": "force", "output_labels": "q1", "output_units": "m"} | names
    return rco.Measurement(force, y + 0.02 * y.std() * rng.standard_normal(n), dt=0.02, **given)


# ------------------------------------------------------------------ served by the command
MODEL = (
    '[mass_spring_damper]\nm = [1.0]\nc = [0.4]\nk = [100.0]\nsensors = "displacement"\noutputs = ["q1"]\n'
)


def _heeds_interruption() -> None:
    """As at a terminal: what a script begins in the background ignores Ctrl-C, and hands that on."""
    signal.signal(signal.SIGINT, signal.SIG_DFL)


class Served:
    """The command in a process of its own."""

    def __init__(self, folder: Path, data: rco.Measurement) -> None:
        (folder / "model.toml").write_text(MODEL)
        np.savez(folder / "record.npz", force=data.inputs[0], q1=data.outputs[0])
        words = [sys.executable, "-m", "rcorefine", "explore", "model.toml", "record.npz", "--dt", "0.02"]
        words += ["--input", "force", "--output", "q1", "--no-browser"]
        self.process = subprocess.Popen(
            words, cwd=folder, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
            env=dict(os.environ), preexec_fn=_heeds_interruption,
        )  # fmt: skip
        line = self.process.stdout.readline()
        if not line.startswith("Explorer at "):
            raise AssertionError(line + self.process.communicate()[1])
        self.address = line.split()[2]
        self.port = int(re.search(r":(\d+)/", self.address)[1])

    def close(self) -> int:
        self.process.send_signal(signal.SIGINT)
        self.process.communicate(timeout=WAIT)
        return self.process.returncode


@pytest.fixture(scope="module")
def served(tmp_path_factory) -> Iterator[Served]:
    one = Served(tmp_path_factory.mktemp("explorer"), record())
    yield one
    one.process.kill()
    one.process.communicate()


# ------------------------------------------------------------------ a visitor
ALL = """const all = (s, r = document) => [...r.querySelectorAll(s),
  ...[...r.querySelectorAll('*')].flatMap(e => e.shadowRoot ? all(s, e.shadowRoot) : [])];
const shown = e => e.getClientRects().length > 0;
const text = s => all(s).filter(shown).map(e => e.innerText.trim());
"""


class Visitor(Browser):
    """A browser with the page open."""

    def open(self, address: str, *, width: int = 1400, scheme: str = "light") -> None:
        self.show(address, width=width, scheme=scheme)
        self.until("text('.error').length", "the page")

    def js(self, expression: str):
        return self.evaluate(f"(() => {{ {ALL} return {expression}; }})()")

    def until(self, expression: str, what: str = ""):
        end = time.monotonic() + WAIT
        while not (value := self.js(expression)):
            assert time.monotonic() < end, f"{what or expression} does not come: {self.js('text(`p`)')}"
            time.sleep(0.05)
        return value

    def settled(self) -> None:
        """Until nothing is being worked at."""
        self.until("!text('.busy').length", "rest")

    def press(self, start: str) -> None:
        """Click the button whose text begins so."""
        named = f"b.innerText.trim().startsWith({json.dumps(start)})"
        find = f"all('button').find(b => shown(b) && !b.disabled && {named})"
        self.until(f"(b => b ? (b.click(), true) : false)({find})", f"button {start!r}")

    def key(self, name: str) -> None:
        codes = {"Tab": 9, "Enter": 13, "ArrowRight": 39}
        more = {"text": "\r"} if name == "Enter" else {}
        for kind in ("keyDown", "keyUp"):
            self.call(
                "Input.dispatchKeyEvent",
                type=kind, key=name, code=name, windowsVirtualKeyCode=codes[name],
                **(more if kind == "keyDown" else {}),
            )  # fmt: skip

    def focused(self) -> str:
        """Text of what has the focus, looked for in all shadow roots."""
        deep = (
            "(() => {let e = document.activeElement; while (e && e.shadowRoot && e.shadowRoot.activeElement)"
        )
        return self.evaluate(
            deep + " e = e.shadowRoot.activeElement; return e ? e.innerText || e.tagName : '';})()"
        )

    @property
    def error(self) -> float:
        """Percentage in the headline."""
        return float(re.search(r"([\d.]+) %$", self.js("text('.error')")[0])[1])

    @property
    def complaints(self) -> list[str]:
        """Errors and warnings of the console; that this machine has no graphics card is none."""
        found = [json.loads(message) for message in self.messages]
        found = [one for one in found if one.get("entry", {}).get("source") != "rendering"]
        return [str(one) for one in found if one.get("type") not in ("log", "info", "debug")]

    @property
    def outside(self) -> list[str]:
        """What was asked of anybody but the server."""
        return [
            url
            for url in self.requests
            if not re.match(r"(http://127\.0\.0\.1:\d+/|data:|blob:http://127)", url)
        ]


@pytest.fixture(scope="module")
def visitor() -> Iterator[Visitor]:
    if CHROMIUM is None:
        pytest.skip("no chromium here (Debian: apt-get install chromium)")
    opened = Visitor()
    yield opened
    opened.close()


@pytest.mark.browser
def test_add_fit_move_undo(served, visitor):
    """What a user does: the shown error falls to what refine says, and comes back."""
    visitor.open(served.address)
    visitor.settled()
    model, data = chain(), record()
    start = 100.0 - rco.refine(model, data).fit[0]
    assert visitor.error == pytest.approx(start, rel=0.01)
    visitor.press("Add stiffness at link1")
    visitor.until("text('.error')[0].startsWith('The error ')")
    added = visitor.error
    visitor.press("Fit all added effects")
    fitted = 100.0 - rco.refine(model, data, [rco.Effect("stiffness", "link1")]).fit[0]
    visitor.until(f"text('.error')[0].endsWith('to {fitted:.3g} %')", f"the error {fitted:.3g} %")
    visitor.settled()
    # a slider, by the keyboard: the curve's error follows, then a step of its own
    visitor.js("all('.noUi-handle').filter(shown).slice(-1)[0].focus() || 0")
    handles = visitor.js("all('.noUi-handle').filter(shown).length")
    assert handles == 2  # the stretch that is shown, and the coefficient
    for _ in range(10):
        visitor.key("ArrowRight")
    visitor.until("text('td').some(t => t === 'move stiffness at link1')", "a step by hand")
    visitor.settled()
    assert visitor.error > 1.5 * fitted
    for expected in (fitted, added, start):
        visitor.press("Undo")
        visitor.until(f"text('.error')[0].endsWith('{expected:.3g} %')", f"the error {expected:.3g} %")
    visitor.settled()
    assert visitor.js("text('td').includes('initial model')")
    assert visitor.complaints == [], "\n".join(visitor.complaints)
    assert visitor.outside == []


@pytest.mark.browser
def test_verdict_and_files(served, visitor):
    visitor.open(served.address)
    visitor.settled()
    visitor.press("Diagnose the present model")
    said = visitor.until("text('p').find(t => ['PARAMETERS', 'EFFECT', 'AMBIGUOUS'].includes(t))")
    assert said == rco.diagnose(chain(), record()).verdict.upper()
    assert visitor.js("text('summary').includes('All checks')")
    visitor.press("Make the report")
    visitor.until("all('a').some(a => shown(a) && a.innerText.includes('report of step 0'))", "the report")
    visitor.settled()
    assert visitor.complaints == [], "\n".join(visitor.complaints)


@pytest.mark.browser
@pytest.mark.parametrize("scheme", ["light", "dark"])
@pytest.mark.parametrize("width", [700, 1400])
def test_fits_the_window_and_the_theme(served, visitor, width, scheme):
    visitor.open(served.address, width=width, scheme=scheme)
    visitor.settled()
    reach = visitor.js("document.documentElement.scrollWidth")
    assert reach <= width, "the page scrolls sideways"
    pictures = visitor.js("all('.bk-Figure').filter(shown).map(e => e.clientWidth)")
    assert len(pictures) == 6
    assert all(300 < size <= width for size in pictures)
    ground = visitor.js("getComputedStyle(document.body).backgroundColor")
    assert (ground == "rgb(255, 255, 255)") == (scheme == "light")
    inverted = visitor.js("all('.bk-Figure').map(e => getComputedStyle(e).filter !== 'none')")
    assert inverted
    assert set(inverted) == {scheme == "dark"}
    assert visitor.complaints == [], "\n".join(visitor.complaints)
    assert visitor.outside == []


@pytest.mark.browser
def test_by_keyboard_alone(served, visitor):
    """Tab reaches a candidate, Enter adds it."""
    visitor.open(served.address)
    visitor.settled()
    for _ in range(80):
        visitor.key("Tab")
        if visitor.focused().startswith("Add "):
            break
    assert visitor.focused().startswith("Add ")
    visitor.key("Enter")
    visitor.until("text('td').some(t => t.startsWith('add '))", "a step")
    visitor.settled()


@pytest.mark.browser
def test_a_second_visitor_has_a_state_of_his_own(served, visitor):
    visitor.open(served.address)
    visitor.settled()
    visitor.press("Add stiffness at link1")
    visitor.until("text('td').some(t => t.startsWith('add '))", "a step")
    other = Visitor()
    try:
        other.open(served.address)
        assert not other.js("text('td').some(t => t.startsWith('add '))")
        assert other.js("text('.error')[0].startsWith('Error of the initial model')")
    finally:
        other.close()
    assert visitor.js("text('td').some(t => t.startsWith('add '))")


#: what panel and bokeh warn of in this process is theirs
THEIRS = pytest.mark.filterwarnings("ignore")


@pytest.mark.browser
@THEIRS
def test_names_from_strangers_are_text(visitor):
    """Names of model, record, signals, with markup, formulas and line breaks."""
    data = record(400, name=EVIL, input_labels=EVIL + "u", output_labels=EVIL + "y", output_units=EVIL[:28])
    model = chain(name=EVIL, inputs=EVIL + "u", outputs=EVIL + "y")
    page = rco.explore(model, data)
    try:
        visitor.open(page.show(browser=False))
        visitor.settled()
        assert "<img src=x" in visitor.js("text('h1')")[0]
        assert visitor.js("all('img').length") == 0
        assert "x" not in {url.rsplit("/", 1)[-1] for url in visitor.requests}
        place = visitor.js("all('select').flatMap(s => [...s.options].map(o => o.text))")
        assert any("<img src=x" in option for option in place)
        assert visitor.complaints == [], visitor.complaints
        assert visitor.outside == []
    finally:
        page.close()


@pytest.mark.browser
@THEIRS
def test_a_unit_with_a_formula_in_it_is_text(visitor):
    """Bokeh makes HTML of a slider's title that holds a formula, with all that stands beside it."""
    plain = ct.ss(
        [[0, 1], [-100, -0.4]], [[0], [1]], [[1, 0]], 0, inputs="force", outputs="q1", states=["x", "v"]
    )
    units = {"x": "$$a$$<img src=evil>", "q1": "m", "force": "N"}
    model = rco.physical(plain, links={"link1": {"x": 1.0}}, units=units)
    page = rco.explore(model, record(400))
    page._new = lambda: added(Exploration(model, record(400)), rco.Effect("clearance", "link1"))
    try:
        visitor.open(page.show(browser=False))
        visitor.settled()
        titles = visitor.js("all('.bk-slider-title').map(e => e.textContent)")
        assert any("a$\N{WORD JOINER}$<img src=evil>]" in title for title in titles), titles
        assert visitor.js("all('img').length") == 0
        assert "evil" not in {url.rsplit("/", 1)[-1] for url in visitor.requests}
        assert visitor.complaints == []
    finally:
        page.close()


def added(explored, effect):
    explored.add(effect)
    return explored


@pytest.mark.browser
@THEIRS
def test_twenty_thousand_samples(visitor):
    """Shown and clickable; how fast is measured, and said with -s."""
    page = rco.explore(chain(), record(20_000))
    try:
        address = page.show(browser=False)
        start = time.monotonic()
        visitor.open(address)
        visitor.until("all('.bk-Figure').filter(shown).length === 6", "the pictures")
        print(f"20,000 samples shown after {time.monotonic() - start:.2f} s")
        assert visitor.error > 10
    finally:
        page.close()


# ------------------------------------------------------------------ without a browser
def upgrade(port: int, origin: str, *more: str) -> int:
    """Status of a request for a websocket from a page of some origin, with further headers."""
    token = socket.create_connection(("127.0.0.1", port), timeout=WAIT)
    lines = [
        "GET /ws HTTP/1.1", f"Host: 127.0.0.1:{port}", "Upgrade: websocket", "Connection: Upgrade",
        "Sec-WebSocket-Key: dGhlIHNhbXBsZSBub25jZQ==", "Sec-WebSocket-Version: 13",
        f"Origin: {origin}", *more,
    ]  # fmt: skip
    token.sendall(("\r\n".join(lines) + "\r\n\r\n").encode())
    answer = token.recv(200).decode(errors="replace")
    token.close()
    return int(answer.split()[1])


def test_no_other_origin_is_served(served):
    for origin in ("http://example.org", "http://127.0.0.1:1", f"http://example.org:{served.port}", "null"):
        assert upgrade(served.port, origin) == 403
    for host in ("127.0.0.1", "localhost"):  # no session token: refused later, and not for its origin
        assert upgrade(served.port, f"http://{host}:{served.port}") != 403


def answer(port: int, path: str = "/", **headers: str) -> tuple[int, str, http.client.HTTPMessage]:
    """Status, reason and headers of a request."""
    ask = http.client.HTTPConnection("127.0.0.1", port, timeout=WAIT)
    ask.request("GET", path, headers={name.replace("_", "-"): value for name, value in headers.items()})
    found = ask.getresponse()
    ask.close()
    return found.status, found.reason, found.headers


@THEIRS
def test_a_page_is_built_for_its_own_address_alone(monkeypatch):
    """Not for a foreign page's picture, frame or script, for a name that leads here, for a given session."""
    page, built = rco.explore(chain(), record(200)), []
    new = page._new
    monkeypatch.setattr(page, "_new", lambda: built.append(1) or new())
    port = int(page.show(browser=False).rsplit(":", 1)[1].strip("/"))
    own = f"http://127.0.0.1:{port}"
    try:
        for path, headers in (
            ("/", {"Host": f"evil.example:{port}"}),
            ("/", {"Host": "127.0.0.1"}),
            ("/", {"Origin": "http://evil.example"}),
            ("/", {"Origin": "null"}),
            ("/", {"Origin": f"https://127.0.0.1:{port}"}),
            ("/", {"Sec_Fetch_Site": "cross-site", "Sec_Fetch_Mode": "no-cors", "Sec_Fetch_Dest": "image"}),
            ("/", {"Sec_Fetch_Site": "cross-site", "Sec_Fetch_Mode": "navigate", "Sec_Fetch_Dest": "iframe"}),
            ("/", {"Sec_Fetch_Site": "same-site", "Sec_Fetch_Mode": "cors"}),
            ("/?bokeh-session-id=mine", {}),
            ("/?bokeh-token=mine", {}),
            ("/", {"Bokeh_Session_Id": "mine"}),
            ("/autoload.js?bokeh-autoload-element=x", {"Origin": "http://evil.example"}),
            ("/autoload.js?bokeh-autoload-element=x&bokeh-session-id=mine", {}),
        ):
            assert answer(port, path, **headers)[0] == 403, (path, headers)
        assert built == []
        typed = {"Sec_Fetch_Site": "none", "Sec_Fetch_Mode": "navigate", "Sec_Fetch_User": "?1"}
        clicked = {**typed, "Sec_Fetch_Site": "cross-site"}  # a link in the terminal of a browser
        for headers in ({}, {"Host": f"localhost:{port}"}, {"Origin": own}, typed, clicked):
            assert answer(port, **headers)[0] == 200, headers
        assert len(built) == 5
    finally:
        page.close()


PATHS = (
    "/ws", "/autoload.js", "/metadata", "/static/", "/static/js/bokeh.min.js", "/static/%00",
    "/static/js/%00.js", "/static/extensions/panel/%00", "/static/%ff", "/static/%2e%2e/x",
    f"/static/{5000 * 'a'}", f"/{300 * '%2F'}", "//", "*", "/x%00", "/%zz", "/login", "http://x/",
    "/components/%00",
)  # fmt: skip
METHODS = (*8 * ("GET",), "HEAD", "POST", "PUT", "OPTIONS", "BREW", "get", "CONNECT")
NAMES = ("theme", "v", "bokeh-token", "bokeh-session-id", "bokeh-autoload-element", "%ff", "resources")
VALUES = ("", "a", "%00", "%ff", 3000 * "a", "[]", "1e999", "<script>", "%0d%0a")
FIELDS = (
    "Range: bytes=5-2", "Range: x", "If-Modified-Since: Thu, 99 Jan 99999", 'If-None-Match: \xff"',
    "Cookie: \x80=\xff;", "Content-Length: -1", "Content-Length: x", "Transfer-Encoding: gzip",
    f"X: {90_000 * 'y'}", "Origin: null", "Content-Type: multipart/form-data", "bad header",
    "Host: [::1", "Host: a", "Bokeh-Session-Id: x",
    "Sec-WebSocket-Extensions: permessage-deflate; client_max_window_bits=x",
)  # fmt: skip
TOKENS = (
    "x",
    "!!!!",
    "YWJj",
    "YWJj.YWJj",
    "e30",
    "bnVsbA",
    "W10",
    "\xe9",
    5000 * "a",
    "bokeh",
    "a, b",
    "",
    "e30=.x",
    "eyJzZXNzaW9uX2lkIjoieCIsInNlc3Npb25fZXhwaXJ5Ijo5OTk5OTk5OTk5OTl9",  # {"session_id": "x", ...}, unsigned
    "eyJzZXNzaW9uX2lkIjoxLCJzZXNzaW9uX2V4cGlyeSI6Im5ldmVyIn0",  # {"session_id": 1, "session_expiry": "never"}
)
FRAMES = (
    b"\x81\x85\0\0\0\0hello",
    50 * b"\xff",
    b"\x82\xfe\xff\xff",
    b"\x81\x82\0\0\0\0{}",
    b"\x88\x80\0\0\0\0",
)


def strange_request(rng: np.random.Generator, port: int) -> str:
    """A request that no page makes."""

    def pick(values):
        return values[rng.integers(len(values))]

    fields = [f"Host: 127.0.0.1:{port}", *(pick(FIELDS) for _ in range(rng.integers(3)))]
    if rng.random() < 0.4:
        key, version = pick(("dGhlIHNhbXBsZSBub25jZQ==", "x", "")), pick(("13", "13", "13", "x", "99"))
        kind = pick(("bokeh, ", "bokeh,", "", "x, "))
        fields += [f"Sec-WebSocket-Key: {key}", f"Sec-WebSocket-Version: {version}", "Connection: Upgrade"]
        fields += [f"Sec-WebSocket-Protocol: {kind}{pick(TOKENS)}", f"Upgrade: {pick(('websocket', 'h2c'))}"]
        first = "GET /ws"
    else:
        query = "&".join(f"{pick(NAMES)}={pick(VALUES)}" for _ in range(rng.integers(3)))
        first = f"{pick(METHODS)} {pick(PATHS)}?{query}".rstrip("?")
    return "\r\n".join([f"{first} HTTP/{pick(('1.1', '1.1', '1.0', 'x'))}", *fields, "", ""])


@THEIRS
@pytest.mark.parametrize("count", [60, *slow(500)])
def test_no_request_is_a_fault(count, caplog):
    """What is strange is refused with 4xx or a closed connection, and the log holds no traceback."""
    page = rco.explore(chain(), record(200))
    port = int(page.show(browser=False).rsplit(":", 1)[1].strip("/"))
    rng, found = np.random.default_rng(count), {}
    try:
        with socket.create_connection(("127.0.0.1", port), timeout=WAIT) as ask:
            ask.sendall(f"GET / HTTP/1.0\r\nHost: 127.0.0.1:{port}\r\n\r\n".encode())
            shown = b"".join(iter(lambda: ask.recv(1 << 16), b"")).decode()
        token = re.search(r'"token":"([^"]+)"', shown)[1]
        requests = [strange_request(rng, port) for _ in range(count)]
        upgrade = (
            f"GET /ws HTTP/1.1\r\nHost: 127.0.0.1:{port}\r\nUpgrade: websocket\r\nConnection: Upgrade\r\n"
            "Sec-WebSocket-Key: dGhlIHNhbXBsZSBub25jZQ==\r\nSec-WebSocket-Version: 13\r\n"
            "Sec-WebSocket-Protocol: "
        )
        for words, status in ((f"bokeh, {token}", 101), (f"x, {token}", 400), (token, 400)):
            found[upgrade + words + "\r\n\r\n"] = status
        for request in [*found, *requests]:
            with socket.create_connection(("127.0.0.1", port), timeout=WAIT) as ask:
                ask.sendall(request.encode("latin-1"))
                ask.shutdown(socket.SHUT_WR) if request not in found else None
                said = ask.recv(200).decode("latin-1")
                if " 101 " in said:
                    ask.sendall(FRAMES[rng.integers(len(FRAMES))])
            status = int(said.split()[1]) if said.startswith("HTTP/") else 400
            assert status == found.get(request, status), request[:300]
            assert status < 500, request[:300]
    finally:
        page.close()
    assert [record.getMessage() for record in caplog.records if record.exc_info] == []


def test_the_page_runs_no_script_but_its_own(served):
    status, _, headers = answer(served.port)
    policy = dict(rule.strip().split(" ", 1) for rule in headers["Content-Security-Policy"].split(";"))
    assert status == 200
    assert policy["default-src"] == policy["base-uri"] == policy["frame-ancestors"] == "'none'"
    scripts = policy["script-src"].split()
    assert not {"'unsafe-inline'", "'unsafe-eval'", "*", "data:", "http:", "https:"} & {*scripts}
    assert [one for one in scripts if one.startswith("'nonce-")]
    other = answer(served.port)[2]["Content-Security-Policy"]
    assert other != headers["Content-Security-Policy"]  # a nonce is used once


def test_serves_this_machine_and_no_files(served):
    outside = {info[4][0] for info in socket.getaddrinfo(socket.gethostname(), None, socket.AF_INET)}
    for host in outside - {"127.0.0.1"}:
        with socket.socket() as probe:
            probe.settimeout(2.0)
            assert probe.connect_ex((host, served.port)) != 0 or host.startswith("127.")
    for path in (
        "/../model.toml",
        "/static/../../../../../../etc/passwd",
        "/static/%2e%2e/%2e%2e/setup.py",
        "/x",
    ):
        ask = http.client.HTTPConnection("127.0.0.1", served.port, timeout=WAIT)
        ask.request("GET", path)
        assert ask.getresponse().status in (403, 404), path
        ask.close()


def test_a_taken_port_is_said(served):
    with pytest.raises(OSError, match="in use"):
        rco.explore(chain(), record(200)).show(served.port, browser=False)


def test_ends_by_interruption(tmp_path):
    assert Served(tmp_path, record(200)).close() == 0


@THEIRS
def test_warnings_of_a_fit_stand_under_the_steps(monkeypatch):
    import panel as pn

    from rcorefine.explorer.page import ExplorerPage

    explored = Exploration(chain(), record(200))
    (step,) = explored.steps
    warned = dataclasses.replace(step.refinement, warnings=("the fit <b> stopped early",))
    monkeypatch.setattr(explored, "_steps", [dataclasses.replace(step, refinement=warned)])
    texts = [pane.object for pane in ExplorerPage(explored).root.select(pn.pane.HTML)]
    assert [text for text in texts if "initial model</td>" in text and "the fit &lt;b&gt; stopped" in text]


def test_shows_itself_in_a_notebook():
    page = rco.explore(chain(), record(200))
    assert "error after 0 steps" in repr(page)


def test_the_extra_is_named_where_it_is_missing(monkeypatch):
    monkeypatch.setitem(sys.modules, "panel", None)
    with pytest.raises(rco.MissingExtraError, match=r"rcorefine\[explore\]"):
        rco.explore(chain(), record(200)).show(browser=False)
