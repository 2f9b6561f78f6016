"""Remarks on the record: the hold told from parameters and filters, clipping told from an ADC's steps."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.signal import butter, cont2discrete, lfilter

import rcorefine as rco
from rcorefine.diagnosis.checks.signals import signal_rows
from rcorefine.diagnosis.holds import best_hold, hold_errors
from rcorefine.refinement.base_fit import base_fit

SETTINGS = {"tolerance": 0.0, "offset": True, "noise": None}
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


def held(model, data):
    base = base_fit(model, [data], free=(), tolerance=0.0, offset=True, noise=None)
    return base, best_hold(base, [data], SETTINGS)


@pytest.mark.parametrize("hold", ["zoh", "foh"])
@pytest.mark.parametrize(
    "fault",
    [
        {"off": 0.02},
        {"off": -0.04},
        {"behind": (4, 0.8)},
        {"behind": (1, 0.5)},
        {"off": 0.02, "behind": (2, 0.7)},
    ],
    ids=str,
)
def test_what_else_is_wrong_is_not_blamed_on_the_hold(hold, fault):
    assert held(*record(7, hold, hold, **fault))[1] == (hold, "")


def test_some_of_these_would_be_blamed_with_the_parameters_held():
    base, _ = held(*record(7, "foh", "foh", behind=(4, 0.8)))
    errors = hold_errors(base, [record(7, "foh", "foh", behind=(4, 0.8))[1]], SETTINGS)
    assert errors["foh"] - errors["zoh"] > 0.05


@pytest.mark.parametrize(("declared", "true"), [("zoh", "foh"), ("foh", "zoh")])
def test_a_wrong_hold_is_still_said(declared, true):
    _, (hold, sentence) = held(*record(8, declared, true))
    assert hold == true
    assert "The hold matters" in sentence


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
