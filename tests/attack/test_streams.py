"""Streams that say nothing for long, in units out of this world, and processes without a home."""

from __future__ import annotations

import os
import subprocess
import sys
import warnings
from importlib import metadata
from pathlib import Path

import numpy as np
import pytest

import rcorefine as rco

ROOT = Path(__file__).resolve().parent.parent.parent
MODEL = rco.mass_spring_damper([1.0, 0.8], [0.4, 0.3], [100.0, 60.0], sensors="displacement")
TRUE = rco.mass_spring_damper([1.0, 0.8], [0.4, 0.3], [100.0, 45.0], sensors="displacement")
LOST = rco.Effect("stiffness", "link2")


def signals(n, seed=0):
    rng = np.random.default_rng(seed)
    w = rng.standard_normal(n)
    y = rco.simulate(TRUE, rco.Measurement(w, np.zeros((2, n)), dt=0.02), "zero").outputs
    return w, y + 0.01 * y.std() * rng.standard_normal(y.shape)


@pytest.mark.numba
@pytest.mark.parametrize("settings", [{"effects": [LOST]}, {"effects": [LOST], "forgetting": 0.99}, {}])
def test_silence_winds_nothing_up(settings, tally):
    """What was learned before is known behind it, and learned on."""
    silent = tally.cases(10_000)
    refiner = rco.RCORefiner(MODEL, dt=0.02, **settings)
    w, y = signals(2000)
    refiner.update(w, y)
    refiner.update(np.zeros(silent), np.zeros((2, silent)))
    refiner.update(*signals(2000, 1))
    k = -refiner.system.A[3, 1] * 0.8
    assert abs(k - 45.0) < 1.5
    tally["streams, silent samples"] += silent


@pytest.mark.parametrize("scale", [1e-310, 1e-200, 1e-120, 1e120, 1e200])
def test_signals_without_a_square(scale):
    """They ended in a ValueError of numpy, in warnings of it, or in a standard deviation of Inf."""
    w, y = signals(300)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        with pytest.raises(rco.DataError, match="whose square is no number; give it in another unit"):
            rco.Measurement(scale * w, y, dt=0.02)
        with pytest.raises(rco.DataError, match="another unit"):
            rco.Measurement(w, scale * y, dt=0.02)
        if scale > 1.0:
            for effects in ([LOST], None):
                with pytest.raises(rco.DataError, match="another unit"):
                    rco.RCORefiner(MODEL, dt=0.02, effects=effects).update(scale * w, scale * y)
        else:
            refiner = rco.RCORefiner(MODEL, dt=0.02, effects=[LOST])
            refiner.update(scale * w, scale * y)  # counts as nothing
            assert refiner.parameters[0].coefficient == 0.0


WITHOUT_A_HOME = """
import numpy as np, rcorefine as rco
model = rco.mass_spring_damper(1.0, 0.4, 100.0)
data = rco.Measurement(np.ones(50), np.ones(50), dt=0.1)
import warnings; warnings.simplefilter("ignore")
print(rco.simulate(model, data, "zero").outputs[0, -1])
"""


def test_no_home_and_no_place_for_a_cache(tmp_path):
    place = {"HOME": "/dev/null", "XDG_CACHE_HOME": "/dev/null/x", "MPLCONFIGDIR": str(tmp_path)}
    done = subprocess.run(
        [sys.executable, "-c", WITHOUT_A_HOME],
        env={**os.environ, **place, "PYTHONPATH": str(ROOT)},
        capture_output=True,
        text=True,
        timeout=300,
        check=False,
    )
    assert done.returncode == 0, done.stderr[-600:]
    assert float(done.stdout) > 0


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
