"""What noise is, and that a fault near a resonance is told from noise that has its color."""

from __future__ import annotations

from collections.abc import Iterator

import control as ct
import numpy as np
import pytest
from cases import slow
from hidden.wider import Wider, wider_record
from scipy import stats
from scipy.signal import lfilter

import rcorefine as rco
from rcorefine.diagnosis import noise as noises


def _ringing(record: Wider, rng: np.random.Generator) -> rco.Measurement:
    """The record with noise of 5 % that has the period and the damping of its resonance."""
    data, pole = record.data, np.linalg.eigvals(record.plant.A)[0]
    z = np.exp(pole * data.dt)
    noise = lfilter([1.0], [1.0, -2 * z.real, abs(z) ** 2], rng.standard_normal(data.n_samples + 4000))[4000:]
    y = data.outputs + 0.05 * data.outputs.std() * noise / noise.std()
    return rco.Measurement(data.inputs, y, dt=data.dt, hold=data.hold)


@pytest.mark.parametrize("seed", [0, *slow(1, 2)])
def test_noise_that_rings_as_the_plant_does_is_no_fault(seed: int) -> None:
    sound = wider_record(seed, plant="pendulum", kind=None)
    found = rco.diagnose(sound.plant.model, _ringing(sound, np.random.default_rng(seed)))
    assert found.verdict == "adequate"


def _noises(rng: np.random.Generator) -> Iterator[tuple[str, np.ndarray, np.ndarray]]:
    """Name, outputs of a model, and what is measured of them."""
    y = 5 * np.sin(0.02 * np.arange(3000)) + rng.standard_normal(3000)
    e = rng.standard_normal(3000)
    yield "autoregressive 0", y, y + e
    yield "autoregressive 1", y, y + lfilter([1.0], [1.0, -0.8], e)
    yield "Student", y, y + rng.standard_t(3, 3000)
    yield "proportional", y, y + e * np.hypot(0.1, y)
    yield "rounded", y, np.round(y + 0.1 * e)


def test_each_sort_of_noise_is_recognized(rng: np.random.Generator) -> None:
    for name, y, seen in _noises(rng):
        outputs, steps = (
            np.array([[*seen], [*(y + rng.standard_normal(3000))]]),
            [noises.rounding_step(seen), 0.0],
        )
        found = noises.noise_of([np.array([y, y]) - outputs], [outputs], steps)
        assert found.names[0].startswith(name)
        assert found.names[1] == "autoregressive 0"
        assert found.uneven == (name in ("Student", "proportional"))
        if name == "autoregressive 1":
            np.testing.assert_allclose(found.whitener.filters[0], [1.0, -0.8], atol=0.05)
        if found.uneven:  # weights are one over the spread
            even = found.weights[0][0] * (y - seen)
            assert stats.kurtosis(even) < 0.5 * stats.kurtosis(y - seen)
        assert found.whitener.scales[1] == pytest.approx(1.0, rel=0.1)


def test_only_rounded_values_have_a_step(rng: np.random.Generator) -> None:
    y = rng.standard_normal(2000)
    assert noises.rounding_step(y) == 0.0
    for step in (0.01, 0.3):
        assert noises.rounding_step(step * np.round(y / step)) == pytest.approx(step)


@pytest.mark.parametrize("seed", [41002, *slow(41006)])
def test_a_resonance_hides_no_law(seed: int) -> None:
    """A pendulum that lacks a law is not adequate, though noise that rings as it does would explain it."""
    record = wider_record(seed, plant="pendulum")
    found = rco.diagnose(record.plant.model, record.data)
    named = [e for e in (*found.effects, *found.ambiguous) if record.at_truth(e.place, record.plant.model)]
    assert record.kind in [effect.kind for effect in named]


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
    assert "Not tried: " in said
    assert "input_rate_limit" in said
    assert ("cannot be distinguished from colored noise" in said) == ("No residual test" in said)
