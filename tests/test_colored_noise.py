"""A fault near a resonance is told from noise that has its color."""

from __future__ import annotations

import control as ct
import numpy as np
import pytest
from scipy.signal import lfilter

import rcorefine as rco
from hidden.wider import wider_record
from rcorefine.diagnosis.colored_noise import gain_over_color
from rcorefine.diagnosis.residual_tests import TestedResidual
from rcorefine.effects.effect import Effect
from rcorefine.inference.fitted import fitted_from
from rcorefine.inference.levels import levels
from rcorefine.inference.sensitivities import candidate_columns
from rcorefine.inference.starts import Motion

RESONANCE, DAMPING, DT = 2.0, 0.02, 0.1


def _gain(model: ct.StateSpace, record: rco.Measurement, kinds: list[Effect]) -> float:
    fitted = fitted_from(rco.refine(model, record), [record], tolerance=0.0)
    motion = Motion(fitted.structure, fitted.theta, record)
    return gain_over_color(TestedResidual(fitted), candidate_columns(fitted, kinds, motion, (0.0,)))


def _resonant(rng: np.random.Generator, samples: int) -> np.ndarray:
    """Noise of unit size with the period and the damping of the resonance."""
    pole = np.exp(DT * RESONANCE * (-DAMPING + 1j * np.sqrt(1 - DAMPING**2)))
    made = lfilter([1.0], np.poly([pole, pole.conj()]).real, rng.standard_normal(samples + 2000))[2000:]
    return np.asarray(made / made.std())


@pytest.mark.parametrize("missing", [False, True])
def test_color_is_explained_by_what_takes_it_away(missing: bool) -> None:
    """A spring that stiffens costs about what the noise at the resonance does: only the former is explained."""
    model = rco.mass_spring_damper([1.0], [2 * DAMPING * RESONANCE], [RESONANCE**2], sensors="displacement")
    kinds = [Effect(kind, "m1") for kind in ("cubic_stiffness", "quadratic_damping", "coulomb_friction")]
    true = rco.Effect("cubic_stiffness", "m1", start={"cubic_stiffness": 0.05})
    for seed in range(6):
        rng = np.random.default_rng(seed)
        w = rng.standard_normal(2500)
        blank = rco.Measurement(w, np.zeros(2500), dt=DT)
        y = rco.simulate(model, blank, "zero").outputs[0]
        level = 0.05 * y.std()
        if missing:
            y = rco.simulate(model, blank, "zero", effects=[true]).outputs[0]
        else:
            y = y + level * _resonant(rng, 2500)
        record = rco.Measurement(w, y + 0.6 * level * rng.standard_normal(2500), dt=DT)
        assert (_gain(model, record, kinds) > levels().color) == missing


@pytest.mark.parametrize("seed", [41002, 41006])
def test_a_resonance_hides_no_law(seed: int) -> None:
    """A pendulum that lacks a law which costs 5 % is not adequate: the noise that would explain it rings as it does."""
    record = wider_record(seed, plant="pendulum")
    found = rco.diagnose(record.plant.model, record.data)
    assert found.verdict in ("effect", "ambiguous")
    assert record.kind in [effect.kind for effect in (found.best.effect, *found.ambiguous)]
