"""Losses that are zero in a model are parameters of it."""

from __future__ import annotations

import control as ct
import numpy as np
import pytest
from cases import few_or_all, offered
from scipy.signal import cont2discrete, dlsim

import rcorefine as rco
from rcorefine.inference.parameters import nominal_size

MASS, SPRING = [[0.0], [1.0]], {"states": ["x", "v"], "inputs": ["f"], "outputs": ["x"]}


def bare(stiffness: float = 100.0, damping: float = 0.0) -> ct.StateSpace:
    return ct.ss([[0, 1], [-stiffness, -damping]], MASS, [[1, 0]], 0, **SPRING)


def built() -> rco.PhysicalModel:
    return rco.mass_spring_damper([1.0], [0.0], [100.0])


def record(
    plant: ct.StateSpace, dt: float, hold: int, size: int = 1500, noise: float = 0.02
) -> rco.Measurement:
    rng = np.random.default_rng(3)
    w = np.repeat(rng.choice([-1.0, 1.0], size // hold), hold)
    exact = cont2discrete((plant.A, plant.B, plant.C, plant.D), dt)
    y = dlsim(exact, w)[1].T
    return rco.Measurement(w, y + noise * y.std(axis=1, keepdims=True) * rng.standard_normal(y.shape), dt=dt)


@pytest.mark.parametrize("kinds", few_or_all("stiffness", "damping", "cubic_stiffness", "coulomb_friction"))
@pytest.mark.parametrize(
    "model", [pytest.param(built(), id="builder"), pytest.param(bare(), id="plain", marks=pytest.mark.slow)]
)
def test_a_model_without_damping_is_refined_and_needs_no_effect(model, kinds):
    data = record(bare(105.0, 0.6), 0.02, 10)
    better = rco.refine(model, data, free="linear")
    found = {row.kind: row for row in better.parameters}
    assert better.fit[0] == pytest.approx(98.0, abs=0.3)  # what 2 % of noise leaves
    scale = found["mass"].value if "mass" in found else 1.0 / found["input_gain"].value
    assert found["damping"].value / scale == pytest.approx(0.6, rel=0.02)
    assert found["stiffness"].value / scale == pytest.approx(105.0, rel=0.002)
    told = rco.diagnose(model, data, candidates=offered(model, kinds))
    assert told.verdict == "parameters"
    assert "0 in the model" in " ".join(str(told).split())


def test_neither_does_a_frequency_response():
    omega, rng = np.linspace(2.0, 30.0, 60), np.random.default_rng(0)
    exact = 1.0 / (105.0 - omega**2 + 0.6j * omega)
    std = 0.01 * np.abs(exact)
    noise = std / np.sqrt(2) * (rng.standard_normal(60) + 1j * rng.standard_normal(60))
    data = rco.FrequencyResponse(exact + noise, omega, std=std)
    assert rco.diagnose(bare(), data).verdict == "parameters"
    better = rco.refine(bare(), data, free="linear")
    (row,) = (row for row in better.parameters if row.kind == "damping")
    assert abs(row.value - 0.6) < 4 * row.std < 0.05


@pytest.mark.parametrize("kinds", few_or_all("stiffness", "damping", "cubic_stiffness", "coulomb_friction"))
def test_a_chain_without_damping_at_a_link(kinds):
    def chain(between: float, damping: float) -> ct.StateSpace:
        K = np.array([[100.0 + between, -between], [-between, between]])
        A = np.block([[np.zeros((2, 2)), np.eye(2)], [-K, -np.diag([damping, 0.0])]])
        names = ["q1", "q2", "v1", "v2"]
        return ct.ss(A, [[0], [0], [0], [1]], [[0, 1, 0, 0]], 0, states=names, inputs=["f"], outputs=["q2"])

    model = chain(200.0, 0.0)
    values = {q.name: q.value for q in rco.physical(model).parameters}
    assert {name for name, value in values.items() if value == 0} == {"c[q1-q2]", "c[q1]"}  # none at q2
    data = record(chain(212.0, 0.5), 0.02, 5, 1000)
    assert rco.diagnose(model, data, candidates=offered(model, kinds)).verdict == "parameters"


def test_a_choke_without_resistance_and_what_has_no_loss_at_all():
    choke = ct.ss([[0, -1000.0], [500.0, -250.0]], [[1000.0], [0]], [[0, 1]], 0, states=["iL", "vC"])
    assert ("c[iL]", 0.0) in [(q.name, q.value) for q in rco.physical(choke).parameters]
    motor = ct.ss(
        [[0, 1, 0], [0, 0, 20], [0, -1, -10]], [[0], [0], [5]], [[1, 0, 0]], 0, states=["phi", "w", "i"]
    )
    assert ("c[phi]", 0.0) in [(q.name, q.value) for q in rco.physical(motor).parameters]
    for A in ([[0.0, 1.0], [0.0, 0.0]], [[-1.0, 0.0], [1.0, 0.0]]):  # integrators: nothing sets a size
        integrator = ct.ss(A, [[0], [1]], [[1, 0]], 0)
        assert all(q.value for q in rco.physical(integrator).parameters)


@pytest.mark.parametrize("unit", [1.0, 1e-3])
def test_the_size_of_a_damping_that_is_zero_is_the_critical_one(unit):
    mass, stiffness = 2.0, 50.0
    A, B = [[0, unit], [-stiffness / mass / unit, 0]], [[0], [1 / mass / unit]]
    model = rco.physical(ct.ss(A, B, [[1, 0]], 0, **SPRING))  # speeds in another unit
    effect = rco.Effect("damping", "x")
    structure = rco.refine(model, record(bare(25.0, 0.3), 0.05, 10), [effect]).simulation_structure()[0]
    assert nominal_size(structure, effect) == pytest.approx(2.0 * np.sqrt(stiffness * mass))
