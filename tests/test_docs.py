"""The pages of the documentation: what they link to is there, and pictures stay small."""

from __future__ import annotations

import re
from pathlib import Path

import pytest
from inner import main

import rcorefine as rco

ROOT = Path(__file__).resolve().parent.parent
DOCS = ROOT / "docs"
PAGES = [ROOT / "README.md", *sorted(DOCS.glob("*.md")), *sorted(DOCS.glob("coursework/*.md"))]
LINK = re.compile(r"\]\((?!https?:)([^)#]*)(?:#([^)]*))?\)")


def anchors(text):
    """Headings as the names that a link may jump to."""
    headings = re.findall(r"^#+ (.*)$", text, flags=re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", heading).lower().replace(" ", "-") for heading in headings}


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_links_lead_somewhere(page):
    found = LINK.findall(page.read_text(encoding="utf-8"))
    assert found or page.parent.name == "coursework", "no link was recognized"
    for path, anchor in found:
        if path.startswith("gallery/"):  # made when the site is built
            assert path == "gallery/index.md"
            continue
        target = page.parent / path if path else page
        assert target.exists(), f"{page.name} links to {path}"
        if anchor:
            assert anchor in anchors(target.read_text(encoding="utf-8")), f"no heading {anchor} in {target}"


#: Pages whose code runs, block after block in one session.
RUN = (
    "closed_loop.md", "explorer.md", "fleets.md", "frequency_responses.md", "howto.md", "laws.md",
    "nonlinear_models.md", "operating_point.md", "refiner.md", "start.md",
)  # fmt: skip


@pytest.mark.notebook
@pytest.mark.parametrize("page", RUN)
def test_code_of_a_page_runs(page, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    if page == "explorer.md":
        pytest.importorskip("panel", reason="the extra explore is not installed")
        monkeypatch.setattr("webbrowser.open", lambda address: True)
    if page in ("explorer.md", "laws.md", "start.md"):
        assert main(["example", "--write", "."]) == 0  # the page has its reader do it
    scope: dict = {}
    blocks = re.findall(
        r"^```python\n(.*?)^```", (DOCS / page).read_text(encoding="utf-8"), re.DOTALL | re.MULTILINE
    )
    assert blocks
    for block in blocks:
        exec(compile(block, page, "exec"), scope)


def test_pictures_are_shown_and_small():
    text = "".join(page.read_text(encoding="utf-8") for page in DOCS.glob("*.md"))
    pictures = sorted((DOCS / "pictures").glob("*.png"))
    assert pictures
    for picture in pictures:
        assert f"pictures/{picture.name}" in text, f"{picture.name} stands on no page"
        assert picture.stat().st_size < 100_000


def test_the_reference_lists_every_public_name():
    pages = sorted((DOCS / "reference").glob("*.md"))
    text = "".join(page.read_text(encoding="utf-8") for page in pages)
    listed = re.findall(r"^   ([A-Za-z_][\w.]*)$", text, flags=re.MULTILINE)
    assert len(set(listed)) == len(listed)
    assert set(rco.__all__) - {"examples", "exercises"} <= set(listed)
    first = (DOCS / "reference" / "index.md").read_text(encoding="utf-8")  # all of them on one screen
    assert sorted(re.findall(r"`~rcorefine\.([\w.]+)`", first)) == sorted(listed)
    for name in listed:
        found = rco
        for part in name.split("."):
            found = getattr(found, part)


def test_pages_with_code_are_run():
    with_code = {page.name for page in DOCS.glob("*.md") if "\n```python\n" in page.read_text("utf-8")}
    assert with_code == set(RUN)
