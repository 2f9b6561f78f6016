"""A line in a residual is named; noise near a resonance is none."""

from __future__ import annotations

import re

import control as ct
import numpy as np
import pytest
from scipy.signal import cont2discrete, lfilter

import rcorefine as rco
from rcorefine.comparison.failure_map.frequency import period_of
from rcorefine.diagnosis.noise import spectral_line

DT = 0.02


def test_a_sine_is_a_line_and_noise_at_a_resonance_is_none() -> None:
    found, false = 0, 0
    for seed in range(40):
        rng = np.random.default_rng(seed)
        omega = 2 * np.pi * rng.uniform(0.5, 4.0)
        sine = np.sin(omega * np.arange(2500) * DT + rng.uniform(0, 6)) + 0.5 * rng.standard_normal(2500)
        line = spectral_line([sine[None]], DT)
        if line is not None:
            found += 1
            assert line[0] == pytest.approx(omega / (2 * np.pi), abs=0.05 / 50)
        pole = np.exp(complex(-0.01, 1) * omega * DT)
        ringing = lfilter([1], [1, -2 * pole.real, abs(pole) ** 2], rng.standard_normal(6000))[3500:]
        false += spectral_line([ringing[None]], DT) is not None
    assert found >= 38
    assert false <= 2


def test_a_force_of_one_frequency_is_said_before_anything_else() -> None:
    n, rng = 2500, np.random.default_rng(3)
    A, B = np.array([[0, 1], [-90.0, -1.3]]), np.array([[0, 0], [1.0, 1.0]])
    known = 6 * rng.standard_normal(n // 10).repeat(10)
    unseen = 1.2 * np.sin(2 * np.pi * 0.9 * np.arange(n) * DT)
    step, into, *_ = cont2discrete((A, B, np.eye(2), np.zeros((2, 2))), DT)
    x, y = np.zeros(2), np.empty(n)
    for k in range(n):
        y[k] = x[0]
        x = step @ x + into @ [known[k], unseen[k]]
    model = ct.ss(A, B[:, :1], [[1, 0]], 0, states=["q", "v"])
    found = rco.diagnose(model, rco.Measurement(known, y + 0.02 * y.std() * rng.standard_normal(n), dt=DT))
    assert found.verdict == "adequate"
    head = found.sentences()[0]
    assert head.startswith("The free run explains only")
    said = float(re.search(r"is a line at ([\d.]+) rad/s", head)[1])
    assert abs(said - 2 * np.pi * 0.9) < np.pi / (n * DT)  # half a line of the spectrum


def test_a_period_is_the_shortest_and_of_all_inputs() -> None:
    rng = np.random.default_rng(0)
    bits = np.repeat(rng.choice([-1.0, 1.0], 100), 4)
    once, twice = np.tile(bits, 3), np.tile(bits[:200], 6)
    assert period_of(once[None]) == 400
    assert period_of(twice[None]) == 200
    assert period_of(np.array([once, twice])) == 400
    once[1100] *= -1.0
    assert period_of(once[None]) is None
    assert period_of(np.ones((1, 50))) is None
