"""The labs: the code of each text runs, and the solution goes on from it and ends where its checks say."""

from __future__ import annotations

import re
import sys
from pathlib import Path

import pytest

COURSE = Path(__file__).resolve().parent.parent / "docs" / "coursework"
LABS = sorted(path.stem for path in COURSE.glob("lab*.md"))


def blocks(page: str) -> list[str]:
    text = (COURSE / f"{page}.md").read_text(encoding="utf-8")
    return re.findall(r"^```python\n(.*?)^```", text, re.DOTALL | re.MULTILINE)


@pytest.fixture
def bench(monkeypatch):
    monkeypatch.syspath_prepend(str(COURSE))
    yield
    sys.modules.pop("bench", None)


def test_every_lab_has_a_solution():
    assert len(LABS) == 8
    assert sorted(path.stem for path in (COURSE / "solutions").glob("*.py")) == LABS


@pytest.mark.notebook
@pytest.mark.parametrize("lab", LABS)
@pytest.mark.filterwarnings("ignore::rcorefine.RCOWarning")  # lab 2 and 4 have them read
@pytest.mark.usefixtures("bench", "without_pictures")
def test_a_lab_is_solved_from_its_text(lab):
    scope: dict = {}
    for block in blocks(lab):
        exec(compile(block, f"{lab}.md", "exec"), scope)
    solution = COURSE / "solutions" / f"{lab}.py"
    exec(compile(solution.read_text(encoding="utf-8"), str(solution), "exec"), scope)


@pytest.mark.notebook
@pytest.mark.parametrize("page", ["index", "lecturer"])
@pytest.mark.usefixtures("bench")
def test_code_of_the_other_pages_runs(page, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    scope: dict = {}
    for block in blocks(page):
        exec(compile(block, f"{page}.md", "exec"), scope)
