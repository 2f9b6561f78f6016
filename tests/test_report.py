"""The report: self-contained, escaped, reproducible, and readable in a browser."""

from __future__ import annotations

import hashlib
import os
import re
from collections.abc import Iterator
from html.parser import HTMLParser
from pathlib import Path

import control as ct
import matplotlib.pyplot as plt
import numpy as np
import pytest
from chromium_pipe import CHROMIUM, Browser
from inner import Page, write_page

import rcorefine as rco

EVIL = "<img src=x onerror=alert(1)> & \"co\" 'x'"


class Reader(HTMLParser):
    """Tags with attributes, and text by element."""

    def __init__(self, text: str) -> None:
        super().__init__(convert_charrefs=True)
        self.tags: list[tuple[str, dict[str, str | None]]] = []
        self.texts: list[tuple[tuple[str, ...], str]] = []
        self._open: list[str] = []
        self.feed(text)
        self.close()

    def handle_starttag(self, tag, attrs):
        self.tags.append((tag, dict(attrs)))
        if tag not in ("meta", "link", "img", "source"):
            label = dict(attrs).get("class") or ""
            self._open.append(f"{tag}.{label.split()[0]}" if label else tag)

    def handle_endtag(self, tag):
        while self._open and self._open.pop().split(".")[0] != tag:
            pass

    def handle_data(self, data):
        if data.strip():
            self.texts.append((tuple(self._open), data))

    def inside(self, element: str) -> list[str]:
        return [text for path, text in self.texts if any(p == element for p in path)]


def chain(**options):
    return rco.mass_spring_damper([1.0], [0.4], [100.0], sensors="displacement", **options)


def record(true, n=800, noise=0.02, seed=0, **options):
    rng = np.random.default_rng(seed)
    force = 10 * rng.standard_normal(n)
    y = rco.simulate(true, rco.Measurement(force, np.zeros(n), dt=0.02), "zero").outputs
    y = y + noise * y.std() * rng.standard_normal(y.shape)
    return rco.Measurement(
        force, y, dt=0.02, input_labels="force", output_labels="q1", output_units="m", **options
    )


@pytest.fixture(scope="module")
def results():
    """One of each, small; file names and labels as a stranger might send them."""
    wrong, true = chain(name=EVIL), rco.mass_spring_damper([1.0], [0.4], [90.0], sensors="displacement")
    data = record(true, name=EVIL)
    laws = [rco.Effect(kind, "link1") for kind in ("stiffness", "damping", "cubic_stiffness")]
    refined = rco.refine(wrong, data, [rco.Effect("cubic_stiffness", "link1"), laws[0]])
    return {
        "data": data,
        "comparison": rco.compare([wrong, refined], data),
        "diagnosis": rco.diagnose(wrong, data, candidates=laws),
        "improvement": rco.improve(wrong, record(true, 1200, seed=1, name=EVIL), candidates=laws),
        "refinement": refined,
    }


@pytest.fixture(scope="module")
def pages(results, tmp_path_factory):
    folder = tmp_path_factory.mktemp("reports")
    more = {"improvement": {"data": results["data"]}, "refinement": {"data": results["data"]}}
    return {
        kind: results[kind].report(folder / f"{kind}.html", **more.get(kind, {}))
        for kind in ("comparison", "diagnosis", "improvement", "refinement")
    }


@pytest.fixture(scope="module")
def small():
    """A comparison that is quickly written."""
    return rco.compare(chain(), record(chain(), 200))


KINDS = ("comparison", "diagnosis", "improvement", "refinement")


@pytest.mark.parametrize("kind", KINDS)
def test_one_file_that_asks_for_nothing(pages, kind):
    text = pages[kind].read_text(encoding="utf-8")
    page = Reader(text)
    names = [tag for tag, _ in page.tags]
    assert not {"script", "iframe", "object", "embed", "form", "base"} & set(names)
    for tag, attributes in page.tags:
        for key, value in attributes.items():
            assert not key.startswith("on"), f"{tag} has {key}"
            if key in ("src", "srcset", "href"):
                assert str(value).startswith("data:"), f"{tag} {key} = {str(value)[:60]}"
    style = "".join(page.inside("style"))
    assert "url(" not in style
    assert "@import" not in style
    policy = next(a["content"] for t, a in page.tags if t == "meta" and "http-equiv" in a)
    assert "default-src 'none'" in policy


@pytest.mark.parametrize("kind", KINDS)
def test_opens_with_three_sentences(pages, kind):
    page = Reader(pages[kind].read_text(encoding="utf-8"))
    answer = [text for path, text in page.texts if "section.answer" in path]
    assert len(answer) == 3
    assert all(sentence.endswith(".") for sentence in answer)
    heads = page.inside("h2")
    assert heads == ["Pictures", "Tables", "Code to reproduce this result", "Record and versions"]


