"""Processes without a home or a place for caches, two at once on one cache, and what a wheel holds."""

from __future__ import annotations

import os
import subprocess
import sys
from importlib import metadata
from pathlib import Path

import pytest
from inner import NUMBA

ROOT = Path(__file__).resolve().parent.parent.parent


def process(code, *, away=(), cwd=None, **place):
    """Python with this code, in an environment without what is `away`."""
    known = {key: value for key, value in os.environ.items() if key not in away}
    return subprocess.Popen(
        [sys.executable, "-c", code],
        env={**known, "PYTHONPATH": f"{ROOT}{os.pathsep}{cwd or ''}", **place},
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )


def answers(*begun):
    """The number that each of the processes prints."""
    found = []
    for one in begun:
        said, wrong = one.communicate(timeout=600)
        assert one.returncode == 0, wrong[-600:]
        assert not wrong, wrong[-600:]
        found.append(float(said))
    return found


SIMULATION = """
import numpy as np, rcorefine as rco
model = rco.mass_spring_damper(1.0, 0.4, 100.0)
data = rco.Measurement(np.ones(50), np.ones(50), dt=0.1)
import warnings; warnings.simplefilter("ignore")
print(rco.simulate(model, data, "zero").outputs[0, -1])
"""


@pytest.mark.parametrize("home", ["/dev/null", "/proc/1", None])
def test_no_home_and_no_place_for_a_cache(home, tmp_path):
    """A home that is none, one that nobody may write to (not even root), and not a word of one."""
    place = {} if home is None else {"HOME": home, "XDG_CACHE_HOME": f"{home}/x"}
    away = ("HOME", "XDG_CACHE_HOME", "USER", "LOGNAME")
    nowhere = {"NUMBA_CACHE_DIR": "/proc/1/x"} if home == "/proc/1" else {}
    found = answers(process(SIMULATION, away=away, MPLCONFIGDIR=str(tmp_path), **place, **nowhere))
    assert found[0] > 0


KERNEL = """
from rcorefine.jit import compiled

@compiled
def total(x):
    found = 0.0
    for i in range(x.size):
        found += x[i] ** 2
    return found
"""
CALL = "import numpy as np, kernel_of_a_test; print(kernel_of_a_test.total(np.arange(4.0)))"


@pytest.mark.skipif(not NUMBA, reason="numba is not installed or switched off")
def test_two_processes_on_one_cache(tmp_path, tally):
    """Both compile and write the same files at once: of one kernel, in the long form of all that simulate."""
    (tmp_path / "kernel_of_a_test.py").write_text(KERNEL)
    code, value = (CALL, 14.0) if tally.scale <= 1 else (SIMULATION, None)
    for index in range(tally.cases(1) if tally.scale <= 1 else 3):
        place = {"NUMBA_CACHE_DIR": str(tmp_path / f"cache{index}")}
        first = answers(*(process(code, cwd=tmp_path, **place) for _ in range(2)))
        assert list((tmp_path / f"cache{index}").rglob("*.nbi"))
        first += answers(process(code, cwd=tmp_path, **place))  # from the cache
        assert len(set(first)) == 1
        assert value in (None, first[0])
        tally["processes, pairs on one cache"] += 1


def test_what_a_wheel_holds():
    """The package and its licence; no tests, no settings of tests; CI installs one."""
    try:
        installed = metadata.distribution("rcorefine")
    except metadata.PackageNotFoundError:
        pytest.skip("not installed")
    if '"editable": true' in (installed.read_text("direct_url.json") or ""):
        pytest.skip("an editable install holds no files")
    held = [one for one in installed.files or [] if "__pycache__" not in one.parts]
    package = {Path(one) for one in held if one.parts[0] == "rcorefine"}
    info = {one.name for one in held if one.parts[0].endswith(".dist-info")}
    pip = {"INSTALLER", "REQUESTED", "direct_url.json"}
    assert info - pip == {"METADATA", "WHEEL", "RECORD", "LICENSE", "entry_points.txt"}
    tree = {
        one.relative_to(ROOT)
        for one in (ROOT / "rcorefine").rglob("*")
        if one.is_file() and "__pycache__" not in one.parts and one.name != "conftest.py"
    }
    assert package == tree
