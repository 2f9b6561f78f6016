"""A fault near a resonance is told from noise that has its color."""

from __future__ import annotations

import control as ct
import numpy as np
import pytest
from hidden.wider import Wider, wider_record
from scipy.signal import lfilter

import rcorefine as rco
from rcorefine.diagnosis import residual_tests
from rcorefine.diagnosis.case import candidates_of
from rcorefine.diagnosis.colored_noise import gain_over_color
from rcorefine.inference.fitted import fitted_from
from rcorefine.inference.levels import levels
from rcorefine.inference.sensitivities import candidate_columns
from rcorefine.inference.starts import Motion


def _gain(record: Wider, data: rco.Measurement) -> float:
    base = rco.refine(record.plant.model, data)
    fitted = fitted_from(base, [data], tolerance=0.0)
    motion = Motion(fitted.structure, fitted.theta, data)
    scored = candidate_columns(fitted, candidates_of(base.physical_model), motion, (0.0,))
    return gain_over_color(residual_tests.TestedResidual(fitted), scored)


def _ringing(record: Wider, rng: np.random.Generator) -> rco.Measurement:
    """The record with noise of 5 % that has the period and the damping of its resonance."""
    data, pole = record.data, np.linalg.eigvals(record.plant.A)[0]
    z = np.exp(pole * data.dt)
    noise = lfilter([1.0], [1.0, -2 * z.real, abs(z) ** 2], rng.standard_normal(data.n_samples + 4000))[4000:]
    y = data.outputs + 0.05 * data.outputs.std() * noise / noise.std()
    return rco.Measurement(data.inputs, y, dt=data.dt, hold=data.hold)


def test_what_is_missing_takes_the_color_away() -> None:
    """A law that costs 5 % leaves white noise; noise at the resonance stays what it is with any law."""
    for seed in range(6):
        lacking = wider_record(seed, plant="pendulum")
        assert _gain(lacking, lacking.data) > levels().color
        sound = wider_record(seed, plant="pendulum", kind=None)
        assert _gain(sound, _ringing(sound, np.random.default_rng(seed))) < levels().color
        assert _gain(sound, sound.data) < levels().color


@pytest.mark.parametrize("seed", [41002, 41006])
def test_a_resonance_hides_no_law(seed: int) -> None:
    """A pendulum that lacks a law is not adequate, though noise that rings as it does would explain it."""
    record = wider_record(seed, plant="pendulum")
    found = rco.diagnose(record.plant.model, record.data)
    assert found.verdict in ("effect", "ambiguous")
    assert record.kind in [effect.kind for effect in (found.best.effect, *found.ambiguous)]


@pytest.mark.parametrize("seed", [pytest.param(2, marks=pytest.mark.slow), 3])
def test_a_swinging_stiffness_is_no_color_of_the_noise(seed: int) -> None:
    """A free run that explains nothing leaves a residual that any filter whitens: no adequate model."""
    rng, dt, sub = np.random.default_rng(seed), 0.01, 50
    w = 3 * np.repeat(rng.standard_normal(400), 5)
    x = v = 0.0
    y = np.empty(w.size)
    for k, force in enumerate(w):
        y[k] = x
        for i in range(sub):  # symplectic Euler, 0.2 ms
            swing = 25 * np.sin(3 * np.pi * (k + i / sub) / w.size)
            v += dt / sub * (force - (60 + swing) * x - 0.8 * v)
            x += dt / sub * v
    model = ct.ss([[0, 1], [-60, -0.8]], [[0], [1]], [[1, 0]], 0, states=["q", "v"])
    found = rco.diagnose(model, rco.Measurement(w, y + 0.01 * y.std() * rng.standard_normal(w.size), dt=dt))
    assert found.verdict == "unexplained"
    assert found.place == "q"
    said = str(found).replace("\n", " ")  # beside "no test fires" it stands why that is not enough
    assert ("passes for noise with a memory" in said) == ("No test fires" in said)
