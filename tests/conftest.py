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


@pytest.hookimpl(wrapper=True)
def pytest_pyfunc_call(pyfuncitem: pytest.Function) -> Iterator[object]:
    """Random numbers come from a generator that is handed over, never from the global one.

    Around the function alone: a plugin may seed the global generator between the steps of a test.
    """
    before = np.random.get_state(legacy=False)  # noqa: NPY002
    result = yield
    after = np.random.get_state(legacy=False)  # noqa: NPY002
    same = np.array_equal(before["state"]["key"], after["state"]["key"])
    assert same, "the test drew from (or seeded) numpy's global generator"
    assert before["state"]["pos"] == after["state"]["pos"], "the test drew from numpy's global generator"
    return result


@pytest.fixture
def without_pictures(monkeypatch: pytest.MonkeyPatch) -> None:
    """Reports without their pictures, where a test asks for something else of them: a second each."""
    monkeypatch.setattr("rcorefine.views.page.draw", lambda plot, alt, caption: "left out")


@pytest.fixture
def rng(request: pytest.FixtureRequest) -> np.random.Generator:
    """Generator seeded by the name of the test: the same numbers in every run and order."""
    return np.random.default_rng(zlib.crc32(request.node.nodeid.encode()))


HERE = Path(__file__).resolve().parent
#: What repeats a promise by a whole run, and what counts over seeds; a line is a test, or one case of it.
SLOW = frozenset((HERE / "slow.txt").read_text(encoding="utf-8").splitlines())
#: Tests of the first tier that may take more than `MOST`: each holds a promise of the mission by a whole run.
ORACLES = frozenset((HERE / "oracles.txt").read_text(encoding="utf-8").splitlines())
#: s of CPU, children included, of any other test of the first tier. The summary lists those that take more.
MOST = 0.7
#: s of CPU of the whole run; 0: no limit. `.ci/run` sets it for the first tier.
BUDGET = float(os.environ.get("RCOREFINE_CPU_BUDGET", "0"))
#: "3/7": the third seventh of the files, so that the slow tier is run once a week; empty: all of them.
PART = os.environ.get("RCOREFINE_PART", "")
_BEGUN = pytest.StashKey[float]()


#: Files that take longest: they begin first, so that all workers end together.
LONGEST = tuple(
    f"tests/test_{name}.py"
    for name in (
        "monitor", "docs", "coursework", "localization", "ladder_steps", "diagnosis", "survey",
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


@pytest.hookimpl(wrapper=True)
def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> Iterator[None]:
    for item in items:
        if ATTACKS in item.path.parents:
            item.add_marker("attack")
        if item.nodeid in SLOW or item.nodeid.split("[")[0] in SLOW:
            item.add_marker("slow")
    yield
    if PART:  # of the files that have tests of this tier
        part, parts = map(int, PART.split("/"))
        files = sorted({item.location[0] for item in items})
        chosen = set(files[part % parts :: parts])
        config.hook.pytest_deselected(items=[item for item in items if item.location[0] not in chosen])
        items[:] = [item for item in items if item.location[0] in chosen]


def _cpu() -> float:
    """Seconds of CPU of this process, its threads, and its children that have ended."""
    return sum(os.times()[:4])


class Meter:
    """Seconds of CPU of each test, also of doctests and notebooks, for which no hook of this file runs."""

    @pytest.hookimpl(wrapper=True)
    def pytest_runtest_protocol(self, item: pytest.Item) -> Iterator[object]:
        item.stash[_BEGUN] = _cpu()
        return (yield)

    @pytest.hookimpl(wrapper=True)
    def pytest_runtest_makereport(
        self, item: pytest.Item, call: pytest.CallInfo[None]
    ) -> Iterator[pytest.TestReport]:
        report: pytest.TestReport = yield
        if call.when == "teardown":
            report.user_properties.append(("cpu", _cpu() - item.stash[_BEGUN]))
        return report


def pytest_configure(config: pytest.Config) -> None:
    config.pluginmanager.register(Meter())


@pytest.fixture
def tally(request: pytest.FixtureRequest) -> Iterator[Tally]:
    """Counts of a test, which stand in the summary of the run."""
    found = Tally()
    long = "100" if request.config.option.markexpr == "attack" else "1"
    found.scale = float(os.environ.get("RCOREFINE_ATTACK_SCALE", long))
    yield found
    request.node.user_properties.append(("tally", dict(found)))


def _spent(terminalreporter: pytest.TerminalReporter) -> dict[str, float]:
    """Seconds of CPU by test."""
    return {
        report.nodeid: value
        for reports in terminalreporter.stats.values()
        for report in reports
        if isinstance(report, pytest.TestReport) and report.when == "teardown"
        for key, value in report.user_properties
        if key == "cpu"
    }


@pytest.hookimpl(wrapper=True, tryfirst=True)
def pytest_sessionfinish(session: pytest.Session) -> Iterator[object]:
    """Fail a run that took more than its budget of CPU."""
    result = yield
    reporter = session.config.pluginmanager.get_plugin("terminalreporter")
    if BUDGET and reporter and sum(_spent(reporter).values()) > BUDGET and session.exitstatus == 0:
        session.exitstatus = pytest.ExitCode.TESTS_FAILED
    return result


def pytest_terminal_summary(terminalreporter: pytest.TerminalReporter) -> None:
    total: Counter[str] = Counter()
    for reports in terminalreporter.stats.values():
        for report in reports:
            if isinstance(report, pytest.TestReport) and report.when == "teardown":
                for key, value in report.user_properties:
                    if key == "tally":
                        total.update(value)
    if total:
        terminalreporter.section("attacks")
        for kind in sorted(total):
            terminalreporter.line(f"{kind}: {total[kind]}")
    spent = _spent(terminalreporter)
    files: Counter[str] = Counter()
    for name, seconds in spent.items():
        files[name.split("::")[0]] += seconds
    if spent:
        limit = f", of {BUDGET:.0f} s allowed" if BUDGET else ""
        terminalreporter.section(f"{sum(spent.values()):.0f} s of CPU{limit}")
    if sum(files.values()) > 60.0:
        terminalreporter.line("The longest files; LONGEST of tests/conftest.py has this order:")
        for file, seconds in files.most_common(len(LONGEST)):
            terminalreporter.line(f"{seconds:7.1f} s {file}")
    if "slow" in terminalreporter.config.option.markexpr.replace("not slow", ""):
        return
    over = {name: s for name, s in spent.items() if s > MOST and name not in ORACLES}
    if over:
        terminalreporter.line(f"More than {MOST:g} s of CPU: to tests/slow.txt, or to tests/oracles.txt")
        for name, seconds in sorted(over.items(), key=lambda entry: -entry[1]):
            terminalreporter.line(f"{seconds:7.1f} s {name}")
