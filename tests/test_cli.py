"""The command `rcorefine`: exit codes, streams, and the demo with its pictures."""

from __future__ import annotations

import os
import re
import runpy
import subprocess
import sys
from pathlib import Path

import matplotlib.image
import numpy as np
import pytest
from inner import main

import rcorefine as rco

ROOT = Path(__file__).resolve().parent.parent
DEMO_LIMIT = 60.0  # s, the promise of the README for two cores, first compilation included


def run(*arguments: str, **environment: str) -> subprocess.CompletedProcess[str]:
    """Start `python -m rcorefine` in a process of its own."""
    return subprocess.run(
        [sys.executable, "-m", "rcorefine", *arguments],
        capture_output=True,
        text=True,
        env={**os.environ, "PYTHONPATH": str(ROOT), **environment},
        stdin=subprocess.DEVNULL,
        timeout=600,
        check=False,
    )


@pytest.fixture(scope="module")
def demo(tmp_path_factory: pytest.TempPathFactory) -> tuple[subprocess.CompletedProcess[str], Path, float]:
    """One demo with its progress shown."""
    return timed_demo(tmp_path_factory.mktemp("demo") / "a" / "new folder")


def timed_demo(output: Path, **environment: str) -> tuple[subprocess.CompletedProcess[str], Path, float]:
    before = os.times()
    done = run("demo", "--output", str(output), OMP_NUM_THREADS="1", **environment)
    after = os.times()
    # processor time of the one thread: what a clock shows where nothing else runs beside it
    busy = after.children_user + after.children_system - before.children_user - before.children_system
    return done, output, busy


@pytest.mark.parametrize("arguments", [["--help"], ["demo", "--help"], ["--version"]])
def test_help_and_version_end_with_0(arguments, capsys):
    with pytest.raises(SystemExit) as end:
        main(arguments)
    assert end.value.code == 0
    captured = capsys.readouterr()
    assert captured.out
    assert not captured.err


def test_failed_work_ends_with_1(tmp_path, capsys):
    """The folder for the pictures is a file: said before any work is done."""
    blocked = tmp_path / "taken"
    blocked.write_text("a file, not a folder")
    assert main(["demo", "--quiet", "--output", str(blocked)]) == 1
    captured = capsys.readouterr()
    assert "taken" in captured.err
    assert "Traceback" not in captured.err
    assert blocked.read_text() == "a file, not a folder"


def test_libraries_are_imported_where_ctrl_c_is_understood():
    code = "import sys, rcorefine.commands.cli; sys.exit('numpy' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0


def test_module_is_the_command(monkeypatch, capsys):
    monkeypatch.setattr(sys, "argv", ["rcorefine", "--version"])
    with pytest.raises(SystemExit) as end:
        runpy.run_module("rcorefine", run_name="__main__")
    assert end.value.code == 0
    assert capsys.readouterr().out.strip() == f"rcorefine {rco.__version__}"


def test_demo_ends_well_and_in_time(demo):
    done, _, busy = demo
    assert done.returncode == 0, done.stderr
    assert "Traceback" not in done.stderr
    assert busy < DEMO_LIMIT


@pytest.mark.slow
def test_first_demo_ends_in_time(tmp_path):
    """As a user sees it on first use: nothing compiled yet."""
    done, _, busy = timed_demo(tmp_path / "demo", NUMBA_CACHE_DIR=str(tmp_path / "cache"))
    assert done.returncode == 0, done.stderr
    assert busy < DEMO_LIMIT


def test_demo_shows_progress_on_standard_error_only(demo):
    done, _, _ = demo
    assert "100%" in done.stderr
    assert "%|" not in done.stdout
    assert done.stdout.isascii()
    assert max(map(len, done.stdout.replace(str(demo[1]), "").splitlines())) <= 80


def test_demo_says_that_the_refined_model_is_better(demo):
    """The fit on held-out data rises to what the noise allows (3 % of noise: about 97 %)."""
    done, _, _ = demo
    before, after = (
        float(x) for x in re.search(r"fit rises.*?(-?[\d.]+) %.*?to (-?[\d.]+) %", done.stdout).groups()
    )
    assert before < 90.0
    assert 95.0 < after <= 98.5


def test_demo_finds_the_friction(demo):
    """The effect that the simulated record holds: 0.5 N at link2, within what 3 % noise allows."""
    done, _, _ = demo
    told = done.stdout.split("2. What is missing?")[1]
    assert "Diagnosis: EFFECT" in told
    size = re.search(r"One effect is missing: coulomb_friction at link2 \(([\d.]+) \+/- ([\d.]+)\)", told)
    value, std = (float(x) for x in size.groups())
    assert std < 0.02
    assert abs(value - 0.5) < 4 * std


def test_demo_climbs_to_both_effects(demo):
    """Both changes of the later record are found: 0.5 N at link2, and k3 at 180 of 200 N/m.

    The stiffness is an effect or a parameter that was estimated again: both say the same of this record.
    """
    done, _, _ = demo
    told = done.stdout.split("5. Two things at once")[1].split("6. Use the refined model")[0]
    assert ": ADEQUATE" in told
    added = re.findall(r"^\d+ (?:add|pair|swap) (\S+ at link\d)", told, flags=re.MULTILINE)
    dropped = re.findall(r"^\d+ drop (\S+ at link\d)", told, flags=re.MULTILINE)
    left = set(added) - set(dropped)
    assert left - {"stiffness at link3"} == {"coulomb_friction at link2"}
    said = " ".join(told.split())
    value, std = map(float, re.search(r"k3 at link3 200 -> ([\d.]+) \+/- ([\d.]+)", said).groups())
    assert "stiffness at link3" in left or abs(value - 180.0) < 3 * std


def test_demo_writes_pictures_and_a_report(demo):
    done, output, _ = demo
    files = sorted(path.name for path in output.iterdir())
    assert files == ["diagnosis.png", "map.png", "overview.png", "report.html", "staircase.png"]
    for name in files:
        assert str(output / name) in done.stdout
    assert done.stdout.rindex("staircase.png") > done.stdout.rindex("report.html")  # the demo ends on it
    assert "coulomb_friction" in (output / "report.html").read_text(encoding="utf-8")
    for name in files:
        if not name.endswith(".png"):
            continue
        pixels = matplotlib.image.imread(output / name)
        height, width = pixels.shape[:2]
        assert height >= 480
        assert width >= 700
        assert np.ptp(pixels[..., :3]) > 0.5, f"{name} is blank"


@pytest.mark.slow
def test_demo_is_the_same_without_numba(demo, tmp_path):
    """Same text, figure by figure: one source, compiled or not. Quiet means quiet."""
    done, output, _ = demo
    plain = run("demo", "--quiet", "--output", str(tmp_path / "x"), RCOREFINE_NUMBA="0")
    assert plain.returncode == 0, plain.stderr
    assert plain.stderr == ""
    assert plain.stdout.replace(str(tmp_path / "x"), "") == done.stdout.replace(str(output), "")


def test_demo_survives_a_reader_that_leaves(tmp_path):
    """`rcorefine demo | head -1` ends without a traceback."""
    with subprocess.Popen(
        [sys.executable, "-u", "-m", "rcorefine", "demo", "--quiet", "--output", str(tmp_path)],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        env={**os.environ, "PYTHONPATH": str(ROOT)},
        text=True,
    ) as process:
        assert process.stdout is not None
        assert process.stderr is not None
        assert process.stdout.readline()
        process.stdout.close()
        errors = process.stderr.read()
        assert process.wait(timeout=600) == 1
    assert errors == ""
