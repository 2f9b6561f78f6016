"""Names of signals, models, records and files as a stranger might send them: shown, and nothing else."""

from __future__ import annotations

import json
import re
import unicodedata
import warnings
from html.parser import HTMLParser
from pathlib import Path

import control as ct
import numpy as np
import pytest
from inner import main

import rcorefine as rco

HOSTILE = {
    "script": "<script>alert(1)</script>",
    "terminal": "\x1b[31mred\x1b]0;title\x07",
    "surrogate": "\ud800",
    "right to left": "\u202egpj,exe\u202c \u05d0\u05d1",
    "attribute": '" onload="alert(1)',
    "lines": "a\nb\r\nc\x0b\x0cd\x85e\u2028f",
    "long": "x" * 10_000,
    "code": "'''\nimport os\n'''\"\"\"\\",
    "image": "<img src=x onerror=alert(1)>",
    "drawing": "<svg/onload=alert(1)>",
    "end": "</td></table></body></html><h1>",
    "comment": "--><script>alert(1)</script><!-- ]]>",
    "entities": "&lt;script&gt; &#60;b&#62;",
    "address": "javascript:alert(1)",
    "nul": "a\0b",
    "mathematics": "$\\frac{1}{0$ \\alpha_{",
    "dollars": "a$b$c^{",
    "format": "{0} %s %(x)s {{7*7}}",
    "path": "/etc/passwd | > $HOME ~",
    "marks": "e" + "\u0301" * 200,
    "no width": "\u200b\u2060\ufeff",
    "sheet": "=cmd|'/c calc'!A0",
}
FORBIDDEN = {"script", "iframe", "object", "embed", "form", "base", "svg", "audio", "video", "applet"}


ALLOWED = re.compile(r"data:image/|data:,$|#|[\w-]+\.html(#[\w-]*)?$", re.ASCII)


class Page(HTMLParser):
    """Refuses what could act."""

    def handle_starttag(self, tag, attrs):
        assert tag not in FORBIDDEN, tag
        for name, value in attrs:
            assert not name.startswith("on"), (tag, name)
            if name in ("src", "href", "srcset"):
                assert ALLOWED.match(value or ""), (tag, name, (value or "")[:40])


def made(label: str):
    """A model, a record and what follows from them, all with this name."""
    rng, n = np.random.default_rng(7), 300
    w = rng.standard_normal(n)
    true = rco.mass_spring_damper([1.0], [0.4], [90.0], sensors="displacement")
    y = rco.simulate(true, rco.Measurement(w, 0 * w, dt=0.02), "zero").outputs[0]
    names = {"inputs": [label], "outputs": [label + "y"], "name": label}
    model = rco.mass_spring_damper([1.0], [0.4], [100.0], sensors="displacement", **names)
    data = rco.Measurement(
        w, y + 0.01 * y.std() * rng.standard_normal(n), dt=0.02, input_labels=[label],
        output_labels=[label + "y"], input_units=[label], output_units=[label], name=label,
    )  # fmt: skip
    effect = rco.Effect("stiffness", "link1", name=label)
    return model, {
        "record": data,
        "comparison": rco.compare(model, data),
        "refinement": rco.refine(model, data, [effect]),
        "check": rco.check(model, data, information=False),
        "diagnosis": rco.diagnose(model, data, candidates=[effect]),
        "survey": rco.survey(model, {label: data}, "refine", options={"effects": [effect]}),
    }


def test_names_are_shown_and_nothing_else(tmp_path, without_pictures, tally):
    for name in list(HOSTILE)[: tally.cases(8)]:
        (tmp_path / name).mkdir()
        shown_and_nothing_else(HOSTILE[name], tmp_path / name, tally)


def shown_and_nothing_else(label, tmp_path, tally):
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", rco.RCOWarning)
        _, results = made(label)
        for kind, result in results.items():
            text = str(result)
            assert not [
                c
                for c in text
                if c != "\n" and (unicodedata.category(c) in ("Cc", "Cs") or c in "\u202e\u2028")
            ], kind
            assert max(map(len, text.split("\n"))) <= 20_000, kind
            assert json.loads(json.dumps(result.to_dict(), allow_nan=False)) is not None
            result.to_dataframe()
            if hasattr(result, "_repr_html_"):
                Page().feed(result._repr_html_())
            if hasattr(result, "report"):
                where = tmp_path / kind if kind == "survey" else tmp_path / f"{kind}.html"
                result.report(where)
            tally["names, results shown"] += 1
    pages = [path for path in tmp_path.rglob("*") if path.is_file()]
    assert all(path.resolve().is_relative_to(tmp_path.resolve()) for path in pages)
    for path in pages:
        if path.suffix == ".html":
            text = path.read_text(encoding="utf-8")
            Page().feed(text)
            assert "Content-Security-Policy" in text, path.name
            tally["names, pages"] += 1


@pytest.mark.parametrize("name", ["mathematics", "dollars", "nul", "terminal", "surrogate", "lines"])
def test_pictures_are_drawn_whatever_the_names(name, tmp_path):
    """A name that is no mathtext was a ValueError of matplotlib."""
    label = HOSTILE[name]
    w = np.random.default_rng(3).standard_normal(60)
    data = rco.Measurement(w, w, dt=0.1, input_labels=[label], output_units=[label], name=label)
    data.plot(title=label).figure.savefig(tmp_path / "record.png")
    lag = ct.ss([[-1.0]], [[1.0]], [[1.0]], 0, inputs=[label])
    rco.compare(lag, data).plot().figure.savefig(tmp_path / "comparison.png")


def test_a_name_that_python_control_refuses_is_refused_at_once():
    """It was taken by a builder, and a ValueError of python-control came out of compare."""
    for wrong in ({"inputs": ["a.b"]}, {"outputs": ["a.b"]}, {"name": "a.b"}):
        with pytest.raises(rco.ModelError, match=r"'a\.b' can be 'a_b'"):
            rco.mass_spring_damper([1.0], [0.4], [100.0], sensors="displacement", **wrong)


@pytest.mark.parametrize(
    "name", [n for n, text in HOSTILE.items() if not {"\0", "\n", "/", "\ud800"} & set(text)]
)
def test_names_of_files_on_the_command_line(name, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    label = HOSTILE[name][:80]
    t = 0.1 * np.arange(60)
    rows = "".join(f"{a:.3f},{np.sin(a):.6f},{np.cos(a):.6f}\n" for a in t)
    Path(f"{label}.csv").write_text("t,u,y\n" + rows, encoding="utf-8")
    Path("lag.toml").write_text("[state_space]\nA = [[-1.0]]\nB = [1.0]\nC = [[1.0]]\n")
    code = main(["compare", "lag.toml", f"./{label}.csv", "--input", "u", "--output", "y", "--time", "t"])
    said = capsys.readouterr()
    assert code in (0, 1, 2), said.err
    assert not {"\x1b", "\u202e", "\x07"} & set(said.out + said.err)
