"""What is looked at before anything is ranked: the hold, motion, clipping, signs."""

from __future__ import annotations

import numpy as np
import pytest

import rcorefine as rco
from rcorefine.diagnosis.case import no_motion
from rcorefine.diagnosis.checks.signals import signal_rows
from rcorefine.diagnosis.holds import best_hold, hold_errors

SETTINGS = {"tolerance": 0.0, "offset": True, "noise": None}
MODEL = rco.mass_spring_damper([1.0], [0.6], [90.0], sensors="displacement")


def record(hold: str, seed: int, noise: float = 0.01) -> rco.Measurement:
    """Coarse sampling, seven samples a period, so that the hold matters."""
    rng = np.random.default_rng(seed)
    w = rng.standard_normal(1500)
    blank = rco.Measurement(w, np.zeros(w.size), dt=0.095, hold=hold)
    y = rco.simulate(MODEL, blank, "zero").outputs[0]
    return rco.Measurement(w, y + noise * y.std() * rng.standard_normal(y.size), dt=0.095, hold=hold)


@pytest.mark.parametrize("true", ["zoh", "foh", "bandlimited"])
@pytest.mark.parametrize("declared", ["zoh", "foh", "bandlimited"])
def test_the_hold_of_the_record_is_found(true, declared):
    data = record(true, 3).with_hold(declared)
    start = rco.refine(MODEL, data)
    hold, sentence = best_hold(start, [data], SETTINGS)
    assert hold == true
    assert bool(sentence) == (true != declared)
    errors = hold_errors(start, [data], SETTINGS)
    assert min(errors, key=errors.get) == true
    assert np.exp(errors[true]) == pytest.approx(0.01 * data.outputs.std(), rel=0.1)


def test_records_that_declare_different_holds_are_taken_at_their_word():
    both = [record("zoh", 1), record("foh", 2)]
    assert best_hold(rco.refine(MODEL, both), both, SETTINGS) == ("zoh", "")


def test_improve_says_and_uses_the_right_hold():
    data = record("foh", 4).with_hold("zoh")
    laws = [rco.Effect(kind, "link1") for kind in ("stiffness", "cubic_stiffness")]
    ladder = rco.improve(MODEL, data, candidates=laws)
    assert ladder.verdict == "adequate"
    assert len(ladder.steps) == 1
    assert any("hold='foh'" in note for note in ladder.notes)


def test_a_record_without_motion_cannot_tell():
    """A commanded input, an output that only flickers in its last digit."""
    rng = np.random.default_rng(0)
    y = np.where(rng.random(800) < 0.01, -0.5, 0.0)
    data = rco.Measurement(np.repeat([0.5, 1.0, 1.5, 2.0], 200), y, dt=0.01)
    model = rco.dc_motor(R=1.0, L=5e-3, Kt=0.05, J=2e-4, b=1e-4, sensors=["speed"])
    found = rco.diagnose(model, data)
    assert found.verdict == "ambiguous"
    assert found.best is None
    assert "Cannot tell" in str(found)
    with pytest.raises(rco.DataError, match="does not move"):
        rco.improve(model, data)


def test_moving_records_are_not_held_for_motionless():
    rng = np.random.default_rng(1)
    square = np.sign(np.sin(np.arange(500) * 0.7))
    for y in (rng.standard_normal(500), square, np.round(rng.standard_normal(500))):
        assert no_motion([rco.Measurement(rng.standard_normal(500), y, dt=0.1)]) == ""


def test_clipping_and_one_sign_are_said():
    rng = np.random.default_rng(2)
    w = 1.0 + 0.2 * rng.random(2000)
    y = np.minimum(np.cumsum(rng.standard_normal(2000)), 5.0)
    said = " ".join(row.sentence for row in signal_rows(rco.Measurement(w, y, dt=0.1, input_labels="pump")))
    assert "exactly 5" in said
    assert "pump never changes sign" in said
    quiet = rco.Measurement(rng.standard_normal(2000), rng.standard_normal(2000), dt=0.1)
    assert all(row.status == "ok" for row in signal_rows(quiet))
