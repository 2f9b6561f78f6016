"""What is said of a record: its hold told from other faults, motion, signs, clipping told from steps."""

from __future__ import annotations

import numpy as np
import pytest
from cases import slow, sweep
from scipy.signal import butter, cont2discrete, lfilter

import rcorefine as rco
from rcorefine.diagnosis.case import no_motion
from rcorefine.diagnosis.check_rows import signal_rows

FINE = 16  # points per sample


def record(seed, declared, true, *, off=0.0, behind=None):
    """Two masses, one velocity; parameters `off` by a share, a Butterworth filter behind the sensor."""
    rng = np.random.default_rng([seed, 91])
    m, c, k = np.array([1.0, 0.7]), np.array([0.5, 0.4]), np.array([90.0, 70.0])
    model = rco.mass_spring_damper(m, c, k, sensors=("velocity", 1))
    c, k = c * (1 - 3 * off), k * (1 + off * np.array([1.0, -1.0]))
    K, C = (np.array([[p[0] + p[1], -p[1]], [-p[1], p[1]]]) / m[:, None] for p in (k, c))
    A = np.block([[np.zeros((2, 2)), np.eye(2)], [-K, -C]])
    B, row = np.array([[0], [0], [1 / m[0]], [0]]), np.array([[0, 0, 1.0, 0]])
    n, dt = 1000, 0.06
    Ad, Bd, *_ = cont2discrete((A, B, row, np.zeros((1, 1))), dt / FINE, "zoh")
    w = lfilter([1.0], [1.0, -0.6], rng.standard_normal(n))
    fine = np.repeat(w, FINE)
    if true == "foh":
        fine = np.interp((np.arange(n * FINE) + 0.5) / FINE, np.arange(n), w)
    x, y = np.zeros((4, 1)), np.zeros(n * FINE)
    for i, value in enumerate(fine):
        y[i] = (row @ x).item()
        x = Ad @ x + Bd * value
    if behind is not None:
        order, corner = behind  # over half the sampling frequency
        y = lfilter(*butter(order, corner / FINE), y)
    y = y[::FINE]
    y = y + 0.02 * y.std() * rng.standard_normal(n)
    return model, rco.Measurement(w, y, dt=dt, hold=declared)


def blamed(found):
    """Hold that is said to fit better, empty where none is."""
    notes = [note for note in found.notes if note.startswith("The hold matters")]
    return [note.split("hold='")[-1].split("'")[0] for note in notes]


FAULTS = (
    {"off": 0.02},
    {"off": -0.04},
    {"behind": (4, 0.8)},
    {"behind": (1, 0.5)},
    {"off": 0.02, "behind": (2, 0.7)},
)


@pytest.mark.parametrize(
    ("hold", "fault"),
    sweep([("zoh", FAULTS[0]), ("foh", FAULTS[3])], ("zoh", "foh"), FAULTS),
    ids=str,
)
def test_what_else_is_wrong_is_not_blamed_on_the_hold(hold, fault):
    assert blamed(rco.diagnose(*record(7, hold, hold, **fault))) == []


def test_some_of_these_would_be_blamed_with_the_parameters_held():
    model, data = record(7, "foh", "foh", behind=(4, 0.8))
    left = {hold: rco.refine(model, data.with_hold(hold)).rmse[0] for hold in ("zoh", "foh")}
    assert np.log(left["foh"] / left["zoh"]) > 0.05


@pytest.mark.parametrize(("declared", "true"), [("zoh", "foh"), *slow(("foh", "zoh"))])
def test_a_wrong_hold_is_still_said(declared, true):
    assert blamed(rco.diagnose(*record(8, declared, true))) == [true]


HOLDS = ("zoh", "foh", "bandlimited")
MODEL = rco.mass_spring_damper([1.0], [0.6], [90.0], sensors="displacement")
LAWS = [rco.Effect(kind, "link1") for kind in ("stiffness", "cubic_stiffness")]


def coarse(hold, seed, noise=0.01):
    """Coarse sampling, seven samples a period, so that the hold matters."""
    rng = np.random.default_rng(seed)
    w = rng.standard_normal(1500)
    blank = rco.Measurement(w, np.zeros(w.size), dt=0.095, hold=hold)
    y = rco.simulate(MODEL, blank, "zero").outputs[0]
    return rco.Measurement(w, y + noise * y.std() * rng.standard_normal(y.size), dt=0.095, hold=hold)


@pytest.mark.parametrize(
    ("declared", "true"),
    sweep([("zoh", "foh"), ("foh", "bandlimited"), ("bandlimited", "zoh"), ("foh", "foh")], HOLDS, HOLDS),
)
def test_the_hold_of_the_record_is_found(true, declared):
    data = coarse(true, 3).with_hold(declared)
    found = rco.diagnose(MODEL, data, candidates=LAWS)
    assert found.verdict == "adequate"
    assert blamed(found) == ([true] if true != declared else [])
    better = found.refine()
    assert (better.hold or declared) == true
    assert better.rmse[0] == pytest.approx(0.01 * data.outputs.std(), rel=0.1)


def test_records_that_declare_different_holds_are_taken_at_their_word():
    found = rco.diagnose(MODEL, [coarse("zoh", 1), coarse("foh", 2)], candidates=LAWS)
    assert (found.verdict, blamed(found), found.refine().hold) == ("adequate", [], None)


def test_improve_says_and_uses_the_right_hold():
    ladder = rco.improve(MODEL, coarse("foh", 4).with_hold("zoh"), candidates=LAWS)
    assert ladder.verdict == "adequate"
    assert ladder.effects == ()
    assert blamed(ladder) == [ladder.refinement.hold] == ["foh"]


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


def said_of(y):
    rng = np.random.default_rng(0)
    rows = signal_rows(rco.Measurement(rng.standard_normal(y.size), y, dt=0.1))
    return " ".join(row.sentence for row in rows)


@pytest.mark.parametrize("bits", [5, 8, 12])
@pytest.mark.parametrize("signal", ["sine", "resonance", "settling"])
def test_the_steps_of_a_converter_are_no_clipping(signal, bits):
    rng, t = np.random.default_rng(4), np.arange(3000)
    y = {
        "sine": np.sin(0.11 * t),
        "resonance": lfilter([1.0], [1.0, -1.9, 0.97], rng.standard_normal(3000)),
        "settling": lfilter([0.05], [1.0, -0.95], np.sign(np.sin(0.01 * t))),
    }[signal]
    step = np.ptp(y) / 2**bits
    assert "clipped" not in said_of(np.round(y / step) * step)
    if bits > 5 and signal != "settling":
        cut = np.minimum(y, 0.7 * y.max())
        assert "clipped" in said_of(np.round(cut / step) * step)