@pytest.mark.parametrize("kind", KINDS)
def test_names_from_files_are_text_and_nothing_else(pages, kind):
    text = pages[kind].read_text(encoding="utf-8")
    assert "<img src=x" not in text
    page = Reader(text)
    assert EVIL in "".join(page.inside("h1")) + "".join(page.inside("dl"))
    for tag, attributes in page.tags:
        if tag == "img":
            assert attributes["alt"]
            assert len(str(attributes["alt"])) > 30


def test_answers_say_what_was_found(results, pages):
    """The planted defect is a spring 10 % too stiff in the model."""
    said = {k: " ".join(Reader(pages[k].read_text()).inside("section.answer")) for k in KINDS}
    fits = results["comparison"].fit[:, 0]
    assert f"{fits[1]:.4g} %" in said["comparison"]
    assert "stiffness at link1" in said["diagnosis"]
    assert "stiffness at link1" in said["improvement"]
    assert "k1 at link1: 100 to 90" in said["refinement"]


def test_fingerprint_is_that_of_the_arrays(results, pages):
    data = results["data"]
    facts = " ".join(Reader(pages["comparison"].read_text()).inside("dl"))
    for array in (data.inputs, data.outputs):
        assert hashlib.sha256(np.ascontiguousarray(array, "<f8").tobytes()).hexdigest() in facts
    assert rco.__version__ in facts
    assert np.__version__ in facts
    assert ct.__version__ in facts


def code_of(path: Path) -> str:
    return "".join(Reader(path.read_text(encoding="utf-8")).inside("pre"))


def run(code: str, data, folder: Path, monkeypatch) -> dict[str, object]:
    """Execute the printed code beside the record that it asks for."""
    monkeypatch.chdir(folder)
    np.savez(
        folder / "record.npz",
        **{data.input_labels[0]: data.inputs[0], data.output_labels[0]: data.outputs[0]},
    )
    space: dict[str, object] = {"print": lambda *_: None}
    exec(compile(code, "report", "exec"), space)
    return space


@pytest.mark.usefixtures("without_pictures")
def test_code_compares_again(tmp_path, monkeypatch):
    data = record(chain(), 300)
    model = ct.ss([[0, 1], [-100, -0.4]], [[0], [1]], [[1, 0]], 0, inputs="force", outputs="q1", name="plain")
    first = rco.compare(model, data)
    again = run(code_of(first.report(tmp_path / "a.html")), data, tmp_path, monkeypatch)["result"]
    assert np.array_equal(again.fit, first.fit)
    assert again.names == first.names


@pytest.mark.usefixtures("without_pictures")
def test_code_diagnoses_again(tmp_path, monkeypatch):
    data = record(chain())
    first = rco.diagnose(chain(), data, tolerance=0.02)
    again = run(code_of(first.report(tmp_path / "b.html")), data, tmp_path, monkeypatch)["found"]
    assert again.verdict == first.verdict
    assert [t.p_value for t in again.tests] == pytest.approx([t.p_value for t in first.tests], rel=1e-6)


@pytest.mark.usefixtures("without_pictures")
def test_code_refines_again(tmp_path, monkeypatch, results):
    data, first = results["data"], results["refinement"]
    again = run(code_of(first.report(tmp_path / "c.html", data=data)), data, tmp_path, monkeypatch)["better"]
    assert again.theta == pytest.approx(first.theta, rel=1e-3, abs=1e-3)


def test_code_admits_what_it_cannot_hold(pages):
    """A comparison keeps linear parts; the code says where the nonlinear effects are missing."""
    text = code_of(pages["comparison"])
    assert "nonlinear effects" in text
    assert text.count("nonlinear effects") == 1


@pytest.mark.usefixtures("without_pictures")
def test_own_code_and_title_stand_first(tmp_path, small):
    path = small.report(tmp_path / "e.html", title="My <title>", code="# rcorefine compare <a> b")
    page = Reader(path.read_text())
    assert page.inside("h1") == ["My <title>"]
    assert code_of(path).startswith("# rcorefine compare <a> b\n")


@pytest.mark.usefixtures("without_pictures")
def test_a_refinement_is_compared_with_the_record_that_it_was_fitted_to(tmp_path, results):
    path = results["refinement"].report(tmp_path / "f.html")
    outputs = np.ascontiguousarray(results["data"].outputs, "<f8")
    facts = " ".join(Reader(path.read_text()).inside("dl"))
    assert hashlib.sha256(outputs.tobytes()).hexdigest() in facts


