"""Each verdict says what to do next in a line of code, and that line runs."""

from __future__ import annotations

import matplotlib.pyplot as plt
import pytest

import rcorefine as rco
from rcorefine.diagnosis.result import next_step
from tests.public_calls import EFFECT, diagnosis, improvement, model, nameless, record, small_record


def ambiguous():
    """Two names for one thing: a gain of the only input and one of the only output."""
    louder = rco.Measurement(record().inputs / 1.2, record().outputs, dt=record().dt)
    offered = [
        rco.Effect("input_gain", model().linear.input_labels[0]),
        rco.Effect("output_gain", model().linear.output_labels[0]),
    ]
    return rco.diagnose(model(), louder, candidates=offered)


def of_points():
    points = small_record(1, 20.0, 900).frequency_response(segment_length=240)
    return rco.diagnose(model(), points, candidates=[EFFECT])


GRAVITY = [rco.Effect("gravity", "link1")]
CASES = {
    "adequate": lambda: rco.diagnose(model(), record(), candidates=[EFFECT]),
    "parameters": lambda: rco.diagnose(model(), small_record(1, 20.0), candidates=GRAVITY),
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
