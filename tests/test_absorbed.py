"""An adequate verdict says what the fit absorbed before nothing was missing."""

from __future__ import annotations

import control as ct
import numpy as np
import pytest

import rcorefine as rco
from rcorefine import Effect, Measurement

STEP, N = 0.02, 2000


def trolley(drag=0.8) -> rco.PhysicalModel:
    return rco.mass_spring_damper([2.0], [drag], [30.0], sensors=("velocity", 1), outputs="speed")


def record(zero=0.0, drag=0.8, noise=0.02, seed=1) -> Measurement:
    rng = np.random.default_rng(seed)
    w = 3 * rng.standard_normal(N)
    y = ct.forced_response(trolley(drag).system.sample(STEP), U=w).outputs
    y = y + noise * y.std() * rng.standard_normal(N)
    return Measurement(w, y + zero, dt=STEP, output_labels="speed")


def answer(data: Measurement, **options) -> tuple[rco.Diagnosis, str]:
    laws = [Effect("cubic_stiffness", "link1"), Effect("coulomb_friction", "link1")]
    found = rco.diagnose(trolley(), data, candidates=laws, **options)
    return found, found.sentences()[0]


def test_an_offset_is_said_with_the_fit_that_compare_shows():
    data = record(zero=5.0)
    found, sentence = answer(data)
    assert found.verdict == "adequate"
    assert "an offset of 5 m/s at speed" in sentence
    shown = rco.compare(trolley(), data).fit[0]
    assert shown < -500  # and yet nothing is missing: the reader must be told why
    assert f"{shown:.4g} %" in sentence
    assert sentence in " ".join(str(found).split())


def test_refitted_parameters_are_said():
    found, sentence = answer(record(drag=1.0), free="linear")
    assert found.verdict == "adequate"
    value = float(sentence.split("c1 from 0.8 to ")[1].split()[0])
    assert value == pytest.approx(1.0, rel=0.05)
    assert "(+2" in sentence  # per cent, about 25


def test_nothing_is_said_where_nothing_was_absorbed():
    found, sentence = answer(record())
    assert found.verdict == "adequate"
    assert sentence == "This record shows no missing effect."
