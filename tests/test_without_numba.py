"""Nonlinear laws in a process where the kernels run as plain Python, against the compiled ones."""

import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from inner import NUMBA

import rcorefine as rco

pytestmark = [
    pytest.mark.numba,
    pytest.mark.skipif(not NUMBA, reason="numba is not installed or switched off"),
]


def record():
    """A slider with dry friction and a hardening spring, integrated with small explicit steps."""
    rng = np.random.default_rng(12)
    force = np.repeat(rng.uniform(-4.0, 4.0, 40), 5)
    q = v = 0.0
    seen = []
    for f in force:
        seen.append(v)
        for _ in range(400):
            a = (f - 0.4 * v - 12.0 * q - 3.0 * q**3 - 0.6 * np.tanh(v / 0.01)) / 1.5
            v += 1e-4 * a
            q += 1e-4 * v
    noise = 0.01 * np.std(seen) * rng.standard_normal(len(seen))
    return rco.Measurement(force, np.array(seen) + noise, dt=0.04)


def model():
    return rco.mass_spring_damper(1.5, 0.4, 12.0, sensors="velocity")


def figures():
    """Coefficients with and without free parameters, the verdict of a diagnosis, and its order."""
    data = record()
    half = data.segment(0, 4.0)  # plain Python takes its time
    friction, spring = rco.Effect("coulomb_friction", "link1"), rco.Effect("cubic_stiffness", "link1")
    alone = rco.refine(model(), half, [friction])
    joint = rco.refine(model(), half, [friction, spring], free="linear")
    found = rco.diagnose(model(), data, candidates=[friction, rco.Effect("damping", "link1")])
    values = [row.value for row in (*alone.parameters, *joint.parameters)]
    return np.array(values), ", ".join([found.verdict, *(row.effect.label for row in found.ranking)])


def test_friction_and_cubic_springs_run_without_numba_to_the_same_figures():
    script = (
        "from test_without_numba import figures\n"
        "from rcorefine.jit import NUMBA\n"
        "assert not NUMBA\n"
        "values, names = figures()\n"
        "print(values.tolist()); print(names)"
    )
    paths = [str(Path(__file__).parent), str(Path(rco.__file__).parents[1])]
    done = subprocess.run(
        [sys.executable, "-c", script],
        env={**os.environ, "RCOREFINE_NUMBA": "0", "PYTHONPATH": os.pathsep.join(paths)},
        capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    numbers, names = done.stdout.strip().splitlines()
    values, expected = figures()
    assert names == expected
    assert np.allclose([float(v) for v in numbers.strip("[]").split(",")], values, rtol=1e-5)