@pytest.mark.usefixtures("without_pictures")
def test_what_is_there_is_kept(tmp_path, small):
    """Another report is replaced, anything else is not; a missing folder is an error; the path comes back."""
    target, notes = tmp_path / "report.html", tmp_path / "notes.txt"
    page = Page("second", "", ["a.", "b.", "c."], True)
    assert write_page(page, target) == target.absolute()
    assert small.report(str(target), title="third") == target.absolute()
    assert "third" in target.read_text()
    assert write_page(page, target) == target.absolute()
    notes.write_text("keep me")
    with pytest.raises(FileExistsError, match="no report of rcorefine"):
        small.report(notes)
    assert notes.read_text() == "keep me"
    write_page(page, notes, overwrite=True)
    assert "<!doctype html>" in notes.read_text()
    with pytest.raises(FileNotFoundError, match="does not exist"):
        small.report(tmp_path / "no" / "report.html")
    assert not (tmp_path / "no").exists()
    with pytest.raises(IsADirectoryError, match="folder"):
        small.report(tmp_path)


def test_report_leaves_no_figure_and_no_file_open(tmp_path, small):
    """But for the fonts that matplotlib keeps, once and for all."""

    def opened():
        folder = Path("/proc/self/fd")
        links = [os.readlink(link) for link in folder.iterdir() if link.exists()] if folder.is_dir() else []
        return sorted(name for name in links if not name.endswith(".ttf"))

    mine, before = plt.figure(), opened()
    small.report(tmp_path / "g.html")
    assert plt.get_fignums() == [mine.number]
    assert opened() == before


def test_picture_that_the_record_forbids_is_a_sentence(tmp_path):
    """A free decay has no measured frequency response: the report says why, and is written."""
    t = 0.02 * np.arange(400)
    y = np.exp(-0.2 * t) * np.cos(10 * t)
    data = rco.Measurement(np.zeros(400), y, dt=0.02, input_labels="force", output_labels="q1")
    with pytest.warns(rco.ExcitationWarning):
        result = rco.compare(chain(), data)
    text = result.report(tmp_path / "h.html").read_text()
    assert "No picture &#x27;bode&#x27;" in text
    assert "constant" in text


@pytest.mark.parametrize(
    "name", ["</style><script>alert(1)</script>", "$x_1$ & 50 % {x} \\n", "a" * 300, "x\ud800"]
)
def test_no_name_breaks_the_page_or_its_code(tmp_path, monkeypatch, name):
    """Markup, mathematics, format signs, length, what UTF-8 cannot hold: all of it is text."""
    monkeypatch.setattr("rcorefine.views.reports._WORDS", {})
    data = record(chain(), 120, name=name)
    path = rco.compare(chain(name=name), data).report(tmp_path / "n.html")
    page = Reader(path.read_text(encoding="utf-8"))
    assert "script" not in [tag for tag, _ in page.tags]
    assert [tag for tag, _ in page.tags].count("style") == 1
    if not name.startswith("x"):
        assert name in "".join(page.inside("h1"))
    assert run(code_of(path), data, tmp_path, monkeypatch)["data"].name == name


def test_measured_response_has_a_report_too(tmp_path, monkeypatch):
    """Without a record in time: answer, picture, table, and code that computes the same fit."""
    omega = np.geomspace(2, 40, 60)
    true = ct.ss([[0, 1], [-90, -0.4]], [[0], [1]], [[1, 0]], 0, inputs="force", outputs="q1", name="true")
    measured = ct.frd(
        ct.frequency_response(true, omega).frdata, omega, name=EVIL, inputs=["force"], outputs=["q1"]
    )
    model = ct.ss([[0, 1], [-100, -0.4]], [[0], [1]], [[1, 0]], 0, inputs="force", outputs="q1", name="model")
    first = rco.compare([model, true], measured)
    path = first.report(tmp_path / "r.html")
    page = Reader(path.read_text(encoding="utf-8"))
    answer = [text for where, text in page.texts if "section.answer" in where]
    assert len(answer) == 3
    assert answer[0].startswith("true explains 100 %")
    assert repr(EVIL) in "".join(page.inside("h1"))
    assert sum(tag == "img" for tag, _ in page.tags) == 1
    monkeypatch.chdir(tmp_path)
    space: dict[str, object] = {"print": lambda *_: None}
    exec(compile(code_of(path), "report", "exec"), space)
    assert np.allclose(space["result"].fit, first.fit, rtol=0, atol=1e-9)


