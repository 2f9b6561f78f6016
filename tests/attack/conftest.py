"""How hard the attacks are: a few cases in the quick suite, a hundred times as many by `pytest -m attack`."""

from __future__ import annotations

import os
from collections import Counter
from collections.abc import Iterator
from pathlib import Path

import pytest

HERE = Path(__file__).resolve().parent


class Tally(Counter[str]):
    """What was tried, by kind, and how often the quick number is multiplied."""

    scale = 1.0

    def cases(self, quick: int) -> int:
        """Number of cases for a quick number of them."""
        return max(1, round(quick * self.scale))


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    for item in items:
        if HERE in item.path.parents:
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
    for reports in terminalreporter.stats.values():
        for report in reports:
            for key, value in getattr(report, "user_properties", ()):
                if key == "tally" and getattr(report, "when", "") == "teardown":
                    total.update(value)
    if total:
        terminalreporter.section("attacks")
        for kind in sorted(total):
            terminalreporter.line(f"{kind}: {total[kind]}")
