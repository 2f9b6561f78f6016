"""Ctrl-C at any moment: no half file, no traceback in a terminal; what was done is kept, nothing else is."""

from __future__ import annotations

import contextlib
import os
import re
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

import rcorefine as rco

ROOT = Path(__file__).resolve().parent.parent.parent
MODEL = """[mass_spring_damper]
m = [1.0, 0.8]
c = [0.4, 0.3]
k = [100.0, 60.0]
sensors = "displacement"
"""
LINKS = [rco.Effect(kind, f"link{i}") for kind in ("stiffness", "coulomb_friction") for i in (1, 2)]

pytestmark = [
    pytest.mark.skipif(os.name == "nt", reason="signals of a terminal"),
    # Python drops a Ctrl-C that meets it in a destructor or in the callback of a weak reference, and says so
    pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning"),
]


def chain(k=60.0):
    return rco.mass_spring_damper([1.0, 0.8], [0.4, 0.3], [100.0, k], sensors="displacement")


def record(k, seed=0, n=300):
    rng = np.random.default_rng([6, seed])
    w = rng.standard_normal(n)
    y = rco.simulate(chain(k), rco.Measurement(w, np.zeros((2, n)), dt=0.02), "zero").outputs
    return rco.Measurement(
        w, y + 0.02 * y.std() * rng.standard_normal(y.shape), dt=0.02, output_labels=["q1", "q2"]
    )


# ------------------------------------------------------------------ in a session
RUNS = {
    "diagnose": lambda: rco.diagnose(chain(), record(48.0), candidates=LINKS),
    "improve": lambda: rco.improve(chain(), record(48.0, n=600), candidates=LINKS, max_effects=1),
    "survey": lambda: rco.survey(
        chain(), {f"m{i}": record(48.0 + i, i) for i in range(4)}, "refine", options={"effects": LINKS[:2]}
    ),
}


def numbers(result):
    """Every number of a result to the last bit, but for the time that it took."""
    return re.sub(r"'seconds': [\d.e-]+", "", repr(result.to_dict()))


@pytest.mark.parametrize("name", RUNS)
def test_in_a_session(name, tmp_path, tally):
    """KeyboardInterrupt comes out, of a survey with what was done; the next call gives the same answer."""
    run, rng = RUNS[name], np.random.default_rng(9)
    run()
    begun = time.perf_counter()
    whole = numbers(run())
    takes = time.perf_counter() - begun
    before = signal.signal(signal.SIGALRM, lambda *_: signal.default_int_handler(signal.SIGINT, None))
    stops = []
    try:
        for index in range(tally.cases(3)):
            try:
                signal.setitimer(signal.ITIMER_REAL, rng.uniform(0.02, 0.8) * takes)
                run()
            except KeyboardInterrupt as error:
                stops.append(error)
            finally:
                signal.setitimer(signal.ITIMER_REAL, 0.0)
            if index % 3 == 2:
                assert numbers(run()) == whole
    finally:
        signal.signal(signal.SIGALRM, before)
    assert stops
    for stop in stops if name == "survey" else ():
        rows = stop.survey.rows
        assert f"{4 - len(rows)} of 4 record(s) were not examined" in stop.survey.notes[0]
        assert all(row.error is None for row in rows)
    tally[f"interruptions, {name}"] += len(stops)


def test_while_a_report_is_written(tmp_path, tally):
    """The older report stays, or the new one is there, whole."""
    found, rng = rco.compare(chain(), record(48.0)), np.random.default_rng(10)
    path = tmp_path / "out.html"
    begun = time.perf_counter()
    found.report(path)
    takes = time.perf_counter() - begun
    before = signal.signal(signal.SIGALRM, lambda *_: signal.default_int_handler(signal.SIGINT, None))
    try:
        for _ in range(tally.cases(2)):
            try:
                signal.setitimer(signal.ITIMER_REAL, rng.uniform(0.01, 1.0) * takes)
                found.report(path, overwrite=True)
            except KeyboardInterrupt:
                tally["interruptions, report"] += 1
            finally:
                signal.setitimer(signal.ITIMER_REAL, 0.0)
            assert path.read_text().rstrip().endswith("</html>")
            assert [one.name for one in tmp_path.iterdir()] == ["out.html"]
    finally:
        signal.signal(signal.SIGALRM, before)


# ------------------------------------------------------------------ in a terminal
WORDS = {
    "diagnose": ["diagnose", "model.toml", "a.csv", "--candidates", "link2", "--report", "out.html"],
    "survey": ["survey", "fleet", "--model", "model.toml", "--task", "localize", "--report", "out"],
    "jobs": ["survey", "fleet", "--model", "model.toml", "--task", "localize", "--jobs", "2"],
}


def written(folder):
    (folder / "model.toml").write_text(MODEL)
    (folder / "fleet").mkdir()
    for place, k in (("a", 48.0), ("fleet/b", 50.0), ("fleet/c", 52.0), ("fleet/d", 54.0)):
        data = record(k)
        rows = np.column_stack([data.timepts, *data.inputs, *data.outputs])
        np.savetxt(folder / f"{place}.csv", rows, delimiter=",", header="time,force,q1,q2", comments="")


def begun(words, folder):
    """The command, alone in its group of processes as a terminal has it."""
    return subprocess.Popen(
        [sys.executable, "-m", "rcorefine", *words],
        cwd=folder,
        env={**os.environ, "PYTHONPATH": str(ROOT)},
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
    )


def test_in_a_terminal(tmp_path, tally):
    """All processes of the group get it, as of Ctrl-C; 130 is what shells say of an interruption."""
    written(tmp_path)
    rng = np.random.default_rng(11)
    for index in range(tally.cases(3)):
        verb = list(WORDS)[index % 3]
        process = begun(WORDS[verb], tmp_path)
        time.sleep(rng.uniform(0.3, (8.0, 8.0, 20.0)[index % 3]))
        with contextlib.suppress(ProcessLookupError):
            os.killpg(process.pid, signal.SIGINT)
        try:
            _, said = process.communicate(timeout=60)
        except subprocess.TimeoutExpired:
            os.killpg(process.pid, signal.SIGKILL)
            pytest.fail(f"{verb} did not end within a minute")
        assert process.returncode in (0, 1, 130, -signal.SIGINT), said
        assert not re.search("Traceback|Exception ignored", said), said
        assert not list(tmp_path.rglob("*.tmp"))
        for page in tmp_path.rglob("out*.html"):
            assert page.read_text().rstrip().endswith("</html>")
            page.unlink()
        tally["interruptions, commands"] += process.returncode not in (0, 1)
        tally["interruptions, commands that were over"] += process.returncode in (0, 1)
