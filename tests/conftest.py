"""Fixtures that every test gets: a quiet backend, no open figures, no leaked defaults."""

from __future__ import annotations

import copy
import os
import sys
import zlib
from collections import Counter
from collections.abc import Iterator
from pathlib import Path

os.environ.setdefault("MPLBACKEND", "Agg")

import control as ct
import matplotlib as mpl
import matplotlib.pyplot as plt
import numpy as np
import pytest
from first_compilation import compile_once


def pytest_sessionstart(session: pytest.Session) -> None:
    """Compile what all workers need in one of them."""
    compile_once(session.config)


@pytest.fixture(autouse=True)
def _close_figures() -> Iterator[None]:
    """Close what a test has drawn, also where it failed."""
    yield
    plt.close("all")


@pytest.fixture(autouse=True)
def _no_thread_goes_on() -> Iterator[None]:
    """What an explorer still works on ends with its test: pictures are those of all threads."""
    yield
    begun = sys.modules.get("rcorefine.explorer.page")
    if begun is not None:
        begun.LOOKING.submit(int).result()


@pytest.fixture(autouse=True)
def _no_leaked_defaults() -> Iterator[None]:
    """Neither python-control's defaults nor matplotlib's may change for good."""
    control_before = copy.deepcopy(dict(ct.defaults))
    style_before = dict(mpl.rcParams)
    yield
    changed = {key for key, value in ct.defaults.items() if control_before.get(key) != value}
    if changed:
        ct.defaults.clear()
        ct.defaults.update(control_before)
    styled = {key for key, value in mpl.rcParams.items() if style_before.get(key) != value}
    for key in styled:
        mpl.rcParams[key] = style_before[key]
    assert not changed, f"the test left python-control's defaults changed: {sorted(changed)}"
    assert not styled, f"the test left matplotlib's rcParams changed: {sorted(styled)}"


@pytest.fixture(autouse=True)
def _no_global_random_numbers() -> Iterator[None]:
    """Random numbers come from a generator that is handed over, never from the global one."""
    before = np.random.get_state(legacy=False)  # noqa: NPY002
    yield
    after = np.random.get_state(legacy=False)  # noqa: NPY002
    same = np.array_equal(before["state"]["key"], after["state"]["key"])
    assert same, "the test drew from (or seeded) numpy's global generator"
    assert before["state"]["pos"] == after["state"]["pos"], "the test drew from numpy's global generator"


@pytest.fixture
def without_pictures(monkeypatch: pytest.MonkeyPatch) -> None:
    """Reports without their pictures, where a test asks for something else of them: a second each."""
    monkeypatch.setattr("rcorefine.views.page.draw", lambda plot, alt, caption: "left out")


@pytest.fixture
def rng(request: pytest.FixtureRequest) -> np.random.Generator:
    """Generator seeded by the name of the test: the same numbers in every run and order."""
    return np.random.default_rng(zlib.crc32(request.node.nodeid.encode()))


#: s of a test that is neither slow nor a notebook. A run lists longer ones; on a loaded machine none fails.
MOST = 8.0
#: Files that take longest: they begin first, so that all workers end together.
LONGEST = tuple(
    f"tests/test_{name}.py"
    for name in (
        "monitor", "notebooks", "docs", "coursework", "localization", "ladder_steps", "diagnosis", "survey",
        "rco_default", "error_shares", "several_records", "parameters", "diagnosis_of_responses", "explorer",
        "improve",
    )
)  # fmt: skip


@pytest.hookimpl(optionalhook=True)
def pytest_xdist_make_scheduler(config: pytest.Config, log: object) -> object | None:
    """Distribute whole files, the longest first; xdist has those of most tests first."""
    if config.getvalue("dist") != "loadfile":
        return None
    from xdist.scheduler import LoadFileScheduling

    class LongestFirst(LoadFileScheduling):
        def _assign_work_unit(self, node: object) -> None:
            known = [file for file in LONGEST if file in self.workqueue]
            if known:
                self.workqueue.move_to_end(known[0], last=False)
            super()._assign_work_unit(node)

    return LongestFirst(config, log)


# attacks: few cases, or by -m attack a hundred times as many
ATTACKS = Path(__file__).resolve().parent / "attack"


class Tally(Counter[str]):
    """What was tried, by kind, and how often the quick number is multiplied."""

    scale = 1.0

    def cases(self, quick: int) -> int:
        """Number of cases for a quick number of them."""
        return max(1, round(quick * self.scale))


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    for item in items:
        if ATTACKS in item.path.parents:
            item.add_marker("attack")


@pytest.fixture
def tally(request: pytest.FixtureRequest) -> Iterator[Tally]:
    """Counts of a test, which stand in the summary of the run."""
    found = Tally()
    long = "100" if request.config.option.markexpr == "attack" else "1"
    found.scale = float(os.environ.get("RCOREFINE_ATTACK_SCALE", long))
    yield found
    request.node.user_properties.append(("tally", dict(found)))


def pytest_terminal_summary(terminalreporter: pytest.TerminalReporter) -> None:
    total: Counter[str] = Counter()
    files: Counter[str] = Counter()
    tests: Counter[str] = Counter()
    marked = set()
    for reports in terminalreporter.stats.values():
        for report in reports:
            if not isinstance(report, pytest.TestReport):
                continue
            tests[report.nodeid] += report.duration
            files[report.nodeid.split("::")[0]] += report.duration
            if {"slow", "notebook"} & set(report.keywords):
                marked.add(report.nodeid)
            for key, value in report.user_properties:
                if key == "tally" and report.when == "teardown":
                    total.update(value)
    if total:
        terminalreporter.section("attacks")
        for kind in sorted(total):
            terminalreporter.line(f"{kind}: {total[kind]}")
    if sum(files.values()) > 60.0:
        terminalreporter.section("time of the longest files; LONGEST of tests/conftest.py in this order")
        for file, seconds in files.most_common(len(LONGEST)):
            terminalreporter.line(f"{seconds:7.1f} s {file}")
    over = [(name, seconds) for name, seconds in tests.most_common() if seconds > MOST and name not in marked]
    if over:
        terminalreporter.section(f"tests of more than {MOST:g} s that are not marked")
        for name, seconds in over:
            terminalreporter.line(f"{seconds:7.1f} s {name}")
