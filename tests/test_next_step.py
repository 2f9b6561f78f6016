"""Each verdict says what to do next in a line of code, and that line runs."""

from __future__ import annotations

import control as ct
import matplotlib.pyplot as plt
import numpy as np
import pytest

import rcorefine as rco
from rcorefine.diagnosis.result import next_step
from tests.public_calls import EFFECT, diagnosis, improvement, model, nameless, record, small_record


def ambiguous():
    """Stiffness and mass at one frequency."""
    turning = np.exp(7.0j * 0.02 * np.arange(1500))
    y = np.imag(ct.ss([[0, 1], [-102, -0.8]], [[0], [1]], [[1, 0]], 0)(7.0j) * turning)
    y += 0.02 * y.std() * np.random.default_rng(0).standard_normal(y.size)
    sine = rco.Measurement(turning.imag, y, dt=0.02, hold="bandlimited")
    offered = [rco.Effect(kind, "link1") for kind in ("stiffness", "mass")]
    return rco.diagnose(rco.mass_spring_damper([1.0], [0.8], [100.0]), sine, candidates=offered)


def of_points():
    points = small_record(1, 20.0, 900).frequency_response(segment_length=240)
    return rco.diagnose(model(), points, candidates=[EFFECT])


DRAG = [rco.Effect("quadratic_damping", "link1")]  # gravity would do as well as the stiffness that is off
CASES = {
    "adequate": lambda: rco.diagnose(model(), record(), candidates=[EFFECT]),
    "parameters": lambda: rco.diagnose(model(), small_record(1, 20.0), candidates=DRAG),
    "effect": diagnosis,
    "ambiguous": ambiguous,
    "unexplained": nameless,
    "effect ": of_points,
    "adequate ": improvement,
}


@pytest.mark.parametrize("verdict", CASES)
def test_the_line_that_a_verdict_ends_with_runs(verdict):
    found = CASES[verdict]()
    assert found.verdict == verdict.strip()
    line = next_step(found)
    assert str(found).splitlines()[-1] == f"Next: {line}"
    assert found.to_dict()["next_step"] == line
    exec(line, {"found": found, "rco": rco})
    plt.close("all")
