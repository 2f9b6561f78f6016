"""The generator of records with hidden effects, held against `scipy.integrate.solve_ivp`."""

from __future__ import annotations

import numpy as np
import pytest
from hidden.generator import OUTSIDE, SECOND_ORDER, _law, excitation, integrate, linear_states
from hidden.integrator import LAWS, MEMORY, force_of
from hidden.plants import PLANTS
from hidden.wider import PLANTS as WIDER
from hidden.wider import march_with
from scipy.integrate import solve_ivp
from scipy.signal import cont2discrete


@pytest.mark.parametrize("kind", [*SECOND_ORDER, *(k for k in OUTSIDE if k != "input saturation")])
def test_motion_is_that_of_solve_ivp(kind):
    """Each sample on its own, tight tolerances: to 1e-4 of the motion where the law is smooth or not."""
    rng = np.random.default_rng([3, len(kind)])
    plant = PLANTS["chain"](rng, 1)
    place = plant.places[-1]
    w = excitation(rng, plant, 120)
    law = _law(plant, place, linear_states(plant, w), kind, 0.2, w.shape[1])
    found = integrate(plant, w, law, place)
    n, size = plant.A.shape[0], plant.A.shape[0] + MEMORY.get(kind, 0)
    steer = (plant.B @ w).T
    x, expected = np.zeros(size), [np.zeros(size)]
    for k in range(w.shape[1] - 1):

        def rhs(t, x, k=k):
            inner = np.zeros(2)
            force = force_of(
                LAWS[kind], law.p, k * plant.dt + t, place.d @ x[:n], place.v @ x[:n], x[n:], inner
            )
            drive = steer[k] + t / plant.dt * (steer[k + 1] - steer[k])
            return np.concatenate([plant.A @ x[:n] + drive + place.act * force, inner[: size - n]])

        x = solve_ivp(rhs, (0, plant.dt), x, rtol=1e-8, atol=1e-10 * np.abs(steer).max()).y[:, -1]
        expected.append(x)
    expected = np.array(expected).T
    scale = np.abs(expected[:n]).max(axis=1, keepdims=True)
    assert np.abs((found - expected)[:n] / scale).max() < 1e-4


FORMULAS = {
    "v^1.5": lambda d, v: np.sign(v) * np.abs(v) ** 1.5,
    "sine": lambda d, v: np.sin(d / 1.5),
    "quintic": lambda d, v: d**5,
    "impact damper": lambda d, v: v * max(d, 0.0),
    "valve": lambda d, v: v if abs(v) < 1.5 else np.sign(v) * (1.5 + 0.2 * (abs(v) - 1.5)),
    "soft saturation": lambda d, v: np.tanh(d / 1.5),
    "inverse square": lambda d, v: 1 / (1 + d / 1.5) ** 2 - 1,
    "radiation": lambda d, v: ((1.5 + v) ** 4 - 1.5**4) / 1.5**4,
    "soft dead zone": lambda d, v: (
        0.45 * (np.logaddexp(0, (d - 1.5) / 0.45) - np.logaddexp(0, (-d - 1.5) / 0.45))
    ),
}  # fmt: skip


@pytest.mark.parametrize("kind", FORMULAS)
def test_laws_of_no_library(kind):
    for d, v in ((0.3, -0.4), (2.0, 1.9), (-0.7, 0.1)):
        force = force_of(LAWS[kind], np.array([2.0, 1.5, 0.0]), 0.0, d, v, np.zeros(2), np.zeros(2))
        assert force == pytest.approx(2 * FORMULAS[kind](d, v), rel=1e-6)


@pytest.mark.parametrize("name", WIDER)
def test_plants_off_the_chains(name):
    """Nothing hidden: the held response of scipy; a law at its site takes energy or turns a spring."""
    plant = WIDER[name](np.random.default_rng(5))
    w = np.random.default_rng(6).standard_normal((1, 200))
    states = march_with(plant, w, None, "none", np.array([0.0, 1.0, 0.0]))[0]
    A, B, *_ = cont2discrete((plant.A, plant.B, plant.C, np.zeros((len(plant.C), 1))), plant.dt)
    x = np.zeros((len(A), 200))
    for k in range(199):
        x[:, k + 1] = A @ x[:, k] + B @ w[:, k]
    assert np.abs(states - x).max() < 1e-5 * np.abs(x).max()
    assert np.linalg.eigvals(plant.A).real.max() < 1e-9
    assert all(site.v @ site.act < 0 for site in plant.sites)
