"""The generator of records with hidden effects, held against `scipy.integrate.solve_ivp`."""

from __future__ import annotations

import numpy as np
import pytest
from hidden.generator import OUTSIDE, SECOND_ORDER, _law, excitation, integrate, linear_states
from hidden.integrator import LAWS, MEMORY, force_of
from hidden.plants import PLANTS
from scipy.integrate import solve_ivp


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