# ------------------------------------------------------------------ in a browser
@pytest.fixture(scope="module")
def browser() -> Iterator[Browser]:
    if CHROMIUM is None:
        pytest.skip("no chromium here (Debian: apt-get install chromium)")
    opened = Browser()
    yield opened
    opened.close()


def luminance(color: str) -> float:
    """Relative luminance of "rgb(r, g, b)" as WCAG 2 defines it."""
    parts = [int(x) / 255 for x in re.findall(r"\d+", color)[:3]]
    linear = [x / 12.92 if x <= 0.04045 else ((x + 0.055) / 1.055) ** 2.4 for x in parts]
    return 0.2126 * linear[0] + 0.7152 * linear[1] + 0.0722 * linear[2]


def contrast(one: str, two: str) -> float:
    high, low = sorted((luminance(one), luminance(two)), reverse=True)
    return (high + 0.05) / (low + 0.05)


TEXTS = "h1,.about,.answer p,figcaption,td,th,.notes p,dd,dt,pre,footer"
STYLES = """[...document.querySelectorAll("%s")].map(e => {
  let b = e; let c = 'rgba(0, 0, 0, 0)';
  while (b && c === 'rgba(0, 0, 0, 0)') { c = getComputedStyle(b).backgroundColor; b = b.parentElement; }
  const s = getComputedStyle(e);
  return [e.tagName, s.color, c, parseFloat(s.fontSize)];
})""".replace("%s", TEXTS)
PICTURES = "[...document.images].map(i => [i.complete, i.naturalWidth, i.clientWidth, i.alt.length])"


@pytest.mark.browser
@pytest.mark.parametrize("scheme", ["light", "dark"])
@pytest.mark.parametrize("width", [400, 1400])
@pytest.mark.parametrize("kind", KINDS)
def test_in_a_browser(browser, pages, kind, width, scheme):
    browser.show(pages[kind], width=width, scheme=scheme)
    assert browser.messages == []
    assert all(url.startswith(("file://", "data:")) for url in browser.requests)
    assert sum(url.startswith("file://") for url in browser.requests) == 1
    inner, reach = browser.evaluate("[innerWidth, document.documentElement.scrollWidth]")
    assert inner == width
    assert reach <= width, "the page scrolls sideways"
    pictures = browser.evaluate(PICTURES)
    assert pictures
    for complete, natural, shown, alt in pictures:
        assert complete
        assert natural > 300
        assert shown <= width
        assert alt > 30
    for tag, color, ground, size in browser.evaluate(STYLES):
        assert contrast(color, ground) >= 4.5, f"{tag} {color} on {ground}"
        assert size >= 12, tag
    ground = luminance(browser.evaluate("getComputedStyle(document.body).backgroundColor"))
    assert (ground > 0.9) if scheme == "light" else (ground < 0.05)
    inverted = browser.evaluate("getComputedStyle(document.images[0]).filter") != "none"
    assert inverted == (scheme == "dark")


@pytest.mark.browser
def test_narrow_windows_get_pictures_of_their_own(browser, pages):
    """Letters of 10 pt stay 9 pixels high or more in a window of 400 pixels."""
    sizes = {}
    for width in (400, 1400):
        browser.show(pages["comparison"], width=width, scheme="light")
        sizes[width] = browser.evaluate("[...document.images].map(i => [i.naturalWidth, i.clientWidth])")
    for (natural, shown), (wide, _) in zip(sizes[400], sizes[1400], strict=True):
        assert natural < wide
        assert 10 / 72 * 150 * shown / natural >= 9  # 150 points per inch in the file


@pytest.mark.browser
@pytest.mark.parametrize("kind", KINDS)
def test_prints_to_pdf(browser, pages, kind):
    browser.show(pages[kind], width=1400, scheme="dark")
    pdf = browser.pdf()
    assert pdf.startswith(b"%PDF")
    assert 2 <= len(re.findall(rb"/Type\s*/Page\b", pdf)) <= 20


@pytest.mark.browser
def test_prints_dark_on_white_also_in_the_dark(browser, pages):
    browser.show(pages["comparison"], width=1400, scheme="dark")
    browser.call(
        "Emulation.setEmulatedMedia",
        media="print",
        features=[{"name": "prefers-color-scheme", "value": "dark"}],
    )
    body, color = browser.evaluate(
        "[getComputedStyle(document.body).backgroundColor, getComputedStyle(document.body).color]"
    )
    shown = browser.evaluate("getComputedStyle(document.images[0]).filter")
    browser.call("Emulation.setEmulatedMedia", media="screen")
    assert luminance(body) > 0.9
    assert contrast(body, color) > 7
    assert shown == "none"
