"""The bar: only when asked for, on standard error, every announced step done, no effect on the answer."""

from __future__ import annotations

import io
import re
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
from hidden.generator import Law, held_motion
from inner import Progress

import rcorefine as rco
from rcorefine import progress

LAWS = [rco.Effect(kind, "link1") for kind in ("stiffness", "damping", "cubic_stiffness")]


@pytest.fixture(scope="module")
def plant():
    return rco.mass_spring_damper([1.0], [0.5], [60.0], sensors="velocity")


@pytest.fixture(scope="module")
def data(plant):
    """A spring that hardens."""
    rng = np.random.default_rng(11)
    force, dt = 6 * rng.standard_normal(1500), 0.02
    spring = Law("cubic_stiffness", np.array([500.0, 0.0, 0.0]))
    rows = (np.array([0.0, -1.0]), np.array([1.0, 0.0]), np.array([0.0, 1.0]))
    A = [[0.0, 1.0], [-60.0, -0.5]]
    y = held_motion(A, np.outer(force, [0.0, 1.0]), dt, [(spring, *rows)])[:, 1]
    return rco.Measurement(force, y + 0.02 * y.std() * rng.standard_normal(y.size), dt=dt)


def last_count(text: str) -> tuple[int, int]:
    """Steps done and steps in all, as the bar ends."""
    done, total = re.findall(r"(\d+)/(\d+) \[", text)[-1]
    return int(done), int(total)


@pytest.mark.parametrize("work", [rco.diagnose, rco.improve])
def test_the_bar_is_shown_only_when_asked_for_and_changes_nothing(work, plant, data, capsys) -> None:
    """The same answer with bar, without it, and on threads; all steps that were announced are done."""
    quiet = work(plant, data, candidates=LAWS)
    captured = capsys.readouterr()
    assert captured.err == ""
    assert captured.out == ""
    with ThreadPoolExecutor(2) as pool:
        answers = [
            work(plant, data, candidates=LAWS, progress=True),
            work(plant, data, candidates=LAWS, progress=True, executor=pool),
        ]
    captured = capsys.readouterr()
    assert captured.out == ""
    done, total = last_count(captured.err)
    assert done == total > 5
    assert "100%" in captured.err
    assert all(str(answer) == str(quiet) for answer in answers)


def test_steps_are_counted_as_they_become_known(capsys) -> None:
    """Rounds ahead count as the mean round; steps that did not come are taken off at the end."""
    with Progress(show=True) as bar:
        bar.round(ahead=3)
        assert bar.map(lambda k: k * k, [1, 2, 3, 4], "squares") == [1, 4, 9, 16]
        assert (bar._bar.n, bar._bar.total) == (4, 16)
        bar.round(ahead=1)
        for item in bar.over(range(6), "loop"):
            if item == 2:
                break
        assert (bar._bar.n, bar._bar.total) == (6, 9)
    assert last_count(capsys.readouterr().err) == (6, 6)


def test_an_error_in_a_step_is_passed_on() -> None:
    """And the step that failed is not counted as done."""
    bar = Progress()
    with pytest.raises(ZeroDivisionError), bar, bar.step("fails"):
        raise ZeroDivisionError
    with pytest.raises(ValueError, match="no"), bar:
        bar.map(int, ["1", "no"], "parses")


class Watched(io.StringIO):
    """Standard error that somebody watches."""

    def isatty(self):
        return True


@pytest.mark.parametrize(
    ("stream", "setting", "shown"),
    [(Watched(), "", True), (Watched(), "0", False), (io.StringIO(), "", False)],
)
def test_a_bar_appears_unasked_where_somebody_watches_and_waits(monkeypatch, stream, setting, shown):
    monkeypatch.setattr("sys.stderr", stream)
    monkeypatch.setenv("RCOREFINE_PROGRESS", setting)
    monkeypatch.setattr("rcorefine.progress._DELAY", 0.0)
    with Progress(None) as bar:
        for _ in bar.over(range(3), "work"):
            pass
    assert ("work" in stream.getvalue()) == shown


@pytest.mark.parametrize(
    ("show", "setting", "compiled", "lines"),
    [
        (None, "", False, 1),
        (True, "", False, 1),
        (False, "", False, 0),
        (None, "0", False, 0),
        (True, "", True, 0),
    ],
)
def test_without_numba_one_line_names_the_extra(monkeypatch, show, setting, compiled, lines):
    """In a log as in a terminal, once per process; no warning, which -W error would make an error."""
    stream = io.StringIO()
    monkeypatch.setattr("sys.stderr", stream)
    monkeypatch.setenv("RCOREFINE_PROGRESS", setting)
    monkeypatch.setattr("rcorefine.progress._DELAY", 0.0)
    monkeypatch.setattr("rcorefine.progress.NUMBA", compiled)
    progress._say_why_slow.cache_clear()
    for _ in range(2):
        with Progress(show) as bar, bar.step("work"):
            pass
    progress._say_why_slow.cache_clear()
    assert stream.getvalue().count("rcorefine[fast]") == lines


def test_a_short_call_draws_no_bar(monkeypatch):
    stream = Watched()
    monkeypatch.setattr("sys.stderr", stream)
    with Progress(None) as bar:
        for _ in bar.over(range(3), "work"):
            pass
    assert "work" not in stream.getvalue()
